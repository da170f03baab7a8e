"""Damage of a propeller at take-off: one flight's balance of commands against healthy flights of the build.

In hover the rotors' thrusts balance weight and torques. A weak rotor needs more command, and the commanded wrench per commanded thrust,

    w = B f / sum f      (roll, pitch, yaw),

moves by a vector that identifies the rotor. Other influences are modelled:

* Wind: rotors in a cross flow pitch and roll the vehicle. The lateral specific force a (the wind's force, in g) measures that flow: w
  = w0 + s a, one slope s per axis, about the same in all flights of a build. w0 is compared.
* Between healthy flights of one build roll and pitch repeat to CENTRE_SD of an arm length (the battery lies elsewhere), yaw to TILT_SD /
  sqrt(n) (motors that do not stand upright, each on its own) and the mean command to THRUST_SD (battery, load). The scatter differs
  between
  builds: the prior counts like PRIOR_FLIGHTS flights, and the baseline's own scatter updates it (inverse Wishart).
* Within a flight: the covariance of the mean, from means over blocks on the time scale that shows the largest one. * A shifted centre of
mass (the battery in another place, a hung weight) moves roll and pitch as a rotor loss does, but not yaw: drag torques
  balance as the thrusts do. A damaged rotor is commanded more thrust than it gives, and as much more yaw: its own column of B, times
  rho.
  rho is 1 when torque falls as thrust does, more for a merely shorter blade, less when damage adds drag.
* A damaged rotor needs more commanded thrust of all, too; a shifted mass does not, a hung one as much as it weighs. Yaw and thrust
together
  decide between them.
* Battery, a load under the centre, air density move all commands alike and leave w unchanged: no test rests on the mean command alone.

A loss theta of rotor i lacks e = theta f_i; the mixer compensates it with all rotors, f = f0 + B+ B_i e, so that B f moves by B_i e with e
= theta f0_i / (1 - a theta), a = (B+ B)_ii (1 of a quadrotor); of several rotors e = Theta (f0 + (B+ B) e).

Source of the scatter: 37 steady hovers of 6 real quadrotors (ArduPilot, Crazyflie, telemetry; a landing between any two of a vehicle),
marginal likelihood of the inverse Wishart model. Its logarithm is flat to 0.2 between yaw 0.020 and 0.025 and between 2 and 10 flights;
with any one vehicle left out 0.008 to 0.011, 0.016 to 0.025 and 4 to 10. The mean command: 5 of these vehicles. There are no hexas or octas
among them; the scaling of yaw is assumed, as in population.py.

Hotelling's test rejects the healthy hypothesis at FALSE_ALARM per flight, shared by two tests: of the mean, and of its change between the
halves of the flight, as damage at take-off stays and a swinging load does not. Only then explanations are weighed, one of them scatter
alone. The verdict fault needs a rarer flight (FALSE_FAULT) and a rotor that is certainly DAMAGED.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import windows
from rotorwatch.base.arrays import distinct, median
from rotorwatch.base.physics import G0
from rotorwatch.engine.events.decisions import DAMAGED, FALSE_ALARM, FALSE_FAULT, MENTIONED
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.stats import huber
from rotorwatch.stats import multivariate_t as student

AFTER_TAKE_OFF_S, BEFORE_LANDING_S = 3.0, 1.0
BLOCK_S = 1.0
SCALES = (1, 2, 4, 8)  # blocks averaged to resolve slow variation
LEAST_BLOCKS = 6
UPRIGHT = np.cos(np.radians(25.0))
CLIMB, TURN = 0.35, 0.35  # m/s, rad/s: faster than that is no steady flight
LIMIT = 0.98  # share of the command range at which a rotor counts as being at its limit
LIMITED = 0.2  # share of the time at its limit beyond which the mean command is not that of hover

CENTRE_SD, TILT_SD, THRUST_SD = 0.011, 0.045, 0.05
PRIOR_FLIGHTS, MANY_FLIGHTS = 6, 10  # many: enough for a baseline to show the scatter of healthy flights
SLOPE_SD, SLOPE_BETWEEN_SD = 2.0, 0.4  # of w per g: any build; flights of one build
HALVES_SD = 0.01  # change of w between the halves of a healthy flight: motors and batteries warm up

OF_MEAN = 0.8  # of the false alarms are the mean's; the rest the change's between halves

SINGLE, PAIR, CENTRE = 0.45, 0.1, 0.45  # prior of the explanations of a difference
LOSS_MEAN = 0.25  # of the extra command theta / (1 - theta), exponential
RHO_SD, CENTRE_RHO_SD = 0.3, 0.1  # yaw shift of a damaged rotor: 1 +- RHO_SD; of a weight 0 +- CENTRE_RHO_SD
WEIGHT_SD = 1.0  # of ln of the mean command, per arm length of shift of the centre: a weight hung from an arm's end
SHIFT_SD = 0.08  # of the centre of mass, arm lengths


class Features(NamedTuple):
    """The hover of one flight. n rotors; axes roll, pitch, yaw; w as in the module docstring.

    share (n,): mean share of full thrust. wrench (3,), force (2,): mean w; mean lateral specific force x, y in g. slope, slope_sd (2,): of
    w on the force, roll on y and pitch on x, from this flight alone.
    covariance (3, 3): of the mean w, without the slope's part. change (3,), change_covariance (3, 3): the same for second half minus first
    half. limited (n,): share of the time at the limit. seconds: of steady flight; blocks: equivalent number of independent ones, 0 when too
    few. voltage: mean of the battery, V, 0 when not logged."""

    name: str
    share: tuple[float, ...]
    wrench: tuple[float, ...]
    force: tuple[float, ...]
    slope: tuple[float, ...]
    slope_sd: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    change: tuple[float, ...]
    change_covariance: tuple[tuple[float, ...], ...]
    limited: tuple[float, ...]
    seconds: float
    blocks: float
    voltage: float = 0.0

    @property
    def usable(self) -> bool:
        """True if there is enough steady flight for a comparison."""
        return self.blocks > 0

    def to_dict(self) -> dict:
        """Plain text, floats and lists, for a vehicle file."""
        return {k: _plain(v) for k, v in self._asdict().items()}

    @classmethod
    def from_dict(cls, table: Mapping) -> Features:
        """The inverse of `to_dict`. Raises ConfigError when something is missing or not a number."""
        none = _no_hover("", np.size(table.get("share", ())))._asdict()
        like = {k: np.shape(v) for k, v in none.items() if k != "name"}
        try:
            arrays = {k: np.asarray(table[k], float) for k in like}
        except (KeyError, TypeError, ValueError):
            arrays = {}
        if not arrays or any(a.shape != like[k] or not np.isfinite(a).all() for k, a in arrays.items()):
            raise ConfigError("The healthy flights in the vehicle file are damaged; run calibrate again.")
        return cls(name=str(table.get("name", "")), **{k: _frozen(a) for k, a in arrays.items()})


class Cause(NamedTuple):
    """An explanation. kind: rotors or centre_of_mass. rotors: 1-based; none for the centre of mass."""

    kind: str
    rotors: tuple[int, ...]
    probability: float


class WholeFlight(NamedTuple):
    """Result of the comparison with healthy flights.

    rotors: 1-based, those damaged (fault) or most likely so if any are (ambiguous).
    loss (n,), interval (n, 2): per rotor, 95 %. Verdict healthy: loss includes the probability that nothing is wrong, and the interval
    reaches to the largest undetected loss; otherwise both assume that rotors are the cause.
    causes: explanations of the difference, most probable first; empty when there is none. p_value: share of healthy flights that would
    differ at least so much if they spread as the model assumes; never below FALSE_FAULT, the smallest share that a verdict is based on:
    neither the assumption nor a handful of flights can support less.
    shift, shift_sd (3,): of w against the baseline. common: log ratio of the mean command, which battery, payload and air density change
    too. flights: number of baseline flights used."""

    verdict: str
    reason: str
    rotors: tuple[int, ...]
    loss: tuple[float, ...]
    interval: tuple[tuple[float, float], ...]
    causes: tuple[Cause, ...]
    p_value: float
    shift: tuple[float, ...]
    shift_sd: tuple[float, ...]
    common: float
    flights: int

    def to_dict(self) -> dict:
        """Plain data, as it goes into the JSON answer."""
        causes = [cause._asdict() for cause in self.causes]
        return {k: _plain(v) for k, v in {**self._asdict(), "causes": causes}.items()} | {"false_alarm_rate": FALSE_ALARM}


# One flight


def features(
    flight: Flight, vehicle: Vehicle, airborne: Sequence[tuple[float, float]], hover: tuple[np.ndarray, np.ndarray] | None = None
) -> Features:
    """The hover of this flight. airborne: ((start, end), ...) s; hover: its `steady`, where known. With too little steady flight it is not
    `usable`. Raises VehicleError when the vehicle has another number of rotors than the log."""
    empty = _no_hover(flight.name, len(vehicle.rotors))
    if not flight.has("motors"):
        return empty
    airframes.check(vehicle, flight)
    time, share = steady(flight, vehicle, airborne) if hover is None else hover
    if len(time) < LEAST_BLOCKS:
        return empty
    w = (share @ vehicle.effectiveness()[:3].T) / share.sum(axis=1, keepdims=True)
    force = _lateral_force(flight, time)
    intercept, slope, slope_sd = _wind_fit(w, force)
    # The slope's part of the scatter is accounted for where flights are compared.
    rest = w - of_wind(force, slope)
    covariance = _covariance_of_mean(rest - intercept)
    half = np.arange(len(time)) >= len(time) / 2
    first, second = huber.mean(rest[~half]), huber.mean(rest[half])
    noise = _covariance_of_mean(rest[~half] - first) + _covariance_of_mean(rest[half] - second)
    push = force[half].mean(axis=0) - force[~half].mean(axis=0)
    noise += np.diag(of_wind(np.square(push), np.square(slope_sd)))
    motors, curve = flight["motors"], vehicle.curve
    most = curve.u_min + LIMIT * (curve.u_max - curve.u_min)
    at_limit = np.mean(motors.values[_inside(motors.time, time)] > most, axis=0)
    worth = float(np.clip(np.mean(np.var(rest, axis=0) / np.maximum(np.diag(covariance), 1e-12)), 1.0, len(time)))
    battery, logged = _block_means(flight.signals.get("battery"), time, 1)
    return Features(
        name=flight.name,
        share=_frozen(huber.mean(share)),
        wrench=_frozen(intercept + of_wind(force.mean(axis=0), slope)),
        force=_frozen(force.mean(axis=0)),
        slope=_frozen(slope),
        slope_sd=_frozen(slope_sd),
        covariance=_frozen(covariance),
        change=_frozen(second - first),
        change_covariance=_frozen(noise),
        limited=_frozen(at_limit),
        seconds=len(time) * BLOCK_S,
        blocks=worth,
        voltage=float(battery[logged, 0].mean()) if logged.any() else 0.0,
    )


def steady(flight: Flight, vehicle: Vehicle, airborne: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """(k,) starts of the blocks of BLOCK_S of steady hover, and (k, n) mean shares of full thrust. airborne: as of `features`."""
    from rotorwatch.engine.motion.allocation import motor_thrusts

    thrust = motor_thrusts(flight, vehicle)
    time = np.concatenate([_block_starts(thrust.time, start, end) for start, end in airborne] or [np.zeros(0)])
    share, some = _block_means(thrust, time)
    keep = some & (share.sum(axis=1) > 1e-3) & _steady(flight, time)
    return time[keep], share[keep]


def _no_hover(name: str, n: int) -> Features:
    none, square = (0.0,) * 3, ((0.0,) * 3,) * 3
    return Features(name, (0.0,) * n, none, none[:2], none[:2], none[:2], square, none, square, (0.0,) * n, 0.0, 0.0)


def _block_starts(samples: np.ndarray, start: float, end: float) -> np.ndarray:
    """Starts of the whole blocks in which there are samples, well after take-off and before landing."""
    first, last = start + AFTER_TAKE_OFF_S, end - BEFORE_LANDING_S
    index = distinct(np.floor((np.sort(samples[(samples >= first) & (samples < last)]) - first) / BLOCK_S))
    starts = first + BLOCK_S * index
    return starts[starts + BLOCK_S <= last]


def _inside(time: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(m,) bool: which times lie in one of the blocks."""
    at = np.searchsorted(starts, time, side="right") - 1
    return (at >= 0) & (time < starts[np.maximum(at, 0)] + BLOCK_S)


