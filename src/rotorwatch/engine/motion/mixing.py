"""Test of the mixer that flew: motor outputs compared with the rate controller's output of the same time.

An autopilot mixes the output c = (roll, pitch, yaw, throttle) of its rate controller into thrusts of all rotors, m(u) = g M c
(engine/intake/mixer.py). A log with both u and c therefore shows which mixer flew, whatever the weather and the condition of the rotors.
Differences between rotors are compared, in windows of `WINDOW_S`, so that neither gain nor collective counts:

    cost[k, j] = sum (y_k - g d_j)^2 / sum y_k^2,        y of m(u),  d of M c,  g^2 = sum y^2 / sum d^2

is 0 where output k follows the mixer's row j, 2 where they are unrelated, 4 where they are opposite. Sound logs have costs of 0.00 to
0.02 on the diagonal; loggers that sample outputs and controller at different moments of the loop have up to 2 everywhere, and nothing
follows from them. Each window votes: in upsets, at limits and while an output is overridden no row fits, and where the vehicle only yaws,
rotors with the same direction of rotation fit alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median, quantile
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.allocation import Spans, within
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle

WINDOW_S, LEAST, LEAST_WINDOWS = (4.0, 12, 3)  # length of a window, outputs in it, and windows with visible differences
RATE_HZ = 20.0  # smallest number of outputs examined, where there are so many
PAIR_S = 0.16  # outputs further than this from the rate controller's samples around them are not compared
ROUNDED = 1e-6  # demand: differences between rotors below this are rounding of an equal demand on all
SEEN = 0.0015  # share of full thrust: rms of differences between rotors, above what rounding to 1 us makes
LIMIT = 0.01  # share of full thrust from its ends within which a rotor may be limited
FOLLOWS, STRAYS = 0.2, 0.4  # cost up to which an output follows a row of the mixer, and from which it does not
BETTER = 4.0  # factor by which another explanation must lower the cost
LATEST_S, LAG_S, LATE_S = 3.0, 0.02, 0.06  # lags tried, in such steps; from which an output is late
OWN = 1.0  # nats in favour of the frame's own order
EXACT = 0.02  # cost below which a fit is no better
NEARLY_ALL = 0.8  # share of the windows that distinguish two rows
LEAST_FRAME, SHARE = 5, 0.2  # windows, and share of the informative ones, in which another mixer flew
SCALES = 0.7, 1.7  # gain by differences over that by level; sound logs have 0.97 to 1.03, old firmware up to 1.5
ALIKE = 1.4  # factor between those of most windows
STILL = 0.002  # share of the outputs' range: two microseconds
CHUNK = 1 << 15  # outputs times rotors times lags compared at once
SAME_S = 0.05  # lags of windows that differ by less are the same


@dataclass(frozen=True, eq=False, repr=False)
class Mixing:
    """Outputs and the rate controller's demand. time (m,) s, of outputs in the air of which none is at a limit; thrust (m, n): m(u);
    output (m, n): u; control: all complete samples; mixer (n, 4)."""

    time: np.ndarray
    thrust: np.ndarray
    output: np.ndarray
    control: Signal
    mixer: np.ndarray

    @cached_property
    def starts(self) -> np.ndarray:
        """First rows of the windows."""
        return np.flatnonzero(np.diff(np.floor(self.time / WINDOW_S), prepend=-np.inf))

    def costs(self, lag_s: float = 0.0, trim: bool = True) -> np.ndarray:
        """(windows, n, n), NaN in uninformative windows. lag_s: delay of outputs behind the demand. trim: include the means over each
        window, which hold no information on time."""
        y, d, of_y, of_d, gain, scale = (x[0] for x in self._compared(np.array([lag_s]), trim))
        both = np.add.reduceat(y[:, None] * d, self.starts, axis=2)
        return ((of_y[:, None] + gain**2 * of_d - 2.0 * gain * both) / scale[:, None]).transpose(2, 0, 1)

    def own(self, lags_s: np.ndarray) -> np.ndarray:
        """(lags, windows) mean cost of the outputs by their own rows, without trim: the mean of the diagonals of `costs`."""
        many = max(1, CHUNK // self.thrust.size)
        return np.concatenate([self._own(lags_s[k : k + many]) for k in range(0, len(lags_s), many)])

    def _own(self, lags_s: np.ndarray) -> np.ndarray:
        y, d, of_y, of_d, gain, scale = self._compared(lags_s, trim=False)
        return ((of_y + gain**2 * of_d - 2.0 * gain * np.add.reduceat(y * d, self.starts, axis=2)) / scale).mean(axis=1)

    def _compared(self, lags_s: np.ndarray, trim: bool) -> tuple[np.ndarray, ...]:
        """y, d (lags, n, m), y without its mean over each window unless `trim`; of each window the sums of their squares (lags, n,
        windows), the gain g (lags, 1, windows), NaN in uninformative ones, and the scale of costs (lags, n, windows). What is the same for
        all lags comes once."""
        n, paired, control = len(self.mixer), *self._asked(lags_s)
        paired = paired[:1] if paired.all() else paired
        count = np.add.reduceat(paired, self.starts, axis=2, dtype=float)
        y, d = (np.where(paired, x, 0.0) for x in (_apart(self.thrust.T), _apart(self.mixer) @ control))
        of_d = np.add.reduceat(d * d, self.starts, axis=2)
        if not trim:
            means, rows = np.add.reduceat(y, self.starts, axis=2) / np.maximum(count, 1.0), np.diff([*self.starts, len(self.time)])
            y = np.where(paired, y - np.repeat(means, rows, axis=2), 0.0)
            of_d -= np.add.reduceat(d, self.starts, axis=2) ** 2 / np.maximum(count, 1.0)
        of_y = np.add.reduceat(y * y, self.starts, axis=2)
        power = of_y.sum(axis=1, keepdims=True), of_d.sum(axis=1, keepdims=True)
        seen = (count >= LEAST) & (power[0] > count * n * SEEN**2) & (power[1] > count * n * ROUNDED**2)
        gain = np.sqrt(power[0] / np.where(seen, power[1], np.nan))
        # For a rotor that moves less than the others, these set the scale: it shows only rounding.
        scale = np.maximum(np.maximum(of_y, 0.1 * power[0] / n), 1e-12)
        return y, d, of_y, of_d, gain, scale

    def unexplained(self) -> np.ndarray:
        """(windows, n) share of each output's differences from the others that no mixer explains; 1 in uninformative windows, or where an
        output stands still, which shifts the mean of all."""
        paired, control = self._now
        y = self.thrust - self.thrust.mean(axis=1, keepdims=True)
        shares = np.ones((len(self.starts), len(self.mixer)))
        for w, (a, b) in enumerate(zip(self.starts, [*self.starts[1:], len(self.time)])):
            rows = np.arange(a, b)[paired[a:b]]
            if rows.size >= LEAST and (y[rows] ** 2).mean() > SEEN**2 and np.ptp(self.output[rows], axis=0).min() > 0.0:
                left = y[rows] - control[rows] @ np.linalg.lstsq(control[rows], y[rows], rcond=None)[0]
                shares[w] = (left**2).sum(axis=0) / np.maximum((y[rows] ** 2).sum(axis=0), 1e-12)
        return shares

    def scales(self) -> np.ndarray:
        """(windows,) gain of the mixer by differences between rotors, over that by their mean thrust: 1 where m is the curve assumed by
        the mixer. NaN where outputs do not follow their rows."""
        paired, control = self._now
        own = np.diagonal(self.costs(), axis1=1, axis2=2).max(axis=1)
        asked, scales = control @ self.mixer.T, np.full(len(self.starts), np.nan)
        for w, (a, b) in enumerate(zip(self.starts, [*self.starts[1:], len(self.time)])):
            if own[w] < 0.5 * FOLLOWS:
                rows = np.arange(a, b)[paired[a:b]]
                y, d = self.thrust[rows], asked[rows]
                apart = d - d.mean(axis=1, keepdims=True)
                scales[w] = (y * apart).sum() / (apart**2).sum() / (y.mean() / max(float(d.mean()), 1e-9))
        return scales

    @property
    def _now(self) -> tuple[np.ndarray, np.ndarray]:
        """(m,), (m, 4) of `_asked` at the time of the outputs."""
        paired, control = self._asked(np.zeros(1))
        return paired[0, 0], control[0].T

    def _asked(self, lags_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(lags, 1, m) bool, where the rate controller's output is known that long before an output, and that output (lags, 4, m)."""
        when, time = self.time - lags_s[:, None], self.control.time
        after = np.clip(np.searchsorted(time, when), 1, len(time) - 1)
        paired = (np.abs(when - time[after - 1]) < PAIR_S) & (np.abs(time[after] - when) < PAIR_S)
        return paired[:, None], np.stack([np.interp(when, time, column) for column in self.control.values.T], axis=1)


