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
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from rotorwatch import airframes, files
from rotorwatch.errors import ConfigError
from rotorwatch.simulation import faults, trajectories

MAX_BYTES = 1_000_000
AUTOPILOTS = ("ardupilot", "px4")
CONTROLS = ("pid", "indi")
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


FIELDS: dict[str, dict[str, Field]] = {
    "": {
        "name": Field("", about="what to call the flight"),
        "duration_s": Field(60.0, 5.0, 7200.0, "length of the flight"),
        "seed": Field(0, 0, 2**31 - 1, "same seed, same flight"),
        "autopilot": Field("ardupilot", choices=AUTOPILOTS, about="frame numbering, mixer and log"),
        "control": Field("pid", choices=CONTROLS, about="rate loop: gains and integrators, or increments (INDI)"),
        "rate_hz": Field(400.0, 200.0, 1000.0, "Runge-Kutta steps and inner control loop"),
    },
    "airframe": {
        "frame": Field(None, about="an autopilot's frame, such as `quad-x`, or a paper's airframe"),
        "mass_kg": Field(2.0, 0.02, 500.0, "without payload"),
        "arm_m": Field(0.3, 0.03, 10.0, "centre to the outermost rotor"),
        "inertia_kg_m2": Field(
            None, 1e-6, 1e4, "about x, y, z; default: 0.4, 0.4 and 0.55 arms of gyration", numbers=3
        ),
        "thrust_to_weight": Field(2.2, 1.2, 20.0, "full thrust without payload"),
        "drag_ratio_m": Field(None, 1e-4, 2.0, "yaw torque per thrust; default: 0.12 rotor radii"),
        "expo": Field(0.65, 0.0, 1.0, "thrust (1 - expo) a + expo a^2 of a command a"),
        "believed_expo": Field(None, 0.0, 1.0, "what the autopilot takes it for; default: the same"),
        "lag_s": Field(0.03, 0.002, 0.5, "time constant of a rotor's speed"),
        "rotor_radius_m": Field(None, 0.01, 5.0, "default: three quarters of what fits between neighbours"),
        "rotor_inertia_kg_m2": Field(None, 0.0, 10.0, "default: a thin blade of 1.5 % of the mass over all rotors"),
        "rotor_speed_rad_s": Field(None, 10.0, 5000.0, "at full thrust; default: a tip speed of 170 m/s"),
        "hub_height_m": Field(None, -2.0, 2.0, "rotors above the centre of mass; default: 0.1 arms"),
        "inflow": Field(1.0, 0.0, 10.0, "thrust lost to climbing, times what momentum theory has for such rotors"),
        "rotor_drag": Field(1.0, 0.0, 10.0, "times what is usual"),
        "body_drag": Field(1.0, 0.0, 10.0, "times 0.01 m v^2, twice that along z"),
        "lower_rotor": Field(0.85, 0.3, 1.0, "coaxial frames: the lower rotor's share of thrust"),
        "ground_effect": Field(True, about="stronger thrust near the ground"),
        "payload_kg": Field(0.0, 0.0, 500.0, "carried besides the mass; the autopilot does not know"),
        "payload_at_m": Field((0.0, 0.0, 0.05), -10.0, 10.0, "forward, right, down of the centre of mass", numbers=3),
    },
    "trajectory": {
        "kind": Field("hover", choices=trajectories.KINDS, about="what is flown between take-off and landing"),
        "altitude_m": Field(10.0, 1.0, 500.0, "working height"),
        "size_m": Field(10.0, 0.5, 1000.0, "side, radius, or height of a climb"),
        "speed_m_s": Field(3.0, 0.1, 30.0, "mean along a square or eight, top of a climb and of an aggressive flight"),
        "yaw_deg": Field(0.0, -360.0, 360.0, "heading at take-off"),
        "yaw_speed_deg_s": Field(0.0, -180.0, 180.0, "of a steady turn on top of the manoeuvre"),
        "take_off_s": Field(3.0, 0.5, 3600.0, "idle on the ground until then"),
        "land": Field(True, about="be down again before the end"),
    },
    "wind": {
        "speed_m_s": Field(0.0, 0.0, 30.0, "mean, 6 m above ground"),
        "from_deg": Field(0.0, -360.0, 360.0, "direction it comes from"),
        "turbulence": Field(1.0, 0.0, 5.0, "Dryden turbulence of that wind, times this"),
    },
    "battery": {
        "cells": Field(4, 1, 24, "4.2 V full, 3.5 V empty each"),
        "capacity_Ah": Field(None, 0.05, 1000.0, "default: twelve minutes of hover"),
        "resistance_ohm": Field(None, 0.0, 1.0, "default: a sag of 7 % at full thrust"),
        "compensated": Field(True, about="the autopilot corrects its commands for the voltage (ArduPilot only)"),
    },
    "sensors": {
        "gyro_noise": Field(2e-4, 0.0, 0.1, "rad/s per root Hz"),
        "accel_noise": Field(2e-3, 0.0, 1.0, "m/s^2 per root Hz"),
        "gyro_bias": Field(0.003, 0.0, 0.5, "rad/s, standard deviation; drawn once a flight"),
        "accel_bias": Field(0.08, 0.0, 5.0, "m/s^2, the same"),
        "gyro_filter_hz": Field(40.0, 5.0, 180.0, "what the rate loop sees"),
        "accel_filter_hz": Field(20.0, 2.0, 180.0, "what is logged"),
        "vibration": Field(0.5, 0.0, 50.0, "m/s^2 of each rotor at full speed, after the filter"),
    },
    "logging": {
        "profile": Field(
            "default", choices=PROFILES, about="the autopilot's default rates, faster ones, or all there is"
        ),
        "esc": Field(False, about="ESC telemetry: speeds, currents, voltages, temperatures"),
    },
}
FAULT_FIELDS: dict[str, Field] = {
    "kind": Field(None, choices=faults.KINDS, about="what breaks"),
    "rotor": Field(None, 1, 32, "the autopilot's number"),
    "actuator": Field(None, choices=ACTUATORS, about="of a helicopter, instead of a rotor"),
    "onset_s": Field(None, 0.0, 7200.0, "when it begins"),
    "end_s": Field(None, 0.0, 7200.0, "when it is gone again; default: never"),
    "strength": Field(
        None,
        -1.0,
        1.0,
        "loss, chipped, weak motor: share of thrust lost; bias: what the command is off by; bearing: friction, share of full torque",
    ),
    "level": Field(None, 0.0, 1.0, "stuck, saturated: the command it stays at"),
    "ramp_s": Field(0.0, 0.0, 3600.0, "time to grow to full strength"),
    "period_s": Field(None, 0.02, 3600.0, "intermittent: of on and off"),
    "duty": Field(0.5, 0.01, 1.0, "intermittent: part of a period that it is there"),
    "vibration": Field(6.0, 0.0, 200.0, "chipped: shaking at full speed, m/s^2"),
}
NEEDS_STRENGTH = ("loss", "bias", "chipped", "weak motor", "bearing")
SHARES = ("loss", "chipped", "weak motor", "bearing")
SOME_HAVE = {
    "strength": NEEDS_STRENGTH,
    "level": ("stuck", "saturated"),
    "ramp_s": (*NEEDS_STRENGTH, "complete loss"),
    "vibration": ("chipped",),
}
"""Fields that only these kinds of faults have."""
HELICOPTER_FIELDS: dict[str, tuple[str, ...]] = {
    "": ("name", "duration_s", "seed", "rate_hz"),
    "airframe": ("frame", "lag_s", "payload_kg"),
    "trajectory": ("kind", "altitude_m", "size_m", "speed_m_s", "yaw_deg", "yaw_speed_deg_s", "take_off_s"),
    "wind": tuple(FIELDS["wind"]),
    "battery": (),
    "sensors": tuple(FIELDS["sensors"]),
    "logging": ("profile",),
}
"""What a helicopter has of `FIELDS`."""
HELICOPTER_WAYS = tuple(kind for kind in trajectories.KINDS if kind != "aggressive")
HELICOPTER_FAULTS = ("loss", "complete loss", "stuck", "bias", "saturated")


