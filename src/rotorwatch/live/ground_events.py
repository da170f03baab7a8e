"""Alerts as MAVLink events, and the definitions that receivers decode them by.

An EVENT carries a number and packed arguments; its text is in a JSON file that the component itself holds (COMPONENT_METADATA,
MAVLink FTP). https://mavlink.io/en/services/events.html, https://github.com/mavlink/libevents (format, and how lost events are requested),
https://mavlink.io/en/services/component_metadata.html, https://mavlink.io/en/services/ftp.html
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections import deque
from collections.abc import Mapping
from functools import cache
from typing import Any

from rotorwatch.answer.falls import CAUSES
from rotorwatch.flight import kinds
from rotorwatch.live.alert_states import ANNOUNCED, CHANGED, FINAL, WITHDRAWN
from rotorwatch.live.framing import Outgoing, outgoing
from rotorwatch.live.requests import COMPONENT, REQUEST_MESSAGE

COMMAND, FTP, REQUEST = 76, 110, 412  # messages that are answered
METADATA = 397
KEPT = 50  # latest events, for receivers that have lost some
STATES = (ANNOUNCED, CHANGED, WITHDRAWN, FINAL)
SURE, UNSURE, NAMELESS, ESC = 1, 2, 3, 4  # events
ROTORS = 16
GENERAL, EVENTS = "/general.json", "/events.json.xz"
RESET = 1  # of CURRENT_EVENT_SEQUENCE: forget earlier numbers
_CAUSES = ("", *CAUSES)
_PACKED = {SURE: "<BBHBBB", UNSURE: "<BBHBBBH", NAMELESS: "<BBB", ESC: "<BB"}


class Sent:
    """The events of one vehicle, numbered. sequence: of the last one."""

    def __init__(self):
        self.sequence = 0
        self._kept: deque[tuple[int, Outgoing]] = deque(maxlen=KEPT)

    def add(self, alert: dict, severity: int, boot_ms: int) -> Outgoing:
        """The EVENT of an alert. severity: MAV_SEVERITY, whose numbers are those of its log levels."""
        self.sequence = (self.sequence + 1) % 2**16
        which, packed = _arguments(alert)
        fields = {"id": COMPONENT << 24 | which, "sequence": self.sequence, "event_time_boot_ms": boot_ms}
        levels = severity << 4 | severity
        made = outgoing("EVENT", **fields, log_levels=levels, arguments=list(packed.ljust(40, b"\0")))
        self._kept.append((self.sequence, made))
        return made

    def current(self) -> Outgoing:
        """The number of the last event, by which receivers notice a loss."""
        return outgoing("CURRENT_EVENT_SEQUENCE", sequence=self.sequence, flags=0 if self._kept else RESET)

    def again(self, asked: Mapping[str, Any], system: int, component: int) -> list[Outgoing]:
        """The answers to a REQUEST_EVENT of that system and component."""
        kept, answers = dict(self._kept), []
        for k in range(min((asked["last_sequence"] - asked["first_sequence"]) % 2**16 + 1, KEPT)):
            number = (asked["first_sequence"] + k) % 2**16
            if number in kept:
                answers.append(kept[number])
            else:
                oldest = self._kept[0][0] if self._kept else self.sequence
                whom = {"target_system": system, "target_component": component}
                answers.append(outgoing("RESPONSE_EVENT_ERROR", sequence=number, sequence_oldest_available=oldest, **whom))
        return answers


def _bits(rotors) -> int:
    return sum({1 << (rotor - 1) for rotor in rotors if rotor <= ROTORS})


def _percent(share: float) -> int:
    return round(100.0 * min(max(share, 0.0), 1.0))


def _arguments(alert: dict) -> tuple[int, bytes]:
    """(event, its packed arguments)."""
    if alert["type"] == "notice":
        return ESC, struct.pack(_PACKED[ESC], alert["rotor"], "stopped" not in alert["text"])
    event = alert["event"]
    kind = kinds.kind_of(event["kind"]).number % 256
    what = kind, STATES.index(alert["state"])
    if not event["rotors"]:
        cause = event.get("cause", "")
        return NAMELESS, struct.pack(_PACKED[NAMELESS], *what, _CAUSES.index(cause) if cause in _CAUSES else 0)
    ranges = event["interval"] or [[0.0, 0.0]]
    sizes = max(event["loss"], default=0.0), min(low for low, _ in ranges), max(high for _, high in ranges)
    named = (*what, _bits(event["rotors"]), *map(_percent, sizes))
    if not event["alternatives"]:
        return SURE, struct.pack(_PACKED[SURE], *named)
    return UNSURE, struct.pack(_PACKED[UNSURE], *named, _bits(r for others in event["alternatives"] for r in others))


def _enum(kind: str, entries: Mapping[int, tuple[str, str]], **more: Any) -> dict[str, Any]:
    return {"type": kind, **more, "entries": {str(k): {"name": name, "description": text} for k, (name, text) in entries.items()}}


@cache
def definitions() -> dict[str, Any]:
    """The definitions of the events, in libevents' format, version 2."""
    known = {kind.number % 256: (kind.name, kind.noun) for kind in kinds.table().values()}
    bits = {1 << k: (f"rotor_{k + 1}", str(k + 1)) for k in range(ROTORS)}
    causes = {k: (name or "none", CAUSES.get(name, "unknown")) for k, name in enumerate(_CAUSES)}
    enums = {
        "kind_t": _enum("uint8_t", known, description="Kind of an event"),
        "state_t": _enum("uint8_t", {k: (name, name) for k, name in enumerate(STATES)}, description="State of an alert"),
        "rotors_t": _enum("uint16_t", bits, description="Rotors", is_bitfield=True, separator="+"),
        "cause_t": _enum("uint8_t", causes, description="Cause of a loss of control"),
        "turns_t": _enum("uint8_t", {0: ("stopped", "stopped"), 1: ("turns", "turns again")}, description="State of a motor"),
    }
    what = [("kind_t", "kind"), ("state_t", "state")]
    named = [*what, ("rotors_t", "rotors"), ("uint8_t", "loss"), ("uint8_t", "loss_low"), ("uint8_t", "loss_high")]
    size = "Largest loss of a rotor's thrust: {4} %, its 95 % interval {5} to {6} %."
    events = {
        SURE: ("rotor", "{1} of rotor {3}, {4} % ({2})", size, named),
        UNSURE: ("rotor_or", "{1} of rotor {3} or {7}, {4} % ({2})", size, [*named, ("rotors_t", "others")]),
        NAMELESS: ("vehicle", "{1} ({2})", "Cause: {3}", [*what, ("cause_t", "cause")]),
        ESC: ("esc", "ESC of rotor {1}: motor {2}", "", [("uint8_t", "rotor"), ("turns_t", "turns")]),
    }
    group = {
        str(number): {
            "name": name, "message": message, **({"description": more} if more else {}),
            "arguments": [{"type": kind, "name": label} for kind, label in arguments],
        }
        for number, (name, message, more, arguments) in events.items()
    }  # fmt: skip
    component = {"namespace": "rotorwatch", "enums": enums, "event_groups": {"default": {"events": group}}}
    return {"version": 2, "components": {str(COMPONENT): component}}


