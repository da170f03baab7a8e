"""ROS 2 message encoding: definitions as text, values in Common Data Representation (CDR).

Definitions: https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html. CDR: OMG, "DDS-XTypes" 1.3, 7.4: four bytes that name the
encoding, then the fields in order, each aligned to its own size (to 4 bytes at most in the second version).

The layout of one message applies to all with the same lengths of strings and sequences, so that whole columns are decoded at once.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

PRIMITIVES = {"bool": "u1", "byte": "u1", "char": "u1", "float32": "f4", "float64": "f8"}
PRIMITIVES |= {f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
HEADER = 4  # bytes before the first field
# Encoding: byte order, largest alignment.
ENCODINGS = {0: (">", 8), 1: ("<", 8), 6: (">", 4), 7: ("<", 4)}
MOST_FIELDS, DEEPEST, MOST_LAYOUTS = 20_000, 10, 2000
ELEMENTS = 64  # of a sequence or an array of numbers; longer ones (images, covariances of covariances) are passed over

_FIELD = re.compile(r"([A-Za-z][\w/]*)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+([A-Za-z]\w*)\s*(=?)")
_RULE = re.compile(r"^=+\s*$", re.MULTILINE)


class Unreadable(ValueError):
    """An invalid definition or message."""


@dataclass(frozen=True)
class Field:
    """A field: `count` None for a single value, 0 for a sequence, else the length of an array."""

    name: str
    kind: str
    count: int | None


def parse(text: str, kind: str) -> dict[str, list[Field]]:
    """Type -> its fields, of a message's definition and of those that follow it, each after a line of = and `MSG: type`.

    kind: the message's type, `px4_msgs/msg/VehicleStatus`. Types have the form `package/Type` here. Raises Unreadable."""
    kind, out = short(kind), {}
    for number, part in enumerate(_RULE.split(text.replace("\r", ""))):
        name, lines = kind, part.strip().split("\n")
        if number:
            if not lines[0].startswith("MSG:"):
                raise Unreadable("a definition without a name")
            name, lines = short(lines[0][4:].strip()), lines[1:]
        out[name] = _fields(lines, name.partition("/")[0])
    _check(out, kind)
    return out


def short(kind: str) -> str:
    """`package/msg/Type` -> `package/Type`."""
    return kind.replace("/msg/", "/")


def _fields(lines: Sequence[str], package: str) -> list[Field]:
    out = []
    for line in lines:
        match = _FIELD.match(line.strip())
        if match is None:
            if line.strip() and not line.strip().startswith("#"):
                raise Unreadable(f"a line that is no field: {line.strip()[:60]!r}")
            continue
        kind, array, name, constant = match.groups()
        if constant:
            continue
        if kind not in PRIMITIVES and kind not in ("string", "wstring"):
            kind = "std_msgs/Header" if kind == "Header" else short(kind) if "/" in kind else f"{package}/{kind}"
        digits = array.strip("[]") if array else ""
        out.append(Field(name, kind, None if array is None else int(digits) if digits.isdigit() else 0))
    # A message without fields has one byte.
    return out or [Field("structure_needs_at_least_one_member", "uint8", None)]


def _check(types: Mapping[str, list[Field]], kind: str) -> None:
    """Refuse types that are missing, recursive or have an absurd number of fields: only damage causes that."""
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if name in PRIMITIVES or name in ("string", "wstring"):
            return 1
        if depth > DEEPEST or name not in types:
            raise Unreadable(f"no definition of {name}")
        if name not in sizes:
            sizes[name] = sum(max(1, f.count or 1) * size(f.kind, depth + 1) for f in types[name] if not _long(f))
            if sizes[name] > MOST_FIELDS:
                raise Unreadable(f"a definition of {name} that cannot be")
        return sizes[name]

    size(kind, 0)


def _long(field: Field) -> bool:
    """True if this array of numbers is skipped."""
    return field.kind in PRIMITIVES and (field.count or 0) > ELEMENTS


@dataclass
class _Layout:
    """Offsets of a message's values, in bytes from its first: numbers (NumPy type, offset), strings (offset, length), and the bytes that
    have to be the same in another message for this layout to apply."""

    order: str
    align: int
    at: int = HEADER
    numbers: dict[str, tuple[str, int]] = field(default_factory=dict)
    strings: dict[str, tuple[int, int]] = field(default_factory=dict)
    same: list[int] = field(default_factory=lambda: list(range(HEADER)))


