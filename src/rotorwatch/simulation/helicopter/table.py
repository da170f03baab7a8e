"""A helicopter's flight as its onboard computer would have logged it: one table in our own column names, and the truth beside it.

`motor_1` .. `motor_4` are the commands to main collective, tail collective, longitudinal and lateral cyclic.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.logs import memory
from rotorwatch.simulation.helicopter.loop import ACTUATORS, Plan, Record
from rotorwatch.simulation.logbook import leaning
from rotorwatch.simulation.scenario import ACTUATORS as NAMES
from rotorwatch.simulation.scenario import Scenario

RATES = {"default": 50.0, "fast": 100.0, "full": 200.0}
SUFFIXES = (".csv", ".parquet")


def record_hz(scenario: Scenario) -> float:
    """How often the flight is recorded: as often as it is logged, and not less than 100 times a second."""
    return max(100.0, RATES[scenario.logging["profile"]])


def columns(scenario: Scenario, plan: Plan, record: Record) -> dict[str, np.ndarray]:
    """The log's columns with the sensors' errors; no truth in them."""
    rng, sensors = np.random.default_rng([scenario.seed, 2]), plan.sensors
    stride = round(record_hz(scenario) / RATES[scenario.logging["profile"]])
    rows = slice(stride - 1, None, stride)

    def noisy(values, sd):
        return values[rows] + float(sd) * rng.standard_normal(values[rows].shape)

    turns = 2.0 * np.pi * float(sensors.full_turns) * record.time
    shaking = float(sensors.shake) * np.stack([np.cos(turns), np.sin(turns), 0.5 * np.sin(turns + 1.0)], axis=1)
    found = {"time_s": record.time[rows]}
    groups = {
        "motor_{}": (range(1, ACTUATORS + 1), record.command[rows]),
        "rates_{}_rad_s": ("xyz", record.rates[rows]),
        "gyro_{}_rad_s": ("xyz", (record.rates + sensors.gyro_bias + float(sensors.rattle) * shaking)[rows]),
        "accel_{}_m_s2": ("xyz", noisy(record.accel + sensors.accel_bias + shaking, sensors.accel_sd)),
        "q_{}": ("wxyz", leaning(record.q, rng, float(sensors.attitude_sd))[rows]),
        "velocity_{}_m_s": ("ned", noisy(record.v, sensors.velocity_sd)),
        "position_{}_m": ("ned", noisy(record.p, sensors.position_sd)),
    }
    for name, (axes, values) in groups.items():
        found |= {name.format(axis): values[:, k] for k, axis in enumerate(axes)}
    return found


def flight(scenario: Scenario, plan: Plan, record: Record) -> Flight:
    """The `Flight` that the written table is read as."""
    return memory.from_arrays(columns(scenario, plan, record), name=scenario.name)


def write(scenario: Scenario, plan: Plan, record: Record, path: Path) -> None:
    """Write the table as .csv or .parquet. Raises ConfigError for other endings."""
    found = columns(scenario, plan, record)
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise ConfigError("Parquet needs pyarrow: pip install rotorwatch[parquet].") from error
        pyarrow.parquet.write_table(pyarrow.table(found), path)
    elif path.suffix.lower() == ".csv":
        _write_csv(path, found)
    else:
        raise ConfigError(
            f"{path.name}: a helicopter's flight is a .csv or .parquet table; an autopilot's log would hold servo pulses behind a "
            "swashplate's mixing, which is not simulated."
        )


def write_truth(scenario: Scenario, plan: Plan, record: Record, stem: Path) -> tuple[Path, Path]:
    """Write what only the simulator knows, as STEM.truth.json and STEM.truth.csv; returns both paths."""
    theta = {f"{what}_{name}": record.theta[:, k] for k, (what, name) in enumerate(
        (what, name) for what in ("loss", "bias") for name in NAMES)}  # fmt: skip
    down = np.flatnonzero(record.flies < 0.5)
    about = {
        "name": scenario.name, "seed": scenario.seed, "frame": scenario.airframe["frame"],
        "faults": [{k: v for k, v in f.items() if v is not None} for f in scenario.faults],
        "last_theta": {name: round(float(v[-1]), 6) for name, v in theta.items()},
        "crashed_s": float(record.time[down[0]]) if down.size else None,
        "wind_m_s": [round(float(v), 6) for v in record.wind.mean(axis=0)], "mass_kg": float(plan.mass),
    }  # fmt: skip
    about_path, table_path = (stem.with_name(stem.name + f".truth.{kind}") for kind in ("json", "csv"))
    about_path.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    stride = round(record_hz(scenario) / 50.0)
    series = {"time_s": record.time}
    for names, values in (
        ("north east down", record.p), ("v_north v_east v_down", record.v), ("q_w q_x q_y q_z", record.q),
        ("p q r", record.omega), ("wind_north wind_east wind_down", record.wind),
        (" ".join(f"actuator_{name}" for name in NAMES), record.actuators),
    ):  # fmt: skip
        series |= {name: values[:, k] for k, name in enumerate(names.split())}
    _write_csv(table_path, {name: values[::stride] for name, values in (series | theta).items()})
    return about_path, table_path


def _write_csv(path: Path, table: dict[str, np.ndarray]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(table)
        out.writerows([f"{v:.9g}" for v in row] for row in np.column_stack(list(table.values())))
