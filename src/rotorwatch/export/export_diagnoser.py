"""The whole default diagnoser as a C99 library for a flight controller: gate, ticks, estimator, decisions, events.

    export_diagnoser("out", vehicle="mine.toml", prefix="rotor")

All of it comes from definitions (engine/); rw_diagnoser.{h,c} (embedded_c) is the interface for a flight controller. rw_config.h and
rw_config.c hold the vehicle and the rates.
"""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import checks
from rotorwatch.base.compiling.body import exact
from rotorwatch.base.compiling.translate import Translation
from rotorwatch.engine import definition, engine
from rotorwatch.engine.bindings import event_rows, program
from rotorwatch.engine.bindings.plant_rows import lower_rotors
from rotorwatch.engine.drift import drift_sizes as trim_sizes
from rotorwatch.engine.estimator import bank
from rotorwatch.engine.estimator import estimator_sizes as engine_sizes
from rotorwatch.engine.estimator.bank import FIRST_LOSS
from rotorwatch.engine.estimator.hypotheses import hypothesis_count
from rotorwatch.engine.estimator.plant import Plant
from rotorwatch.engine.intake import sizes
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.knocks import look_back
from rotorwatch.engine.spin import rotors_off, subsets
from rotorwatch.errors import ConfigError
from rotorwatch.export import projects
from rotorwatch.flight import kinds
from rotorwatch.flight.vehicle import Vehicle

SOURCES = Path(__file__).parent / "embedded_c"
MADE = "Made of the definitions in rotorwatch/engine; not to be edited."
ROOMS = ("RECORDS", "CONTACTS", "FALLS", "EVENTS", "SAMPLES")  # buffer sizes that the compiler's -D may override
TRIM = {name: size for name, size in vars(trim_sizes).items() if name.isupper()}
QUEUE_S = 5.25  # queue of ticks: airborne.CONFIRM_S, what the ticks wait for motion, and a margin


def plant_table(vehicle: Vehicle, dt: float) -> dict[str, Any]:
    """The members of rw_plant: the estimator's prior for a vehicle, for ticks of dt seconds."""
    n = len(vehicle.rotors)
    plant = program.steps(dt, vehicle.effectiveness(), (vehicle.identified or {}).get("dynamics")).plant
    fitting = {engine_sizes.ROTORS: n, engine_sizes.STATES: engine_sizes.PLANT_STATES + n}
    table = {name: plant[name][0] for name, _ in Plant.declared()}
    return {
        name: value[tuple(slice(0, fitting.get(size, size)) for size in value.shape)] if np.ndim(value) else value
        for name, value in table.items()
    }


