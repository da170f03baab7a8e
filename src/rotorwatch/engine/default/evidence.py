"""How strongly the data speak for a jump of each kind, whenever it was: the bank's onset times summed, and the best one picked.

With prior weights p_h, and onsets equally likely at any tick, the evidence of a hypothesis h is the sum over the slots w of the bank,

    log sum_w exp( log BF_wh + log p_h + log stride_w )

and that of a fault the sum over the hypotheses that are one: the Shiryaev-Roberts statistic (Pollak, Ann. Statist. 13, 1985). With the
most probable onset and size of a hypothesis comes what the augmented filter would hold, had it known of the jump.
"""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch.core import Array
from rotorwatch.engine.default import bank, hypotheses, noise
from rotorwatch.engine.default.hypotheses import NOTHING, Hypotheses
from rotorwatch.engine.estimator.evidence import DISTURBANCE_LEAST, DISTURBANCE_MOST, DISTURBANCE_SCALE

DISTURBANCE_RANGE = DISTURBANCE_LEAST, DISTURBANCE_MOST


class Evidence(NamedTuple):
    """Of all hypotheses (n_h,): log evidence over all onsets, probability among faults. fault, other: log of the sums; far: that
    of disturbances much larger than this flight's; log_bf (W, n_h): Bayes factors, per_slot (W, n_h): with prior weights; nu
    (W, n_fault, 2): sizes; spread (W, n): variance of the size of one rotor alone; recovery (W, n): sizes that end a known loss;
    slop (W, 4): `hypotheses.slop`; width (4,): of disturbances; live (W,): slots in use; gives (2, W, n): thrust that
    each rotor gives if it gives but one, and the variance of that."""

    log_odds: Array
    probability: Array
    fault: Array
    other: Array
    far: Array
    log_bf: Array
    per_slot: Array
    nu: Array
    spread: Array
    recovery: Array
    slop: Array
    width: Array
    live: Array
    gives: Array


class Jump(NamedTuple):
    """One hypothesis at its most probable onset. slot (W,): that onset, one-hot; since: ticks since then; rotors (n,): whether it is
    theirs; size (q,) with its covariance cov; each (2, n): size, rotor by rotor; gives: the thrust that its rotor gives, whatever it is
    commanded, where it is that, else 0."""

    slot: Array
    since: Array
    rotors: Array
    size: Array
    cov: Array
    each: Array
    gives: Array


def gather(
    hyp: Hypotheses,
    onsets: bank.Jumps,
    statistics: bank.Bank,
    theta,
    active,
    variances,
    reach,
    drag,
    air,
    outside,
    B,
    full,
) -> Evidence:
    """The evidence of a bank without its last direction. theta (n,): known losses, of the rotors `active` (n,); variances (4, 4) of the
    noise model; reach (n,): the most that a whole loss of each rotor does to any axis by geometry; drag (n,): what the drag of each does
    to yaw; air: `plausibility.air`, as a variance; outside: `model_error.outside`; B (4, n): effectiveness; full: thrust of a rotor."""
    import jax.numpy as jnp

    n = hyp.n
    # A known loss may be taken back; what the filter has absorbed of that already is part of the jump.
    lo, hi = jnp.where(active, -1.0, 0.0), jnp.maximum(1.0 - theta, 0.0)
    width = jnp.clip(DISTURBANCE_SCALE * jnp.sqrt(noise.spread(variances)), *DISTURBANCE_RANGE)
    # What moving air does to thrust needs no rotor, nor what a force from the side does: it turns the vehicle at an arm as long as its own.
    width = jnp.sqrt(width**2 + outside**2 + air * jnp.array([0.0, 0.0, 0.0, 1.0]))
    live = statistics.age >= 0
    # What ends a known loss: of a unit jump the filter has by now, or will have, so much of theta left.
    own = jnp.diagonal(statistics.M[:, -n:, :n], axis1=1, axis2=2)
    to_come = jnp.where(jnp.asarray(onsets.slow), onsets.decay ** (jnp.maximum(statistics.age, 0) + 1.0), 0.0)
    recovery = jnp.where(active, -theta / jnp.maximum(own + to_come[:, None], 0.3), 0.0)
    slop = hypotheses.slop(statistics.C, statistics.z, lo, hi, reach, drag)
    log_bf, nu, spread, gives = hypotheses.log_bayes_factors(
        hyp, statistics.C, statistics.z, lo, hi, width, recovery, slop, air, B, full
    )
    far = hypotheses.disturbances(hyp, statistics.C, statistics.z, hypotheses.FAR * width)
    log_bf, far = (jnp.where(live[:, None], b, NOTHING) for b in (log_bf, far))
    stride = jnp.asarray(onsets.log_stride)
    per_slot = log_bf + stride[:, None] + jnp.log(jnp.asarray(hyp.weight))[None, :]
    far = far + stride[:, None] + jnp.log(hypotheses.FAR_SHARE * hypotheses.WEIGHT["disturbance"])
    # With a rotor lost altogether the vehicle flies at its limits, where the others look weak: no two of them are judged at once.
    new = jnp.asarray(hyp.pick.sum(axis=1)) @ (~active).astype(float)  # rotors of each hypothesis
    dead = (active & (theta > hypotheses.TOTAL_LOSS)).any()
    # ... and beside a weak one it is not asked whether another gives one thrust.
    barred = (
        (dead & (new > 1.5))
        | (jnp.asarray(hyp.well) & (new > 0.5))
        | (jnp.asarray(hyp.stuck) & active.any() & (new > 0.5))
    )
    fault = jnp.asarray(hyp.fault)
    # A rotor that has failed is likely to change again, another one less so, and far less beside one that is lost.
    another = jnp.where(dead, -3.0, jnp.where(active.any(), -1.0, 0.0)) * hypotheses.CLEAR
    prior = jnp.where(new < 0.5, hypotheses.CLEAR, another)
    per_slot = jnp.where(barred & fault, 2.0 * NOTHING, per_slot + jnp.where(fault, prior, 0.0))
    top = per_slot.max(0)
    odds = top + jnp.log(jnp.exp(per_slot - top[None]).sum(0))
    best = jnp.max(jnp.where(fault, odds, -jnp.inf))
    share = jnp.where(fault, jnp.exp(odds - best), 0.0)
    least = jnp.max(jnp.where(fault, -jnp.inf, odds))
    return Evidence(
        log_odds=odds,
        probability=share / share.sum(),
        fault=best + jnp.log(share.sum()),
        other=least + jnp.log(jnp.where(fault, 0.0, jnp.exp(odds - least)).sum()),
        far=far.max() + jnp.log(jnp.exp(far - far.max()).sum()),
        log_bf=log_bf,
        per_slot=per_slot,
        nu=nu,
        spread=spread,
        recovery=recovery,
        slop=slop,
        width=width,
        live=live,
        gives=gives,
    )


