"""Positions of the messages of a ULog: a definition (docs/one-definition.md), as there are millions of them."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Bytes, Ints, Struct


class Walk(Struct):
    """Progress of a walk. at: position of the next message; count: messages found by the last call."""

    at: int = 0
    count: int = 0


def walk(w: Walk, data: Bytes, end: int, kinds: Ints, sizes: Ints, places: Ints, room: int) -> None:
    """The complete messages from w.at on, before `end`, up to `room` of them: kind, size in bytes, and position of each."""
    w.count = 0
    while w.count < room and w.at + 3 <= end:
        size = data[w.at] + 256 * data[w.at + 1]
        if size > end - w.at - 3:
            return
        kinds[w.count] = data[w.at + 2]
        sizes[w.count] = size
        places[w.count] = w.at + 3
        w.at += 3 + size
        w.count += 1
