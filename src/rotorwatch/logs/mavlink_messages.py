"""MAVLink messages on the wire.

The table next to this file is made from pymavlink's ardupilotmega dialect (`tools/mavlink_messages.py`): all that is needed of 90 MB.
https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import json
import struct
from functools import cache
from pathlib import Path
from typing import NamedTuple


class Message(NamedTuple):
    """name, id; seed: of its check sum; form: of its payload, as `struct` has it; fields: in the order on the wire."""

    name: str
    id: int
    seed: int
    form: str
    fields: tuple[str, ...]

    def payload(self, /, **values) -> bytes:
        """The payload with these values, a sequence for an array, bytes for a text; omitted fields are 0."""
        unknown = values.keys() - set(self.fields)
        if unknown:
            raise TypeError(f"{self.name} has no field {', '.join(sorted(unknown))}")
        flat: list = []
        for name, (code, count) in zip(self.fields, parts(self.form), strict=True):
            value = values.get(name, b"" if code == "s" else 0)
            flat += value if count > 1 and code != "s" and value else [value] * (1 if code == "s" else count)
        return struct.pack(self.form, *flat)


def parts(form: str) -> list[tuple[str, int]]:
    """(code, count) of each field: "3H" is an array, "16s" a text; repeated single codes are fields of their own."""
    parts_, number = [], ""
    for c in form.lstrip("<"):
        if c.isdigit():
            number += c
        else:
            parts_.append((c, int(number or 1)))
            number = ""
    return parts_


@cache
def by_name() -> dict[str, Message]:
    """All messages, by name."""
    table = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))
    return {name: Message(name, id, seed, form, tuple(fields)) for name, (id, seed, form, fields) in table.items()}


@cache
def by_id() -> dict[int, Message]:
    """All messages, by id."""
    return {message.id: message for message in by_name().values()}
