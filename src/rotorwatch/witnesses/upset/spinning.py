"""Vehicles that spin and fly on with rotors off: since when, until when, and which rotors went off, one after the other or at once.

A vehicle without a rotor can still hold its thrust axis and its place if it gives up its heading (Mueller and D'Andrea, ICRA 2014). Such a
spin is no fall: the load shows that rotors carry it. Which of them are off is judged by `subsets`, from the controlled flight before on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.engine.events.decisions import CERTAIN
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.tick_table import Sensed
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.upset.loss_of_control import SPUN, SPUN_S, LossOfControl, held, thrust_axis
from rotorwatch.witnesses.upset.subsets import AVERAGE_S, Motion, Subsets

PAUSE_S = 1.0  # shorter pauses do not end a spin
BEFORE_S, AFTER_S = 2.0, 5.0  # around the loss of control, in which it begins
CARRIES = 0.5, 1.7  # g along the thrust axis, median: rotors carry the vehicle; asked only where the velocity is unknown
SINKS_M_S = 2.0  # down, median: faster is a fall
UPRIGHT = 0.5  # cosine of the tilt, median
CONTROLLED_S = 8.0  # before the spin that are used
WORKED_S = 1.5  # of controlled flight in which no rotor is off, to compare with
CALM = 1.0  # rad/s: flight that shows the hover thrust
CALM_TICKS = 20  # of it, the first ones: a rotor may go off before anything turns fast
# Standard deviations, root mean square over a second: beyond, even the likeliest set does not explain the motion, and none is named.
FITS, FITS_S = 1.7, 1.0
SLOWEST_S = 0.2  # ticks: slower ones are no averages
IDLE, IDLE_S = 0.3, 0.5  # mean demand in hover thrusts, and for how long: it has landed, or falls
SHOWS_S = 1.0  # after its onset, a rotor off is likelier than not
BACK_S, RECOVERS_S = 1.0, 5.0  # a rotor that gives thrust again for this long has come back; after a spin, which ends then


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
    first = max(begun - CONTROLLED_S, start) if trace is None else trace.when[-1]
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
        trace = Trace(vehicle.effectiveness(), how.dt, hover)
    trace.extend(seen, first, until)
    return trace if len(trace.when) > 2 else None


def _hover(seen: Sensed, first: float, until: float) -> float | None:
    """Mean share of full thrust per rotor that carries the vehicle, from calm flight; None with too little of it."""
    mean = seen.share.mean(axis=1)
    calm = seen.some & seen.rate_ok & seen.load_ok & (seen.time > first) & (seen.time < until) & (np.abs(seen.rate).max(axis=1) < CALM)
    calm &= (mean > 0.02) & (np.abs(seen.load - 1.0) < 0.3)
    which = np.flatnonzero(calm)[:CALM_TICKS]
    return float(median(mean[which] / seen.load[which])) if which.size >= CALM_TICKS // 2 else None


class Trace:
    """The chain over sets of rotors, tick by tick. when: times of the ticks [s]."""

    def __init__(self, B: np.ndarray, dt: float, hover: float):
        """B (4, n): effectiveness; dt: length of a tick [s]; hover: mean share of full thrust that carries the vehicle."""
        self._chain, self._dt, self._hover = Subsets(B, dt), dt, hover
        self.when: list[float] = []
        self._log_likelihood: list[np.ndarray] = []
        self._off: list[np.ndarray] = []  # (n,) probability that each rotor is off
        self._misfit: list[float] = []
        self._idle = 0.0  # s

    def extend(self, seen: Sensed, after: float, until: float) -> None:
        """Take in the ticks from `after` to `until` s."""
        chain, share, push = self._chain, seen.share / self._hover, seen.rows["push"]
        ok = seen.some & seen.rate_ok & seen.load_ok & (seen.time > after) & (seen.time <= until)
        for k in np.flatnonzero(ok):
            self._idle = self._idle + self._dt if share[k].mean() < IDLE else 0.0
            if self._idle > IDLE_S:
                return
            force = np.array([push[k, 0], push[k, 1], -G0 * seen.load[k]])
            chain.step(Motion(share[k], seen.rate[k], seen.rate_dot[k], force))
            self.when.append(float(seen.time[k]))
            self._log_likelihood.append(chain.log_likelihood)
            self._off.append(chain.probability @ chain.off)
            self._misfit.append(chain.misfit)

    def off(self) -> tuple[Off, ...]:
        """The rotors that went off; () where one did before all of them were seen to work."""
        when, p = np.array(self.when), np.array(self._off)
        logs = np.array(self._log_likelihood)[:, int(np.argmax(self._chain.power))]
        lasts = max(1, round(FITS_S / self._dt))
        square = np.convolve(np.nan_to_num(self._misfit) ** 2, np.ones(lasts), "full")[: len(when)]
        found = [o for i in range(p.shape[1]) for o in _changes(when, p[:, i], square <= FITS**2 * lasts, i, self._dt)]
        found.sort(key=lambda o: (o.detected, o.rotor))
        found = [self._with_onset(o, found, when, logs, p[:, o.rotor]) for o in found]
        return () if any(o.onset < when[0] + WORKED_S for o in found) else tuple(found)

    def _with_onset(self, one: Off, found: list[Off], when: np.ndarray, logs: np.ndarray, p: np.ndarray) -> Off:
        """The time from which the ticks are likelier with the rotor off, among those already off, less half of an average."""
        others = {o.rotor for o in found if o.detected <= one.detected and o is not one and (o.end is None or o.end > one.detected)}
        # Of rotors that go off together each is compared with the set of them all.
        before = {i for i in others if any(o.rotor == i and o.detected < one.detected - AVERAGE_S for o in found)}
        known = {who: h for h, who in enumerate(self._chain.sets)}
        with_it, without = known.get(tuple(sorted({*others, one.rotor}))), known.get(tuple(sorted(before)))
        last = int(np.searchsorted(when, one.detected, side="right"))
        unlikely = np.flatnonzero(p[:last] < 0.5)
        if with_it is None or without is None or not unlikely.size:
            return one
        begin = int(np.searchsorted(when, when[unlikely[-1]] - SHOWS_S))
        gained = np.cumsum((logs[begin:last, with_it] - logs[begin:last, without])[::-1])[::-1]
        return one._replace(onset=float(when[begin + int(np.argmax(gained))]) - 0.5 * AVERAGE_S)


def _changes(when: np.ndarray, p: np.ndarray, fits: np.ndarray, rotor: int, dt: float) -> list[Off]:
    """Every time that a rotor goes off. p (K,): probability that it is; fits (K,) bool: the likeliest set explains the motion."""
    sure = (p >= CERTAIN) & fits
    clear = (p < 1.0 - CERTAIN) & fits
    found, k, lasts = [], 1, round(BACK_S / dt)
    while k < len(when):
        if not (sure[k] and sure[k - 1]):
            k += 1
            continue
        back = next((j for j in range(k + 1, len(when) - lasts) if clear[j : j + lasts].all()), None)
        found.append(Off(rotor, float(when[k]), float(when[k]), None if back is None else float(when[back]), float(p[k:back].max())))
        if back is None:
            break
        k = back + 1
    return found
