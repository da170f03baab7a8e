"""Was a propeller damaged at take-off already? One flight's balance of commands against healthy flights of the build.

In hover the rotors' thrusts balance weight and torques. A weak rotor needs more command, and the commanded wrench per commanded thrust,

    w = B f / sum f      (roll, pitch, yaw),

moves by a vector that names the rotor. What else moves it is modelled:

* Wind: rotors in a cross flow pitch and roll the vehicle. The lateral specific force a (what wind pushes with, in g) measures that flow: w
  = w0 + s a, one slope s per axis, about the same in all flights of a build. w0 is compared.
* Between healthy flights of one build roll and pitch repeat to CENTRE_SD of an arm length (the battery lies elsewhere), yaw to TILT_SD /
  sqrt(n) (motors that do not stand upright, each on its own) and the mean command to THRUST_SD (battery, load). How much a build scatters
  differs, too: the prior counts like PRIOR_FLIGHTS flights, and the baseline's own scatter updates it (inverse Wishart).
* Within a flight: the covariance of the mean, from means over blocks on the time scale that shows the largest one.
* A shifted centre of mass (a battery put in otherwise, a hung weight) moves roll and pitch as a rotor loss does, but not yaw: drag torques
  balance as the thrusts do. A damaged rotor is commanded more thrust than it gives, and as much more yaw: its own column of B, times rho.
  rho is 1 when torque falls as thrust does, more for a mere shorter blade, less when damage adds drag.
* A damaged rotor needs more commanded thrust of all, too; a shifted mass does not, a hung one as much as it weighs. Yaw and thrust together
  decide between them.
* Battery, a load under the centre, air density move all commands alike and leave w where it was: no test rests on the mean command alone.

A loss theta of rotor i lacks e = theta f_i; the mixer makes up for it with all rotors, f = f0 + B+ B_i e, so that B f moves by B_i e with e
= theta f0_i / (1 - a theta), a = (B+ B)_ii (1 of a quadrotor); of several rotors e = Theta (f0 + (B+ B) e).

Source of the scatter: 37 steady hovers of 6 real quadrotors (ArduPilot, Crazyflie, telemetry; a landing between any two of a vehicle),
marginal likelihood of the inverse Wishart model. Its logarithm is flat to 0.2 between yaw 0.020 and 0.025 and between 2 and 10 flights;
with any one vehicle left out 0.008 to 0.011, 0.016 to 0.025 and 4 to 10. The mean command: 5 of these vehicles. Of hexas and octas there
are none; the scaling of yaw is assumed, as in population.py.
Hotelling's test rejects the healthy hypothesis at FALSE_ALARM per flight, shared by two tests: of the mean, and of its change between the
halves of the flight, as damage at take-off stays and a swinging load does not. Only then explanations are weighed, one of them that nothing
but scatter is there. The verdict fault needs a rarer flight (FALSE_FAULT) and a rotor that is SURE to be damaged.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.maths.tails import f_tail

AFTER_TAKE_OFF_S, BEFORE_LANDING_S = 3.0, 1.0
BLOCK_S = 1.0
SCALES = (1, 2, 4, 8)  # blocks that are averaged to see slow variation
LEAST_BLOCKS = 6
UPRIGHT = np.cos(np.radians(25.0))
CLIMB, TURN = 0.35, 0.35  # m/s, rad/s: faster than that is no steady flight
LIMIT = 0.98  # share of the command range at which a rotor counts as being at its limit
LIMITED = 0.2  # of the time at its limit: the mean command no longer says what hover needs
G0 = 9.80665

CENTRE_SD, TILT_SD, THRUST_SD = 0.011, 0.045, 0.05
PRIOR_FLIGHTS, MANY_FLIGHTS = 6, 10  # many: from which on a baseline can begin to show how much healthy flights differ
SLOPE_SD, SLOPE_BETWEEN_SD = 2.0, 0.4  # of w per g: any build; flights of one build
HALVES_SD = 0.01  # change of w between the halves of a healthy flight: motors and batteries warm up

FALSE_ALARM = 0.05
"""Share of healthy flights that are called ambiguous or worse, under the model above."""
FALSE_FAULT = 0.01
"""Share of healthy flights that may be called a fault at most."""
OF_MEAN = 0.8  # of the false alarms are the mean's; the rest the change's between halves
SURE = 0.95  # probability of being damaged that a rotor needs for the verdict fault
OTHER = 0.05  # probability from which another explanation is worth a word

SINGLE, PAIR, CENTRE = 0.45, 0.1, 0.45  # prior of what it is when something is wrong
LOSS_MEAN = 0.25  # of the extra command theta / (1 - theta), exponential
RHO_SD, CENTRE_RHO_SD = 0.3, 0.1  # yaw shift of a damaged rotor: 1 +- RHO_SD; of a weight 0 +- CENTRE_RHO_SD
WEIGHT_SD = (
    1.0  # of ln of the mean command, per arm length that a mass shifts the centre: a weight hung from an arm's end
)
SHIFT_SD = 0.08  # of the centre of mass, arm lengths


@dataclass(frozen=True)
class Features:
    """How one flight hovered. n rotors; axes roll, pitch, yaw; w as in the module docstring.

    share (n,): mean share of full thrust. wrench (3,), force (2,): mean w; mean lateral specific force x, y in g.
    slope, slope_sd (2,): of w on the force, roll on y and pitch on x, from this flight alone.
    covariance (3, 3): of the mean w, the slope's part taken out. change (3,), change_covariance (3, 3): the same for
    second half minus first half. limited (n,): share of the time at the limit. seconds: of steady flight; blocks: how
    many independent ones it is worth, 0 when too few. voltage: mean of the battery, V, 0 when not logged.
    """

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
        """Enough steady flight to be compared at all."""
        return self.blocks > 0

    def to_dict(self) -> dict:
        """Plain text, floats and lists, for a vehicle file."""
        return {k: _plain(v) for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, table: Mapping) -> Features:
        """The inverse of `to_dict`. Raises ConfigError when something is missing or not a number."""
        none = asdict(_no_hover("", np.size(table.get("share", ()))))
        like = {k: np.shape(v) for k, v in none.items() if k != "name"}
        try:
            arrays = {k: np.asarray(table[k], float) for k in like}
        except (KeyError, TypeError, ValueError):
            arrays = {}
        if not arrays or any(a.shape != like[k] or not np.isfinite(a).all() for k, a in arrays.items()):
            raise ConfigError("The healthy flights in the vehicle file are damaged; run calibrate again.")
        return cls(name=str(table.get("name", "")), **{k: _frozen(a) for k, a in arrays.items()})


@dataclass(frozen=True)
class Cause:
    """One explanation. kind: rotors or centre_of_mass. rotors: 1-based; none for the centre of mass."""

    kind: str
    rotors: tuple[int, ...]
    probability: float


@dataclass(frozen=True)
class WholeFlight:
    """The judgement.

    rotors: 1-based, those damaged (fault) or most likely so if any are (ambiguous).
    loss (n,), interval (n, 2): per rotor, 95 %. Verdict healthy: loss weighs in that nothing is wrong, and the interval
    reaches to what could have gone unnoticed; else both suppose that rotors are the cause.
    causes: what explains the difference, most probable first; empty when there is none. p_value: share of healthy
    flights that would differ at least so much if they spread as the model assumes; never below FALSE_FAULT, the smallest
    share that a verdict is built on: neither the assumption nor a handful of flights can vouch for less.
    shift, shift_sd (3,): of w against the baseline. common: log ratio of the mean
    command, which battery, payload and air density change too. flights: how many baseline flights were used.
    """

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
        return {k: _plain(v) for k, v in asdict(self).items()} | {"false_alarm_rate": FALSE_ALARM}


# One flight


def features(flight: Flight, vehicle: Vehicle, airborne: Sequence[tuple[float, float]]) -> Features:
    """How this flight hovered. airborne: ((start, end), ...) s. With too little steady flight it is not `usable`.

    Raises VehicleError when the vehicle has another number of rotors than the log.
    """
    from rotorwatch.motion.allocation import motor_thrusts

    empty = _no_hover(flight.name, len(vehicle.rotors))
    if not flight.has("motors"):
        return empty
    airframes.check(vehicle, flight)
    thrust = motor_thrusts(flight, vehicle)
    time = np.concatenate([_block_starts(thrust.time, start, end) for start, end in airborne] or [np.zeros(0)])
    share, some = _block_means(thrust, time)
    keep = some & (share.sum(axis=1) > 1e-3) & _steady(flight, time)
    time, share = time[keep], share[keep]
    if len(time) < LEAST_BLOCKS:
        return empty
    w = (share @ vehicle.effectiveness()[:3].T) / share.sum(axis=1, keepdims=True)
    force = _lateral_force(flight, time)
    intercept, slope, slope_sd = _wind_fit(w, force)
    # The slope's part of the scatter is accounted for where flights are compared.
    rest = w - force[:, ::-1] @ np.diag(slope) @ np.eye(2, 3)
    covariance = _covariance_of_mean(rest - intercept)
    half = np.arange(len(time)) >= len(time) / 2
    first, second = _robust_mean(rest[~half]), _robust_mean(rest[half])
    noise = _covariance_of_mean(rest[~half] - first) + _covariance_of_mean(rest[half] - second)
    push = force[half].mean(axis=0) - force[~half].mean(axis=0)
    noise += np.diag([*np.square(slope_sd * push[::-1]), 0.0])
    motors, curve = flight["motors"], vehicle.curve
    most = curve.u_min + LIMIT * (curve.u_max - curve.u_min)
    at_limit = np.mean(motors.values[_inside(motors.time, time)] > most, axis=0)
    worth = float(np.clip(np.mean(np.var(rest, axis=0) / np.maximum(np.diag(covariance), 1e-12)), 1.0, len(time)))
    battery, logged = _block_means(flight.signals.get("battery"), time, 1)
    return Features(
        name=flight.name,
        share=_frozen(_robust_mean(share)),
        wrench=_frozen(intercept + np.array([slope[0] * force[:, 1].mean(), slope[1] * force[:, 0].mean(), 0.0])),
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


def _no_hover(name: str, n: int) -> Features:
    none, square = (0.0,) * 3, ((0.0,) * 3,) * 3
    return Features(name, (0.0,) * n, none, none[:2], none[:2], none[:2], square, none, square, (0.0,) * n, 0.0, 0.0)


def _block_starts(samples: np.ndarray, start: float, end: float) -> np.ndarray:
    """Starts of the whole blocks in which there are samples, well after take-off and before landing."""
    first, last = start + AFTER_TAKE_OFF_S, end - BEFORE_LANDING_S
    index = np.unique(np.floor((samples[(samples >= first) & (samples < last)] - first) / BLOCK_S))
    starts = first + BLOCK_S * index
    return starts[starts + BLOCK_S <= last]


def _inside(time: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(m,) bool: which times lie in one of the blocks."""
    at = np.searchsorted(starts, time, side="right") - 1
    return (at >= 0) & (time < starts[np.maximum(at, 0)] + BLOCK_S)


