"""A helicopter's log as the table of its plant, any estimator over it, and the actuators that do not follow their commands.

    U = (1 - loss) u + bias          deviation = U - u = bias - loss u

From commands alone a loss and a displacement cannot be distinguished while the command stands still; their deviation can always be seen,
so it decides: an actuator is named when its deviation stays beyond LEAST and beyond MARGIN times what it may be off by for LASTING_S.
A flight is taken to begin sound: what deviates at first is steady wind and trim, and counts as none.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import discovery, files
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.flight import Flight
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.maths.set_membership import SetMembership
from rotorwatch_lab.published import own
from rotorwatch_lab.systems.helicopter import Helicopter

ACTUATORS = 4
LAG_S = 0.03  # of the actuators, when nothing else is known
VELOCITY_SD, RATE_SD = 0.03, 0.0015  # of one sample: a navigation filter's velocity, the rates that the controller used
PROCESS_SD = (4e-3, 4e-3)  # what gusts and the plant's simplifications add in 0.02 s [m/s, rad/s]
LEAST, MARGIN, LASTING_S = 0.04, 1.5, 0.5
FILTER_SD = 2.0  # standard deviations that a filter's estimate may be off by; of a set, its half-width
# Deviations in this time are steady wind and trim: they are removed, and no actuator is named before its end.
LEARN_S = (2.0, 6.0)
KALMAN: dict[str, Any] = {
    # A fault is a jump of theta; a random walk follows it in about a second.
    "theta_walk": np.repeat([4e-3, 1e-3], ACTUATORS), "theta_var": np.repeat([1e-3, 4e-4], ACTUATORS),
}  # fmt: skip
SETS: dict[str, Any] = {
    # Where theta may be after a jump, how fast it drifts without one, and bounds of what one step adds and one sample errs by. The
    # remainder of the linearisation is neglected. Taylor models bound it well while nothing breaks (sets half as wide again); but after a
    # jump the set begins anew with all of theta_reach, over which the remainder exceeds what a measurement cuts away: it stays that wide.
    "theta_centre": np.repeat([0.5, 0.0], ACTUATORS), "theta_reach": np.repeat([1.0, 0.5], ACTUATORS), "theta_drift": 1e-3,
    "theta_range": (np.repeat([0.0, -1.0], ACTUATORS), np.ones(2 * ACTUATORS)),
    "process": np.repeat([2e-3, 2e-3], 3), "measurement": np.repeat([0.13, 0.007], 3), "remainder": "none",
}  # fmt: skip
NAMES = Helicopter.u_names[:ACTUATORS]
AIR = (
    "still air is assumed: wind passes for a displacement of the tail or of the cyclic, and what deviates in the first seconds counts as "
    "trim"
)
TRIM = (
    f"an actuator is named faulty when its deviation, bias - loss u, stays beyond {LEAST:g} and {MARGIN:g} times what it may be off by for "
    f"{LASTING_S:g} s; loss and displacement alone cannot be distinguished while the command stands still"
)
START_REACH = np.repeat([0.05, 0.02], ACTUATORS)  # of losses and displacements: a flight begins sound


class Table(NamedTuple):
    """Input of an estimator: time (T,); u (T, 6): commands, roll, pitch; y (T, 6): body velocities and rates; valid; dt [s]."""

    time: np.ndarray
    u: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    dt: float


@dataclass(frozen=True)
class Estimated:
    """theta and off (T, 8): losses, then displacements, and their uncertainty (95 %, or the half-width of a set); deviation, deviation_off
    (T, 4); found (4,): when each actuator was named [s], NaN if never. itself: the method's own series."""

    table: Table
    theta: np.ndarray
    off: np.ndarray
    deviation: np.ndarray
    deviation_off: np.ndarray
    found: np.ndarray
    itself: MethodSeries


