"""Encoding of numbers in Blackbox logs, as a definition (`compiling.structs`): each function decodes fields from bytes.

All take the bytes, the read position and the write position, and return the next read position. Numbers have 32 bits; unsigned ones from
2^31 on are negative here, which `header` corrects. Sources: blackbox_encoding.c of Betaflight for the encoder, docs/development/Blackbox of
Cleanflight for the rest.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Bytes, Ints, shift32, sum32

# As headers name them; 2 was never used. 10 was an Elias gamma code in a tool before Betaflight gave it to another.
SIGNED_VB, UNSIGNED_VB, UNUSED, NEG_14BIT, ELIAS_DELTA_U32, ELIAS_DELTA_S32 = 0, 1, 2, 3, 4, 5
TAG8_8SVB, TAG2_3S32, TAG8_4S16, NOTHING, TAG2_3SVARIABLE, ELIAS_GAMMA_S32 = 6, 7, 8, 9, 10, 11


def signed_vb(data: Bytes, at: int, out: Ints, first: int, last: int) -> int:
    """Bytes of seven bits, the lowest first, the sign in the lowest bit of all."""
    at = unsigned_vb(data, at, out, first, last)
    for i in range(first, last):
        out[i] = (out[i] >> 1 & 0x7FFFFFFF) ^ -(out[i] & 1)
    return at


def unsigned_vb(data: Bytes, at: int, out: Ints, first: int, last: int) -> int:
    """Bytes of seven bits, the lowest first."""
    for i in range(first, last):
        byte = data[at]
        at += 1
        value = byte & 127
        shift = 7
        while byte > 127 and shift < 35:
            byte = data[at]
            at += 1
            value |= shift32(byte & 127, shift)
            shift += 7
        out[i] = value
    return at


def neg_14bit(data: Bytes, at: int, out: Ints, first: int, last: int) -> int:
    """The same, of 14 bits, and with the other sign."""
    at = unsigned_vb(data, at, out, first, last)
    for i in range(first, last):
        out[i] = -_extended(out[i], 14)
    return at


def tag8_8svb(data: Bytes, at: int, out: Ints, first: int, last: int) -> int:
    """A byte that says which of up to eight numbers are not 0, and those; a single one goes without that byte."""
    if last - first == 1:
        return signed_vb(data, at, out, first, last)
    there = data[at]
    at += 1
    for i in range(first, last):
        out[i] = 0
        if there & 1:
            at = signed_vb(data, at, out, i, i + 1)
        there >>= 1
    return at


def tag2_3s32(data: Bytes, at: int, out: Ints, place: int) -> int:
    """Three numbers of 2, 4 or 6 bits each, or of 1 to 4 bytes."""
    lead = data[at]
    how = lead >> 6
    at += 1
    if how == 0:
        out[place] = _extended(lead >> 4, 2)
        out[place + 1] = _extended(lead >> 2, 2)
        out[place + 2] = _extended(lead, 2)
    elif how == 1:
        out[place] = _extended(lead, 4)
        out[place + 1] = _extended(data[at] >> 4, 4)
        out[place + 2] = _extended(data[at], 4)
        at += 1
    elif how == 2:
        out[place] = _extended(lead, 6)
        out[place + 1] = _extended(data[at], 6)
        out[place + 2] = _extended(data[at + 1], 6)
        at += 2
    else:
        at = _whole_bytes(data, at, out, place, lead)
    return at


def tag2_3svariable(data: Bytes, at: int, out: Ints, place: int) -> int:
    """Three numbers of 2 bits each, of 5, 5 and 4, of 8, 7 and 7, or of 1 to 4 bytes."""
    lead = data[at]
    how = lead >> 6
    if how == 0 or how == 3:
        return tag2_3s32(data, at, out, place)
    if how == 1:
        out[place] = _extended(lead >> 1, 5)
        out[place + 1] = _extended(lead << 4 | data[at + 1] >> 4, 5)
        out[place + 2] = _extended(data[at + 1], 4)
        return at + 2
    out[place] = _extended(lead << 2 | data[at + 1] >> 6, 8)
    out[place + 1] = _extended(data[at + 1] << 1 | data[at + 2] >> 7, 7)
    out[place + 2] = _extended(data[at + 2], 7)
    return at + 3


def tag8_4s16(data: Bytes, at: int, out: Ints, place: int) -> int:
    """Four numbers of 0, 4, 8 or 16 bits, half bytes one after the other, the higher half first."""
    sizes = data[at]
    at += 1
    half = False  # the lower half of the byte before is still to be read
    for k in range(4):
        size = sizes & 3
        sizes >>= 2
        value = 0
        if size == 1 and half:
            value = _extended(data[at - 1], 4)
            half = False
        elif size == 1:
            value = _extended(data[at] >> 4, 4)
            at += 1
            half = True
        elif size == 2:
            value = _extended(data[at - 1] << 4 | data[at] >> 4 if half else data[at], 8)
            at += 1
        elif size == 3:
            high = data[at - 1] << 12 | data[at] << 4 | data[at + 1] >> 4
            value = _extended(high if half else data[at] << 8 | data[at + 1], 16)
            at += 2
        out[place + k] = value
    return at


def tag8_4s16_v1(data: Bytes, at: int, out: Ints, place: int) -> int:
    """The same in logs of data version 1: two numbers of 4 bits share a byte, the lower half first; 16 bits the lower byte first."""
    sizes = data[at]
    at += 1
    k = 0
    while k < 4:
        size = sizes & 3
        value = 0
        if size == 1:
            value = _extended(data[at], 4)
            if k < 3:
                out[place + k] = value
                value = _extended(data[at] >> 4, 4)
                k += 1
                sizes >>= 2
            at += 1
        elif size == 2:
            value = _extended(data[at], 8)
            at += 1
        elif size == 3:
            value = _extended(data[at] | data[at + 1] << 8, 16)
            at += 2
        out[place + k] = value
        sizes >>= 2
        k += 1
    return at


def elias(data: Bytes, bit: int, out: Ints, place: int, encoding: int) -> int:
    """A number in an Elias code; `bit` counts from the first bit of data, the highest bit of a byte first, and so does the result."""
    length = 0
    while length < 32 and not _bits(data, bit, 1):
        length += 1
        bit += 1
    bit += 1
    if encoding != ELIAS_GAMMA_S32:  # the length is a gamma code itself
        if length > 5:
            length = 5
        size = length
        length = (1 << size | _bits(data, bit, size)) - 1
        bit += size
    if length > 31:
        length = 31
    value = shift32(1, length) | _bits(data, bit, length)
    bit += length
    if value == -1:  # an escape for two numbers, distinguished by one bit
        value = sum32(value, _bits(data, bit, 1))
        bit += 1
    value = sum32(value, -1)
    out[place] = value if encoding == ELIAS_DELTA_U32 else (value >> 1 & 0x7FFFFFFF) ^ -(value & 1)
    return bit


def _bits(data: Bytes, bit: int, count: int) -> int:
    value = 0
    for k in range(count):
        value = shift32(value, 1) | (data[(bit + k) >> 3] >> (7 - ((bit + k) & 7)) & 1)
    return value


def _whole_bytes(data: Bytes, at: int, out: Ints, place: int, sizes: int) -> int:
    """Three numbers of as many bytes as the two lowest bits say, and so on."""
    for k in range(3):
        size = sizes >> 2 * k & 3
        value = data[at]
        for j in range(1, size + 1):
            value |= shift32(data[at + j], 8 * j)
        out[place + k] = value if size == 3 else _extended(value, 8 * size + 8)
        at += size + 1
    return at


def _extended(value: int, bits: int) -> int:
    """The lowest bits of a number, the highest of them its sign."""
    half = 1 << bits - 1
    return ((value & (2 * half - 1)) ^ half) - half
