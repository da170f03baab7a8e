"""The diagnoser with readers of ULog and DataFlash logs as a C99 library, a command, and a page that assesses logs in a browser.

    export_log_reader("out", page=True)

The diagnoser is the machine code that `diagnose` runs (engine/definition.py), for any number of rotors; the readers are log_reader_c/. What
both languages need to know, frames, constants and names, is written from here into rw_tables.h.
"""

from __future__ import annotations

import base64
import functools
import json
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.airframes import ardupilot, px4
from rotorwatch.answer import conclusion
from rotorwatch.base import medians
from rotorwatch.base.compiling import running
from rotorwatch.base.compiling.translate import Translation
from rotorwatch.engine import driver
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.intake import airborne, planning, sense, sizes
from rotorwatch.engine.motion import allocation, mixing, trust
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch.export import projects
from rotorwatch.flight import kinds, vehicle, vehicle_kind
from rotorwatch.logs import dataflash, dataflash_rotors, lone_values, plausible
from rotorwatch.witnesses import near_ground, witness
from rotorwatch.witnesses.aerobatic import assess as aerobatic

SOURCES = Path(__file__).parent / "log_reader_c"
PAGE, SCRIPT = "rotorwatch.html", "rotorwatch.mjs"
LEFT_TO_DIAGNOSE = (
    "These are the events that a flight controller would have announced. Only rotorwatch diagnose compares them with wind, a shifted load "
    "or late rotors, tests in all its ways whether the log contradicts itself, and assesses losses of control, damage present at take-off, "
    "ESC telemetry, vibration and reports of the autopilot."
)
WASM = (
    "--target=wasm32-wasi",
    "-msimd128",
    "-mexec-model=reactor",
    "-nostartfiles",
    "-Wl,--no-entry",
    "-Wl,--stack-first",
    "-Wl,-z,stack-size=1048576",
)
EXPORTED = "malloc", "free", "rw_assess_log"


def export_log_reader(out: str | Path, page: bool = False) -> tuple[Path, ...]:
    """Write the library and `rotorwatch-c` into the folder `out`, created where missing; returns the files written. page: compile it to
    WebAssembly as well, rotorwatch.wasm, for Node (rotorwatch.mjs) and within a page, rotorwatch.html. Raises ConfigError where clang or
    its parts for WebAssembly are missing."""
    texts = sources()
    texts["CMakeLists.txt"] = projects.log_reader_cmake([name for name in texts if name.endswith(".c") and name != "rw_main.c"])
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / name for name in texts]
    for path in written:
        path.write_text(texts[path.name], encoding="utf-8")
    if page:
        code, script = compiled(folder), (SOURCES / SCRIPT).read_text(encoding="utf-8")
        template = (SOURCES / PAGE).read_text(encoding="utf-8")
        reported = {row.name: {"noun": row.noun, "weakens": row.weakens, "accuses": row.accuses} for row in kinds.table().values()}
        filled = {
            "@KINDS@": json.dumps(reported),
            "@CODE@": base64.b64encode(code).decode(),
            "@ASSESS@": script.partition("// begin\n")[2].partition("// end\n")[0],
        }
        for mark, text in filled.items():
            template = template.replace(mark, text)
        for name, data in ("rotorwatch.wasm", code), (SCRIPT, script.encode()), (PAGE, template.encode()):
            (folder / name).write_bytes(data)
            written.append(folder / name)
    return tuple(written)


_engine = functools.cache(ENGINE.translated)


def sources() -> dict[str, str]:
    """File name -> text of the library."""
    config, header, source = _engine()
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(SOURCES.glob("*.[ch]"))}
    lone = Translation([lone_values], given=[Translation([medians])])
    texts |= {"rw_lone.h": lone.header("Lone values.", ["rw_engine.h"], "lone"), "rw_lone.c": lone.source("rw_lone.h")}
    return {**texts, "rw_config.h": config, "rw_engine.h": header, "rw_engine.c": source, "rw_tables.h": tables()}


