"""How fast is one step? rotorwatch against hand-written C++ and what else there is; one flight, a batch, live, from the start, reading.

    python benchmarks/run.py [--json OUT] [--cpu] [--rounds 5] [--steps 60000] [--flights ../shared/flights]

Needs the extras `benchmark` and `research` and a C++ compiler. The plant has 16 states, losses included; UKF, EKF, TSUKF and MHE are
the registered estimators with their defaults. The C++ in floor/ is compiled here, into a temporary folder. Nothing is timed before all
contenders have given the same to 1e-9 (relative to the largest value of each output). Contenders take turns; medians of the rounds, and
of the rounds' ratios. Slow ones step over fewer rows. --cpu counts processor time where the wall clock would count other work on the
machine too: for one flight, and for batches, where it is divided by the cores.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

if importlib.util.find_spec("jax") is None:
    raise SystemExit('JAX is missing: install the extras `benchmark` and `research`: pip install -e ".[benchmark,research]"')
os.environ.setdefault("XLA_FLAGS", f"--xla_force_host_platform_device_count={os.cpu_count()}")  # before JAX is imported

import numpy as np
from contenders import METHODS, Floor, NativeBatch, Rotorwatch, build_floor, estimator, flight, jax_program
from logs import reading, sample
from peers import peers

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.compiling import native

HERE = Path(__file__).resolve().parent
PARTS = ["single_flight", "batch", "live", "start", "read"]
SAME = 1e-9
GAPS, FULL = 2000, 300  # rows compared: with missing measurements, and all there, for those who cannot miss any
SHARE = {"mhe": 0.05}  # of the steps of one flight
PEER_SECONDS = 0.5  # that a peer's turn may take
BATCH, CHUNK = {"mhe": 100}, {"mhe": 10}  # flights (else 1000); flights at once (else 50)
BATCH_STEPS = 300  # of each: the C++ moving horizon solves the part of its window that is filled, ours always solves all of it
LIVE_STEPS = 20_000
DEVICES = {"mhe": 1}  # JAX's; its small factors and loops, run on two of the processor's devices at once, wait for each other for ever
CORES = os.cpu_count() or 1
CHILD = """
import sys; sys.path.insert(0, {here!r})
import numpy as np
from contenders import {kind}
from pathlib import Path
rows = {rows}
step = {make}
step(np.full((rows, 4), 0.35), np.zeros((rows, 6)), np.ones((rows, 6), bool))
print(next(line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")))
"""


def same(method: str, one, other, who: str) -> float:
    """The largest relative difference. Exits when that is too large for a comparison of times to mean anything."""
    one, other = (np.hstack(results) if isinstance(results, tuple) else results for results in (one, other))
    gap = float((np.abs(one - other) / np.abs(one).max(axis=0)).max())
    if not gap <= SAME:
        raise SystemExit(f"{method}: {who} differs from rotorwatch by {gap:.2g}, more than {SAME:g}: nothing is timed.")
    return gap


def agreement(library) -> dict:
    """Largest difference of every contender, method by method."""
    with_gaps, full = flight(GAPS, gaps=True), flight(FULL)
    found: dict = {}
    for method in METHODS:
        ours = Rotorwatch(method, "jax")
        results, results_full = ours(*with_gaps), ours(*full)
        found[method] = {
            "native": same(method, results, Rotorwatch(method, "native")(*with_gaps), "native code"),
            "floor": same(method, results, Floor(library, method)(*with_gaps), "the C++"),
            **{name: same(method, results_full, run(*full), name) for name, run in peers(method).items()},
        }
    return found


def turns(contenders: dict[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Seconds per step of each in each round; one after the other, so that all see the same machine."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            times[name].append(run())
    return times


def summary(times: dict[str, list[float]], ours: tuple[str, ...]) -> dict:
    """Medians in microseconds a step; the ratio is that of the better of `ours` to the floor, round by round."""
    median = {name: statistics.median(t) * 1e6 for name, t in times.items()}
    best = min(ours, key=lambda name: median[name])
    return {
        "rotorwatch_us": median[best],
        "floor_us": median["floor"],
        "ratio": statistics.median(a / b for a, b in zip(times[best], times["floor"], strict=True)),
        "best": best,
        **{f"{name}_us": median[name] for name in ours},
        "peers": {name: us for name, us in median.items() if name not in (*ours, "floor")},
    }


def single_flight(library, steps: int, rounds: int, clock: Callable[[], float]) -> dict:
    """One flight from its first row to its last."""
    out = {}
    for method in METHODS:
        rows = max(1000, int(steps * SHARE.get(method, 1.0)))
        table = flight(rows)
        everyone = {b: Rotorwatch(method, b) for b in ("jax", "native")} | {"floor": Floor(library, method)} | peers(method)
        contenders = {}
        for name, run in everyone.items():
            run(*(a[:100] for a in table))  # compiled, and warm
            start = time.perf_counter()
            run(*(a[:100] for a in table))
            # At least 100 rows of the slow ones, all of the fast ones.
            mine = rows if name in ("jax", "native", "floor") else int(PEER_SECONDS / (time.perf_counter() - start) * 100)
            part = tuple(a[: min(rows, max(100, mine))] for a in table)
            contenders[name] = clocked(partial(run, *part), len(part[0]), clock)
        out[method] = {**summary(turns(contenders, rounds), ("jax", "native")), "steps": rows}
        print(f"one flight, {method}: {printed(out[method])}", flush=True)
    return out


def clocked(run: Callable[[], object], steps: int, clock: Callable[[], float]) -> Callable[[], float]:
    """Seconds per step of one call."""

    def once() -> float:
        start = clock()
        run()
        return (clock() - start) / steps

    return once


def batch(library, rounds: int, clock: Callable[[], float]) -> dict:
    """Many flights on all cores: native code and the floor in threads, flight by flight; JAX in chunks, a device for each core."""
    out = {}
    for method in METHODS:
        count, steps, chunk = BATCH.get(method, 1000), BATCH_STEPS, CHUNK.get(method, 50)
        tables = tuple(a.reshape(count, steps, -1) for a in flight(count * steps))
        flights = [tuple(np.ascontiguousarray(a[k]) for a in tables) for k in range(count)]
        by_jax, alone = jax_batch(method, chunk, DEVICES.get(method, CORES)), jax_batch(method, count, devices=1)
        contenders = {
            "jax": partial(by_jax, *tables),
            "native": partial(threads, NativeBatch(method), flights),
            "floor": partial(threads, Floor(library, method), flights),
        }
        if method != "mhe":
            contenders["jax vmap(1000), one device"] = partial(alone, *tables)
        results = {name: np.asarray(run()) for name, run in contenders.items()}  # compiled, and the same
        for name in ("native", "floor"):
            same(method, results["jax"].reshape(-1, 20), results[name].reshape(-1, 20), f"{name} in a batch")

        timed = {name: clocked(run, count * steps, clock) for name, run in contenders.items()}
        times = turns(timed, rounds)
        out[method] = {**summary(times, ("jax", "native")), "flights": count, "steps": steps, "cores": CORES}
        print(f"batch, {method}: {printed(out[method])}", flush=True)
    return out


def threads(run: Callable, flights) -> np.ndarray:
    """Each flight by the next thread that is free."""
    with ThreadPoolExecutor(CORES) as pool:
        return np.stack(list(pool.map(lambda table: run(*table), flights)))


def jax_batch(method: str, chunk: int, devices: int = CORES) -> Callable:
    """A function of (B, T, ...) tables: `chunk` flights at once on each device."""
    jax, program = load_jax(), jax_program(method)

    def all_of(device, tables, parts):
        return [np.asarray(program(*(jax.device_put(a[k : k + chunk], device) for a in tables))) for k in parts]

    def call(*tables):
        used, starts = jax.devices()[:devices], range(0, len(tables[0]), chunk)
        shares = [list(starts)[k :: len(used)] for k in range(len(used))]
        with ThreadPoolExecutor(len(used)) as pool:
            done = list(pool.map(lambda part: all_of(part[0], tables, part[1]), zip(used, shares, strict=True)))
        order = {k: result for share, results in zip(shares, done, strict=True) for k, result in zip(share, results, strict=True)}
        return np.concatenate([order[k] for k in starts])

    return call


def live() -> dict:
    """One step at a time, from Python, with what the caller has in arrays: native.Live."""
    out: dict = {}
    for method in METHODS:
        u, y, valid = flight(LIVE_STEPS)
        step, durations = native.Live(estimator(method)), np.empty(LIVE_STEPS)
        rows = list(zip(u, y, valid, strict=True))
        for k, row in enumerate(rows):
            start = time.perf_counter_ns()
            step.step(*row)
            durations[k] = time.perf_counter_ns() - start
        p50, p99 = np.percentile(durations[1000:], [50, 99]) / 1000
        out[method] = {"p50_us": p50, "p99_us": p99}
        print(f"live, {method}: p50 {p50:.1f} us, p99 {p99:.1f} us", flush=True)
    return {"method": "ukf", **out["ukf"], "methods": out}


def start_and_memory(flights: Path, rounds: int) -> tuple[dict, dict]:
    """Seconds from the start of a process to the UKF's first result, and megabytes after 60,000 steps; and a whole verdict."""
    seconds, megabytes = {}, {}
    kinds = {b: ("Rotorwatch", f"Rotorwatch('ukf', {b!r})") for b in ("jax", "native")}
    kinds["numpy"] = ("estimator; from peers import peers", "peers('ukf')['numpy']")
    with tempfile.TemporaryDirectory() as scratch:
        for name, (kind, make) in kinds.items():
            environment = {**os.environ, "ROTORWATCH_CACHE": str(Path(scratch) / name)}

            def run(rows, code=(kind, make), environment=environment):
                text = CHILD.format(here=str(HERE), kind=code[0], make=code[1], rows=rows)
                began = time.perf_counter()
                done = subprocess.run([sys.executable, "-c", text], env=environment, capture_output=True, text=True, check=True)
                return time.perf_counter() - began, int(done.stdout.split()[-1]) * 1024 / 1e6

            if name != "numpy":
                seconds[f"{name}_cold_s"] = run(1)[0]
            seconds[f"{name}_s"] = statistics.median(run(1)[0] for _ in range(rounds))
            megabytes[f"{name}_mb"] = run(60_000 if name != "numpy" else 1000)[1]
        verdict, memory = whole_verdict(flights, Path(scratch), rounds)
    return {**seconds, **verdict}, {**megabytes, **memory}


def whole_verdict(flights: Path, scratch: Path, rounds: int) -> tuple[dict, dict]:
    """`rotorwatch diagnose` of a default-rate log, the cache filled: reading, and with native code no JAX at all."""
    from diagnose import diagnose

    log = scratch / "flight.bin"
    log.write_bytes(sample(flights))
    seconds, megabytes, before = {}, {}, os.environ.get("ROTORWATCH_BACKEND")
    for backend in ("jax", "native"):
        os.environ["ROTORWATCH_BACKEND"] = backend
        diagnose(log)
        runs = [diagnose(log) for _ in range(rounds)]
        seconds[f"diagnose_{backend}_s"] = statistics.median(run[0] for run in runs)
        megabytes[f"diagnose_{backend}_mb"] = statistics.median(run[2] for run in runs)
    os.environ.pop("ROTORWATCH_BACKEND")
    if before is not None:
        os.environ["ROTORWATCH_BACKEND"] = before
    return seconds, megabytes


def printed(row: dict) -> str:
    others = ", ".join(f"{name} {us:.1f}" for name, us in row["peers"].items())
    ours = f"rotorwatch {row['rotorwatch_us']:.2f} us ({row['best']}), C++ {row['floor_us']:.2f} us, ratio {row['ratio']:.2f}"
    return f"{ours}; JAX {row['jax_us']:.1f}, native {row['native_us']:.2f}" + (f"; {others}" if others else "")


def tables(result: dict) -> str:
    """What docs/speed.md holds."""
    lines = []
    for part, title in (("single_flight", "One flight"), ("batch", "Batch")):
        if part not in result:
            continue
        names = sorted({name for row in result[part].values() for name in row["peers"]})
        lines += [f"{title}, microseconds a step:", ""]
        lines += ["| " + " | ".join(["method", "C++", "native", "JAX", "best / C++", *names]) + " |", "|---" * (5 + len(names)) + "|"]
        for method, row in result[part].items():
            cells = [f"{row[k]:.2f}" for k in ("floor_us", "native_us", "jax_us", "ratio")]
            others = [f"{row['peers'][name]:.0f}" if name in row["peers"] else "" for name in names]
            lines.append("| " + " | ".join([method, *cells, *others]) + " |")
        lines.append("")
    if "live" in result:
        lines += ["| live step | p50 us | p99 us |", "|---|---|---|"]
        lines += [f"| {m} | {row['p50_us']:.1f} | {row['p99_us']:.1f} |" for m, row in result["live"]["methods"].items()]
    for part in ("start", "memory", "read"):
        lines += ["", f"| {part} | |", "|---|---|"]
        lines += [f"| {name} | {value:.2f} |" for name, value in result.get(part, {}).items() if isinstance(value, float)]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--parts", type=lambda text: text.split(","), default=PARTS, help="some; with --json: into that file")
    parser.add_argument("--cpu", action="store_true")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--flights", type=Path, default=HERE.parents[0] / "../shared/flights")
    chosen = parser.parse_args()
    one, many = (time.process_time, lambda: time.process_time() / CORES) if chosen.cpu else (time.perf_counter,) * 2
    result: dict = json.loads(chosen.json.read_text()) if chosen.parts != PARTS and chosen.json and chosen.json.exists() else {}
    result["machine"] = {"processor": processor(), "cores": CORES, "python": platform.python_version()}
    result["clock"] = "processor" if chosen.cpu else "wall"
    if {"single_flight", "batch"} & set(chosen.parts):
        with tempfile.TemporaryDirectory() as folder:
            library = build_floor(Path(folder))
            result["agreement"] = agreement(library)
            print("largest differences:", json.dumps(result["agreement"]), flush=True)
            if "single_flight" in chosen.parts:
                result["single_flight"] = single_flight(library, chosen.steps, chosen.rounds, one)
            if "batch" in chosen.parts:
                result["batch"] = batch(library, chosen.rounds, many)
    if "live" in chosen.parts:
        result["live"] = live()
    if "start" in chosen.parts:
        result["start"], result["memory"] = start_and_memory(chosen.flights, min(3, chosen.rounds))
    if "read" in chosen.parts:
        result["read"] = reading(chosen.flights)
    print(tables(result))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


def processor() -> str:
    """As the system calls it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


if __name__ == "__main__":
    main()
