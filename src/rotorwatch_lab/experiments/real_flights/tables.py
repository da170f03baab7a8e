"""Tables that `rotorwatch.read` understands (docs/readers.md), and vehicle files, for data in other forms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rotorwatch.base import files

FRD = np.array([1.0, -1.0, -1.0])
"""Turns forward-left-up into forward-right-down, and x-north, y-west, z-up into north-east-down; of a vector's components."""


def write(path: Path, columns: Mapping[str, np.ndarray], time_s: np.ndarray) -> None:
    """Write a table with these columns (T,) at the times (T,) [s]; NaN is an empty cell."""
    names = ["time_s", *columns]
    values = np.column_stack([time_s, *columns.values()])
    with files.replacing(path) as unfinished, open(unfinished, "w", encoding="utf-8") as file:
        file.write(",".join(names) + "\n")
        for row in values:
            file.write(",".join("" if v != v else f"{v:.7g}" if k else f"{v:.6f}" for k, v in enumerate(row.tolist())) + "\n")


def vector(name: str, values: np.ndarray, axes: str = "xyz", unit: str = "") -> dict[str, np.ndarray]:
    """Columns of a vector (T, 3), as gyro_x_rad_s .. are."""
    return {f"{name}_{axis}_{unit}": values[:, k] for k, axis in enumerate(axes)}


def quaternion(q: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of quaternions (T, 4), scalar first, FRD to NED."""
    return {f"q_{axis}": q[:, k] for k, axis in enumerate("wxyz")}


def quad_x(path: Path, name: str, expo: float, u_min: float, u_max: float, reverse: bool = False) -> None:
    """Write the vehicle file of a quad X with PX4's order of rotors. expo: of the thrust curve; reverse: all spin the other way round."""
    rotors = ((0.7, 0.7, "ccw"), (-0.7, -0.7, "ccw"), (0.7, -0.7, "cw"), (-0.7, 0.7, "cw"))
    other = {"ccw": "cw", "cw": "ccw"}
    lines = [f'name = "{name}"', "[curve]", f"u_min = {u_min}", f"u_max = {u_max}", f"expo = {expo}"]
    for x, y, spin in rotors:
        lines += ["[[rotors]]", f"x = {x}", f"y = {y}", f'spin = "{other[spin] if reverse else spin}"']
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
