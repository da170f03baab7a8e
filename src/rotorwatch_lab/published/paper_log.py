"""A multirotor's log on the plant that a method's paper has, in SI units: mass, inertias and arm from the vehicle file, the rest from the
log.

    rate dynamics        body rates and the thrust that is felt        lyapunov, mh_lyapunov, mhe (Niermeyer and others)
    Hamiltonian attitude Euler angles                                  akf, axkf (Rot and others)
    linear hover         attitude, rates, height and climb             intermediate (Nguyen and others)
    rigid body           position and Euler angles                     tsukf, atsukf (Zhang and others)

Thrust follows from hover: the mean command of the ticks that taught the trim carries the weight. What torque those commands leave over is
taken out of all, so that a sound vehicle has no loss. Noise of torques is what the log has taught (log_plant.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks, discovery
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.method_series import MethodSeries, joined
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import Ticks
from rotorwatch_lab.compiling.run import chosen, run
from rotorwatch_lab.published import own
from rotorwatch_lab.published.log_plant import LogPlant
from rotorwatch_lab.systems.linear_hover import LinearHover
from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude
from rotorwatch_lab.systems.rate_dynamics import RateDynamics
from rotorwatch_lab.systems.rigid_body import RigidBody

FIELDS = ("mass_kg", "arm_m", "inertia_kg_m2", "drag_ratio_m")
# Of a navigation filter's attitude [rad], position [m] and climb [m/s].
ANGLE_SD, POSITION_SD, CLIMB_SD = 0.005, 0.05, 0.05
FORCE_SD = 0.3  # m/s^2 per root of Hz: what gusts do to a vehicle's velocity
PAPER = "of the paper"
FRESH_S = 0.15  # a sample is used at ticks for so long
NOTES = (
    "the plant is that of the method's paper, in SI units: mass, inertias, arm and drag ratio are the vehicle file's, thrust follows from "
    "hover, and what torque the commands leave over there is taken out of them: a loss is a change since then",
)


class Numbers(NamedTuple):
    """m [kg], J (3,) [kg m^2], and torques [N m] (3, n) and thrusts [N] (n,) per hover thrust of one rotor."""

    m: float
    J: np.ndarray
    B_tau: np.ndarray
    B_T: np.ndarray


class Seen(NamedTuple):
    """The log at the ticks of a hop: Euler angles (T, 3), rates (T, 3), position and velocity (T, 3) NED, f_z (T,); NaN where unknown."""

    angles: np.ndarray
    rates: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    f_z: np.ndarray


def numbers(vehicle: Vehicle) -> Numbers:
    """Physical parameters of a vehicle whose file has FIELDS under [extra]. Raises ConfigError that names what is missing or wrong."""
    extra: Mapping[str, Any] = vehicle.extra or {}
    if missing := [name for name in FIELDS if name not in extra]:
        raise ConfigError(
            f"A paper's plant needs {', '.join(missing)}: put {'it' if len(missing) == 1 else 'them'} into the vehicle file under [extra], "
            "and give that with --vehicle."
        )
    for name in ("mass_kg", "arm_m", "drag_ratio_m"):
        checks.positive(name, extra[name])
    J = np.asarray(checks.positive("inertia_kg_m2", checks.shape("inertia_kg_m2", np.asarray(extra["inertia_kg_m2"], float), 3)))
    n, m = len(vehicle.rotors), float(extra["mass_kg"])
    place = np.array([(r.x, r.y) for r in vehicle.rotors])
    x, y = (place * float(extra["arm_m"]) / np.hypot(*place.T).max()).T
    share = np.array([r.share for r in vehicle.rotors])
    thrust = m * G0 / n * share / share.mean()
    levers = np.stack([-y, x, float(extra["drag_ratio_m"]) * np.array([r.spin for r in vehicle.rotors])])
    return Numbers(m, J, levers * thrust, thrust)


def estimate(name: Any, flight: Flight, vehicle: Vehicle, table: Ticks, hops: Sequence[LogPlant], progress=None) -> MethodSeries:
    """The method on its paper's plant over the hops of a flight (`log_plant.hops` of its ticks). Raises ConfigError for a method whose
    paper has no multirotor, for numbers that are missing, and for a log without the plant's measurements."""
    kind = discovery.estimator(name)
    title = discovery.title(name)
    if title not in PLANTS:
        raise ConfigError(
            f"The paper of {title} has no multirotor whose plant a log could fill: papers' plants are for {', '.join(PLANTS)}; "
            "leave --plant out."
        )
    known, parts, fill = numbers(vehicle), [], PLANTS[title]
    for k, hop in enumerate(hops, start=1):
        time = table.time[hop.rows]
        system, y = fill(known, hop, _seen(flight, hop, time))
        lacking = [n for n, column in zip(system.y_names, y.T) if not np.isfinite(column).any()]
        if lacking:
            raise ConfigError(f"{flight.name or 'The log'} lacks {', '.join(lacking)}: the plant of {title}'s paper measures them.")
        estimator = kind(system, hop.dt)
        valid = np.isfinite(y)
        # Mean rates lag half a tick behind; what is sampled at a tick's end moved with that tick's commands.
        thrust = hop.u if fill is _rates else table.thrust[hop.rows]
        u = thrust + _trim(known, table.thrust[hop.trimmed].mean(axis=0))
        _, outputs = run(estimator, u, np.where(valid, y, 0.0), valid, own.own, progress, backend=chosen(None, "jax"))
        series = own.series(title, estimator, outputs, time, k, hop.dt, NOTES)
        parts.append(replace(series, plant=f"{series.plant} ({PAPER})"))
    return joined(parts)


