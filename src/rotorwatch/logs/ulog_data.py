"""The data messages of an intact ULog, read as tables at once; the small rest is left to pyulog.

pyulog reads message by message, and nearly all of a log are data messages. Here each topic's are found by their places, and viewed as one
structured array. A log that is not intact from its first message to the last complete one - damaged, with unknown messages, topics that are
announced again, or data behind the end - is left to pyulog, which recovers from damage.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.arrays import unique
from rotorwatch.base.compiling.running import Definition
from rotorwatch.logs import ulog_messages

ULOG = Definition("ulog", (ulog_messages,), (), ["logs/ulog_messages.py"])
HEADER = 16  # bytes before the first message
ROOM = 1 << 20  # messages in one call
ROWS = 4096  # messages copied at once
DEFINES, DATA, ADDED = frozenset(b"BFIMPQ"), ord("D"), ord("A")
KNOWN = DEFINES | frozenset(b"ADLCSOR")
BEGINS = frozenset(b"ALC")  # the end of the definitions
ONLY_BEFORE = frozenset(b"BF")  # only among the definitions


class Messages(NamedTuple):
    """All messages, in their order: kinds, sizes, places (M,); ids (M,): of the topics of data messages, else -1; rest: the log without
    data messages but the first of each topic; cut: it ends in the middle of a message; formats: name of a message -> (type, count, name) of
    each field, as the log defines them."""

    data: np.ndarray
    kinds: np.ndarray
    sizes: np.ndarray
    places: np.ndarray
    ids: np.ndarray
    rest: bytes
    cut: bool
    formats: dict[str, list[tuple[str, int, str]]]

    def fill(self, log: Any) -> bool:
        """Give `log`, which pyulog made of `rest`, all data; False where a message's size differs from its topic's."""
        seen, latest = {d.msg_id for d in log.data_list}, np.zeros(len(self.kinds), np.uint64)
        for d in log.data_list:
            kind = np.dtype([(f.field_name, d.data[f.field_name].dtype) for f in d.field_data])
            mine = np.flatnonzero(self.ids == d.msg_id)
            if (self.sizes[mine] != kind.itemsize + 2).any():
                return False
            rows = self._rows(self.places[mine] + 2, kind.itemsize).view(kind)[:, 0]
            d.data = {name: rows[name] for name in kind.names or ()}
            latest[mine] = rows["timestamp"] if "timestamp" in d.data else 0
        if set(unique(self.ids[self.ids >= 0]).tolist()) - seen:
            return False
        # Messages without a time have that of the latest one before.
        latest = np.maximum(np.maximum.accumulate(latest), np.uint64(log.start_timestamp))
        begins = int(np.flatnonzero(np.isin(self.kinds, [*BEGINS]))[0])
        place = np.arange(len(self.kinds)) > begins
        changed = latest[(self.kinds == ord("P")) & place]
        log.changed_parameters[:] = [(int(t), *p[1:]) for t, p in zip(changed, log.changed_parameters, strict=True)]
        for t, dropout in zip(latest[self.kinds == ord("O")], log.dropouts, strict=True):
            dropout.timestamp = int(t)
        return True

    def _rows(self, places: np.ndarray, size: int) -> np.ndarray:
        """(k, size) bytes from each place on."""
        out, columns = np.empty((len(places), size), np.uint8), np.arange(size)
        for first in range(0, len(places), ROWS):
            np.take(self.data, places[first : first + ROWS, None] + columns, out=out[first : first + ROWS])
        return out


def messages(data: Any, wanted: Collection[str], beside: Mapping[str, Collection[str]] = MappingProxyType({})) -> Messages | None:
    """The messages of a log, with data messages of the topics `wanted` alone; None where pyulog has to read all of it. beside: topic ->
    those that are wanted as well where the log has it."""
    if ULOG.library is None or len(data) >= 1 << 31:
        return None
    raw = np.frombuffer(data, np.uint8)
    kinds, sizes, places, end = _walked(raw)
    here = set(unique(kinds).tolist())
    if not here <= KNOWN or not here & BEGINS:
        return None
    begins = int(np.flatnonzero(np.isin(kinds, [*BEGINS]))[0])
    if np.isin(kinds[:begins], [*(KNOWN - DEFINES)]).any() or np.isin(kinds[begins:], [*ONLY_BEFORE]).any():
        return None
    try:
        formats = dict(_format(raw[places[k] : places[k] + sizes[k]].tobytes()) for k in np.flatnonzero(kinds == ord("F")))
    except ValueError:
        return None
    flags = np.flatnonzero(kinds == ord("B"))
    if any(bytes(raw[places[k] + 16 : places[k] + 40]).strip(b"\0") for k in flags):  # data behind the end
        return None
    is_data, added = kinds == DATA, np.flatnonzero(kinds == ADDED)
    if (sizes[is_data] < 2).any() or (sizes[added] < 3).any():
        return None
    ids = np.where(is_data, _number(raw, places, is_data), -1)
    topics = {int(raw[places[k] + 1]) + 256 * int(raw[places[k] + 2]): k for k in added}
    if len(topics) < len(added):
        return None
    numbers, first = np.unique(ids, return_index=True)
    if any(i >= 0 and (i not in topics or topics[i] > k) for i, k in zip(numbers.tolist(), first.tolist())):
        return None
    names = {i: bytes(raw[places[k] + 3 : places[k] + sizes[k]]).decode("latin-1") for i, k in topics.items()}
    wanted = {*wanted, *(name for topic, more in beside.items() if topic in names.values() for name in more)}
    ids[~np.isin(ids, [i for i, name in names.items() if name in wanted])] = -1
    kept = ~is_data
    kept[[k for i, k in zip(numbers.tolist(), first.tolist()) if i >= 0]] = True
    parts = [raw[p - 3 : p + s].tobytes() for p, s in zip(places[kept].tolist(), sizes[kept].tolist())]
    return Messages(raw, kinds, sizes, places, ids, raw[:HEADER].tobytes() + b"".join(parts), end < len(raw), formats)


def _format(text: bytes) -> tuple[str, list[tuple[str, int, str]]]:
    """(name, fields) of a definition. Raises ValueError for an invalid one."""
    name, rest = text.decode("latin-1").split(":")
    fields = []
    for field in filter(None, rest.split(";")):
        kind, label = field.split(" ")
        kind, _, count = kind.partition("[")
        fields.append((kind, int(count[:-1]) if count else 0, label))
    return name, fields


def _walked(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """(kinds, sizes, places, end of the last whole message)."""
    state, parts = ULOG.new(ulog_messages.Walk), []
    state.set(at=HEADER)
    room = [np.empty(ROOM, np.int32) for _ in range(3)]
    while True:
        ULOG.call(ulog_messages.walk, state, raw, len(raw), *room, ROOM)
        count = int(state["count"][0])
        parts.append([column[:count].copy() for column in room])
        if count < ROOM:
            break
    kinds, sizes, places = map(np.concatenate, zip(*parts, strict=True))
    return kinds, sizes, places.astype(np.int64), int(state["at"][0])


def _number(raw: np.ndarray, places: np.ndarray, here: np.ndarray) -> np.ndarray:
    """The 16-bit numbers at places, where `here`; 0 elsewhere."""
    at = np.where(here, places, 0)
    return np.where(here, raw[at] + 256 * raw[at + 1].astype(np.int64), 0)