def _apart(x: np.ndarray) -> np.ndarray:
    """(n, m) less its mean over the rotors."""
    return x - x.mean(axis=0)


def mixing(flight: Flight, vehicle: Vehicle, air: Spans) -> Mixing | None:
    """The mixing of a flight; None without both signals, or without a known mixer."""
    if vehicle.mixer is None or not flight.has("motors", "control"):
        return None
    motors, control = flight["motors"], flight["control"].wholes()
    motors = motors.part(slice(None, None, max(1, int(motors.rate_hz / RATE_HZ))))
    ratio = allocation.battery_ratio(flight, motors.time)[:, None]
    thrust = allocation.mixer_curve(vehicle)(motors.values, ratio)
    free = ((thrust > LIMIT) & (thrust < (1.0 - LIMIT) * np.maximum(ratio, 1e-3))).all(axis=1)
    rows = within(motors.time, air) & motors.whole & free
    if rows.sum() < LEAST * LEAST_WINDOWS or len(control) < 2:
        return None
    return Mixing(motors.time[rows], thrust[rows], motors.values[rows], control, np.asarray(vehicle.mixer, float))


def order(costs: np.ndarray) -> tuple[int, ...] | None:
    """The row of the mixer that each output follows (0-based), where some follow those of other rotors; None where none does.

    costs (windows, n, n), of `Mixing.costs`. The order is that of the least sum of log costs; every output that moves needs
    `LEAST_WINDOWS` windows that distinguish its two rows, nearly all of them in favour of the other one.
    """
    costs = costs[np.isfinite(costs[:, 0, 0])]
    if len(costs) < LEAST_WINDOWS:
        return None
    logs, outputs = np.log(np.maximum(costs, EXACT)), np.arange(costs.shape[1])
    rows = _assigned(logs.sum(axis=0))
    gain = logs[:, outputs, outputs] - logs[:, outputs, rows]
    tells, fits = np.abs(gain) > np.log(BETTER), costs[:, outputs, rows] < FOLLOWS
    votes, count = (tells & (gain > 0.0) & fits).sum(axis=0), tells.sum(axis=0)
    moved = rows != outputs
    if not moved.any() or (votes < np.maximum(LEAST_WINDOWS, NEARLY_ALL * count))[moved].any():
        return None
    return tuple(int(k) for k in rows)