def _block_means(signal: Signal | None, starts: np.ndarray, columns: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(k, c) means over the blocks and (k,) whether there was a sample. columns: only the first ones."""
    if signal is None or not len(signal):
        return np.zeros((len(starts), columns or 1)), np.zeros(len(starts), bool)
    ok = signal.whole if columns is None else signal.valid[:, :columns].all(axis=1)
    time, values = signal.time, signal.values[:, :columns]
    if not ok.all():
        time, values = time[ok], values[ok]
    a, b = np.searchsorted(time, starts), np.searchsorted(time, starts + BLOCK_S)
    return windows.sums(values, a, b) / np.maximum(b - a, 1)[:, None], b > a


def _steady(flight: Flight, starts: np.ndarray) -> np.ndarray:
    """(k,) bool: blocks in which the vehicle, as far as is logged, was upright and neither climbed, sank nor turned."""
    steady = np.ones(len(starts), bool)
    if flight.has("attitude"):
        q, some = _block_means(flight["attitude"], starts)
        # The mean of quaternions of a flip vanishes: not steady either.
        steady &= ~some | (1.0 - 2.0 * (q[:, 1] ** 2 + q[:, 2] ** 2) > UPRIGHT)
    if flight.has("velocity"):
        v, some = _block_means(flight["velocity"], starts)
        steady &= ~some | (np.abs(v[:, 2]) < CLIMB)
    if flight.has("gyro"):
        rate, some = _block_means(flight["gyro"], starts)
        steady &= ~some | (np.abs(rate).max(axis=1) < TURN)
    return steady


def _lateral_force(flight: Flight, starts: np.ndarray) -> np.ndarray:
    """(k, 2) lateral specific force x, y in g; zero where none was logged, so that it explains nothing."""
    if not flight.has("accel"):
        return np.zeros((len(starts), 2))
    accel, some = _block_means(flight["accel"], starts)
    return np.where(some[:, None], np.clip(accel[:, :2] / G0, -0.5, 0.5), 0.0)


def of_wind(force: Any, slope: Any) -> np.ndarray:
    """(..., 3) wind's part of w at the lateral force (..., 2) and slopes (2,); given their squares, its part of the variance."""
    across = np.asarray(force, float)[..., ::-1] * slope
    return np.concatenate([across, np.zeros((*across.shape[:-1], 1))], axis=-1)


def _wind_fit(w: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intercept (3,), slopes and their sd (2,) of w (k, 3) on the crosswise force; robust, with the prior SLOPE_SD."""
    intercept = huber.mean(w)
    x, y = (force[:, ::-1] - force[:, ::-1].mean(axis=0), w[:, :2])  # roll by the force to the right, pitch by that forward
    level, slope, sd = median(y, axis=0), np.zeros(2), np.full(2, SLOPE_SD)
    for _ in range(huber.ROUNDS):
        weight, scale = huber.weights(y - level - slope * x, 1e-6)
        level = np.sum(weight * (y - slope * x), axis=0) / np.sum(weight, axis=0)
        certain = 0.25 / scale**2  # neighbouring blocks are correlated: count every fourth
        precision = certain * np.sum(weight * x * x, axis=0) + SLOPE_SD**-2
        slope = certain * np.sum(weight * x * (y - level), axis=0) / precision
        sd = precision**-0.5
    intercept[:2] = level - slope * force[:, ::-1].mean(axis=0)
    return intercept, slope, sd


def _covariance_of_mean(rest: np.ndarray) -> np.ndarray:
    """Covariance of the mean of correlated rows (k, d): of the SCALES, the one that gives the largest."""
    best = np.zeros((rest.shape[1],) * 2)
    for scale in SCALES:
        count = len(rest) // scale
        if count < 3:
            break
        means = rest[: count * scale].reshape(count, scale, -1).mean(axis=1)
        covariance = np.cov(means.T) / count
        best = covariance if np.trace(covariance) > np.trace(best) else best
    return best


# Against the baseline


def assess(flight: Features, baseline: Sequence[Features], vehicle: Vehicle, said: np.ndarray | float = 0.0) -> WholeFlight:
    """Compare this flight's balance with healthy ones, and explain a difference.

    baseline: one or more healthy flights of the same build. said (n,): log-odds by which others testify to a loss of each rotor's thrust,
    independent of w (`View.testimony`). verdict: healthy; fault (these rotors); ambiguous (a difference: rotors or the
    centre of mass, or not certain which rotors); inconclusive (too little hover). Raises ConfigError without a baseline or when numbers of
    rotors differ."""
    n = len(vehicle.rotors)
    if not baseline:
        raise ConfigError("Damage present at take-off can only be assessed against healthy flights; give some with --baseline.")
    if any(len(one.share) != n for one in (flight, *baseline)):
        raise ConfigError("The baseline flights are not of this airframe: their number of rotors differs.")
    healthy = [one for one in baseline if one.usable]
    if not flight.usable or not healthy:
        which = "flight" if not flight.usable else "baseline"
        return _undecided(n, f"too little steady hover in the {which} to compare whole flights.", len(healthy))

    shift, covariance, dof = _difference(flight, healthy)
    p_mean, p_change, p_value = _p_values(shift, covariance, dof, flight, healthy)
    different = p_value < FALSE_ALARM
    share = np.mean([np.array(one.share) / np.mean(one.share) for one in healthy], axis=0)
    supported = np.exp(np.broadcast_to(said, n))
    hypotheses = [
        h._replace(weight=h.weight * float(np.prod([supported[r - 1] for r in h.rotors])))
        for h in _weigh(shift, covariance, dof, share, vehicle)
    ]
    if different:
        loss, interval = _losses([h for h in hypotheses if h.kind == "rotors"], n)
    else:
        loss, _ = _losses(hypotheses, n)
        # The largest undetected loss: the upper end if only this rotor were damaged.
        alone = (h for h in hypotheses if len(h.rotors) == 1)
        interval = tuple((0.0, student.mean_and_interval(h.theta[:, 0], h.mass)[1][1]) for h in alone)
    wrong = [h for h in hypotheses if h.kind != "healthy"]
    total = sum(h.weight for h in wrong)
    scatter = 1.0 - total / sum(h.weight for h in hypotheses)
    causes = sorted((Cause(h.kind, h.rotors, h.weight / total) for h in wrong), key=lambda c: -c.probability)
    suspects: tuple[int, ...] = ()
    count = len(healthy)
    usual = "the healthy flight" if count == 1 else f"the {count} healthy flights"
    verdict, reason = "healthy", f"the rotors shared the load as in {usual}."
    if different:
        damaged = {r: (1.0 - scatter) * sum(c.probability for c in causes if r in c.rotors) for r in range(1, n + 1)}
        sure = tuple(r for r in damaged if damaged[r] >= DAMAGED)
        suspects = sure or next(c.rotors for c in causes if c.kind == "rotors")
        verdict, reason = _explain(causes, suspects, bool(sure), p_mean, p_change, p_value, flight, loss, healthy)
    return WholeFlight(
        verdict=verdict,
        reason=reason,
        rotors=suspects,
        loss=loss,
        interval=interval,
        causes=tuple(c for c in causes if c.probability > 0.01) if different else (),
        p_value=max(p_value, FALSE_FAULT),
        shift=_frozen(shift[:3]),
        shift_sd=_frozen(np.sqrt(np.diag(covariance)[:3])),
        common=float(shift[3]),
        flights=len(healthy),
    )


def rarity(flight: Features, others: Sequence[Features]) -> float:
    """Share of healthy flights of the build that would differ from the others at least so much, under the model alone: without a lower
    bound, so it ranks flights but is no probability to quote. All flights must be `usable`."""
    return _p_values(*_difference(flight, others), flight, others)[2]


def _p_values(shift, scale, dof, flight: Features, healthy) -> tuple[float, float, float]:
    """Hotelling's p-values of the mean, of its change between the halves, and of both (Bonferroni). The rest: as of `_difference`."""
    p_mean, p_change = student.tail(shift[:3], scale[:3, :3], dof), student.tail(*_change(flight, healthy))
    return p_mean, p_change, min(1.0, p_mean / OF_MEAN, p_change / (1.0 - OF_MEAN))


def _rarity_text(p_value: float, flights: int) -> str:
    """The rarity of such a flight in words, and its basis: few flights cannot show how much healthy ones differ."""
    odds = f"1 in {1.0 / max(p_value, FALSE_FAULT):.0f}"
    odds = f"fewer than {odds}" if p_value < FALSE_FAULT else odds
    few = "one flight cannot show that" if flights == 1 else f"{flights} flights are too few to show that"
    given = few if flights < MANY_FLIGHTS else f"{flights} flights were given"
    return f"{odds} healthy flights would differ by this much if they vary as assumed ({given})"


def _explain(causes, suspects, sure, p_mean, p_change, p_value, flight, loss, healthy) -> tuple[str, str]:
    """Verdict and sentence for a flight that differs."""
    named = " and ".join(f"{r} ({100 * loss[r - 1]:.0f} % loss)" for r in suspects)
    rotors = f"rotor{'s' if len(suspects) > 1 else ''} {named}"
    seldom = _rarity_text(p_value, len(healthy))
    if p_mean / OF_MEAN > max(FALSE_ALARM, p_change):
        return "ambiguous", f"the balance of the rotors changed in flight: a moving load, or {rotors}; {seldom}."
    limited = int(np.argmax(flight.limited))
    if flight.limited[limited] > LIMITED:
        why = f"rotor {limited + 1} was at its limit {100 * flight.limited[limited]:.0f} % of the time"
        return "ambiguous", f"{rotors} or a shifted centre of mass: {why}, too much to distinguish them."
    if sure and p_value < FALSE_FAULT:
        return "fault", f"{rotors} needed more command from take-off on, and roll, pitch and yaw agree; {seldom}."
    if any(c.kind == "centre_of_mass" and c.probability > MENTIONED for c in causes):
        both = (rotors, "a shifted centre of mass")
        either = " or ".join(both[::-1] if causes[0].kind == "centre_of_mass" else both)
        return "ambiguous", f"{either}: yaw and thrust do not distinguish them; {seldom}."
    sets = [c.rotors for c in causes if c.rotors and (c.probability > MENTIONED or c is causes[0])]
    either = " or ".join("+".join(map(str, r)) for r in sets)
    which = "but not beyond doubt" if len(sets) < 2 else f"and it is not certain which ({either})"
    return "ambiguous", f"{rotors} needed more command from take-off on, {which}; {seldom}."


def _undecided(n: int, reason: str, flights: int) -> WholeFlight:
    return WholeFlight("inconclusive", reason, (), (0.0,) * n, ((0.0, 1.0),) * n, (), 1.0, (0.0,) * 3, (0.0,) * 3, 0.0, flights)


def prior_covariance(n: int) -> np.ndarray:
    """(4, 4) covariance of w and of ln of the mean command between healthy flights of n rotors before any was seen."""
    return np.diag(np.square([CENTRE_SD, CENTRE_SD, TILT_SD / np.sqrt(n), THRUST_SD]))


def _difference(flight: Features, healthy) -> tuple[np.ndarray, np.ndarray, float]:
    """Shift of w and ln of the mean command (4,) against the mean of the healthy flights, its t scale matrix (4, 4), degrees of freedom."""
    all_of_them = (flight, *healthy)
    variance = np.square([one.slope_sd for one in all_of_them]) + SLOPE_BETWEEN_SD**2
    slope, slope_variance = student.weighted_mean(np.array([one.slope for one in all_of_them]), variance)
    rows = np.array([[*(one.wrench - of_wind(one.force, slope)), np.log(np.mean(one.share))] for one in all_of_them])
    base, force = rows[1:], np.array([one.force for one in all_of_them])
    scale, dof = student.predictive(base, prior_covariance(len(flight.share)), PRIOR_FLIGHTS)
    push = np.square(force[0] - force[1:].mean(axis=0))
    scale[:3, :3] += _within(flight.covariance, [one.covariance for one in healthy])
    scale[:3, :3] += np.diag(of_wind(push, slope_variance + SLOPE_BETWEEN_SD**2))
    return rows[0] - base.mean(axis=0), scale, dof


def _change(flight: Features, healthy) -> tuple[np.ndarray, np.ndarray, float]:
    """Change of w between the halves of the flight, less that of healthy flights; as `_difference` returns it."""
    base = np.array([one.change for one in healthy])
    between, dof = student.predictive(base, np.eye(3) * HALVES_SD**2, PRIOR_FLIGHTS)
    within = _within(flight.change_covariance, [one.change_covariance for one in healthy])
    return np.array(flight.change) - base.mean(axis=0), between + within, dof


def _within(own, others: list) -> np.ndarray:
    """Covariance of a flight's own noise less that of the mean of the others."""
    return np.array(own) + np.mean(others, axis=0) / len(others)


# Explanations of a difference


class _Hypothesis(NamedTuple):
    """weight: posterior, not normalised. theta (g, len(rotors)): grid of losses; mass (g,): posterior on it, sum 1."""

    kind: str
    rotors: tuple[int, ...]
    weight: float
    theta: np.ndarray
    mass: np.ndarray


def _weigh(shift, covariance, dof, share, vehicle) -> list[_Hypothesis]:
    """All hypotheses for a shift of w and ln of the mean command; share (n,): healthy commands. Half of the prior is healthy."""
    B, n = vehicle.effectiveness(), len(vehicle.rotors)
    mixer, balance, thrust = np.linalg.pinv(B) @ B, (B[:3] @ share)[:, None], share.sum()
    none = np.zeros((1, 0))
    hypotheses = [_Hypothesis("healthy", (), float(student.density(shift, covariance, dof)), none, np.ones(1))]
    for count, prior in ((1, SINGLE), (2, PAIR)):
        sets = list(itertools.combinations(range(n), count))
        extra, extra_mass = _loss_grid(count)
        for rotors in sets:
            who = list(rotors)
            command = share[who][:, None]
            lacks = extra * command  # (count, g) shares of full thrust
            theta = lacks / (command + mixer[np.ix_(who, who)].T @ lacks)
            mass = extra_mass * (theta <= 1.0).all(axis=0)
            total = thrust + lacks.sum(axis=0)
            moved = np.empty((4, len(mass)))
            moved[:3] = (balance + B[:3, who] @ lacks) / total - balance / thrust
            moved[3] = np.log(total / thrust)
            yaw = np.square(RHO_SD * np.abs(B[2, who][:, None] * lacks / thrust).max(axis=0))
            mass *= student.density((shift[:, None] - moved).T, covariance, dof, (0.0, 0.0, yaw, 0.0)) / mass.sum()
            weight = float(mass.sum())
            one_based = tuple(r + 1 for r in rotors)
            hypotheses.append(_Hypothesis("rotors", one_based, prior / len(sets) * weight, theta.T, mass / max(weight, 1e-300)))
    where, distance, mass = student.centred_grid(SHIFT_SD, 4.0)
    rest = shift - np.pad(where, ((0, 0), (0, 2)))
    extra_variance = (0.0, 0.0, np.square(CENTRE_RHO_SD * distance), np.square(WEIGHT_SD * distance))
    weight = float(mass @ student.density(rest, covariance, dof, extra_variance))
    return [*hypotheses, _Hypothesis("centre_of_mass", (), CENTRE * weight, none, np.ones(1))]


@functools.cache
def _loss_grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Extra command (count, g) of damaged rotors, relative, up to a theta of 0.83 of a quadrotor, and its prior mass (g,)."""
    line = np.linspace(0.0, 1.0, 201)[1:] ** 2 * 5.0
    axis = line if count == 1 else line[::5]
    cell = np.gradient(axis) * np.exp(-axis / LOSS_MEAN) / LOSS_MEAN
    extra = np.stack([g.ravel() for g in np.meshgrid(*[axis] * count, indexing="ij")])
    return extra, np.prod([g.ravel() for g in np.meshgrid(*[cell] * count, indexing="ij")], axis=0)


def _losses(hypotheses, n: int) -> tuple[tuple[float, ...], tuple[tuple[float, float], ...]]:
    """Mean and 95 % interval of every rotor's loss over the hypotheses; 0 where one leaves the rotor healthy."""
    loss, interval = [], []
    for rotor in range(1, n + 1):
        damaged = [h for h in hypotheses if rotor in h.rotors]
        spared = sum(h.weight for h in hypotheses if rotor not in h.rotors)
        value = np.concatenate([np.zeros(1), *(h.theta[:, h.rotors.index(rotor)] for h in damaged)])
        mass = np.concatenate([np.array([spared]), *(h.weight * h.mass for h in damaged)])
        mean, ends = student.mean_and_interval(value, mass / mass.sum())
        loss.append(mean)
        interval.append(ends)
    return tuple(loss), tuple(interval)


def _frozen(value) -> Any:
    """Numbers and nested sequences as floats and tuples."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(_frozen(v) for v in value)
    return float(value)


def _plain(value):
    """Tuples as lists, dictionaries kept: what TOML and JSON hold."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value
