"""What a campaign costs: `python benchmarks/campaign.py [PLAN] [--cell K] [--flights N] [--seconds S ..]`.

On a processor: processor seconds of this process (compiled programs use threads; wall time on a busy machine says little); where
JAX has an accelerator, which does its work elsewhere: seconds by the clock. After a first run that compiles. Where they go, phase
by phase, and how they grow: exponents of a power law fitted to the flights of one batch after the other, and to flights of several
lengths. 1 is linear. At last the simulator alone, in flight-steps a second, in double and single precision. Of a plan that is assessed by
logs (plans/open.toml) all cells are flown unless one is named, and of each cell fewer flights.

    python benchmarks/campaign.py PLAN --ways [--flights N] [--rounds R]

Whole campaigns, as the command runs them: by one process and by two, by one worker of a Dask scheduler and by two, in turn. Each flies
N flights and three times as many into new folders; the difference of the two counts, so that starting does not. Others may use the
computer: what the workers waited for a processor is counted, too.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

import many
import numpy as np

from rotorwatch import logs
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.toolkit import Case
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import batch, open_world
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.published import log_plant
from rotorwatch_lab.simulation import logbook, loop, prepare
from rotorwatch_lab.simulation.multirotor import MULTIROTOR

BY_TICKS = {
    "flights simulated, logged, turned into ticks": (batch, "fly"),
    "bounds": (batch, "_bounds"),
    "default estimator": (batch, "by_default"),
    "learning for published ones": (log_plant, "hops"),
}
BY_LOGS = {
    "flights drawn": (open_world, "flight_plan"),
    "simulated": (open_world, "fly_each"),
    "logs written": (logbook, "log"),
    "logs read": (logs, "from_bytes"),
    "prepared": (open_world, "prepare"),
    "assessed": (Case, "answer"),
}
FEW = 8  # flights of a cell, of a plan that is assessed by logs
COMMAND = [sys.executable, "-m", "rotorwatch", "campaign"]
WAYS = {"one process": 1, "two processes": 2, "one Dask worker": 1, "two Dask workers": 2}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", nargs="?", default=Path(__file__).parents[1] / "plans" / "default.toml")
    parser.add_argument("--cell", type=int, help="which combination of frame, autopilot and profile")
    parser.add_argument("--flights", type=int, help="most flights of a cell; with --ways: of a campaign, the shorter one")
    parser.add_argument("--seconds", type=float, nargs="*", default=[60.0, 90.0, 120.0], help="lengths of the second")
    parser.add_argument("--repeats", type=int, default=2, help="the least of so many runs counts")
    parser.add_argument("--ways", action="store_true", help="whole campaigns by processes and by Dask workers")
    parser.add_argument("--rounds", type=int, default=2, help="of these; their median counts")
    options = parser.parse_args()
    plan = campaign.read(options.plan)
    width, by_logs = batch.width(), plan.assess == "log"
    if options.ways:
        ways(options.plan, options.flights or 2 * FEW * len(plan.cells), options.rounds)
        return
    named = [options.cell] if options.cell is not None or not by_logs else range(len(plan.cells))
    cells = [cell or 0 for cell in named]
    what = " ".join(plan.cells[cells[0]]) if len(cells) == 1 else f"{len(cells)} cells"
    print(f"{what}, {batch.where()}, load {os.getloadavg()[0]:.1f}")

    least, each = FEW if by_logs else width, len(cells)
    counts = [n for n in (least, 2 * least, 4 * least) if n <= (options.flights or 4 * least)]
    assessed(plan, cells, least, width)  # compiles
    spent = [best(lambda n=n: assessed(plan, cells, n, width), options.repeats) for n in counts]
    for n, cost in zip(counts, spent, strict=True):
        print(f"{n * each:6d} flights of {plan.scenario['duration_s']:g} s: {cost:7.2f} s, {cost / n / each:.4f} s a flight")
    if len(counts) > 1:
        print(f"grows with flights as their number to the power of {exponent(counts, spent):.2f}")
    phases(plan, cells, least, width, BY_LOGS if by_logs else BY_TICKS)

    costs = []
    for seconds in options.seconds:
        longer = replace(plan, scenario={**plan.scenario, "duration_s": seconds})
        longer = replace(longer, kinds=tuple(k._replace(scenario={**k.scenario, "duration_s": seconds}) for k in plan.kinds))
        assessed(longer, cells, least, width)
        costs.append(best(lambda p=longer: assessed(p, cells, least, width), options.repeats))
        print(f"{least * each:6d} flights of {seconds:g} s: {costs[-1]:7.2f} s, {costs[-1] / least / each:.4f} s a flight")
    if len(costs) > 1:
        print(f"grows with their length to the power of {exponent(options.seconds, costs):.2f}")
    for name, cost in simulated(plan, cells[0], width, options.repeats).items():
        steps = width * plan.scenario["duration_s"] * plan.flight(cells[0]).rate_hz
        print(f"{steps / cost:.3g} flight-steps a second by the clock: the simulator alone in {name}, {width} flights side by side")


def ways(plan: Path, flights: int, rounds: int) -> None:
    """Print what whole campaigns take, each way."""
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NPROC"):  # of what is started here: one of each
        os.environ.setdefault(threads, "1")
    found: dict[str, list[np.ndarray]] = {name: [] for name in WAYS}
    with ExitStack() as stack:
        clusters = {name: stack.enter_context(many.cluster(n)) for name, n in WAYS.items() if "Dask" in name}
        for name in WAYS:  # each cell is compiled, each worker has begun
            flown(plan, flights, WAYS[name], clusters.get(name))
        for k in range(rounds):
            for name, n in WAYS.items():
                few, more = (flown(plan, count, n, clusters.get(name)) for count in (flights, 3 * flights))
                found[name].append((more - few) / (2 * flights))
                passed, alone, spent = found[name][-1]
                print(
                    f"round {k + 1}, {name}: {1.0 / passed:.2f} flights a second, {1.0 / alone:.2f} on free processors, "
                    f"{1e3 * spent:.0f} ms of processors each, load {os.getloadavg()[0]:.1f}",
                    flush=True,
                )
    middle = {name: np.median(rows, axis=0) for name, rows in found.items()}
    print("\n| | flights a second | on free processors | ms of processors a flight |\n|---|---|---|---|")
    for name, (passed, alone, spent) in middle.items():
        print(f"| {name} | {1.0 / passed:.1f} | {1.0 / alone:.1f} | {1e3 * spent:.0f} |")
    for one, two in (("one process", "two processes"), ("one Dask worker", "two Dask workers")):
        times = middle[one][:2] / middle[two][:2]
        print(f"{two}: {times[0]:.2f} times as fast as {one}, on free processors {times[1]:.2f}, {times[1] / 2:.2f} of twice")


def flown(plan: Path, count: int, workers: int, dask: many.Cluster | None) -> np.ndarray:
    """Seconds of a campaign: by the clock; by the clock, less what its workers waited for a processor that others had, in the mean; of
    processors."""
    import psutil  # comes with Dask

    how = ["--scheduler", dask.address] if dask else ["--jobs", str(workers)]
    with tempfile.TemporaryDirectory() as folder:
        command = [*COMMAND, str(plan), "--flights", str(count), *how, "-o", folder, "-q"]
        before, began = many.spent_s(dask), time.perf_counter()
        first = {part.pid: scheduled(part.pid) for part in dask.parts.values()} if dask else {}
        last = dict(first)
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        while process.poll() is None:
            mine = [process.pid, *(child.pid for child in psutil.Process(process.pid).children(recursive=True)), *first]
            last |= {pid: np.maximum(last.get(pid, 0.0), scheduled(pid)) for pid in mine}
            time.sleep(0.1)
        passed, spent = time.perf_counter() - began, many.spent_s(dask) - before
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}.")
    busiest = sorted((seen - first.get(pid, 0.0) for pid, seen in last.items()), key=lambda used: -used[0])[:workers]
    return np.array([passed, passed - np.mean([waited for _, waited in busiest]), spent])


def scheduled(pid: int) -> np.ndarray:
    """Seconds that a process has run, and that it has waited for a processor; Linux tells."""
    total = np.zeros(2)
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with suppress(OSError):  # it has ended meanwhile
            total += [1e-9 * float(word) for word in path.read_text().split()[:2]]
    return total


def simulated(plan: Plan, cell: int, width: int, repeats: int) -> dict[str, float]:
    """Precision -> least seconds by the clock to simulate a batch of the cell, records left on the device."""
    jax = load_jax()
    flights = [plan.flight(cell + len(plan.cells) * k) for k in range(width)]
    double, one, found = loop.stack([prepare.plan(flight) for flight in flights]), flights[0], {}
    single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == np.float64 else a, double)
    for name, numbers in (("float64", double), ("float32", single)):
        spent = []
        for _ in range(1 + repeats):  # the first one compiles
            began = time.perf_counter()
            jax.block_until_ready(loop.fly_many(MULTIROTOR, numbers, one.duration_s, one.rate_hz, one.record_hz, logbook.needed))
            spent.append(time.perf_counter() - began)
        found[name] = min(spent[1:])
    return found


def clock() -> float:
    """Seconds of this process' work: of the processor where it does all, else by the clock."""
    return time.process_time() if load_jax().default_backend() == "cpu" else time.perf_counter()


