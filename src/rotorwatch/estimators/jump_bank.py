"""The default diagnoser: one augmented Kalman filter and a bank of jump detectors on its innovations.

The filter runs on the wrench balance with the losses theta of already announced rotors in its state. For every onset time in
a bank (evidence/jumps.py) the exact effect of a unit jump on the innovations is carried along, so that at each tick the likelihood ratio
of any jump - one rotor, two rotors, common mode, a torque bias, any disturbance (evidence/hypotheses.py) - at any of these times is
known, with its most probable size and its covariance. Summed over onset times with prior weights this is the
Shiryaev-Roberts statistic, whose mean time to a false alarm is at least its threshold (Pollak, Ann. Statist. 13, 1985):
the threshold follows from the stated false-alarm rate. An alarm is announced at once; the jump is committed to the
filter (state, covariance and cross-covariance, exactly) after HOLD_S.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array, Decision, Estimate
from rotorwatch.evidence import caution, hypotheses, jumps, noise, plausibility
from rotorwatch.motion.ticks import AGAIN, GROUND, JUDGE
from rotorwatch.systems.wrench_balance import B1, B2, B3, GAIN, PER_AXIS

FALSE_ALARM_PERIOD_S = 10 * 3600.0  # promised: no more than one in so long
# Of the statistic's own false alarms - as rare, on surrogates of real noise, as its threshold says - odds, persistence and plausibility
# let pass at most this share: none of 6 there, and 1 of 81 with a threshold 4 nats lower.
GATES = 0.15
COMPETITOR_ODDS = 10.0  # how much likelier than any disturbance a fault must be
PERSIST_S = 0.15
EDGE = 0.9  # of the bank's reach
HOLD_S = 1.5
LEARN_LOSS_S = 6.0  # a committed loss is refined this long; after that only a new jump changes it,
# unless it grows: has left its mean over MOVING_S by MOVING, and by its own uncertainty.
MOVING, MOVING_S = 0.01, 2.0
THETA_WALK = 0.02**2  # 1/s, while it is refined
KNOWN_BONUS, SECOND_NATS = 2.0, 0.0  # nats: a rotor that has failed is likely to change again, another one is not
DISTURBANCE_SCALE, DISTURBANCE_RANGE = 3.0, (0.03, 1.0)
OUTLIER = 6.0  # standard deviations that an innovation counts at most
TRUST = 3000.0  # nats
DEAD = 0.8
ABSORB_S, ABSORB_NATS, BASE_NATS = 1.0, 10.0, 6.0
FREEZE_S = 4.0
SUSPICIOUS_PERIOD_S = 60.0  # noise is not learned while there is more evidence than chance would bring in a minute
# A disturbance that opposite rotors explain as well, within OPPOSITE_NATS, and that came at once: SHARP_NATS likelier than one that
# builds up; for so long.
OPPOSITE_NATS, SHARP_NATS, OPPOSITE_S, OPPOSITE_LOSS = 5.0, 2.0, 0.5, 0.03
# rad/s of yaw, above which its drag is known too badly for that; and load factor away from 1: who climbs, drops or is tossed about
# changes the air that all rotors meet
TURNING, HEAVING = 0.15, 0.2
OVER, NOTHING = 0.02, 0.6 * plausibility.SMALLEST


def threshold(hyp: hypotheses.Hypotheses, dt: float, period_s: float = GATES * FALSE_ALARM_PERIOD_S) -> float:
    """Log of the Shiryaev-Roberts threshold: the mean time to a false alarm, in ticks, is at least its value over the sum
    of the fault hypotheses' prior weights (about the number of rotors), as far as the noise is what the model says."""
    return float(np.log(period_s / dt * hyp.weight[hyp.fault].sum()))


