"""Bytes of a link -> valid MAVLink frames, and messages -> frames: https://mavlink.io/en/guide/serialization.html

pymavlink's parser makes an object of every message, at a cost above that of all further processing; here a frame stays bytes.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from bisect import bisect_left
from functools import cache
from typing import NamedTuple

import numpy as np

from rotorwatch.logs import mavlink_messages
from rotorwatch.logs.mavlink_frames import SIGNED, V1, V2

MOST = 280  # bytes of the longest frame
# Budget of wasted check sum bytes per received byte, its limit, and the extra cost of an attempt. Damage costs about 1.
VAIN, SAVED, ATTEMPT = 4, 16 * MOST, 64

# MAVLink's check sum, CRC-16/MCRF4XX, processes bits from the low end; the standard library's from the high end.
_TURNED = bytes(int(f"{k:08b}"[::-1], 2) for k in range(256))


def sums(frame: bytes, extra: int) -> bytes:
    """The two bytes of check sum of a frame. frame: without them, magic byte included; extra: its message's seed."""
    crc = crc_hqx(frame[1:].translate(_TURNED) + _TURNED[extra : extra + 1], 0xFFFF)
    return bytes((_TURNED[crc >> 8], _TURNED[crc & 0xFF]))


@cache
def seeds() -> dict[int, int]:
    """Message id -> seed of its check sum, of all known messages."""
    return {number: message.seed for number, message in mavlink_messages.by_id().items()}


@cache
def _known_messages() -> tuple[np.ndarray, np.ndarray]:
    """(longest payload of each message id of MAVLink 1, -1: unknown; whether each id of MAVLink 2 is known, the last: all larger ones)."""
    messages = mavlink_messages.by_id()
    longest, known = np.full(256, -1), np.zeros(max(messages) + 2, bool)
    for number, message in messages.items():
        known[number] = True
        if number < longest.size:
            longest[number] = struct.calcsize(message.form)
    return longest, known


class Frames:
    """The frames in the bytes of one peer, in any chunks. damaged: stretches without a valid frame; unknown: whole frames of unknown
    messages, whose check sums cannot be verified.

    Work is linear in the bytes, whatever they are: places where no frame can begin are skipped at once, and after repeated wrong check sums
    as many bytes are skipped as an attempt costs, instead of one."""

    def __init__(self):
        self._left = b""
        self._seeds = seeds()
        self._skipping = False
        self._may = SAVED
        self.damaged = self.unknown = 0

    def take(self, data: bytes) -> list[bytes]:
        """The valid frames that these bytes complete."""
        self._may = min(self._may + VAIN * len(data), max(SAVED, VAIN * len(data)))
        data, self._skipping = self._left + data if self._left else data, False
        complete, at, size, places = [], 0, len(data), None
        while at < size:
            length, sound = self._frame(data, at, size)
            if sound:
                complete.append(data[at : at + length])
                self._skipping = False
                at += length
            elif not length and size - at < MOST:
                break  # the rest is still to come
            else:
                # Skip only this byte: a valid frame may begin within an apparent long one.
                self.damaged += not self._skipping
                self._skipping = True
                if places is None:
                    places = _places(data)
                k = bisect_left(places, at + max(1, -length))
                at = places[k] if k < len(places) else size
        self._left = data[at:] if at < size else b""
        return complete

    def _frame(self, data: bytes, at: int, size: int) -> tuple[int, bool]:
        """(length, whether it is valid) of the frame that begins here: 0 where bytes are missing, -k to skip k bytes."""
        magic = data[at]
        if magic == V2:
            if at + 12 > size:
                return 0, False
            flags = data[at + 2]
            if flags & ~SIGNED:
                return -1, False
            identity = int.from_bytes(data[at + 7 : at + 10], "little")
            end = at + 10 + data[at + 1]
            whole = end + 15 if flags else end + 2
        elif magic == V1:
            if at + 8 > size:
                return 0, False
            identity, end = data[at + 5], at + 6 + data[at + 1]
            whole = end + 2
        else:
            return -1, False
        if whole > size:
            return 0, False
        seed = self._seeds.get(identity)
        if seed is None:
            if not self._skipping and (whole == size or data[whole] in (V1, V2)):
                self.unknown += 1
                self._skipping = True  # not damaged, but searched all the same: it may be a coincidence
            return -1, False
        if sums(data[at:end], seed) != data[end : end + 2]:
            cost = whole - at + ATTEMPT
            self._may -= cost
            return -1 if self._may > 0 else -cost, False
        return whole - at, True


def _places(data: bytes) -> list[int]:
    """Possible beginnings of frames of known messages, and places with too few bytes to decide."""
    at = np.frombuffer(data, np.uint8)
    longest, known = _known_messages()
    sure = max(at.size - 11, 0)  # beyond, a header may be truncated
    first = np.flatnonzero(at[:sure] == V1)
    first = first[at[first + 1] <= longest[at[first + 5]]]
    second = np.flatnonzero((at[:sure] == V2) & (at[2 : sure + 2] <= SIGNED))
    number = at[second + 7] | at[second + 8].astype(np.int64) << 8 | at[second + 9].astype(np.int64) << 16
    second = second[known[np.minimum(number, known.size - 1)]]
    rest = sure + np.flatnonzero((at[sure:] == V1) | (at[sure:] == V2))
    return np.sort(np.concatenate([first, second, rest])).tolist()


class Outgoing(NamedTuple):
    """A message to be sent: its name, and its payload."""

    name: str
    payload: bytes

    @property
    def number(self) -> int:
        """Its message id."""
        return mavlink_messages.by_name()[self.name].id


def outgoing(name: str, /, **values) -> Outgoing:
    """A message with these values; omitted fields are 0."""
    return Outgoing(name, mavlink_messages.by_name()[name].payload(**values))


class Sender:
    """Makes frames of messages, with running numbers of its own."""

    def __init__(self, system: int, component: int):
        self._who, self._sequence = (system, component), 0

    def frame(self, message: Outgoing, first_version: bool = False) -> bytes:
        """The next frame, of MAVLink 2 or 1."""
        about, payload = mavlink_messages.by_name()[message.name], message.payload
        if first_version:
            head = bytes((V1, len(payload), self._sequence, *self._who, about.id))
        else:
            payload = payload.rstrip(b"\0") or b"\0"
            head = bytes((V2, len(payload), 0, 0, self._sequence, *self._who)) + about.id.to_bytes(3, "little")
        self._sequence = (self._sequence + 1) % 256
        return head + payload + sums(head + payload, about.seed)
