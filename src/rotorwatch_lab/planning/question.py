"""What a log leaves for an excitation to distinguish: the sets of rotors, the hover, and the noise about it."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from rotorwatch.stats.nonnegative import least_squares
from rotorwatch.toolkit import ASSESS, GAIN, PER_AXIS, TAU, ExcitationNoise, Ticks, excitation_response

HOVER_S = 3.0  # over which the commands of hover are averaged
EXPLAINED = 4.0  # standard deviations of trim that a set of rotors may leave unexplained to be suspected
LEAST_LOSS = 0.1  # ... and the smallest loss in it


class Question(NamedTuple):
    """Input to the design of an excitation. candidates: sets of rotors (0-based; (): none) and their losses (n,); hover (n,): commands,
    shares of full thrust; noise and gain (3,) as `rotorwatch_lab.control.excitation.design` takes them; dt [s] of a tick."""

    candidates: dict[tuple[int, ...], np.ndarray]
    hover: np.ndarray
    noise: ExcitationNoise
    gain: np.ndarray
    dt: float


def suspects(carry, out, table: Ticks, B: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Single rotors and pairs (0-based) whose losses (n,) explain the change of trim, whatever was announced."""
    lacking, sd = excitation_response.shift(carry, out, table)
    n, sets = B.shape[1], {}
    if lacking is None:
        return sets
    for who in (*combinations(range(n), 1), *combinations(range(n), 2)):
        losses = np.zeros(n)
        losses[list(who)], left = least_squares(B[:, who] / sd[:, None], lacking / sd)
        least = losses[list(who)].min()
        if left < EXPLAINED and LEAST_LOSS < least and losses.max() <= 1.0:
            sets[who] = losses
    return sets


def pose(sets: dict[tuple[int, ...], np.ndarray], carry, table: Ticks, B: np.ndarray) -> Question:
    """The sets of rotors (`excitation_response.candidates` or `suspects`, or none) that an excitation has to distinguish. carry: of the
    default estimator after the ticks of `table`."""
    flying = table.mode == ASSESS
    late = flying & (table.time > table.time[flying][-1] - HOVER_S)
    hover = (table.thrust * table.hover[:, None])[late].mean(axis=0)
    gain = np.asarray(carry.s)[: 4 * PER_AXIS].reshape(4, PER_AXIS)[:3, GAIN]
    noise = ExcitationNoise(np.asarray(carry.variances)[:, 3], np.array(TAU))
    return Question({**sets, (): np.zeros(B.shape[1])}, hover, noise, gain, table.dt)
