"""Certified reallocation: a belief about the rotors is acted on as far as that serves every loss that is possible no worse than not acting.

    e_a = e_up + lambda (e - e_up), the largest lambda of STEPS with
    J(u(e_a), e) <= J(u_old, e) for all e in V, "<" for one,      J(u, e) = |W S^-1 (B (e u) - v)|^2

e, e_up: effectiveness by the belief, and the end of its interval with the smallest losses. u(e_a): the allocator's commands (`allocation`)
for the demand v of hover; u_old: those of the belief that is followed now. V: what the effectiveness may be: the vertices of the interval,
the belief's mean, and all other explanations that are not excluded, "no rotor is weak" among them. J(u) - J(u_old) is convex in the
effectiveness of a rotor that u commands more, so that vertices suffice; for one that is commanded less the mean is tried, too. After Qi,
Song, Dai, Han and Wang (International Journal of Advanced Robotic Systems, 2015), who design a controller for all vertices of the
coefficients' bounds.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from rotorwatch_lab.control.allocation import Allocator

UNCERTAIN = 1e-3  # an interval of effectiveness that is narrower has one vertex
STEPS = (1.0, 0.75, 0.5, 0.25, 0.0)
SAME = 1e-9  # errors that differ by rounding: a dead rotor's command changes nothing


def possible(mean, lower, upper, others) -> np.ndarray:
    """(V, n) V: the vertices of the interval [lower, upper] (n,), the mean (n,), and others (k, n)."""
    sides = [(low, high) if high - low > UNCERTAIN else (low,) for low, high in zip(lower, upper, strict=True)]
    return np.concatenate([np.array(list(product(*sides)), float), np.asarray(mean, float)[None], np.asarray(others, float)])


def is_better(allocator: Allocator, demand, old, new, effectiveness) -> bool:
    """Whether commands `new` (n,) meet demand (4,) no worse than `old` (n,) for each row of effectiveness (V, n), and better for one."""
    before, after = (((allocator.scale * ((effectiveness * u) @ allocator.B.T - demand)) ** 2).sum(axis=1) for u in (old, new))
    return bool((after <= before + SAME).all() and (after < before - SAME).any())
