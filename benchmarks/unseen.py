"""Does "changed by at most" hold? Simulated flights in wind, with a loss of one rotor or none, judged by the default diagnoser.

    python benchmarks/unseen.py --flights 600

For losses that were not announced (verdict healthy): how often the loss is beyond the upper bound that the answer gives for its rotor.
Flight k follows from its number alone. The table is in docs/limits.md.
"""

from __future__ import annotations

import argparse
import itertools
import math

import numpy as np

import rotorwatch as rw
from rotorwatch.many import spread
from rotorwatch.simulation import scenario, simulate

FRAMES = {"quad-x": 4, "hexa-x": 6, "hexa-plus": 6, "y6-b": 6, "octa-x": 8}
TRAJECTORIES = ("hover", "square", "yaw", "climb", "figure-eight")
LOSSES, WINDS = (0.02, 0.05, 0.1, 0.2, 0.6), (0.0, 2.0, 4.0, 6.0, 8.0)


def flown(number: int) -> tuple[float, float, str, tuple[float, ...], int]:
    """(loss or 0, wind m/s, verdict, upper bounds of the rotors, the rotor) of a flight."""
    rng = np.random.default_rng(number)
    frame, trajectory = str(rng.choice(list(FRAMES))), str(rng.choice(TRAJECTORIES))
    wind = float(rng.uniform(WINDS[0], WINDS[-1]))
    loss = math.exp(rng.uniform(math.log(LOSSES[0]), math.log(LOSSES[-1])))
    rotor, onset = int(rng.integers(1, FRAMES[frame] + 1)), float(rng.uniform(20.0, 50.0))
    profile = str(rng.choice(["default", "fast"]))
    if rng.random() < 0.25:
        loss = 0.0
    faults = [{"kind": "loss", "rotor": rotor, "onset_s": onset, "strength": loss}] if loss else []
    table = {
        "duration_s": 65.0, "seed": number, "airframe": {"frame": frame}, "trajectory": {"kind": trajectory},
        "wind": {"speed_m_s": wind}, "logging": {"profile": profile}, "faults": faults,
    }  # fmt: skip
    answer = rw.diagnose(simulate(scenario.from_table(table)).flight)
    bounds = tuple(r.since_takeoff[1] if r.since_takeoff else 1.0 for r in answer.rotors)
    return loss, wind, answer.verdict, bounds, rotor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=600)
    parser.add_argument("--first", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=spread.processors())
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.flights)
    rows = [done.result() for done in spread.run(flown, numbers, options.jobs)]
    print("| loss | flights | not announced | of these beyond the bound |\n|---|---|---|---|")
    for low, high in (*itertools.pairwise(LOSSES), (LOSSES[0], LOSSES[-1])):
        there = [row for row in rows if low <= row[0] < high]
        missed = [row for row in there if row[2] == "healthy"]
        beyond = sum(row[3][row[4] - 1] < row[0] for row in missed)
        print(f"| {100 * low:.0f} to {100 * high:.0f} % | {len(there)} | {len(missed)} | {beyond} |")
    print("\n| healthy flights, wind, m/s | flights | bound, median of all rotors | 90 % |\n|---|---|---|---|")
    for low, high in itertools.pairwise(WINDS):
        there = [row[3] for row in rows if row[0] == 0.0 and row[2] == "healthy" and low <= row[1] < high]
        if there:
            middle, most = np.quantile(np.concatenate(there), [0.5, 0.9])
            print(f"| {low:.0f} to {high:.0f} | {len(there)} | {100 * middle:.1f} % | {100 * most:.1f} % |")


if __name__ == "__main__":
    main()
