"""The example of OpenHA: a real quadrotor whose firmware weakens rotor 1 by 45 %, then rotor 3 by 60 %, each for a minute.

Commands, Euler angles, rates and height at 20 Hz (`.._lossfactor.csv`); velocity is that of the position estimate. Rotors and losses are
those of the notebook beside it (lossfactor.ipynb), which has them from 83 to 143 s and from 113 to 173 s of the autopilot's clock; the
commands change 0.7 s before each of these full seconds, and these times are taken.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch_lab.experiments.real_flights import tables

FOLDER, NAME = "2_tutorial/examples", "log_7_2022-5-12-16-22-12"
TRUTH = ((1, 82.3, 142.3, 0.45), (3, 112.3, 172.3, 0.60))  # rotor, from, to [s], loss
ORDER = ("roll", "pitch", "yaw")


def flights(checkout: Path, out: Path) -> Iterator[dict[str, Any]]:
    """Converts the flight of a checkout; yields its rows for `evaluate`."""
    source, vehicle, target = checkout / FOLDER / f"{NAME}_lossfactor.csv", out / "vehicle.toml", out / f"{NAME}.csv"
    tables.quad_x(vehicle, "openha", expo=1.0, u_min=0.0, u_max=1.0)
    start = convert(source, checkout / FOLDER / f"{NAME}_vehicle_local_position_0.csv", target)
    for rotor, begins, ends, loss in TRUTH:
        known = {"rotor": str(rotor), "onset_s": begins - start, "end_s": ends - start, "size": loss}
        yield {"path": str(target), "vehicle": str(vehicle), "group": "losses in the firmware"} | known


def convert(source: Path, position: Path, target: Path) -> float:
    """Write the flight as a table that `rotorwatch.read` understands; returns its second 0 on the autopilot's clock."""
    with source.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    table = np.array(rows, float)
    time = table[:, 0] / 1e6
    columns = {f"motor_{k + 1}": table[:, head.index("sigma_re") + k] for k in range(4)}
    rates = np.column_stack([table[:, head.index(f"omega_re_{axis}")] for axis in "pqr"])
    columns |= tables.vector("gyro", rates, unit="rad_s")
    columns |= {f"{axis}_rad": table[:, head.index(f"euler_re_{axis}")] for axis in ORDER}
    with position.open(encoding="utf-8", newline="") as file:
        where = list(csv.DictReader(file))
    clock = np.array([float(row["timestamp"]) / 1e6 for row in where])
    velocity, place = (np.array([[float(row[name]) for name in names] for row in where]) for names in (("vx", "vy", "vz"), "xyz"))
    columns |= tables.vector("velocity", _at(time, clock, velocity), "ned", "m_s")
    columns |= tables.vector("position", _at(time, clock, place), "ned", "m")
    last = np.append(np.diff(time) > 0, True)  # the last row is there twice
    tables.write(target, {name: values[last] for name, values in columns.items()}, time[last] - time[0])
    return float(time[0])


def _at(time: np.ndarray, clock: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(time, clock, column) for column in values.T])