def assessed(plan: Plan, cells: Sequence[int], flights: int, width: int) -> None:
    """Fly and assess the cells' first flights, batch by batch, as a campaign does in one process."""
    assess = open_world.assess if plan.assess == "log" else batch.assess
    for cell in cells:
        for start in range(0, flights, width):
            places = range(start, min(start + width, flights))
            assess(plan, [cell + len(plan.cells) * k for k in places], width)


def best(run: Callable[[], None], repeats: int) -> float:
    """Least seconds of so many runs."""
    found = []
    for _ in range(repeats):
        began = clock()
        run()
        found.append(clock() - began)
    return min(found)


def exponent(sizes, costs) -> float:
    """Slope of the costs over the sizes, both in logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def phases(plan: Plan, cells: Sequence[int], flights: int, width: int, parts: dict) -> None:
    """Print what each phase takes of so many flights of each cell. parts: what a phase is called -> (module or class, function)."""
    spent = dict.fromkeys(parts, 0.0)

    def timed(text: str, function: Callable) -> Callable:
        def run(*args, **more):
            began = clock()
            try:
                made = function(*args, **more)
            finally:
                spent[text] += clock() - began
            return each(text, made) if isinstance(made, Iterator) else made

        return run

    def each(text: str, made: Iterator) -> Iterator:
        while True:
            began = clock()
            try:
                one = next(made)
            except StopIteration:
                return
            finally:
                spent[text] += clock() - began
            yield one

    originals = {text: getattr(*place) for text, place in parts.items()}
    try:
        for text, (module, name) in parts.items():
            setattr(module, name, timed(text, originals[text]))
        began = clock()
        assessed(plan, cells, flights, width)
        whole = clock() - began
    finally:
        for text, (module, name) in parts.items():
            setattr(module, name, originals[text])
    count = flights * len(cells)
    for text, seconds in spent.items():
        if seconds:
            print(f"{1e3 * seconds / count:10.1f} ms a flight, {seconds / whole:4.0%}: {text}")
    rest = whole - sum(spent.values())
    print(f"{1e3 * rest / count:10.1f} ms a flight, {rest / whole:4.0%}: events, scores and the rest")


if __name__ == "__main__":
    main()
