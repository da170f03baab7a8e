"""How noisy is this aircraft, on every time scale: variances of a four-component noise model, learned causally.

The residual's structure function at lag L,  D(L) = E[(e(t) - e(t - L))^2] / 2,  of white noise, two coloured disturbances (time
constants TAU) and a random walk is

    D(L) = s_w^2 + sum_j s_j^2 (1 - exp(-L / tau_j)) + q L / 2

Each squared difference is a chi-square sample of D(L), so the variances (s_w^2, s_1^2, s_2^2, q) >= 0 have a gamma likelihood; its
multiplicative (expectation-maximisation) update keeps them positive and needs no solver: a few iterations a tick, warm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array
from rotorwatch.engine.default import plant
from rotorwatch.engine.default.plant import PER_AXIS, TAU, fading
from rotorwatch.engine.estimator import noise as definition
from rotorwatch.engine.estimator.noise import CLIP, FLOOR, GENERIC_WEIGHT, GROWTH_WEIGHT, LAGS, MEMORY_S

GENERIC = np.tile(np.array(definition.GENERIC)[:, None], (1, 4))


class NoiseState(NamedTuple):
    """ring, ring_ok (64, 4): last residuals; weight, total (7, 4): sums for D; variances (4 components, 4 axes); safety (4,)."""

    ring: Array
    ring_ok: Array
    weight: Array
    total: Array
    variances: Array
    safety: Array


def basis(dt):
    """(7, 4): D at each lag for a unit of each variance."""
    numpy, lag = plant.arrays(dt), np.array(LAGS) * dt
    return numpy.stack([np.ones(len(LAGS)), *(1.0 - numpy.exp(-lag / t) for t in TAU), lag / 2.0], axis=1)


def init(dt, prior_variances=GENERIC, prior_weight=GENERIC_WEIGHT) -> NoiseState:
    """prior_variances (4 components, 4 axes), of healthy flights or generic, count like prior_weight samples a lag."""
    D = basis(dt) @ prior_variances
    weight = np.full((len(LAGS), 4), prior_weight)
    return NoiseState(
        np.zeros((LAGS[-1], 4)),
        np.zeros((LAGS[-1], 4), bool),
        np.asarray(weight),
        np.asarray(weight * D),
        np.asarray(prior_variances),
        np.ones(4),
    )


def step(state: NoiseState, e, ok, trust, dt) -> NoiseState:
    """Add one residual e (4,) where ok (4,); trust (4,) in 0..1 discounts manoeuvring ticks."""
    import jax.numpy as jnp

    A = jnp.asarray(basis(dt))
    back = jnp.array([LAGS[-1] - lag for lag in LAGS])
    old, old_ok = state.ring[back], state.ring_ok[back]
    both = (old_ok & ok[None, :]) * trust[None, :]
    D = state.total / state.weight
    square = jnp.minimum(0.5 * (e[None, :] - old) ** 2, CLIP * D)
    # Differences a long lag apart overlap: L of them carry about as much as one independent sample.
    share = 1.0 / jnp.array(LAGS, float)[:, None]
    forget = jnp.exp(-dt / MEMORY_S) ** both
    weight = state.weight * forget + both * share
    total = state.total * forget + both * share * square
    # Long lags have few samples at first: until then suppose that variance grows with the lag, as disturbances do.
    D = total / weight
    D = (total + GROWTH_WEIGHT * D[:1] * (1.0 + jnp.array(LAGS, float)[:, None] * dt / plant.ANSWER_S)) / (
        weight + GROWTH_WEIGHT
    )
    certain = jnp.minimum(weight, 5.0)
    v = state.variances / state.safety
    for _ in range(3):
        model = A @ v
        gain = (A.T @ (certain * D / model**2)) / (A.T @ (certain / model))
        v = v * jnp.sqrt(jnp.clip(gain, 0.05, 20.0))
    v = v.at[0].set(jnp.maximum(v[0], FLOOR))
    v = jnp.maximum(v, 1e-12)
    # The model must not be quieter than the aircraft on any scale.
    safety = jnp.clip((D / (A @ v)).max(axis=0) / 1.1, 1.0, 4.0)
    ring = jnp.concatenate([state.ring[1:], jnp.where(ok, e, 0.0)[None, :]])
    ring_ok = jnp.concatenate([state.ring_ok[1:], ok[None, :]])
    return NoiseState(ring, ring_ok, weight, total, v * safety, safety)


def process_variance(variances, dt):
    """(20,) process noise variances a tick that keep b1 and b2 stationary and let b3 walk; variances (4 components, 4 axes)."""
    import jax.numpy as jnp

    share = jnp.stack([*(1.0 - fading(dt) ** 2), dt])[:, None]
    per_axis = jnp.concatenate([variances[1:] * share, jnp.zeros((PER_AXIS - 3, 4))])
    return per_axis.T.reshape(-1)


def spread(variances):
    """(4,) variance of everything but white noise over ten seconds: how large this aircraft's disturbances are."""
    return variances[1] + variances[2] + variances[3] * 5.0
