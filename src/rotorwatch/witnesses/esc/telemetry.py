"""Usable ESC telemetry of a flight, in bins: frozen, silent, shifted and mixed-up records are found by comparison with the commands.

A rotor's command tells when its speed must have changed. Telemetry that stays the same to the last bit while the command moves is frozen;
telemetry that follows the commands only with a shift in time has another clock; telemetry that follows another rotor's command has the
wrong number. A value that never leaves 0 in flight is not connected.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.answer.wording import rotors, seconds
from rotorwatch.base.arrays import median
from rotorwatch.engine.motion import allocation
from rotorwatch.flight import Flight, Signal
from rotorwatch.stats.nonnegative import best_total

BIN_S = 0.5
LEAST_SHARE = 0.03  # of full thrust: smaller commands are not compared
FROZEN_S, FROZEN_SAMPLES = 2.0, 5
# Relative change, and steps of the telemetry's resolution, that a command must have changed by.
FROZEN_CHANGE, FROZEN_STEPS = 0.02, 4.0
SPEED_POWER, CURRENT_POWER = 0.5, 1.5  # of thrust
MOSTLY = 0.5  # share of the time in the air for which telemetry must be usable
GRID_S, SHIFT_MOST_S, SHIFT_LEAST_S = 0.1, 5.0, 0.45
SHIFT_FIT, SHIFT_BETTER = 0.6, 0.2  # least correlation of a shift, and least gain over none
ORDER_FIT, ORDER_BETTER, ORDINARY = 0.6, 0.3, 0.25
ORDER_MOVES = 0.005  # rms of what a rotor's thrust changes by from bin to bin beyond the others', share of itself


class Binned(NamedTuple):
    """T bins of BIN_S of a flight of n rotors, in the air only. Values are 1 where not valid.

    time (T,): middle of the bin [s]. thrust (T, n): commanded, share of full; power (T, n): mean square of speed [rad^2/s^2], known (T, n);
    current (T, n) [A], current_known; voltage (T, n) [V], voltage_known.

    The m reports that bins are made of: report_time (m,), speed (m, n) [rad/s] with speed_known, amps (m, n) [A] with amps_known, commanded
    (m, n): share of full thrust when they were made. width: of a bin [s]."""

    time: np.ndarray
    thrust: np.ndarray
    power: np.ndarray
    known: np.ndarray
    current: np.ndarray
    current_known: np.ndarray
    voltage: np.ndarray
    voltage_known: np.ndarray
    report_time: np.ndarray
    speed: np.ndarray
    speed_known: np.ndarray
    amps: np.ndarray
    amps_known: np.ndarray
    commanded: np.ndarray
    width: float = BIN_S


class Quantity(NamedTuple):
    """A quantity of all rotors: values (m, n) with valid (m, n)."""

    values: np.ndarray
    valid: np.ndarray


def quantity(esc: Signal, name: str, rotors_: int) -> Quantity:
    """A quantity (speed, current, voltage, temperature) of signal `esc` in the order of the rotors; invalid where there are no columns."""
    columns = [k for k, c in enumerate(esc.columns) if c.rstrip("0123456789") == name][:rotors_]
    if len(columns) < rotors_:
        shape = (len(esc), rotors_)
        return Quantity(np.zeros(shape), np.zeros(shape, bool))
    return Quantity(esc.values[:, columns], esc.valid[:, columns])


def read(flight: Flight, thrust: Signal, air: allocation.Spans) -> tuple[Binned | None, list[str]]:
    """(usable telemetry, sentences on the rest); (None, ..) where nothing is usable, and (None, []) where the log has no telemetry.

    thrust: commanded share of full thrust of each rotor, from `allocation.rotor_thrusts`. air: ((start, end), ...) s."""
    if not flight.has("esc") or not air:
        return None, []
    esc, n = flight["esc"], thrust.values.shape[1]
    speed, current, voltage = (quantity(esc, name, n) for name in ("speed", "current", "voltage"))
    inside = allocation.within(esc.time, air)
    notes: list[str] = []
    if inside.sum() < FROZEN_SAMPLES:
        return None, ["ESC telemetry was not logged in the air; it is not used."]
    usable = _reporting(speed, inside, notes)
    if not usable.any():
        return None, notes
    if (late := _shifted(esc.time, speed, usable, thrust, notes)) is not None:
        usable &= ~late
    speed = Quantity(speed.values, speed.valid & usable)
    commanded = allocation.hold(thrust.time, thrust.values, esc.time)
    still = frozen(esc.time, speed, commanded, SPEED_POWER, inside)
    still_current = frozen(esc.time, current, commanded, CURRENT_POWER, inside)
    _note_frozen(esc.time, still, notes)
    # An ESC that repeats its last report repeats all of it.
    speed = Quantity(speed.values, speed.valid & ~still)
    current = Quantity(current.values, current.valid & usable & ~still & ~still_current & _ever_above_zero(current, inside))
    bins = binned(esc.time, speed, current, voltage, thrust, air)
    if bins is None or not bins.known.any():
        return None, notes
    if _mixed_up(bins):
        notes.append(
            "ESC telemetry follows other rotors' commands better than its own: its ESCs are numbered differently, and it is not used."
        )
        return None, notes
    return bins, notes


def _reporting(speed: Quantity, inside, notes: list[str]) -> np.ndarray:
    """(n,) bool: rotors whose speed is reported in the air, and is not always 0. Adds a note on the others."""
    n = speed.valid.shape[1]
    there = speed.valid[inside].mean(axis=0) > MOSTLY * speed.valid[inside].mean(axis=0).max(initial=0.0)
    there &= speed.valid[inside].any(axis=0)
    first = inside & (np.cumsum(inside) <= max(FROZEN_SAMPLES, 0.3 * inside.sum()))
    turning = np.array([np.any(speed.values[first & speed.valid[:, k], k] > 0.0) for k in range(n)])
    if not (there & turning).any():
        notes.append("ESC telemetry reports no speed in flight (not connected, or the number of poles not set); it is not used.")
        return there & turning
    silent, idle = np.flatnonzero(~there) + 1, np.flatnonzero(there & ~turning) + 1
    if silent.size:
        notes.append(f"ESC telemetry of {rotors(silent.tolist())} is missing in flight; nothing is concluded from it.")
    if idle.size:
        notes.append(f"ESC telemetry of {rotors(idle.tolist())} reports no speed in flight; it is not used.")
    return there & turning


def _ever_above_zero(current: Quantity, inside) -> np.ndarray:
    """(n,) bool: currents that were ever above 0; those of ESCs without a sensor never are."""
    return np.array([np.any(current.values[inside & v, k] > 0.0) for k, v in enumerate(current.valid.T)])


def frozen(time, what: Quantity, commanded: np.ndarray, power: float, inside) -> np.ndarray:
    """(m, n) bool: samples in a stretch in which a value stays the same to the last bit though the command asks for a change.

    time (m,); commanded (m, n): share of full thrust; power: exponent of the quantity's dependence on thrust. A stretch is at least
    FROZEN_S and FROZEN_SAMPLES long. A value of 0 is a stopped rotor."""
    still = np.zeros(what.valid.shape, bool)
    for k in range(what.valid.shape[1]):
        at = np.flatnonzero(what.valid[:, k] & inside)
        if at.size < FROZEN_SAMPLES:
            continue
        x = what.values[at, k]
        steps = np.abs(np.diff(x))
        step = float(steps[steps > 0].min(initial=np.inf))
        if not np.isfinite(step):
            step = 0.0  # never moved at all
        edges = np.flatnonzero(np.r_[True, steps > 0, True])
        for a, b in itertools.pairwise(edges):
            if b - a < FROZEN_SAMPLES or time[at[b - 1]] - time[at[a]] < FROZEN_S or x[a] == 0.0:
                continue
            f = commanded[at[a:b], k]
            low, high = np.quantile(f, (0.05, 0.95))
            if low < LEAST_SHARE:
                continue
            change = ((high / low) ** power - 1.0) * x[a]
            if change > max(FROZEN_CHANGE * x[a], FROZEN_STEPS * step):
                still[at[a] : at[b - 1] + 1, k] = True
    return still


def _note_frozen(time, still: np.ndarray, notes: list[str]) -> None:
    for k in np.flatnonzero(still.any(axis=0)):
        at = np.flatnonzero(still[:, k])
        notes.append(
            f"ESC telemetry of {rotors([int(k) + 1])} does not change between {seconds(time[at[0]])} and {seconds(time[at[-1]])} while its "
            "command changes; it is not used there."
        )


def _shifted(time, speed: Quantity, usable, thrust: Signal, notes: list[str]) -> np.ndarray | None:
    """(n,) bool: rotors whose speed follows their command only with a shift in time, with a note; None where that is unknown."""
    start, end = max(time[0], thrust.time[0]), min(time[-1], thrust.time[-1])
    grid = np.arange(start, end, GRID_S)
    half = round(SHIFT_MOST_S / GRID_S)
    if grid.size < 6 * half:
        return None
    wide = round(0.5 / GRID_S)
    late = np.zeros(usable.size, bool)
    by = []
    for k in np.flatnonzero(usable):
        ok, sent = speed.valid[:, k], thrust.valid[:, k]
        if ok.sum() < 20 or sent.sum() < 20:
            continue
        w = np.interp(grid, time[ok], speed.values[ok, k] ** 2)
        f = np.interp(grid, thrust.time[sent], thrust.values[sent, k])
        moved, commanded = w[wide:] - w[:-wide], f[wide:] - f[:-wide]
        shifts, middle = range(-half, half + 1), slice(half, moved.size - half)
        fits = np.array([_correlation(np.roll(moved, -s)[middle], commanded[middle]) for s in shifts])
        best = int(np.argmax(fits))
        near = fits[half - round(SHIFT_LEAST_S / GRID_S) : half + round(SHIFT_LEAST_S / GRID_S) + 1].max()
        if fits[best] > SHIFT_FIT and fits[best] > near + SHIFT_BETTER:
            late[k] = True
            by.append(GRID_S * (best - half))
    # ESCs report over one link: a single rotor that seems shifted has stopped, or hit the ground.
    if np.count_nonzero(late) < max(2, 0.5 * np.count_nonzero(usable)):
        return None
    if late.any():
        way = "after" if median(by) > 0 else "before"
        who = rotors((np.flatnonzero(late) + 1).tolist())
        notes.append(
            f"ESC telemetry of {who} follows the commands {abs(median(by)):.1f} s {way} they were sent: its time stamps are wrong, "
            "and it is not used."
        )
    return late


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0


def _mixed_up(bins: Binned) -> bool:
    """True if speeds follow the commands in another order than that of their numbers."""
    # A stopped rotor follows no command.
    usual = np.quantile(np.where(bins.known, bins.power, 0.0), 0.75, axis=0)
    fine = (bins.known & (bins.thrust > LEAST_SHARE) & (bins.power > ORDINARY * usual)).all(axis=1)
    if fine.sum() < 20 or bins.known.shape[1] < 3:
        return False
    changes = [np.diff(np.log(v[fine]), axis=0) for v in (bins.power, bins.thrust)]
    # Its end is a jump that nothing else in the flight comes near to.
    changes = [np.clip(c, *(s * 5.0 * median(np.abs(c)) for s in (-1.0, 1.0))) for c in changes]
    w, f = (c - c.mean(axis=1, keepdims=True) for c in changes)
    if np.sqrt(np.square(f).mean()) < ORDER_MOVES:
        return False  # the rotors change alike: what differs is their delays
    fits = np.array([[_correlation(a, b) for b in f.T] for a in w.T])
    in_order = float(np.mean(np.diag(fits)))
    best = best_total(fits) / len(fits)
    return best > ORDER_FIT and best > in_order + ORDER_BETTER


def binned(time, speed: Quantity, current: Quantity, voltage: Quantity, thrust: Signal, air) -> Binned | None:
    """Means over bins of BIN_S within each stretch in the air; None without any. A bin counts for a rotor commanded to turn in it."""
    parts = []
    sent = thrust.whole
    sent_time, sent_values = thrust.time[sent], thrust.values[sent]
    for start, end in air:
        edges = np.arange(start, end, BIN_S)
        if edges.size < 2:
            continue
        lo, hi = edges[:-1], edges[1:]
        commanded, some = _means(sent_time, sent_values, np.ones(sent_values.shape, bool), lo, hi)
        commanded = np.where(some, commanded, allocation.hold(sent_time, sent_values, 0.5 * (lo + hi)))
        turning = commanded > LEAST_SHARE
        w2, known = _means(time, speed.values**2, speed.valid, lo, hi, turning)
        amps, amps_known = _means(time, current.values, current.valid, lo, hi, turning)
        volts, volts_known = _means(time, voltage.values, voltage.valid, lo, hi)
        parts.append((0.5 * (lo + hi), np.where(turning, commanded, 1.0), w2, known, amps, amps_known, volts, volts_known))
    if not parts:
        return None
    names = ("time", "thrust", "power", "known", "current", "current_known", "voltage", "voltage_known")
    binned_: dict[str, Any] = {name: np.concatenate(p) for name, p in zip(names, zip(*parts), strict=True)}
    sent = allocation.hold(sent_time, sent_values, time)
    reports = time, speed.values, speed.valid, current.values, current.valid, sent
    names = ("report_time", "speed", "speed_known", "amps", "amps_known", "commanded")
    return Binned(**binned_, **dict(zip(names, reports, strict=True)))


def _means(time, values, valid, lo, hi, count: Any = True) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the valid values with lo <= time < hi, 1 without any, and whether there is any: (T, n) both. count (T, n): which may."""
    zero = np.zeros((1, values.shape[1]))
    total = np.concatenate([zero, np.cumsum(np.where(valid, values, 0.0), axis=0)])
    counted = np.concatenate([zero, np.cumsum(valid, axis=0)])
    a, b = np.searchsorted(time, lo), np.searchsorted(time, hi)
    number = counted[b] - counted[a]
    some = (number > 0) & count
    return np.where(some, (total[b] - total[a]) / np.maximum(number, 1.0), 1.0), some
