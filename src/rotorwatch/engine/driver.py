"""Drive the engine with samples as they come: plan the ticks, feed, and roll back to a checkpoint when a flight turns out to have ended.

The only place that steps the engine, for links and logs. A log is a link that is over: fed in one piece, with its impacts known in advance.
Samples of one signal come in the order of time, those of different signals in the order of the link. Pieces of any length give the same
ticks.

Rollback: an impact shows only in the samples after it, so the engine has evaluated ticks on the ground as flight. The driver restores
the last checkpoint before it and feeds the samples since then again, with the end of the flight known.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import memory
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.definition import Samples, pieces
from rotorwatch.engine.diagnoser import Assessed, Checkpoint, Diagnoser, Written
from rotorwatch.engine.intake.sense import SUM_S
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.air_spans import Gap
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.samples import SIGNALS, parts
from rotorwatch.engine.motion.tick_table import READY_KNOWN_S, READY_S, Plan, Ticks, grounded, plan
from rotorwatch.engine.window import STATES, Window
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import Vehicle

LOOK_S = 0.2  # longest interval between checks whether the vehicle flies
FORGET_S = 1.0  # between two removals of old samples
LOOK_BACK_S = 8.0  # of samples before a checkpoint: the longest look back is 2 s; late samples come on top
REPLAY_S = 120.0  # shortest rollback that is always possible
FIRST, FIRST_S, LEAST = 64, 20.0, 20  # commands needed to plan a flight, or so long and so many
CHANGED = 1.2  # factor by which a sampling rate must change for a new plan


RECORDED = "best", "probability", "onsets", "active", "each", "share", "gives"
"""Outputs of ticks, half of their size, that are not read once the engine has recorded its losses."""


class Piece(NamedTuple):
    """Result of a step. spans: ((start, end), ...) s of each flight so far, end infinite while airborne; assessed: the new ticks, None
    without any; rolled_back: these replace all ticks since the checkpoint whose `extra` is given."""

    spans: Spans
    assessed: Assessed | None = None
    rolled_back: bool = False
    extra: Any = None


class _Mark(NamedTuple):
    """A checkpoint: the engine's state, up to where each signal was fed [s], the messages fed since, and the owner's state."""

    engine: Checkpoint
    fed: dict[str, float]
    messages: list[Message]
    extra: Any


class Driver:
    """The samples of one vehicle and its diagnoser, which is None until enough samples have come to plan the ticks."""

    def __init__(
        self,
        about: Flight,
        vehicle: Vehicle,
        *,
        keep_s: float = 0.0,
        snapshot: Callable[[], Any] = lambda: None,
        kept: Callable[[Assessed], Assessed] = lambda assessed: assessed,
    ):
        """about: parameters and facts of the flight; keep_s: samples that are kept for others, at least; snapshot: state of the owner that
        belongs to a checkpoint, copied; kept: the part of each batch of ticks that is kept."""
        self.window, self.vehicle = Window(about), vehicle
        self.diagnoser: Diagnoser | None = None
        self.dynamics: dict | None = None  # noise and gains by which it assesses
        self._keep_s, self._snapshot, self._kept = keep_s, snapshot, kept
        self._mixing, self._planned_aloft = False, False
        self._fed: dict[str, float] = {}  # signal -> time of its last sample that was fed
        self._falls: dict[float, float] = {}  # start of a flight -> time of its impact
        self._time, self._first = (-np.inf, -np.inf)  # of the last commands in a tick; of the first since the newer checkpoint
        self._reached = -np.inf  # time of the last sample that was fed
        self._marks: list[_Mark] = []  # two, the older first
        self._messages: list[Message] = []
        self._forgot = -np.inf

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """Append samples and messages, in the order of time."""
        messages = list(messages)
        self.window.add(signals, messages)
        self._messages += (m for m in messages if m.kind in STATES)  # the engine takes no others; texts must not fill the memory

    def begin(self, flight: Flight, how: Plan, dynamics: dict | None, spans: Spans = ()) -> Diagnoser:
        """Start with a plan. flight: for its ranges and rates; dynamics: noise and gains of this vehicle from healthy flights; spans: of a
        log, ((start, end), ...) s of each flight, cut at impacts."""
        self._falls = dict(spans)
        self._mixing = allocation.faster_control(flight)
        craft = allocation.laid_out(self.vehicle, flight)
        self.diagnoser, self.dynamics = Diagnoser(self.vehicle, craft, how, self._mixing, dynamics), dynamics
        self._marks = [] if spans else [self._mark(self.diagnoser)]  # the end of a log's flights is known
        return self.diagnoser

    def advance(self) -> Piece | None:
        """Feed new samples; None before the flight is planned."""
        diagnoser = self.diagnoser or self._begin()
        if diagnoser is None:
            self.window.forget(self.window.now - 60.0)
            return None
        piece = self._piece(diagnoser, self._feed(diagnoser))
        if self.window.now > self._forgot + FORGET_S:
            self._forgot = self.window.now
            oldest = min(self._marks[0].fed.values(), default=np.inf)
            self.window.forget(min(self.window.now - self._keep_s, oldest - LOOK_BACK_S))
        return piece

    def finish(self, end: float, progress: Callable[[float], object] | None = None) -> Piece | None:
        """Feed the rest of a flight without samples after `end` s. progress: called with the finished share, 0..1."""
        diagnoser = self.diagnoser or self._begin()
        if diagnoser is None:
            return None
        assessed = self._feed(diagnoser, progress=progress)
        assessed += map(self._kept, diagnoser.finish(end))
        return self._piece(diagnoser, assessed)

    def follow(self, spans: Spans) -> Piece | None:
        """Take over the end of each flight, ((start, end), ...) s: earlier than the engine knows after an impact. The replacement of all
        ticks since the checkpoint where that changes ticks which have been evaluated, else None."""
        diagnoser = self.diagnoser
        assert diagnoser is not None
        known = dict(diagnoser.spans)
        falls, before = {start: end for start, end in spans if end < known.get(start, -np.inf)}, self._falls
        changed = [end for start, end in {*falls.items(), *before.items()} if falls.get(start) != before.get(start)]
        self._falls = falls
        if spans:
            diagnoser.fell(falls.get(spans[-1][0], np.inf))
        if min(changed, default=np.inf) >= self._time:
            return None
        mark, until, waiting = self._marks[0], self._fed, self._messages
        diagnoser.restore(mark.engine)
        for start, _ in diagnoser.spans[-1:]:
            diagnoser.fell(falls.get(start, np.inf))
        self._reached = max(mark.fed.values(), default=-np.inf)
        self._fed, self._messages = dict(mark.fed), list(mark.messages)
        self._marks, self._first = [mark._replace(messages=[])], -np.inf
        assessed = self._feed(diagnoser, until)
        self._messages = waiting
        return self._piece(diagnoser, assessed)._replace(rolled_back=True, extra=copy.deepcopy(mark.extra))

    @property
    def plan(self) -> Plan | None:
        """Division of the flight into ticks."""
        return None if self.diagnoser is None else self.diagnoser.plan

    @property
    def due_s(self) -> float:
        """Earliest time at which there may be another tick [s]."""
        if self.diagnoser is None:
            return self.window.now + LOOK_S
        how = self.diagnoser.plan
        end = self.diagnoser.tick_end_s + how.lag_s + max(how.half.values(), default=0.0) - SUM_S
        return min(end, self.window.now + LOOK_S)

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that have been missing for longer than a gap, in the current or the last flight."""
        return () if self.diagnoser is None else self.diagnoser.missing

    def replanned(self) -> Flight | None:
        """At the first lift-off: the kept samples when their rates are not those of the plan, so that the flight must be begun anew; else
        None."""
        diagnoser = self.diagnoser
        if self._planned_aloft or diagnoser is None or not diagnoser.spans:
            return None
        self._planned_aloft = True
        flight = self.window.flight(self.window.now - LOOK_BACK_S)
        mixing = allocation.faster_control(flight)
        commands = flight["control" if mixing else "motors"]
        if len(commands) < LEAST:
            return None
        old = diagnoser.plan
        new = plan(flight, commands, old.ready_s)
        if (new.dt, new.gyro, new.accel, mixing) != (old.dt, old.gyro, old.accel, self._mixing):
            return flight
        if any(not 1 / CHANGED < new.period[name] / old.period[name] < CHANGED for name in new.period):
            diagnoser.planned(old._replace(half=new.half, period=new.period))
        return None

    def _begin(self) -> Diagnoser | None:
        flight = self.window.flight(-np.inf)
        if not flight.has("motors"):
            return None
        motors = flight["motors"]
        if len(motors) < LEAST or (len(motors) < FIRST and self.window.now - motors.time[0] < FIRST_S):
            return None
        commands = flight["control" if allocation.faster_control(flight) else "motors"]
        dynamics = (self.vehicle.identified or {}).get("dynamics")
        how = plan(flight, commands, READY_KNOWN_S if dynamics else READY_S)
        if dynamics and dynamics.get("dt") != how.dt:
            dynamics = None  # the noise of healthy flights at another rate does not apply
        if not (dynamics and how.gyro == "gyro"):
            how = plan(flight, commands, READY_S)
        return self.begin(flight, how, dynamics)

    def _piece(self, diagnoser: Diagnoser, found: list[Assessed]) -> Piece:
        assessed = Assessed.joined(found)
        if assessed is not None:
            time = assessed.table.command_time
            self._first = float(time[0]) if self._first == -np.inf else self._first
            self._time = float(time[-1])
        return Piece(diagnoser.spans, assessed)

    def checkpoint(self) -> None:
        """Set a checkpoint where the last one is old; to be called when the owner has taken over all ticks so far."""
        if self.diagnoser is not None and -np.inf < self._first < self._time - REPLAY_S:
            self._marks = [*self._marks[-1:], self._mark(self.diagnoser)]
            self._first = -np.inf

    def _mark(self, diagnoser: Diagnoser) -> _Mark:
        return _Mark(diagnoser.checkpoint(), dict(self._fed), [], copy.deepcopy(self._snapshot()))

    def _feed(
        self, diagnoser: Diagnoser, until: Mapping[str, float] | None = None, progress: Callable[[float], object] | None = None
    ) -> list[Assessed]:
        """The ticks made by the samples since the last call; until: of each signal only those up to this time [s]."""
        window, signals = self.window, {}
        for name in window.names:
            since, end = (self._fed.get(name, -np.inf), window.newest(name) if until is None else until.get(name, -np.inf))
            if end > since and name in SIGNALS:
                signal = window.flight(since, (name,))[name]
                if since > -np.inf or until is not None:
                    first, last = np.searchsorted(signal.time, (since, end), "right")
                    signal = signal.part(slice(int(first), int(last)))
                signals[name] = signal
                self._fed[name] = end
        messages, self._messages = self._messages, []
        for mark in self._marks:
            mark.messages.extend(messages)
        taken = parts(signals, messages, self.vehicle, diagnoser.plan.gyro, "battery" in window.names)
        total, done, assessed = sum(len(part.time) for part in taken), 0, []
        for samples in pieces(taken):
            for piece in self._to_lift_off(diagnoser, samples):
                assessed += map(self._kept, diagnoser.feed(piece))
            done += len(samples)
            if progress:
                progress(done / total)
        return assessed

    def _to_lift_off(self, diagnoser: Diagnoser, samples: Samples) -> Iterator[Samples]:
        """The samples, cut at lift-offs of flights with a known end, which the engine is given there."""
        lifted, last = {}, samples.time[-1] if len(samples) else -np.inf
        for start, end in self._falls.items():
            if self._reached < start <= last:
                lifted[int(np.searchsorted(samples.time, start))] = end
        self._reached = max(self._reached, last)
        for first, last in itertools.pairwise(sorted({0, *lifted, len(samples)})):
            if first in lifted:
                diagnoser.fell(lifted[first])
            yield samples.part(first, last)


