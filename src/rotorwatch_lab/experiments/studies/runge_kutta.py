"""The classical fourth-order Runge-Kutta rule, by which the studies' truth is integrated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rotorwatch.base.backend import jax as load_jax


def rk4(rate: Callable[[Any], Any], x: Any, dt: float) -> Any:
    """x, an array or a tree of arrays, after dt s at d x / dt = rate(x)."""
    tree = load_jax().tree

    def ahead(slope, h):
        return tree.map(lambda s, d: s + h * d, x, slope)

    a = rate(x)
    b = rate(ahead(a, 0.5 * dt))
    c = rate(ahead(b, 0.5 * dt))
    d = rate(ahead(c, dt))
    return tree.map(lambda s, a, b, c, d: s + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d), x, a, b, c, d)
