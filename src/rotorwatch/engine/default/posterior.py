"""Explanations of a flight so far, side by side: which rotors are weak, how much, and what the filter would then hold.

A jump found in the innovations may be several things: this rotor or its neighbour, two rotors, a disturbance. Each of them becomes a
branch: a set of weak rotors with its own filter state s = [x; theta], covariance P and log weight. All branches filter the same
measurements; a branch's weight grows by the log-likelihood of its innovations nu with variances S (a bank of Kalman filters; D. T.
Magill, IEEE Trans. Automatic Control 10 (1965) 434-439),

    log w_b += g sum_a c_a [ -log S_a / 2 - nu_a^2 / (2 S_a) ],       g = TEMPER exp(-age / BURST_S)

c_a: weight of evidence in weather that the noise model lacks (model_error.py). g: evidence of the age of an explanation tells less and
less; what decides is how a change looked, and after it the errors of the model. The branch in place 0 leads: it has the jump bank, and
what that bank finds becomes branches of it, each with its jump in state, covariance and cross-covariance, exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array
from rotorwatch.engine.default import bank, evidence, hypotheses, plant
from rotorwatch.engine.default.hypotheses import Hypotheses
from rotorwatch.engine.estimator.posterior import ALIKE, NEVER, OUT, TEMPER
from rotorwatch.engine.front import losses

PLACES = 4


class Branches(NamedTuple):
    """K = PLACES explanations, the leader first. s (K, n_s), P (K, n_s, n_s); weight (K,): log, 0 for the leader, NEVER where there is
    none; active (K, n): weak rotors; learning (K, n): seconds their losses are still refined; theta_var, theta_mean (K, n): variance
    after that, and mean lately; gives (K, n): thrust of rotors that follow no command, 0 of others; alike (K, n): found together as a pair
    that others look like;
    onset (K,): ticks since its last jump of a rotor; age: s since then."""

    s: Array
    P: Array
    weight: Array
    active: Array
    learning: Array
    theta_var: Array
    theta_mean: Array
    gives: Array
    alike: Array
    onset: Array
    age: Array


def init(s: Array, P: Array, n: int) -> Branches:
    """One explanation: nothing has happened."""
    K = PLACES
    none = np.zeros((K, n))
    return Branches(
        s=np.tile(s, (K, 1)),
        P=np.tile(P, (K, 1, 1)),
        weight=np.where(np.arange(K) == 0, 0.0, NEVER),
        active=np.zeros((K, n), bool),
        learning=none,
        theta_var=none,
        theta_mean=none,
        gives=none,
        alike=np.zeros((K, n), bool),
        onset=np.zeros(K),
        age=np.float64(1e3),
    )


def weigh(branches: Branches, innovation, variance, valid, calm, counts, dt) -> Branches:
    """One tick's innovations (K, 4) of variance (K, 4) where valid (4,); calm (4,): their weight; counts: whether they do at all."""
    import jax.numpy as jnp

    fit = jnp.where(valid, -0.5 * jnp.log(variance) - 0.5 * innovation**2 / variance, 0.0)
    counted = jnp.where(valid, calm, 0.0)
    share = jnp.where(counts, TEMPER * jnp.exp(-branches.age / plant.BURST_S), 0.0)
    weight = branches.weight + share * (fit @ counted)
    weight = weight - weight[0]
    # How rotors differ in hover is not known well enough to drop one of several pairs that look the same.
    weight = jnp.where(branches.alike.any(axis=1) & branches.alike[0].any(), jnp.maximum(weight, ALIKE), weight)
    # Yaw and thrust tell a pair from the rotor between them, and are slower than what announced it.
    stays = (weight > OUT) | (branches.age < losses.YOUNG_S)
    # One whose numbers have overflowed is none.
    weight = jnp.where((branches.weight > 0.5 * NEVER) & stays & jnp.isfinite(weight), weight, NEVER)
    return branches._replace(weight=weight, onset=branches.onset + 1.0, age=branches.age + dt)


def lead(branches: Branches) -> tuple[Branches, Array]:
    """The best explanation in place 0; and whether that is another one than before."""
    import jax.numpy as jnp

    best = jnp.argmax(branches.weight)
    change = branches.weight[best] > hypotheses.CLEAR
    place = jnp.arange(PLACES)
    swapped = jnp.where(place == 0, best, jnp.where(place == best, 0, place))
    turn = jnp.where(change, swapped, place)
    # Taken, not multiplied by ones and zeros: what has overflowed in one place would spoil all.
    new = Branches(*[jnp.asarray(a)[turn] if getattr(a, "ndim", 0) else a for a in branches])
    return new._replace(weight=jnp.where(new.weight > 0.5 * NEVER, new.weight - new.weight[0], NEVER)), change


