"""The default diagnoser: a Kalman filter, a bank of jump detectors on its innovations, and explanations side by side.

The step below is the method, in the order of docs/methods/default.md; each part has its file. The filter (kalman.py) runs on the wrench
balance (plant.py) with the losses theta of already announced rotors in its state. For every onset time in a bank (bank.py) the exact
effect of a unit jump on the innovations is carried along, so that at each tick the likelihood ratio of any jump at any of these times is
known, with its most probable size (hypotheses.py, evidence.py). When a fault is announced (announcement.py, plausibility.py) what may
have happened becomes a few explanations (posterior.py); the best of them leads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array, Decision, Estimate
from rotorwatch.engine.default import (
    announcement,
    bank,
    evidence,
    hypotheses,
    kalman,
    model_error,
    noise,
    opposite,
    plant,
    plausibility,
    posterior,
)
from rotorwatch.engine.default.plant import AIR, B3, CURVE, DAMPING, GAIN, PER_AXIS
from rotorwatch.engine.front.ticks import AGAIN, GROUND, JUDGE


class Carry(NamedTuple):
    """All that lasts from tick to tick: the explanations with their filters, the noise model, the leader's bank, and the memories of
    model error, plausibility, announcement and (opposite_s) of opposite rotors."""

    branches: posterior.Branches
    noise: noise.NoiseState
    bank: bank.Bank
    model_error: model_error.Memory
    missing: plausibility.Missing
    alarm_state: announcement.AlarmState
    opposite_s: Array

    @property
    def s(self):
        """State [x; theta] of the explanation that leads."""
        return self.branches.s[0]

    @property
    def P(self):
        """Its covariance."""
        return self.branches.P[0]


class Output(NamedTuple):
    """What one tick leaves behind, beside the Estimate and the Decision. announced: explanations were made at this tick; onsets
    (K,): ticks since the last jump of a rotor in each; active, each (K, n), share (K,): their rotors, losses and probabilities, the leader
    first; gives (n,): thrust of the leader's rotors that follow no command, 0 of others; built
    (4,): wrench by which the rotors that are not weak seem to differ, as they are built."""

    estimate: Estimate
    decision: Decision
    probability: Array
    theta: Array
    theta_sd: Array
    announced: Array
    onsets: Array
    active: Array
    each: Array
    share: Array
    gives: Array
    built: Array
    detectable: Array
    plausible: Array
    opposite: opposite.Opposite


class JumpBank:
    """system: a WrenchBalance. dt: tick length in s, a number or traced. The last two inputs in u are mode (GROUND, LEARN, JUDGE) and
    restart: 1 at the first tick of a hop, AGAIN at a contact."""

    name = "default"
    not_kalman = "a loss enters its state only once it is announced, and its noise is learned on the way"

    def __init__(self, system, dt=0.05, noise_prior=None):
        """noise_prior: (variances (4, 4), weight) learned from healthy flights, or None."""
        self.system, self.dt, self.noise_prior = system, dt, noise_prior
        self.n, self.n_x, self.n_s = system.n_theta, system.n_x, system.n_x + system.n_theta
        self.hyp = hypotheses.make(self.n)
        self.limit = announcement.threshold(self.hyp, dt)
        # A jump is a rotor's loss, or a step of an axis' bias. The last two directions are errors of the model, integrated out. What it
        # takes to yaw this vehicle is the least known of its gains, and the yaw that follows a loss is long and slow. How fast roll and
        # pitch die out is known only once it has moved: when it first flies off, both at once look like a rotor's loss.
        E = np.zeros((self.n_s, self.n + 6))
        E[self.n_x :, : self.n] = np.eye(self.n)
        E[np.arange(4) * PER_AXIS + B3, self.n + np.arange(4)] = 1.0
        self.yaw_gain = 2 * PER_AXIS + GAIN
        E[self.yaw_gain, -2] = 1.0
        E[np.arange(2) * PER_AXIS + DAMPING, -1] = 1.0
        self.jumps = bank.Jumps(E, self.dt)

    def init(self) -> Carry:
        """Before the first tick: nothing announced, the system's prior."""
        P = np.zeros((self.n_s, self.n_s))
        P[: self.n_x, : self.n_x] = self.system.P0
        P[self.n_x :, self.n_x :] = plant.BUILT_SD**2 * (np.eye(self.n) - 1.0 / self.n)
        return Carry(
            branches=posterior.init(np.concatenate([np.asarray(self.system.x0), np.zeros(self.n)]), P, self.n),
            noise=noise.init(self.dt, *(self.noise_prior or ())),
            bank=self.jumps.init(self.n),
            model_error=model_error.init(self.n),
            missing=plausibility.init(self.n),
            alarm_state=announcement.init(),
            opposite_s=np.float64(0),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """One tick; see Output."""
        import jax
        import jax.numpy as jnp

        system, hyp, n, n_x, dt = self.system, self.hyp, self.n, self.n_x, self.dt
        mode, again, u = u[-2], u[-1], u[:-2]
        restart, hop = again > 0.5, (again > 0.5) & (again < AGAIN - 0.5)
        judge, flying = mode > JUDGE - 0.5, mode > GROUND + 0.5
        y, variances = jnp.where(valid, y, 0.0), carry.noise.variances

        # One tick ahead: the filters of all explanations, and the bank of the one that leads.
        branches = kalman.restart(carry.branches, system.P0, restart, hop)
        burst_factor = (1.0 / model_error.calm(carry.model_error)).mean()
        branches = kalman.predict(branches, system.decay(dt), variances, burst_factor, flying, dt)
        A = plant.arrays(dt).concatenate([system.decay(dt), np.ones(n)])
        onsets = self.jumps.advance(carry.bank, A, judge, judge & ~restart, carry.model_error.thrust)

        # How far this tick's inputs and the model can be believed.
        x = branches.s[0, :n_x]
        usual = jnp.maximum(jnp.where(restart, u[:n].mean(), carry.model_error.collective), 0.1)
        lost = system.H(u, x, usual) @ branches.s[0, n_x:]
        bend = system.bend(u, usual)
        bent = system.B @ bend
        memory, seen = model_error.look(
            carry.model_error, u, y, lost, valid, flying, restart, x, variances, n, dt, bent
        )
        # What carries a vehicle that is not clear of the ground says nothing of the curve, and beside a weak rotor a curve looks like
        # its loss.
        seen = seen._replace(curve=seen.curve * (judge & ~branches.active[0].any()))
        flow = system.inflow(u)
        shows = flying * model_error.shows_air(flow[3] / n)
        seen = seen._replace(gain_share=seen.gain_share.at[AIR].set(shows))
        error = model_error.variance(carry.model_error, seen, x, y, variances[0], system.B, n, dt)
        calm = model_error.calm(memory)
        lacking = y[3] + bent[3] * x[CURVE] - u[n + 3] * x[3 * PER_AXIS + GAIN] - flow[3] * x[AIR]
        missing = plausibility.follow(carry.missing, lacking, u[n + 3] / n, u[:n] / u[n + 9], valid[3], restart, dt)

        # The measurement: to every explanation, and to the bank.
        rows, drag = jnp.concatenate([system.C(seen.u, usual), system.H(seen.u, x, usual)], axis=1), system.drag(seen.u)
        bent = rows[:, CURVE]
        rows = rows.at[:, CURVE].set(seen.curve * bent)
        y = y + drag.sum(axis=1) - (1.0 - seen.curve) * bent * x[CURVE]
        counts, R = valid & flying, variances[0] + error + model_error.ERROR_TICKS * (drag @ branches.s[0, n_x:]) ** 2
        left = y - rows @ branches.s[0]
        curve = (jnp.array([0.0, 1.0]) - u[n + 10]) / jnp.maximum(u[n + 11], 1e-9)
        least, most = jnp.stack([curve, jnp.array([0.0, jnp.inf])], axis=1)
        s, P, gains, innovation, variance = jax.vmap(
            lambda s, P: kalman.update(s, P, rows, y, counts, R, seen.gain_share, least, most)
        )(branches.s, branches.P)
        for a in range(4):
            w = jnp.where(counts[a], calm[a] / variance[0, a], 0.0)
            onsets = self.jumps.observe(onsets, rows[a], gains[0, a], w, innovation[0, a])
        memory = model_error.remember(memory, innovation[0], variance[0], counts, dt)

        # Which explanation leads.
        branches = posterior.weigh(branches._replace(s=s, P=P), innovation, variance, counts, calm, judge, dt)
        branches, changed = posterior.lead(branches)
        onsets = bank.forget(onsets, changed)

        # What the bank says of any jump since, and whether that is announced.
        theta, P, active = branches.s[0, n_x:], branches.P[0], branches.active[0]
        statistics = bank.without_last(onsets, model_error.unknown_damping(branches.s[0, :n_x], onsets.z[:, -1], n))
        statistics = bank.without_last(statistics, jnp.maximum(P[self.yaw_gain, self.yaw_gain], 1e-12))
        reach = jnp.abs(system.B).max(axis=0) * seen.u[:n]
        air = plausibility.air(missing, n) ** 2
        outside = model_error.outside(memory, n)
        found = evidence.gather(
            hyp, self.jumps, statistics, theta, active, variances, reach, drag[2], air, outside, system.B, u[n + 9]
        )
        first = jnp.argmax(found.probability)
        best = evidence.jump(hyp, statistics, found, first, system.B)
        rough = noise.spread(variances)
        coupling = plausibility.demand_coupling(system.B)
        # A manoeuvre swings commands about their trim: what a rotor was commanded at the onset counts as well.
        before = best.slot @ onsets.before
        rise = seen.part - jnp.minimum(seen.trim, before), seen.part - jnp.maximum(seen.trim, before)
        possible = plausibility.plausible(
            best, best.since * dt, seen.u[:n], rise, missing, carry.missing, valid[3], active, rough, coupling
        )
        alarm_state, alarm_decision = announcement.decide(
            carry.alarm_state, found, best, self.jumps, self.limit, possible, active.any(), judge, dt
        )
        free = judge & ~alarm_decision.alarm & (jnp.abs(seen.u[n + 6]) < opposite.TURNING) & ~active.any()
        pair, opposite_s = opposite.suspect(
            hyp, self.jumps, statistics, found, system.B, free, missing, self.limit, carry.opposite_s, dt
        )
        # Opposite rotors are announced as any other fault; only which pair it is the others of its kind contest.
        shared = pair.pair >= 0
        first, alarm = jnp.where(shared, pair.pair, first), alarm_decision.alarm | shared
        alike = opposite.contested(hyp, system.B)
        mine = jnp.where(jnp.arange(alike.size) == first, found.log_odds, -jnp.inf).max()
        other = jnp.maximum(found.log_odds, mine + posterior.ALIKE)
        odds = jnp.where(alike & alike[first], other, found.log_odds)
        even = found._replace(log_odds=jnp.where(shared & ~alike, 2.0 * hypotheses.NOTHING, odds))
        branches = posterior.born(
            branches, hyp, statistics, even, alike, first, alarm, alarm_decision.absorbed, system.B
        )
        onsets = bank.forget(onsets, alarm | alarm_decision.absorbed)

        # The noise learns from what the calm parts leave over, biases included.
        alarm_state, quiet = announcement.suspicion(alarm_state, found, hyp, dt)
        learns = quiet & flying
        left = left + (rows[:, :n_x] * jnp.asarray(np.isin(np.arange(n_x), kalman.BIASES), float)) @ x
        noises = noise.step(carry.noise, left, valid & learns, variances[0] / R, dt)

        after = Carry(branches, noises, onsets, memory, missing, alarm_state, opposite_s)
        weak = branches.active[0]
        each = jnp.where(branches.active, jnp.clip(branches.s[:, n_x:], 0.0, 1.0), 0.0)
        shown = each[0]
        # The filter believes its noise model; where innovations have been larger or longer than that, so is the error.
        unsure = opposite.common(shown, branches.alike[0])
        # What of the curve is still open is open of a loss, too: by as much as the rotor is commanded more than is usual, and still gives.
        more = usual + jnp.maximum(memory.trim, 0.0)
        bent_share = (1.0 - shown) * system.bend(jnp.concatenate([more, u[n:]]), usual) / more
        curved = jnp.where(weak, bent_share**2, 0.0) * after.P[CURVE, CURVE]
        shown_var = (
            (unsure / 1.96) ** 2
            + branches.theta_var[0]
            + jnp.where(weak, (1.0 / calm).mean() * jnp.diagonal(after.P)[n_x:], 0.0)
            + curved
        )
        status = jnp.where(~flying, 1, jnp.where(valid.any(), 0, 2)).astype(jnp.int32)
        estimate = Estimate(
            after.s[:n_x], after.P[:n_x, :n_x], shown, after.P[n_x:, n_x:], innovation[0], jnp.diag(variance[0]), status
        )
        return after, Output(
            estimate=estimate,
            decision=Decision(
                found.log_odds, alarm_decision.statistic, alarm_decision.alarm, best.since, first.astype(jnp.int32)
            ),
            probability=found.probability,
            theta=shown,
            theta_sd=jnp.sqrt(jnp.maximum(shown_var, 0.0)),
            announced=alarm | (alarm_decision.absorbed & active.any()),
            onsets=branches.onset,
            active=branches.active,
            each=each,
            share=posterior.shares(branches),
            gives=jnp.where(weak, branches.gives[0], 0.0),
            built=rows[:, n_x:] @ jnp.where(weak, 0.0, after.s[n_x:]),
            detectable=evidence.detectable(statistics, found),
            plausible=alarm_decision.possible,
            opposite=pair._replace(pair=jnp.int32(-1)),
        )
