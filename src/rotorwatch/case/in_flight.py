"""Events reconsidered while the vehicle flies: a loss must explain the motion that follows it, and no flight ends in a loss by its landing.

The witnesses that revise and compare claims (`witnesses.witness.Stage`) are asked of a link whenever there is more to go by: LOOKS_S of
motion after a loss or its end, another loss, or the end of a flight. In between, their last result holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.witness import Events, Stage, View

LOOKS_S = 6.0, 20.0  # of motion after an onset or an end; sooner, true losses are withdrawn as often as others

Key = tuple[str, tuple[int, ...], float]


class InFlight:
    """What the witnesses have made of the events so far."""

    def __init__(self):
        self._known: tuple = (0,)  # when they were asked last: number of flights that have ended, and each loss with its looks
        self._ruled: dict[Key, Event | None] = {}
        self._open: Events = ()

    def reconsidered(self, found: Events, now: float, air: Spans, view: Callable[[], View]) -> tuple[Events, Events]:
        """The events at `now` s as they stand, and the open claims that losses among them have become. air: flights ((start, end), ...) s,
        end infinite while airborne."""
        looks = [(_key(e), e.end_s is None, _looks(now, e.onset_s), _looks(now, e.end_s)) for e in found if e.kind == LOSS]
        known = (sum(bool(np.isfinite(end)) for _, end in air), *(look for look in looks if look[2]))
        if known != self._known:
            seen = view()
            after = witness.ask(Stage.COMPARISON, seen, witness.ask(Stage.REVISION, seen, found))
            same = {_key(e): e for e in after}
            renamed = {e[1:]: same[e] for e in same.keys() - {_key(e) for e in found}}  # another kind, of the same rotors and onset
            self._known, self._ruled = known, {key: same.get(key, renamed.get(key[1:])) for key in map(_key, found)}
            self._open = seen.open
        return tuple(event for e in found if (event := self._as_ruled(e)) is not None), self._open

    def _as_ruled(self, event: Event) -> Event | None:
        """The event as the witnesses left it, with its newest size; None where they withdrew it."""
        ruled = self._ruled.get(_key(event), event)
        if ruled is None or ruled.kind != event.kind:
            return ruled
        if ruled.kind != LOSS:
            return event
        return replace(event, alternatives=ruled.alternatives, probability=min(event.probability, ruled.probability), end_s=ruled.end_s)


def _looks(now: float, since: float | None) -> int:
    """Number of looks that are due `since` s at `now` s."""
    return 0 if since is None else sum(now - since >= s for s in LOOKS_S)


def _key(event: Event) -> Key:
    return event.kind, event.rotors, event.onset_s
