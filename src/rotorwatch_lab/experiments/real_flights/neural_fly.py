"""Neural-Fly's flights: a quadrotor with a PX4 flight controller before a fan array, 0 to 12 m/s, tables of 50 Hz.

Frames are forward-left-up and z up. Motor commands are counts of DShot, 0 to 1999: their mean follows the thrust setpoint as 120 + 1870 T.
Over all flights the yaw acceleration rises with the commands of rotors 1 and 2: the propellers turn the other way round than PX4's. There
is no accelerometer.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch_lab.experiments.real_flights import tables

FULL = 1999.0  # DShot's largest count


def flights(checkout: Path, out: Path) -> Iterator[dict[str, Any]]:
    """Converts all flights of a checkout; yields their rows for `evaluate`, with a group."""
    vehicle = out / "vehicle.toml"
    tables.quad_x(vehicle, "neural-fly", expo=1.0, u_min=0.0, u_max=1.0, reverse=True)
    for source in sorted(checkout.glob("data/*/*.csv")):
        target = out / source.name
        convert(source, target)
        yield {"path": str(target), "vehicle": str(vehicle), "group": f"{source.parent.name}, {source.stem.rpartition('_')[2]}"}


def convert(source: Path, target: Path) -> None:
    """Write one flight as a table that `rotorwatch.read` understands."""
    with source.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    time = np.array([float(row["t"]) for row in rows])

    def column(name: str) -> np.ndarray:
        return np.array([json.loads(row[name].replace("nan", "NaN")) for row in rows], float)

    q = column("q")[:, [3, 0, 1, 2]] * np.array([1.0, *tables.FRD])  # scalar last, as published
    columns = {f"motor_{k + 1}": counts / FULL for k, counts in enumerate(column("pwm").T)}
    columns |= tables.vector("gyro", column("w") * tables.FRD, unit="rad_s") | tables.quaternion(q)
    columns |= tables.vector("velocity", column("v") * tables.FRD, "ned", "m_s")
    columns |= tables.vector("position", column("p") * tables.FRD, "ned", "m")
    tables.write(target, columns, time)