def _assigned(cost: np.ndarray) -> np.ndarray:
    """(n,) a row of the mixer for each output, all different, for which no exchange of two lowers the sum of costs (n, n)."""
    n, rows = len(cost), np.full(len(cost), -1)
    cost = cost - OWN * np.eye(n)  # rotors with equal commands keep their places
    for output, row in zip(*np.unravel_index(cost.argsort(axis=None), cost.shape)):  # the most probable first
        if rows[output] < 0 and row not in rows:
            rows[output] = row
    while True:
        own = cost[np.arange(n), rows]
        swapped = cost[:, rows] + cost[:, rows].T - own[:, None] - own  # by exchanging the rows of two outputs
        i, j = np.unravel_index(swapped.argmin(), swapped.shape)
        if swapped[i, j] > -1e-9:
            return rows
        rows[[i, j]] = rows[[j, i]]


def confirmed(found: Mixing | None) -> bool:
    """Return whether the outputs follow the frame's mixer, in most informative windows."""
    own = np.zeros(0) if found is None else np.diagonal(found.costs(), axis1=1, axis2=2).max(axis=1)
    own = own[np.isfinite(own)]
    return len(own) >= LEAST_WINDOWS and bool((own < FOLLOWS).mean() > 0.5)


def outputs_in_another_order(found: Mixing | None) -> str | None:
    """Outputs that follow the mixer's demand on other rotors: their places in the log or its parameters differ from those in the air."""
    if found is None:
        return None
    # Trim may be equal for rotors that motion distinguishes, and a logger's timing may blur the motion but not the trim.
    rows = next((rows for trim in (True, False) if (rows := order(found.costs(trim=trim))) is not None), None)
    if rows is None:
        return None
    moved = [f"output {k + 1} as motor {row + 1}" for k, row in enumerate(rows) if row != k]
    return (
        f"the motor outputs are not in the frame's order: the rate controller's demand moves {', '.join(moved)}. No rotor is "
        "diagnosed until output functions and frame are those that flew."
    )


