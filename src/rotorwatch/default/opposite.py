"""A sudden shift that is a disturbance, or else a pair of opposite rotors that explains it as well.

Torques of opposite rotors cancel in roll and pitch, so that the shift left in thrust (and yaw) is what battery, payload or a gust make,
too - but those do not come within a tick. Only steady flight can tell: who climbs, drops or turns changes the air that all rotors meet.
"""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch.core import Array
from rotorwatch.default import bank, evidence, hypotheses, plant
from rotorwatch.default.hypotheses import Hypotheses

# rad/s of yaw, above which its drag is known too badly for that; and load factor away from 1
TURNING, HEAVING = 0.15, 0.2


class Opposite(NamedTuple):
    """pair: the hypothesis, at the tick that says so, else -1; onset: ticks ago; loss (2,) of its rotors."""

    pair: Array
    onset: Array
    loss: Array


def suspect(
    hyp: Hypotheses, onsets: bank.Jumps, told: bank.Bank, found: evidence.Evidence, B, calm, limit, lasted, dt
) -> tuple[Opposite, Array]:
    """B (4, n): effectiveness; calm: steady flight of which nothing is known but a disturbance; limit: nats that a fault needs; lasted:
    seconds for which it has been so, returned with this tick added."""
    import jax.numpy as jnp

    n, pairs = hyp.n, slice(hyp.n, hyp.n + len(hyp.pairs))
    slow = jnp.asarray(onsets.slow)
    real = (found.nu[:, pairs] > hypotheses.NONE).all(axis=2)
    usable = ~slow[:, None] & torque_free(hyp, B)[None, :] & real & found.live[:, None]
    fit = jnp.where(usable, found.log_bf[:, pairs], evidence.NOTHING)
    free_fit = jnp.where(found.live[:, None], found.log_bf[:, ~hyp.fault], evidence.NOTHING)
    best, gradual, sudden = fit.max(), free_fit[onsets.slow].max(), free_fit[~onsets.slow].max()
    # A quadrotor's pairs can be told apart by their yaw: there the fault hypotheses say all there is to say.
    now = (
        calm
        & (n >= 6)
        & (best > limit)
        & (best > sudden - 2.0 * hypotheses.CLEAR)
        & (best > gradual + hypotheses.CLEAR)
    )
    since = jnp.where(now, lasted + dt, 0.0)
    news = (since >= plant.ANSWER_S) & (lasted < plant.ANSWER_S)
    pair = jnp.argmax(fit.max(axis=0))
    slot = jnp.argmax(fit[:, pair])
    which = jnp.where(news, n + pair, -1).astype(jnp.int32)
    return Opposite(which, told.age[slot].astype(float) + 1.0, found.nu[slot, n + pair]), since


def torque_free(hyp: Hypotheses, B):
    """(n_pairs,) bool: equal losses of these two rotors make no torque in roll and pitch. B (4, n)."""
    import jax.numpy as jnp

    (i, j), B = hyp.pairs.T, jnp.asarray(B)
    return jnp.abs(B[:2, i] + B[:2, j]).max(axis=0) < 0.05
