"""Explanations of a departure from controlled flight by the rotors' behaviour, at every onset, by the balance (`balance`).

Explanations: all rotors gave what was commanded; one of them lost a share theta from a tick on, or gave a constant thrust whatever its
command; all of them lost the same share (battery); a lasting external torque; two outputs went to each other's motor; yaw has the wrong
sign. Sizes and onsets are summed over a grid, with the prior of each.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from rotorwatch.engine.estimator.hypotheses import STUCK_WEIGHT
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.spin.rotors_off import FITS
from rotorwatch.witnesses.upset.balance import Fit, Offset, Window, delivered, fit

SIZES = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
STUCK = np.array([0.5, 0.7, 0.9])  # of full thrust, of a rotor that no longer follows its command but gives more than in hover
CARRIES = 1.5  # hover thrusts: a rotor that still gives this much turns no vehicle over
# Frequency of each explanation among vehicles that departed controlled flight.
PRIOR = {"healthy": 0.4, "rotor": 0.4, "outside": 0.1}
ORDER = {"healthy": 0.25, "rotor": 0.35, "outside": 0.08, "order": 0.25, "yaw": 0.05}
# All rotors fail alike: where the battery's voltage was steady (then none can, but wrong commands look the same), where it is not
# logged, where it collapsed.
COMMON = {False: 1e-12, None: 0.005, True: 0.3}
EXTERNAL_SD = 1.0  # hover thrusts of one rotor, of a lasting external torque
CHUNK = 256  # hypotheses fitted at once


class Explanation(NamedTuple):
    """An explanation, summed over sizes and onsets. kind: healthy, rotor, common, outside, order or yaw; rotors (0-based); log: of its
    evidence with its prior; onset: most probable [s]; size: mean loss, low, high: its 95 % interval; residual (K, 4) of the best; gives:
    the constant thrust of the rotor, in hover thrusts, where that is the most likely, else 0."""

    kind: str
    rotors: tuple[int, ...]
    log: float
    onset: float
    size: float
    low: float
    high: float
    residual: np.ndarray
    gives: float = 0.0

    @property
    def fits(self) -> bool:
        """True if what it leaves of the torques is noise."""
        return bool((np.sqrt((self.residual[:, :3] ** 2).mean(axis=0)) < FITS).all())


def explain(
    window: Window, B: np.ndarray, offset: Offset, onsets: np.ndarray, orders: bool, sagged: bool | None = None
) -> tuple[tuple[Explanation, ...], np.ndarray]:
    """All explanations, the most probable first, and their probabilities.

    B (4, n); onsets: indices of the ticks of possible onsets; orders: whether outputs may go to the wrong motors (at the first take-off:
    later it would have shown); sagged: whether the battery's voltage collapsed, None where that is unknown."""
    n, K = B.shape[1], window.time.size
    T = delivered(window)
    healthy = T @ B.T
    courses: list[np.ndarray] = []
    labels: list[tuple[str, tuple[int, ...], int, float, float]] = []
    prior = {**(ORDER if orders else PRIOR), "common": COMMON[sagged]}

    sizes = SIZES[(1.0 - SIZES) * window.full < CARRIES]

    def add(kind, rotors, onset, size, wrench, gives=0.0):
        courses.append(wrench)
        labels.append((kind, rotors, onset, size, gives))

    add("healthy", (), 0, 0.0, healthy)
    for k in onsets:
        since = (np.arange(K) >= k)[:, None]
        for size in sizes:
            for i in range(n):
                lost = np.zeros(n)
                lost[i] = size
                add("rotor", (i,), k, size, np.where(since, (T * (1.0 - lost)) @ B.T, healthy))
            if size <= 0.9:
                add("common", (), k, size, np.where(since, (1.0 - size) * healthy, healthy))
        # At the first take-off outputs on the wrong motors look the same, and are far more frequent.
        for gives in () if orders else STUCK[STUCK * window.full > 1.0] * window.full:
            for i in range(n):
                other = np.where(np.arange(n) == i, gives, T)
                add("rotor", (i,), k, 1.0, np.where(since, other @ B.T, healthy), gives)
        for a in range(3):
            for push in (-1.5, -0.6, 0.6, 1.5):
                shifted = healthy.copy()
                shifted[:, a] += np.where(since[:, 0], push * EXTERNAL_SD, 0.0)
                add("outside", (), k, push, shifted)
    if orders:
        for i, j in combinations(range(n), 2):
            swapped = T.copy()
            swapped[:, [i, j]] = swapped[:, [j, i]]
            add("order", (i, j), 0, 0.0, swapped @ B.T)
        add("yaw", (), 0, 0.0, healthy * np.array([1.0, 1.0, -1.0, 1.0]))
    fits = [fit(window, np.stack(courses[c : c + CHUNK]), B, offset) for c in range(0, len(courses), CHUNK)]
    log = np.concatenate([f.log_evidence for f in fits])
    log = log + np.log([STUCK_WEIGHT if gives else 1.0 for *_, gives in labels])
    explanations = [_summed(kind, rotors, prior, labels, log, fits, window) for kind, rotors in dict.fromkeys(x[:2] for x in labels)]
    explanations.sort(key=lambda e: -e.log)
    weight = np.exp(np.array([e.log for e in explanations]) - explanations[0].log)
    return tuple(explanations), weight / weight.sum()


def _summed(kind, rotors, prior, labels, log, fits: list[Fit], window: Window) -> Explanation:
    mine = np.array([k for k, x in enumerate(labels) if x[0] == kind and x[1] == rotors])
    kinds = len({x[1] for x in labels if x[0] == kind})
    top = float(log[mine].max())
    weight = np.exp(log[mine] - top)
    evidence = top + float(np.log(weight.mean())) + float(np.log(prior[kind] / kinds))
    weight = weight / weight.sum()
    best = int(mine[np.argmax(weight)])
    sizes = np.array([labels[k][3] for k in mine])
    mean = float(weight @ sizes)
    sd = float(np.sqrt(weight @ (sizes - mean) ** 2 + (0.5 * (SIZES[1] - SIZES[0])) ** 2))
    onsets = np.array([labels[k][2] for k in mine])
    when = window.time[onsets[np.argmax(weight)]]
    residual = fits[best // CHUNK].residual[best % CHUNK]
    low, high = max(0.0, mean - WITHIN_95 * sd), min(1.0, mean + WITHIN_95 * sd)
    return Explanation(kind, rotors, evidence, float(when), mean, low, high, residual, labels[best][4])
