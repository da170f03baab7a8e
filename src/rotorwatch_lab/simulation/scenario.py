"""Scenarios: one simulated flight as a TOML file. Every field has a default but the frame; wrong ones get one sentence.

    name = "a hexarotor loses a third of rotor 3 in a gusty square"
    duration_s = 60.0
    seed = 7
    autopilot = "ardupilot"           # or "px4": whose frame numbering, mixer and log
    control = "pid"                   # or "indi"

    [airframe]
    frame = "hexa-x"                  # docs/airframes.md; or a paper's airframe
    [trajectory]
    kind = "square"
    [wind]
    speed_m_s = 5.0
    [[faults]]
    kind = "loss"
    rotor = 3
    onset_s = 30.0
    strength = 0.35

docs/simulation.md lists all fields; `FIELDS` and `FAULT_FIELDS` are that list. A frame that is a helicopter (a paper's airframe with
a main rotor) takes those of `HELICOPTER_FIELDS` and names what breaks by `actuator`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from rotorwatch import airframes
from rotorwatch.base import files
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError
from rotorwatch_lab.simulation import faults, trajectories

MAX_BYTES = 1_000_000
AUTOPILOTS = ("ardupilot", "px4")
CONTROLS = ("pid", "indi")
DESATURATIONS = ("throttle", "sequential")
PROFILES = ("default", "fast", "full")
ACTUATORS = ("collective", "tail", "longitudinal", "lateral")
RECORD_HZ = {
    "ardupilot": {"default": 100.0, "fast": 100.0, "full": 400.0},
    "px4": {"default": 200.0, "fast": 200.0, "full": 400.0},
    "helicopter": {"default": 100.0, "fast": 100.0, "full": 200.0},
}
"""How often a flight is recorded: a multiple of every rate that its log has."""


class Field(NamedTuple):
    """A field's default (None: worked out from others), least and most, or its choices; numbers: how many, for lists; and what it is."""

    default: Any
    low: float = 0.0
    high: float = 0.0
    about: str = ""
    choices: tuple = ()
    numbers: int = 0


CHOICES = {
    "autopilot": AUTOPILOTS, "control": CONTROLS, "desaturation": DESATURATIONS,
    "trajectory.kind": trajectories.KINDS, "logging.profile": PROFILES,
    "faults.kind": faults.KINDS, "faults.actuator": ACTUATORS,
}  # fmt: skip
"""Of the fields that take one of some names."""


def _field(name: str, row: Mapping[str, Any]) -> Field:
    default = row.get("default")
    known = {**row, "default": tuple(default) if isinstance(default, list) else default}
    return Field(**known, choices=CHOICES.get(name, ()))


_TABLES = {
    part: {name: _field(name if part == "flight" else f"{part}.{name}", row) for name, row in rows.items()}
    for part, rows in files.toml(Path(__file__).with_suffix(".toml"), "table of fields")[0].items()
}
FAULT_FIELDS: dict[str, Field] = _TABLES.pop("faults")
FIELDS: dict[str, dict[str, Field]] = {"": _TABLES.pop("flight"), **_TABLES}
"""Table of a scenario ("": its top) -> its fields, of scenario.toml."""
NEEDS_STRENGTH = ("loss", "bias", "chipped", "weak motor", "bearing", "strong")
SHARES = ("loss", "chipped", "weak motor", "bearing", "strong")
NEEDS = {"strength": NEEDS_STRENGTH, "level": ("capped",), "angle_deg": ("tilt",)}
SOME_HAVE = {
    "strength": NEEDS_STRENGTH,
    "level": ("stuck", "saturated", "capped"),
    "times": ("slow",),
    "angle_deg": ("tilt",),
    "ramp_s": (*NEEDS_STRENGTH, "complete loss", "slow", "tilt"),
    "vibration": ("chipped",),
}
"""Fields that only these kinds of faults have."""
HELICOPTER_FIELDS: dict[str, tuple[str, ...]] = {
    "": ("name", "duration_s", "seed", "rate_hz"),
    "airframe": ("frame", "lag_s", "payload_kg"),
    "trajectory": ("kind", "altitude_m", "size_m", "speed_m_s", "yaw_deg", "yaw_speed_deg_s", "take_off_s"),
    "wind": tuple(name for name in FIELDS["wind"] if name != "falls"),
    "outside": (),
    "battery": (),
    "sensors": tuple(name for name in FIELDS["sensors"] if not name.startswith(("reset", "imbalance", "track"))),
    "logging": ("profile",),
}
"""What a helicopter has of `FIELDS`."""
HELICOPTER_WAYS = tuple(kind for kind in trajectories.KINDS if kind not in ("aggressive", "yaw-steps", "turning-square"))
HELICOPTER_FAULTS = ("loss", "complete loss", "stuck", "bias", "saturated")