def shares(branches: Branches):
    """(K,) probability of each explanation among those that are left."""
    import jax.numpy as jnp

    p = jnp.exp(branches.weight)
    return p / p.sum()


def born(
    branches: Branches,
    hyp: Hypotheses,
    statistics: bank.Bank,
    found: evidence.Evidence,
    alike,
    first,
    alarm,
    absorbed,
    B,
) -> Branches:
    """What may have happened becomes branches of the one that leads: the likeliest disturbance and the likeliest faults. alike
    (n_h,): pairs that others look like. Hypothesis `first` leads where it is announced, the disturbance where something was
    absorbed; else all stays."""
    import jax
    import jax.numpy as jnp

    def made(branches):
        fault = jnp.asarray(hyp.fault)
        left, chosen, h = jnp.where(fault, found.log_odds, -jnp.inf), [], first
        none = jnp.argmax(jnp.where(fault, -jnp.inf, found.log_odds))
        members = jnp.asarray(hyp.pick.sum(axis=1))
        with_first = members @ members[first] > members[first].sum() - 0.5
        for place in range(PLACES - 1):
            chosen.append((h, found.log_odds[h]))
            left = jnp.where(jnp.arange(left.size) == h, -jnp.inf, left)
            # One more rotor beside the first explains nearly all that the first does: the last fault is one without it.
            left = jnp.where(with_first & (place == PLACES - 3), -jnp.inf, left)
            h = jnp.argmax(left)
        chosen.append((none, jnp.logaddexp(found.other, found.far)))
        turn = jnp.where(alarm, jnp.arange(PLACES), PLACES - 1 - jnp.arange(PLACES))
        which, weight = (jnp.stack(part)[turn] for part in zip(*chosen))
        # The first place leads; nobody else may be ahead from the start.
        weight = jnp.minimum(weight - weight[0], hypotheses.CLEAR)
        # The odds against disturbances are what an announcement is made by; they are not tested again. Without one, and where no rotor
        # is weak, nothing but a disturbance may lead.
        considered = alarm | branches.active[0].any()
        barred = jnp.where(alarm, which == none, ~considered & (which != none))
        # What adds a rotor to the first has to earn it at once.
        barred |= with_first[which] & (weight <= OUT)
        weight = jnp.where(barred, NEVER, weight)
        child = jax.vmap(lambda h: _child(branches, hyp, statistics, found, alike, h, B))(which)
        return child._replace(weight=weight, age=jnp.where(considered, 0.0, branches.age))

    return jax.lax.cond(alarm | absorbed, made, lambda same: same, branches)


def _child(
    branches: Branches, hyp: Hypotheses, statistics: bank.Bank, found: evidence.Evidence, alike, h, B
) -> Branches:
    """The leader with the jump of hypothesis h: exactly what an augmented filter with this jump would hold."""
    import jax.numpy as jnp

    n_x, n = branches.s.shape[1] - hyp.n, hyp.n
    jump = evidence.jump(hyp, statistics, found, h, B)
    M, _, _ = bank.pick(statistics, jump.slot)
    s, P = branches.s[0] + M @ jump.size, branches.P[0] + M @ jump.cov @ M.T
    theta, sd = s[n_x:], jnp.sqrt(jnp.maximum(jnp.diagonal(P)[n_x:], 0.0))
    taken_back = (jump.each.sum(axis=0) < 0) & (theta < jnp.maximum(hypotheses.NONE, 2.0 * sd))
    off = jump.rotors & (jnp.asarray(hyp.well)[h] | taken_back)
    for i in range(n):  # a rotor that is well again: what if its loss were known to be none, but for how rotors differ
        column = P[:, n_x + i]
        variance = jnp.maximum(column[n_x + i], 1e-12) + plant.BUILT_SD**2
        s = jnp.where(off[i], s - column * (s[n_x + i] / variance), s)
        P = jnp.where(off[i], P - column[:, None] * column[None, :] / variance, P)
    return Branches(
        s=s,
        P=0.5 * (P + P.T),
        weight=branches.weight[0],
        active=(branches.active[0] | jump.rotors) & ~off,
        learning=jnp.where(off, 0.0, jnp.where(jump.rotors, plant.USUAL_S, branches.learning[0])),
        theta_var=jnp.where(off, 0.0, branches.theta_var[0]),
        theta_mean=jnp.where(jump.rotors, s[n_x:], branches.theta_mean[0]),
        gives=jnp.where(off, 0.0, jnp.where(jump.rotors, jump.gives, branches.gives[0])),
        alike=(branches.alike[0] | (jump.rotors & jnp.asarray(alike)[h])) & ~off.any(),
        onset=jnp.where(jump.rotors.any(), jump.since, branches.onset[0]),
        age=jnp.zeros(()),
    )
