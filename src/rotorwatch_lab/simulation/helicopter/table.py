"""A helicopter's flight as its onboard computer would have logged it: one table in our own column names, and the truth beside it.

`motor_1` .. `motor_4` are the commands to main collective, tail collective, longitudinal and lateral cyclic.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rotorwatch.base import optional
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.logs import log_memory
from rotorwatch_lab.simulation import sensors, truth
from rotorwatch_lab.simulation.helicopter.aircraft import ACTUATORS, Plan, Record
from rotorwatch_lab.simulation.scenario import ACTUATORS as NAMES
from rotorwatch_lab.simulation.scenario import Scenario

RATES = {"default": 50.0, "fast": 100.0, "full": 200.0}
SUFFIXES = (".csv", ".parquet")
COLUMNS = {
    "rates": ("rates_{}_rad_s", "xyz"),
    "gyro": ("gyro_{}_rad_s", "xyz"),
    "accel": ("accel_{}_m_s2", "xyz"),
    "attitude": ("q_{}", "wxyz"),
    "velocity": ("velocity_{}_m_s", "ned"),
    "position": ("position_{}_m", "ned"),
}
"""What the columns of each signal are called, and its axes."""


def columns(scenario: Scenario, plan: Plan, record: Record) -> dict[str, np.ndarray]:
    """The log's columns with the sensors' errors; no truth in them."""
    rng, sensed = np.random.default_rng([scenario.seed, 2]), plan.sensors
    stride = round(scenario.record_hz / RATES[scenario.logging["profile"]])
    rows = slice(stride - 1, None, stride)
    # The main rotor turns with one speed: its imbalance is felt once per turn.
    angle = 2.0 * np.pi * float(sensed.full_turns) * record.time[:, None]
    shaking = sensors.vibration(np.full(angle.shape, float(sensed.shake)), angle)
    table = {"time_s": record.time[rows]}
    table |= {f"motor_{k + 1}": record.command[rows, k] for k in range(ACTUATORS)}
    for name, values, sd in sensors.readings(sensed, record, shaking, rng):
        logged = values[rows]
        if sd is not None:
            logged = logged + float(sd) * rng.standard_normal(logged.shape)
        column, axes = COLUMNS[name]
        table |= {column.format(axis): logged[:, k] for k, axis in enumerate(axes)}
    return table


def flight(scenario: Scenario, plan: Plan, record: Record) -> Flight:
    """The `Flight` that the written table is read as."""
    return log_memory.from_arrays(columns(scenario, plan, record), name=scenario.name)


def write(scenario: Scenario, plan: Plan, record: Record, path: Path) -> None:
    """Write the table as .csv or .parquet. Raises ConfigError for other endings."""
    table = columns(scenario, plan, record)
    if path.suffix.lower() == ".parquet":
        parquet = optional.library("pyarrow.parquet", "Parquet")
        import pyarrow

        parquet.write_table(pyarrow.table(table), path)
    elif path.suffix.lower() == ".csv":
        truth.write_csv(path, list(table), np.column_stack(list(table.values())))
    else:
        raise ConfigError(
            f"{path.name}: a helicopter's flight is a .csv or .parquet table; an autopilot's log would hold servo pulses behind a "
            "swashplate's mixing, which is not simulated."
        )


def write_truth(scenario: Scenario, plan: Plan, record: Record, stem: Path) -> tuple[Path, Path]:
    """Write what only the simulator knows, as STEM.truth.json and STEM.truth.csv; returns both paths."""
    theta = [f"{what}_{name}" for what in ("loss", "bias") for name in NAMES]
    final = {name: round(float(v), 6) for name, v in zip(theta, record.theta[-1], strict=True)}
    series = {" ".join(f"actuator_{name}" for name in NAMES): record.actuators, " ".join(theta): record.theta}
    return truth.write(scenario, record, stem, {"last_theta": final, "mass_kg": float(plan.mass)}, series)