@dataclass(frozen=True)
class Scenario:
    """A checked scenario: its tables as dictionaries of the fields in `FIELDS`, and a tuple of faults (`FAULT_FIELDS`)."""

    name: str
    duration_s: float
    seed: int
    autopilot: str
    control: str
    rate_hz: float
    airframe: Mapping[str, Any]
    trajectory: Mapping[str, Any]
    wind: Mapping[str, Any]
    battery: Mapping[str, Any]
    sensors: Mapping[str, Any]
    logging: Mapping[str, Any]
    faults: tuple[Mapping[str, Any], ...]

    def __post_init__(self):
        if self.rate_hz % self.record_hz:
            raise ConfigError(
                f"rate_hz must be a multiple of {self.record_hz:g}, the rate of the record, not {self.rate_hz:g}."
            )

    @property
    def record_hz(self) -> float:
        """How often the flight is recorded for its log."""
        return RECORD_HZ["helicopter" if self.helicopter else self.autopilot][self.logging["profile"]]

    @property
    def helicopter(self) -> bool:
        """Whether the frame is a helicopter's."""
        return is_helicopter(self.airframe["frame"])

    def with_autopilot(self, autopilot: str) -> Scenario:
        """The same flight under the other autopilot. Raises ConfigError where its log needs another rate_hz."""
        return replace(self, autopilot=autopilot)

    def with_seed(self, seed: int) -> Scenario:
        """The same scenario in other weather."""
        return replace(self, seed=seed)


