"""What the diagnoser has written down -> claims, as `diagnose` has them of a log that ends now."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.answer import slow, trim
from rotorwatch.answer.unseen import Unseen
from rotorwatch.engine.diagnoser import Diagnoser, Judged
from rotorwatch.engine.host import events
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.deviations import Override, in_flight
from rotorwatch.engine.motion.ticks import JUDGE, Plan, Ticks, grounded
from rotorwatch.flight.diagnosis import Event
from rotorwatch.live.account import Account
from rotorwatch.live.beginnings import Beginnings
from rotorwatch.live.stream import Piece


class Judge:
    """One vehicle, piece by piece. now: the last ticks, and the estimator's outputs of these rows; None before there are any. grown: what
    the trim of the flight shows of a loss, as it was looked at last."""

    def __init__(self, diagnoser: Diagnoser, account: Account):
        """account: its way back."""
        vehicle, plan = diagnoser.vehicle, diagnoser.plan
        self._diagnoser, self._account, self.B = diagnoser, account, vehicle.effectiveness()
        known = vehicle.identified  # healthy flights have told what happened in the blind time
        self._beginnings = None if known else Beginnings(self.B, plan.ready_s)
        self._spans: Spans = ()
        self._over = False
        self._time = -np.inf
        self._overrides: tuple[Override, ...] = ()
        self.now: tuple[Ticks, Any] | None = None
        self.unseen = Unseen(self.B, plan.dt)
        self.grown: trim.Growth | None = None
        self._added = 0  # 1 where that changes the losses that were told
        self._looks, self._turned = 0, tuple[Event, ...]()
        self.ticks = 0  # that were judged

    def judge(self, piece: Piece, final: bool = False) -> None:
        """Go on with what has become certain. final: nothing will come after."""
        self._account.keep(piece.spans)
        if self._beginnings is not None and (end := _earlier(self._spans, piece.spans)) is not None:
            self._beginnings.cut(end)
        self._spans, self._over, self._overrides = piece.spans, final, piece.overrides
        if piece.judged is not None:
            self._look(piece.judged)
        if (looks := int(self._diagnoser.trim["looks"][0])) != self._looks:
            self._looks = looks
            self._look_at_trim()
        early = self._beginnings
        if early is not None and (final or early.due(self._spans, self._time)):
            early.search(self._diagnoser.learned, self._spans, self._time, final)

    @property
    def plan(self) -> Plan:
        """How the samples are cut into ticks."""
        return self._diagnoser.plan

    @property
    def revision(self) -> int:
        """Grows, or shrinks, when there may be other events."""
        early = 0 if self._beginnings is None else len(self._beginnings.found)
        told = self._diagnoser.losses.announcements + len(self._overrides) + len(self._diagnoser.contacts)
        return told + early + len(self._turned) + self._added

    @property
    def contact_s(self) -> float:
        """Time of the last knock, s; minus infinity without one."""
        return max([-np.inf, *(c.time for c in self._diagnoser.contacts[-1:])])

    @property
    def report(self) -> events.Report:
        """Its falls and contacts."""
        return self._diagnoser.report

    def claims(self) -> tuple[Event, ...]:
        """All that is claimed, as it looks now."""
        losses = self._diagnoser.losses.events(flies=not self._over)
        early = () if self._beginnings is None else self._beginnings.found
        return (*losses, *early, *self._turned, *map(events.overridden, in_flight(self._overrides, self._spans)))

    def _look(self, judged: Judged) -> None:
        table, out = grounded(judged.table, self._spans), judged.out
        if self._beginnings is not None:
            self._beginnings.add(table, self._spans)
        self._time, self.now = float(table.time[-1]), (table, out)
        self.unseen.add(out, table)
        self.ticks += int(np.count_nonzero(table.mode == JUDGE))

    def _look_at_trim(self) -> None:
        """What has changed slowly."""
        self.grown, self._turned = trim.growth(self._diagnoser.trim), trim.mounts(self._diagnoser.trim)
        losses = self._diagnoser.losses.events(flies=not self._over)
        self._added = int(slow.join(losses, self.grown) != losses)


def _earlier(old: Spans, new: Spans) -> float | None:
    """End of the last flight, if it has ended earlier than was known."""
    before = dict(old[-1:])
    return next((end for start, end in new[-2:] if end < before.get(start, -np.inf)), None)