def settings(B: np.ndarray, dt: float) -> dict[str, Any]:
    """Entries of rw_config.h for the effectiveness B (4, n) and the length of a tick."""
    n = B.shape[1]
    opposite = max(1, sum(map(len, event_rows.opposites(B).values())) // 2)
    pairs, places = n * (n - 1) // 2, sizes.PLACES
    states, directions = engine_sizes.PLANT_STATES + n, FIRST_LOSS + n
    return {
        "ROTORS": n, "PLACES": places, "PAIRS": pairs, "HYPOTHESES": hypothesis_count(n), "TICK_S": dt,
        "REACH": bank.GROUP * max(bank.LONG if dt >= bank.SLOW_S else bank.SHORT) + 16,
        "PLANT_STATES": engine_sizes.PLANT_STATES, "STATES": states, "PRODUCTS": states * (states + 1) // 2,
        "DIRECTIONS": directions, "CROSSES": directions * (directions + 1) // 2, "SLOTS": engine_sizes.SLOTS,
        "RING": engine_sizes.RING, **TRIM, "COLUMNS": 1 + n,
        "RECORDS": 2 * n + 4, "TOGETHER": min(4, n), "ALTERNATIVES": places + 2 + opposite,
        "CONTACTS": 4, "FALLS": 4, "EVENTS": 12, "REPORTED_EVENTS": "(RW_EVENTS + 4)",
        "LISTED": "(RW_RECORDS > RW_EVENTS ? RW_RECORDS : RW_EVENTS)",
        "TICKS_BEFORE": look_back(dt), "SETTLING": 2 * look_back(dt) + 4, "QUEUE": round(QUEUE_S / dt), "WAITING": 8, "FLIGHTS": 4,
        "LEVELS": 8, "PENDING": 8, "OVERRIDES": 2 * n, "SAMPLES": 64,
        "SETS": subsets.sets_of(n), "AVERAGED": min(sizes.AVERAGED, max(1, round(subsets.AVERAGE_S / dt))),
        "MISFITS": min(sizes.MISFITS, max(1, round(rotors_off.FITS_S / dt))), "WENT_OFF": n + 2,
    }  # fmt: skip


def rates(output_hz: float, gyro_hz: float, accel_hz: float) -> dict[str, int]:
    """Entries of rw_config.h for signals at these rates [Hz]: lengths of the buffers, and the interval of motion samples."""
    half = int(np.ceil(max(gyro_hz, accel_hz) / 2)) + 2
    samples = int(np.ceil(max(0.4 * gyro_hz, 0.9 * accel_hz))) + 4
    often = int(np.ceil(max(gyro_hz, accel_hz)))
    return {
        "HALF_SECOND": half,
        "MOTION_SAMPLES": samples,
        "RECENT": int(np.ceil(output_hz / 2)) + 2,
        "MOTION_HZ": often,
        "OUTPUT_HZ": int(np.ceil(output_hz)),
    }


def config(vehicle: Vehicle, dt: float, output_hz: float, gyro_hz: float, accel_hz: float) -> str:
    """rw_config.h."""
    values = settings(vehicle.effectiveness(), dt) | rates(output_hz, gyro_hz, accel_hz)
    lines = [f"#define RW_{name} {value}" for name, value in values.items() if name not in ROOMS]
    lines += [f"#ifndef RW_{name}\n#define RW_{name} {values[name]}\n#endif" for name in ROOMS]
    head = "/* Vehicle and rates of this library. Made by `rotorwatch export-c --diagnoser`; not to be edited. */"
    return "\n".join([head, "#ifndef RW_CONFIG_H", "#define RW_CONFIG_H", *lines, "#endif", ""])


def vehicle_table(vehicle: Vehicle, output: tuple[float, float], yaw_headroom: float = allocation.YAW_HEADROOM) -> dict[str, Any]:
    """The members of rw_vehicle. output: ends of the outputs' range in the autopilot's unit."""
    coaxial = lower_rotors(vehicle.effectiveness()) is not None
    return {"rotors": len(vehicle.rotors), **allocation.table(vehicle, output, yaw_headroom), "coaxial": coaxial}


def usual_plan(rate_hz: float, control_hz: float, gyro_hz: float, accel_hz: float, known: bool) -> tick_table.Plan:
    """A plan for outputs, controller, gyro and accelerometer at these rates; known: the noise was learned from healthy flights."""
    dt = tick_table.tick_length(max(rate_hz, control_hz))
    half = dt / 2.0
    ready_s = tick_table.ready_after(tick_table.READY_KNOWN_S if known else tick_table.READY_S, dt)
    periods = {"gyro": 1.0 / gyro_hz, "accel": 1.0 / accel_hz}
    return tick_table.Plan(dt, ready_s, tick_table.LAG_S, half, "gyro", True, dict.fromkeys(periods, half), periods, ())


def text_of(table: dict[str, Any], kind: str, name: str) -> str:
    """A const struct in C."""

    def value(x: Any, real: str) -> str:
        if isinstance(x, np.ndarray):
            return "{" + ", ".join(value(part, real) for part in x) + "}"
        if isinstance(x, bool | np.bool_):
            return "true" if x else "false"
        if isinstance(x, int | np.integer):
            return str(int(x))
        return exact(float(x)) if real == "rw_time" and np.isfinite(x) else f"({real}){float(x)!r}"

    reals = {key: "rw_time" if kind == "rw_plan" and key != "hover" else "rw_real" for key in table}
    members = "".join(f"    .{key} = {value(x, reals[key])},\n" for key, x in table.items())
    return f"const {kind} {name} = {{\n{members}}};\n"


@functools.cache
def definitions() -> dict[str, str]:
    """File name -> text of the translated definitions, the same for all vehicles."""
    front = Translation(definition.FRONT, *definition.SIZES)
    estimator = Translation(definition.ESTIMATOR, *definition.SIZES, given=[front])
    trim = Translation(definition.TRIM, *definition.SIZES, given=[front, estimator])
    names = ", ".join(f'"{row.brief or row.noun}"' for row in kinds.table().values())
    joined = Translation([*definition.SPIN, engine], *definition.SIZES, given=[front, estimator, trim])
    return {
        "rw_front.h": front.header(f"The front end: samples in, ticks out. {MADE}"),
        "rw_front.c": front.source("rw_front.h"),
        "rw_estimator.h": estimator.header(f"The estimator: ticks in, losses out. {MADE}", ["rw_front.h"], "estimator"),
        "rw_estimator.c": estimator.source("rw_estimator.h"),
        "rw_trim.h": trim.header(f"The trim of a whole flight. {MADE}", ["rw_estimator.h"], "trim"),
        "rw_trim.c": trim.source("rw_trim.h"),
        "rw_engine.h": joined.header(f"All joined: samples in, events out. {MADE}", ["rw_trim.h"], "engine"),
        "rw_engine.c": joined.source("rw_engine.h"),
        "rw_names.h": f"/* What events are called, by their kind. {MADE} */\n#define RW_NAMES {{{names}}}\n",
    }


def files(vehicle: Vehicle, plan: tick_table.Plan, rates: tuple[float, float, float], tables: tuple[dict, dict]) -> dict[str, str]:
    """File name -> text of the library. rates: of outputs, gyro and accelerometer [Hz]; tables: of `vehicle_table`, `plan_table`."""
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(SOURCES.glob("*.[ch]"))}
    texts |= definitions()
    texts["rw_config.h"] = config(vehicle, plan.dt, *rates)
    parts = [text_of(tables[0], "rw_vehicle", "rw_vehicle_default"), text_of(tables[1], "rw_plan", "rw_plan_default")]
    parts.append(text_of(plant_table(vehicle, plan.dt), "rw_plant", "rw_plant_default"))
    texts["rw_config.c"] = '#include "rw_diagnoser.h"\n\n' + "\n".join(parts)
    return texts


