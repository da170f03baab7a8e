"""The engine of one vehicle in Python: samples in; ticks, the estimator's outputs, and the records of losses and contacts out."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base import memory
from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine import engine, feed
from rotorwatch.engine.bindings import event_rows, program
from rotorwatch.engine.bindings.program import Learned, TickOutput
from rotorwatch.engine.definition import ENGINE, Samples
from rotorwatch.engine.estimator.estimator import Result
from rotorwatch.engine.intake.ticks import Made
from rotorwatch.engine.motion import overrides as deviations
from rotorwatch.engine.motion.air_spans import Gap
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.knocks import Contact
from rotorwatch.engine.motion.overrides import Override
from rotorwatch.engine.motion.tick_table import Plan, Ticks, columns, joined, known_hover, laid_out
from rotorwatch.flight.vehicle import Vehicle

ROOM = 128  # ticks in one call
MANY = 32  # pieces whose memory is worth giving back before the next columns are joined


class Assessed(NamedTuple):
    """Ticks that have become certain, with the estimator's outputs."""

    table: Ticks
    out: TickOutput

    def part(self, keep: np.ndarray | slice) -> Assessed:
        """The ticks `keep` (T,) bool, or from one to another."""
        return Assessed(self.table.part(keep), TickOutput(*(column[keep] for column in self.out)))

    @staticmethod
    def joined(parts: list[Assessed]) -> Assessed | None:
        """Consecutive ones joined; None without any. The list is emptied, to save memory."""
        if len(parts) < 2:
            return parts[0] if parts else None
        tables, columns = [one.table for one in parts], [list(x) for x in zip(*(one.out for one in parts), strict=True)]
        parts.clear()
        table = joined(tables)
        if len(tables) > MANY:
            tables.clear()
            memory.give_back()
        return Assessed(table, TickOutput(*(np.concatenate(columns.pop(0)) for _ in TickOutput._fields)))


class Written(NamedTuple):
    """Records of a diagnoser: losses, falls and contacts, the trim, outputs that have not followed the mixer, and the estimator's present
    state."""

    losses: event_rows.Losses
    report: event_rows.Report
    trim: Rows
    overrides: tuple[Override, ...]
    learned: Learned


class Checkpoint(NamedTuple):
    """State of a diagnoser: of the engine, with the contacts, flights and overrides so far."""

    engine: Rows
    contacts: tuple[Contact, ...]
    spans: Spans
    overrides: tuple[Override, ...]


class Diagnoser:
    """Diagnoser of one vehicle. losses, report, trim: the records so far; contacts: of all ticks so far."""

    def __init__(self, vehicle: Vehicle, craft: Rows, plan: Plan, mixing: bool, dynamics: dict | None = None):
        """craft: the vehicle in the definitions' form (`allocation.laid_out`); mixing: thrusts come from the rate controller's output;
        dynamics: learned from healthy flights. Raises ConfigError for ticks of an unknown length."""
        self.vehicle, self._craft, self._mixing = vehicle, craft, mixing
        B = vehicle.effectiveness()
        craft.set(coaxial=bool(event_rows.vehicle(B)["coaxial"][0]))
        self._plant = program.laid_out(program.parameters(B, plan.dt, dynamics))
        self._engine = ENGINE.new(engine.Engine)
        self._room = ENGINE.array(Made, ROOM), ENGINE.array(Result, ROOM)
        self._fed = ENGINE.new(feed.Fed)
        self._closed: list[tuple[float, float]] = []
        self._overrides: tuple[Override, ...] = ()
        self.contacts: tuple[Contact, ...] = ()
        self.losses = event_rows.Losses(B, self._engine.part("losses"))
        self.report = event_rows.Report(B, self._engine.part("report"))
        self.trim = self._engine.part("trim")
        self._engine.part("spin").set(watched=False)  # case/departures.py knows what was commanded
        self.planned(plan)
        ENGINE.call(feed.begin, self._engine, self._plant)

    def planned(self, plan: Plan) -> None:
        """Continue with other sampling rates; the length of a tick stays."""
        self.plan, self._plan = plan, laid_out(plan, known_hover(self.vehicle), self._mixing)

    def feed(self, samples: Samples) -> list[Assessed]:
        """Add samples, in time order; returns the ticks that they make certain."""
        found, first, many = [], 0, ROOM
        while first < len(samples) or many == ROOM:
            rest = first, len(samples), samples.kind, samples.time, samples.at, samples.values
            many = self._call(feed.feed, *rest)
            first = int(self._fed["samples"][0])
            found += self._assessed(many)
        return found

    def finish(self, end: float) -> list[Assessed]:
        """No sample comes after `end` s: returns the remaining ticks."""
        found = []
        while many := self._call(feed.finish, end):
            found, end = [*found, *self._assessed(many)], LASTS
        return found

    def fell(self, at: float) -> None:
        """The current or last flight ended at `at` s, as only later samples show: its ticks from now on are on the ground; LASTS:
        withdraw that."""
        self._engine.set(fell=min(at, LASTS))

    def checkpoint(self) -> Checkpoint:
        """A copy of its state, for `restore`."""
        spans, overrides = self.spans, self.overrides  # state that the engine copies
        return Checkpoint(self._engine.copy(), self.contacts, spans, overrides)

    def restore(self, state: Checkpoint) -> None:
        """Go back to a checkpoint."""
        self._engine.assign(state.engine)
        self.contacts, self._overrides = state.contacts, state.overrides
        self._closed = [span for span in state.spans if span[1] < np.inf]

    @property
    def learned(self) -> Learned:
        """The estimator's present state."""
        return program.learned(self._engine.part("estimator"), len(self.vehicle.rotors))

    @property
    def spans(self) -> Spans:
        """(start, end) s of each flight so far, infinite end while airborne."""
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
        """Commands that have been missing for longer than a gap, in the current or last flight."""
        air, spans = self._engine.part("front").part("air"), self.spans
        who = [k for k in range(len(self.vehicle.rotors)) if int(air["unseen"][0]) >> k & 1]
        start, end = spans[-1] if spans else (np.inf, np.inf)
        since = {k: max(float(air["seen"][0, k]), start) for k in who}
        return tuple(Gap((k + 1,), since[k], end, since[k] == start, True) for k in who)

    @property
    def tick_end_s(self) -> float:
        """End of the next tick of the front end [s]."""
        sense = self._engine.part("front").part("sense")
        return float(sense["origin"][0]) + self.plan.dt * int(sense["next"][0])

    @property
    def doubting(self) -> bool:
        """Return whether ticks wait because the vehicle may have landed."""
        return bool(self._engine.part("front")["doubting"][0])

    @property
    def written(self) -> Written:
        """Copies of the records so far."""
        losses, report, trim = (self._engine.part(name).copy() for name in ("losses", "report", "trim"))
        B = self.vehicle.effectiveness()
        return Written(event_rows.Losses(B, losses), event_rows.Report(B, report), trim, self.overrides, self.learned)

    def _call(self, function, *arguments) -> int:
        """Collect the ticks made by a function of `feed`."""
        constants = self._craft, self._plan, self._plant
        ENGINE.call(function, self._engine, *constants, *arguments, *self._room, ROOM, self._fed)
        return int(self._fed["ticks"][0])

    def _assessed(self, count: int) -> list[Assessed]:
        if not count:
            return []
        made, out = self._room
        table = columns(made.cut(count), self.plan, len(self.vehicle.rotors), self.contacts).part(np.arange(count))
        self.contacts = table.contacts
        return [Assessed(replace(table, curve=self.vehicle.curve.believed), program.outputs(out, count, len(self.vehicle.rotors)))]