@dataclass(frozen=True)
class Scenario:
    """A checked scenario: its tables as dictionaries of the fields in `FIELDS`, and a tuple of faults (`FAULT_FIELDS`)."""

    name: str
    duration_s: float
    seed: int
    autopilot: str
    control: str
    desaturation: str
    rate_hz: float
    airframe: Mapping[str, Any]
    trajectory: Mapping[str, Any]
    wind: Mapping[str, Any]
    outside: Mapping[str, Any]
    battery: Mapping[str, Any]
    sensors: Mapping[str, Any]
    logging: Mapping[str, Any]
    faults: tuple[Mapping[str, Any], ...]

    def __post_init__(self):
        if self.rate_hz % self.record_hz:
            raise ConfigError(f"rate_hz must be a multiple of {self.record_hz:g}, the rate of the record, not {self.rate_hz:g}.")

    @property
    def record_hz(self) -> float:
        """How often the flight is recorded for its log."""
        return RECORD_HZ["helicopter" if self.helicopter else self.autopilot][self.logging["profile"]]

    @property
    def helicopter(self) -> bool:
        """True if the frame is a helicopter's."""
        return is_helicopter(self.airframe["frame"])

    def with_autopilot(self, autopilot: str) -> Scenario:
        """The same flight under the other autopilot. Raises ConfigError where its log needs another rate_hz."""
        return replace(self, autopilot=autopilot)

    def with_seed(self, seed: int) -> Scenario:
        """The same scenario with other wind and noise."""
        return replace(self, seed=seed)


def read(path: str | os.PathLike) -> Scenario:
    """The scenario in a TOML file. Raises ConfigError with one sentence that names the field."""
    table, _ = files.toml(path, "scenario", MAX_BYTES)
    try:
        return from_table({"name": os.path.splitext(os.path.basename(os.fspath(path)))[0], **table})
    except ConfigError as error:
        raise ConfigError(f"Scenario {path}: {error}") from error


def is_helicopter(frame: Any) -> bool:
    """True if a frame's name is that of a helicopter described by a paper."""
    return isinstance(frame, str) and frame in airframes.papers() and "main" in airframes.paper(frame)


def from_table(table: Mapping[str, Any]) -> Scenario:
    """The scenario of a parsed TOML table. Raises ConfigError naming the field that is missing or wrong."""
    only_fields(table, sorted({*FIELDS[""], *(k for k in FIELDS if k), "faults"}), of=" of a scenario")
    top = _table("", {k: v for k, v in table.items() if k in FIELDS[""]}, FIELDS[""])
    parts = {}
    for part in (k for k in FIELDS if k):
        values = table.get(part, {})
        if not isinstance(values, Mapping):
            raise ConfigError(f"{part} must be a table, [{part}].")
        parts[part] = _table(f"{part}.", values, FIELDS[part])
    if parts["airframe"]["frame"] is None:
        raise ConfigError('airframe.frame is missing; name one, such as "quad-x".')
    rows = table.get("faults", [])
    if not isinstance(rows, list) or len(rows) > faults.MOST:
        raise ConfigError(f"faults must be at most {faults.MOST} [[faults]] tables.")
    helicopter = is_helicopter(parts["airframe"]["frame"])
    if parts["airframe"]["legs"] not in (0, 3, 4):
        raise ConfigError(f"airframe.legs must be 0, 3 or 4, not {parts['airframe']['legs']}.")
    found = tuple(_fault(f"faults[{k + 1}]", row, top["duration_s"], helicopter) for k, row in enumerate(rows))
    if helicopter:
        _helicopter(table, top["duration_s"], parts["trajectory"])
    else:
        _times(top["duration_s"], parts["trajectory"])
    return Scenario(**top, **parts, faults=found)


