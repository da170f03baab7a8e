"""The default diagnoser: one augmented Kalman filter and a bank of jump detectors on its innovations.

The filter runs on the wrench balance with the losses theta of already announced rotors in its state. For every onset time in
a bank (default/bank.py) the exact effect of a unit jump on the innovations is carried along, so that at each tick the likelihood ratio
of any jump - one rotor, two rotors, common mode, a torque bias, any disturbance (default/hypotheses.py) - at any of these times is
known, with its most probable size and its covariance. Summed over onset times with prior weights this is the
Shiryaev-Roberts statistic, whose mean time to a false alarm is at least its threshold (Pollak, Ann. Statist. 13, 1985):
the threshold follows from the stated false-alarm rate. When it is passed, what may have happened becomes a few branches
(default/posterior.py), each with its jump in state, covariance and cross-covariance, exactly; the best of them leads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array, Decision, Estimate
from rotorwatch.default import bank as onsets
from rotorwatch.default import caution, hypotheses, noise, plausibility, posterior
from rotorwatch.default.plant import B1, B2, B3, GAIN, PER_AXIS
from rotorwatch.motion.ticks import AGAIN, GROUND, JUDGE

FALSE_ALARM_PERIOD_S = 10 * 3600.0  # promised: no more than one in so long
# Of the statistic's own false alarms - as rare, on surrogates of real noise, as its threshold says - odds, persistence and plausibility
# let pass at most this share: none of 6 there, and 1 of 81 with a threshold 4 nats lower.
GATES = 0.15
COMPETITOR_ODDS = 10.0  # how much likelier than any disturbance a fault must be
PERSIST_S = 0.15
EDGE = 0.9  # of the bank's reach
LEARN_LOSS_S = 6.0  # a new loss is refined this long; after that only a new jump changes it,
# unless it grows: has left its mean over MOVING_S by MOVING, and by its own uncertainty.
MOVING, MOVING_S = 0.01, 2.0
THETA_WALK = 0.02**2  # 1/s, while it is refined
KNOWN_BONUS, SECOND_NATS = 2.0, 3.0  # nats: a rotor that has failed is likely to change again, another one less so
DISTURBANCE_SCALE, DISTURBANCE_RANGE = 3.0, (0.03, 1.0)
OUTLIER = 6.0  # standard deviations that an innovation counts at most
TRUST = 3000.0  # nats
DEAD = 0.8
ABSORB_S, CERTAIN_NATS, UNDECIDED = 1.0, 16.0, 3.0
FREEZE_S = 4.0
SETTLE_S = 1.5  # after a jump, before noise is learned again
SUSPICIOUS_PERIOD_S = 60.0  # noise is not learned while there is more evidence than chance would bring in a minute
# A disturbance that opposite rotors explain as well, within OPPOSITE_NATS, and that came at once: SHARP_NATS likelier than one that
# builds up; for so long.
OPPOSITE_NATS, SHARP_NATS, OPPOSITE_S, OPPOSITE_LOSS = 5.0, 2.0, 0.5, 0.03
# rad/s of yaw, above which its drag is known too badly for that; and load factor away from 1: who climbs, drops or is tossed about
# changes the air that all rotors meet
TURNING, HEAVING = 0.15, 0.2
OVER = 0.02


def threshold(hyp: hypotheses.Hypotheses, dt: float, period_s: float = GATES * FALSE_ALARM_PERIOD_S) -> float:
    """Log of the Shiryaev-Roberts threshold: the mean time to a false alarm, in ticks, is at least its value over the sum
    of the fault hypotheses' prior weights (about the number of rotors), as far as the noise is what the model says."""
    new = hyp.fault & (np.array(hyp.kinds) != "recovery")
    return float(np.log(period_s / dt * hyp.weight[new].sum()))


class Standing(NamedTuple):
    """above: ticks over the threshold in a row. frozen: seconds of suspicion in which no noise was learned; sure_s: seconds for which
    a disturbance has been certain; opposite_s: for which opposite rotors explain one."""

    above: Array
    frozen: Array
    sure_s: Array
    opposite_s: Array


