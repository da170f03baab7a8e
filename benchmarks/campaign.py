"""What a campaign costs: `python benchmarks/campaign.py [PLAN] [--cell K] [--flights N] [--seconds S ..]`.

On a processor: processor seconds of this process (compiled programs use threads; wall time on a busy machine says little); where
JAX has an accelerator, which does its work elsewhere: seconds by the clock. After a first run that compiles. Where they go, phase
by phase, and how they grow: exponents of a power law fitted to the flights of one batch after the other, and to flights of several
lengths. 1 is linear. At last the simulator alone, in flight-steps a second, in double and single precision.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.lab import campaign
from rotorwatch.lab.campaign import batch
from rotorwatch.lab.campaign.plan import Plan
from rotorwatch.lab.simulation import logbook, loop, prepare
from rotorwatch.lab.simulation.multirotor import MULTIROTOR

PHASES = {
    "flights simulated, logged, turned into ticks": "fly",
    "bounds": "_bounds",
    "default estimator": "by_default",
    "learning for published ones": "learned_states",
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plan", nargs="?", default=Path(__file__).parents[1] / "plans" / "default.toml")
    parser.add_argument("--cell", type=int, default=0, help="which combination of frame, autopilot and profile")
    parser.add_argument("--flights", type=int, help="most flights of the first exponent; default: four batches")
    parser.add_argument("--seconds", type=float, nargs="*", default=[60.0, 90.0, 120.0], help="lengths of the second")
    parser.add_argument("--repeats", type=int, default=2, help="the least of so many runs counts")
    options = parser.parse_args()
    plan = campaign.read(options.plan)
    width = batch.width()
    print(f"{' '.join(plan.cells[options.cell])}, {batch.where()}, load {os.getloadavg()[0]:.1f}")

    counts = [n for n in (width, 2 * width, 4 * width) if n <= (options.flights or 4 * width)]
    judged(plan, options.cell, width, width)  # compiles
    spent = [best(lambda n=n: judged(plan, options.cell, n, width), options.repeats) for n in counts]
    for n, cost in zip(counts, spent, strict=True):
        print(f"{n:6d} flights of {plan.scenario['duration_s']:g} s: {cost:7.2f} s, {cost / n:.4f} s a flight")
    if len(counts) > 1:
        print(f"grows with flights as their number to the power of {exponent(counts, spent):.2f}")
    phases(plan, options.cell, width)

    costs = []
    for seconds in options.seconds:
        longer = replace(plan, scenario={**plan.scenario, "duration_s": seconds})
        judged(longer, options.cell, width, width)
        costs.append(best(lambda p=longer: judged(p, options.cell, width, width), options.repeats))
        print(f"{width:6d} flights of {seconds:g} s: {costs[-1]:7.2f} s, {costs[-1] / width:.4f} s a flight")
    if len(costs) > 1:
        print(f"grows with their length to the power of {exponent(options.seconds, costs):.2f}")
    for name, cost in simulated(plan, options.cell, width, options.repeats).items():
        steps = width * plan.scenario["duration_s"] * plan.flight(options.cell).rate_hz
        print(
            f"{steps / cost:.3g} flight-steps a second by the clock: the simulator alone in {name}, {width} flights side by side"
        )


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
            jax.block_until_ready(
                loop.fly_many(MULTIROTOR, numbers, one.duration_s, one.rate_hz, one.record_hz, logbook.needed)
            )
            spent.append(time.perf_counter() - began)
        found[name] = min(spent[1:])
    return found


def clock() -> float:
    """Seconds of this process' work: of the processor where it does all, else by the clock."""
    return time.process_time() if load_jax().default_backend() == "cpu" else time.perf_counter()


def judged(plan: Plan, cell: int, flights: int, width: int) -> None:
    """Fly and judge the cell's first flights, batch by batch, as `campaign.run` does in one process."""
    for start in range(0, flights, width):
        batch.judge(plan, [cell + len(plan.cells) * k for k in range(start, start + width)], width)


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


def phases(plan: Plan, cell: int, width: int) -> None:
    """Print what each phase of one batch takes."""
    spent = dict.fromkeys(PHASES.values(), 0.0)

    def timed(name: str, function: Callable) -> Callable:
        def run(*args):
            began = clock()
            try:
                return function(*args)
            finally:
                spent[name] += clock() - began

        return run

    originals = {name: getattr(batch, name) for name in PHASES.values()}
    try:
        for name, function in originals.items():
            setattr(batch, name, timed(name, function))
        began = clock()
        judged(plan, cell, width, width)
        whole = clock() - began
    finally:
        for name, function in originals.items():
            setattr(batch, name, function)
    for text, name in PHASES.items():
        if spent[name]:
            print(f"{spent[name] / width:10.4f} s a flight: {text}")
    print(f"{(whole - sum(spent.values())) / width:10.4f} s a flight: events, scores and the rest")


if __name__ == "__main__":
    main()