def outputs_of_another_mixer(found: Mixing | None) -> str | None:
    """Outputs that follow the rate controller exactly, but by another mixer than the frame's."""
    if found is None:
        return None
    costs = found.costs()
    own, left = np.diagonal(costs, axis1=1, axis2=2), found.unexplained()
    seen = np.isfinite(own[:, 0])
    against = (own > STRAYS) & (own > BETTER * left) & (left < FOLLOWS)
    share = against.sum(axis=0) / max(int(seen.sum()), 1)
    astray = [str(k + 1) for k in np.flatnonzero((against.sum(axis=0) >= LEAST_FRAME) & (share > SHARE))]
    if not astray:
        return None
    which = f"motor output{'s' if len(astray) > 1 else ''} {', '.join(astray)}"
    return (
        f"{which} follow{'' if len(astray) > 1 else 's'} the rate controller by a mixer other than the frame's: frame, rotor positions or "
        "directions of rotation are not those that flew."
    )


class Lag(NamedTuple):
    """Delay of outputs behind the demand, from a time on [s]."""

    start: float
    seconds: float


def lags(found: Mixing) -> tuple[Lag, ...] | None:
    """Delays of the outputs: () where they have the rate controller's clock, one lag, or two with a step between them; None where the
    windows show many lags.

    Each window has the lag at which its differences fit best; one that fits at none is ignored.
    """
    now = found.own(np.zeros(1))
    if not (now > STRAYS * FOLLOWS).sum() > 0.5 * LEAST_WINDOWS:
        return ()
    tried = np.concatenate([-np.arange(LAG_S, LATEST_S, LAG_S)[::-1], np.arange(0.0, LATEST_S, LAG_S)])
    costs = found.own(tried)
    costs[np.isnan(costs)] = np.inf
    best, rows = costs.argmin(axis=0), np.arange(costs.shape[1])
    telling = (costs[best, rows] < FOLLOWS) & (BETTER * costs[best, rows] < np.maximum(median(costs, axis=0), 1e-9))
    found_lags, starts = tried[best][telling], found.time[found.starts][telling]
    late = np.abs(found_lags) > LATE_S
    if late.sum() < LEAST_WINDOWS:
        return ()
    spread = [_spread(found_lags[:k]) + _spread(found_lags[k:]) for k in range(len(starts))]
    k = int(np.argmin(spread))
    k = 0 if spread[0] <= spread[k] + SAME_S else k
    if spread[k] > SAME_S * len(starts) or 0 < k < LEAST_WINDOWS or len(starts) - k < LEAST_WINDOWS:
        return None
    parts = [Lag(-np.inf, float(median(found_lags[:k] if k else found_lags)))]
    if k:  # a clock that is set leaves a gap, or samples that overlap
        near = np.flatnonzero((found.time >= starts[k - 1]) & (found.time <= starts[k] + WINDOW_S))
        gap = near[:-1][np.argmax(np.diff(found.time[near]))] + 1
        parts.append(Lag(float(found.time[gap]), float(median(found_lags[k:]))))
    return tuple(part._replace(seconds=0.0) if abs(part.seconds) <= LATE_S else part for part in parts)


