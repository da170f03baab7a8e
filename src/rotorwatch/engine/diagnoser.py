"""The engine of one vehicle, as Python has it: samples in; ticks, what the estimator made of them, and what is written down of it out."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base import memory
from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine import engine, feed
from rotorwatch.engine.definition import ENGINE, Samples, pieces
from rotorwatch.engine.estimator.estimator import Result
from rotorwatch.engine.front.ticks import Made
from rotorwatch.engine.host import events, program
from rotorwatch.engine.host.program import Learned, TickOutput
from rotorwatch.engine.motion import allocation, deviations
from rotorwatch.engine.motion.airborne import Gap
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.contact import Contact
from rotorwatch.engine.motion.deviations import Override
from rotorwatch.engine.motion.samples import parts
from rotorwatch.engine.motion.ticks import Plan, Ticks, columns, grounded, joined, known_hover, laid_out, plan
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

ROOM = 512  # ticks in one call
WRITTEN = "best", "probability", "onsets", "active", "each", "share", "gives"
"""Outputs of ticks, half of all, of which a diagnosis asks nothing once losses are written down."""


class Judged(NamedTuple):
    """Ticks that have become certain, and what the estimator made of them."""

    table: Ticks
    out: TickOutput

    def part(self, keep: np.ndarray | slice) -> Judged:
        """The ticks `keep` (T,) bool, or from one to another."""
        return Judged(self.table.part(keep), TickOutput(*(column[keep] for column in self.out)))

    @staticmethod
    def joined(parts: list[Judged]) -> Judged | None:
        """Those that follow each other, in one; None without any. The list is emptied, so that they are not held twice."""
        if len(parts) < 2:
            return parts[0] if parts else None
        tables, columns = [one.table for one in parts], [list(x) for x in zip(*(one.out for one in parts), strict=True)]
        parts.clear()
        table = joined(tables)
        tables.clear()
        return Judged(table, TickOutput(*(np.concatenate(columns.pop(0)) for _ in TickOutput._fields)))


class Written(NamedTuple):
    """What a diagnoser leaves behind: losses, falls and contacts, the trim, outputs that have not followed the mixer, and what the
    estimator has come to."""

    losses: events.Losses
    report: events.Report
    trim: Rows
    overrides: tuple[Override, ...]
    learned: Learned


class Diagnoser:
    """One vehicle, from its samples on. losses, report, trim: what is written down so far; contacts: of all ticks so far."""

    def __init__(self, vehicle: Vehicle, craft: Rows, plan: Plan, mixing: bool, dynamics: dict | None = None):
        """craft: the vehicle as the definitions take it (`allocation.laid_out`); mixing: thrusts come from the rate controller's output;
        dynamics: what healthy flights have shown. Raises ConfigError for ticks of no length that is known."""
        self.vehicle, self._craft, self._mixing = vehicle, craft, mixing
        B = vehicle.effectiveness()
        craft.set(coaxial=bool(events.vehicle(B)["coaxial"][0]))
        self._plant = program.laid_out(program.parameters(B, plan.dt, dynamics))
        self._engine = ENGINE.new(engine.Engine)
        self._room = ENGINE.array(Made, ROOM), ENGINE.array(Result, ROOM)
        self._fed = ENGINE.new(feed.Fed)
        self._closed: list[tuple[float, float]] = []
        self._overrides: tuple[Override, ...] = ()
        self.contacts: tuple[Contact, ...] = ()
        self.losses = events.Losses(B, self._engine.part("losses"))
        self.report = events.Report(B, self._engine.part("report"))
        self.trim = self._engine.part("trim")
        self.planned(plan)
        ENGINE.call(feed.begin, self._engine, self._plant)

    def planned(self, plan: Plan) -> None:
        """Go on with other rates of the samples; the length of a tick stays."""
        self.plan, self._plan = plan, laid_out(plan, known_hover(self.vehicle), self._mixing)

    def feed(self, samples: Samples) -> list[Judged]:
        """More samples, in the order of time: the ticks that are certain by them."""
        found, first, many = [], 0, ROOM
        while first < len(samples) or many == ROOM:
            rest = first, len(samples), samples.kind, samples.time, samples.at, samples.values
            many = self._call(feed.feed, *rest)
            first = int(self._fed["samples"][0])
            found += self._judged(many)
        return found

    def finish(self, end: float) -> list[Judged]:
        """No sample comes after `end` s: the ticks that are left."""
        found = []
        while many := self._call(feed.finish, end):
            found, end = [*found, *self._judged(many)], LASTS
        return found

    def fell(self, at: float) -> None:
        """The flight that goes on, or was the last, was over at `at` s, as only what comes after it shows: its ticks from now on lie on
        the ground; LASTS: no, it was not."""
        self._engine.set(fell=min(at, LASTS))

    def restore(self, losses: Rows, report: Rows) -> None:
        """Have written down this instead, copies of `losses.state` and `report.state` then."""
        self._engine.put(losses=losses, report=report)

    @property
    def learned(self) -> Learned:
        """What the estimator has come to."""
        return program.learned(self._engine.part("estimator"), len(self.vehicle.rotors))

    @property
    def spans(self) -> Spans:
        """(start, end) s of each flight so far, infinite where it lasts."""
        air = self._engine.part("front").part("air")
        if count := int(air["ended"][0]):
            flights, last = air.part("flights"), float(air["last"][0])
            begins, ends = (flights[name].reshape(-1)[:count] for name in ("start", "end"))
            self._closed += [(float(a), min(float(b), last)) for a, b in zip(begins, ends)]
            air.set(ended=0)
        start = float(air["start"][0])
        return (*self._closed, *([(start, np.inf)] if start < LASTS else []))

    @property
    def overrides(self) -> tuple[Override, ...]:
        """Outputs that have not followed the mixer so far."""
        state = self._engine.part("front").part("deviations")
        if int(state["overrides_count"][0]):
            self._overrides = deviations.found(state, self._craft)
        return self._overrides

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that have been missing for longer than a gap, in the flight that goes on or was the last."""
        air, spans = self._engine.part("front").part("air"), self.spans
        who = [k for k in range(len(self.vehicle.rotors)) if int(air["unseen"][0]) >> k & 1]
        start, end = spans[-1] if spans else (np.inf, np.inf)
        since = {k: max(float(air["seen"][0, k]), start) for k in who}
        return tuple(Gap((k + 1,), since[k], end, since[k] == start, True) for k in who)

    @property
    def tick_end_s(self) -> float:
        """End of the next tick of all [s]."""
        sense = self._engine.part("front").part("sense")
        return float(sense["origin"][0]) + self.plan.dt * int(sense["next"][0])

    @property
    def doubting(self) -> bool:
        """Whether ticks wait because the vehicle may have landed."""
        return bool(self._engine.part("front")["doubting"][0])

    @property
    def written(self) -> Written:
        """What is written down so far, of its own."""
        losses, report, trim = (self._engine.part(name).copy() for name in ("losses", "report", "trim"))
        B = self.vehicle.effectiveness()
        return Written(events.Losses(B, losses), events.Report(B, report), trim, self.overrides, self.learned)

    def _call(self, function, *arguments) -> int:
        """Ticks that a function of `feed` has made."""
        constants = self._craft, self._plan, self._plant
        ENGINE.call(function, self._engine, *constants, *arguments, *self._room, ROOM, self._fed)
        return int(self._fed["ticks"][0])

    def _judged(self, count: int) -> list[Judged]:
        if not count:
            return []
        made, out = self._room
        table = columns(made.cut(count), self.plan, len(self.vehicle.rotors), self.contacts).part(np.arange(count))
        self.contacts = table.contacts
        return [
            Judged(
                replace(table, curve=self.vehicle.curve.believed), program.outputs(out, count, len(self.vehicle.rotors))
            )
        ]


