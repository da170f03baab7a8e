"""Samples as they come -> the diagnoser: those of one signal in the order of time, those of different signals as the link brings them.

Pieces of any length give the same ticks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from rotorwatch.engine.diagnoser import Diagnoser, Judged
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.airborne import Gap
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.deviations import Override
from rotorwatch.engine.motion.samples import SIGNALS, samples
from rotorwatch.engine.motion.ticks import READY_KNOWN_S, READY_S, Plan, plan
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.account import Account
from rotorwatch.live.window import WINDOW_S, Window

LOOK_S = 0.2  # at least so often it is asked whether the vehicle flies
FORGET_S = 1.0  # between two clearings of what is not needed any more
FIRST, FIRST_S, LEAST = 64, 20.0, 20  # commands from which a flight is planned, or so long and so many
SUM_S = 1e-9  # by which two sums of the same times may differ: a tick does not wait for the next sample because of that
CHANGED = 1.2  # factor by which a rate must change to be another one


@dataclass(frozen=True)
class Piece:
    """What has become certain. judged: ticks; spans: when it was in the air, one that lasts without an end; overrides: all so far."""

    spans: Spans
    judged: Judged | None = None
    overrides: tuple[Override, ...] = ()


class Stream:
    """One vehicle's samples, their diagnoser, and its way back; None before enough has come to plan how they are cut into ticks."""

    def __init__(self, about: Flight, vehicle: Vehicle):
        """about: what is known of the flight besides its signals."""
        self.window, self.vehicle = Window(about), vehicle
        self.diagnoser: Diagnoser | None = None
        self.account: Account | None = None
        self._mixing, self._planned_aloft = False, False
        self._fed: dict[str, float] = {}  # signal -> time of its last sample that was fed
        self._messages: list[Message] = []
        self._forgot = -np.inf

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of the flight, in time order."""
        messages = list(messages)
        self.window.add(signals, messages)
        self._messages += messages

    def advance(self) -> Piece | None:
        """What has become certain; None before the flight is planned."""
        diagnoser = self.diagnoser or self._begin()
        if diagnoser is None:
            self.window.forget(self.window.now - 60.0)
            return None
        piece = self._piece(diagnoser, self._feed(diagnoser))
        if self.window.now > self._forgot + FORGET_S:
            self._forgot = self.window.now
            self.window.forget(self.window.now - WINDOW_S)
        return piece

    def finish(self, duration: float) -> Piece | None:
        """The rest, of a flight that has ended after `duration` s."""
        diagnoser = self.diagnoser or self._begin()
        if diagnoser is None:
            return None
        judged = [*self._feed(diagnoser), *diagnoser.finish(max(duration, self.window.now))]
        return self._piece(diagnoser, judged)

    @property
    def plan(self) -> Plan | None:
        """How the samples are cut into ticks."""
        return None if self.diagnoser is None else self.diagnoser.plan

    @property
    def due_s(self) -> float:
        """Time from which there may be another tick: nothing need be asked for before."""
        if self.diagnoser is None:
            return self.window.now + LOOK_S
        how = self.diagnoser.plan
        end = self.diagnoser.tick_end_s + how.lag_s + max(how.half.values(), default=0.0) - SUM_S
        return min(end, self.window.now + LOOK_S)

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that have been missing for longer than a gap, in the flight that goes on or was the last."""
        return () if self.diagnoser is None else self.diagnoser.missing

    def replanned(self) -> Flight | None:
        """At the first lift-off: the flight that is kept, when its rates are not those that it was planned by, so that it must be begun
        anew; None when all is well."""
        diagnoser = self.diagnoser
        if self._planned_aloft or diagnoser is None or not diagnoser.spans:
            return None
        self._planned_aloft = True
        flight = self.window.flight(self.window.now - WINDOW_S)
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
        self._mixing = allocation.faster_control(flight)
        commands = flight["control" if self._mixing else "motors"]
        dynamics = (self.vehicle.identified or {}).get("dynamics")
        how = plan(flight, commands, READY_KNOWN_S if dynamics else READY_S)
        if dynamics and dynamics.get("dt") != how.dt:
            dynamics = None  # the noise of healthy flights at another rate is not this one's
        if not (dynamics and how.gyro == "gyro"):
            how = plan(flight, commands, READY_S)
        craft = allocation.laid_out(self.vehicle, flight)
        self.diagnoser = Diagnoser(self.vehicle, craft, how, self._mixing, dynamics)
        self.account = Account(self.diagnoser)
        return self.diagnoser

    def _piece(self, diagnoser: Diagnoser, parts: list[Judged]) -> Piece:
        judged = Judged.joined(parts)
        if judged is not None and self.account is not None:
            self.account.add(judged)
        return Piece(diagnoser.spans, judged, diagnoser.overrides)

    def _feed(self, diagnoser: Diagnoser) -> list[Judged]:
        """All that has come since the last time."""
        window, signals = self.window, {}
        for name in window.names:
            since = self._fed.get(name, -np.inf)
            if window.newest(name) > since and name in SIGNALS:
                signal = window.flight(since, (name,))[name]
                signals[name] = signal.part(slice(int(np.searchsorted(signal.time, since, "right")), None))
                self._fed[name] = window.newest(name)
        messages, self._messages = self._messages, []
        battery = "battery" in window.names
        return diagnoser.feed(samples(signals, messages, self.vehicle, diagnoser.plan.gyro, battery))
