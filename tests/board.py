"""The glue of an autopilot, built with that autopilot's flags against its declared headers, and flown through recorded samples."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tests import onboard_law

from rotorwatch import airframes
from rotorwatch.engine.motion import allocation
from rotorwatch.export.export_diagnoser import export_diagnoser
from rotorwatch.flight import Signal
from rotorwatch.flight.vehicle import Vehicle

EMBEDDED = Path(__file__).resolve().parents[1] / "embedded"
STUBS = EMBEDDED / "stubs"
SENSOR_HZ, OUTPUT_HZ = 100.0, 50.0  # that the glue is documented with
# Of a log that shows what a board would have seen: rates, and the share of the outputs between those of the log that can be rebuilt.
LEAST_SENSOR_HZ, LEAST_OUTPUT_HZ, LEAST_REBUILT, LEAST_CONTROL_HZ = 45.0, 19.0, 0.8, 40.0

# As their build systems give them to a library's sources, warnings being errors.
ARDUPILOT = (
    "-ffunction-sections", "-fdata-sections", "-fsigned-char", "-Wall", "-Wextra", "-Werror", "-Wpointer-arith",
    "-Wlogical-op",
    "-Wno-missing-field-initializers", "-Wno-unused-parameter", "-Wno-redundant-decls", "-Wno-trigraphs", "-Wshadow", "-Wundef",
    "-Wfloat-equal", "-Wmissing-declarations", "-Wcast-align", "-Wformat", "-Warray-bounds", "-Wuninitialized", "-Winit-self",
    "-Wunused-but-set-variable", "-fno-exceptions", "-fno-strict-aliasing", "-fomit-frame-pointer", "-fno-math-errno",
    "-fsingle-precision-constant", "-DARDUPILOT_BUILD", "-DROTORWATCH_FLOAT=1",
)  # fmt: skip
ARDUPILOT_CXX = (
    "-std=gnu++11", *ARDUPILOT, "-fno-rtti", "-fno-threadsafe-statics", "-Wreorder", "-Wformat-security", "-Wnarrowing", "-Wsign-compare",
    "-Wtype-limits", "-Wdelete-non-virtual-dtor", "-Wsuggest-override", "-Wimplicit-fallthrough", "-Wmaybe-uninitialized",
    "-Wduplicated-cond", "-Wsizeof-pointer-div", "-Wno-psabi", "-Wno-expansion-to-defined", "-D__AP_LINE__=__LINE__",
)  # fmt: skip
PX4 = (
    "-fdata-sections", "-ffunction-sections", "-fomit-frame-pointer", "-funsafe-math-optimizations", "-fno-strict-aliasing",
    "-fno-math-errno", "-fvisibility=hidden", "-include", "visibility.h",
    "-Wall", "-Wextra", "-Werror", "-Warray-bounds", "-Wcast-align", "-Wdisabled-optimization",
    "-Wdouble-promotion", "-Wfloat-equal", "-Wformat-security", "-Winit-self", "-Wlogical-op", "-Wpointer-arith", "-Wshadow",
    "-Wuninitialized", "-Wunknown-pragmas", "-Wunused-variable", "-Wno-missing-field-initializers", "-Wno-unused-parameter",
    "-fno-builtin-printf", "-fno-strength-reduce", "-Wformat=1", "-Wunused-but-set-variable", "-Wno-format-truncation",
    "-DROTORWATCH_FLOAT", '-DMODULE_NAME="rotorwatch"',
)  # fmt: skip
PX4_CXX = (
    "-std=gnu++14", *PX4, "-fcheck-new", "-fno-exceptions", "-fno-rtti", "-fno-threadsafe-statics", "-Wreorder", "-Wno-overloaded-virtual",
)  # fmt: skip
PX4_C = ("-std=gnu11", *PX4, "-fno-common", "-Wbad-function-cast", "-Wnested-externs", "-Wstrict-prototypes")
FRAME = "-Wframe-larger-than=1300"  # ArduPilot's; PX4 allows a module 2048


@dataclass(frozen=True)
class Autopilot:
    """What it takes to build the glue of one autopilot. sources: the glue; world: what stands for the autopilot; folders: of headers."""

    c: tuple[str, ...]
    cxx: tuple[str, ...]
    sources: tuple[Path, ...]
    world: tuple[Path, ...]
    folders: tuple[Path, ...]


LIBRARY = EMBEDDED / "ardupilot" / "AP_RotorDiagnosis"
MODULE = EMBEDDED / "px4" / "diagnoser"
AUTOPILOTS = {
    "ardupilot": Autopilot(
        ("-std=gnu11", *ARDUPILOT), ARDUPILOT_CXX, (LIBRARY / "AP_RotorDiagnosis.cpp",),
        (STUBS / "ardupilot" / "world.cpp", STUBS / "ardupilot" / "fly.cpp"), (LIBRARY, STUBS / "ardupilot"),
    ),
    "px4": Autopilot(
        PX4_C, PX4_CXX, (MODULE / "RotorWatchDiagnoser.cpp",),
        (STUBS / "px4" / "world.cpp", STUBS / "px4" / "fly.cpp"), (MODULE, STUBS / "px4"),
    ),
}  # fmt: skip
AUTOPILOTS["px4-1.17"] = replace(AUTOPILOTS["px4"], cxx=(*PX4_CXX, "-DROTORWATCH_MODULE_DESCRIPTOR", "-DSTUB_PX4_1_17"))


TYPES = {"uint8": "uint8_t", "uint16": "uint16_t", "uint32": "uint32_t", "uint64": "uint64_t", "float32": "float"}


def message() -> list[tuple[str, str, str | None, str | None]]:
    """Constants and fields of the uORB message: (type, name, value or None, how many or None)."""
    found = []
    for line in (MODULE / "msg" / "RotorwatchVerdict.msg").read_text().splitlines():
        line = line.partition("#")[0].strip()
        if not line:
            continue
        match = re.fullmatch(r"(\w+?)(?:\[(\d+)\])? (\w+)(?:\s*=\s*(\d+))?", line)
        assert match and match[1] in TYPES, line
        found.append((match[1], match[3], match[4], match[2]))
    return found


def topic() -> str:
    """The header that PX4 makes of the message."""
    lines = ["#pragma once", "#include <uORB/uORB.h>", "struct rotorwatch_verdict_s {"]
    for kind, name, value, many in message():
        if value is not None:
            lines.append(f"\tstatic constexpr {TYPES[kind]} {name} = {value};")
        else:
            lines.append(f"\t{TYPES[kind]} {name}{f'[{many}]' if many else ''};")
    return "\n".join([*lines, "};", "ORB_DECLARE(rotorwatch_verdict);", ""])


def compile_all(jobs: list[list[str]]) -> None:
    """Run compilers side by side, as many as there are processors; raises AssertionError with what one of them says."""
    running: list[subprocess.Popen] = []
    for command in jobs:
        while len(running) >= (os.cpu_count() or 1):
            _ended(running.pop(0))
        running.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
    for one in running:
        _ended(one)


def _ended(one: subprocess.Popen) -> None:
    said = one.communicate()[1]
    assert one.returncode == 0 and not said, f"{one.args}\n{said[:3000]}"


def build(name: str, library: Path, folder: Path, optimise: str = "-O1", more: tuple[str, ...] = ()) -> Path:
    """The program that flies samples through the glue of an autopilot. library: what `export-c --diagnoser` wrote; more: flags for all."""
    a = AUTOPILOTS[name]
    (folder / "uORB" / "topics").mkdir(parents=True, exist_ok=True)
    (folder / "uORB" / "topics" / "rotorwatch_verdict.h").write_text(topic())
    include = [f"-I{f}" for f in (folder, library, *a.folders)]
    cc, cxx = shutil.which("gcc"), shutil.which("g++")
    assert cc and cxx, "needs gcc and g++"
    jobs, objects = [], []
    sources = [p for p in sorted(library.glob("*.c")) if p.name != "example.c"]
    for source in (*a.sources, *sources, *a.world):
        flags = a.c if source.suffix == ".c" else a.cxx
        if source in a.world:  # is no firmware
            flags = ("-std=gnu++17", "-w", *(f for f in flags if f.startswith(("-D", "-include")) or f == "visibility.h"))
        objects.append(str(folder / f"{source.name}.o"))
        jobs.append([cc if source.suffix == ".c" else cxx, *flags, optimise, *more, *include, "-c", str(source), "-o", objects[-1]])
    compile_all(jobs)
    program = folder / "fly"
    compile_all([[cxx, *more, *objects, "-lm", "-lpthread", "-o", str(program)]])
    return program


@dataclass
class Flown:
    """What came out. texts: (time s, severity, text); records: of a name, rows of numbers by label; verdict: the last; size: what the
    program says of the glue: bytes, threads; left: work items of PX4 after the module was stopped; factors: (time s, (12, 4) of each motor:
    roll, pitch, yaw, throttle) that are loaded into ArduPilot's mixer, or PX4's effectiveness of a matrix of ones."""

    texts: list[tuple[float, int, str]] = field(default_factory=list)
    records: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    verdict: int = -1
    size: tuple[int, int] = (0, 0)
    left: int = 0
    factors: list[tuple[float, np.ndarray]] = field(default_factory=list)

    def events(self) -> list[dict[str, float]]:
        """The events that stand at the end, as the last record of each says."""
        last = {row["Num"]: row for row in self.records.get("RWEV", [])}
        return [row for row in last.values() if row["What"] != 2]


def fly(program: Path, table: np.ndarray, folder: Path, *words: str) -> Flown:
    """Samples (m, 24) in time order, as `onboard_law.table` makes them, through the glue."""
    samples = folder / "samples"
    np.ascontiguousarray(table, float).tofile(samples)
    done = subprocess.run([str(program), str(samples), *words], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[:2000]
    flown = Flown()
    for line in done.stdout.splitlines():
        kind, *rest = line.split("\t")
        if kind == "text":
            flown.texts.append((float(rest[0]), int(rest[1]), rest[2]))
        elif kind == "log":
            row = dict(zip(rest[1].split(","), map(float, rest[2:]), strict=True))
            flown.records.setdefault(rest[0], []).append(row)
        elif kind == "verdict":
            flown.verdict = int(rest[0])
        elif kind == "factors":
            flown.factors.append((float(rest[0]), np.array(rest[1:], float).reshape(12, 4)))
        elif kind == "left":
            flown.left = int(rest[0])
        elif kind == "size":
            flown.size = int(rest[0]), int(rest[1])
    return flown


class TooFew(Exception):
    """The log has too few samples to show what a board would have seen."""


def outputs(flight, craft) -> Signal:
    """The motor outputs as fast as they can be known, which a board reads: those of the log, and between them, where that can be trusted,
    rebuilt of the rate controller's, which many logs have more often. Raises TooFew."""
    motors, curve = flight["motors"], craft.curve
    mixed = allocation.mixed_thrusts(flight, craft)
    if mixed is None:
        return motors
    if motors.rate_hz < LEAST_OUTPUT_HZ and flight["control"].rate_hz < LEAST_CONTROL_HZ:
        rates = f"outputs at {motors.rate_hz:.0f} Hz and the rate controller's at {flight['control'].rate_hz:.0f} Hz"
        raise TooFew(f"{rates} do not say what a board has seen")
    thrust = allocation.better(allocation.motor_thrusts(flight, craft), mixed)
    e, full = curve.expo, curve.u_max - curve.u_min
    f = np.maximum(thrust.values, 0.0)
    a = f if abs(e) < 1e-6 else (np.sqrt((1.0 - e) ** 2 + 4.0 * e * f) - (1.0 - e)) / (2.0 * e)
    u = curve.u_min + full * a / allocation.battery_ratio(flight, thrust.time)[:, None]
    held = allocation.hold(motors.time, motors.values, thrust.time)
    fresh = np.logical_and.reduce(np.asarray(mixed.valid), axis=1)
    flies = held.mean(axis=1) > curve.u_min + 0.1 * full
    if motors.rate_hz < LEAST_OUTPUT_HZ and fresh[flies].mean() < LEAST_REBUILT:
        raise TooFew(f"only {100 * fresh[flies].mean():.0f} % of the outputs between those of the log can be rebuilt")
    time = np.concatenate([thrust.time[fresh], motors.time])
    values = np.concatenate([np.where(held > curve.u_min, u, held)[fresh], motors.values])
    valid = np.concatenate([np.ones_like(held, bool)[fresh], np.asarray(motors.valid)])
    order = np.argsort(time, kind="stable")
    return Signal(time[order], values[order], motors.columns, motors.unit, motors.frame, thrust.source, valid[order])