def _times(duration: float, way: Mapping[str, Any]) -> None:
    """Raise ConfigError for a flight too short for its take-off and landing."""
    least = way["take_off_s"] + way["altitude_m"] / trajectories.CLIMB + 7.0 + way["spool_s"]
    slow = way["slow_m_s"] or trajectories.DESCENT
    if way["slow_m"] > way["altitude_m"]:
        raise ConfigError(f"trajectory.slow_m is {way['slow_m']:g}, above altitude_m, {way['altitude_m']:g}.")
    down = trajectories.down_time(way["altitude_m"], way["slow_m"], slow)
    least += (down + 4.0 + way["cut_s"] + way["rest_s"]) if way["land"] else 0.0
    hop = way["spool_s"] + way["hop_m"] / trajectories.CLIMB + way["hop_s"] + way["hop_m"] / slow + way["cut_s"] + way["hop_rest_s"]
    least += way["hops"] * hop
    least += way["size_m"] / trajectories.LEVEL if way["land"] and way["kind"] in ("climb", "aggressive") else 0.0
    if duration < least:
        raise ConfigError(f"duration_s is {duration:g}, but the way to trajectory.altitude_m and back takes {least:.0f} s.")


def _helicopter(table: Mapping[str, Any], duration: float, way: Mapping[str, Any]) -> None:
    """Raise ConfigError for fields that a helicopter does not have."""
    for part, known in HELICOPTER_FIELDS.items():
        values = table.get(part, {}) if part else [key for key in table if key in FIELDS[""]]
        for key in values:
            if key not in known:
                field, has = (f"{part}.{key}", ", ".join(known) or "none") if part else (key, ", ".join(known))
                raise ConfigError(f"{field} is no field of a helicopter; it has {has}.")
    if way["kind"] not in HELICOPTER_WAYS:
        raise ConfigError(f"trajectory.kind: a helicopter flies {', '.join(HELICOPTER_WAYS)}, not {way['kind']!r}.")
    if way["take_off_s"] >= duration:
        raise ConfigError(f"trajectory.take_off_s is {way['take_off_s']:g}, not before the end of the flight at {duration:g} (duration_s).")


