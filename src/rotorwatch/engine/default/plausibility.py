"""Before a loss is announced: has the controller commanded more of that rotor, and is the thrust missing that it no longer gives?

Evidence says which explanation fits best; these gates say whether the best one can be true at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.core import Array
from rotorwatch.engine.default import hypotheses, model_error, plant
from rotorwatch.engine.default.evidence import Jump
from rotorwatch.engine.estimator.plausibility import (
    CUT_SHARE,
    DEMAND_SHARE,
    DEMAND_SLACK,
    INFLOW,
    LEAST_THRUST,
    LIMIT_S,
    MISSING_SLACK,
)


class Plausible(NamedTuple):
    """Of a jump, each a bool. asked: the commands went the way of it; missing: thrust is missing as it says, and no limit explains that."""

    asked: Array
    missing: Array


class Missing(NamedTuple):
    """Commanded thrust that the accelerometer does not see, hover thrusts of one rotor: fast, over ANSWER_S; slow, over USUAL_S. heave:
    how far the load factor was from 1, lately; rose: how far above; climb: speed [m/s] that it has made, lately. limit (n,): share of its
    thrust that a rotor near its limit may have lacked, lately."""

    fast: Array
    slow: Array
    heave: Array
    rose: Array
    climb: Array
    limit: Array


def init(n: int) -> Missing:
    """Nothing missing."""
    zero = np.float64(0.0)
    return Missing(zero, zero, zero, zero, zero, np.zeros(n))


def follow(state: Missing, missing, load, share, valid, restart, dt) -> Missing:
    """One tick on. missing: commanded thrust minus load factor times its gain, where `valid`; load: that factor. share (n,): of full
    thrust that each rotor is commanded."""
    import jax.numpy as jnp

    up = jnp.where(valid, load - 1.0, 0.0)
    push, left = jnp.abs(up), jnp.exp(-dt / plant.USUAL_S)
    missing = jnp.where(valid, missing, state.slow)
    near = jnp.clip((share - model_error.BELOW_LIMIT) / (model_error.AT_LIMIT - model_error.BELOW_LIMIT), 0.0, 1.0)
    lacks = near * (1.0 - model_error.BELOW_LIMIT / jnp.maximum(share, model_error.BELOW_LIMIT))
    return Missing(
        jnp.where(restart, missing, state.fast + (missing - state.fast) * jnp.minimum(dt / plant.ANSWER_S, 1.0)),
        jnp.where(restart, missing, state.slow + (missing - state.slow) * (dt / plant.USUAL_S)),
        jnp.where(restart, push, jnp.maximum(push, state.heave * left)),
        jnp.where(restart, up, jnp.maximum(up, state.rose * left)),
        jnp.where(restart, 0.0, state.climb * left + up * G0 * dt),
        jnp.where(restart, lacks, jnp.maximum(lacks, state.limit * jnp.exp(-dt / LIMIT_S))),
    )


def air(state: Missing, n: int):
    """Thrust, in hover thrusts of one rotor, that air from below adds to that of n rotors when the vehicle has begun to sink; below 0 when
    it has begun to climb."""
    return -INFLOW * n * state.climb


def demand_coupling(B):
    """(n, n): by what share of it a loss of rotor j raises the command of rotor i, above the mean of all, where its own loss counts 1.

    A controller makes up for the wrench B x that is missing with the least change of thrusts, B' (B B')^-1 B x. Of opposite rotors each
    has to rise by itself: where they lose the same neither does, and only steady flight can tell (opposite.py)."""
    import jax.numpy as jnp

    B = jnp.asarray(B)
    n = B.shape[1]
    L = hypotheses.cholesky((B @ B.T + 1e-6 * jnp.eye(4))[None])  # rotors of a tricopter make no yaw
    half = hypotheses.forward(jnp.broadcast_to(L, (n, *L.shape[1:])), B.T)
    answer = half @ half.T - 1.0 / n
    against = jnp.abs(B[:2, :, None] + B[:2, None, :]).max(axis=0) < 0.05
    return jnp.where(against, 0.0, answer / jnp.maximum(jnp.diagonal(answer)[:, None], 1e-9))


def plausible(
    best: Jump, since_s, smooth, rise, now: Missing, before: Missing, thrust_valid, active, rough, coupling
) -> Plausible:
    """May the jump be what happened? coupling (n, n): `demand_coupling`.

    smooth (n,): thrust of each rotor; rise (2, n): commands above the least and the most that they were. active (n,): rotors already known
    to be weak. rough (4,): variance of this flight's disturbances.
    """
    import jax.numpy as jnp

    # Of a rotor that gives one thrust counts what that is more, or less, than its command.
    more = best.gives / jnp.maximum(smooth, LEAST_THRUST)
    jump = jnp.where(best.each > 0.0, best.each - more, best.each)
    # A controller asks more of a rotor that gives less, and less of one that gives more: a candidate whose command went the other way is
    # none. Of two rotors it asks what geometry leaves of that.
    # Two rotors at once are rare: they have to show as they would in calm air.
    n, two = smooth.shape[0], (jump != 0.0).any(axis=1).all()
    rough, below = jnp.where(two, 0.0, rough), jnp.where(two, 0.0, jnp.maximum(air(now, n), 0.0))
    swing = jnp.sqrt(rough[:3].sum()) / n
    demanded = coupling @ (jump.sum(axis=0) * smooth)
    slack, (risen, fallen) = jnp.maximum(DEMAND_SLACK, swing), rise
    asked = jnp.where(jump > 0, risen > DEMAND_SHARE * demanded - slack, True)
    asked &= jnp.where((jump < 0) & ~active, fallen < DEMAND_SHARE * demanded + slack, True)
    ok = jnp.abs(jump).max() > hypotheses.NONE
    # ... and what the rotors no longer give must be missing from the thrust, as far as its average can show that by now, and air from below
    # does not give it.
    slack = jnp.maximum(MISSING_SLACK, jnp.sqrt(rough[3])) + below
    lost_thrust = (jnp.clip(jump, 0.0, 1.0) * smooth).sum() * (1.0 - jnp.exp(-since_s / plant.ANSWER_S))
    ok &= ~thrust_valid | (lost_thrust <= 0.0) | (now.fast - before.slow > DEMAND_SHARE * lost_thrust - slack)
    # ... and not because a rotor at its limit gives no more.
    claimed = (jump > 0) & ~active[None, :]
    ok &= jnp.where(claimed, jump > now.limit[None, :], True).all()
    # What pushes a vehicle from below for a moment looks as if a rotor gave more: one that does is taken off the command, and stays so.
    cut = (smooth * best.rotors).sum() < CUT_SHARE * smooth.mean()
    return Plausible(asked.all(), ok & ((best.gives <= 0.0) | ((since_s >= 0.5 * plant.ANSWER_S) & cut)))