class Carry(NamedTuple):
    """The explanations with their filter states, the noise model, the leader's bank, and the memories of its parts."""

    branches: posterior.Branches
    noise: noise.NoiseState
    bank: onsets.Bank
    caution: caution.Memory
    missing: plausibility.Missing
    standing: Standing

    @property
    def s(self):
        """State [x; theta] of the explanation that leads."""
        return self.branches.s[0]

    @property
    def P(self):
        """Its covariance."""
        return self.branches.P[0]


class Evidence(NamedTuple):
    """Of all hypotheses (n_h,): log evidence over all onsets, probability among faults. fault, other: log of the sums; far: that
    of disturbances much larger than this flight's; log_bf (W, n_h): Bayes factors, per_slot (W, n_h): with prior weights; nu
    (W, n_fault, 2): most probable sizes; gone (W, n): sizes that end a known loss; slop (W, 4): `hypotheses.slop`; width (4,): of
    disturbances; live (W,): slots in use."""

    log_odds: Array
    probability: Array
    fault: Array
    other: Array
    far: Array
    log_bf: Array
    per_slot: Array
    nu: Array
    gone: Array
    slop: Array
    width: Array
    live: Array


class Jump(NamedTuple):
    """One hypothesis at its most probable onset. slot (W,): that onset, one-hot; size (q,) with its covariance cov; each (2, n): rotor by
    rotor; sd (n,): of each rotor's."""

    slot: Array
    size: Array
    cov: Array
    each: Array


class Opposite(NamedTuple):
    """A sudden shift that is a disturbance, or else a pair of opposite rotors that explains it as well. pair: its hypothesis, at the
    tick that says so, else -1; onset: ticks ago; loss (2,) of its rotors."""

    pair: Array
    onset: Array
    loss: Array


class Output(NamedTuple):
    """What one tick leaves behind, beside the Estimate and the Decision. announced: explanations were made at this tick; since: ticks
    since the jump of the one that leads; active (K, n), share (K,): their rotors and probabilities, the leader first."""

    estimate: Estimate
    decision: Decision
    probability: Array
    theta: Array
    theta_sd: Array
    announced: Array
    since: Array
    active: Array
    share: Array
    detectable: Array
    plausible: Array
    opposite: Opposite


