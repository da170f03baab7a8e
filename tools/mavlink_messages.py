"""Writes src/rotorwatch/logs/mavlink_messages.json: MAVLink's messages as they are on the wire, of pymavlink's ardupilotmega dialect.

    python tools/mavlink_messages.py

The table is all that rotorwatch needs of pymavlink (90 MB on the disk), which tests compare it with. Message -> [id, seed of its check sum,
format of its payload (`struct`), fields in the order on the wire].
"""

from __future__ import annotations

import json
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega

TABLE = Path(__file__).parents[1] / "src" / "rotorwatch" / "logs" / "mavlink_messages.json"
# MAVLink's common messages that this dialect lacks; their seeds follow from names and types by MAVLink's serialization guide.
BESIDES = {
    "ESC_INFO": [290, 251, "<Q4IH4H4hBBBB", [
        "time_usec", "error_count", "counter", "failure_flags", "temperature", "index", "count", "connection_type", "info",
    ]],
    "ESC_STATUS": [291, 10, "<Q4i4f4fB", ["time_usec", "rpm", "voltage", "current", "index"]],
    "COMPONENT_METADATA": [397, 182, "<II100s", ["time_boot_ms", "file_crc", "uri"]],
    "EVENT": [410, 160, "<IIHBBB40B", [
        "id", "event_time_boot_ms", "sequence", "destination_component", "destination_system", "log_levels", "arguments",
    ]],
    "CURRENT_EVENT_SEQUENCE": [411, 106, "<HB", ["sequence", "flags"]],
    "REQUEST_EVENT": [412, 33, "<HHBB", ["first_sequence", "last_sequence", "target_system", "target_component"]],
    "RESPONSE_EVENT_ERROR": [413, 77, "<HHBBB", [
        "sequence", "sequence_oldest_available", "target_system", "target_component", "reason",
    ]],
}  # fmt: skip


def table() -> dict[str, list]:
    """All messages by name, in the order of their ids."""
    found = dict(BESIDES)
    for message in ardupilotmega.mavlink_map.values():
        code = message.unpacker.format
        code = code.decode() if isinstance(code, bytes) else code
        found[message.msgname] = [message.id, message.crc_extra, code, list(message.ordered_fieldnames)]
    return dict(sorted(found.items(), key=lambda item: item[1][0]))


def text() -> str:
    """The file: a message a line."""
    rows = (f"{json.dumps(name)}: {json.dumps(row, separators=(',', ':'))}" for name, row in table().items())
    return "{\n" + ",\n".join(rows) + "\n}\n"


if __name__ == "__main__":
    TABLE.write_text(text(), "utf-8")
    print(f"{TABLE}: {len(table())} messages, {TABLE.stat().st_size / 1000:.0f} kB")