def read(path: str | os.PathLike) -> Scenario:
    """The scenario in a TOML file. Raises ConfigError with one sentence that names the field."""
    table, _ = files.toml(path, "scenario", MAX_BYTES)
    try:
        return from_table({"name": os.path.splitext(os.path.basename(os.fspath(path)))[0], **table})
    except ConfigError as error:
        raise ConfigError(f"Scenario {path}: {error}") from error


def is_helicopter(frame: Any) -> bool:
    """Whether a frame's name is that of a helicopter that a paper describes."""
    return isinstance(frame, str) and frame in airframes.papers() and "main" in airframes.paper(frame)


def from_table(table: Mapping[str, Any]) -> Scenario:
    """The scenario of a parsed TOML table. Raises ConfigError naming the field that is missing or wrong."""
    known = {*FIELDS[""], *(k for k in FIELDS if k), "faults"}
    for key in table:
        if key not in known:
            raise ConfigError(f"{plain(key)} is not a field of a scenario; known are {', '.join(sorted(known))}.")
    top = _table("", {k: v for k, v in table.items() if k in FIELDS[""]}, FIELDS[""])
    parts = {}
    for part in (k for k in FIELDS if k):
        given = table.get(part, {})
        if not isinstance(given, Mapping):
            raise ConfigError(f"{part} must be a table, [{part}].")
        parts[part] = _table(f"{part}.", given, FIELDS[part])
    if parts["airframe"]["frame"] is None:
        raise ConfigError('airframe.frame is missing; name one, such as "quad-x".')
    rows = table.get("faults", [])
    if not isinstance(rows, list) or len(rows) > faults.MOST:
        raise ConfigError(f"faults must be at most {faults.MOST} [[faults]] tables.")
    helicopter = is_helicopter(parts["airframe"]["frame"])
    found = tuple(_fault(f"faults[{k + 1}]", row, top["duration_s"], helicopter) for k, row in enumerate(rows))
    if helicopter:
        _helicopter(table, top["duration_s"], parts["trajectory"])
    else:
        _times(top["duration_s"], parts["trajectory"])
    return Scenario(**top, **parts, faults=found)