def compiled(folder: Path) -> bytes:
    """The library in a folder as WebAssembly. Raises ConfigError where it cannot be built."""
    clang = shutil.which("clang")
    if clang is None or shutil.which("wasm-ld") is None:
        raise ConfigError(
            "A page needs clang and lld, and the C library for WebAssembly (Debian: clang lld wasi-libc libclang-rt-dev-wasm32)."
        )
    files = [str(path) for path in sorted(folder.glob("rw_*.c")) if path.name != "rw_main.c"]
    exports = [f"-Wl,--export={name}" for name in EXPORTED]
    with tempfile.TemporaryDirectory() as scratch:
        goal = Path(scratch) / "made.wasm"
        # As in running.FLAGS, but for what is of shared libraries.
        flags = [flag for flag in (*running.FLAGS, *running.VECTORS) if flag not in ("-fPIC", "-shared", "-fno-semantic-interposition")]
        command = [clang, *WASM, *flags, *exports, "-Wl,--strip-all", "-o", str(goal), *files]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            why = next((line for line in done.stderr.splitlines() if "error" in line), "nothing said")
            raise ConfigError(f"clang cannot build WebAssembly (Debian: wasi-libc, libclang-rt-dev-wasm32): {why}")
        return goal.read_bytes()


def tables() -> str:
    """rw_tables.h: frames of both autopilots and how parameters name them, constants of the way from a log to ticks, names of events."""
    frames = {name: airframes.named(name) for name in (*ardupilot.NAMES, *px4.NAMES)}
    starts = [*((n, n, f) for n, f in px4.SINGLE.items()), *((1000 * n, 1000 * n + 999, f) for n, f in px4.THOUSANDS.items())]
    names = {row.number: row.name for row in kinds.table().values()}
    constants = {
        "PI": np.pi, "EXPO_SD": vehicle.ThrustCurve(0.0, 1.0, 0.0, known=False).believed[1], "PX4_EXPO": px4.USUAL_EXPO,
        "YAW_HEADROOM": allocation.YAW_HEADROOM, "LOWER_SHARE": vehicle.LOWER_SHARE, "SAME_ARM": vehicle.SAME_ARM,
        "PLAN_READY_S": planning.READY_S, "PLAN_LAG_S": planning.LAG_S, "PLAN_LATE_PERIODS": planning.LATE_PERIODS,
        "PLAN_LATE_S": sense.LATE_S, "PLAN_SIDE_S": sense.SIDE_S, "PLAN_BEFORE_S": sense.BEFORE_S, "PLAN_CONFIRM_S": airborne.CONFIRM_S,
        "LEAST_COMMANDS": driver.LEAST, "FASTER": allocation.FASTER, "COARSE": allocation.COARSE, "ENOUGH_STEPS": allocation.ENOUGH_STEPS,
        "AEROBATIC_HZ": aerobatic.LEAST_HZ, "HOVERING": aerobatic.HOVERING, "CARRIES_LEAST": aerobatic.CARRIES[0],
        "CARRIES_MOST": aerobatic.CARRIES[1], "ASSESSED_LEAST_S": conclusion.LEAST_S, "RAW_TORQUE": dataflash.RAW_TORQUE,
        "RAW_THROTTLE": dataflash.RAW_THROTTLE, "STILL": mixing.STILL, "STILL_S": trust.STILL_S, "STILL_RAD": trust.STILL_RAD,
        "STILL_LONG_S": trust.STILL_LONG_S, "STILL_LONG_RAD": trust.STILL_LONG_RAD, "STILL_SAMPLES": trust.STILL_SAMPLES,
        "WINDOW_S": mixing.WINDOW_S, "WINDOW_LEAST": mixing.LEAST, "LEAST_WINDOWS": mixing.LEAST_WINDOWS, "SEEN": mixing.SEEN,
        "ROUNDED": mixing.ROUNDED, "OWN": mixing.OWN, "EXACT": mixing.EXACT, "BETTER": mixing.BETTER, "FOLLOWS": mixing.FOLLOWS,
        "NEARLY_ALL": mixing.NEARLY_ALL, "MIXING_HZ": mixing.RATE_HZ, "LIMIT": mixing.LIMIT, "PAIR_S": mixing.PAIR_S,
        "FALLS_S": witness.FALLS_S, "NEAR_M": near_ground.NEAR_M, "FRESH_S": near_ground.FRESH_S, "MOVES_M": near_ground.MOVES_M,
        "FAR": lone_values.FAR, "JUMPS": plausible.JUMPS, "ALONE": plausible.ALONE, "ALONE_IN_AXIS": plausible.ALONE_IN_AXIS,
        "HABIT": plausible.HABIT, "FIT_EVERY": plausible.FIT_EVERY, "FITTED": plausible.FITTED, "PARTNER_S": plausible.PARTNER_S,
        **{f"FLOOR_{name.upper()}": plausible.FLOORS[name] for name in ("control", "motors", "rates", "accel", "attitude", "velocity")},
        "PULSE_LEAST_US": dataflash.PWM_RANGE_US[0], "PULSE_MOST_US": dataflash.PWM_RANGE_US[1],
    }  # fmt: skip
    rows = [
        "/* What both languages know. Made by `rotorwatch export-c --log-reader`; not to be edited. */",
        '#ifndef RW_TABLES_H\n#define RW_TABLES_H\n\n#include "rw_engine.h"\n',
        *(f"#define RW_{name} {value!r}" for name, value in ((k, float(v) if isinstance(v, float) else v) for k, v in constants.items())),
        f'#define RW_LEFT_TO_DIAGNOSE "{LEFT_TO_DIAGNOSE}"',
        f"#define RW_FRAME_COUNT {len(frames)}\n#define RW_KIND_COUNT {max(names) + 1}\n",
        "/* Frames: as autopilots number their rotors; effectiveness and mixer as of rw_vehicle. */",
        "typedef struct {\n    const char *name;\n    int rotors;\n    bool mixer_known;\n    rw_real effectiveness[4][RW_ROTORS];\n"
        "    rw_real mixer[RW_ROTORS][4];\n} rw_frame;\n",
        _table("rw_frame RW_FRAMES", [_frame(name, one) for name, one in frames.items()]),
        "/* PX4's SYS_AUTOSTART, from first to last; ArduPilot's FRAME_CLASS and FRAME_TYPE, and the class by the name in its texts;\n"
        "   MAV_TYPE of vehicles that are no multirotors. */",
        _table("struct { int first, last; const char *frame; } RW_STARTS", [f'{{{a}, {b}, "px4-{f}"}}' for a, b, f in starts]),
        _table(
            "struct { int number, kind; const char *frame; } RW_CLASSES",
            [f'{{{number}, {kind}, "ardupilot-{name}"}}' for number, kind, name in _classes()],
        ),
        _table(
            "struct { const char *name; int number; } RW_CLASS_NAMES",
            [f'{{"{name}", {number}}}' for name, number in dataflash_rotors.FRAME_NAMES.items()],
        ),
        _table("struct { int type; const char *words; } RW_OTHERS", [f'{{{k}, "{words}"}}' for k, words in vehicle_kind.OTHERS.items()]),
        _table("char *const RW_KIND_NAMES", [f'"{names.get(k, "")}"' for k in range(max(names) + 1)]),
        "#endif\n",
    ]
    return "\n".join(rows)


