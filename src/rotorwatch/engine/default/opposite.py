"""A sudden shift that is a disturbance, or else a pair of opposite rotors that explains it as well.

Torques of opposite rotors cancel in roll and pitch, so that the shift left in thrust (and yaw) is what battery, payload or a gust make,
too - but those do not come within a tick. Which of the pairs it is, and how they share the loss, motion does not say: the hypothesis is one
loss nu that both rotors of a pair have. With C (q, q) and z (q,) of the bank and d = e_i + e_j its log Bayes factor against "no jump" is
that of a single rotor with information d'C d and vector d'z (hypotheses.py): one number, as the step of an axis is, and not two, of which
one would be paid for but never seen.

Only steady flight can tell: who climbs, drops or turns changes the air that all rotors meet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array
from rotorwatch.engine.default import bank, evidence, hypotheses, plant
from rotorwatch.engine.default.hypotheses import Hypotheses
from rotorwatch.engine.estimator.opposite import HEAVING, TURNING  # noqa: F401 - the method's constants stand in its definition


class Opposite(NamedTuple):
    """pair: the hypothesis, at the tick that says so, else -1; onset: ticks ago; loss (2,) of its rotors."""

    pair: Array
    onset: Array
    loss: Array


def suspect(
    hyp: Hypotheses,
    onsets: bank.Jumps,
    statistics: bank.Bank,
    found: evidence.Evidence,
    B,
    calm,
    missing,
    limit,
    lasted,
    dt,
) -> tuple[Opposite, Array]:
    """B (4, n): effectiveness; calm: flight without turns of which nothing is known but a disturbance; missing: `plausibility.Missing`;
    limit: nats that a fault needs; lasted: seconds for which it has been so, returned with this tick added."""
    import jax.numpy as jnp

    n, slow = hyp.n, jnp.asarray(onsets.slow)
    log_bf, nu = shared(hyp, statistics.C, statistics.z)
    usable = ~slow[:, None] & torque_free(hyp, B)[None, :] & (nu > hypotheses.NONE) & found.live[:, None]
    fit = jnp.where(usable, log_bf, hypotheses.NOTHING)
    free_fit = jnp.where(found.live[:, None], found.log_bf[:, ~hyp.fault], hypotheses.NOTHING)
    best, gradual, sudden = fit.max(), free_fit[onsets.slow].max(), free_fit[~onsets.slow].max()
    pair = jnp.argmax(fit.max(axis=0))
    slot = jnp.argmax(fit[:, pair])
    loss = nu[slot, pair]
    since_onset = jnp.exp(statistics.age[slot] * dt / plant.USUAL_S)  # what was forgotten of the heaving meanwhile
    # A quadrotor's pairs can be distinguished by their yaw: there the fault hypotheses say all there is to say.
    now = (
        calm
        & (missing.heave * since_onset < HEAVING + 2.0 * loss / n)
        & (missing.rose * since_onset < HEAVING)
        & (n >= 6)
        & (best > limit)
        & (best > sudden - 2.0 * hypotheses.CLEAR)
        & (best > gradual)
    )
    since = jnp.where(now, lasted + dt, 0.0)
    newly = (since >= plant.ANSWER_S) & (lasted < plant.ANSWER_S)
    which = jnp.where(newly, n + pair, -1).astype(jnp.int32)
    return Opposite(which, statistics.age[slot].astype(float) + 1.0, jnp.stack([loss, loss])), since


def shared(hyp: Hypotheses, C, z):
    """Log Bayes factors (W, n_pairs) of one loss that both rotors of a pair have, and its most probable size (W, n_pairs)."""
    import jax.numpy as jnp

    i, j = hyp.pairs.T
    c, z = C[:, i, i] + C[:, j, j] + 2.0 * C[:, i, j], z[:, i] + z[:, j]
    small, large = (hypotheses.near(c, z, 0.0, w**2, 0.0, 1.0) for w in (hypotheses.SMALL_WIDTH, hypotheses.LOSS_WIDTH))
    return jnp.logaddexp(small[0], large[0]) - np.log(2.0), large[1]


def torque_free(hyp: Hypotheses, B):
    """(n_pairs,) bool: equal losses of these two rotors make no torque in roll and pitch. B (4, n)."""
    import jax.numpy as jnp

    (i, j), B = hyp.pairs.T, jnp.asarray(B)
    return jnp.abs(B[:2, i] + B[:2, j]).max(axis=0) < 0.05


def contested(hyp: Hypotheses, B):
    """(n_h,) bool: the hypotheses that are such a pair, of a vehicle on which there are several. B (4, n)."""
    import jax.numpy as jnp

    free = torque_free(hyp, B) & (hyp.n >= 6)
    return jnp.concatenate([jnp.zeros(hyp.n, bool), free, jnp.zeros(len(hyp.names) - hyp.n - free.size, bool)])


def common(theta, alike):
    """(n,): what rotors `alike` (n,) with losses theta (n,) lack alike: it may be theirs, or that of any other such pair."""
    import jax.numpy as jnp

    return jnp.where(alike, jnp.where(alike, theta, 1.0).min(), 0.0)