def autopilot_of(flight) -> str:
    """Whose glue a flight goes through. Raises TooFew."""
    said = flight.autopilot.lower()
    if not said.startswith(("px4", "ardu")):
        raise TooFew(f"{flight.autopilot or 'no autopilot'}: there is no glue for it")
    return "px4" if said.startswith("px4") else "ardupilot"


@dataclass(frozen=True)
class Shown:
    """A flight as a board sees it: samples for `fly`, the vehicle, and the rates that the library is exported for."""

    table: np.ndarray
    craft: Vehicle
    output_hz: float
    sensor_hz: float


def shown(flight) -> Shown:
    """Raises TooFew, VehicleError."""
    craft = airframes.identify(flight)
    if not flight.has("gyro", "accel", "motors"):
        raise TooFew("no gyro, accelerometer or outputs")
    fast = outputs(flight, craft)
    rates = [len(s.time) / float(s.time[-1] - s.time[0]) for s in (flight["gyro"], fast)]
    if rates[0] < LEAST_SENSOR_HZ or rates[1] < LEAST_OUTPUT_HZ:
        raise TooFew(f"gyro at {rates[0]:.0f} Hz, outputs at {rates[1]:.0f} Hz")
    seen = replace(flight, signals={**flight.signals, "motors": fast})
    return Shown(onboard_law.table(seen, craft), craft, float(round(min(rates[1], OUTPUT_HZ))), float(round(min(rates[0], SENSOR_HZ))))


