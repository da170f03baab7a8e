"""The common mode: change of the thrust commanded of all rotors together over a flight."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.stats.tails import student_quantile

BLOCKS = 5  # in each third of the flight
LEAST = 4  # ticks in a block


def thrust_shift(collective: np.ndarray) -> dict[str, Any]:
    """Change of the collective thrust that the same motion needs, from the first third of the assessed time to the last third.

    collective (T,): thrust [hover thrusts of one rotor] at each assessed tick beyond what the motion explains. Each third is divided into
    blocks whose medians are compared by Student's t-test with equal variances, so that a landing or a climb, confined to one block, widens
    the interval and does not appear as a change. Empty where there are too few ticks."""
    third = len(collective) // 3
    if third < BLOCKS * LEAST:
        return {}
    ends = (np.array_split(part, BLOCKS) for part in (collective[:third], collective[-third:]))
    first, last = (np.array([median(block) for block in blocks]) for blocks in ends)
    shift = last.mean() - first.mean()
    half = student_quantile(0.975, 2 * BLOCKS - 2) * np.sqrt((first.var(ddof=1) + last.var(ddof=1)) / BLOCKS)
    interval = [float(shift - half), float(shift + half)]
    return {"thrust_shift": float(shift), "interval": interval, "unit": "hover thrusts of one rotor"}