def _spread(x: np.ndarray) -> float:
    """Sum of the distances from the median."""
    return float(np.abs(x - median(x)).sum()) if x.size else 0.0


def aligned(flight: Flight, vehicle: Vehicle, air: Spans) -> Flight:
    """The flight with outputs on the clock of the rate controller, and a warning where they were not."""
    found = mixing(flight, vehicle, air)
    late = lags(found) if found is not None else None
    if not late:
        return flight
    motors = flight["motors"]
    part = np.searchsorted([lag.start for lag in late], motors.time, side="right") - 1
    time = motors.time - np.array([lag.seconds for lag in late])[part]
    by_time = np.argsort(time, kind="stable")
    motors = motors.with_arrays(time[by_time], motors.values[by_time], np.ascontiguousarray(motors.valid[by_time]))
    reported = [
        f"{abs(lag.seconds):.2f} s {'later' if lag.seconds > 0.0 else 'earlier'}"
        f"{'' if lag.start == -np.inf else f' from {lag.start:.1f} s on'}"
        for lag in late
        if lag.seconds
    ]
    warning = (
        f"motors ({motors.source}): logged {', '.join(reported)} than the rate controller's output that they follow; moved to its clock."
    )
    return replace(flight, signals={**flight.signals, "motors": motors}, warnings=(*flight.warnings, warning))


def outputs_of_another_range(found: Mixing | None) -> str | None:
    """Outputs whose thrust, by the curve of the parameters, is not that mixer's demand from the rate controller."""
    scales = np.zeros(0) if found is None else found.scales()
    scales = scales[np.isfinite(scales)]
    if len(scales) < LEAST_FRAME or quantile(scales, 0.9) > ALIKE * quantile(scales, 0.1):
        return None  # a wrong curve affects every window alike
    if SCALES[0] < (typical := float(median(scales))) < SCALES[1]:
        return None
    return (
        f"the motor outputs differ from each other {typical:.2g} times as much as the rate controller demands at their thrust: the "
        "range of the outputs or the thrust curve in the parameters is not the one that flew."
    )


def outputs_that_never_move(flight: Flight, air: Spans) -> str | None:
    """Outputs that stand still through a flight in which the others move: no autopilot commands that of a rotor in use."""
    if not flight.has("motors"):
        return None
    motors = flight["motors"]
    rows = within(motors.time, air)
    known = motors.valid[rows]
    low, high = allocation.output_range(flight)
    values = np.where(known, motors.values[rows], np.nan)
    if len(values) < LEAST * LEAST_WINDOWS:
        return None
    moves = np.array([np.ptp(x[~np.isnan(x)]) if (~np.isnan(x)).any() else 0.0 for x in values.T]) > STILL * (high - low)
    if moves.all() or moves.sum() < 2:
        return None
    still = [(k + 1, values[:, k][~np.isnan(values[:, k])]) for k in np.flatnonzero(~moves)]
    at = ", ".join(f"{k} ({x[0]:.4g})" if x.size else f"{k} (no value)" for k, x in still)
    return (
        f"motor output{'s' if len(still) > 1 else ''} {at} never move{'' if len(still) > 1 else 's'} in flight while the others do: the "
        "log does not show what drove these motors."
    )
