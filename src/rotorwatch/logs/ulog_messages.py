"""Where the messages of a ULog lie, one after the other: a definition (docs/one-definition.md), for there are millions of them."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Bytes, Ints, Struct


class Walk(Struct):
    """How far a walk has come: at: the next message; count: messages that the last call has found."""

    at: int = 0
    count: int = 0


def walk(w: Walk, data: Bytes, end: int, kinds: Ints, sizes: Ints, places: Ints, room: int) -> None:
    """The whole messages from w.at on, before `end`, as many as there is room for: kind, bytes, and place of the first of these."""
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