def _to_be_read(one: Judged) -> Judged:
    """Without the outputs WRITTEN."""
    none = np.empty((len(one.table.time), 0))
    return one._replace(out=one.out._replace(**dict.fromkeys(WRITTEN, none)))


def fly(
    flight: Flight,
    vehicle: Vehicle,
    air: Spans,
    ready_s: float,
    dynamics: dict | None = None,
    progress: Callable[[float], object] | None = None,
    whole: bool = False,
) -> tuple[Written, Judged]:
    """A whole flight: a link that is over. What its diagnoser has written down, and its ticks up to the last command.

    air: its flights ((start, end), ...) s; an end before the one that samples show is an impact. ready_s: blind time after lift-off;
    dynamics: what healthy flights have shown; progress: called with the finished share, 0..1. The flight needs motor outputs. Outputs that
    the diagnoser has written down (WRITTEN) have columns only where the outputs are wanted whole.
    """
    kept = (lambda one: one) if whole else _to_be_read
    mixing = allocation.faster_control(flight)
    how = plan(flight, flight["control" if mixing else "motors"], ready_s)
    diagnoser = Diagnoser(vehicle, allocation.laid_out(vehicle, flight), how, mixing, dynamics)
    diagnoser.trim.set(every=LASTS)  # nobody asks before the end
    taken = parts(flight.signals, flight.messages, vehicle, how.gyro, "battery" in flight.signals)
    left, done, total = list(air), 0, sum(len(part.time) for part in taken)
    found: list[Judged] = []
    for samples in pieces(taken):
        lifted = {}
        while left and left[0][0] <= samples.time[-1]:
            start, end = left.pop(0)
            lifted[int(np.searchsorted(samples.time, start))] = end
        for first, last in itertools.pairwise(sorted({0, *lifted, len(samples)})):
            if first in lifted:
                diagnoser.fell(lifted[first])
            found += map(kept, diagnoser.feed(samples.part(first, last)))
        done += len(samples)
        if progress:
            progress(done / total)
    found += map(kept, diagnoser.finish(max(flight.duration, float(flight["motors"].time[-1]))))
    judged = Judged.joined(found)
    memory.give_back()  # many small pieces
    assert judged is not None and judged.table.seen is not None
    commanded = np.flatnonzero(judged.table.seen)
    judged = judged.part(slice(0, int(commanded[-1]) + 1))
    return diagnoser.written, judged._replace(table=grounded(judged.table, air))
