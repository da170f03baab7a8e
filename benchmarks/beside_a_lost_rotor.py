"""One rotor is lost altogether, another one loses 20 to 50 % later: is that seen, and is none accused that works?

    python benchmarks/beside_a_lost_rotor.py [--flights 120]

Flights of `rotorwatch sequences` on frames that fly on without a rotor, with these two losses instead of their own; states and outcomes as
there (docs/experiments.md), by how many rotors are weak.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from rotorwatch.base.backend import jax
from rotorwatch_lab.campaign import batch, sequences
from rotorwatch_lab.campaign.plan import Cell
from rotorwatch_lab.simulation.scenario import Scenario

FRAMES = ("octa-x", "octaquad-x")


class Beside(sequences.Sequences):
    """The flights of one frame, both logging profiles in turn."""

    def __init__(self, frame: str):
        super().__init__(77)
        self.cells = tuple(Cell(frame, "ardupilot", profile) for profile in ("default", "fast"))

    def kind(self, k: int) -> str:
        return "second"

    def flight(self, k: int) -> Scenario:
        flown, rng = super().flight(k), np.random.default_rng([self.seed, k, 1])
        lost, weak = flown.faults
        weak = {**weak, "onset_s": lost["onset_s"] + rng.uniform(8.0, 20.0), "strength": rng.uniform(0.2, 0.5)}
        return replace(flown, faults=({**lost, "strength": 1.0}, weak))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=120, help="of each frame")
    count = parser.parse_args().flights
    jax()
    for frame in FRAMES:
        plan, rows = Beside(frame), []
        for cell in range(len(plan.cells)):
            rows += sequences.assessed(plan, batch.fly(plan, range(cell, count, len(plan.cells)), sequences.WIDTH))
        for weak in range(3):
            outcomes = Counter(row["outcome"] for row in rows if len(row["truth"]) == weak)
            print(frame, f"{weak} weak:", ", ".join(f"{outcomes[o]} {o}" for o in sequences.OUTCOMES), flush=True)


if __name__ == "__main__":
    main()
