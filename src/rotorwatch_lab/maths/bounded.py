"""Bounds of theta, quadratic programs over a box, and losses that are unobservable while a rotor idles."""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths.small import definite_solve

ROUNDING = 1e-13  # a bound passed by less is kept: losses are of order 1


def of_losses(system, bounds) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest theta (n_theta,) of a plant: `bounds` for the losses, none for what the plant adds to them.

    bounds: (least, largest) loss. Raises ConfigError unless least <= 0 < largest.
    """
    if len(bounds) != 2 or (checks.concrete(bounds) and not bounds[0] <= 0.0 < bounds[1]):
        raise ConfigError(f"bounds must be a least loss of at most 0 and a largest above it, not {tuple(bounds)}.")
    loss = np.arange(system.n_theta) < system.n_u
    return np.where(loss, bounds[0], -np.inf), np.where(loss, bounds[1], np.inf)


def quadratic(H, g, low, high, turns: int | None = None):
    """argmin over low <= t <= high of t' H t / 2 - g' t for a positive definite H (n, n).

    Goldfarb and Idnani's dual active-set method (Mathematical Programming 27, 1983) for a box. It begins at the free minimum.
    A turn moves towards the bound that is violated most, t staying optimal for the bounds taken so far, until it gets there or
    until a bound taken before no longer presses and is let go. turns: 3 n by default, of which 2 n
    are enough in tests/test_bounded.py; a turn after the last changes nothing. What the turns end with is solved once more, so that
    no rounding adds up.
    """
    n = H.shape[-1]
    turns = 3 * n if turns is None else turns
    low, high = jnp.broadcast_to(low, n), jnp.broadcast_to(high, n)
    scale = jnp.diagonal(H)

    def solve(free, right):
        """H^-1 right among the free elements; right over its scale elsewhere."""
        masked = jnp.where(free[:, None] & free[None, :], H, jnp.diag(scale))
        return definite_solve(masked, right)

    def at_bounds(side):
        """t (n,) that is optimal while elements stay at their bounds: side (n,) -1 low, 1 high, 0 free."""
        fixed = jnp.where(side < 0, low, jnp.where(side > 0, high, 0.0))
        t = jnp.where(side == 0, solve(side == 0, g - H @ fixed), fixed)
        return t + jnp.where(side == 0, solve(side == 0, g - H @ t), 0.0)  # once refined

    def turn(_, now):
        t, side, aim = now  # aim: 1 or -1 where an element is on its way up or down to a bound
        beyond = jnp.where(side == 0, jnp.maximum(low - t, t - high), -jnp.inf)
        worst = (jnp.arange(n) == jnp.argmax(beyond)) & (beyond > ROUNDING)
        aim = jnp.where((aim != 0).any(), aim, jnp.where(worst, jnp.where(t < low, 1, -1), 0))
        move = jnp.where(side == 0, solve(side == 0, aim.astype(float)), 0.0)
        moves = jnp.where(aim == 0, 0.0, move * aim).sum()
        away = jnp.where(aim == 0, 0.0, jnp.maximum(low - t, t - high)).sum()
        to_bound = away / jnp.where(moves > 0, moves, 1.0)
        # A bound presses with -side (H t - g) >= 0.
        presses, eases = jnp.maximum(-side * (H @ t - g), 0.0), side * (H @ move)
        lasts = jnp.where(eases > 0, presses / jnp.where(eases > 0, eases, 1.0), jnp.inf)
        let_go = (jnp.arange(n) == jnp.argmin(lasts)) & (lasts < to_bound)
        t = t + jnp.minimum(lasts.min(), to_bound) * move
        reached = ~let_go.any()
        side = jnp.where(let_go, 0, jnp.where(reached & (aim != 0), -aim, side))
        return t, side, jnp.where(reached, 0, aim)

    none = jnp.zeros(n, jnp.int32)
    _, side, _ = jax.lax.fori_loop(0, turns, turn, (at_bounds(none), none, none))
    return jnp.clip(at_bounds(side), low, high)


def active(trial, low, high):
    """(free, fixed): 1 where `trial` is strictly inside the box, and the bound where it is not (0 where it is)."""
    inside = (trial > low) & (trial < high)
    fixed = jnp.where(trial <= low, low, jnp.where(trial >= high, high, 0.0))
    return inside.astype(float), jnp.where(inside, 0.0, fixed)


def nominal_input(system, u_nominal=None):
    """u (n_u,) in ordinary flight: `u_nominal`, or the plant's own `u_nominal`, or for plants with B_T and m equal thrusts that
    carry the weight, else ones."""
    if u_nominal is not None:
        return checks.finite("u_nominal", checks.shape("u_nominal", np.asarray(u_nominal, float), system.n_u))
    if hasattr(system, "u_nominal"):
        return system.u_nominal
    if hasattr(system, "B_T") and hasattr(system, "m"):
        weight = system.m * G0 - getattr(system, "F_0", 0.0)
        return weight / system.B_T.sum() * np.ones(system.n_u)
    return np.ones(system.n_u)


def moving(system, u, least):
    """(n_theta,) 1, or 0 where the rotor's command is below least (n_u,): its loss does nothing then, and would only drift."""
    n = min(system.n_theta, system.n_u)
    live = (jnp.abs(u[:n]) >= jnp.abs(least[:n])).astype(float)
    return jnp.concatenate([live, jnp.ones(system.n_theta - n)])