class Standing(NamedTuple):
    """Where rotors and announcements stand. active (n,): announced and in the filter. pending: ticks since an announcement
    that is not committed, -1 none; above: ticks over the threshold in a row; update: it changes a known loss only. learning (n,):
    seconds a loss is still refined; theta_var (n,): its variance after
    that; theta_mean (n,): over MOVING_S. frozen: seconds of suspicion in which no noise
    was learned; sure_s: seconds for which a disturbance has been certain; opposite_s: for which opposite rotors explain one."""

    active: Array
    pending: Array
    above: Array
    update: Array
    learning: Array
    theta_var: Array
    theta_mean: Array
    frozen: Array
    sure_s: Array
    opposite_s: Array


class Carry(NamedTuple):
    """State s = [x; theta] (n_s,), its covariance P, the noise model, the bank, and the memories of its parts."""

    s: Array
    P: Array
    noise: noise.NoiseState
    bank: jumps.Bank
    caution: caution.Memory
    missing: plausibility.Missing
    standing: Standing


class Evidence(NamedTuple):
    """Of all hypotheses (n_h,): log evidence over all onsets, probability among faults. fault, other: log of the sums; far: that
    of disturbances much larger than this flight's; log_bf (W, n_h): Bayes factors, per_slot (W, n_h): with prior weights; nu
    (W, n_fault, 2): most probable sizes; own (W, n): information on the loss of one rotor alone; width (4,): of
    disturbances; live (W,): slots in use."""

    log_odds: Array
    probability: Array
    fault: Array
    other: Array
    far: Array
    log_bf: Array
    per_slot: Array
    nu: Array
    width: Array
    live: Array


class Candidate(NamedTuple):
    """The most probable fault. best: its index; slot (W,): its onset, one-hot; sizes (2,); jump (q,) with its covariance cov; hit (n,):
    its rotors; each (2, n): the jump rotor by rotor; mine: it touches known rotors only; lone: one rotor only."""

    best: Array
    slot: Array
    sizes: Array
    jump: Array
    cov: Array
    hit: Array
    each: Array
    mine: Array
    lone: Array


class Opposite(NamedTuple):
    """A sudden shift that is a disturbance, or else a pair of opposite rotors that explains it as well. pair: its hypothesis, at the
    tick that says so, else -1; onset: ticks ago; loss (2,) of its rotors."""

    pair: Array
    onset: Array
    loss: Array


