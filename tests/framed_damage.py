"""Damage inside a log's valid framing: every record is still a record, but what it says, when or how often is wrong.

Such damage passes every check of a file's structure (a bit of memory that tips over, a card that repeats a block, a
logger that drops and reorders), so only the values themselves can give it away. Definitions are left alone: without
them there is no framing. For DataFlash (.bin), ULog (.ulg) and MAVLink telemetry (.tlog, check sums made right again).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rotorwatch.logs import dataflash, mavlink_frames, mavlink_messages, tlog, ulog
from rotorwatch.logs.dataflash_binary import BinaryLog

SWAP_WITHIN = 10  # records: how far a swapped record moves, as buffers that are written out of order move it
_ULOG_HEADER = 16


@dataclass(frozen=True)
class Records:
    """Where the n records of a log are that may be damaged; whatever lies between them stays as it is.

    start, end: (n,) bytes. body, body_end: (n,) where the values begin and end. stamp, stamp_size: (n,) first byte and
    number of bytes of the record's own time stamp (little-endian), size 0 where it has none. seal: makes the check sums
    of changed records right again, called with the bytes (in place) and the indices of the records; None without any.
    """

    start: np.ndarray
    end: np.ndarray
    body: np.ndarray
    body_end: np.ndarray
    stamp: np.ndarray
    stamp_size: np.ndarray
    seal: Callable[[np.ndarray, np.ndarray], None] | None = None


def records(data: bytes, name: str) -> Records:
    """The records of a log. Raises ValueError for a format whose framing is not known here."""
    head = data[:4096]
    if ulog.sniff(head, name):
        return _ulog(data)
    if dataflash.sniff(head, name) and dataflash.FMT_HEADER in head:
        return _dataflash(data)
    if tlog.sniff(head, "") or tlog.sniff(head, name):
        return _tlog(data)
    raise ValueError(f"{name}: damage inside the framing is made for .bin, .ulg and .tlog logs only.")


def damaged(data: bytes, found: Records, kind: str, share: float, rng: np.random.Generator) -> bytes:
    """The log with one `kind` of damage (see KINDS) to `share` of its records, at random."""
    n = found.start.size
    hit = np.sort(rng.choice(n, min(n, max(1, round(share * n))), replace=False))
    out = np.frombuffer(data, np.uint8).copy()
    # Which record stands at each place, and how often.
    order, times = np.arange(n), np.ones(n, int)
    KINDS[kind](out, found, hit, order, times, rng)
    if found.seal is not None:
        found.seal(out, hit)
    whole, pieces, at = out.tobytes(), [], 0
    start, end = found.start.tolist(), found.end.tolist()
    for place, (record, count) in enumerate(zip(order.tolist(), times.tolist())):
        pieces += [whole[at : start[place]], whole[start[record] : end[record]] * count]
        at = end[place]
    return b"".join([*pieces, whole[at:]])


def _flip(out, found, hit, order, times, rng):
    room = np.maximum(found.body_end[hit] - found.body[hit], 1)
    out[found.body[hit] + rng.integers(0, room)] ^= (1 << rng.integers(0, 8, hit.size)).astype(np.uint8)


def _wrong_time(out, found, hit, order, times, rng):
    hit = hit[found.stamp_size[hit] > 0]
    at = found.stamp[hit] + rng.integers(0, np.maximum(found.stamp_size[hit], 1))
    out[at] ^= (1 << rng.integers(0, 8, hit.size)).astype(np.uint8)


def _drop(out, found, hit, order, times, rng):
    times[hit] = 0


def _double(out, found, hit, order, times, rng):
    times[hit] = 2


def _swap(out, found, hit, order, times, rng):
    other = np.minimum(hit + rng.integers(1, SWAP_WITHIN + 1, hit.size), order.size - 1)
    for a, b in zip(hit.tolist(), other.tolist()):
        order[a], order[b] = order[b], order[a]


KINDS: dict[str, Callable[..., None]] = {
    "bit flips": _flip,
    "dropped": _drop,
    "doubled": _double,
    "swapped": _swap,
    "wrong times": _wrong_time,
}


def _dataflash(data: bytes) -> Records:
    log = BinaryLog(data)
    start, end, timed, definition = log.spans()
    start, end, timed = start[~definition], end[~definition], timed[~definition]
    return Records(start, end, start + 3, end, start + 3, timed)


def _ulog(data: bytes) -> Records:
    """Data (D) and parameter (P) messages; a data message's stamp follows its two bytes of topic number."""
    at, rows = _ULOG_HEADER, []
    while at + 3 <= len(data):
        end = at + 3 + int.from_bytes(data[at : at + 2], "little")
        kind = data[at + 2]
        if end > len(data):
            break
        if kind == ord("D") and end >= at + 13:
            rows.append((at, end, at + 5, end, at + 5, 8))
        elif kind == ord("P"):
            rows.append((at, end, at + 3, end, at + 3, 0))
        at = end
    begin, end, first, last, stamp, size = np.array(rows, np.int64).reshape(-1, 6).T
    return Records(begin, end, first, last, stamp, size)


def _tlog(data: bytes) -> Records:
    """Messages of all kinds that the dialect knows, with the autopilot's own stamp where they begin with one."""
    layouts = mavlink_messages.by_id()
    frames = mavlink_frames.Frames(data, layouts)
    rows, extras = [], []
    for (_, _, message), (starts, _) in frames.found.items():
        kind = mavlink_frames.payload_type(layouts[message])
        field = next((f for f in ("time_boot_ms", "time_usec") if f in (kind.names or ())), None)
        offset, size = (kind.fields[field][1], kind[field].itemsize) if field else (0, 0)  # type: ignore[index]
        for start in starts:
            head = 10 if data[start] == 0xFD else 6
            body_end = start + head + data[start + 1]
            signed = 13 if data[start] == 0xFD and data[start + 2] & 1 else 0
            known = size if offset + size <= data[start + 1] else 0  # MAVLink 2 cuts zeros off the end
            rows.append((start - 8, body_end + 2 + signed, start + head, body_end, start + head + offset, known))
            extras.append(layouts[message].seed)
    order = np.argsort([r[0] for r in rows], kind="stable")
    table, extra = np.array(rows, np.int64).reshape(-1, 6)[order], np.array(extras)[order]

    def seal(out, changed):
        for k in changed.tolist():
            first, last = table[k, 0] + 9, table[k, 3]
            crc = int(mavlink_frames.checksum(out[None, first:last], int(extra[k]))[0])
            out[last], out[last + 1] = crc & 0xFF, crc >> 8

    return Records(*table.T, seal=seal)
