"""The way back: a flight may turn out to have ended some time ago, at an impact, or to have gone on after all.

Nothing in the samples before shows it, so that the diagnoser has written down by then what the ground did. What it had written two minutes
ago is kept, and the ticks since: these are gone through again, with the flight's end where it was.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.engine.diagnoser import Diagnoser, Judged
from rotorwatch.engine.host.events import Losses, Report
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.contact import Contact
from rotorwatch.engine.motion.ticks import grounded, landed

REPLAY_S = 120.0  # of ticks, at least, that can be gone through again


@dataclass
class Mark:
    """What was written down at some time, and the ticks since."""

    losses: Rows
    report: Rows
    contacts: tuple[Contact, ...]
    since: list[Judged] = field(default_factory=list)


class Account:
    """The way back of one diagnoser."""

    def __init__(self, diagnoser: Diagnoser):
        self._diagnoser = diagnoser
        self._falls: dict[float, float] = {}  # start of a flight -> when it fell to the ground
        self._time = -np.inf  # of the last commands
        self._older, self._newer = self._mark(), self._mark()

    def _mark(self) -> Mark:
        now = self._diagnoser
        return Mark(now.losses.state.copy(), now.report.state.copy(), now.contacts)

    def add(self, judged: Judged) -> None:
        """More ticks, which have been written down."""
        self._time = float(judged.table.command_time[-1])
        self._newer.since.append(judged)
        if self._time - self._newer.since[0].table.command_time[0] > REPLAY_S:
            self._older, self._newer = self._newer, self._mark()

    def keep(self, spans: Spans) -> None:
        """The flights are these, (start, end) s, infinite where it lasts. Where one now ends earlier than the diagnoser knows, or does so
        no longer, its ticks are gone through again."""
        known = dict(self._diagnoser.spans)
        falls, before = {start: end for start, end in spans if end < known[start]}, self._falls
        self._falls = falls
        if spans:
            self._diagnoser.fell(falls.get(spans[-1][0], np.inf))
        changed = [end for start, end in {*falls.items(), *before.items()} if falls.get(start) != before.get(start)]
        if min(changed, default=np.inf) >= self._time:
            return
        then = self._older
        whole = Judged.joined([*then.since, *self._newer.since])
        assert whole is not None
        B = self._diagnoser.vehicle.effectiveness()
        losses, report = Losses(B, then.losses.copy()), Report(B, then.report.copy(), then.contacts)
        announced = whole.out.announced & ~landed(whole.table, spans)
        losses.add(grounded(whole.table, spans), whole.out._replace(announced=announced))
        report.add(whole.table, spans).finish(spans)
        self._diagnoser.restore(losses.state, report.state)
        then.since, self._newer = [whole], self._mark()