def fly(
    flight: Flight,
    vehicle: Vehicle,
    air: Spans,
    ready_s: float,
    dynamics: dict | None = None,
    progress: Callable[[float], object] | None = None,
    whole: bool = False,
) -> tuple[Written, Assessed] | None:
    """The engine's records of a whole log, and its ticks up to the last command; None where no commands are known in the air.

    air: its flights ((start, end), ...) s, cut at impacts; ready_s: blind time after lift-off [s]; dynamics: noise and gains of this
    vehicle from healthy flights; progress: called with the finished share, 0..1; whole: with the outputs RECORDED as well.
    """
    if not flight.has("motors") or not air:
        return None
    commands = flight["control" if allocation.faster_control(flight) else "motors"]
    if len(commands) < LEAST or not flight["motors"].whole.any():  # or one output never has a value
        return None
    driver = Driver(flight, vehicle, kept=(lambda one: one) if whole else _without_recorded)
    driver.add({name: s for name, s in flight.signals.items() if name in SIGNALS}, flight.messages)
    diagnoser = driver.begin(flight, plan(flight, commands, ready_s), dynamics, air)
    diagnoser.trim.set(every=LASTS)  # looked at once, at the end
    piece = driver.finish(max(flight.duration, float(flight["motors"].time[-1])), progress)
    memory.give_back()
    assert piece is not None and piece.assessed is not None and piece.assessed.table.seen is not None
    commanded = np.flatnonzero(piece.assessed.table.seen)
    if not commanded.size:
        return None
    assessed = piece.assessed.part(slice(0, int(commanded[-1]) + 1))
    return diagnoser.written, assessed._replace(table=grounded(assessed.table, air))


def observe(
    flight: Flight, vehicle: Vehicle, air: Spans, ready_s: float, progress: Callable[[float], object] | None = None
) -> Ticks | None:
    """The ticks of a log as `fly` makes them."""
    flown = fly(flight, vehicle, air, ready_s, progress=progress)
    return None if flown is None else flown[1].table


def _without_recorded(assessed: Assessed) -> Assessed:
    none = np.empty((len(assessed.table.time), 0))
    return assessed._replace(out=assessed.out._replace(**dict.fromkeys(RECORDED, none)))
