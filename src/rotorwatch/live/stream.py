"""Samples as they come -> ticks that are certain: the front end of `diagnose`, fed piece by piece.

Pieces of any length give the same ticks. Samples of one signal come in the order of time; those of different signals as the link brings
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.definition import ENGINE, merged, states
from rotorwatch.engine.front import front, ticks, whole
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.airborne import Gap
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.contact import Contact
from rotorwatch.engine.motion.deviations import Override, found
from rotorwatch.engine.motion.ticks import Plan, Ticks, columns, joined, laid_out, plan
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.window import WINDOW_S, Window

LOOK_S = 0.2  # at least so often it is asked whether the vehicle flies
FORGET_S = 1.0  # between two clearings of what is not needed any more
FIRST, FIRST_S, LEAST = 64, 20.0, 20  # commands from which a flight is planned, or so long and so many
SUM_S = 1e-9  # by which two sums of the same times may differ: a tick does not wait for the next sample because of that
CHANGED = 1.2  # factor by which a rate must change to be another one
ROOM = 512  # ticks in one call


@dataclass(frozen=True)
class Piece:
    """What has become certain. table: ticks; spans: when it was in the air, one that lasts without an end; overrides: all so far."""

    spans: Spans
    table: Ticks | None = None
    overrides: tuple[Override, ...] = ()


class Stream:
    """One vehicle's samples, cut into ticks. plan: how, once enough has come; None before."""

    def __init__(self, about: Flight, vehicle: Vehicle, ready_s: float):
        """about: what is known of the flight besides its signals. ready_s: blind time after lift-off."""
        self.window, self.vehicle = Window(about), vehicle
        self.plan: Plan | None = None
        self._ready_s, self._mixing, self._planned_aloft = ready_s, False, False
        self._front, self._made, self._done = (
            ENGINE.new(front.Front),
            ENGINE.array(ticks.Made, ROOM),
            ENGINE.new(whole.Done),
        )
        self._fed: dict[str, float] = {}  # signal -> time of its last sample that was fed
        self._messages: list[Message] = []
        self._contacts: tuple[Contact, ...] = ()
        self._overrides: tuple[Override, ...] = ()
        self._closed: list[tuple[float, float]] = []
        self._forgot = -np.inf

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of the flight, in time order."""
        messages = list(messages)
        self.window.add(signals, messages)
        self._messages += messages

    def advance(self) -> Piece | None:
        """What has become certain; None before the flight is planned."""
        if self.plan is None and not self._begin():
            self.window.forget(self.window.now - 60.0)
            return None
        tables = self._feed()
        if self.window.now > self._forgot + FORGET_S:
            self._forgot = self.window.now
            self.window.forget(self.window.now - WINDOW_S)
        return self._piece(tables)

    def finish(self, duration: float) -> Piece | None:
        """The rest, of a flight that has ended after `duration` s."""
        if self.plan is None and not self._begin():
            return None
        tables, end = self._feed(), max(duration, self.window.now)
        while True:
            ENGINE.call(whole.finish, self._front, self._craft, self._plan, end, self._made, ROOM, self._done)
            count, end = int(self._done["rows"][0]), LASTS
            if not count:
                return self._piece(tables)
            tables.append(self._table(count))

    @property
    def due_s(self) -> float:
        """Time from which there may be another tick: nothing need be asked for before."""
        if self.plan is None:
            return self.window.now + LOOK_S
        sense, how = self._front.part("sense"), self.plan
        end = float(sense["origin"][0]) + how.dt * int(sense["next"][0])
        return min(end + how.lag_s + max(how.half.values(), default=0.0) - SUM_S, self.window.now + LOOK_S)

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that have been missing for longer than a gap, in the flight that goes on or was the last."""
        air, spans = self._front.part("air"), self._spans()
        who = [k for k in range(len(self.vehicle.rotors)) if int(air["unseen"][0]) >> k & 1]
        start, end = spans[-1] if spans else (np.inf, np.inf)
        since = {k: max(float(air["seen"][0, k]), start) for k in who}
        return tuple(Gap((k + 1,), since[k], end, since[k] == start, True) for k in who)

    def replanned(self) -> Flight | None:
        """At the first lift-off: the flight that is kept, when its rates are not those that it was planned by, so that it must be begun
        anew; None when all is well."""
        if self._planned_aloft or self.plan is None or not self._spans():
            return None
        self._planned_aloft = True
        flight = self.window.flight(self.window.now - WINDOW_S)
        mixing = allocation.faster_control(flight)
        commands = flight["control" if mixing else "motors"]
        if len(commands) < LEAST:
            return None
        new, old = plan(flight, commands, self._ready_s), self.plan
        if (new.dt, new.gyro, new.accel, mixing) != (old.dt, old.gyro, old.accel, self._mixing):
            return flight
        if any(not 1 / CHANGED < new.period[name] / old.period[name] < CHANGED for name in new.period):
            self._planned(
                Plan(old.dt, old.ready_s, old.lag_s, old.first, old.gyro, old.accel, new.half, new.period, old.notes)
            )
        return None

    def _begin(self) -> bool:
        flight = self.window.flight(-np.inf)
        if not flight.has("motors"):
            return False
        motors = flight["motors"]
        if len(motors) < LEAST or (len(motors) < FIRST and self.window.now - motors.time[0] < FIRST_S):
            return False
        self._mixing = allocation.faster_control(flight)
        self._craft = allocation.laid_out(self.vehicle, flight)
        self._planned(plan(flight, flight["control" if self._mixing else "motors"], self._ready_s))
        return True

    def _planned(self, how: Plan) -> None:
        self.plan, self._plan = how, laid_out(how, (self.vehicle.identified or {}).get("hover"), self._mixing)

    def _feed(self) -> list[Ticks]:
        """All that has come since the last time."""
        assert self.plan is not None
        window, parts = self.window, []
        full = self.vehicle.extra.get("full_voltage")
        for name in window.names:
            since = self._fed.get(name, -np.inf)
            if window.newest(name) <= since or name not in SIGNALS:
                continue
            signal = window.flight(since, (name,))[name]
            signal = signal.part(slice(int(np.searchsorted(signal.time, since, "right")), None))
            self._fed[name] = window.newest(name)
            part = _numbers(name, signal, full if full and "battery" in window.names else None, self.plan.gyro)
            parts += [] if part is None else [part]
        messages, self._messages = self._messages, []
        if messages:
            parts.append(("state", *states(messages)))
        samples, tables, taken = merged(parts), [], 0
        while taken < len(samples):
            arguments = (taken, len(samples), samples.kind, samples.time, samples.at, samples.values)
            ENGINE.call(whole.feed, self._front, self._craft, self._plan, *arguments, self._made, ROOM, self._done)
            taken = int(self._done["samples"][0])
            if count := int(self._done["rows"][0]):
                tables.append(self._table(count))
        return tables

    def _table(self, count: int) -> Ticks:
        assert self.plan is not None
        made = columns(self._made.cut(count), self.plan, len(self.vehicle.rotors), self._contacts)
        made = replace(made, curve=self.vehicle.curve.believed)
        self._contacts = made.contacts
        return made

    def _piece(self, tables: list[Ticks]) -> Piece:
        deviations = self._front.part("deviations")
        if int(deviations["overrides_count"][0]):
            self._overrides = found(deviations, self._craft)
        return Piece(self._spans(), joined(tables) if tables else None, self._overrides)

    def _spans(self) -> Spans:
        air = self._front.part("air")
        if count := int(air["ended"][0]):
            flights, last = air.part("flights"), float(air["last"][0])
            begins, ends = flights["start"].reshape(-1)[:count], flights["end"].reshape(-1)[:count]
            self._closed += [(float(a), min(float(b), last)) for a, b in zip(begins, ends)]
            air.set(ended=0)
        start = float(air["start"][0])
        return (*self._closed, *([(start, np.inf)] if start < LASTS else []))


SIGNALS = ("motors", "control", "gyro", "rates", "accel", "velocity", "attitude", "lift", "battery")


def _numbers(name: str, signal: Signal, full: float | None, gyro: str | None):
    """Samples of a signal as the front end takes them; None where it does not. full: voltage of a full battery, where motors are driven
    straight from it; gyro: the signal that tells angular rates."""
    value = signal.values if signal.valid.all() else np.where(signal.valid, signal.values, np.nan)
    if name == "battery" and full:
        ok = value[:, 0] > 0.5 * full
        return "voltage", signal.time[ok], value[ok, :1] / full
    if name == "lift" and not full and "voltage_ratio" in signal.columns:
        ratio = value[:, signal.columns.index("voltage_ratio")]
        ok = ratio > 0.3
        return "voltage", signal.time[ok], ratio[ok, None]
    if name == "rates":
        return (name, signal.time, value) if gyro == "rates" else None
    if name == "control":
        return name, signal.time, value[:, :4]
    return (name, signal.time, value) if name in ("motors", "gyro", "accel", "velocity", "attitude") else None