def rows(flight: Flight, lag_s: float = LAG_S) -> Table:
    """The plant's table of a helicopter's log, at the times of its commands, which pass the actuators' lag first.

    Rates are those that the controller used; without them the gyro's. Raises LogError for a log without commands to four actuators,
    velocity, attitude and rates.
    """
    need = ("motors", "velocity", "attitude", "rates" if "rates" in flight.signals else "gyro")
    missing = [name for name in need if name not in flight.signals]
    if missing:
        raise LogError(f"{flight.name or 'The log'} lacks {', '.join(missing)}: a helicopter's plant needs them.")
    motors = flight.signals["motors"]
    if len(motors.columns) != ACTUATORS or motors.unit != "1" or len(motors) < 3:
        raise LogError(f"{flight.name or 'The log'} holds no commands to four actuators as shares: motor_1 .. motor_4.")
    time, dt = motors.time, float(np.median(np.diff(motors.time)))
    at = {name: _nearest(flight.signals[name].time, time) for name in need[1:]}
    v, q, gyro = (flight.signals[name].values[at[name]] for name in need[1:])
    near = np.stack([np.abs(flight.signals[name].time[at[name]] - time) < 0.75 * dt for name in need[1:]], axis=1)
    q = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-9)
    roll = np.arctan2(2 * (q[:, 0] * q[:, 1] + q[:, 2] * q[:, 3]), 1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2))
    pitch = np.arcsin(np.clip(2 * (q[:, 0] * q[:, 2] - q[:, 1] * q[:, 3]), -1, 1))
    y = np.concatenate([_to_body(q, v), gyro], axis=1)
    moving = np.stack([near[:, 0] & near[:, 1], near[:, 2]], axis=1)
    valid = np.repeat(moving, 3, axis=1) & np.isfinite(y)
    # A measurement is what the row before led to: the command of then, the attitude of then.
    command, tilt = _followed(motors.values, dt, lag_s), np.stack([roll, pitch], axis=1)
    u = np.concatenate([command[:-1], tilt[:-1]], axis=1)
    fine = np.isfinite(u)
    if not np.all(np.any(fine, axis=0)):
        raise LogError(f"{flight.name or 'The log'} holds a column without numbers.")
    u = np.where(fine, u, np.nanmean(np.where(fine, u, np.nan), axis=0))
    return Table(time[1:], u, y[1:], valid[1:] & np.all(fine, axis=1, keepdims=True), dt)


def _followed(command: np.ndarray, dt: float, lag_s: float) -> np.ndarray:
    """Mean position over each step of sound actuators driven by `command` (T, 4), held over the step: first-order lag, exact."""
    fade = np.exp(-dt / lag_s)
    share = lag_s / dt * (1.0 - fade)
    at, positions = command[0], np.empty_like(command)
    for k, driven in enumerate(command):
        positions[k] = driven + (at - driven) * share
        at = driven + (at - driven) * fade
    return positions