def prefixed(texts: dict[str, str], prefix: str) -> dict[str, str]:
    """The texts with the prefix rw_ or RW_ of all names replaced."""

    def renamed(text: str) -> str:
        text = re.sub(r"\brw_", f"{prefix}_", text)
        return re.sub(r"\bRW_", f"{prefix.upper()}_", text)

    return {renamed(name): renamed(text) for name, text in texts.items()}


def export_diagnoser(
    out: str | Path,
    *,
    vehicle: Vehicle | str = "ardupilot-quad-x",
    rate_hz: float = 50.0,
    control_hz: float = 0.0,
    gyro_hz: float = 100.0,
    accel_hz: float = 100.0,
    prefix: str = "rw",
) -> tuple[Path, ...]:
    """Write the library into the folder `out`, created where missing; returns the files written.

    vehicle: from `calibrate`, or an airframe's name. rate_hz: of the outputs; control_hz: of the rate controller's output, when it is an
    input and faster; gyro_hz, accel_hz: of the averaged samples. prefix: of all names. Raises ConfigError."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*", prefix):
        raise ConfigError(f"{prefix!r} cannot begin the names of C functions: give letters and digits.")
    for name, hz in (("rate_hz", rate_hz), ("gyro_hz", gyro_hz), ("accel_hz", accel_hz)):
        checks.positive(name, hz)
    craft = airframes.named(vehicle) if isinstance(vehicle, str) else vehicle
    known = craft.identified or {}
    plan = usual_plan(rate_hz, control_hz, gyro_hz, accel_hz, bool(known.get("dynamics")))
    if plan.dt > tick_table.SHORTEST_S / 2.0:
        raise ConfigError(f"Outputs at {rate_hz:g} Hz are too slow for on board: feed them at 8 Hz or more.")
    unit = (1000.0, 2000.0)
    if craft.curve.u_max <= 2.0:  # PX4's demands, to which its mixer applies no curve
        unit, craft = (0.0, 1.0), replace(craft, extra={"mixer_expo": 0.0, **craft.extra})
    tables = vehicle_table(craft, unit), tick_table.table(plan, known.get("hover"), control_hz >= 1.5 * rate_hz)
    texts = files(craft, plan, (rate_hz, gyro_hz, accel_hz), tables)
    sources = [name for name in texts if name.endswith(".c")]
    texts["example.c"] = projects.diagnoser_example(rate_hz, gyro_hz)
    texts["CMakeLists.txt"] = projects.cmake("rw_diagnoser", sources)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, text in prefixed(texts, prefix).items() if prefix != "rw" else texts.items():
        (folder / name).write_text(text, encoding="utf-8")
        written.append(folder / name)
    return tuple(written)