def jump(hyp: Hypotheses, statistics: bank.Bank, found: Evidence, h, B) -> Jump:
    """Hypothesis h at its most probable onset: sizes of its rotors, or of the steps of a disturbance."""
    import jax.numpy as jnp

    n, q = hyp.n, hyp.n + 4
    it = (jnp.arange(len(hyp.names)) == h).astype(float)
    slot = jnp.argmax(jnp.where(found.live, found.per_slot @ it, -jnp.inf))
    slot = (jnp.arange(found.live.shape[0]) == slot).astype(float)
    _, C, z = bank.pick(statistics, slot)
    rotors = jnp.einsum("h,hkr->kr", it, jnp.asarray(hyp.pick))
    steps, well = it @ jnp.asarray(hyp.steps), it @ jnp.asarray(hyp.well, float)
    each = jnp.einsum("w,h,whk->k", slot, it[: found.nu.shape[1]], found.nu)[:, None] * rotors
    free = jnp.where(steps.sum() > 0.5, steps * (hypotheses.FAR * found.width) ** 2, slot @ found.slop) + 1e-12
    width = jnp.where(well > 0.5, hypotheses.recovery_sd(slot @ found.recovery @ rotors[0]), hypotheses.LOSS_WIDTH)
    D = jnp.concatenate([jnp.concatenate([rotors, jnp.zeros((2, 4))], axis=1), jnp.eye(q)[n:]])
    own = jnp.concatenate([1.0 / width[None] ** 2, 1.0 / width[None] ** 2, 1.0 / free])
    half = _half_inverse(D @ C @ D.T + jnp.diag(own))
    # What geometry is wrong by counts in how well a loss is known; it does not become a disturbance.
    mask = jnp.concatenate([jnp.ones(n), steps])
    cov = D.T @ (half.T @ half) @ D * mask[:, None] * mask[None, :]
    single = jnp.concatenate([it[:n], jnp.zeros(4)])  # all kinds of losses that it may be count
    cov = jnp.where(single.sum() > 0.5, jnp.diag(single) * (slot @ found.spread @ it[:n]), cov)
    half = _half_inverse(C[n:, n:] + jnp.diag(1.0 / free))
    stuck = (it @ jnp.asarray(hyp.stuck, float)) * rotors[0]
    gives = jnp.einsum("kwr,w,r->k", found.gives, slot, stuck)
    instead = jnp.concatenate([jnp.zeros(n), -B @ stuck])  # what it gives instead of what it is commanded
    sure = jnp.diag(jnp.concatenate([stuck, jnp.zeros(4)])) * hypotheses.NONE**2
    cov = jnp.where(stuck.sum() > 0.5, sure + gives[1] * instead[:, None] * instead[None, :], cov)
    size = jnp.concatenate([each.sum(axis=0), steps * (half.T @ (half @ z[n:]))]) + gives[0] * instead
    since = slot @ jnp.where(found.live, statistics.age + 1.0, 0.0)
    return Jump(slot, since, rotors.sum(axis=0) > 0.5, size, cov, each, gives[0])


def detectable(statistics: bank.Bank, found: Evidence):
    """(n,) standard deviation with which a loss of each rotor would be measured now."""
    import jax.numpy as jnp

    n = found.recovery.shape[1]
    own = jnp.where(found.live[:, None], jnp.diagonal(statistics.C, axis1=1, axis2=2)[:, :n], 0.0).max(0)
    return 1.0 / jnp.sqrt(own + 1.0 / hypotheses.LOSS_WIDTH**2)


def _half_inverse(A):
    """L^-1 of A (k, k) = L L'."""
    import jax.numpy as jnp

    k = A.shape[0]
    return hypotheses.forward(jnp.broadcast_to(hypotheses.cholesky(A[None]), (k, k, k)), jnp.eye(k)).T