@cache
def files() -> dict[str, bytes]:
    """Path -> content of the files that are offered over MAVLink FTP."""
    events = lzma.compress(json.dumps(definitions()).encode())
    types = [{"type": 4, "uri": uri(EVENTS), "fileCrc": crc(events)}]  # COMP_METADATA_TYPE_EVENTS
    return {GENERAL: json.dumps({"version": 1, "metadataTypes": types}).encode(), EVENTS: events}


def uri(path: str) -> str:
    """The address of a file on this component."""
    return f"mftp://[;comp={COMPONENT}]{path}"


def crc(content: bytes) -> int:
    """CRC-32 as MAVLink FTP has it: without the inversions at its start and its end."""
    return zlib.crc32(content, 0xFFFFFFFF) ^ 0xFFFFFFFF


def metadata(asked: Mapping[str, Any], system: int, component: int, boot_ms: int) -> list[Outgoing]:
    """The answers to a COMMAND_LONG of that system and component: to a request for COMPONENT_METADATA. All others may be meant for another
    program with this component id, and get none."""
    if asked["command"] != REQUEST_MESSAGE or round(asked["param1"]) != METADATA:
        return []
    file = {"time_boot_ms": boot_ms, "file_crc": crc(files()[GENERAL]), "uri": uri(GENERAL).encode()}
    whom = {"target_system": system, "target_component": component}
    return [outgoing("COMMAND_ACK", command=REQUEST_MESSAGE, **whom), outgoing("COMPONENT_METADATA", **file)]


_HEAD = struct.Struct("<HBBBBBxI")  # number, session, operation, size, operation that is answered, end of a burst, offset
_ROOM = 239  # bytes of data
_TERMINATE, _OPEN, _READ, _CRC, _BURST, _ACK, _NAK, _END = 1, 4, 5, 14, 15, 128, 129, 6
SESSIONS = 64


class Transfers:
    """The `files` over MAVLink FTP, read only. What is not about one of them may be meant for another program with this component id, and
    gets no answer."""

    def __init__(self):
        self._open: dict[tuple[int, int, int], str] = {}  # (system, component, session) -> path; clients name their sessions

    def answers(self, payload: bytes, system: int, component: int) -> list[Outgoing]:
        """The answers to a FILE_TRANSFER_PROTOCOL of that system and component, with this payload."""
        number, session, operation, size, _, _, offset = _HEAD.unpack_from(payload)
        key = system, component, session
        path = self._open.get(key)
        if operation in (_OPEN, _CRC):
            path = payload[_HEAD.size : _HEAD.size + size].rstrip(b"\0").decode("utf-8", "replace")
        content = files().get(path or "")
        if content is None:
            self._open.pop(key, None)
            return []

        def answer(kind: int, data: bytes, step: int = 1, end: bool = False, at: int = offset) -> Outgoing:
            head = _HEAD.pack((number + step) % 2**16, session, kind, len(data), operation, end, at)
            whom = {"target_system": system, "target_component": component}
            return outgoing("FILE_TRANSFER_PROTOCOL", **whom, payload=list((head + data).ljust(251, b"\0")))

        if operation == _CRC:
            return [answer(_ACK, struct.pack("<I", crc(content)))]
        if operation == _OPEN:
            if len(self._open) >= SESSIONS:
                del self._open[next(iter(self._open))]
            self._open[key] = path or ""
            return [answer(_ACK, struct.pack("<I", len(content)))]
        if operation == _TERMINATE:
            del self._open[key]
            return [answer(_ACK, b"")]
        if operation not in (_READ, _BURST):
            return []
        if offset >= len(content):
            return [answer(_NAK, bytes([_END]))]
        if operation == _READ:
            return [answer(_ACK, content[offset : offset + min(size or _ROOM, _ROOM)])]
        places = range(offset, len(content), _ROOM)
        return [answer(_ACK, content[at : at + _ROOM], k, at == places[-1], at) for k, at in enumerate(places, 1)]