def _table(name: str, rows: list[str]) -> str:
    return f"static const {name}[] = {{\n" + "".join(f"    {row},\n" for row in rows) + "};\n"


def _frame(name: str, one: vehicle.Vehicle) -> str:
    n = len(one.rotors)
    effectiveness, mixer = np.zeros((4, sizes.ROTORS)), np.zeros((sizes.ROTORS, 4))
    effectiveness[:, :n] = one.effectiveness()
    if one.mixer is not None:
        mixer[:n] = one.mixer
    known = "true" if one.mixer is not None and "tri" not in name.split("-") else "false"
    return f'{{"{name}", {n}, {known}, {_numbers(effectiveness[:, :n])}, {_numbers(mixer[:n])}}}'


def _numbers(x: Any) -> str:
    return repr(float(x)) if np.ndim(x) == 0 else "{" + ", ".join(map(_numbers, x)) + "}"


def _classes() -> list[tuple[int, int, str]]:
    """(FRAME_CLASS, FRAME_TYPE, frame) of each frame of ArduPilot."""
    found = []
    for number in ardupilot.CLASSES:
        for kind in range(max(ardupilot.TYPES) + 1):
            try:
                found.append((number, kind, ardupilot.frame_of(number, kind)))
            except VehicleError:
                continue
    return found