def _trim(known: Numbers, mean: np.ndarray) -> np.ndarray:
    """(n,) the least change of the commands after which their mean has no torque and carries the weight."""
    B = np.concatenate([known.B_tau, known.B_T[None]])
    wanted = np.array([0.0, 0.0, 0.0, known.m * G0])
    scale = np.abs(B).max(axis=1)
    return np.linalg.pinv(B / scale[:, None]) @ ((wanted - B @ mean) / scale)


def _seen(flight: Flight, hop: LogPlant, time: np.ndarray) -> Seen:
    nothing = np.full((len(time), 3), np.nan)
    rates = np.where(hop.valid[:, :3], hop.y[:, :3], np.nan)
    f_z = np.where(hop.valid[:, 3], hop.y[:, 3], np.nan)
    q = _latest(flight.signals.get("attitude"), time)
    angles = nothing if q is None else _euler(q)
    position, velocity = (_latest(flight.signals.get(name), time) for name in ("position", "velocity"))
    return Seen(angles, rates, nothing if position is None else position, nothing if velocity is None else velocity, f_z)


def _latest(signal: Signal | None, time: np.ndarray) -> np.ndarray | None:
    """(T, k) the last sample before each tick; NaN where it is older than FRESH_S."""
    if signal is None or len(signal) == 0:
        return None
    at = np.searchsorted(signal.time, time, side="right") - 1
    fresh = (at >= 0) & (time - signal.time[np.maximum(at, 0)] <= FRESH_S) & signal.valid[np.maximum(at, 0)].all(axis=1)
    return np.where(fresh[:, None], signal.values[np.maximum(at, 0)], np.nan)


def _euler(q: np.ndarray) -> np.ndarray:
    """(T, 3) roll, pitch and yaw that goes on beyond a turn."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    fine = np.isfinite(yaw)
    yaw[fine] = np.unwrap(yaw[fine])
    return np.stack([roll, pitch, yaw], axis=1)


def _torque_sd(known: Numbers, hop: LogPlant) -> np.ndarray:
    """(3,) disturbance torque [N m per root of Hz]: what the log's plant has, as angular acceleration, on these inertias."""
    return np.asarray(hop.parameters["torque_sd"]) / np.diag(hop.parameters["J"]) * known.J


def _first(y: np.ndarray) -> np.ndarray:
    """(n_y,) the first known value of each measurement."""
    return np.array([column[np.isfinite(column)][0] if np.isfinite(column).any() else 0.0 for column in y.T])


def _rates(known: Numbers, hop: LogPlant, seen: Seen) -> tuple[Any, np.ndarray]:
    gyro, accel = (hop.parameters[part] for part in ("gyro_sd", "accel_sd"))
    system = RateDynamics(
        np.diag(known.J), known.B_tau, known.B_T, known.m, gyro_sd=gyro, accel_sd=float(accel), torque_sd=_torque_sd(known, hop)
    )
    return system, np.column_stack([seen.rates, seen.f_z])


def _attitude(known: Numbers, hop: LogPlant, seen: Seen) -> tuple[Any, np.ndarray]:
    y = seen.angles
    walk: Any = np.concatenate([np.full(3, 1e-8), _torque_sd(known, hop) ** 2])
    start = np.concatenate([_first(y), np.zeros(3)])
    spread = np.concatenate([np.full(3, ANGLE_SD), known.J]) ** 2
    system = PortHamiltonianAttitude(
        np.diag(known.J), known.B_tau, generalised_force="physical", process_var=walk, measurement_var=ANGLE_SD**2, x0=start,
        P0=np.diag(spread),
    )  # fmt: skip
    return system, y


def _hover(known: Numbers, hop: LogPlant, seen: Seen) -> tuple[Any, np.ndarray]:
    B = np.concatenate([known.B_tau / known.J[:, None], -known.B_T[None] / known.m])
    walk = np.append(_torque_sd(known, hop) / known.J, FORCE_SD)
    gyro = np.broadcast_to(hop.parameters["gyro_sd"], 3)
    sd = np.concatenate([np.full(3, ANGLE_SD), [POSITION_SD], gyro, [CLIMB_SD]])
    y = np.column_stack([seen.angles, seen.position[:, 2:], seen.rates, seen.velocity[:, 2:]])
    system = LinearHover(B, measured_sd=tuple(sd), walk=tuple(walk))
    system.x0 = _first(y)
    return system, y


def _body(known: Numbers, hop: LogPlant, seen: Seen) -> tuple[Any, np.ndarray]:
    y = np.column_stack([seen.position, seen.angles])
    walk = np.concatenate([np.full(3, 1e-6), np.full(3, 1e-8), np.full(3, FORCE_SD**2), (_torque_sd(known, hop) / known.J) ** 2])
    sd: Any = np.repeat([POSITION_SD, ANGLE_SD], 3)
    start = np.concatenate([_first(y), np.zeros(6)])
    spread = np.repeat([POSITION_SD, ANGLE_SD, 1.0, 0.3], 3) ** 2
    system = RigidBody(np.diag(known.J), known.B_tau, known.B_T, known.m, measured_sd=sd, walk=walk, x0=start, P0=np.diag(spread))
    return system, y


PLANTS: dict[str, Callable[[Numbers, LogPlant, Seen], tuple[Any, np.ndarray]]] = {
    **dict.fromkeys(("lyapunov", "mh_lyapunov", "mhe"), _rates), **dict.fromkeys(("akf", "axkf"), _attitude),
    "intermediate": _hover, **dict.fromkeys(("tsukf", "atsukf"), _body),
}  # fmt: skip
"""Method -> the plant of its paper, and its measurements."""
