"""Explanations of a flight so far, side by side: which rotors are weak, how much, and what the filter would then hold.

A jump found in the innovations may be several things: this rotor or its neighbour, two rotors, a disturbance. Each of them becomes a
branch: a set of weak rotors with its own filter state s = [x; theta], covariance P and log weight. All branches filter the same
measurements; a branch's weight grows by the log-likelihood of its innovations nu with variances S (a bank of Kalman filters; D. T.
Magill, IEEE Trans. Automatic Control 10 (1965) 434-439),

    log w_b += g sum_a c_a [ -log S_a / 2 - nu_a^2 / (2 S_a) ],       g = TEMPER exp(-age / RESOLVE_S)

c_a: weight of evidence in weather that the noise model does not know (caution.py). g: evidence of the age of an explanation tells less and
less; what decides is how a change looked, and after it the errors of the model. The branch in place 0 leads: it has the jump bank.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array

PLACES = 4
RESOLVE_S, TEMPER = 3.0, 0.3
OUT = -7.0  # log weight relative to the leader's at which a branch is dropped
AHEAD = 2.3  # nats by which another must be better before it leads: ten times likelier
NEVER = -1e3


class Branches(NamedTuple):
    """K = PLACES explanations, the leader first. s (K, n_s), P (K, n_s, n_s); weight (K,): log, 0 for the leader, NEVER where there is
    none; active (K, n): weak rotors; learning (K, n): seconds their losses are still refined; theta_var, theta_mean (K, n): variance
    after that, and mean lately; onset (K,): ticks since its last jump of a rotor; age: s since then."""

    s: Array
    P: Array
    weight: Array
    active: Array
    learning: Array
    theta_var: Array
    theta_mean: Array
    onset: Array
    age: Array


def init(s: Array, P: Array, n: int) -> Branches:
    """One explanation: nothing has happened."""
    K = PLACES
    none = np.zeros((K, n))
    return Branches(
        np.tile(s, (K, 1)),
        np.tile(P, (K, 1, 1)),
        np.where(np.arange(K) == 0, 0.0, NEVER),
        np.zeros((K, n), bool),
        none,
        none,
        none,
        np.zeros(K),
        np.float64(1e3),
    )


def weigh(branches: Branches, innovation, variance, valid, calm, counts, dt: float) -> Branches:
    """One tick's innovations (K, 4) of variance (K, 4) where valid (4,); calm (4,): their weight; counts: whether they do at all."""
    import jax.numpy as jnp

    fit = -0.5 * jnp.log(variance) - 0.5 * innovation**2 / variance
    told = jnp.where(valid, calm, 0.0)
    share = jnp.where(counts, TEMPER * jnp.exp(-branches.age / RESOLVE_S), 0.0)
    weight = branches.weight + share * (fit @ told)
    weight = weight - weight[0]
    weight = jnp.where((branches.weight > 0.5 * NEVER) & (weight > OUT), weight, NEVER)
    return branches._replace(weight=weight, onset=branches.onset + 1.0, age=branches.age + dt)


def lead(branches: Branches) -> tuple[Branches, Array]:
    """The best explanation in place 0; and whether that is another one than before."""
    import jax.numpy as jnp

    best = jnp.argmax(branches.weight)
    change = branches.weight[best] > AHEAD
    order = jnp.eye(PLACES)
    here = (jnp.arange(PLACES) == best).astype(float)
    swapped = order - jnp.outer(order[0] - here, order[0] - here)
    turn = jnp.where(change, swapped, order)

    def moved(a):
        flat = a.reshape(PLACES, -1)
        return (
            (turn @ flat.astype(float)).reshape(a.shape).astype(a.dtype)
            if a.dtype != bool
            else ((turn @ flat.astype(float)).reshape(a.shape) > 0.5)
        )

    new = Branches(*[moved(a) if getattr(a, "ndim", 0) else a for a in branches])
    return new._replace(weight=jnp.where(new.weight > 0.5 * NEVER, new.weight - new.weight[0], NEVER)), change


def shares(branches: Branches):
    """(K,) probability of each explanation among those that are left."""
    import jax.numpy as jnp

    p = jnp.exp(branches.weight)
    return p / p.sum()
