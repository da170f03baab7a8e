"""The mathematics of the ESC consistency check: deviations of a rotor's speed and current from its command and the other rotors, and the
causes that they imply.

Thrust T of a propeller goes with its speed squared, T = k W^2, and the current of its motor with a power of the speed (torque goes with
W^2, power with W^3; M. Drela, First-Order DC Electric Motor Model, MIT 2007). While rotor k is healthy its bins obey

    log W_k^2 = a_k + b log f_k + c,        log I_k = alpha_k + beta log W_k + gamma

with f_k the commanded share of full thrust; a_k, alpha_k are the rotor's own; b and beta are common to all (1 and about 3 when the
autopilot's thrust curve is right); c and gamma are common to all at that moment (battery, air density): the median over the other rotors.
From that, for a time after an onset,

    S = W_k^2 / commanded    1: the rotor turns as commanded     commanded: exp(a_k + b log f_k + c)
    D = (I_k - expected) / I_healthy      0: the current fits the speed                expected: exp(alpha_k + beta log W_k + gamma)

With theta the loss of effectiveness by commands and motion, 1 - theta = S (1 - loss of the propeller). The causes predict

    propeller       S = 1 (a little more: less load), D = -g theta E,  E = expected / I_healthy: drag goes with thrust, mostly
    motor or ESC    S = 1 - theta, D = 0
    bearing         S = 1 - theta, D well above 0
    unknown         anything

and Bayes' rule with Gaussian likelihoods, whose variances include the flight's own scatter, gives their probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.events.losses import WITHIN_95

PROPELLER, MOTOR, BEARING, UNKNOWN = "propeller", "motor_or_esc", "bearing", "unknown"
PRIOR = {PROPELLER: 0.4, MOTOR: 0.3, BEARING: 0.15, UNKNOWN: 0.15}

SPEED_POWER = (1.0, 0.3)  # b: prior mean and sd; the thrust curve may be wrong
CURRENT_POWER = (2.9, 0.4)  # beta
# Model error: of the speed ratio, and of the current difference in healthy currents.
MODEL_S, MODEL_D = 0.01, 0.04
LEAST_POWER_SD = 0.05
# Relative lag of W^2 behind the commands of a tumbling vehicle, which change faster than rotors follow.
SWING = 0.3
FEWEST = 10  # bins that a rotor's healthy part needs
UNLOADED, UNLOADED_SD = 0.05, 0.05  # speed-up of an unloaded propeller, in W^2, per lost thrust
DRAG, DRAG_SD = 0.7, 0.4  # lost drag per lost thrust
MOTOR_D_SD = 0.1  # a failing motor may be less efficient
BEARING_D, BEARING_D_SD = 0.45, 0.25
ANY_S, ANY_D = 0.15, 0.6
THETA_SD = 0.15  # relative error of the loss by commands and motion: assumed thrust curve, short flight
STANDS = 0.05


class Law(NamedTuple):
    """log y_k = own_k + power x_k + common, fitted to healthy bins. own (n,); power, power_sd; known (n,) bool: rotors with a fit; scatter
    (n,): standard deviation of a bin about it; memory (n,): correlation of neighbouring bins."""

    own: np.ndarray
    power: float
    power_sd: float
    known: np.ndarray
    scatter: np.ndarray
    memory: np.ndarray


def learn(y: np.ndarray, x: np.ndarray, known: np.ndarray, prior: tuple[float, float]) -> Law:
    """Fit the law to healthy bins: y, x, known (T, n), known False where there is none; prior: mean and sd of the power.

    The power is fitted to changes between neighbouring bins, which slow common changes do not affect."""
    both = known[1:] & known[:-1]
    dy, dx = (np.diff(v, axis=0)[both] for v in (y, x))
    mean, sd = prior
    power, power_sd = mean, sd
    for _ in range(3):
        rest = dy - power * dx
        noise = max(float(median(np.abs(rest)) / 0.6745) if rest.size else 0.0, 1e-4)
        usable = np.abs(rest) < 5.0 * noise
        precision = 1.0 / sd**2 + float(np.sum(dx[usable] ** 2)) / noise**2
        power = (mean / sd**2 + float(dx[usable] @ dy[usable]) / noise**2) / precision
        power_sd = max(precision**-0.5, LEAST_POWER_SD)
    enough = known.sum(axis=0) >= FEWEST
    level = np.where(known, y - power * x, 0.0)
    levels = np.array([median(level[k, i]) if k.any() else 0.0 for i, k in enumerate(known.T)])
    law = Law(levels, float(power), float(power_sd), enough, np.full(levels.size, 0.1), np.zeros(levels.size))
    rest, there = residual(law, y, x, known)
    scatter, memory = np.full(levels.size, 0.1), np.zeros(levels.size)
    for k in np.flatnonzero(enough):
        at = there[:, k]
        r = rest[at, k]
        if r.size >= FEWEST:
            r = r - median(r)
            levels[k] += float(median(rest[at, k]))
            spread = max(float(median(np.abs(r)) / 0.6745), 0.3 * float(np.std(r)), 1e-4)
            scatter[k] = spread
            r = np.clip(r, -4.0 * spread, 4.0 * spread)
            memory[k] = np.clip(float(r[1:] @ r[:-1]) / max(float(r @ r), 1e-12), 0.0, 0.95)
    return Law(levels, float(power), float(power_sd), enough, scatter, memory)


def residual(law: Law, y: np.ndarray, x: np.ndarray, known: np.ndarray, healthy: np.ndarray | None = None):
    """(rest (T, n), there (T, n) bool): y of each rotor less its law and less the median residual of the other rotors in the same bin.

    healthy (T, n) bool: rotors used for the common part; all where None."""
    rest = y - law.own - law.power * x
    good = known & law.known
    reference = good if healthy is None else good & healthy
    reference = np.where(reference.any(axis=1, keepdims=True), reference, good)
    n = y.shape[1]
    common, some = np.zeros(y.shape), np.zeros(y.shape, bool)
    masked = np.where(reference, rest, np.nan)
    for k in range(n):
        others = np.delete(masked, k, axis=1)
        some[:, k] = np.isfinite(others).any(axis=1)
        common[some[:, k], k] = np.nanmedian(others[some[:, k]], axis=1)
    return rest - common, good & some


def mean_variance(scatter: float, memory: float, count: int) -> float:
    """Variance of the mean of `count` bins with that scatter and correlation of neighbours (first-order process)."""
    return scatter**2 / max(count, 1) * (1.0 + memory) / (1.0 - memory)


def _noise(law: Law, k: int, *counts: int) -> float:
    """Variance of a difference of means over so many bins of rotor k."""
    return sum(mean_variance(law.scatter[k], law.memory[k], count) for count in counts)


@dataclass(frozen=True, eq=False, repr=False)
class Measured:
    """A rotor's telemetry in a time after an onset. speed_ratio: S and its sd; current_change: D and its sd, None without currents; load:
    E; count: bins; volts: V by which its supply fell relative to the others', None where not measured."""

    speed_ratio: tuple[float, float]
    current_change: tuple[float, float] | None
    load: float
    count: int
    volts: tuple[float, float] | None = None