def _nearest(times: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.searchsorted(0.5 * (times[1:] + times[:-1]), at)


def _to_body(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """World vectors (T, 3) in body axes; q (T, 4) body to world."""
    w, u = q[:, :1], -q[:, 1:]
    t = 2.0 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def helicopter(airframe: str) -> dict[str, Any]:
    """Data of a helicopter: one described by a paper, by name, or an airframe file (TOML, in the papers' format). Raises ConfigError."""
    if airframe.endswith(".toml") or "/" in airframe:
        return files.toml(airframe, "airframe file")[0]
    if airframe not in airframes.papers() or "main" not in airframes.paper(airframe):
        known = [paper for paper in airframes.papers() if "main" in airframes.paper(paper)]
        names = f"{', '.join(known)}, and any airframe file (a name that ends in .toml)"
        raise ConfigError(f"There is no helicopter called {airframe!r}{meant(airframe, known)}; known are {names}.")
    return airframes.paper(airframe)


def method(name: Any, airframe: str, dt: float) -> Any:
    """The estimator of that name on a helicopter (`helicopter`), tuned for its logs. Raises ConfigError for an unknown name, or an
    estimator that is not defined for this plant."""
    craft = helicopter(airframe)
    load_jax()
    kind = discovery.estimator(name)
    if name == "default":
        raise ConfigError("The default estimator is made for multirotors; name a published one for a helicopter (docs/methods).")
    try:
        system = Helicopter(craft, PROCESS_SD, VELOCITY_SD, RATE_SD)
    except (TypeError, ValueError, KeyError, AttributeError) as why:
        raise ConfigError(f"The airframe {airframe} holds a value that is no number, or none of the right size ({why}).") from None
    known = inspect.signature(kind).parameters
    return kind(system, dt, **{key: value for key, value in _tuning(kind).items() if key in known})


def _tuning(kind: Any) -> dict[str, Any]:
    made = getattr(kind, "func", kind)
    return SETS if inspect.isclass(made) and issubclass(made, SetMembership) else KALMAN


def healthy_start(estimator: Any) -> Any:
    """The estimator's first carry, of a flight that begins in hover with sound actuators."""
    start = estimator.init()
    if not isinstance(estimator, SetMembership):
        return start
    wide = np.concatenate([3.0 * np.sqrt(np.diag(estimator.system.P0)), START_REACH])
    return start._replace(z=np.zeros(wide.size), shape=np.diag(wide**2))


def notes(estimator: Any) -> tuple[str, ...]:
    """Basis and neglected effects of the estimates."""
    if not isinstance(estimator, SetMembership):
        return (AIR, "process and measurement noise are tuned for these logs, not learned from this one", TRIM)
    neglected = (
        "the sets neglect the remainder of the linearisation, because after a jump it exceeds what a measurement cuts away: they guarantee "
        "nothing here, and hold the truth as often as their noise bounds happen to cover it",
        "the sets' bounds of noise are tuned for these logs; what gusts or a wrong airframe add beyond them is neglected as well",
    )
    return (AIR, *neglected, TRIM)


def estimate(flight: Flight, airframe: str, name: Any, lag_s: float = LAG_S, progress=None) -> Estimated:
    """The estimator of that name over a helicopter's log. Raises ConfigError and LogError."""
    table = rows(flight, lag_s)
    estimator = method(name, airframe, table.dt)
    if estimator.system.n_theta != 2 * ACTUATORS:
        raise ConfigError(f"{name} does not estimate the losses and displacements of the helicopter.")
    _, itself = run(estimator, table.u, table.y, table.valid, own.own, progress, healthy_start(estimator))
    theta, cov = itself.theta, itself.theta_cov * (1.0 if isinstance(estimator, SetMembership) else FILTER_SD**2)
    deviation, deviation_off = _deviation(theta, cov, table.u[:, :ACTUATORS])
    since = table.time - table.time[0]
    level = (since > LEARN_S[0]) & (since <= LEARN_S[1])
    if not level.any():
        raise LogError(f"{flight.name or 'The log'} is shorter than the {LEARN_S[1]:g} s that a helicopter's trim takes to learn.")
    deviation = deviation - deviation[level].mean(axis=0)
    off = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    series = own.series(discovery.title(name), estimator, itself, table.time, 1, table.dt, notes(estimator))
    made_of = {f"deviation_{actuator}": (deviation[:, k], deviation_off[:, k]) for k, actuator in enumerate(NAMES)}
    series = replace(series, made_of=made_of)
    return Estimated(table, theta, off, deviation, deviation_off, _named(table, deviation, deviation_off), series)


def summary(estimated: Estimated) -> dict[str, dict[str, float | None]]:
    """Actuator -> its estimates at the end of the flight, as numbers that JSON takes."""
    final = {
        "loss": estimated.theta[-1, :ACTUATORS], "loss_off": estimated.off[-1, :ACTUATORS], "bias": estimated.theta[-1, ACTUATORS:],
        "bias_off": estimated.off[-1, ACTUATORS:], "deviation": estimated.deviation[-1], "deviation_off": estimated.deviation_off[-1],
    }  # fmt: skip
    return {
        name: {"found_s": None if np.isnan(estimated.found[k]) else float(estimated.found[k])}
        | {key: float(values[k]) for key, values in final.items()}
        for k, name in enumerate(NAMES)
    }


def _deviation(theta: np.ndarray, cov: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(bias - loss u) (T, 4) of outputs that stay within their stops, and the root of its variance."""
    loss, bias = theta[:, :ACTUATORS], theta[:, ACTUATORS:]
    k = np.arange(ACTUATORS)
    var = cov[:, k, k] * u**2 + cov[:, k + ACTUATORS, k + ACTUATORS] - 2.0 * u * cov[:, k, k + ACTUATORS]
    return bias - loss * u, np.sqrt(np.maximum(var, 0.0))


def _named(table: Table, deviation: np.ndarray, off: np.ndarray) -> np.ndarray:
    """(4,) when each actuator had deviated for LASTING_S."""
    far = (np.abs(deviation) > np.maximum(LEAST, MARGIN * off)) & (table.time > table.time[0] + LEARN_S[1])[:, None]
    width, named = max(1, round(LASTING_S / table.dt)), np.full(ACTUATORS, np.nan)
    for k in range(ACTUATORS):
        run_length = np.convolve(far[:, k], np.ones(width, int))[: len(far)]
        if (run_length >= width).any():
            named[k] = table.time[np.argmax(run_length >= width)]
    return named
