"""Samples as they come -> ticks as they are known: the front end of `diagnose`, gone on with piece by piece.

Nothing is computed here: what the functions of `motion` make of a whole flight they make of its last seconds, with what they have
learned before. Pieces of any length give the same ticks (docs/watch.md says what a live observer cannot know).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.window import KEPT_S, Growing, Window, copied
from rotorwatch.motion import allocation, ticks
from rotorwatch.motion.airborne import Airborne, commands
from rotorwatch.motion.allocation import Comparison, Learned, Spans
from rotorwatch.motion.contact import Shaken
from rotorwatch.motion.ticks import Plan, Sensed

LATE_S = 0.9  # a signal that is this much behind the others is not waited for; less than the second after lift-off that nobody judges
AIR_S = 0.2  # nor does anybody ask at once whether the vehicle flies
FORGET_S = 1.0  # between two clearings of what is not needed any more
FIRST, FIRST_S, LEAST = 64, 20.0, 20  # commands from which a flight is planned, or so long and so many
BACK_S = 2.0
SUM_S = 1e-9  # by which two sums of the same times may differ: a tick does not wait for the next sample because of that
COMMANDS = ("motors", "lift", "battery")
CHANGED = 1.2  # factor by which a rate must change to be another one


@dataclass(frozen=True)
class Piece:
    """What has become known. sensed: ticks; check, command: comparisons and the outputs logged in them; motors, thrust: outputs that
    were logged. Each may be None. spans: when the vehicle was in the air, known up to `air_s`."""

    spans: Spans
    air_s: float
    sensed: Sensed | None = None
    check: Comparison | None = None
    command: np.ndarray | None = None
    motors: Signal | None = None
    thrust: np.ndarray | None = None


class Stream:
    """One vehicle's samples, cut into ticks. plan: how, once enough has come; None before."""

    def __init__(self, about: Flight, vehicle: Vehicle, ready_s: float):
        """about: what is known of the flight besides its signals. ready_s: blind time after lift-off."""
        self.window, self.vehicle = Window(about), vehicle
        self.plan: Plan | None = None
        self._ready_s, self._air = ready_s, Airborne()
        self._learned, self._shaken, self._checks = Learned(), Shaken(), None
        self._mixing, self._planned_aloft = False, False
        self._thrust: Growing | None = None
        self._compared = self._rebuilt = self._logged = -np.inf  # up to when
        self._forgot = -np.inf
        self._last, self._waiting = -1, np.empty(0, np.int64)

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of the flight, in time order."""
        self.window.add(signals, messages)

    def finish(self, duration: float) -> Piece | None:
        """The rest, of a flight that has ended after `duration` s."""
        piece = self.advance(np.inf, max(duration, self.window.now))
        return None if piece is None else replace(piece, spans=self._air.intervals(), air_s=np.inf)

    def advance(self, complete: float | None = None, end: float | None = None) -> Piece | None:
        """What has become known; None before the flight is planned. complete: time up to which all samples have been added, where that
        is known; None on a link, where samples of one signal may be behind those of another."""
        now = self.window.now
        if self.plan is None and not self._begin(now):
            self.window.forget(now - 60.0)
            return None
        self._follow_air(now, complete if end is None else end, end)
        check, command = self._compare()
        until = now if complete is None else complete
        motors, thrust = self._log(until)
        self._rebuild(motors, thrust, until, check)
        sensed = self._sense(now, complete)
        if now > self._forgot + FORGET_S:
            self._forget(now)
        return Piece(self._air.spans(), self._air.now, sensed, check, command, motors, thrust)

    @property
    def due_s(self) -> float:
        """Time from which there may be another tick: nothing need be asked for before."""
        if self.plan is None:
            return self.window.now + AIR_S
        waits = self._waiting[0] if self._waiting.size else self._last + 1
        known = (
            float(self.plan.first + self.plan.dt * waits) + self.plan.lag_s + max(self.plan.half.values(), default=0.0)
        )
        return min(known - SUM_S, self.window.now + AIR_S)

    def replanned(self) -> Flight | None:
        """At the first lift-off: the flight that is kept, when its rates are not those that it was planned by, so that it must be begun
        anew; None when all is well."""
        if self._planned_aloft or not self._air.spans() or self.plan is None:
            return None
        self._planned_aloft = True
        flight = self.window.flight(self.window.now - KEPT_S)
        mixing = allocation.faster_control(flight)
        thrust = self._thrust.since(-np.inf) if self._thrust is not None and mixing == self._mixing else None
        thrust = allocation.motor_thrusts(flight, self.vehicle) if thrust is None else thrust
        if len(thrust) < LEAST:
            return None
        new, old = ticks.plan(flight, thrust, self._ready_s), self.plan
        if (new.dt, new.gyro, new.accel, mixing) != (old.dt, old.gyro, old.accel, self._mixing):
            return flight
        if any(not 1 / CHANGED < new.period[name] / old.period[name] < CHANGED for name in new.period):
            self.plan = replace(old, half=new.half, period=new.period)
        return None

    def _begin(self, now: float) -> bool:
        flight = self.window.flight(-np.inf)
        if not flight.has("motors"):
            return False
        motors = flight["motors"]
        if len(motors) < LEAST or (len(motors) < FIRST and now - motors.time[0] < FIRST_S):
            return False
        self._mixing = allocation.faster_control(flight)
        thrust = allocation.motor_thrusts(flight, self.vehicle)
        if self._mixing:
            check = allocation.compare(flight, self.vehicle)
            self._mixing = len(check.time) > 0
            if self._mixing:
                thrust = allocation.better(thrust, allocation.rebuilt(flight, self.vehicle, check))
        self.plan = ticks.plan(flight, thrust, self._ready_s)
        return True

    def _follow_air(self, now: float, complete: float | None, end: float | None) -> None:
        until = now if complete is None else complete
        if complete is None:
            for name in ("motors", "accel", "gyro", "velocity"):
                if name in self.window.names:
                    until = min(until, max(self.window.newest(name), now - LATE_S))
        if until < self._air.now + (AIR_S if end is None else 0.0):
            return
        time, command = commands(self.window.flight(self._air.now, ("motors",)))
        given = slice(max(np.searchsorted(time, self._air.now, "right") - 1, 0), np.searchsorted(time, until, "right"))
        if given.start < given.stop:
            names = ("motors", "accel", "gyro", "velocity")
            self._air.on(self.window.flight(self._air.now - BACK_S, names), time[given], command[given], until)

    def _compare(self) -> tuple[Comparison | None, np.ndarray | None]:
        """Outputs held against the mixer, all that have a later sample of the controller."""
        if "control" not in self.window.names or "motors" not in self.window.names:
            return None, None
        flight = self.window.flight(self._compared - BACK_S, (*COMMANDS, "control"))
        control, motors = flight["control"], flight["motors"]
        known = control.time[control.valid.all(axis=1)]
        if not len(known):
            return None, None
        new = slice(
            np.searchsorted(motors.time, self._compared, "right"), np.searchsorted(motors.time, known[-1], "right")
        )
        if new.start >= new.stop:
            return None, None
        part = motors.part(new)
        self._compared = float(part.time[-1])
        check = allocation.compare(
            copied(flight, signals={**flight.signals, "motors": part}), self.vehicle, self._learned
        )
        if not len(check.time):
            return None, None
        return check, allocation.hold(part.time, part.values, check.time)

    def _log(self, until: float) -> tuple[Signal | None, np.ndarray | None]:
        """Outputs that have been logged, and the thrusts of these."""
        if "motors" not in self.window.names:
            return None, None
        flight = self.window.flight(self._logged, COMMANDS)
        time = flight["motors"].time
        new = slice(np.searchsorted(time, self._logged, "right"), np.searchsorted(time, until, "right"))
        if new.start >= new.stop:
            return None, None
        motors = flight["motors"].part(new)
        self._logged = float(motors.time[-1])
        thrust = allocation.motor_thrusts(copied(flight, signals={**flight.signals, "motors": motors}), self.vehicle)
        return motors, thrust.values

    def _rebuild(
        self, motors: Signal | None, thrust: np.ndarray | None, until: float, check: Comparison | None
    ) -> None:
        """The thrusts that ticks are made of."""
        if not self._mixing:
            if motors is not None and thrust is not None:
                self._extend(motors.with_arrays(motors.time, thrust, motors.valid))
            return
        if check is not None:
            self._checks = check if self._checks is None else self._checks + check
        if self._checks is None:
            return
        flight = self.window.flight(self._rebuilt - BACK_S, (*COMMANDS, "control"))
        time = flight["control"].time
        new = slice(np.searchsorted(time, self._rebuilt, "right"), np.searchsorted(time, until, "right"))
        if new.start >= new.stop:
            return
        control = flight["control"].part(new)
        piece = copied(flight, signals={**flight.signals, "control": control})
        logged = allocation.motor_thrusts(piece, self.vehicle)
        self._extend(allocation.better(logged, allocation.rebuilt(piece, self.vehicle, self._checks)))
        self._rebuilt = float(control.time[-1])
        old = np.searchsorted(self._checks.known, self._rebuilt - 1.0)
        self._checks = self._checks[max(old - 1, 0) :]

    def _extend(self, thrust: Signal) -> None:
        if self._thrust is None:
            self._thrust = Growing(thrust)
        self._thrust.add(thrust)
        assert self.plan is not None
        new = self.plan.numbers(thrust.time, self._last)
        if new.size:
            self._last = int(new[-1])
            self._waiting = np.concatenate([self._waiting, new])

    def _sense(self, now: float, complete: float | None) -> Sensed | None:
        """The ticks for which all is known that happened in them."""
        plan, window = self.plan, self.window
        if not self._waiting.size or self._thrust is None:
            return None
        assert plan is not None
        hi = plan.ends(self._waiting)
        end = hi + plan.lag_s + plan.dt / 2.0
        ready = np.ones(hi.size, bool) if complete is None else end <= complete
        for name, half in plan.half.items():
            # Motion is averaged around a lag after its commands, and these are at the latest at the end of the tick.
            known = hi + plan.lag_s + half <= window.newest(name) + SUM_S
            ready &= known | (now - end > LATE_S) | (complete == np.inf)
        count = int(np.argmin(ready)) if not ready.all() else hi.size
        if not count:
            return None
        hi = hi[:count]
        start = min(hi[0] - plan.dt - BACK_S, self._shaken.time - BACK_S)
        flight = window.flight(start, (*plan.half, "attitude"))
        sensed = ticks.sense(flight, self._thrust.since(start), hi, plan, self._shaken)
        self._waiting = self._waiting[count:]
        return sensed

    def _forget(self, now: float) -> None:
        self._forgot = now
        assert self.plan is not None
        waiting = self.plan.ends(self._waiting[:1])
        oldest = min([now, self._air.now, self._logged, *waiting.tolist()])
        before = max(oldest, now - 60.0) - KEPT_S
        self.window.forget(before)
        if self._thrust is not None:
            self._thrust.forget(before)
