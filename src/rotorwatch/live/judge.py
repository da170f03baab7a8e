"""Ticks as they come -> estimator -> events, as `diagnose` has them of a log that ends now.

When a landing is certain its beginning lies up to `airborne.CONFIRM_S` back: what was judged since then is taken back and judged anew, so
that nothing on the ground is read as a fault. For that the last seconds are kept, with what everything had come to at some moments.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rotorwatch.answer.unseen import Unseen
from rotorwatch.default import events, hypotheses, program
from rotorwatch.diagnosis import Event
from rotorwatch.flight import Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.beginnings import Beginnings
from rotorwatch.live.history import History
from rotorwatch.live.stream import Piece
from rotorwatch.motion import outside, ticks
from rotorwatch.motion.airborne import CONFIRM_S
from rotorwatch.motion.allocation import Comparison, Spans
from rotorwatch.motion.departures import Watch
from rotorwatch.motion.ticks import JUDGE, SETTLE_S, Past, Plan, Sensed, Ticks

KEEP_EVERY_S, TAKE_BACK_S = 1.0, CONFIRM_S + 3.0


@dataclass(frozen=True)
class Compared:
    """Comparisons, and the outputs logged in them."""

    check: Comparison
    command: np.ndarray

    def __len__(self):
        return len(self.command)

    def __getitem__(self, part: slice) -> Compared:
        return Compared(self.check[part], self.command[part])

    def __add__(self, later: Compared) -> Compared:
        return Compared(self.check + later.check, np.concatenate([self.command, later.command]))

    @property
    def time(self) -> np.ndarray:
        return self.check.time


@dataclass(frozen=True)
class Logged:
    """Outputs, and the thrusts of these."""

    motors: Signal
    thrust: np.ndarray

    def __len__(self):
        return len(self.thrust)

    def __getitem__(self, part: slice) -> Logged:
        return Logged(self.motors.part(part), self.thrust[part])

    def __add__(self, later: Logged) -> Logged:
        both = ((getattr(self.motors, name), getattr(later.motors, name)) for name in ("time", "values", "valid"))
        return Logged(
            self.motors.with_arrays(*(np.concatenate(pair) for pair in both)),
            np.concatenate([self.thrust, later.thrust]),
        )

    @property
    def time(self) -> np.ndarray:
        return self.motors.time


class Tape:
    """Rows as they came, of which the last are kept; `at`: running number of the next one to be read.

    They stay in the pieces in which they came: to join all that is kept with every new one would take longer than to judge it.
    """

    def __init__(self):
        self._pieces: list[Any] = []
        self._first = self._end = self.at = 0

    def add(self, more) -> None:
        if more is not None and len(more):
            self._pieces.append(more)
            self._end += len(more)

    def left(self):
        """The rows that have not been read, or None."""
        if self.at >= self._end:
            return None
        first, place = self._end, len(self._pieces)
        while first > self.at:
            place -= 1
            first -= len(self._pieces[place])
        left = functools.reduce(operator.add, self._pieces[place:])
        return left[self.at - first :] if self.at > first else left

    def forget(self, before: int) -> None:
        while self._pieces and self._first + len(self._pieces[0]) <= before:
            self._first += len(self._pieces.pop(0))


@dataclass(frozen=True)
class Kept:
    """What everything had come to: after ticks and samples up to `time` s; number: of ticks; places: of the tapes."""

    time: float
    number: int
    places: tuple[int, ...]
    past: Past | None
    state: Any
    watch: bytes


class Judge:
    """One vehicle, tick by tick. now: the last ticks, and the estimator's outputs of these rows; None before there are any."""

    def __init__(self, vehicle: Vehicle, plan: Plan, dynamics=None):
        self.vehicle, self.plan = vehicle, plan
        self.B = vehicle.effectiveness()
        self.hyp = hypotheses.make(len(vehicle.rotors))
        self._hover = ticks.known_hover(vehicle)
        self._steps = program.steps(plan.dt, self.B, dynamics)
        self._past: Past | None = None
        self._watch = Watch(vehicle)
        self._history = History(plan.dt)
        known = vehicle.identified  # healthy flights have told what happened in the blind time
        self._beginnings = None if known else Beginnings(self.hyp, self.B, plan.ready_s)
        self._tapes = (Tape(), Tape(), Tape())  # Sensed, Compared, Logged
        self._spans: Spans = ()
        self._over = False
        self._time = self._air_s = -np.inf
        self._done: tuple[Event, ...] = ()
        self._fallen: dict[float, tuple[tuple[float, float], ...]] = {}
        self.now: tuple[Ticks, Any] | None = None
        self.unseen = Unseen(self.B, plan.dt)
        self.ticks = 0  # that were judged, those that were taken back and judged again twice
        self._kept = [self._keep()]

    def on(self, piece: Piece, final: bool = False) -> None:
        """Go on with what has become known. final: nothing will come after."""
        for tape, more in zip(self._tapes, _rows(piece)):
            tape.add(more)
        changed = _changed(self._spans, piece.spans)
        self._spans, self._over = piece.spans, final
        if changed <= self._time:
            self._take_back(changed)
        self._judge_ticks()
        if piece.air_s > self._air_s:
            self._judge_outputs(piece.air_s)
            self._air_s = piece.air_s
        early = self._beginnings
        if early is not None and (final or early.due(self._spans, self._time)):
            early.look(self._steps.carry, self._spans, self._time, final)
        if self._time - self._kept[-1].time >= KEEP_EVERY_S:
            self._kept.append(self._keep())
            while len(self._kept) > 2 and self._kept[1].time < self._time - TAKE_BACK_S:
                del self._kept[0]
            for tape, place in zip(self._tapes, self._kept[0].places):
                tape.forget(place)
            self._done += self._history.settle(self._kept[0].number, self.hyp, self.B)

    @property
    def said(self) -> int:
        """Grows, or shrinks, when there may be other events."""
        contacts = 0 if self._past is None else len(self._past.contacts)
        early = 0 if self._beginnings is None else len(self._beginnings.found)
        return self._history.said + len(self._watch.found()) + contacts + len(self._done) + early

    @property
    def contact_s(self) -> float:
        """Time of the last knock, s; minus infinity without one."""
        return -np.inf if self._past is None else self._past.hit

    def events(self) -> tuple[Event, ...]:
        """All that has happened, as it looks now."""
        air = self._air()
        losses: tuple[Event, ...] = (*self._done, *self._history.events(self.hyp, self.B, flies=not self._over))
        if self._beginnings is not None:
            losses = self._beginnings.join(losses)
        losses = tuple(events.one_arm(e, self.B) for e in losses if events.accuses(e))
        overrides = outside.as_events(self._watch.found(), self._falls(air))
        contacts = () if self._past is None else outside.contacts_in(self._past.contacts, air)
        found = (*outside.unexplained(losses, overrides), *overrides, *contacts)
        return tuple(sorted(found, key=lambda e: e.detected_s))

    def _air(self) -> Spans:
        return tuple((start, min(end, self._time)) for start, end in self._spans)

    def _falls(self, air: Spans):
        """Of each flight that ends in a fall, the fall; of those whose ticks are gone as it was."""
        time, upset = self._history.column("time"), self._history.column("upset")
        for start, end in air:
            if len(time) and end >= time[0]:
                self._fallen[start] = outside.falls_in(time, upset, self.plan.dt, ((start, end),))
        return tuple(fall for falls in self._fallen.values() for fall in falls)

    def _keep(self) -> Kept:
        places = tuple(tape.at for tape in self._tapes)
        return Kept(self._time, self._history.end, places, self._past, self._steps.state, self._watch.kept())

    def _take_back(self, since: float) -> None:
        """Everything as it was before `since`."""
        while len(self._kept) > 1 and self._kept[-1].time >= since:
            del self._kept[-1]
        kept = self._kept[-1]
        self._time, self._past = kept.time, kept.past
        self._watch.again(kept.watch)
        self._steps.state = kept.state
        self._history.cut(kept.number)
        if self._beginnings is not None:
            self._beginnings.cut(kept.time)
        for tape, place in zip(self._tapes, kept.places):
            tape.at = place

    def _judge_ticks(self) -> None:
        sensed: Sensed | None = self._tapes[0].left()
        if sensed is None:
            return
        count = len(sensed)
        if self._spans:
            start, end = self._spans[-1]
            # The first second of a hop is taken in one piece; nothing in it is judged.
            new = self._past is None or self._past.hop != start
            if new and end > start + SETTLE_S and sensed.when[-1] < start + SETTLE_S:
                count = int(np.searchsorted(sensed.time, start))
        if not count:
            return
        sensed = sensed if count == len(sensed) else sensed[:count]
        self._tapes[0].at += count
        table, self._past = ticks.assemble(sensed, self.plan, self.B, self._spans, self._hover, self._past)
        out = self._steps.run(*program.inputs(table, self.B))
        self._history.add(table, out)
        if self._beginnings is not None:
            self._beginnings.add(table, self._spans)
        self._time = max(self._time, float(table.time[-1]))
        self.now = table, out
        self.unseen.add(np.asarray(out.biases), table)
        self.ticks += int(np.count_nonzero(table.mode == JUDGE))

    def _judge_outputs(self, known_s: float) -> None:
        """Outputs against the mixer, up to when it is known whether the vehicle flies."""
        compared: Compared | None = self._tapes[1].left()
        if compared is not None and (count := int(np.searchsorted(compared.time, known_s, "right"))):
            self._watch.compared(compared.check[:count], compared.command[:count], self._spans)
            self._tapes[1].at += count
            self._time = max(self._time, float(compared.time[count - 1]))
        logged: Logged | None = self._tapes[2].left()
        if logged is not None and (count := int(np.searchsorted(logged.time, known_s, "right"))):
            part = logged[:count]
            self._watch.logged(part.motors, part.thrust, self._spans)
            self._tapes[2].at += count
            self._time = max(self._time, float(part.time[-1]))


def _rows(piece: Piece):
    compared = Compared(piece.check, piece.command) if piece.check is not None and piece.command is not None else None
    logged = Logged(piece.motors, piece.thrust) if piece.motors is not None and piece.thrust is not None else None
    return piece.sensed, compared, logged


def _changed(old: Spans, new: Spans) -> float:
    """From when on what was known of being in the air is not what it was; infinity where nothing has changed."""
    before, after = dict(old), dict(new)
    times = [min(end, after[start]) if start in after else start for start, end in old if after.get(start) != end]
    return min([*times, *(start for start in after if start not in before)], default=np.inf)
