"""Inverse of an inertia: what every rigid-body plant needs, of numbers or inside a compiled program."""

from __future__ import annotations

import numpy as np

from rotorwatch import checks
from rotorwatch.backend import jnp


def inverse(J):
    """Inverse (3, 3) of a symmetric matrix by its adjugate: no factorisation in a step, and any derivative of it is exact."""
    xp = np if checks.concrete(J) else jnp
    a, b, c = (xp.asarray(J)[k] for k in range(3))
    adjugate = xp.stack([xp.cross(b, c), xp.cross(c, a), xp.cross(a, b)])
    return adjugate / (a @ adjugate[0])
