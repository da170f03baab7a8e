"""What becomes of losses that wind hides? Simulated flights in wind, with a loss of one rotor or none, assessed by the default diagnoser.

    python benchmarks/unseen.py --flights 600

How often a loss is announced; how often the answer is `ambiguous`, without an event, and the rotor is a suspect; and how often it is
healthy, with the loss beyond the upper bound that the answer gives for its rotor. Flight k follows from its number alone. The tables are in
docs/limits.md.
"""

from __future__ import annotations

import argparse
import itertools
import math
from typing import NamedTuple

import numpy as np

import rotorwatch as rw
from rotorwatch.base.many import spread
from rotorwatch_lab.simulation import scenario, simulate

FRAMES = {"quad-x": 4, "hexa-x": 6, "hexa-plus": 6, "y6-b": 6, "octa-x": 8}
TRAJECTORIES = ("hover", "square", "yaw", "climb", "figure-eight")
LOSSES, WINDS = (0.02, 0.05, 0.1, 0.2, 0.6), (0.0, 2.0, 4.0, 6.0, 8.0)


class Row(NamedTuple):
    """A flight. loss: 0 without; rotor: its; announced: an event names rotors; suspects; bounds: upper ones of all rotors."""

    loss: float
    wind: float
    rotor: int
    verdict: str
    announced: bool
    suspects: tuple[int, ...]
    bounds: tuple[float, ...]


def flown(number: int) -> Row:
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
    suspects = tuple(r.rotor for r in answer.rotors if r.status == "suspect")
    return Row(loss, wind, rotor, answer.verdict, any(e.rotors for e in answer.events), suspects, bounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=600)
    parser.add_argument("--first", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=spread.processors())
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.flights)
    rows = [done.result() for done in spread.run(flown, numbers, options.jobs)]
    print("| loss | flights | announced | ambiguous | ... and the rotor is a suspect | ... alone | healthy | ... beyond the bound |")
    print("|---|---|---|---|---|---|---|---|")
    for low, high in (*itertools.pairwise(LOSSES), (LOSSES[0], LOSSES[-1])):
        there = [row for row in rows if low <= row.loss < high]
        open_ = [row for row in there if row.verdict == "ambiguous" and not row.announced]
        healthy = [row for row in there if row.verdict == "healthy"]
        counts = [
            len(there), sum(row.announced for row in there), len(open_), sum(row.rotor in row.suspects for row in open_),
            sum(row.suspects == (row.rotor,) for row in open_), len(healthy), sum(row.bounds[row.rotor - 1] < row.loss for row in healthy),
        ]  # fmt: skip
        print(f"| {100 * low:.0f} to {100 * high:.0f} % | {' | '.join(map(str, counts))} |")
    print(
        "\n| healthy flights, wind, m/s | flights | announced | ambiguous | bound, median of all rotors | 90 % |\n|---|---|---|---|---|---|"
    )
    for low, high in itertools.pairwise(WINDS):
        there = [row for row in rows if row.loss == 0.0 and low <= row.wind < high]
        bounds = [row.bounds for row in there if row.verdict == "healthy"]
        if bounds:
            middle, most = np.quantile(np.concatenate(bounds), [0.5, 0.9])
            announced, ambiguous = sum(row.announced for row in there), sum(row.verdict == "ambiguous" for row in there)
            print(f"| {low:.0f} to {high:.0f} | {len(there)} | {announced} | {ambiguous} | {100 * middle:.1f} % | {100 * most:.1f} % |")


if __name__ == "__main__":
    main()
