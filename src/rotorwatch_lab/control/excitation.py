"""Excitation of the vehicle: a small signal on top of the commands that moves no thrust and no moment, unless a rotor is weak.

With more rotors than channels there are commands N c with B N = 0, the null space of the geometry B. Added to the commands of a
healthy vehicle they do nothing. Rotors with losses theta answer with the wrench

    -B diag(theta) N c(t)                                                                            (1)

which depends on *which* rotors are weak even where hover does not. Hover shows B theta; as every rotor gives thrust, the thrust
of (1) shows N' theta; the two together are all of theta: what hover leaves open, the thrust channel tells, and no gain of the vehicle
has to be known for it, because thrust over weight is the load factor.

The excitation is two waves in the null space, c(t) = w(t) (c1 sin 2 pi t / P + c2 sin 3 pi t / P), faded in and out by w over half a
period. Their frequencies differ, so that a rotor which follows later than thought does not make one direction look like the other,
as it would with sine and cosine. What it tells about two candidates (losses theta_A, theta_B) is the information between them,

    I = phi' Sigma^-1 phi,        phi(t) = B_T diag(theta_A - theta_B) N c(t)                         (2)

with B_T the thrust row and Sigma the covariance of the noise along the ticks (`Noise`): the squared distance of two Gaussian
hypotheses. Their log-likelihood ratio has the mean I / 2 and the variance I under the one that is true; no test can do better
(Neyman and Pearson 1933). `design` maximises the smallest I within what commands and attitude allow; this is the max-min
problem of auxiliary signals (Campbell and Nikoukhah, Auxiliary Signal Design for Failure Detection, 2004).
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import NO_EFFECT as FLAT
from rotorwatch.toolkit import ExcitationNoise as Noise
from rotorwatch.toolkit import noise_covariance as covariance
from rotorwatch.toolkit import null_space

Array = Any
PERIODS = (0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.6, 2.0)  # s
TICKS = 5.0  # in a period, at least
LONGEST_S = 10.0
CONTROLLER_SHARE = 0.5  # share of the room to the commands' limits that stays the controller's
FASTER = 1.5  # the second wave
HOLD = 3.0  # rad/s: attitude is held at least so fast, by whatever autopilot
DAMPED = 0.87  # ... with this damping: an attitude loop a third as fast as its rate loop
STARTS = 3  # of the search for directions
STEP_S = 0.005
SIGNS = np.array([[1.0, 1.0], [1.0, -1.0]])


class Signal(namedtuple("Signal", "first second period start length")):
    """An excitation. first, second (n,): commands, shares of full thrust, of the wave with `period` [s] and of the one with two thirds of
    it; start, length [s]."""


class Limits(NamedTuple):
    """Limits of an excitation. tilt [rad]: largest turn of the vehicle under any candidate; amplitude: largest change of a command, share
    of full thrust; least, most: command limits."""

    tilt: float = float(np.radians(1.0))
    amplitude: float = 0.2
    least: float = 0.0
    most: float = 0.9


class Design(NamedTuple):
    """An excitation and its expected effect. signal: from 0 s on. information (m,): at its end, for each pair of candidates pairs (m, 2);
    course (T,): smallest information up to each tick; needed: information required. tilt (k,) [rad], heave (k,) [m]: largest turn and
    change of height under each candidate. bound: active limit, "attitude", "commands" or "amplitude"."""

    signal: Signal
    information: np.ndarray
    pairs: np.ndarray
    course: np.ndarray
    needed: float
    tilt: np.ndarray
    heave: np.ndarray
    bound: str


def none(n: int) -> Signal:
    """An excitation of n rotors that never begins."""
    return Signal(np.zeros(n), np.zeros(n), np.array(1.0), np.array(np.inf), np.array(0.0))


def value_at(signal: Signal, t) -> Array:
    """(n,) what is added to the commands at time t [s]; zeros before its start and after its end. Pure: a step of the autopilot."""
    since = t - signal.start
    inside = (since >= 0.0) & (since <= signal.length)
    since = jnp.where(inside, since, 0.0)
    first, second = _waves(since, signal.period, signal.length, jnp)
    return jnp.where(inside, signal.first * first + signal.second * second, 0.0)


def _waves(since, period, length, xp=np):
    """The two waves with their fades at times `since` the start."""
    fade = xp.clip(xp.minimum(since, length - since) / (0.5 * period), 0.0, 1.0)
    window = 0.5 - 0.5 * xp.cos(np.pi * fade)
    turn = 2.0 * np.pi * since / period
    return window * xp.sin(turn), window * xp.sin(FASTER * turn)


def information(noise: Noise, difference: Array, dt: float) -> np.ndarray:
    """(T,) information I between two candidates up to each tick, equation (2), from the difference (T,) of the thrusts that they expect
    [hover thrusts]. A choice between two equally likely ones is wrong with the probability Phi(-sqrt(I) / 2)."""
    return np.cumsum((_whitener(noise, len(difference), dt) @ np.asarray(difference, float)) ** 2)


def _whitener(noise: Noise, ticks: int, dt: float) -> np.ndarray:
    """(T, T): inverse Cholesky factor of the covariance."""
    from scipy.linalg import solve_triangular

    return solve_triangular(np.linalg.cholesky(covariance(noise, ticks, dt)), np.eye(ticks), lower=True)


def needed(candidates: int, probability: float = 0.99, power: float = 0.99) -> float:
    """Information from which on the posterior of the true candidate among so many, all equally likely before, exceeds `probability` in a
    share `power` of flights. The log-likelihood ratio is Gaussian, of mean I / 2 and variance I: I / 2 - z sqrt(I) = log odds."""
    from statistics import NormalDist

    z = NormalDist().inv_cdf(power)
    odds = np.log(max(candidates - 1, 1) * probability / (1.0 - probability))
    return float((z + np.sqrt(z * z + 2.0 * odds)) ** 2)


def design(
    B: Array,
    candidates: Sequence[Array],
    hover: Array,
    noise: Noise,
    gain: Array,
    dt: float,
    limits: Limits | None = None,
    longest_s: float = LONGEST_S,
    length_s: float | None = None,
    lag: float = 0.03,
) -> Design:
    """The excitation that distinguishes the candidates soonest.

    B (4, n): roll, pitch, yaw, thrust of each rotor (`Vehicle.effectiveness`); candidates: losses (n,) of each; hover
    (n,): commands in hover, shares of full thrust, whose mean is a hover thrust; noise: in hover thrusts; gain (3,): hover thrusts per
    rad/s^2 of roll, pitch, yaw; dt [s]: a tick of the diagnosis; lag [s] of a rotor. longest_s: no longer than that; length_s: exactly so
    long instead. Raises ConfigError with one sentence where no excitation can be designed: no null space, no room, or candidates
    that it cannot distinguish, or not in that time.
    """
    limits = limits or Limits()
    B, hover, gain = (np.asarray(v, float) for v in (B, hover, gain))
    if B.ndim != 2 or B.shape[0] != 4:
        raise ConfigError(f"B must have the shape (4, number of rotors), not {B.shape}.")
    n = B.shape[1]
    thetas = np.stack([checks.shape("a candidate's losses", np.asarray(c, float), n) for c in candidates])
    for name, value in (("B", B), ("hover", hover), ("losses", thetas), ("gain", gain)):
        checks.finite(name, value)
    if len(thetas) < 2:
        raise ConfigError("Give at least two candidates: with one there is nothing to tell apart.")
    N = null_space(B)
    if not N.shape[1]:
        raise ConfigError(
            f"This frame has no null space: its {n} rotors have one way only to make a thrust and moment, so that every change of "
            "commands moves the vehicle."
        )
    pairs = np.array([(i, j) for i in range(len(thetas)) for j in range(i)])
    unit = hover.mean()
    seen = np.stack([(B[3] * (thetas[i] - thetas[j])) @ N / unit for i, j in pairs])  # (m, k) per share of thrust
    size = np.abs(thetas).max(initial=1e-12)
    blind = [tuple(p) for p, A in zip(pairs, seen, strict=True) if np.abs(A).max() * unit < 1e-6 * size]
    if blind:
        raise ConfigError(_why_blind(thetas, N, blind[0]))
    room = np.minimum((1.0 - CONTROLLER_SHARE) * np.minimum(hover - limits.least, limits.most - hover), limits.amplitude)
    used = np.linalg.norm(N, axis=1) > FLAT
    if (room[used] < 1e-3).any():
        tight = ", ".join(str(k + 1) for k in np.flatnonzero(used & (room < 1e-3)))
        raise ConfigError(
            f"There is no room for an excitation: in hover rotor {tight} is commanded {hover[used & (room < 1e-3)][0]:.0%} of full "
            f"thrust, and commands stay between {limits.least:.0%} and {limits.most:.0%}."
        )
    enough = needed(len(thetas))
    longest = length_s if length_s is not None else longest_s
    turned = np.stack([B[:3] @ (theta[:, None] * N) / unit / gain[:, None] for theta in thetas])  # rad/s^2 per share
    ticks = max(2, round(longest / dt))
    whiten = _whitener(noise, ticks, dt)
    designs: list[Design] = []
    for period in PERIODS:
        if period < TICKS * FASTER * dt or 2.0 * period > longest:
            continue
        reach = _turn(period)
        typical = min(longest, max(2.0, 2.0 * period))
        D = _directions(seen, _kernel(whiten, period, typical, dt, lag, ticks), turned / limits.tilt, reach, N, room)
        candidate = _whole(N @ D, period, longest, length_s, dt, lag, whiten, seen, D, enough)
        if candidate is None:
            continue
        signal, found_information = candidate
        tilt = np.stack([np.linalg.norm(turned @ D @ (reach * signs), axis=1) for signs in SIGNS]).max(axis=0)
        lift = G0 / n / unit * (thetas * B[3]) @ N @ D
        heave = np.abs(lift) @ reach
        amplitude = np.abs(N @ D).sum(axis=1)
        bound = "attitude" if tilt.max() > 0.98 * limits.tilt else "commands"
        bound = "amplitude" if bound == "commands" and amplitude.max() > 0.98 * limits.amplitude else bound
        course = found_information.min(axis=1)
        designs.append(Design(signal, found_information[-1], pairs, course, enough, tilt, heave, bound))
    if not designs:
        raise ConfigError(f"An excitation takes at least {2.0 * max(TICKS * dt, PERIODS[0]):.1f} s; allow more time.")
    if length_s is not None:
        return max(designs, key=lambda d: d.information.min())
    sufficient = [d for d in designs if d.information.min() >= enough]
    if not sufficient:
        best = max(designs, key=lambda d: d.information.min())
        least = float(best.information.min())
        factor = np.sqrt(enough / max(least, 1e-12))
        what = {
            "attitude": f"an attitude of {np.degrees(limits.tilt):.2g} degrees",
            "commands": "the commands' limits",
            "amplitude": f"an amplitude of {limits.amplitude:.0%} of full thrust",
        }[best.bound]
        raise ConfigError(
            f"Within {what} {longest:.3g} s do not tell these candidates apart: the information is {least:.3g} of {enough:.0f}, and an "
            f"excitation {factor:.2g} times as large would do."
        )
    return min(sufficient, key=lambda d: (float(d.signal.length), -d.information.min()))


def _why_blind(thetas, N, pair) -> str:
    one, other = (("+".join(str(k + 1) for k in np.flatnonzero(thetas[i] > 0)) or "none") for i in pair)
    differing = np.flatnonzero(np.abs(thetas[pair[0]] - thetas[pair[1]]) > 0)
    if not differing.size:
        return f"The candidates {one} and {other} have the same losses: there is nothing to tell apart."
    still = [k for k in differing if np.linalg.norm(N[k]) < 1e-6]
    if still:
        rotors = ", ".join(str(k + 1) for k in still)
        return (
            f"The null space cannot tell {one} from {other}: no command that leaves the vehicle unmoved uses rotor {rotors}, whose thrust "
            "or moment no others can make up for."
        )
    return (
        f"The null space cannot tell {one} from {other}: their losses differ in a thrust and moment only, which hover shows, and answer "
        "every excitation alike."
    )


def _turn(period: float) -> np.ndarray:
    """(2,) largest turn [rad] per rad/s^2 of each wave of this period, start and end included, by x'' + 2 D w x' + w^2 x = a."""
    length = 6.0 * period
    t = np.arange(0.0, length + 2.0, STEP_S)
    inside = t <= length
    waves = np.stack(_waves(np.where(inside, t, 0.0), period, length)) * inside
    # A step of a damped oscillator whose input is held is a constant linear map.
    a, b = -DAMPED * HOLD, HOLD * np.sqrt(1.0 - DAMPED**2)
    e, c, s = np.exp(a * STEP_S), np.cos(b * STEP_S), np.sin(b * STEP_S) / b
    F = e * np.array([[c - a * s, s], [-(HOLD**2) * s, c + a * s]])
    G = np.array([(1.0 - F[0, 0]) / HOLD**2, -F[1, 0] / HOLD**2])
    x, most = np.zeros((2, 2)), np.zeros(2)
    for k in range(t.size):
        most = np.maximum(most, np.abs(x[0]))
        x = F @ x + G[:, None] * waves[:, k]
    return most


