"""MAVLink frames from a telemetry log, decoded a message type at a time.

A telemetry log repeats: time of receipt (8 bytes, big endian, us since 1970), then one MAVLink 1 or 2 frame. pymavlink's reader takes
message after message, at about 2 MB/s.
Frame format and check sum: https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

from array import array
from bisect import bisect_left

import numpy as np

from rotorwatch.logs.mavlink_messages import Message, parts

_STAMP = 8
V1, V2 = 0xFE, 0xFD
SIGNED = 0x01
_WINDOW = 1 << 20  # bytes searched at once behind a damaged place


class Frames:
    """Positions of the frames of a telemetry log, by source and message type. skipped: bytes outside frames."""

    def __init__(self, data, wanted, progress=None):
        """data: bytes-like; wanted: message ids to keep. Frames are kept unchecked; `decode` checks their sums."""
        self._bytes = np.frombuffer(data, np.uint8)
        self.skipped = 0
        self.found: dict[tuple[int, int, int], tuple[array, array]] = {}
        self._scan(data, frozenset(wanted), progress)

    def _scan(self, data, wanted, progress):
        at, size, count = 0, len(data), 0
        places, seen = [], 0  # candidates for the continuation of the chain, up to `seen`
        found = self.found
        while at + _STAMP + 8 <= size:
            start = at + _STAMP
            magic, length = data[start], data[start + 1]
            source = component = message = -1
            if magic == V2 and start + 12 <= size:
                end = start + 12 + length + (13 if data[start + 2] & SIGNED else 0)
                source, component = data[start + 5], data[start + 6]
                message = data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
            elif magic == V1:
                end = start + 8 + length
                source, component, message = data[start + 3], data[start + 4], data[start + 5]
            else:
                end = size + 1
            # The next frame's magic byte follows this frame, or this one is damaged.
            if end > size or (end + _STAMP < size and data[end + _STAMP] not in (V1, V2)):
                later = size
                while (k := bisect_left(places, start + 1)) == len(places) and seen < size:
                    places, seen = self._places(max(start + 1, seen)), min(max(start + 1, seen) + _WINDOW, size)
                if k < len(places):
                    later = places[k]
                self.skipped += later - start
                at = later - _STAMP
                continue
            if message in wanted:
                key = source, component, message
                if key not in found:
                    found[key] = array("q"), array("q")
                found[key][0].append(start)
                found[key][1].append(count)
            count += 1
            at = end
            if progress and not count & 0xFFFF:
                progress(0.5 + 0.4 * at / size)
        self.count = count

    def _places(self, at: int) -> list[int]:
        """Positions from there on of possible frames that another one follows, or with too few bytes left to decide."""
        data, size = self._bytes, self._bytes.size
        window = data[at : at + _WINDOW]
        start = at + np.flatnonzero((window == V1) | (window == V2))
        sure = start[: np.searchsorted(start, size - 11)]
        second = data[sure] == V2
        end = sure + 8 + data[sure + 1].astype(np.int64)
        end += second * (4 + 13 * (data[sure + 2] & SIGNED).astype(np.int64))
        follows = end + _STAMP >= size
        inside = ~follows
        magic = data[end[inside] + _STAMP]
        follows[inside] = (magic == V1) | (magic == V2)
        return np.concatenate([sure[follows & (end <= size)], start[sure.size :]]).tolist()

    def decode(self, source: int, component: int, layout: Message) -> tuple[np.ndarray, np.ndarray]:
        """All valid messages of one type: (structured array, (n,) running number of the frame in the file). Frames with a wrong check sum
        are left out."""
        starts, order = (np.array(a, np.int64) for a in self.found.get((source, component, layout.id), ((), ())))
        kind = payload_type(layout)
        second = self._bytes[starts] == V2
        header = np.where(second, 10, 6)
        length = self._bytes[starts + 1].astype(np.int64)
        # MAVLink 2 cuts zeros off the end of a payload, and extends it with fields that MAVLink 1 does not have.
        payload = np.zeros((starts.size, max(kind.itemsize, 1)), np.uint8)
        sound = np.zeros(starts.size, bool)
        for head, n in {*zip(header.tolist(), length.tolist())}:
            same = np.flatnonzero((header == head) & (length == n))
            block = self._bytes[starts[same, None] + np.arange(head + n + 2)]
            sent_sum = block[:, -2].astype(np.int64) | block[:, -1].astype(np.int64) << 8
            sound[same] = sent_sum == checksum(block[:, 1:-2], layout.seed)
            payload[same, : min(n, kind.itemsize)] = block[:, head : head + min(n, kind.itemsize)]
        return payload[sound].view(kind)[:, 0], order[sound]

    def received(self, source: int, component: int, layout: Message) -> np.ndarray:
        """(n,) s since 1970 at which the ground station received each frame of one type, valid or not."""
        starts = np.array(self.found.get((source, component, layout.id), ((),))[0], np.int64)
        stamps = self._bytes[starts[:, None] - _STAMP + np.arange(_STAMP)]
        return stamps.copy().view(">u8")[:, 0].astype(float) * 1e-6


def payload_type(layout: Message) -> np.dtype:
    """NumPy type of a message's payload on the wire."""
    codes = {"b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8"}
    codes |= {"f": "<f4", "d": "<f8", "c": "S1"}
    fields = []
    for name, (code, n) in zip(layout.fields, parts(layout.form), strict=True):
        if code == "s":
            fields.append((name, f"S{n}"))
        else:
            fields.append((name, codes[code]) if n == 1 else (name, codes[code], (n,)))
    return np.dtype(fields)


def checksum(block: np.ndarray, extra: int) -> np.ndarray:
    """CRC-16/MCRF4XX of each row of (n, k) bytes followed by the byte `extra`; (n,) int."""
    crc = np.full(block.shape[0], 0xFFFF, np.int64)
    for column in (*block.T, np.full(block.shape[0], extra, np.uint8)):
        tmp = (column ^ crc) & 0xFF
        tmp ^= (tmp << 4) & 0xFF
        crc = (crc >> 8) ^ (tmp << 8) ^ (tmp << 3) ^ (tmp >> 4)
    return crc
