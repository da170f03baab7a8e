"""Flights to compare estimators on: simulated ones with a known loss, healthy logs with losses put in, logs with a truth table.

The simulated vehicle is independent of every estimator: rigid-body rotation with gyroscopic torque, motor lag, gusts, an
attitude and climb controller that knows nothing of the loss, 200 Hz steps; it ends in a `Flight` that goes the way of every log.
"""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import cast

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import READY_S, Case, Ticks, aerobatic, airborne, allocation, prepare
from rotorwatch_lab.estimate import Truth, read_truth
from rotorwatch_lab.experiments.inject import inject
from rotorwatch_lab.published import log_plant

STEP, SECONDS, LANDED_S = 0.005, 45.0, 1.0
AIRFRAMES = ("ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-plus")
HOVER = 0.35  # share of full thrust
INERTIA = np.array([0.012, 0.013, 0.025])  # hover thrusts of one rotor x arm, per rad/s^2
DRAG_RATIO, MOTOR_LAG, DAMPING = 0.06, 0.025, 0.02
GUST_SD, GUST_S = np.array([0.03, 0.03, 0.004, 0.02]), 0.8  # torques in those units; share of weight
GYRO_SD, ACCEL_SD = 0.005, 0.4
STAYS = 0.02  # a loss that changes by less stays
TURN_SD, TURN_S = 0.12, 2.5  # rad: how the pilot tilts


@dataclass(frozen=True)
class Scene:
    """A flight to evaluate. group: row of the table. ready: input of `diagnose` before the estimator. faults: (rotor, onset s, loss),
    1-based; none when it is healthy."""

    group: str
    name: str
    ready: Case
    faults: tuple[tuple[int, float, float], ...]

    @property
    def ticks(self) -> Ticks:
        """Its ticks."""
        return cast(Ticks, self.ready.table)

    @property
    def B(self) -> np.ndarray:
        """The vehicle's effectiveness."""
        return self.ready.vehicle.effectiveness()

    @functools.cached_property
    def hops(self) -> tuple[log_plant.LogPlant, ...]:
        """Plants and tables for published methods, the same for all of them."""
        return log_plant.hops(self.ticks, self.B)


def simulated(
    seeds: int = 2, losses: Sequence[float] = (0.2, 0.4), progress: Callable | None = None, frames: Sequence[str] = ()
) -> list[Scene]:
    """Scenes of these airframes, by default all of AIRFRAMES: for each seed a healthy flight, and one for each loss of a random rotor at a
    random time."""
    scenes, frames = [], frames or AIRFRAMES
    for k, frame in enumerate(frames):
        vehicle = airframes.named(frame)
        rng = np.random.default_rng(7 + k)
        plan = [(s, loss) for s in range(seeds) for loss in (0.0, *losses)]
        rotors = rng.integers(0, len(vehicle.rotors), len(plan))
        onsets = rng.uniform(16.0, 24.0, len(plan))
        flights = simulate(vehicle, [loss for _, loss in plan], rotors, onsets, rng)
        for flight, (_, loss), rotor, onset in zip(flights, plan, rotors, onsets):
            faults = ((int(rotor) + 1, float(onset), loss),) if loss else ()
            scenes.append(_scene(f"simulated {frame.removeprefix('ardupilot-')}", flight, vehicle, faults))
        if progress:
            progress((k + 1) / len(frames), "simulating")
    return [s for s in scenes if s is not None]