def causes(seen: Measured, theta: float, theta_sd: float) -> dict[str, float]:
    """Probability of each cause of a loss theta (0..1) with standard deviation theta_sd; they sum to 1."""
    S, S_sd = seen.speed_ratio
    if S < STANDS:  # a stopped rotor has lost all thrust, whatever the motion shows so far
        theta = max(theta, 1.0 - S)
    theta_sd = float(np.hypot(theta_sd, THETA_SD * theta))
    means = {
        PROPELLER: (1.0 + UNLOADED * theta, UNLOADED_SD * theta),
        MOTOR: (1.0 - theta, theta_sd),
        BEARING: (1.0 - theta, theta_sd),
        UNKNOWN: (1.0 - 0.5 * theta, ANY_S + 0.5 * theta),
    }
    draws = {
        PROPELLER: (-DRAG * theta * seen.load, DRAG_SD * theta * seen.load),
        MOTOR: (0.0, MOTOR_D_SD),
        BEARING: (BEARING_D, BEARING_D_SD),
        UNKNOWN: (0.0, ANY_D),
    }
    log = {}
    for cause, prior in PRIOR.items():
        mean, spread = means[cause]
        log[cause] = np.log(prior) + gaussian(S, mean, np.hypot(S_sd, spread))
        if seen.current_change is not None:
            mean, spread = draws[cause]
            log[cause] += gaussian(seen.current_change[0], mean, np.hypot(seen.current_change[1], spread))
    top = max(log.values())
    weight = {cause: float(np.exp(value - top)) for cause, value in log.items()}
    total = sum(weight.values())
    return {cause: value / total for cause, value in weight.items()}


def gaussian(value: float, mean: float, sd: float) -> float:
    """Log density."""
    return float(-0.5 * ((value - mean) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2.0 * np.pi))


def parts(seen: Measured, theta: float, theta_sd: float) -> dict[str, tuple[float, float, float]]:
    """Loss of speed and loss of the propeller, which together make theta, each with its 95 % interval: (loss, low, high), in 0..1."""
    S, S_sd = seen.speed_ratio
    speed_share = max(S, 0.05)
    propeller = 1.0 - (1.0 - theta) / speed_share
    propeller_sd = float(np.hypot(theta_sd / speed_share, (1.0 - theta) / speed_share**2 * S_sd))
    return {"speed": _bounded(1.0 - S, S_sd), "propeller": _bounded(propeller, propeller_sd)}