def _times(duration: float, way: Mapping[str, Any]) -> None:
    """Refuse a flight too short for its own way up and down."""
    least = way["take_off_s"] + way["altitude_m"] / trajectories.CLIMB + 8.0
    least += (way["altitude_m"] / trajectories.DESCENT + 6.0) if way["land"] else 0.0
    least += way["size_m"] / trajectories.LEVEL if way["land"] and way["kind"] in ("climb", "aggressive") else 0.0
    if duration < least:
        raise ConfigError(
            f"duration_s is {duration:g}, but the way to trajectory.altitude_m and back takes {least:.0f} s."
        )


def _helicopter(table: Mapping[str, Any], duration: float, way: Mapping[str, Any]) -> None:
    """Refuse what a helicopter does not have."""
    for part, known in HELICOPTER_FIELDS.items():
        given = table.get(part, {}) if part else [key for key in table if key in FIELDS[""]]
        for key in given:
            if key not in known:
                field, has = (f"{part}.{key}", ", ".join(known) or "none") if part else (key, ", ".join(known))
                raise ConfigError(f"{field} is no field of a helicopter; it has {has}.")
    if way["kind"] not in HELICOPTER_WAYS:
        raise ConfigError(f"trajectory.kind: a helicopter flies {', '.join(HELICOPTER_WAYS)}, not {way['kind']!r}.")
    if way["take_off_s"] >= duration:
        raise ConfigError(
            f"trajectory.take_off_s is {way['take_off_s']:g}, not before the end of the flight at {duration:g} (duration_s)."
        )


def _fault(where: str, row: Any, duration: float, helicopter: bool) -> Mapping[str, Any]:
    """One row of `faults`, with all of FAULT_FIELDS; of a helicopter, `rotor` is the actuator's place."""
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
            raise ConfigError(
                f"{where}.kind: a helicopter's actuators suffer {', '.join(HELICOPTER_FAULTS)}, not {fault['kind']!r}."
            )
        fault["rotor"] = ACTUATORS.index(fault["actuator"]) + 1
    for field, kinds in SOME_HAVE.items():
        if field in row and fault["kind"] not in kinds:
            raise ConfigError(f"{where}.{field}: a {fault['kind']} has none; leave it out.")
    if "duty" in row and fault["period_s"] is None:
        raise ConfigError(f"{where}.duty: only a fault with a period_s has one.")
    if fault["onset_s"] >= duration:
        raise ConfigError(
            f"{where}.onset_s is {fault['onset_s']:g}, not before the end of the flight at {duration:g} (duration_s)."
        )
    if fault["end_s"] is not None and fault["end_s"] <= fault["onset_s"]:
        raise ConfigError(f"{where}.end_s must lie after its onset_s.")
    if fault["kind"] in NEEDS_STRENGTH and fault["strength"] is None:
        raise ConfigError(f"{where}.strength is missing: a {fault['kind']} needs one.")
    if fault["kind"] in SHARES and fault["strength"] < 0.0:
        raise ConfigError(f"{where}.strength must be a share from 0 to 1, not {fault['strength']:g}.")
    return fault


def _table(where: str, given: Mapping[str, Any], fields: Mapping[str, Field]) -> dict[str, Any]:
    """All of `fields`, as given or by default."""
    for key in given:
        if key not in fields:
            raise ConfigError(f"{where}{plain(key)} is not a field; known are {', '.join(fields)}.")
    return {
        key: _value(f"{where}{key}", given[key], field) if key in given else field.default
        for key, field in fields.items()
    }


def _value(name: str, value: Any, field: Field) -> Any:
    """One value in the kind of its field. Raises ConfigError."""
    if field.choices:
        if value not in field.choices:
            raise ConfigError(f"{name} must be one of {', '.join(field.choices)}, not {brief(value)}.")
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


def brief(value: Any) -> str:
    """A wrong value as one short line of a message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def plain(key: str) -> str:
    """A field's name as one short line of a message: in quotes where it is no word."""
    return key if key.isidentifier() and len(key) <= 60 else brief(key)


def is_number(value: Any) -> bool:
    """Whether a value of a TOML file is a finite number (an integer of hundreds of digits is none)."""
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
    found = number(name, value, low, high)
    if found != int(found):
        raise ConfigError(f"{name} must be a whole number, not {brief(value)}.")
    return int(found)