def _passed(period: float, dt: float, lag: float) -> np.ndarray:
    """(2,) share of each wave that rotors of that lag follow and that ticks, means over dt, still show."""
    f = np.array([1.0, FASTER]) / period
    return np.sinc(dt * f) / np.sqrt(1.0 + (2.0 * np.pi * f * lag) ** 2)


def _kernel(whiten, period, length, dt, lag, ticks) -> np.ndarray:
    """K (2, 2): information per unit of the two waves, squared, over `length` seconds."""
    t = dt * (np.arange(ticks) + 0.5)
    waves = np.stack(_waves(np.minimum(t, length), period, length), axis=1) * (t <= length)[:, None]
    white = whiten @ (waves * _passed(period, dt, lag))
    return white.T @ white


def _directions(seen, K, turned, reach, N, room) -> np.ndarray:
    """D (k, 2): null space directions of the two waves, that have the largest smallest information within the limits.

    seen (m, k): thrust per share of thrust of each pair; K (2, 2); turned (c, 3, k): rad/s^2 per share of thrust, over the allowed
    turn; reach (2,): `_turn`; N (n, k); room (n,). Where waves are at their largest together is the worst; all is quadratic in D, and
    sequential quadratic programming finds  max t,  I_p(D) >= t,  limits_j(D) <= 1.
    """
    from scipy.optimize import minimize

    k = N.shape[1]
    gains = [np.kron(K, np.outer(A, A)) for A in seen]
    walls = []
    for signs in SIGNS:
        both, turns = np.outer(signs, signs), np.outer(reach * signs, reach * signs)
        walls += [np.kron(both, np.outer(row, row) / r**2) for row, r in zip(N, room, strict=True) if row @ row > FLAT]
        walls += [np.kron(turns, T.T @ T) for T in turned if np.abs(T).max() > FLAT]
    gains, walls = np.stack(gains), np.stack(walls)

    def scaled(d):
        d = d / np.sqrt(max((walls @ d @ d).max(), 1e-300))
        return d, float((gains @ d @ d).min())

    rng = np.random.default_rng(0)
    best = max((scaled(rng.standard_normal(2 * k)) for _ in range(64)), key=lambda one: one[1])
    starts = [best[0], *(scaled(rng.standard_normal(2 * k))[0] for _ in range(STARTS - 1))]
    for start in starts:
        unit = max(scaled(start)[1], 1e-12)
        constraints = [
            {
                "type": "ineq",
                "fun": lambda v, unit=unit: (gains @ v[:-1] @ v[:-1]) / unit - v[-1],
                "jac": lambda v, unit=unit: np.column_stack([2.0 * (gains @ v[:-1]) / unit, -np.ones(len(gains))]),
            },
            {
                "type": "ineq",
                "fun": lambda v: 1.0 - walls @ v[:-1] @ v[:-1],
                "jac": lambda v: np.column_stack([-2.0 * (walls @ v[:-1]), np.zeros(len(walls))]),
            },
        ]
        aim = np.zeros(2 * k + 1)
        aim[-1] = -1.0
        solved = minimize(
            lambda v: -v[-1],
            np.append(start, 1.0),
            jac=lambda v, aim=aim: aim,
            constraints=constraints,
            method="SLSQP",
            options={"maxiter": 60, "ftol": 1e-6},
        )
        if np.isfinite(solved.x).all():
            tried = scaled(solved.x[:-1])
            best = tried if tried[1] > best[1] else best
    return best[0].reshape(2, k).T


def _whole(directions, period, longest, length_s, dt, lag, whiten, seen, D, enough):
    """(Signal, information (T, m) up to each tick) of the fewest half periods that are enough, else of the most there are."""
    if length_s is not None:
        lengths = [length_s]
    else:
        lengths = list(0.5 * period * np.arange(4, int(longest / (0.5 * period) + 1e-9) + 1))
    ticks = len(whiten)
    parts = (seen @ D).T
    t = dt * (np.arange(ticks) + 0.5)

    def information_by(length):
        waves = np.stack(_waves(np.minimum(t, length), period, length), axis=1) * (t <= length)[:, None]
        waves = waves * _passed(period, dt, lag)
        return np.cumsum((whiten @ waves @ parts) ** 2, axis=0)[: max(1, int(np.ceil(length / dt)))]

    low, high = 0, len(lengths) - 1
    if high < 0:
        return None
    while low < high:  # information grows with the length
        middle = (low + high) // 2
        if information_by(lengths[middle])[-1].min() >= enough:
            high = middle
        else:
            low = middle + 1
    information = information_by(lengths[low])
    signal = Signal(directions[:, 0], directions[:, 1], np.array(period), np.array(0.0), np.array(float(lengths[low])))
    return signal, information
