"""Sensor errors: noise inside the control loop, and errors added to the record when it is logged."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterator
from typing import Any

import numpy as np

from rotorwatch_lab.simulation import rotation

RESET_S = 4.0  # an estimator finds back after a jump with this time constant


class Sensors(
    namedtuple("Sensors", "gyro_sd accel_sd gyro_bias accel_bias accel_cut shake full_turns rattle attitude_sd velocity_sd position_sd")
):
    """gyro_sd [rad/s] of one sample in a step, accel_sd [m/s^2] after the filter; biases (3,); accel_cut [rad/s];
    shake [m/s^2 at full speed] of each healthy rotor, full_turns: its revolutions per second at full speed; rattle: rad/s of gyro
    per m/s^2 of it; attitude_sd [rad], velocity_sd [m/s], position_sd [m] of what is logged."""


def jumped(record: Any, at: float, tilt: float, yaw: float, speed: float, rng) -> Any:
    """The record as estimated by an estimator that jumps at time `at` [s] and recovers in seconds: tilt, yaw [rad], speed [m/s] (and as
    many metres), tilt and speed in directions that rng draws."""
    since = record.time - at
    size = np.where(since >= 0.0, np.exp(-np.maximum(since, 0.0) / RESET_S), 0.0)[:, None]
    about, to = rng.uniform(0.0, 2.0 * np.pi, 2)
    half = 0.5 * size * np.array([tilt * np.cos(about), tilt * np.sin(about), yaw])
    angle = np.linalg.norm(half, axis=1, keepdims=True)
    turn = np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=1)
    q = np.asarray(rotation.multiply(turn.T, record.q.T)).T
    off = size * speed * np.array([np.cos(to), np.sin(to), 0.3])
    return record._replace(q=q, v=record.v + off, p=record.p + off)


def readings(sensors: Sensors, record: Any, shaking: np.ndarray, rng) -> Iterator[tuple[str, np.ndarray, Any]]:
    """(signal, values (T, k), standard deviation of the white noise that each logged sample has on top, or None) of all motion.

    record: with rates, accel, q, v and p (T, ..). shaking (T, 3): of `vibration`. rng: draws the wandering error of attitudes when its
    turn comes, so that the order in which a log takes the signals is part of the flight.
    """
    yield "rates", record.rates, None
    yield "gyro", record.rates + np.asarray(sensors.gyro_bias) + float(sensors.rattle) * shaking, None
    yield "accel", record.accel + np.asarray(sensors.accel_bias) + shaking, sensors.accel_sd
    yield "attitude", with_attitude_error(record.q, rng, float(sensors.attitude_sd)), None
    yield "velocity", record.v, sensors.velocity_sd
    yield "position", record.p, sensors.position_sd


def vibration(size: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(T, 3) m/s^2: every rotor's imbalance turns with it, and nods at the same rate. size [m/s^2], angle [rad]: (T, rotors)."""
    waves = (np.cos(angle), np.sin(angle), 0.5 * np.sin(angle + 1.0))
    return np.stack([np.sum(size * wave, axis=1) for wave in waves], axis=1)


def with_attitude_error(q: np.ndarray, rng, sd: float) -> np.ndarray:
    """Attitudes (T, 4) with an estimator's slowly wandering error of `sd` rad about each axis."""
    steps = rng.standard_normal((len(q) // 100 + 2, 3)) * sd
    at = np.linspace(0.0, len(steps) - 1.0, len(q))
    e = 0.5 * np.stack([np.interp(at, np.arange(len(steps)), column) for column in steps.T], axis=1)
    w, v = q[:, :1], q[:, 1:]
    turned = np.concatenate([w - np.sum(v * e, axis=1, keepdims=True), v + w * e + np.cross(v, e)], axis=1)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)