def _bounded(value: float, sd: float) -> tuple[float, float, float]:
    low, high = value - WITHIN_95 * sd, value + WITHIN_95 * sd
    return tuple(float(np.clip(v, 0.0, 1.0)) for v in (value, low, high))  # pyright: ignore[reportReturnType]


def measure(
    laws: tuple[Law, Law | None], bins, k: int, before: np.ndarray, after: np.ndarray, healthy: np.ndarray, swings: bool = False
) -> Measured | None:
    """Telemetry of rotor k (from 0) in the bins `after`, relative to those `before` (T,) bool; None where there are too few of either.

    laws: of speed and of current, fitted to `before`; bins: `telemetry.Binned`; healthy (T, n): rotors used for the common part; swings:
    whether the vehicle tumbles in `after`."""
    speed, current = laws
    y, x = log_power(bins), np.log(bins.thrust)
    known = bins.known
    # The logarithm of a stopped rotor's speed is that of a tiny one, and S is 0.
    rest, there = residual(speed, y, x, known, healthy)
    b, a = before & there[:, k], after & there[:, k]
    if b.sum() < FEWEST or not a.any() or not speed.known[k]:
        return None
    ratio = np.exp(np.clip(rest[:, k], -12.0, 2.0))
    S = float(np.mean(ratio[a]) / np.mean(ratio[b]))
    reach = _reach(x, a, b, k)
    noise = _noise(speed, k, int(a.sum()), int(b.sum())) + (SWING if swings else 0.0) ** 2
    S_sd = float(np.sqrt(max(S, 0.1) ** 2 * (noise + (speed.power_sd * reach) ** 2) + MODEL_S**2))
    count, volts = int(a.sum()), _volts(bins, k, a, b)
    if current is None or not current.known[k]:
        return Measured((S, S_sd), None, 1.0, count, volts)
    z, v = np.log(np.maximum(bins.current, 1e-3)), 0.5 * y
    known = bins.known & bins.current_known & (bins.power > 0.0)
    rest, there = residual(current, z, v, known, healthy)
    b2, a2 = before & there[:, k], after & there[:, k]
    stopped = after & bins.known[:, k] & (bins.power[:, k] <= 0.0) & bins.current_known[:, k]
    if b2.sum() < FEWEST or not (a2.any() or stopped.any()):
        return Measured((S, S_sd), None, 1.0, count, volts)
    usual = float(np.mean(bins.current[b2, k]))
    expected = bins.current[:, k] * np.exp(-np.clip(rest[:, k], -12.0, 12.0))
    # A stopped rotor needs no current.
    draws = np.concatenate([(bins.current[a2, k] - expected[a2]), bins.current[stopped, k]]) / usual
    load = float(np.mean(np.concatenate([expected[a2], np.zeros(int(stopped.sum()))])) / usual)
    noise = _noise(current, k, draws.size, int(b2.sum()))
    reach = _reach(v, a2, b2, k) if a2.any() else 0.0
    variance = max(load, 0.3) ** 2 * (noise + (current.power_sd * reach) ** 2) + (MODEL_D * max(load, 1.0)) ** 2
    D_sd = float(np.sqrt(variance))
    return Measured((S, S_sd), (float(np.mean(draws)), D_sd), load, count, volts)


def log_power(bins) -> np.ndarray:
    """(T, n) log W^2; of a stopped rotor, that of a speed far below any."""
    return np.log(np.maximum(bins.power, 1e-2))


def _reach(x: np.ndarray, a: np.ndarray, b: np.ndarray, k: int) -> float:
    """Extrapolation of the law: change of x of rotor k from b to a, relative to the other rotors' median change."""
    change = x[a].mean(axis=0) - x[b].mean(axis=0)
    return float(change[k] - median(np.delete(change, k)))


def _volts(bins, k: int, a: np.ndarray, b: np.ndarray) -> tuple[float, float] | None:
    """(V by which the supply of rotor k fell against the others', standard deviation)."""
    n = bins.voltage.shape[1]
    others = np.delete(np.arange(n), k)
    ok = bins.voltage_known[:, k] & bins.voltage_known[:, others].all(axis=1)
    a, b = a & ok, b & ok
    if not a.any() or b.sum() < FEWEST:
        return None
    difference = median(bins.voltage[:, others], axis=1) - bins.voltage[:, k]
    sd = float(np.std(difference[b]) * np.sqrt(1.0 / a.sum() + 1.0 / b.sum()))
    return float(difference[a].mean() - difference[b].mean()), max(sd, 0.02)