def _layout(data: bytes, types: Mapping[str, list[Field]], kind: str, wanted) -> _Layout:
    """The layout of one message. Raises Unreadable where the message is shorter than its definition, or of another encoding."""
    if len(data) < HEADER or data[0] or data[1] not in ENCODINGS:
        raise Unreadable("a message of an unknown encoding")
    where = _Layout(*ENCODINGS[data[1]])
    for f in types[kind]:
        _place(data, types, f, f.name, where, wanted is None or f.name in wanted)
    return where


def _place(data, types, f: Field, path: str, where: _Layout, keep: bool) -> None:
    count = f.count
    if count == 0:
        count = _length(data, where)
        if count > len(data):
            raise Unreadable("a sequence that is longer than its message")
    if f.kind in PRIMITIVES:
        _numbers(data, PRIMITIVES[f.kind], count, path, where, keep)
        return
    for i in range(1 if count is None else count):
        at = path if count is None else f"{path}[{i}]"
        if f.kind == "string":
            length = _length(data, where)
            if keep:
                where.strings[at] = where.at, max(0, length - 1)
            _advance(data, where, length)
        elif f.kind == "wstring":
            raise Unreadable("wide strings")
        else:
            for inner in types[f.kind]:
                _place(data, types, inner, f"{at}.{inner.name}", where, keep)
        if len(where.numbers) > MOST_FIELDS:
            raise Unreadable("a message with more fields than one can have")


def _numbers(data, code: str, count: int | None, path: str, where: _Layout, keep: bool) -> None:
    if count == 0:
        return
    size = int(code[1])
    step = min(size, where.align)
    start = HEADER + -(-(where.at - HEADER) // step) * step
    where.at = start
    _advance(data, where, size * (1 if count is None else count))
    if not keep or (count or 0) > ELEMENTS:
        return
    if count is None:
        where.numbers[path] = where.order + code, start
    else:
        where.numbers.update({f"{path}[{i}]": (where.order + code, start + i * size) for i in range(count)})


def _length(data, where: _Layout) -> int:
    """The count of four bytes that comes next."""
    start = HEADER + -(-(where.at - HEADER) // 4) * 4
    where.at = start
    _advance(data, where, 4)
    where.same.extend(range(start, start + 4))
    return struct.unpack_from(where.order + "I", data, start)[0]


def _advance(data, where: _Layout, size: int) -> None:
    where.at += size
    if where.at > len(data):
        raise Unreadable("a message that is shorter than its definition")


def decode(payloads: Sequence[bytes], types: Mapping[str, list[Field]], kind: str, wanted=None):
    """({field path: (m,) array}, rows (m,)): the readable messages, and their indices in `payloads`, in order.

    Paths are flattened as PX4 flattens them: `control[3]`, `esc[0].esc_rpm`, `header.stamp.sec`. Strings become arrays of str. Numbers that
    only some messages have are NaN in the others. wanted: names of the fields to keep; None: all."""
    kind, pieces, layouts = short(kind), [], 0
    sizes = np.array([len(p) for p in payloads])
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        block = np.frombuffer(b"".join(payloads[i] for i in rows.tolist()), np.uint8).reshape(rows.size, size)
        left = np.arange(rows.size)
        while left.size and layouts < MOST_LAYOUTS:
            layouts += 1
            try:
                where = _layout(payloads[int(rows[left[0]])], types, kind, wanted)
            except Unreadable:
                left = left[1:]
                continue
            alike = (block[left][:, where.same] == block[left[0], where.same]).all(axis=1)
            pieces.append((rows[left[alike]], _columns(block[left[alike]], where)))
            left = left[~alike]
    return _joined(pieces)


def _columns(block: np.ndarray, where: _Layout) -> dict[str, np.ndarray]:
    out = {}
    for name, (code, at) in where.numbers.items():
        out[name] = np.ascontiguousarray(block[:, at : at + int(code[2])]).view(code)[:, 0].astype(code[1:])
    for name, (at, length) in where.strings.items():
        texts = [row.tobytes().decode("utf-8", "replace") for row in block[:, at : at + length]]
        out[name] = np.array(texts, object)
    return out


def _joined(pieces):
    if not pieces:
        return {}, np.zeros(0, int)
    rows = np.concatenate([r for r, _ in pieces])
    order = np.argsort(rows)
    if len(pieces) == 1:
        return pieces[0][1], rows
    out = {}
    for name in dict.fromkeys(n for _, columns in pieces for n in columns):
        parts = [columns.get(name) for _, columns in pieces]
        text = any(p is not None and p.dtype == object for p in parts)
        filled = [
            np.full(len(r), "", object) if p is None and text else np.full(len(r), np.nan) if p is None else p
            for p, (r, _) in zip(parts, pieces)
        ]
        out[name] = np.concatenate(filled)[order]
    return out, rows[order]
