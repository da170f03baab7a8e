"""What a campaign costs: `python benchmarks/campaign.py [PLAN] [--cell K] [--flights N] [--seconds S ..]`.

Processor seconds of this process (compiled programs use threads; wall time on a busy machine says little), after a first run that
compiles. Where they go, phase by phase, and how they grow: exponents of a power law fitted to the flights of one batch after the other,
and to flights of several lengths. 1 is linear.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch import campaign
from rotorwatch.campaign import batch
from rotorwatch.campaign.plan import Plan

PHASES = {
    "flights simulated, logged, turned into ticks": "fly",
    "bounds": "_bounds",
    "default estimator": "_default",
    "learning for published ones": "_taught",
}


def main() -> None:
    """Print the tables."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("plan", nargs="?", default=Path(__file__).parents[1] / "plans" / "default.toml")
    asked.add_argument("--cell", type=int, default=0, help="which combination of frame, autopilot and profile")
    asked.add_argument("--flights", type=int, default=128, help="most flights of the first exponent")
    asked.add_argument("--seconds", type=float, nargs="*", default=[60.0, 90.0, 120.0], help="lengths of the second")
    asked.add_argument("--repeats", type=int, default=2, help="the least of so many runs counts")
    given = asked.parse_args()
    plan = campaign.read(given.plan)
    width = batch.width()
    print(f"{' '.join(plan.cells[given.cell])}, {batch.where()}, load {os.getloadavg()[0]:.1f}")

    counts = [n for n in (width // 4, width // 2, width, 2 * width, 4 * width) if width <= n <= given.flights]
    judged(plan, given.cell, width, width)  # compiles
    spent = [best(lambda n=n: judged(plan, given.cell, n, width), given.repeats) for n in counts]
    for n, cost in zip(counts, spent, strict=True):
        print(f"{n:6d} flights of {plan.scenario['duration_s']:g} s: {cost:7.2f} s, {cost / n:.4f} s a flight")
    if len(counts) > 1:
        print(f"grows with flights as their number to the power of {exponent(counts, spent):.2f}")
    phases(plan, given.cell, width)

    costs = []
    for seconds in given.seconds:
        longer = replace(plan, scenario={**plan.scenario, "duration_s": seconds})
        judged(longer, given.cell, width, width)
        costs.append(best(lambda p=longer: judged(p, given.cell, width, width), given.repeats))
        print(f"{width:6d} flights of {seconds:g} s: {costs[-1]:7.2f} s, {costs[-1] / width:.4f} s a flight")
    if len(costs) > 1:
        print(f"grows with their length to the power of {exponent(given.seconds, costs):.2f}")


def judged(plan: Plan, cell: int, flights: int, width: int) -> None:
    """Fly and judge the cell's first flights, batch by batch, as `campaign.run` does in one process."""
    for start in range(0, flights, width):
        batch.judge(plan, [cell + len(plan.cells) * k for k in range(start, start + width)], width)


def best(run: Callable[[], None], repeats: int) -> float:
    """Least processor seconds of so many runs."""
    found = []
    for _ in range(repeats):
        began = time.process_time()
        run()
        found.append(time.process_time() - began)
    return min(found)


def exponent(sizes, costs) -> float:
    """Slope of the costs over the sizes, both in logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def phases(plan: Plan, cell: int, width: int) -> None:
    """Print what each phase of one batch takes."""
    spent = dict.fromkeys(PHASES.values(), 0.0)

    def timed(name: str, function: Callable) -> Callable:
        def run(*given):
            began = time.process_time()
            try:
                return function(*given)
            finally:
                spent[name] += time.process_time() - began

        return run

    kept = {name: getattr(batch, name) for name in PHASES.values()}
    try:
        for name, function in kept.items():
            setattr(batch, name, timed(name, function))
        began = time.process_time()
        judged(plan, cell, width, width)
        whole = time.process_time() - began
    finally:
        for name, function in kept.items():
            setattr(batch, name, function)
    for text, name in PHASES.items():
        if spent[name]:
            print(f"{spent[name] / width:10.4f} s a flight: {text}")
    print(f"{(whole - sum(spent.values())) / width:10.4f} s a flight: events, scores and the rest")


if __name__ == "__main__":
    main()
