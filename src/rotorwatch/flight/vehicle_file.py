"""Vehicle descriptions as TOML files: geometry, thrust curve, mixer and identified gains of one airframe.

    name = "my-quad"
    lag_s = 0.03                      # command to thrust, s

    [curve]                           # share of full thrust (1 - expo) a + expo a^2, a = (u - u_min) / (u_max - u_min)
    u_min = 1150.0
    u_max = 1950.0
    expo = 0.65

    [[rotors]]                        # in the autopilot's rotor order
    x = 0.7                           # forward, arm lengths or m
    y = 0.7                           # right
    spin = "ccw"                      # seen from above; or 1 / -1
    share = 0.85                      # thrust at the same command, compared with the others; 1 when not given
    lower = true                      # in the wash of a rotor above it; false when not given

Optional: `mixer` (a row roll, pitch, yaw, throttle per rotor), `source`, `assumptions`, `[identified]` and `[extra]`.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from rotorwatch.base import files
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle

SPINS = {"ccw": 1, "cw": -1, 1: 1, -1: -1, 0: 0}
KNOWN = {"name", "rotors", "curve", "mixer", "lag_s", "identified", "source", "assumptions", "extra"}


def read(path: str | os.PathLike) -> Vehicle:
    """The vehicle described in a TOML file. Raises VehicleError naming the field that is missing or wrong."""
    try:
        table, _ = files.toml(path, "vehicle file")
    except ConfigError as error:
        raise VehicleError(str(error)) from error
    try:
        return from_table(table)
    except VehicleError as error:
        raise VehicleError(f"Vehicle file {path}: {error}") from error


def write(vehicle: Vehicle, path: str | os.PathLike) -> None:
    """Write the vehicle to a TOML file that `read` gives back unchanged; an existing file is replaced in one step."""
    text = dumps(vehicle)
    try:
        with files.replacing(path) as temporary:
            temporary.write_text(text, "utf-8")
    except ConfigError as error:
        raise VehicleError(f"Cannot write the vehicle file: {error}") from error


def from_table(table: Mapping[str, Any]) -> Vehicle:
    """The vehicle of a parsed TOML table. Raises VehicleError naming the field that is missing or wrong."""
    for key in table:
        if key not in KNOWN:
            raise VehicleError(f"unknown field {key}{meant(key, KNOWN)}; known are {', '.join(sorted(KNOWN))}.")
    rows = table.get("rotors")
    if not isinstance(rows, list) or not 3 <= len(rows) <= 32:
        raise VehicleError("rotors must be a list of 3 to 32 [[rotors]] tables.")
    rotors = tuple(_rotor(row, f"rotors[{k + 1}]") for k, row in enumerate(rows))
    if max(max(abs(r.x), abs(r.y)) for r in rotors) < 1e-6:
        raise VehicleError("rotors: all x and y are 0; give their distance from the centre of mass.")
    curve = _curve(table.get("curve"))
    mixer = table.get("mixer")
    if mixer is not None:
        try:
            mixer = np.array(mixer, dtype=float)
        except (TypeError, ValueError):
            mixer = np.empty(0)
        if mixer.shape != (len(rotors), 4) or not np.isfinite(mixer).all():
            raise VehicleError(f"mixer must be {len(rotors)} rows (roll, pitch, yaw, throttle) of numbers, one per rotor.")
    assumptions = table.get("assumptions", [])
    if not isinstance(assumptions, list) or not all(isinstance(a, str) for a in assumptions):
        raise VehicleError("assumptions must be a list of texts.")
    for key in ("identified", "extra"):
        if not isinstance(table.get(key, {}), dict):
            raise VehicleError(f"{key} must be a table.")
    return Vehicle(
        name=_text(table, "name"),
        rotors=rotors,
        curve=curve,
        mixer=mixer,
        lag_s=_number(table, "lag_s", "", 0.0, 2.0, 0.03),
        source=_text(table, "source", "vehicle file"),
        assumptions=tuple(assumptions),
        identified=table.get("identified"),
        extra=table.get("extra", {}),
    )


def dumps(vehicle: Vehicle) -> str:
    """The TOML text of a vehicle."""
    lines = [f"name = {_value(vehicle.name)}", f"source = {_value(vehicle.source)}", f"lag_s = {_value(vehicle.lag_s)}"]
    if vehicle.assumptions:
        lines.append(f"assumptions = {_value(vehicle.assumptions, spread=True)}")
    if vehicle.mixer is not None:
        lines += ["# roll, pitch, yaw, throttle of each rotor", f"mixer = {_value(vehicle.mixer, spread=True)}"]
    c = vehicle.curve
    lines += ["", "[curve]", *(f"{k} = {_value(getattr(c, k))}" for k in ("u_min", "u_max", "expo", "known"))]
    for rotor in vehicle.rotors:
        spin = {1: '"ccw"', -1: '"cw"'}.get(rotor.spin, "0")
        lines += ["", "[[rotors]]", f"x = {_value(rotor.x)}", f"y = {_value(rotor.y)}", f"spin = {spin}"]
        lines += [f"share = {_value(rotor.share)}"] if rotor.share != 1.0 else []
        lines += ["lower = true"] if rotor.lower else []
    for key, table in (("identified", vehicle.identified), ("extra", vehicle.extra)):
        if table is not None and (table or key == "identified"):
            lines += _table(key, table)
    return "\n".join(lines) + "\n"


def _table(path: str, table: Mapping) -> list[str]:
    """A TOML table and the tables inside it."""
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping) and v is not None}
    lines = ["", f"[{path}]", *(f"{_key(k)} = {_value(v)}" for k, v in plain.items())]
    for key, inner in table.items():
        if isinstance(inner, Mapping):
            lines += _table(f"{path}.{_key(key)}", inner)
    return lines


def _key(key: Any) -> str:
    text = str(key)
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else _value(text)


def _value(value: Any, spread: bool = False) -> str:
    """A TOML value; spread puts the entries of a list on lines of their own."""
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + re.sub(r"[\x00-\x1f\x7f]", lambda m: f"\\u{ord(m.group()):04x}", escaped) + '"'
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return repr(number) if math.isfinite(number) else {"inf": "inf", "-inf": "-inf"}.get(repr(number), "nan")
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple, np.ndarray)):
        items = [_value(v.item() if isinstance(v, np.ndarray) and v.ndim == 0 else v) for v in value]
        return "[\n" + "".join(f"    {i},\n" for i in items) + "]" if spread else "[" + ", ".join(items) + "]"
    raise VehicleError(f"A vehicle file cannot hold a {type(value).__name__}.")


def _rotor(row: Any, where: str) -> Rotor:
    if not isinstance(row, dict):
        raise VehicleError(f"{where} must be a table with x, y and spin.")
    spin = row.get("spin")
    spin = spin.lower() if isinstance(spin, str) else spin
    if isinstance(spin, (bool, list, dict)) or spin not in SPINS:
        raise VehicleError(f'{where}.spin must be "ccw" or "cw" (seen from above).')
    x, y = (_number(row, key, where, -100, 100) for key in ("x", "y"))
    lower = row.get("lower", False)
    if not isinstance(lower, bool):
        raise VehicleError(f"{where}.lower must be true or false.")
    return Rotor(x, y, SPINS[spin], _number(row, "share", where, 0.1, 10.0, 1.0), lower)


def _curve(row: Any) -> ThrustCurve:
    if not isinstance(row, dict):
        raise VehicleError("curve must be a [curve] table with u_min, u_max and expo.")
    low, high = (_number(row, key, "curve", -1e4, 1e4) for key in ("u_min", "u_max"))
    if not low < high:
        raise VehicleError("curve.u_max must be larger than curve.u_min.")
    known = row.get("known", True)
    if not isinstance(known, bool):
        raise VehicleError("curve.known must be true or false.")
    return ThrustCurve(low, high, _number(row, "expo", "curve", 0.0, 1.0), known)


def _number(table: Mapping, key: str, where: str, low: float, high: float, default: float | None = None) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        name = f"{where}.{key}" if where else key
        raise VehicleError(f"{name} must be a number from {low:g} to {high:g}.")
    return float(value)


def _text(table: Mapping, key: str, default: str | None = None) -> str:
    value = table.get(key, default)
    if not isinstance(value, str):
        raise VehicleError(f"{key} must be a text.")
    return value