def in_shares(what: Shown) -> Shown:
    """The same flight as PX4 would see it, which counts outputs from 0 to 1 where ArduPilot counts from 1000 to 2000."""
    table, n, curve = what.table.copy(), len(what.craft.rotors), what.craft.curve
    rows = table[:, 0] == onboard_law.OUTPUTS
    table[rows, 3 : 3 + n] = (table[rows, 3 : 3 + n] - 1000.0) / 1000.0
    curve = replace(curve, u_min=(curve.u_min - 1000.0) / 1000.0, u_max=(curve.u_max - 1000.0) / 1000.0)
    extra = {**what.craft.extra, "mixer_expo": curve.expo}
    return replace(what, table=table, craft=replace(what.craft, curve=curve, extra=extra))


def library(what: Shown, folder: Path) -> Path:
    """What `export-c --diagnoser --vehicle ... --rate-hz ... --sensor-hz ...` writes for it."""
    export_diagnoser(folder, vehicle=what.craft, rate_hz=what.output_hz, gyro_hz=what.sensor_hz, accel_hz=what.sensor_hz)
    return folder


KINDS = {"loss_of_effectiveness": 0, "output_override": 1, "contact": 2, "turned_mount": 9}
ACCUSING = (0, 1, 9)
ONSET_S = 0.3  # by which the onset of an event on board may differ from that of `diagnose`
VERDICTS = {"healthy": 1, "fault": 2, "ambiguous": 3}


