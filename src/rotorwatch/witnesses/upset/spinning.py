"""Vehicles that spin and fly on with rotors off: since when, until when, and which rotors went off, one after the other or at once.

A vehicle without a rotor can still hold its thrust axis and its place if it gives up its heading (Mueller and D'Andrea, ICRA 2014). Such a
spin is no fall: the load shows that rotors carry it. Which of them are off engine/spin assesses from the controlled flight before on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.base.physics import G0
from rotorwatch.engine.definition import ENGINE, craft
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.tick_table import Sensed
from rotorwatch.engine.spin import many_ticks
from rotorwatch.engine.spin.rotors_off import RotorsOff
from rotorwatch.engine.spin.turning import CARRIES, PAUSE_S, RECOVERS_S, SINKS_M_S, SLOWEST_S, SPUN, SPUN_S, UPRIGHT
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.upset.loss_of_control import LossOfControl, held, thrust_axis

BEFORE_S, AFTER_S = 2.0, 5.0  # around the loss of control, in which it begins
CONTROLLED_S = 8.0  # before the spin that are used
CALM = 1.0  # rad/s: flight that shows the hover thrust
CALM_TICKS = 20  # of it, the first ones: a rotor may go off before anything turns fast


class Off(NamedTuple):
    """A rotor (from 0) that went off. onset, detected; end: when it came back, or None [all s]; probability."""

    rotor: int
    onset: float
    detected: float
    end: float | None
    probability: float


class FliesOn(NamedTuple):
    """since, until: of the spin in the air [s]; turns: per second; off: rotors in the order of their detection; trace: of the ticks so far,
    None where no controlled flight shows that all rotors worked before."""

    since: float
    until: float
    turns: float
    off: tuple[Off, ...] = ()
    trace: Trace | None = None


def find(flight: Flight, vehicle: Vehicle, left: LossOfControl, start: float, known: FliesOn | None = None) -> FliesOn | None:
    """The spin that follows a loss of control if the vehicle flies on in it, else None. start: of the flight [s]; known: the same as it
    looked before, on a link: only later ticks are followed."""
    turning = flight.angular_rate()
    if turning is None:
        return None
    rates = turning.between(left.onset - BEFORE_S, np.inf).wholes()
    span = _spin(rates, left.lost + AFTER_S)
    if span is None:
        return None
    since, until = span[0], min(span[1], np.inf if left.ground is None else left.ground)
    inside = (rates.time >= since) & (rates.time <= until)
    if until - since < SPUN_S or not _carried(flight, since, until):
        return None
    trace = known.trace if known is not None and known.since == since else None
    last = until if left.ground is not None else until + RECOVERS_S
    trace = _followed(flight, vehicle, min(left.onset, since), start, since, last, trace)
    turns = float(median(np.abs(rates.values[inside, 2]))) / (2.0 * np.pi)
    return FliesOn(since, until, turns, () if trace is None else trace.off(), trace)


def _spin(rates: Signal, latest: float) -> tuple[float, float] | None:
    """(since, until) s of the first lasting spin that begins before `latest` s."""
    fast = np.flatnonzero(np.abs(rates.values[:, 2]) > SPUN)
    if not fast.size:
        return None
    slow = (np.diff(rates.time[fast]) > PAUSE_S) & (np.diff(fast) > 1)  # missing samples are no pause
    runs = np.split(fast, np.flatnonzero(slow) + 1)
    for run in runs:
        since, until = float(rates.time[run[0]]), float(rates.time[run[-1]])
        if since > latest:
            return None
        if until - since >= SPUN_S:
            return since, until
    return None


def _carried(flight: Flight, since: float, until: float) -> bool:
    """True if rotors carry the vehicle, upright and without falling, as far as that is known."""
    if flight.has("velocity"):
        down = flight["velocity"].wholes().between(since, until).values[:, 2]
        if down.size and median(down) > SINKS_M_S:
            return False
    elif not flight.has("accel"):
        return False
    else:
        load = -median(flight["accel"].wholes().between(since, until).values[:, 2]) / G0
        if not CARRIES[0] < load < CARRIES[1]:
            return False
    if flight.has("attitude"):
        q, age = held(flight["attitude"], np.linspace(since, until, 50))
        if (age < 1.0).all() and median(thrust_axis(q)[:, 2]) < UPRIGHT:
            return False
    return True


def _followed(
    flight: Flight, vehicle: Vehicle, begun: float, start: float, since: float, until: float, trace: Trace | None
) -> Trace | None:
    """The ticks up to `until` s, from controlled flight before `begun` s on."""
    first = max(begun - CONTROLLED_S, start) if trace is None else trace.last
    part = replace(flight, signals={name: s.between(first - 3.0, until + 1.0) for name, s in flight.signals.items()})
    if not part.has("motors"):
        return trace
    thrust = allocation.rotor_thrusts(part, vehicle)
    if len(thrust) < 4:
        return trace
    how = tick_table.plan(part, thrust, 0.0)
    if how.dt > SLOWEST_S:
        return trace
    seen = tick_table.sense(part, thrust, how)
    if trace is None:
        hover = tick_table.known_hover(vehicle) or _hover(seen, first, since)
        if hover is None:
            return None
        trace = Trace(vehicle, how.dt, hover)
    trace.extend(seen, first, until)
    return trace


def _hover(seen: Sensed, first: float, until: float) -> float | None:
    """Mean share of full thrust per rotor that carries the vehicle, from calm flight; None with too little of it."""
    mean = seen.share.mean(axis=1)
    calm = seen.some & seen.rate_ok & seen.load_ok & (seen.time > first) & (seen.time < until) & (np.abs(seen.rate).max(axis=1) < CALM)
    calm &= (mean > 0.02) & (np.abs(seen.load - 1.0) < 0.3)
    which = np.flatnonzero(calm)[:CALM_TICKS]
    return float(median(mean[which] / seen.load[which])) if which.size >= CALM_TICKS // 2 else None


class Trace:
    """The rotors that went off, tick by tick, by the definition (engine/spin/rotors_off.py). last: time of the last tick [s]."""

    def __init__(self, vehicle: Vehicle, dt: float, hover: float):
        """dt: length of a tick [s]; hover: mean share of full thrust that carries the vehicle."""
        B = vehicle.effectiveness()
        self._craft, self._dt, self._hover = craft(B.shape[1], effectiveness=B), dt, hover
        self._state = ENGINE.new(RotorsOff)
        ENGINE.call(many_ticks.begin, self._state)
        self.last = -np.inf

    def extend(self, seen: Sensed, after: float, until: float) -> None:
        """Take in the ticks from `after` to `until` s."""
        inside = seen.time[(seen.time > after) & (seen.time <= until)]
        self.last = float(inside[-1]) if inside.size else self.last
        ENGINE.call(many_ticks.follow, self._state, self._craft, self._dt, self._hover, len(seen), seen.rows, after, until)

    def off(self) -> tuple[Off, ...]:
        """The rotors that went off; () where one did before all of them were seen to work."""
        if self._state["blind"][0]:
            return ()
        rows, count = self._state.part("all"), int(self._state["count"][0])
        columns = (rows[name].reshape(-1)[:count].tolist() for name in Off._fields)
        return tuple(Off(*one)._replace(end=None if one[3] >= LASTS else one[3]) for one in zip(*columns))