def simulate(vehicle: Vehicle, losses, rotors, onsets, rng: np.random.Generator) -> list[Flight]:
    """Flights of one vehicle, all at once: `losses`, `rotors` (0-based) and `onsets` (F,), one each."""
    B = vehicle.effectiveness()
    n, F = B.shape[1], len(losses)
    to_torque = np.diag([1.0, 1.0, DRAG_RATIO, 1.0])
    M = np.linalg.pinv(to_torque @ B)
    loss = np.zeros((F, n))
    loss[np.arange(F), rotors] = losses
    rate, angle, climb, gust, tilt = (np.zeros((F, k)) for k in (3, 3, 1, 4, 2))
    integral = np.zeros((F, 4))
    thrust = np.ones((F, n))
    rows = []
    fade, turn = np.exp(-STEP / GUST_S), np.exp(-STEP / TURN_S)
    for k in range(round(SECONDS / STEP)):
        t = k * STEP
        noisy = rate + GYRO_SD * rng.standard_normal((F, 3))
        tilt = turn * tilt + TURN_SD * np.sqrt(1 - turn**2) * rng.standard_normal((F, 2))
        error = np.column_stack([6.0 * (tilt - angle[:, :2]), -2.0 * angle[:, 2:]]) - noisy
        error = np.column_stack([error, -0.15 * climb])
        integral = np.clip(integral + STEP * error * np.array([1.0, 1.0, 0.5, 0.6]), -0.6, 0.6)
        wanted = np.column_stack([INERTIA * np.array([24.0, 24.0, 6.0]) * error[:, :3], n * (1.0 + error[:, 3:])])
        wanted += integral * np.array([1.0, 1.0, 0.1, n])
        command = np.clip(wanted @ M.T, 0.05, 1.0 / HOVER)
        thrust = thrust + (STEP / MOTOR_LAG) * (command - thrust)
        active = (t >= np.asarray(onsets))[:, None]
        wrench = (thrust * (1.0 - loss * active)) @ (to_torque @ B).T + gust * np.array([1.0, 1.0, 1.0, n])
        gust = fade * gust + GUST_SD * np.sqrt(1 - fade**2) * rng.standard_normal((F, 4))
        turning = INERTIA * rate  # (rates x turning, without NumPy's cross, which takes several times as long)
        turning = rate[:, [1, 2, 0]] * turning[:, [2, 0, 1]] - rate[:, [2, 0, 1]] * turning[:, [1, 2, 0]]
        torque = wrench[:, :3] - turning - DAMPING * rate
        rate = rate + STEP * torque / INERTIA
        angle = angle + STEP * rate
        load = wrench[:, 3] / n
        climb = climb + STEP * G0 * (load * np.cos(angle[:, 0]) * np.cos(angle[:, 1]) - 1.0)[:, None] - STEP * 0.3 * climb
        rows.append((command, noisy, -G0 * load, angle.copy()))
    command, gyro, f_z, angle = (np.array(column) for column in zip(*rows))
    f_z = f_z + ACCEL_SD * rng.standard_normal(f_z.shape)
    return [_flight(vehicle, command[:, i], gyro[:, i], f_z[:, i], angle[:, i]) for i in range(F)]


def _flight(vehicle: Vehicle, command, gyro, f_z, angle) -> Flight:
    """Log of one simulated flight: outputs and attitude at 50 Hz, inertial sensors at 100 Hz, after a second on the ground."""
    time = LANDED_S + STEP * np.arange(len(command))
    curve = vehicle.curve
    drive = allocation.drive(curve.expo, HOVER * command)
    outputs = curve.u_min + (curve.u_max - curve.u_min) * np.clip(drive, 0.0, 1.0)
    half = 0.5 * angle
    c, s = np.cos(half), np.sin(half)
    quaternion = np.column_stack([
        c[:, 0] * c[:, 1] * c[:, 2] + s[:, 0] * s[:, 1] * s[:, 2], s[:, 0] * c[:, 1] * c[:, 2] - c[:, 0] * s[:, 1] * s[:, 2],
        c[:, 0] * s[:, 1] * c[:, 2] + s[:, 0] * c[:, 1] * s[:, 2], c[:, 0] * c[:, 1] * s[:, 2] - s[:, 0] * s[:, 1] * c[:, 2],
    ])  # fmt: skip
    n = command.shape[1]
    accel = np.column_stack([np.zeros((len(f_z), 2)), f_z])
    signals = {
        "motors": Signal(time[::4], outputs[::4], tuple(f"r{i + 1}" for i in range(n)), "us", "body"),
        "gyro": Signal(time[::2], gyro[::2], ("x", "y", "z"), "rad/s", "body"),
        "accel": Signal(time[::2], accel[::2], ("x", "y", "z"), "m/s^2", "body"),
        "attitude": Signal(time[::4], quaternion[::4], ("w", "x", "y", "z"), "1", "body to NED"),
    }
    return Flight("simulated", "", signals, float(time[-1]), name=f"simulated {vehicle.name}")


