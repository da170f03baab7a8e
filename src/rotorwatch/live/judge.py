"""Ticks as they come -> estimator -> events, as `diagnose` has them of a log that ends now."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rotorwatch.answer.unseen import Unseen
from rotorwatch.default import events, hypotheses, program
from rotorwatch.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.beginnings import Beginnings
from rotorwatch.live.history import History
from rotorwatch.live.stream import Piece
from rotorwatch.motion import outside
from rotorwatch.motion.airborne import CONFIRM_S
from rotorwatch.motion.allocation import Spans
from rotorwatch.motion.contact import Contact
from rotorwatch.motion.departures import Override
from rotorwatch.motion.ticks import GROUND, JUDGE, Plan, Ticks

SETTLED_S = CONFIRM_S + 3.0  # after its last tick what a flight was is certain


class Judge:
    """One vehicle, tick by tick. now: the last ticks, and the estimator's outputs of these rows; None before there are any."""

    def __init__(self, vehicle: Vehicle, plan: Plan, dynamics=None):
        self.vehicle, self.plan = vehicle, plan
        self.B = vehicle.effectiveness()
        self.hyp = hypotheses.make(len(vehicle.rotors))
        self._steps = program.steps(plan.dt, self.B, dynamics)
        self._history = History(plan.dt)
        known = vehicle.identified  # healthy flights have told what happened in the blind time
        self._beginnings = None if known else Beginnings(self.hyp, self.B, plan.ready_s)
        self._spans: Spans = ()
        self._over = False
        self._time = -np.inf
        self._contacts: tuple[Contact, ...] = ()
        self._overrides: tuple[Override, ...] = ()
        self._done: tuple[Event, ...] = ()
        self._fallen: dict[float, tuple[tuple[float, float], ...]] = {}
        self.now: tuple[Ticks, Any] | None = None
        self.unseen = Unseen(self.B, plan.dt)
        self.ticks = 0  # that were judged

    def on(self, piece: Piece, final: bool = False) -> None:
        """Go on with what has become certain. final: nothing will come after."""
        if cut := _earlier(self._spans, piece.spans):
            self._cut(*cut)
        self._spans, self._over, self._overrides = piece.spans, final, piece.overrides
        if piece.table is not None:
            self._judge(_grounded(piece.table, piece.spans))
        early = self._beginnings
        if early is not None and (final or early.due(self._spans, self._time)):
            early.look(self._steps.carry, self._spans, self._time, final)
        self._done += self._history.settle(self._time - SETTLED_S, self.hyp, self.B)

    @property
    def said(self) -> int:
        """Grows, or shrinks, when there may be other events."""
        early = 0 if self._beginnings is None else len(self._beginnings.found)
        return self._history.said + len(self._overrides) + len(self._contacts) + len(self._done) + early

    @property
    def contact_s(self) -> float:
        """Time of the last knock, s; minus infinity without one."""
        return self._contacts[-1].time if self._contacts else -np.inf

    def events(self) -> tuple[Event, ...]:
        """All that has happened, as it looks now."""
        air = tuple((start, min(end, self._time)) for start, end in self._spans)
        losses: tuple[Event, ...] = (*self._done, *self._history.events(self.hyp, self.B, flies=not self._over))
        if self._beginnings is not None:
            losses = self._beginnings.join(losses)
        losses = tuple(events.one_arm(e, self.B) for e in losses if events.accuses(e))
        overrides = outside.as_events(_in_flight(self._overrides, self._spans), self._falls(air))
        flown = [c for c in self._contacts if any(start <= c.time <= end + self.plan.dt for start, end in air)]
        contacts = outside.contacts_in(flown, air)
        found = (*outside.unexplained(losses, overrides), *overrides, *contacts)
        return tuple(sorted(found, key=lambda e: e.detected_s))

    def _falls(self, air: Spans):
        """Of each flight that ends in a fall, the fall; of those whose ticks are gone as it was."""
        time, upset = self._history.column("time"), self._history.column("upset")
        for start, end in air:
            if len(time) and end >= time[0]:
                self._fallen[start] = outside.falls_in(time, upset, self.plan.dt, ((start, end),))
        return tuple(fall for falls in self._fallen.values() for fall in falls)

    def _judge(self, table: Ticks) -> None:
        out = self._steps.run(*program.inputs(table, self.B))
        self._history.add(table, out)
        if self._beginnings is not None:
            self._beginnings.add(table, self._spans)
        self._time, self._contacts = float(table.time[-1]), table.contacts
        self.now = table, out
        self.unseen.add(np.asarray(out.biases), table)
        self.ticks += int(np.count_nonzero(table.mode == JUDGE))

    def _cut(self, start: float, end: float) -> None:
        """The flight that began at `start` fell to the ground at `end` s: what was judged of it after that was no flight."""
        self._history.ground(start, end)
        if self._beginnings is not None:
            self._beginnings.cut(end)


def _earlier(old: Spans, new: Spans) -> tuple[float, float] | None:
    """The last flight, if it has ended earlier than was known."""
    before = dict(old[-1:])
    return next(((start, end) for start, end in new[-2:] if end < before.get(start, -np.inf)), None)


def _grounded(table: Ticks, spans: Spans) -> Ticks:
    """The ticks, with those after the end of their flight on the ground: where it was cut by an impact."""
    after = np.zeros(len(table.time), bool)
    for k, (start, end) in enumerate(spans):
        following = spans[k + 1][0] if k + 1 < len(spans) else np.inf
        after |= (table.command_time > end) & (table.time >= start) & (table.time < following)
    if not (after & (table.mode != GROUND)).any():
        return table
    mode, valid, upset = np.where(after, GROUND, table.mode), table.valid & ~after[:, None], table.upset & ~after
    return replace(table, mode=mode.astype(np.int32), valid=valid, upset=upset)


def _in_flight(found: tuple[Override, ...], spans: Spans) -> list[Override]:
    """Overrides that were noticed in flight, each ended with its flight at the latest."""
    kept = []
    for one in found:
        for start, end in spans:
            if start <= one.onset < end and one.detected <= end + CONFIRM_S:
                kept.append(one if (one.end or np.inf) <= end else replace(one, end=end))
    return kept