def _fault(where: str, row: Any, duration: float, helicopter: bool) -> Mapping[str, Any]:
    """A row of `faults`, with all of FAULT_FIELDS; of a helicopter, `rotor` is the actuator's place."""
    if not isinstance(row, Mapping):
        raise ConfigError(f"{where} must be a [[faults]] table.")
    fault = _table(f"{where}.", row, FAULT_FIELDS)
    what, other = ("actuator", "rotor") if helicopter else ("rotor", "actuator")
    if fault[other] is not None:
        vehicle = "helicopter" if helicopter else "multirotor"
        raise ConfigError(f"{where}.{other}: what breaks on a {vehicle} is named by {what}.")
    for field in ("kind", what, "onset_s"):
        if fault[field] is None:
            raise ConfigError(f"{where}.{field} is missing.")
    if helicopter:
        if fault["kind"] not in HELICOPTER_FAULTS:
            raise ConfigError(f"{where}.kind: a helicopter's actuators suffer {', '.join(HELICOPTER_FAULTS)}, not {fault['kind']!r}.")
        fault["rotor"] = ACTUATORS.index(fault["actuator"]) + 1
    for field, kinds in SOME_HAVE.items():
        if field in row and fault["kind"] not in kinds:
            raise ConfigError(f"{where}.{field}: a {fault['kind']} has none; leave it out.")
    if "duty" in row and fault["period_s"] is None:
        raise ConfigError(f"{where}.duty: only a fault with a period_s has one.")
    if fault["onset_s"] >= duration:
        raise ConfigError(f"{where}.onset_s is {fault['onset_s']:g}, not before the end of the flight at {duration:g} (duration_s).")
    if fault["end_s"] is not None and fault["end_s"] <= fault["onset_s"]:
        raise ConfigError(f"{where}.end_s must lie after its onset_s.")
    for field, kinds in NEEDS.items():
        if fault["kind"] in kinds and fault[field] is None:
            raise ConfigError(f"{where}.{field} is missing: a {fault['kind']} needs one.")
    if fault["kind"] in SHARES and fault["strength"] < 0.0:
        raise ConfigError(f"{where}.strength must be a share from 0 to 1, not {fault['strength']:g}.")
    return fault


def _table(where: str, values: Mapping[str, Any], fields: Mapping[str, Field]) -> dict[str, Any]:
    """All of `fields`, as given or by default."""
    only_fields(values, fields, where)
    return {key: _value(f"{where}{key}", values[key], field) if key in values else field.default for key, field in fields.items()}


def _value(name: str, value: Any, field: Field) -> Any:
    """A value converted to its field's type. Raises ConfigError."""
    if field.choices:
        if value not in field.choices:
            raise ConfigError(f"{name} must be one of {', '.join(field.choices)}, not {brief(value)}{meant(value, field.choices)}.")
        return value
    if isinstance(field.default, bool):
        if not isinstance(value, bool):
            raise ConfigError(f"{name} must be true or false, not {brief(value)}.")
        return value
    if field.low == field.high:
        if not isinstance(value, str):
            raise ConfigError(f"{name} must be a text, not {brief(value)}.")
        return value
    if field.numbers:
        if not isinstance(value, (list, tuple)) or len(value) != field.numbers:
            raise ConfigError(f"{name} must be {field.numbers} numbers, not {brief(value)}.")
        return tuple(number(name, v, field.low, field.high) for v in value)
    if isinstance(field.default, int) or name.endswith(".rotor"):
        return whole(name, value, field.low, field.high)
    return number(name, value, field.low, field.high)


def only_fields(table: Iterable[str], known: Collection[str], where: str = "", of: str = "") -> None:
    """Raise ConfigError for the first key of a table that is not a known field."""
    for key in table:
        if key not in known:
            raise ConfigError(f"{where}{plain(key)} is not a field{of}{meant(key, known)}; known are {', '.join(known)}.")


def brief(value: Any) -> str:
    """A wrong value as one short line of a message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def plain(key: str) -> str:
    """A field's name as one short line of a message: in quotes where it is no word."""
    return key if key.isidentifier() and len(key) <= 60 else brief(key)


def is_number(value: Any) -> bool:
    """True if a value of a TOML file is a finite number (an integer of hundreds of digits is none)."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


def number(name: str, value: Any, low: float, high: float) -> float:
    """The value as a float when it is a number in [low, high]. Raises ConfigError."""
    if not is_number(value):
        raise ConfigError(f"{name} must be a number, not {brief(value)}.")
    if not low <= value <= high:
        raise ConfigError(f"{name} must lie between {low:.10g} and {high:.10g}, not {value:g}.")
    return float(value)


def whole(name: str, value: Any, low: float, high: float) -> int:
    """The value as an int when it is a whole number in [low, high]. Raises ConfigError."""
    converted = number(name, value, low, high)
    if converted != int(converted):
        raise ConfigError(f"{name} must be a whole number, not {brief(value)}.")
    return int(converted)
