"""ESC telemetry of a flight: speed, current, voltage and temperature, delayed, rounded and each with its own current sensor's error.

Resolutions are those of the KISS/BLHeli telemetry frame: 100 electrical revolutions per minute, 0.01 A, 0.01 V, 1 degC. Its current
sensors are cheap: each is off by some percent, always the same, and noisy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.logs import esc_columns
from rotorwatch_lab.simulation import motor
from rotorwatch_lab.simulation.scenario import Scenario

POLE_PAIRS = 7
LATE_S = (0.01, 0.06)  # between measuring and logging, each ESC's own
SPEED_SD = 0.002  # relative
CURRENT_SCALE_SD, CURRENT_SD, CURRENT_FLOOR_A = 0.05, 0.02, 0.05
VOLTS_SD = 0.02
SPEEDS_UP_S = 0.02  # of a motor that lost its propeller: the bell alone is light
AMBIENT_DEGC, RISE_DEGC, WARMING_S = 25.0, 35.0, 30.0  # temperature rises so far at full current


def readings(scenario: Scenario, plan: Any, record: Any) -> np.ndarray:
    """(T, 4 n): speeds [rad/s], currents [A], voltages [V], temperatures [degC] as `esc_columns.names` orders them, for every row of the
    record (T rows, n rotors) of a flight of this plan."""
    rng = np.random.default_rng([scenario.seed, 3])
    w = turning(scenario, record)
    size = w.shape
    dt = float(record.time[1] - record.time[0])
    late = np.round(rng.uniform(*LATE_S, size[1]) / dt).astype(int)
    rows = np.maximum(np.arange(size[0])[:, None] - late, 0)
    columns = np.arange(size[1])
    rpm = w * float(plan.sensors.full_turns) * 60.0
    rpm = rpm[rows, columns] * (1.0 + SPEED_SD * rng.standard_normal(size))
    step = 100.0 / POLE_PAIRS
    speed = np.round(np.maximum(np.round(rpm / step), 0.0) * step) * esc_columns.RPM
    scale = 1.0 + CURRENT_SCALE_SD * rng.standard_normal(size[1])
    noise = rng.standard_normal(size)
    amps = scale * record.drawn[rows, columns] * (1.0 + CURRENT_SD * noise) + CURRENT_FLOOR_A * rng.standard_normal(size)
    volts = record.volts[rows] + VOLTS_SD * rng.standard_normal(size)
    heat = (record.drawn / max(float(plan.battery.current) / size[1], 1e-9)) ** 2
    degrees = AMBIENT_DEGC + RISE_DEGC * _smoothed(heat, dt / WARMING_S)
    return np.concatenate([speed, np.round(np.maximum(amps, 0.0), 2), np.round(volts, 2), np.round(degrees)], axis=1)


def turning(scenario: Scenario, record: Any) -> np.ndarray:
    """(T, n) shares of full speed: a motor without its propeller turns faster."""
    w = np.asarray(record.w).copy()
    for fault in scenario.faults:
        if fault["kind"] == "complete loss":
            k, since = fault["rotor"] - 1, record.time - fault["onset_s"]
            there = (since >= 0.0) & (record.time < (np.inf if fault["end_s"] is None else fault["end_s"]))
            gained = np.where(there, 1.0 - np.exp(-np.maximum(since, 0.0) / SPEEDS_UP_S), 0.0)
            w[:, k] += gained * (motor.unloaded(w[:, k]) - w[:, k])
    return w


def _smoothed(values: np.ndarray, share: float) -> np.ndarray:
    """First-order low-pass over rows (T, n) from 0, by `share` a row."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([share], [1.0, share - 1.0], values, axis=0))