def _block_means(
    signal: Signal | None, starts: np.ndarray, columns: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(k, c) means over the blocks and (k,) whether there was a sample. columns: only the first ones."""
    if signal is None or not len(signal):
        return np.zeros((len(starts), columns or 1)), np.zeros(len(starts), bool)
    ok = signal.valid[:, :columns].all(axis=1)
    time, values = signal.time[ok], signal.values[ok, :columns]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    a, b = np.searchsorted(time, starts), np.searchsorted(time, starts + BLOCK_S)
    return (total[b] - total[a]) / np.maximum(b - a, 1)[:, None], b > a


def _steady(flight: Flight, starts: np.ndarray) -> np.ndarray:
    """(k,) bool: blocks in which the vehicle, as far as is logged, was upright and neither climbed, sank nor turned."""
    steady = np.ones(len(starts), bool)
    if flight.has("attitude"):
        q, some = _block_means(flight["attitude"], starts)
        # A mean of quaternions that turn over vanishes: not steady either.
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


def _wind_fit(w: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intercept (3,), slopes and their sd (2,) of w (k, 3) on the crosswise force; robust, with the prior SLOPE_SD."""
    intercept, slope, sd = _robust_mean(w), np.zeros(2), np.full(2, SLOPE_SD)
    for axis, cause in ((0, 1), (1, 0)):
        centre = force[:, cause].mean()
        x, y = force[:, cause] - centre, w[:, axis]
        level, s, weight = np.median(y), 0.0, np.ones(len(y))
        for _ in range(10):
            rest = y - level - s * x
            scale = 1.4826 * np.median(np.abs(rest)) + 1e-6
            weight = np.minimum(1.0, 1.5 * scale / np.maximum(np.abs(rest), 1e-12))  # Huber
            level = np.average(y - s * x, weights=weight)
            precision = np.sum(weight * x * x) / scale**2 / 4.0  # neighbouring blocks are alike: count every fourth
            s = np.sum(weight * x * (y - level)) / scale**2 / 4.0 / (precision + SLOPE_SD**-2)
            sd[axis] = (precision + SLOPE_SD**-2) ** -0.5
        slope[axis], intercept[axis] = s, level - s * centre
    return intercept, slope, sd


def _robust_mean(values: np.ndarray) -> np.ndarray:
    """Column means with Huber's weights."""
    centre = np.median(values, axis=0)
    for _ in range(10):
        rest = np.abs(values - centre)
        scale = 1.4826 * np.median(rest, axis=0) + 1e-9
        weight = np.minimum(1.0, 1.5 * scale / np.maximum(rest, 1e-12))
        centre = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
    return centre


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


def judge(flight: Features, baseline: Sequence[Features], vehicle: Vehicle) -> WholeFlight:
    """Is this flight's balance that of the healthy ones, and if not, what explains it?

    baseline: one or more healthy flights of the same build. verdict: healthy; fault (these rotors); ambiguous
    (something differs: rotors or the centre of mass, or not certain which rotors); inconclusive (too little hover).
    Raises ConfigError without a baseline or when numbers of rotors differ.
    """
    n = len(vehicle.rotors)
    if not baseline:
        raise ConfigError("Whole-flight damage can only be judged against healthy flights; give some with --baseline.")
    if any(len(one.share) != n for one in (flight, *baseline)):
        raise ConfigError("The baseline flights are not of this airframe: their number of rotors differs.")
    healthy = [one for one in baseline if one.usable]
    if not flight.usable or not healthy:
        which = "flight" if not flight.usable else "baseline"
        return _undecided(n, f"too little steady hover in the {which} to compare whole flights.", len(healthy))

    shift, covariance, dof = _difference(flight, healthy)
    p_mean = _tail(shift[:3], covariance[:3, :3], dof)
    p_change = _tail(*_change(flight, healthy))
    p_value = min(1.0, p_mean / OF_MEAN, p_change / (1.0 - OF_MEAN))  # Bonferroni
    different = p_value < FALSE_ALARM
    share = np.mean([np.array(one.share) / np.mean(one.share) for one in healthy], axis=0)
    hypotheses = _weigh(shift, covariance, dof, share, vehicle)
    if different:
        loss, interval = _losses([h for h in hypotheses if h.kind == "rotors"], n)
    else:
        loss, _ = _losses(hypotheses, n)
        # What could have gone unnoticed: the upper end were this rotor, and only this, damaged.
        hidden = [_losses([h for h in hypotheses if h.rotors == (r,)], n)[1][r - 1][1] for r in range(1, n + 1)]
        interval = tuple((0.0, high) for high in hidden)
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
        sure = tuple(r for r in damaged if damaged[r] >= SURE)
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


def rarity(flight: Features, others: Sequence[Features], vehicle: Vehicle) -> float:
    """Share of healthy flights of the build that would differ from the others at least so much, under the model alone: no bound is put
    on it, so it orders flights but is no odds. All flights must be `usable`."""
    shift, scale, dof = _difference(flight, others)
    p_mean, p_change = _tail(shift[:3], scale[:3, :3], dof), _tail(*_change(flight, others))
    return min(1.0, p_mean / OF_MEAN, p_change / (1.0 - OF_MEAN))


def _tail(x: np.ndarray, scale: np.ndarray, dof: float) -> float:
    """Hotelling: x' scale^-1 x / d follows F(d, dof) when x (d,) has a t distribution with that scale matrix."""
    return f_tail(float(x @ np.linalg.solve(scale, x)) / len(x), len(x), dof)


def _seldom(p_value: float, flights: int) -> str:
    """How rare such a flight is, and what that rests on: few flights cannot show how much healthy ones differ."""
    odds = f"1 in {1.0 / max(p_value, FALSE_FAULT):.0f}"
    odds = f"fewer than {odds}" if p_value < FALSE_FAULT else odds
    few = "one flight cannot show that" if flights == 1 else f"{flights} flights are too few to show that"
    given = few if flights < MANY_FLIGHTS else f"{flights} flights were given"
    return f"{odds} healthy flights would differ so much, if they spread as assumed ({given})"


def _explain(causes, suspects, sure, p_mean, p_change, p_value, flight, loss, healthy) -> tuple[str, str]:
    """Verdict and sentence for a flight that differs."""
    named = " and ".join(f"{r} ({100 * loss[r - 1]:.0f} % loss)" for r in suspects)
    rotors = f"rotor{'s' if len(suspects) > 1 else ''} {named}"
    seldom = _seldom(p_value, len(healthy))
    if p_mean / OF_MEAN > max(FALSE_ALARM, p_change):
        return "ambiguous", f"the balance of the rotors changed in flight: a moving load, or {rotors}; {seldom}."
    limited = int(np.argmax(flight.limited))
    if flight.limited[limited] > LIMITED:
        why = f"rotor {limited + 1} was at its limit {100 * flight.limited[limited]:.0f} % of the time"
        return "ambiguous", f"{rotors} or a shifted centre of mass: {why}, too much to tell them apart."
    if sure and p_value < FALSE_FAULT:
        return "fault", f"{rotors} had to work harder from take-off on, and roll, pitch and yaw agree; {seldom}."
    if any(c.kind == "centre_of_mass" and c.probability > OTHER for c in causes):
        both = (rotors, "a shifted centre of mass")
        either = " or ".join(both[::-1] if causes[0].kind == "centre_of_mass" else both)
        return "ambiguous", f"{either}: yaw and thrust do not tell them apart; {seldom}."
    sets = [c.rotors for c in causes if c.rotors and (c.probability > OTHER or c is causes[0])]
    either = " or ".join("+".join(map(str, r)) for r in sets)
    which = "but not beyond doubt" if len(sets) < 2 else f"and it is not certain which ({either})"
    return "ambiguous", f"{rotors} had to work harder from take-off on, {which}; {seldom}."


def _undecided(n: int, reason: str, flights: int) -> WholeFlight:
    return WholeFlight(
        "inconclusive", reason, (), (0.0,) * n, ((0.0, 1.0),) * n, (), 1.0, (0.0,) * 3, (0.0,) * 3, 0.0, flights
    )


def prior_covariance(n: int) -> np.ndarray:
    """(4, 4) covariance of w and of ln of the mean command between healthy flights of n rotors before any was seen."""
    return np.diag(np.square([CENTRE_SD, CENTRE_SD, TILT_SD / np.sqrt(n), THRUST_SD]))


def _difference(flight: Features, healthy) -> tuple[np.ndarray, np.ndarray, float]:
    """Shift of w and ln of the mean command (4,) against the mean of the healthy flights, its t scale matrix (4, 4), degrees of freedom."""
    all_of_them = (flight, *healthy)
    variance = np.array([np.square(one.slope_sd) + SLOPE_BETWEEN_SD**2 for one in all_of_them])
    slope = np.sum([np.array(one.slope) for one in all_of_them] / variance, axis=0) / np.sum(1.0 / variance, axis=0)
    slope_variance = 1.0 / np.sum(1.0 / variance, axis=0) + SLOPE_BETWEEN_SD**2

    def at_no_force(one):
        x, y = one.force
        return np.array([*one.wrench, np.log(np.mean(one.share))]) - [slope[0] * y, slope[1] * x, 0.0, 0.0]

    base = np.array([at_no_force(one) for one in healthy])
    m = len(base)
    shift = at_no_force(flight) - base.mean(axis=0)
    push = np.array(flight.force) - np.mean([one.force for one in healthy], axis=0)
    by_slope = np.diag([slope_variance[0] * push[1] ** 2, slope_variance[1] * push[0] ** 2, 0.0])
    scale, dof = _predictive(prior_covariance(len(flight.share)), base)
    scale = scale * (1.0 + 1.0 / m)
    scale[:3, :3] += np.array(flight.covariance) + np.mean([one.covariance for one in healthy], axis=0) / m + by_slope
    return shift, scale, dof


def _change(flight: Features, healthy) -> tuple[np.ndarray, np.ndarray, float]:
    """Change of w between the halves of the flight, less that of healthy flights; as `_difference` returns it."""
    base = np.array([one.change for one in healthy])
    m = len(base)
    between, dof = _predictive(np.eye(3) * HALVES_SD**2, base)
    within = np.array(flight.change_covariance) + np.mean([one.change_covariance for one in healthy], axis=0) / m
    return np.array(flight.change) - base.mean(axis=0), between * (1.0 + 1.0 / m) + within, dof


def _predictive(prior: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, float]:
    """Scale matrix and degrees of freedom of a new row's t distribution: rows (m, d) update an inverse Wishart prior.

    `prior` (d, d) is its mean. A. Gelman et al., Bayesian Data Analysis, 3rd ed., section 3.6.
    """
    d = len(prior)
    dof = PRIOR_FLIGHTS + d + 1 + len(rows) - 1
    scatter = (rows - rows.mean(axis=0)).T @ (rows - rows.mean(axis=0))
    t_dof = dof - d + 1
    return (PRIOR_FLIGHTS * prior + scatter) / t_dof, float(t_dof)


# What explains a difference


@dataclass(frozen=True)
class _Hypothesis:
    """weight: posterior, not normalised. theta (g, len(rotors)): grid of losses; mass (g,): posterior on it, sum 1."""

    kind: str
    rotors: tuple[int, ...]
    weight: float
    theta: np.ndarray
    mass: np.ndarray


def _weigh(shift, covariance, dof, share, vehicle) -> list[_Hypothesis]:
    """All hypotheses for a shift of w and ln of the mean command; share (n,): healthy commands. A priori healthy is as likely as others."""
    B, n = vehicle.effectiveness(), len(vehicle.rotors)
    mixer = np.linalg.pinv(B) @ B
    none = np.zeros((1, 0))
    unmoved = t_density(shift[None], covariance, np.zeros((1, 4)), dof)[0]
    found = [_Hypothesis("healthy", (), unmoved, none, np.ones(1))]

    def rotor_shift(rotors, lacks):
        """(g, 4) shift when rotors lack `lacks` (g, r), shares of full thrust."""
        total = share.sum() + lacks.sum(axis=1, keepdims=True)
        w = (B[:3] @ share + lacks @ B[:3, rotors].T) / total - (B[:3] @ share) / share.sum()
        return np.concatenate([w, np.log(total / share.sum())], axis=1)

    line = np.linspace(0.0, 1.0, 201)[1:] ** 2 * 5.0  # theta up to 0.83 of a quadrotor
    sets = [((i,), SINGLE / n) for i in range(n)]
    pairs = list(itertools.combinations(range(n), 2))
    sets += [(pair, PAIR / len(pairs)) for pair in pairs]
    for rotors, prior in sets:
        axis = line if len(rotors) == 1 else line[::5]
        cell = np.gradient(axis) * np.exp(-axis / LOSS_MEAN) / LOSS_MEAN
        extra = np.stack([g.ravel() for g in np.meshgrid(*[axis] * len(rotors), indexing="ij")], axis=1)
        mass = np.prod(np.stack([g.ravel() for g in np.meshgrid(*[cell] * len(rotors), indexing="ij")]), axis=0)
        who = list(rotors)
        lacks = extra * share[who]
        theta = lacks / (share[who] + lacks @ mixer[np.ix_(who, who)])
        mass = mass * (theta <= 1.0).all(axis=1)
        more = np.zeros((len(extra), 4))
        more[:, 2] = np.square(RHO_SD * np.abs(lacks * B[2, who] / share.sum()).max(axis=1))
        density = mass / mass.sum() * t_density(shift - rotor_shift(who, lacks), covariance, more, dof)
        total = density.sum()
        one_based = tuple(r + 1 for r in rotors)
        found.append(_Hypothesis("rotors", one_based, prior * total, theta, density / max(total, 1e-300)))

    step = np.linspace(-4.0, 4.0, 61) * SHIFT_SD
    where = np.stack([g.ravel() for g in np.meshgrid(step, step)] + [np.zeros(len(step) ** 2)] * 2, axis=1)
    distance = np.hypot(where[:, 0], where[:, 1])
    mass = np.exp(-0.5 * (distance / SHIFT_SD) ** 2)
    more = np.square(distance[:, None] * [0.0, 0.0, CENTRE_RHO_SD, WEIGHT_SD])
    density = mass / mass.sum() * t_density(shift - where, covariance, more, dof)
    found.append(_Hypothesis("centre_of_mass", (), CENTRE * float(density.sum()), none, np.ones(1)))
    return found


def t_density(rest: np.ndarray, scale: np.ndarray, more: np.ndarray, dof: float) -> np.ndarray:
    """(g,) multivariate t densities, but for a factor, of rest (g, d). more (g, d): added to the diagonal of the scale matrix (d, d)."""
    d = rest.shape[1]
    grown = scale + more[:, :, None] * np.eye(d)
    distance = np.einsum("gi,gi->g", rest, np.linalg.solve(grown, rest[:, :, None])[:, :, 0])
    return (1.0 + distance / dof) ** (-(dof + d) / 2) / np.sqrt(np.linalg.det(grown))


def _losses(hypotheses, n: int) -> tuple[tuple[float, ...], tuple[tuple[float, float], ...]]:
    """Mean and 95 % interval of every rotor's loss over the hypotheses; 0 where one leaves the rotor healthy."""
    total = sum(h.weight for h in hypotheses)
    loss, interval = [], []
    for rotor in range(1, n + 1):
        value, mass = [np.zeros(1)], [np.zeros(1)]
        for h in hypotheses:
            column = h.theta[:, h.rotors.index(rotor)] if rotor in h.rotors else np.zeros(1)
            value.append(column)
            mass.append(h.weight / total * (h.mass if rotor in h.rotors else np.ones(1)))
        v, p = np.concatenate(value), np.concatenate(mass)
        order = np.argsort(v)
        v, cumulative = v[order], np.cumsum(p[order])
        low, high = (v[min(np.searchsorted(cumulative, q * cumulative[-1]), len(v) - 1)] for q in (0.025, 0.975))
        loss.append(float(np.sum(v * p[order]) / cumulative[-1]))
        interval.append((float(low), float(high)))
    return tuple(loss), tuple(interval)


def _frozen(value) -> Any:
    """Numbers and nested sequences as floats and tuples."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(_frozen(v) for v in value)
    return float(value)


def _plain(value):
    """Tuples as lists, data classes' dictionaries kept: what TOML and JSON hold."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value
