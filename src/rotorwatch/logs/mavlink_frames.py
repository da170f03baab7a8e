"""MAVLink frames from a telemetry log, decoded a message type at a time.

A telemetry log repeats: time of receipt (8 bytes, big endian, us since 1970), then one MAVLink 1 or 2 frame. pymavlink's reader takes
message after message, at about 2 MB/s.
Frame format and check sum: https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

from array import array

import numpy as np

from rotorwatch.logs.mavlink_messages import Message, parts

_STAMP = 8
_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01


class Frames:
    """Where each frame of a telemetry log is, by source and message type. skipped: bytes that belong to no frame."""

    def __init__(self, data, wanted, progress=None):
        """data: bytes-like; wanted: message ids to keep. Frames are kept unchecked; `decode` checks their sums."""
        self._bytes = np.frombuffer(data, np.uint8)
        self.skipped = 0
        self.found: dict[tuple[int, int, int], tuple[array, array]] = {}
        self._scan(data, frozenset(wanted), progress)

    def _scan(self, data, wanted, progress):
        at, size, count = 0, len(data), 0
        found = self.found
        while at + _STAMP + 8 <= size:
            start = at + _STAMP
            magic, length = data[start], data[start + 1]
            source = component = message = -1
            if magic == _V2 and start + 12 <= size:
                end = start + 12 + length + (13 if data[start + 2] & _SIGNED else 0)
                source, component = data[start + 5], data[start + 6]
                message = data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
            elif magic == _V1:
                end = start + 8 + length
                source, component, message = data[start + 3], data[start + 4], data[start + 5]
            else:
                end = size + 1
            # The next frame's magic is where this one says, or this one is damaged.
            if end > size or (end + _STAMP < size and data[end + _STAMP] not in (_V1, _V2)):
                later = _next_magic(data, start + 1)
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

    def decode(self, source: int, component: int, layout: Message) -> tuple[np.ndarray, np.ndarray]:
        """All sound messages of one type: (structured array, (n,) running number of the frame in the file).

        Frames whose check sum is wrong are left out.
        """
        starts, order = (np.array(a, np.int64) for a in self.found.get((source, component, layout.id), ((), ())))
        kind = payload_type(layout)
        second = self._bytes[starts] == _V2
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
        """(n,) s since 1970 at which the ground station received each frame of one type, sound or not."""
        starts = np.array(self.found.get((source, component, layout.id), ((),))[0], np.int64)
        stamps = self._bytes[starts[:, None] - _STAMP + np.arange(_STAMP)]
        return stamps.copy().view(">u8")[:, 0].astype(float) * 1e-6


def _next_magic(data, at: int) -> int:
    """Position of the next byte that may start a frame, or the end of the data."""
    places = [p for p in (data.find(bytes([_V1]), at), data.find(bytes([_V2]), at)) if p >= 0]
    return min(places, default=len(data))


def payload_type(layout: Message) -> np.dtype:
    """numpy type of a message's payload as it is on the wire."""
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