def _scene(group: str, flight: Flight, vehicle: Vehicle, faults) -> Scene | None:
    ready = prepare(flight, vehicle)
    return None if ready.table is None else Scene(group, flight.name, ready, tuple(faults))


def injected(paths: Sequence[str | PathLike], losses: Sequence[float] = (0.2, 0.4), seed: int = 0) -> list[Scene]:
    """Scenes of healthy logs: each unchanged, and once for each loss put into a random rotor at a random time (`inject`)."""
    rng = np.random.default_rng(seed)
    scenes = []
    for path in paths:
        flight = _read(path)
        vehicle, air = airframes.identify(flight), airborne(flight)
        group = f"losses put into {flight.autopilot or 'other'} logs"
        scenes.append(_scene(group, flight, vehicle, ()))
        room = [(a + READY_S + 6.0, b - 8.0) for a, b in air if b - a > READY_S + 15.0]
        for loss in losses if room else ():
            onset = float(rng.uniform(*room[0]))
            rotor = int(rng.integers(1, len(vehicle.rotors) + 1))
            scenes.append(_scene(group, inject(flight, vehicle, rotor, loss, onset), vehicle, ((rotor, onset, loss),)))
    return [s for s in scenes if s is not None]


def with_truth(paths: Sequence[str | PathLike], truth: str | PathLike) -> list[Scene]:
    """Scenes of logs with a CSV table of faults: columns path, faulty_rotors (1+2), thrust_loss, start_s; matched by log name. Of a single
    log also the losses over time that `rotorwatch simulate` writes: columns time_s, loss_1 and so on.

    Left out: logs that the file does not list, losses it does not know, and (column faults) those that change on the way.
    Raises ConfigError for other files.
    """
    try:
        with open(truth, newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            rows, columns = list(table), set(table.fieldnames or ())
    except (UnicodeDecodeError, csv.Error) as why:
        raise ConfigError(f"{truth} is no table of commas and lines ({why}).") from None
    if "time_s" in columns and len(paths) == 1:
        flight = _read(paths[0])
        scene = _scene("logs with known faults", flight, airframes.identify(flight), _steps(read_truth(truth, flight.name), truth))
        return [scene] if scene else []
    if not {"path", "faulty_rotors", "thrust_loss", "start_s"} <= columns:
        raise ConfigError(f"{truth} needs the columns path, faulty_rotors, thrust_loss and start_s.")
    known = {_stem(row["path"]): row for row in rows if row["path"]}
    if not any(_stem(str(path)) in known for path in paths):
        raise ConfigError(f"{truth} names none of the logs given; its column path holds their names.")
    scenes = []
    for path in paths:
        row = known.get(_stem(str(path)))
        segments = (row.get("faults") or "").count(";") if row else 0
        if row is None or row["thrust_loss"] == "?" or segments >= len(row["faulty_rotors"].split("+")):
            continue
        flight = _read(path)
        try:
            rotors = [int(r) for r in row["faulty_rotors"].split("+") if r]
            faults = tuple((r, float(row["start_s"]), float(row["thrust_loss"])) for r in rotors)
        except ValueError:
            raise ConfigError(f"{truth}: the line of {row['path']} does not give rotors (as in 1+2), start and loss as numbers.") from None
        scenes.append(_scene("logs with known faults", flight, airframes.identify(flight), faults))
    return [s for s in scenes if s is not None]


def _steps(known: Truth, truth: str | PathLike) -> list[tuple[int, float, float]]:
    """(rotor, onset s, loss) of every loss that begins once and stays. Raises ConfigError for another."""
    faults = []
    for name, (times, values) in known.items():
        lost = np.flatnonzero(values)
        if name.startswith("loss_") and lost.size:
            if np.ptp(values[lost[0] :]) > STAYS:
                raise ConfigError(f"{truth}: {name} changes on the way; compare takes losses that begin once and stay.")
            faults.append((int(name.removeprefix("loss_")), float(times[lost[0]]), float(values[lost[-1]])))
    return faults


def _read(path: str | PathLike) -> Flight:
    flight = logs.read(path)
    aerobatic.decline(
        flight, "the published methods model hover, so that there is nothing to compare; `rotorwatch inject` puts losses into it."
    )
    return flight


def _stem(path: str) -> str:
    return Path(path).name.removesuffix(".xz").removesuffix(".gz")