def mask(rotors) -> int:
    return sum(1 << (r - 1) for r in rotors)


def expected(reported) -> list[tuple[int, int, float]]:
    """(kind, rotors, onset s) of what `diagnose` says and a board can: nothing of the blind time, no impacts."""
    return [
        (KINDS[e.kind], mask(e.rotors), e.onset_s)
        for e in reported.events
        if e.kind in KINDS and (e.extra.get("live", True) or "grew_until_s" in e.extra)
    ]


def differences(reported, flown: Flown) -> list[str]:
    """How the events that stand at the end differ from those of `diagnose`; contacts, which accuse nobody, are left out."""
    left = [(int(e["Kind"]), int(e["Rot"]), e["On"]) for e in flown.events()]
    found = []
    for kind, rotors, onset in expected(reported):
        same = [e for e in left if e[:2] == (kind, rotors)]
        near = min(same, key=lambda e: abs(e[2] - onset), default=None)
        if near is None or abs(near[2] - onset) > ONSET_S + 1e-6:
            if kind in ACCUSING:
                found.append(f"kind {kind} of {rotors:b} at {onset:.2f} s: " + (f"at {near[2]:.2f} s" if near else "missing"))
        if near is not None:
            left.remove(near)
    found += [f"kind {kind} of {rotors:b} at {onset:.2f} s: only on board" for kind, rotors, onset in left if kind in ACCUSING]
    return found
