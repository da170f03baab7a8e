"""Losses within bounds and losses at rest: which bounds a theta has, quadratic programs over a box, and whose loss shows at all."""

from __future__ import annotations

import numpy as np

from rotorwatch import checks
from rotorwatch.backend import jax as load_jax
from rotorwatch.errors import ConfigError


def of_losses(system, bounds) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest theta (n_theta,) of a plant: `bounds` for the losses, none for what the plant adds to them.

    bounds: (least, largest) loss. Raises ConfigError unless least <= 0 < largest.
    """
    if len(bounds) != 2 or (checks.concrete(bounds) and not bounds[0] <= 0.0 < bounds[1]):
        raise ConfigError(f"bounds must be a least loss of at most 0 and a largest above it, not {tuple(bounds)}.")
    loss = np.arange(system.n_theta) < system.n_u
    return np.where(loss, bounds[0], -np.inf), np.where(loss, bounds[1], np.inf)


def quadratic(H, g, low, high, iterations: int = 4):
    """argmin over low <= t <= high of t' H t / 2 - g' t for a positive definite H (n, n).

    Each iteration: one sweep of coordinate descent, which lowers the cost whatever the active set, then Newton's step on
    what the sweep left free, taken where it lowers the cost further. Exact once the set settles; a pure active-set method
    (Hintermueller, Ito and Kunisch, SIAM J. Optim. 13(3), 2003) is as exact but may run in circles.
    """
    jax = load_jax()
    jnp = jax.numpy
    n = H.shape[-1]
    low, high = jnp.broadcast_to(low, n), jnp.broadcast_to(high, n)
    scale = jnp.diagonal(H)
    t = jnp.clip(g / scale, low, high)
    for _ in range(iterations):
        for i in range(n):
            t = t.at[i].set(jnp.clip(t[i] + (g[i] - H[i] @ t) / scale[i], low[i], high[i]))
        free = ((t > low) & (t < high)).astype(float)
        masked = free[:, None] * H * free[None, :] + jnp.diag((1.0 - free) * scale)
        root = jnp.linalg.cholesky(masked)
        move = jax.scipy.linalg.cho_solve((root, True), free * (g - H @ t))
        newton = jnp.clip(t + move, low, high)
        move = newton - t
        gain = move @ (g - H @ t) - 0.5 * move @ (H @ move)
        t = jnp.where(gain > 0.0, newton, t)
    return t


def active(trial, low, high):
    """(free, fixed): 1 where `trial` is strictly inside the box, and the bound where it is not (0 where it is)."""
    jnp = load_jax().numpy
    inside = (trial > low) & (trial < high)
    fixed = jnp.where(trial <= low, low, jnp.where(trial >= high, high, 0.0))
    return inside.astype(float), jnp.where(inside, 0.0, fixed)


def nominal_input(system, given=None):
    """u (n_u,) in ordinary flight: as given, or the plant's own `u_nominal`, or for plants with B_T and m equal thrusts that
    carry the weight, else ones."""
    if given is not None:
        return checks.finite("u_nominal", checks.shape("u_nominal", np.asarray(given, float), system.n_u))
    if hasattr(system, "u_nominal"):
        return system.u_nominal
    if hasattr(system, "B_T") and hasattr(system, "m"):
        weight = system.m * 9.80665 - getattr(system, "F_0", 0.0)
        return weight / system.B_T.sum() * np.ones(system.n_u)
    return np.ones(system.n_u)


def moving(system, u, least):
    """(n_theta,) 1, or 0 where the rotor's command is below least (n_u,): its loss does nothing then, and would only drift."""
    jnp = load_jax().numpy
    n = min(system.n_theta, system.n_u)
    live = (jnp.abs(u[:n]) >= jnp.abs(least[:n])).astype(float)
    return jnp.concatenate([live, jnp.ones(system.n_theta - n)])
