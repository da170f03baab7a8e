"""Algebra of matrices of a dozen rows, in elementwise operations: in a compiled step each call of a matrix library, or of XLA's own
product, takes 0.5 us, ten times what the arithmetic does.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp


def symmetric(P):
    """P without the asymmetry that rounding brought."""
    return 0.5 * (P + P.T)


def definite_solve(A, B):
    """A^-1 B of a symmetric positive definite A, by its Cholesky factor."""
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(A), True), B)


def inverse(J):
    """Inverse (3, 3) of a symmetric matrix, such as an inertia, by its adjugate: no factorisation in a step, and any derivative of it is
    exact."""
    xp = np if checks.concrete(J) else jnp
    a, b, c = (xp.asarray(J)[k] for k in range(3))
    adjugate = xp.stack([xp.cross(b, c), xp.cross(c, a), xp.cross(a, b)])
    return adjugate / (a @ adjugate[0])


def product(A, B):
    """A B: (..., n, k) and (..., k, m) to (..., n, m)."""
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def solve(A, B):
    """A^-1 B (m, k) of a positive definite A (m, m), NaN of any other: Gauss and Jordan's elimination, which needs no pivots
    then. B (m, k)."""
    m = A.shape[0]
    rows = jnp.concatenate([A, B], axis=1)
    for j in range(m):
        pivot = rows[j, 1:] / jnp.where(rows[j, 0] > 0, rows[j, 0], jnp.nan)
        rows = jnp.where((np.arange(m) == j)[:, None], pivot, rows[:, 1:] - rows[:, :1] * pivot)
    return rows


def blocks(A, B, numpy=np):
    """Block-diagonal matrix of two."""
    corner = numpy.zeros((A.shape[0], B.shape[0]))
    return numpy.block([[A, corner], [corner.T, B]])