class JumpBank:
    """system: a WrenchBalance. dt: tick length in s. The last two inputs in u are mode (GROUND, LEARN, JUDGE) and restart: 1 at
    the first tick of a hop, AGAIN at a contact."""

    name = "default"
    not_kalman = "a loss enters its state only once it is announced, and its noise is learned on the way"

    def __init__(self, system, dt: float = 0.05, noise_prior=None, false_alarm_period_s: float = FALSE_ALARM_PERIOD_S):
        """noise_prior: (variances (4, 4), weight) learned from healthy flights, or None."""
        self.system, self.dt = system, float(dt)
        self.hyp = hyp = hypotheses.make(system.n_theta)
        self.noise_prior = noise_prior
        self.n, self.n_x = system.n_theta, system.n_x
        self.n_s = self.n_x + self.n
        self.log_threshold = threshold(hyp, dt, GATES * false_alarm_period_s)
        # A jump is a rotor's loss, or a step of an axis' bias. The yaw that follows a loss is long and slow, and what it takes to
        # yaw this vehicle is the least known of its gains: the last direction is an error in that, integrated out.
        E = np.zeros((self.n_s, self.n + 5))
        E[self.n_x :, : self.n] = np.eye(self.n)
        E[np.arange(4) * PER_AXIS + B3, self.n + np.arange(4)] = 1.0
        self.yaw_gain = 2 * PER_AXIS + GAIN
        E[self.yaw_gain, -1] = 1.0
        self.jumps = onsets.Jumps(E, self.dt)
        # Of each hypothesis: its (at most two) rotors, one-hot; the axes it steps; whether it is a rotor that is well again.
        self.pick = np.array(
            [
                [[float(f and k < len(who) and who[k] == i) for i in range(self.n)] for k in range(2)]
                for who, f in zip(hyp.rotors, hyp.fault)
            ]
        )
        self.steps = np.zeros((len(hyp.names), 4))
        self.steps[~hyp.fault] = [[float(a in block) for a in range(4)] for block in hypotheses.DISTURBANCES]
        self.well = np.array([kind == "recovery" for kind in hyp.kinds])
        self.membership = self.pick.sum(axis=1)
        self.bias_rows = np.array([a * PER_AXIS + b for a in range(4) for b in (B1, B2, B3)])

    def init(self) -> Carry:
        """Before the first tick: nothing announced, the system's prior."""
        P = np.zeros((self.n_s, self.n_s))
        P[: self.n_x, : self.n_x] = self.system.P0
        return Carry(
            posterior.init(np.concatenate([np.asarray(self.system.x0), np.zeros(self.n)]), P, self.n),
            noise.init(self.dt, *(self.noise_prior or ())),
            self.jumps.init(),
            caution.init(self.n),
            plausibility.init(self.n),
            Standing(np.int32(0), *[np.float64(0)] * 3),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """One tick; see Output."""
        import jax
        import jax.numpy as jnp

        n, n_x, dt = self.n, self.n_x, self.dt
        mode, restart, hop, u = u[-2], u[-1] > 0.5, (u[-1] > 0.5) & (u[-1] < AGAIN - 0.5), u[:-2]
        y = jnp.where(valid, y, 0.0)
        judge, flying = mode > JUDGE - 0.5, mode > GROUND + 0.5
        stand = carry.standing
        explained = self._predicted(self._restarted(carry.branches, restart, hop), carry, flying)
        biases = explained.s[0, :n_x]
        bank = self.jumps.advance(carry.bank, self._A(), judge, judge & ~restart)
        memory, seen = caution.look(carry.caution, u, y, valid, flying, restart, biases, carry.noise.variances, n, dt)
        white = carry.noise.variances[0]
        error = caution.model_error(carry.caution, seen, biases, y, white, self.system.B, n, dt)
        rows = jnp.concatenate([self.system.C(seen.u), self.system.H(seen.u, biases)], axis=1)
        e = y - rows @ explained.s[0]
        carried = u[n + 3] * biases[3 * PER_AXIS + GAIN]
        missing = plausibility.follow(
            carry.missing, y[3] - carried, u[n + 3] / n, u[:n] / u[n + 9], valid[3], restart, dt
        )
        calm = caution.calm(memory)

        def measured(s, P):
            return self._measured(s, P, rows, y, valid & flying, white + error, seen.teach)

        s, P, gains, innovation, variance = jax.vmap(measured)(explained.s, explained.P)
        for a in range(4):
            w = jnp.where((valid & flying)[a], calm[a] / variance[0, a], 0.0)
            bank = self.jumps.observe(bank, rows[a], gains[0, a], w, innovation[0, a])
        memory = caution.remember(memory, innovation[0], variance[0], valid & flying, dt)
        explained = explained._replace(s=s, P=P)
        explained = posterior.weigh(explained, innovation, variance, valid & flying, calm, judge, dt)
        explained, other_leads = posterior.lead(explained)
        bank = onsets.forget(bank, other_leads)

        s, P, active = explained.s[0], explained.P[0], explained.active[0]
        told = onsets.without_last(bank, jnp.maximum(P[self.yaw_gain, self.yaw_gain], 1e-12))
        reach = jnp.abs(rows[:, n_x:]).max(axis=0)
        found = self._evidence(s, told, carry.noise.variances, active, reach)
        rough = noise.spread(carry.noise.variances)
        first = jnp.argmax(found.probability)
        best = self._jump(found, told, first)
        # One rotor's direction may be met by chance, by a disturbance such as this flight has not seen yet.
        lone = (best.each != 0.0).any(axis=1).sum() < 2
        other = jnp.where(lone, jnp.logaddexp(found.other, found.far), found.other)
        statistic = jnp.minimum(found.fault - self.log_threshold, found.fault - other - jnp.log(COMPETITOR_ODDS))
        possible = plausibility.plausible(
            best.each, seen.u[:n], seen.rise, missing, carry.missing, valid[3], active, s[n_x:], rough
        )
        # The most probable onset at the edge of the bank speaks of a drift that began before it, not of a jump.
        onset = best.slot @ jnp.where(found.live, bank.age + 1.0, 0.0)
        possible &= onset < EDGE * self.jumps.reach
        above = jnp.where(judge & (statistic > 0.0) & possible, stand.above + 1, 0)
        alarm = above >= max(2, round(PERSIST_S / dt))

        detectable = self._detectable(told, found.live)
        # What certainly happened is explained, whatever it was; where nothing is known to be wrong, only what is no fault.
        certain = jnp.maximum(found.other, found.fault) > CERTAIN_NATS
        certain &= (found.other > found.fault + UNDECIDED) | active.any()
        sure_s = jnp.where(judge & ~alarm & certain, stand.sure_s + dt, 0.0)
        absorbed = sure_s >= ABSORB_S
        sure_s = jnp.where(absorbed, 0.0, sure_s)
        # Where no rotor is weak, a fault has to be announced.
        doubt = alarm | (absorbed & active.any())
        explained = self._born(explained, told, bank, found, first, alarm, absorbed)
        steady = (jnp.abs(seen.u[n + 6]) < TURNING) & (missing.heave < HEAVING)
        opposite, opposite_s = self._opposite(found, told, stand, active, judge & ~alarm & steady)
        bank = onsets.forget(bank, alarm | absorbed)
        above = jnp.where(alarm, 0, above)

        # Learn the noise from what the calm parts leave over, never from a growing suspicion.
        e = e + (rows[:, :n_x] * jnp.asarray(np.isin(np.arange(n_x), self.bias_rows), float)) @ biases
        suspicious = found.fault > threshold(self.hyp, dt, SUSPICIOUS_PERIOD_S)
        frozen = jnp.where(suspicious, stand.frozen + dt, jnp.maximum(stand.frozen - dt, 0.0))
        learns = (~suspicious | (frozen > FREEZE_S)) & (explained.age > SETTLE_S) & flying
        noises = noise.step(carry.noise, e, valid & learns, white / (white + error), dt)

        s, P = explained.s[0], explained.P[0]
        shown = jnp.clip(s[n_x:], 0.0, 1.0)
        # The filter believes its noise model; where innovations have been larger or longer than that, so is the error.
        shown_var = explained.theta_var[0] + (1.0 / calm).mean() * jnp.diagonal(P)[n_x:]
        estimate = Estimate(
            s[:n_x],
            P[:n_x, :n_x],
            shown,
            P[n_x:, n_x:],
            innovation[0],
            jnp.diag(variance[0]),
            jnp.where(~flying, 1, jnp.where(valid.any(), 0, 2)).astype(jnp.int32),
        )
        out = Output(
            estimate,
            Decision(found.log_odds, statistic, alarm, onset, first.astype(jnp.int32)),
            found.probability,
            shown,
            jnp.sqrt(jnp.maximum(shown_var, 0.0)),
            doubt,
            explained.onset[0],
            explained.active,
            posterior.shares(explained),
            detectable,
            possible,
            opposite,
        )
        standing = Standing(above.astype(jnp.int32), jnp.minimum(frozen, 2.0 * FREEZE_S), sure_s, opposite_s)
        return Carry(explained, noises, bank, memory, missing, standing), out

    def _A(self) -> np.ndarray:
        return np.concatenate([self.system.decay(self.dt), np.ones(self.n)])

    def _restarted(self, explained: posterior.Branches, restart, hop) -> posterior.Branches:
        """A new hop starts with new biases; what the vehicle is like, and how noisy, stays known. After a contact the biases may be any,
        but a loss that was known stays. Either ends the competition of explanations."""
        import jax.numpy as jnp

        keep = jnp.ones(self.n_s).at[self.bias_rows].set(0.0).at[self.n_x :].set(0.0)
        rows = np.ix_(self.bias_rows, self.bias_rows)
        P0 = jnp.zeros((self.n_s, self.n_s)).at[rows].set(jnp.asarray(self.system.P0)[rows])
        leads = jnp.arange(posterior.PLACES) == 0
        return explained._replace(
            s=jnp.where(hop, explained.s * keep, explained.s),
            P=jnp.where(hop, explained.P * keep[:, None] * keep[None, :], explained.P) + jnp.where(restart, P0, 0.0),
            active=explained.active & ~hop,
            learning=jnp.where(hop, 0.0, explained.learning),
            theta_var=jnp.where(hop, 0.0, explained.theta_var),
            weight=jnp.where(restart, jnp.where(leads, 0.0, posterior.NEVER), explained.weight),
        )

    def _predicted(self, explained: posterior.Branches, carry: Carry, flying) -> posterior.Branches:
        """One tick ahead. A loss that has been refined long enough is taken as known; its variance is remembered. One that turned out to
        be none is over."""
        import jax
        import jax.numpy as jnp

        A, n_x = self._A(), self.n_x
        doubt = (1.0 / caution.calm(carry.caution)).mean()
        q_x = jnp.where(flying, noise.process_variance(carry.noise.variances, self.dt), 0.0)
        q_x = jnp.concatenate([q_x, jnp.zeros(n_x - q_x.size)])

        def one(s, P, active, learning, theta_var, theta_mean):
            theta = s[n_x:]
            mean = theta_mean + (theta - theta_mean) * (self.dt / MOVING_S)
            var = doubt * jnp.diagonal(P)[n_x:]
            finished = (learning > 0) & (learning <= self.dt)
            moving = finished & (jnp.abs(theta - mean) > jnp.maximum(MOVING, jnp.sqrt(jnp.maximum(var, 0.0))))
            finished &= ~moving
            known = jnp.concatenate([jnp.ones(n_x), jnp.where(finished, 0.0, 1.0)])
            P = P * known[:, None] * known[None, :]
            learning = jnp.where(moving, MOVING_S, jnp.maximum(learning - self.dt, 0.0))
            Q = jnp.diag(jnp.concatenate([q_x, (learning > 0) * THETA_WALK * self.dt]))
            over = finished & (theta < OVER)
            s = s * jnp.concatenate([jnp.ones(n_x), jnp.where(over, 0.0, 1.0)])
            theta_var = jnp.where(over, 0.0, jnp.where(finished, var, theta_var))
            return A * s, A[:, None] * P * A[None, :] + Q, active & ~over, learning, theta_var, mean

        parts = ("s", "P", "active", "learning", "theta_var", "theta_mean")
        ahead = jax.vmap(one)(*(getattr(explained, name) for name in parts))
        return explained._replace(**dict(zip(parts, ahead)))

    def _measured(self, s, P, rows, y, valid, R, teach):
        """One axis after the other: R is diagonal. -> s, P, gains (4, n_s), innovations (4,), variances (4,)."""
        import jax.numpy as jnp

        gains, innovations, variances = [], [], []
        for a in range(4):
            h = rows[a]
            nu = y[a] - h @ s
            Ph = P @ h
            S = h @ Ph + R[a]
            S = jnp.maximum(S, nu * nu / OUTLIER**2)
            nu = jnp.where(valid[a], nu, 0.0)
            # A smaller gain where little may be learned: the covariance below holds for any gain.
            K = Ph * jnp.where(valid[a], 1.0 / S, 0.0) * teach
            s = s + K * nu
            P = P - K[:, None] * Ph[None, :] - Ph[:, None] * K[None, :]
            P = P + jnp.where(valid[a], S, 0.0) * K[:, None] * K[None, :]
            gains.append(K)
            innovations.append(nu)
            variances.append(S)
        return s, 0.5 * (P + P.T), jnp.stack(gains), jnp.stack(innovations), jnp.stack(variances)

    def _evidence(self, s, bank, variances, active, reach) -> Evidence:
        """How strongly the data speak for each hypothesis, over all onset times."""
        import jax.numpy as jnp

        hyp, theta = self.hyp, s[self.n_x :]
        # A known loss may be taken back; what the filter has absorbed of that already is part of the jump.
        lo, hi = jnp.where(active, -1.0, 0.0), jnp.maximum(1.0 - theta, 0.0)
        width = jnp.clip(DISTURBANCE_SCALE * jnp.sqrt(noise.spread(variances)), *DISTURBANCE_RANGE)
        live = bank.age >= 0
        # What ends a known loss: of a unit jump the filter has by now, or will have, so much of theta left.
        own = jnp.diagonal(bank.M[:, self.n_x :, : self.n], axis1=1, axis2=2)
        to_come = jnp.where(jnp.asarray(self.jumps.slow), self.jumps.decay ** (jnp.maximum(bank.age, 0) + 1.0), 0.0)
        gone = jnp.where(active, -theta / jnp.maximum(own + to_come[:, None], 0.3), 0.0)
        logbf, nu = hypotheses.log_bayes_factors(hyp, bank.C, bank.z, lo, hi, width, gone, reach)
        # The model is right to a few percent: overwhelming evidence must not hang on its last decimals.
        far = hypotheses.disturbances(hyp, bank.C, bank.z, hypotheses.FAR * width)
        share = TRUST / (TRUST + jnp.maximum(logbf.max(), 0.0))
        logbf, far = (jnp.where(live[:, None], share * b, -50.0) for b in (logbf, far))
        slot_weight = jnp.log(jnp.asarray(self.jumps.stride, float))
        per_slot = logbf + slot_weight[:, None] + jnp.log(jnp.asarray(hyp.weight))[None, :]
        far = far + slot_weight[:, None] + np.log(hypotheses.FAR_SHARE * hypotheses.WEIGHT["disturbance"])
        # With a rotor gone the vehicle flies at its limits: only that rotor itself is still judged.
        dead = active & (theta > DEAD)
        members = jnp.asarray(self.membership)
        mine = members @ (~active).astype(float) < 0.5
        barred = (dead.any() & (members @ (~dead).astype(float) > 0.5)) | (jnp.asarray(self.well) & ~mine)
        fault = jnp.asarray(hyp.fault)
        per_slot = jnp.where(barred[None, :] & fault[None, :], -60.0, per_slot)
        prior = jnp.where(mine, KNOWN_BONUS, jnp.where(active.any(), -SECOND_NATS, 0.0))
        per_slot = per_slot + jnp.where(fault, prior, 0.0)[None, :]
        top = per_slot.max(0)
        evidence = top + jnp.log(jnp.exp(per_slot - top[None]).sum(0))
        f_top = jnp.max(jnp.where(fault, evidence, -jnp.inf))
        share = jnp.where(fault, jnp.exp(evidence - f_top), 0.0)
        o_top = jnp.max(jnp.where(fault, -jnp.inf, evidence))
        other = o_top + jnp.log(jnp.where(fault, 0.0, jnp.exp(evidence - o_top)).sum())
        far = far.max() + jnp.log(jnp.exp(far - far.max()).sum())
        return Evidence(
            evidence,
            share / share.sum(),
            f_top + jnp.log(share.sum()),
            other,
            far,
            logbf,
            per_slot,
            nu,
            gone,
            hypotheses.slop(bank.C, bank.z, lo, hi, reach),
            width,
            live,
        )

    def _jump(self, found: Evidence, bank, h) -> Jump:
        """Hypothesis h at its most probable onset: sizes of its rotors, or of the steps of a disturbance."""
        import jax.numpy as jnp

        n, q = self.n, self.n + 4
        it = (jnp.arange(len(self.hyp.names)) == h).astype(float)
        slot = jnp.argmax(jnp.where(found.live, found.per_slot @ it, -jnp.inf))
        slot = (jnp.arange(self.jumps.stride.size) == slot).astype(float)
        _, C, z = onsets.pick(bank, slot)
        rotors = jnp.einsum("h,hkr->kr", it, jnp.asarray(self.pick))
        steps, well = it @ jnp.asarray(self.steps), it @ jnp.asarray(self.well, float)
        n_fault = found.nu.shape[1]
        each = jnp.einsum("w,h,whk->k", slot, it[:n_fault], found.nu)[:, None] * rotors
        slop = slot @ found.slop
        free = jnp.where(steps.sum() > 0.5, steps * (hypotheses.FAR * found.width) ** 2, slop) + 1e-12
        width = jnp.where(well > 0.5, hypotheses.recovery_sd(slot @ found.gone @ rotors[0]), hypotheses.LOSS_WIDTH)
        D = jnp.concatenate([jnp.concatenate([rotors, jnp.zeros((2, 4))], axis=1), jnp.eye(q)[n:]])
        own = jnp.concatenate([1.0 / width[None] ** 2, 1.0 / width[None] ** 2, 1.0 / free])
        half = _half_inverse(D @ C @ D.T + jnp.diag(own))
        # What geometry is wrong by counts in how well a loss is known; it does not become a disturbance.
        kept = jnp.concatenate([jnp.ones(n), steps])
        cov = D.T @ (half.T @ half) @ D * kept[:, None] * kept[None, :]
        half = _half_inverse(C[n:, n:] + jnp.diag(1.0 / free))
        size = jnp.concatenate([each.sum(axis=0), steps * (half.T @ (half @ z[n:]))])
        return Jump(slot, size, cov, each)

    def _born(
        self, explained: posterior.Branches, told, bank, found: Evidence, first, alarm, absorbed
    ) -> posterior.Branches:
        """What may have happened becomes branches of the one that leads: the likeliest disturbance and the likeliest faults. Hypothesis
        `first` leads where it is announced, else the disturbance."""
        import jax
        import jax.numpy as jnp

        fault, other = jnp.asarray(self.hyp.fault), jnp.logaddexp(found.other, found.far)

        def born(explained):
            left, chosen = jnp.where(fault, found.log_odds, -jnp.inf), []
            none = jnp.argmax(jnp.where(fault, -jnp.inf, found.log_odds))
            h = first
            for _ in range(posterior.PLACES - 1):
                chosen.append((h, found.log_odds[h]))
                left = jnp.where(jnp.arange(left.size) == h, -jnp.inf, left)
                h = jnp.argmax(left)
            chosen.append((none, other))
            weight = jnp.stack([w for _, w in chosen])
            which = jnp.stack([h for h, _ in chosen])
            # The first place leads; nobody else may be ahead from the start.
            turn = jnp.where(alarm, jnp.arange(posterior.PLACES), posterior.PLACES - 1 - jnp.arange(posterior.PLACES))
            weight, which = weight[turn], which[turn]
            weight = jnp.minimum(weight - weight[0], posterior.AHEAD)
            # The odds against disturbances are what an announcement is made by; they are not asked again.
            weight = jnp.where(alarm & (which == none), posterior.NEVER, weight)
            # Where no rotor is weak, a fault has to be announced.
            doubt = alarm | explained.active[0].any()
            weight = jnp.where(doubt | (which == none), weight, posterior.NEVER)
            child = jax.vmap(lambda h: self._child(explained, told, bank, found, h))(which)
            return child._replace(
                weight=jnp.where(weight > posterior.OUT, weight, posterior.NEVER),
                age=jnp.where(doubt, 0.0, explained.age),
            )

        return jax.lax.cond(alarm | absorbed, born, lambda same: same, explained)

    def _child(self, explained: posterior.Branches, told, bank, found: Evidence, h) -> posterior.Branches:
        """The leader with the jump of hypothesis h: exactly what an augmented filter with this jump would hold."""
        import jax.numpy as jnp

        n_x = self.n_x
        jump = self._jump(found, told, h)
        M, _, _ = onsets.pick(told, jump.slot)
        s, P = explained.s[0] + M @ jump.size, explained.P[0] + M @ jump.cov @ M.T
        hit = (jnp.einsum("h,hkr->r", (jnp.arange(len(self.hyp.names)) == h).astype(float), self.pick)) > 0.5
        well = jnp.asarray(self.well)[h]
        theta, sd = s[n_x:], jnp.sqrt(jnp.maximum(jnp.diagonal(P)[n_x:], 0.0))
        off = hit & (well | ((jump.each.sum(axis=0) < 0) & (theta < jnp.maximum(OVER, 2.0 * sd))))
        for i in range(self.n):
            j = n_x + i
            column = P[:, j]
            variance = jnp.maximum(column[j], 1e-12)
            s = jnp.where(off[i], s - column * (s[j] / variance), s)
            P = jnp.where(off[i], P - column[:, None] * column[None, :] / variance, P)
        learning = jnp.where(hit & ~off, LEARN_LOSS_S, jnp.where(off, 0.0, explained.learning[0]))
        return posterior.Branches(
            s,
            0.5 * (P + P.T),
            explained.weight[0],
            (explained.active[0] | hit) & ~off,
            learning,
            jnp.where(off, 0.0, explained.theta_var[0]),
            jnp.where(hit, s[n_x:], explained.theta_mean[0]),
            jnp.where(hit.any(), jump.slot @ jnp.where(found.live, bank.age + 1.0, 0.0), explained.onset[0]),
            jnp.zeros(()),
        )

    def _detectable(self, bank, live):
        """(n,) standard deviation with which a loss of each rotor would be measured now."""
        import jax.numpy as jnp

        own = jnp.where(live[:, None], jnp.diagonal(bank.C, axis1=1, axis2=2)[:, : self.n], 0.0).max(0)
        return 1.0 / jnp.sqrt(own + 1.0 / hypotheses.LOSS_WIDTH**2)

    def _opposite(self, found: Evidence, bank, stand: Standing, active, free) -> tuple[Opposite, Array]:
        """Could a disturbance be two opposite rotors? Their torques cancel in roll and pitch, so that the shift left in thrust
        (and yaw) is what battery, payload or a gust make, too - but those do not come within a tick. Returns with it for how
        many seconds that has been so."""
        import jax.numpy as jnp

        n, pairs = self.n, slice(self.n, self.n + len(self.hyp.pairs))
        slow = jnp.asarray(self.jumps.slow)
        real = (found.nu[:, pairs] > OPPOSITE_LOSS).all(axis=2)
        usable = ~slow[:, None] & self._torque_free()[None, :] & real & found.live[:, None]
        fit = jnp.where(usable, found.log_bf[:, pairs], -50.0)
        free_fit = jnp.where(found.live[:, None], found.log_bf[:, ~self.hyp.fault], -50.0)
        best, gradual = fit.max(), free_fit[self.jumps.slow].max()
        sudden = free_fit[~self.jumps.slow].max()
        # A quadrotor's pairs can be told apart by their yaw: there the fault hypotheses say all there is to say.
        now = free & ~active.any() & (n >= 6) & (best > self.log_threshold)
        now &= (best > sudden - OPPOSITE_NATS) & (best > gradual + SHARP_NATS)
        since = jnp.where(now, stand.opposite_s + self.dt, 0.0)
        news = (since >= OPPOSITE_S) & (stand.opposite_s < OPPOSITE_S)
        pair = jnp.argmax(fit.max(axis=0))
        slot = jnp.argmax(fit[:, pair])
        which = jnp.where(news, n + pair, -1).astype(jnp.int32)
        return Opposite(which, bank.age[slot].astype(float) + 1.0, found.nu[slot, n + pair]), since

    def _torque_free(self):
        """(n_pairs,) bool: equal losses of these two rotors make no torque in roll and pitch."""
        import jax.numpy as jnp

        (i, j), B = self.hyp.pairs.T, jnp.asarray(self.system.B)
        return jnp.abs(B[:2, i] + B[:2, j]).max(axis=0) < 0.05


def _half_inverse(A):
    """L^-1 of A (k, k) = L L'."""
    import jax.numpy as jnp

    k = A.shape[0]
    return hypotheses.forward(jnp.broadcast_to(hypotheses.cholesky(A[None]), (k, k, k)), jnp.eye(k)).T