class Output(NamedTuple):
    """What one tick leaves behind, beside the Estimate and the Decision."""

    estimate: Estimate
    decision: Decision
    probability: Array
    theta: Array
    theta_sd: Array
    announced: Array
    committed: Array
    active: Array
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
        self.hyp = hypotheses.make(system.n_theta)
        self.noise_prior = noise_prior
        self.n, self.n_x = system.n_theta, system.n_x
        self.n_s = self.n_x + self.n
        self.log_threshold = threshold(self.hyp, dt, GATES * false_alarm_period_s)
        # A jump is a rotor's loss, or a step of an axis' bias. The yaw that follows a loss is long and slow, and what it takes to
        # yaw this vehicle is the least known of its gains: the last direction is an error in that, integrated out.
        E = np.zeros((self.n_s, self.n + 5))
        E[self.n_x :, : self.n] = np.eye(self.n)
        E[np.arange(4) * PER_AXIS + B3, self.n + np.arange(4)] = 1.0
        self.yaw_gain = 2 * PER_AXIS + GAIN
        E[self.yaw_gain, -1] = 1.0
        self.jumps = jumps.Jumps(E, self.dt)
        hyp = self.hyp
        fault = [who for who, f in zip(hyp.rotors, hyp.fault) if f]
        self.pick = np.array(
            [[[float(k < len(who) and who[k] == i) for i in range(self.n)] for k in range(2)] for who in fault]
        )
        self.lone = np.array([float(len(who) == 1) for who in fault])
        self.membership = np.array([[float(i in who) for i in range(self.n)] for who in hyp.rotors])
        self.first = np.concatenate([hyp.singles, hyp.pairs[:, 0]])
        self.second = np.concatenate([hyp.singles, hyp.pairs[:, 1]])
        self.blocks = np.array([[float(a in block) for a in range(4)] for block in hypotheses.DISTURBANCES])
        self.bias_rows = np.array([a * PER_AXIS + b for a in range(4) for b in (B1, B2, B3)])

    def init(self) -> Carry:
        """Before the first tick: nothing announced, the system's prior."""
        P = np.zeros((self.n_s, self.n_s))
        P[: self.n_x, : self.n_x] = self.system.P0
        none = np.zeros(self.n)
        return Carry(
            np.concatenate([np.asarray(self.system.x0), none]),
            P,
            noise.init(self.dt, *(self.noise_prior or ())),
            self.jumps.init(),
            caution.init(self.n),
            plausibility.init(self.n),
            Standing(
                np.zeros(self.n, bool),
                np.int32(-1),
                np.int32(0),
                np.bool_(False),
                none,
                none,
                none,
                *[np.float64(0)] * 3,
            ),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """One tick; see Output."""
        import jax.numpy as jnp

        n, n_x, dt = self.n, self.n_x, self.dt
        mode, restart, hop, u = u[-2], u[-1] > 0.5, (u[-1] > 0.5) & (u[-1] < AGAIN - 0.5), u[:-2]
        y = jnp.where(valid, y, 0.0)
        judge, flying = mode > JUDGE - 0.5, mode > GROUND + 0.5
        s, P, stand = self._restarted(carry, restart, hop)
        s, P, stand = self._predicted(s, P, stand, carry, flying)
        biases = s[:n_x]
        open_ = judge & (stand.pending < 0)
        bank = self.jumps.advance(carry.bank, self._A(), open_, judge & ~restart)
        memory, seen = caution.look(carry.caution, u, y, valid, flying, restart, biases, carry.noise.variances, n, dt)
        white = carry.noise.variances[0]
        error = caution.model_error(carry.caution, seen, biases, y, white, self.system.B, n, dt)
        rows = jnp.concatenate([self.system.C(seen.u), self.system.H(seen.u, biases)], axis=1)
        e = y - rows @ s
        carried = u[n + 3] * biases[3 * PER_AXIS + GAIN]
        missing = plausibility.follow(
            carry.missing, y[3] - carried, u[n + 3] / n, u[:n] / u[n + 9], valid[3], restart, dt
        )
        s, P, bank, innovation, variance = self._updated(
            s, P, bank, rows, y, valid & flying, white + error, seen.teach, caution.calm(memory)
        )
        # What an announced jump does to the innovations is not weather.
        memory = caution.remember(memory, innovation, variance, valid & flying & (stand.pending < 0), dt)

        told = jumps.without_last(bank, jnp.maximum(P[self.yaw_gain, self.yaw_gain], 1e-12))
        found = self._evidence(s, told, carry.noise.variances, stand)
        best = self._candidate(found, told, stand)
        # One rotor's direction may be met by chance, by a disturbance such as this flight has not seen yet.
        other = jnp.where(best.lone, jnp.logaddexp(found.other, found.far), found.other)
        statistic = jnp.minimum(found.fault - self.log_threshold, found.fault - other - jnp.log(COMPETITOR_ODDS))
        rough = noise.spread(carry.noise.variances)
        possible = plausibility.plausible(
            best.sizes[0],
            best.each,
            jnp.sqrt(jnp.maximum(jnp.diagonal(best.cov)[:n], 0.0)),
            seen.u[:n],
            seen.rise,
            missing,
            carry.missing,
            valid[3],
            stand.active,
            s[n_x:],
            rough,
        )
        # The most probable onset at the edge of the bank speaks of a drift that began before it, not of a jump.
        onset = best.slot @ jnp.where(found.live, carry.bank.age + 1.0, 0.0)
        possible &= onset < EDGE * self.jumps.reach
        above = jnp.where(open_ & (statistic > 0.0) & possible, stand.above + 1, 0)
        alarm = above >= max(2, round(PERSIST_S / dt))
        update = jnp.where(alarm, best.mine, stand.update)
        pending = jnp.where(alarm, 0, jnp.where(stand.pending >= 0, stand.pending + 1, -1))
        pending = jnp.where(judge, pending, -1)
        commit = (pending >= 0) & (pending * dt >= HOLD_S)
        waiting = (pending >= 0).astype(float)
        shown = jnp.clip(s[n_x:] + waiting * best.jump[:n], 0.0, 1.0)
        # The filter believes its noise model; where innovations have been larger or longer than that, so is the error.
        doubt = (1.0 / caution.calm(memory)).mean()
        shown_var = stand.theta_var + doubt * jnp.diagonal(P)[n_x:] + waiting * jnp.diagonal(best.cov)[:n]

        detectable = self._detectable(told, found.live)
        s, P = self._committed(s, P, told, best, commit)
        s, P, sure_s, absorbed = self._absorbed(s, P, told, found, stand, open_ & (pending < 0))
        steady = (jnp.abs(seen.u[n + 6]) < TURNING) & (missing.heave < HEAVING)
        opposite, opposite_s = self._opposite(found, told, stand, open_ & (pending < 0) & steady)
        s, P, active, learning, theta_var = self._settled(s, P, stand, best, best.hit & commit)
        bank = jumps.forget(bank, commit | absorbed)
        pending = jnp.where(commit, -1, pending)

        # Learn the noise from what the calm parts leave over, never from a growing suspicion.
        e = e + (rows[:, :n_x] * jnp.asarray(np.isin(np.arange(n_x), self.bias_rows), float)) @ biases
        suspicious = found.fault > threshold(self.hyp, dt, SUSPICIOUS_PERIOD_S)
        frozen = jnp.where(suspicious, stand.frozen + dt, jnp.maximum(stand.frozen - dt, 0.0))
        calm = (~suspicious | (frozen > FREEZE_S)) & (pending < 0) & flying
        noises = noise.step(carry.noise, e, valid & calm, white / (white + error), dt)

        estimate = Estimate(
            s[:n_x],
            P[:n_x, :n_x],
            shown,
            P[n_x:, n_x:],
            innovation,
            jnp.diag(variance),
            jnp.where(~flying, 1, jnp.where(valid.any(), 0, 2)).astype(jnp.int32),
        )
        decision = Decision(found.log_odds, statistic, alarm, onset, best.best)
        out = Output(
            estimate,
            decision,
            found.probability,
            shown,
            jnp.sqrt(jnp.maximum(shown_var, 0.0)),
            alarm,
            commit,
            active,
            detectable,
            possible,
            opposite,
        )
        standing = Standing(
            active,
            pending.astype(jnp.int32),
            above.astype(jnp.int32),
            update,
            learning,
            theta_var,
            stand.theta_mean,
            jnp.minimum(frozen, 2.0 * FREEZE_S),
            sure_s,
            opposite_s,
        )
        return Carry(s, P, noises, bank, memory, missing, standing), out

    def _A(self) -> np.ndarray:
        return np.concatenate([self.system.decay(self.dt), np.ones(self.n)])

    def _restarted(self, carry: Carry, restart, hop):
        """A new hop starts with new biases; what the vehicle is like, and how noisy, stays known. After a contact the biases may be any,
        but a loss that was known stays."""
        import jax.numpy as jnp

        keep = jnp.ones(self.n_s).at[self.bias_rows].set(0.0).at[self.n_x :].set(0.0)
        rows = np.ix_(self.bias_rows, self.bias_rows)
        P0 = jnp.zeros((self.n_s, self.n_s)).at[rows].set(jnp.asarray(self.system.P0)[rows])
        s = jnp.where(hop, carry.s * keep, carry.s)
        P = jnp.where(hop, carry.P * keep[:, None] * keep[None, :], carry.P) + jnp.where(restart, P0, 0.0)
        stand = carry.standing
        return (
            s,
            P,
            stand._replace(
                active=stand.active & ~hop,
                pending=jnp.where(restart, -1, stand.pending),
                learning=jnp.where(hop, 0.0, stand.learning),
                theta_var=jnp.where(hop, 0.0, stand.theta_var),
            ),
        )

    def _predicted(self, s, P, stand: Standing, carry: Carry, flying):
        """One tick ahead. A loss that has been refined long enough is taken as known; its variance is remembered."""
        import jax.numpy as jnp

        theta = s[self.n_x :]
        mean = stand.theta_mean + (theta - stand.theta_mean) * (self.dt / MOVING_S)
        var = (1.0 / caution.calm(carry.caution)).mean() * jnp.diagonal(P)[self.n_x :]
        finished = (stand.learning > 0) & (stand.learning <= self.dt)
        moving = finished & (jnp.abs(theta - mean) > jnp.maximum(MOVING, jnp.sqrt(jnp.maximum(var, 0.0))))
        finished &= ~moving
        theta_var = jnp.where(finished, var, stand.theta_var)
        known = jnp.concatenate([jnp.ones(self.n_x), jnp.where(finished, 0.0, 1.0)])
        P = P * known[:, None] * known[None, :]
        learning = jnp.where(moving, MOVING_S, jnp.maximum(stand.learning - self.dt, 0.0))
        A = self._A()
        q_x = jnp.where(flying, noise.process_variance(carry.noise.variances, self.dt), 0.0)
        q_x = jnp.concatenate([q_x, jnp.zeros(self.n_x - q_x.size)])
        Q = jnp.diag(jnp.concatenate([q_x, (learning > 0) * THETA_WALK * self.dt]))
        return (
            A * s,
            A[:, None] * P * A[None, :] + Q,
            stand._replace(theta_var=theta_var, learning=learning, theta_mean=mean),
        )

    def _updated(self, s, P, bank, rows, y, valid, R, teach, weight):
        """One axis after the other: R is diagonal."""
        import jax.numpy as jnp

        innovations, variances = [], []
        for a in range(4):
            h = rows[a]
            nu = y[a] - h @ s
            Ph = P @ h
            S = h @ Ph + R[a]
            S = jnp.maximum(S, nu * nu / OUTLIER**2)
            w = jnp.where(valid[a], 1.0 / S, 0.0)
            nu = jnp.where(valid[a], nu, 0.0)
            K = Ph * w * teach  # a deliberately smaller gain: the covariance update below holds for any gain
            bank = self.jumps.observe(bank, h, K, w * weight[a], nu)
            s = s + K * nu
            P = P - K[:, None] * Ph[None, :] - Ph[:, None] * K[None, :]
            P = P + jnp.where(valid[a], S, 0.0) * K[:, None] * K[None, :]
            innovations.append(nu)
            variances.append(S)
        return s, 0.5 * (P + P.T), bank, jnp.stack(innovations), jnp.stack(variances)

    def _evidence(self, s, bank, variances, stand: Standing) -> Evidence:
        """How strongly the data speak for each hypothesis, over all onset times."""
        import jax.numpy as jnp

        hyp, theta, active = self.hyp, s[self.n_x :], stand.active
        # A known loss may be taken back; what the filter has absorbed of that already is part of the jump.
        lo, hi = jnp.where(active, -1.0, 0.0), jnp.maximum(1.0 - theta, 0.0)
        width = jnp.clip(DISTURBANCE_SCALE * jnp.sqrt(noise.spread(variances)), *DISTURBANCE_RANGE)
        logbf, nu = hypotheses.log_bayes_factors(hyp, bank.C, bank.z, lo, hi, width)
        # The model is right to a few percent: overwhelming evidence must not hang on its last decimals.
        far = hypotheses.disturbances(hyp, bank.C, bank.z, hypotheses.FAR * width)
        share = TRUST / (TRUST + jnp.maximum(logbf.max(), 0.0))
        live = bank.age >= 0
        logbf, far = (jnp.where(live[:, None], share * b, -50.0) for b in (logbf, far))
        slot_weight = jnp.log(jnp.asarray(self.jumps.stride, float))
        per_slot = logbf + slot_weight[:, None] + jnp.log(jnp.asarray(hyp.weight))[None, :]
        far = far + slot_weight[:, None] + np.log(hypotheses.FAR_SHARE * hypotheses.WEIGHT["disturbance"])
        # With a rotor gone the vehicle flies at its limits: only that rotor itself is still judged.
        # While the change of a known loss is being measured, no other rotor can slip in.
        gone = active & (theta > DEAD)
        outside = jnp.asarray(self.membership) @ (~gone).astype(float) > 0.5
        mine = jnp.asarray(self.membership) @ (~active).astype(float) < 0.5
        barred = (gone.any() & outside) | ((stand.pending >= 0) & stand.update & ~mine)
        # Two more rotors whose torques cancel: that is what is left of a third one's loss when its torque passed for a disturbance.
        i, j = self.hyp.pairs.T
        more = self._torque_free() & active.any() & ~active[i] & ~active[j]
        barred |= jnp.zeros(len(hyp.names), bool).at[self.n + np.arange(len(i))].set(more)
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
            width,
            live,
        )

    def _candidate(self, found: Evidence, bank, stand: Standing) -> Candidate:
        """The most probable fault at its most probable onset, as a full direction vector with its covariance."""
        import jax.numpy as jnp

        n, q = self.n, self.n + 4
        best = jnp.argmax(found.probability).astype(jnp.int32)
        slot = jnp.argmax(jnp.where(found.live, found.per_slot[:, best], -jnp.inf))
        one_slot = (jnp.arange(self.jumps.stride.size) == slot).astype(float)
        one_fault = (jnp.arange(len(self.first)) == best).astype(float)
        sizes = jnp.einsum("w,h,whk->k", one_slot, one_fault, found.nu)
        D1 = (jnp.arange(q) == (one_fault @ jnp.asarray(self.first))).astype(float)
        D2 = (jnp.arange(q) == (one_fault @ jnp.asarray(self.second))).astype(float)
        two = (D1 * D2).sum() < 0.5
        # What the rotors' losses do may differ by SLOP from geometry: steps of the axes that come with them.
        _, C, z = jumps.pick(bank, one_slot)
        each = jnp.einsum("h,hkr->kr", one_fault, jnp.asarray(self.pick)) * sizes[:, None]
        slop = hypotheses.slop(C[None], z[None], found.width)[0]
        D = jnp.concatenate([D1[None], jnp.where(two, D2, 0.0)[None], jnp.eye(q)[n:]])
        width = jnp.concatenate([jnp.full(2, hypotheses.LOSS_WIDTH**2), slop])
        L = hypotheses.cholesky((D @ C @ D.T + jnp.diag(1.0 / width))[None])
        half = hypotheses.forward(jnp.broadcast_to(L, (6, 6, 6)), jnp.eye(6)).T
        cov = D.T @ (half.T @ half) @ D
        jump = sizes[0] * D1 + jnp.where(two, sizes[1], 0.0) * D2
        step = hypotheses.cholesky((C[n:, n:] + jnp.diag(1.0 / slop))[None])
        half = hypotheses.forward(jnp.broadcast_to(step, (4, 4, 4)), jnp.eye(4)).T
        jump = jump + jnp.concatenate([jnp.zeros(n), half.T @ (half @ (z - C @ jump)[n:])])
        mine = jnp.asarray(self.membership) @ (~stand.active).astype(float) < 0.5
        return Candidate(
            best,
            one_slot,
            sizes,
            jump,
            cov,
            (D1 + jnp.where(two, D2, 0.0))[:n] > 0.5,
            each,
            (mine * (jnp.arange(len(self.hyp.names)) == best)).sum() > 0.5,
            one_fault @ self.lone > 0.5,
        )

    def _detectable(self, bank, live):
        """(n,) standard deviation with which a loss of each rotor would be measured now."""
        import jax.numpy as jnp

        own = jnp.where(live[:, None], jnp.diagonal(bank.C, axis1=1, axis2=2)[:, : self.n], 0.0).max(0)
        return 1.0 / jnp.sqrt(own + 1.0 / hypotheses.LOSS_WIDTH**2)

    def _committed(self, s, P, bank, best: Candidate, commit):
        """Exactly what an augmented filter with this jump would hold."""
        import jax.numpy as jnp

        M, _, _ = jumps.pick(bank, best.slot)
        P_c = P + M @ best.cov @ M.T
        return jnp.where(commit, s + M @ best.jump, s), jnp.where(commit, 0.5 * (P_c + P_c.T), P)

    def _absorbed(self, s, P, bank, found: Evidence, stand: Standing, free):
        """A disturbance that has long been certain becomes part of the biases; the bank starts afresh."""
        import jax.numpy as jnp

        n, hyp = self.n, self.hyp
        fault = jnp.asarray(hyp.fault)
        certain = free & (found.other > found.fault + 3.0) & (found.other > ABSORB_NATS + BASE_NATS)
        sure_s = jnp.where(certain, stand.sure_s + self.dt, 0.0)
        now = sure_s >= ABSORB_S
        which = jnp.argmax(jnp.where(fault, -jnp.inf, found.log_odds))
        slot = jnp.argmax(jnp.where(found.live, found.per_slot[:, which], -jnp.inf))
        M, C, z = jumps.pick(bank, (jnp.arange(self.jumps.stride.size) == slot).astype(float))
        mask = jnp.asarray(self.blocks)[jnp.maximum(which - (len(hyp.names) - len(self.blocks)), 0)]
        C = C[n:, n:] * mask[:, None] * mask[None, :] + jnp.diag(1.0 / found.width**2)
        half = hypotheses.forward(jnp.broadcast_to(hypotheses.cholesky(C), (4, 4, 4)), jnp.diag(mask)).T
        cov = half.T @ half
        M = M[:, n:]
        s = jnp.where(now, s + M @ (cov @ (z[n:] * mask)), s)
        P = jnp.where(now, P + M @ cov @ M.T, P)
        return s, P, jnp.where(now, 0.0, sure_s), now

    def _opposite(self, found: Evidence, bank, stand: Standing, free) -> tuple[Opposite, Array]:
        """Could a disturbance be two opposite rotors? Their torques cancel in roll and pitch, so that the shift left in thrust
        (and yaw) is what battery, payload or a gust make, too - but those do not come within a tick. Returns with it for how
        many seconds that has been so."""
        import jax.numpy as jnp

        n, pairs = self.n, slice(self.n, self.n + len(self.hyp.pairs))
        slow = jnp.asarray(self.jumps.slow)
        real = (found.nu[:, pairs] > OPPOSITE_LOSS).all(axis=2)
        usable = ~slow[:, None] & self._torque_free()[None, :] & real & found.live[:, None]
        fit = jnp.where(usable, found.log_bf[:, pairs], -50.0)
        free_fit = jnp.where(found.live[:, None], found.log_bf[:, len(self.first) :], -50.0)
        best, gradual = fit.max(), free_fit[self.jumps.slow].max()
        sudden = free_fit[~self.jumps.slow].max()
        # A quadrotor's pairs can be told apart by their yaw: there the fault hypotheses say all there is to say.
        now = free & ~stand.active.any() & (n >= 6) & (best > self.log_threshold)
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

    def _settled(self, s, P, stand: Standing, best: Candidate, hit):
        """After a commitment: what is a loss now, and what a new jump has taken back."""
        import jax.numpy as jnp

        n, n_x = self.n, self.n_x
        theta, var = s[n_x:], jnp.diagonal(P)[n_x:]
        over = hit & (theta < jnp.maximum(OVER, 2.0 * jnp.sqrt(var))) & (best.jump[:n] < 0)
        nothing = hit & ~over & (theta < jnp.where(stand.active, 0.005, NOTHING))
        off = over | nothing
        for i in range(n):
            j = n_x + i
            column = P[:, j]
            variance = jnp.maximum(column[j], 1e-12)
            s = jnp.where(off[i], s - column * (s[j] / variance), s)
            P = jnp.where(off[i], P - column[:, None] * column[None, :] / variance, P)
        learning = jnp.where(hit & ~off, LEARN_LOSS_S, jnp.where(off, 0.0, stand.learning))
        return s, P, (stand.active | hit) & ~off, learning, jnp.where(off, 0.0, stand.theta_var)
