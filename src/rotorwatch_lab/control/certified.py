"""Certified reallocation: a belief about the rotors is acted on only where every loss that is possible is better served by it.

    J(u_new, e) < J(u_old, e) for all e in V,      J(u, e) = |W S^-1 (B (e u) - v)|^2

u_old, u_new: commands of the allocator (`allocation`) for the demand v of hover, by the belief that is followed now and by the new one.
V: what the effectiveness e may be: the vertices of the new belief's interval, and all other explanations that are not excluded, "no rotor
is weak" among them. J(u_new) - J(u_old) is convex in the effectiveness of a rotor that u_new commands more, so that vertices suffice; for
one that is commanded less the belief's mean is tried, too. After Qi, Song, Dai, Han and Wang (International Journal of Advanced Robotic
Systems, 2015), who design a controller for all vertices of the coefficients' bounds.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from rotorwatch_lab.control.allocation import Allocator

UNCERTAIN = 1e-3  # an interval of effectiveness that is narrower has one vertex


def possible(mean, lower, upper, others) -> np.ndarray:
    """(V, n) V: the vertices of the interval [lower, upper] (n,), the mean (n,), and others (k, n)."""
    sides = [(low, high) if high - low > UNCERTAIN else (low,) for low, high in zip(lower, upper, strict=True)]
    return np.concatenate([np.array(list(product(*sides)), float), np.asarray(mean, float)[None], np.asarray(others, float)])


def is_better(allocator: Allocator, demand, old, new, effectiveness) -> bool:
    """Whether commands `new` (n,) meet demand (4,) better than `old` (n,) for each row of effectiveness (V, n)."""
    before, after = (((allocator.scale * ((effectiveness * u) @ allocator.B.T - demand)) ** 2).sum(axis=1) for u in (old, new))
    return bool((after < before).all())
