"""The default diagnoser: one augmented Kalman filter and a bank of jump detectors on its innovations.

The filter runs on the wrench balance with the losses theta of already announced rotors in its state. For every onset time in
a bank (dense for recent ones, sparse for old ones) the exact effect of a unit jump on the innovations is carried along, so that at
each tick the likelihood ratio of any jump - one rotor, two rotors, common mode, a torque bias, any disturbance - at any of these times is
known, with its most probable size and its covariance (generalised likelihood ratio, Willsky & Jones, IEEE TAC 21(1), 1976):

    phi = H M,   C += phi' phi / S,   z += phi' nu / S,   M <- A (M - K phi)

M (n_s, q): the part of a unit jump the filter has not absorbed. Summed over onset times with prior weights this is the
Shiryaev-Roberts statistic, whose mean time to a false alarm is at least its threshold (Pollak, Ann. Statist. 13, 1985):
the threshold follows from the stated false-alarm rate. An alarm is announced at once; the jump is committed to the
filter (state, covariance and cross-covariance, exactly) as soon as one rotor set is certain or after HOLD_S.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch import hypotheses, noise
from rotorwatch.core import Array, Decision, Estimate
from rotorwatch.systems.wrench_balance import B1, B2, B3, DAMPING, GAIN, PER_AXIS
from rotorwatch.ticks import GROUND, JUDGE

SLOTS = 16
BUILD_UP_S = 0.5
THRUST_MEMORY_S = 0.5
# Nominal: the weights of all hypotheses sum to about n, and real noise is not quite what the model says (docs/results.md).
FALSE_ALARM_PERIOD_S = 300 * 3600.0
COMPETITOR_ODDS = 200.0
HOLD_S = 1.5
LEARN_LOSS_S = 6.0  # a committed loss is refined this long; after that only a new jump changes it
THETA_WALK = 0.02**2  # 1/s, while it is refined
KNOWN_BONUS = 2.0  # nats: a rotor that has failed is likely to change again
DISTURBANCE_SCALE, DISTURBANCE_RANGE = 3.0, (0.03, 1.0)
# Share by which the motion model may be wrong for a moment, and how many ticks such an error lasts.
GAIN_ERROR, DAMPING_ERROR = (0.25, 0.25, 0.35, 0.15), 0.3
ERROR_TICKS = 4.0
LAG_ERROR_S = 0.015
FAR, FAR_ERROR, FAR_MEMORY_S = 0.3, 0.5, 5.0
OUTLIER = 6.0
PERSIST_S = 0.15
TRUST = 3000.0  # nats
DEAD = 0.8
ASKED_SHARE, ASKED_SLACK, ASKED_MEMORY_S = 0.25, 0.05, 6.0
MISSING_SLACK = 0.15  # hover thrusts of one rotor
SECOND, SECOND_NATS = 0.1, 6.0
SMALLEST = 0.015  # loss that is worth an event
ABSORB_S, ABSORB_NATS, BASE_NATS = 1.0, 10.0, 6.0
GARROTE = 2.5
LEVEL_MEMORY_S = 10.0
FREEZE_S = 4.0


def threshold(dt: float, false_alarm_period_s: float = FALSE_ALARM_PERIOD_S) -> float:
    """Log of the Shiryaev-Roberts threshold: the mean time to a false alarm, in ticks, is at least its value over the sum
    of the hypotheses' prior weights (about the number of rotors), as far as the noise is what the model says."""
    return float(np.log(false_alarm_period_s / dt))


class Carry(NamedTuple):
    """State s = [x; theta] (n_s,), its covariance, the noise model, the bank, and where an announcement stands."""

    s: Array
    P: Array
    noise: noise.NoiseState
    M: Array
    C: Array
    z: Array
    age: Array
    count: Array
    active: Array
    pending: Array
    above: Array
    level: Array
    learning: Array
    theta_var: Array
    thrust: Array
    thrust_level: Array
    thrust_slow: Array
    frozen: Array
    sure_s: Array
    update: Array
    collective: Array
    y: Array
    missing: Array
    missing_slow: Array


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


class JumpBank:
    """system: a WrenchBalance. dt: tick length in s. The last two inputs in u are mode (GROUND, LEARN, JUDGE) and restart."""

    name = "default"

    def __init__(self, system, dt: float = 0.05, noise_prior=None, false_alarm_period_s: float = FALSE_ALARM_PERIOD_S):
        """noise_prior: (variances (4, 4), weight) learned from healthy flights, or None."""
        self.system, self.dt = system, float(dt)
        self.hyp = hypotheses.make(system.n_theta)
        self.noise_prior = noise_prior
        self.n, self.n_x = system.n_theta, system.n_x
        self.n_s = self.n_x + self.n
        self.q = self.n + 4
        strides = (1, 2, 4) if dt < 0.08 else (1, 2, 3)
        self.stride = np.repeat(strides, SLOTS)
        self.place = np.tile(np.arange(SLOTS), len(strides))
        # Recent slots hold sudden losses; the oldest group one that builds up, as a controller reveals it.
        self.slow = np.repeat((False, False, True), SLOTS)
        self.first_share = float(1.0 - np.exp(-dt / BUILD_UP_S))
        self.log_threshold = threshold(dt, false_alarm_period_s)
        E = np.zeros((self.n_s, self.q))
        E[self.n_x :, : self.n] = np.eye(self.n)
        for a in range(4):
            E[a * PER_AXIS + B3, self.n + a] = 1.0
        self.E = E
        fault = [who for who, f in zip(self.hyp.rotors, self.hyp.fault) if f]
        self.pick = np.array(
            [[[float(k < len(who) and who[k] == i) for i in range(self.n)] for k in range(2)] for who in fault]
        )
        self.membership = np.array([[float(i in who) for i in range(self.n)] for who in self.hyp.rotors])
        self.blocks = np.array([[float(a in block) for a in range(4)] for block in hypotheses.DISTURBANCES])
        self.bias_rows = np.array([a * PER_AXIS + b for a in range(4) for b in (B1, B2, B3)])

    def init(self) -> Carry:
        """Before the first tick: nothing announced, the system's prior."""
        W = self.stride.size
        P = np.zeros((self.n_s, self.n_s))
        P[: self.n_x, : self.n_x] = self.system.P0
        return Carry(
            np.concatenate([np.asarray(self.system.x0), np.zeros(self.n)]),
            P,
            noise.init(self.dt, *(self.noise_prior or ())),
            np.zeros((W, self.n_s, self.q)),
            np.zeros((W, self.q, self.q)),
            np.zeros((W, self.q)),
            np.full(W, -1, np.int32),
            np.int32(0),
            np.zeros(self.n, bool),
            np.int32(-1),
            np.int32(0),
            np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05]) ** 2,
            np.zeros(self.n),
            np.zeros(self.n),
            np.zeros(self.n),
            np.full(self.n, 0.05**2),
            np.zeros(self.n),
            np.float64(0.0),
            np.float64(0.0),
            np.bool_(False),
            np.float64(1.0),
            np.zeros(4),
            np.float64(0.0),
            np.float64(0.0),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """One tick; see Output."""
        import jax.numpy as jnp

        n, n_x, hyp, dt = self.n, self.n_x, self.hyp, self.dt
        mode, restart, u = u[-2], u[-1] > 0.5, u[:-2]
        y = jnp.where(valid, y, 0.0)
        judge = mode > JUDGE - 0.5
        flying = mode > GROUND + 0.5

        # A new hop starts with new biases; what the vehicle is like, and how noisy, stays known.
        keep = jnp.ones(self.n_s).at[self.bias_rows].set(0.0).at[n_x:].set(0.0)
        fresh_s = carry.s * keep
        rows = np.ix_(self.bias_rows, self.bias_rows)
        P0 = jnp.zeros((self.n_s, self.n_s)).at[rows].set(jnp.asarray(self.system.P0)[rows])
        fresh_P = carry.P * keep[:, None] * keep[None, :] + P0
        s, P = jnp.where(restart, fresh_s, carry.s), jnp.where(restart, fresh_P, carry.P)
        active = carry.active & ~restart
        pending = jnp.where(restart, -1, carry.pending)

        # a loss that has been refined long enough is taken as known; its variance is remembered
        finished = (carry.learning > 0) & (carry.learning <= dt)
        theta_var = jnp.where(finished, jnp.diagonal(P)[n_x:], jnp.where(restart, 0.0, carry.theta_var))
        known = jnp.concatenate([jnp.ones(n_x), jnp.where(finished, 0.0, 1.0)])
        P = P * known[:, None] * known[None, :]
        learning = jnp.where(restart, 0.0, jnp.maximum(carry.learning - dt, 0.0))

        # predict
        A = np.concatenate([self.system.decay(dt), np.ones(n)])
        s = A * s
        biases = s
        q_x = jnp.where(flying, noise.process_variance(carry.noise.variances, dt), 0.0)
        P = A[:, None] * P * A[None, :] + jnp.diag(jnp.concatenate([q_x, (learning > 0) * THETA_WALK * dt]))

        # the bank: one slot of each group is reused for a jump at this tick
        open_ = judge & (pending < 0)
        turn = (carry.count % self.stride == 0) & ((carry.count // self.stride) % SLOTS == self.place)
        new = turn & open_
        since = jnp.where(new, 0, jnp.maximum(carry.age, -1) + 1)
        share = jnp.where(
            jnp.asarray(self.slow), self.first_share * jnp.exp(-since * dt / BUILD_UP_S), (since == 0) * 1.0
        )
        share = jnp.where(new | (carry.age >= 0), share, 0.0)
        M = jnp.where(new[:, None, None], 0.0, A[:, None] * carry.M) + share[:, None, None] * self.E[None]
        C = jnp.where(new[:, None, None], 0.0, carry.C)
        z = jnp.where(new[:, None], 0.0, carry.z)
        age = jnp.where(new, 0, jnp.where(carry.age >= 0, carry.age + 1, -1))
        age = jnp.where(judge & ~restart, age, -1)

        # Below the calm level, angular motion is gyro noise that the rate controller answers: it would teach the filter the
        # controller's gains instead of the vehicle's. Only motion that stands out teaches (nonnegative garrote).
        motion6 = u[jnp.array([n, n + 1, n + 2, n + 4, n + 5, n + 6])]
        shrink = jnp.maximum(0.0, 1.0 - GARROTE**2 * carry.level / jnp.maximum(motion6**2, 1e-12))
        fade = jnp.where(flying & valid[0], dt / LEVEL_MEMORY_S, 0.0)
        level = carry.level + fade * (jnp.minimum(motion6**2, 6.0 * carry.level) - carry.level)
        one = jnp.ones(1)
        teach = jnp.ones((4, PER_AXIS)).at[:, GAIN].set(jnp.concatenate([shrink[:3], one]))
        teach = jnp.concatenate([teach.at[:, DAMPING].set(jnp.concatenate([shrink[3:], one])).reshape(-1), jnp.ones(n)])

        # What a loss takes is in proportion to the rotor's thrust, but not to its jitter: a disturbance that the controller
        # answers through rotor i would correlate with that rotor's own command and look like its loss.
        # The collective part is common to all rotors and may pass; the torque part is smoothed unless it stands out.
        collective = u[:n].mean()
        part = u[:n] - collective
        before = jnp.where(restart, part, carry.thrust)
        away = part - before
        tracked = jnp.maximum(0.0, 1.0 - GARROTE**2 * carry.thrust_level / jnp.maximum(away**2, 1e-12)) * away
        thrust = before + away * (dt / THRUST_MEMORY_S)
        slow = jnp.where(restart, part, carry.thrust_slow)
        slow = slow + (part - slow) * (dt / ASKED_MEMORY_S)
        fade_t = jnp.where(flying & valid[0] & ~restart, dt / LEVEL_MEMORY_S, 0.0)
        thrust_level = carry.thrust_level + fade_t * (
            jnp.minimum(away**2, 6.0 * carry.thrust_level) - carry.thrust_level
        )
        smooth = jnp.maximum(collective + before + tracked, 0.0)
        u = jnp.concatenate([smooth, u[n:]])

        # update, one axis after the other: R is diagonal
        x = s[:n_x].reshape(4, PER_AXIS)
        # Punch-outs, drops and knocks: far from hover the thrust curve and the lag are no longer known well.
        level_T = jnp.where(restart, collective, carry.collective)
        far = jnp.maximum(jnp.abs(collective - level_T) - FAR, 0.0) + jnp.maximum(
            jnp.abs(u[n + 3] / n - 1.0) - FAR, 0.0
        )
        level_T = level_T + (collective - level_T) * (dt / FAR_MEMORY_S)
        motion = jnp.concatenate([u[n : n + 3], u[n + 3 : n + 4] - n])
        rates = jnp.concatenate([u[n + 4 : n + 7], jnp.zeros(1)])
        model_error = ERROR_TICKS * (
            (jnp.asarray(GAIN_ERROR) * x[:, GAIN] * motion) ** 2
            + (DAMPING_ERROR * x[:, DAMPING] * rates) ** 2
            + (FAR_ERROR * n * far) ** 2
            + (LAG_ERROR_S / dt * jnp.maximum(jnp.abs(y - carry.y) - 4.0 * jnp.sqrt(carry.noise.variances[0]), 0.0))
            ** 2
        )
        R_white = carry.noise.variances[0]
        R = R_white + model_error
        Ct, Ht = self.system.C(u), self.system.H(u)
        full = jnp.concatenate([Ct, Ht], axis=1)
        e_raw = y - full @ s
        innovations, variances = [], []
        for a in range(4):
            h = full[a]
            nu = y[a] - h @ s
            Ph = P @ h
            S = h @ Ph + R[a]
            S = jnp.maximum(S, nu * nu / OUTLIER**2)
            ok = valid[a] & flying
            w = jnp.where(ok, 1.0 / S, 0.0)
            K = Ph * w * teach  # a deliberately smaller gain: the covariance update below holds for any gain
            phi = jnp.einsum("s,wsq->wq", h, M)
            C = C + (w * phi[:, :, None]) * phi[:, None, :]
            z = z + (w * nu) * phi
            M = M - K[None, :, None] * phi[:, None, :]
            s = s + K * jnp.where(ok, nu, 0.0)
            P = (
                P
                - K[:, None] * Ph[None, :]
                - Ph[:, None] * K[None, :]
                + jnp.where(ok, S, 0.0) * K[:, None] * K[None, :]
            )
            innovations.append(jnp.where(ok, nu, 0.0))
            variances.append(S)
        P = 0.5 * (P + P.T)

        # hypotheses
        theta = s[n_x:]
        # A known loss may be taken back; what the filter has absorbed of that already is part of the jump.
        lo, hi = jnp.where(active, -1.0, 0.0), jnp.maximum(1.0 - theta, 0.0)
        width = jnp.clip(DISTURBANCE_SCALE * jnp.sqrt(noise.spread(carry.noise.variances)), *DISTURBANCE_RANGE)
        logbf, nu_h = hypotheses.log_bayes_factors(hyp, C, z, lo, hi, width)
        # The model is right to a few percent: overwhelming evidence must not hang on its last decimals.
        logbf = logbf * (TRUST / (TRUST + jnp.maximum(logbf.max(), 0.0)))
        live = age >= 0
        logbf = jnp.where(live[:, None], logbf, -50.0)
        slot_weight = jnp.log(jnp.asarray(self.stride, float))
        per_slot = logbf + slot_weight[:, None] + jnp.log(jnp.asarray(hyp.weight))[None, :]
        # With a rotor gone the vehicle flies at its limits: only that rotor itself is still judged.
        # While the change of a known loss is being measured, no other rotor can slip in.
        gone = active & (theta > DEAD)
        outside = jnp.asarray(self.membership) @ (~gone).astype(float) > 0.5
        mine = jnp.asarray(self.membership) @ (~active).astype(float) < 0.5
        barred = (gone.any() & outside) | ((pending >= 0) & carry.update & ~mine)
        per_slot = jnp.where(barred[None, :] & jnp.asarray(hyp.fault)[None, :], -60.0, per_slot)
        prior = jnp.where(mine, KNOWN_BONUS, jnp.where(active.any(), -SECOND_NATS, 0.0))
        per_slot = per_slot + jnp.where(jnp.asarray(hyp.fault), prior, 0.0)[None, :]
        top = per_slot.max(0)
        evidence = top + jnp.log(jnp.exp(per_slot - top[None]).sum(0))
        fault = jnp.asarray(hyp.fault)
        f_top = jnp.max(jnp.where(fault, evidence, -jnp.inf))
        prob = jnp.where(fault, jnp.exp(evidence - f_top), 0.0)
        log_fault = f_top + jnp.log(prob.sum())
        prob = prob / prob.sum()
        o_top = jnp.max(jnp.where(fault, -jnp.inf, evidence))
        log_other = o_top + jnp.log(jnp.where(fault, 0.0, jnp.exp(evidence - o_top)).sum())
        statistic = jnp.minimum(log_fault - self.log_threshold, log_fault - log_other - jnp.log(COMPETITOR_ODDS))
        best = jnp.argmax(prob).astype(jnp.int32)
        slot = jnp.argmax(jnp.where(live, per_slot[:, best], -jnp.inf))
        onehot = (jnp.arange(len(hyp.names)) == best).astype(float)[: nu_h.shape[1]]
        where_slot = (jnp.arange(self.stride.size) == slot).astype(float)
        pair_nu = jnp.einsum("w,h,whk->k", where_slot, onehot, nu_h)
        big = jnp.abs(pair_nu[0]) > SMALLEST
        # A controller asks more of a rotor that gives less: a candidate whose command has fallen instead is none.
        rise = smooth - collective - carry.thrust_slow
        jump_of = jnp.einsum("h,hkr->kr", onehot, jnp.asarray(self.pick)) * pair_nu[:, None]
        asked = jnp.minimum(jump_of, 0.35) * smooth
        big = big & jnp.where(jump_of > 0, rise > ASKED_SHARE * asked - ASKED_SLACK, True).all()
        # ... and what the rotors no longer give must be missing from the thrust.
        missing = jnp.where(valid[3], y[3] - x[3, GAIN] * u[n + 3], carry.missing_slow)
        missing_fast = jnp.where(restart, missing, carry.missing + (missing - carry.missing) * (dt / THRUST_MEMORY_S))
        missing_slow = jnp.where(
            restart, missing, carry.missing_slow + (missing - carry.missing_slow) * (dt / ASKED_MEMORY_S)
        )
        lost = (jnp.clip(jump_of, 0.0, 1.0) * smooth).sum()
        big = big & (
            ~valid[3] | (lost <= 0.0) | (missing_fast - carry.missing_slow > ASKED_SHARE * lost - MISSING_SLACK)
        )
        # A second rotor failing is rare: small second losses are more likely errors in the size of the first.
        another = active.any() & (jump_of * (~active)[None, :] > 0).any()
        new_size = jnp.where(active[None, :], 1.0, jump_of)
        big = big & (~another | jnp.where(jump_of > 0, new_size > SECOND, True).all())
        above = jnp.where(open_ & (statistic > 0.0) & big, carry.above + 1, 0)
        alarm = above >= max(2, round(PERSIST_S / dt))
        update = jnp.where(alarm, (mine.astype(float) * (jnp.arange(len(hyp.names)) == best)).sum() > 0.5, carry.update)
        pending = jnp.where(alarm, 0, jnp.where(pending >= 0, pending + 1, pending))
        waited = pending * dt
        pending = jnp.where(judge, pending, -1)
        commit = (pending >= 0) & (waited >= HOLD_S)

        # the most probable jump, as a full direction vector with its covariance
        first = jnp.asarray(np.concatenate([hyp.singles, hyp.pairs[:, 0], hyp.mixed[:, 0]]))
        second = jnp.asarray(np.concatenate([hyp.singles, hyp.pairs[:, 1], hyp.mixed[:, 1]]))
        D1 = (jnp.arange(self.q) == (onehot @ first)).astype(float)
        D2 = (jnp.arange(self.q) == (onehot @ second)).astype(float)
        two = (D1 * D2).sum() < 0.5
        C_best = jnp.einsum("w,wab->ab", where_slot, C)
        M_best = jnp.einsum("w,wsq->sq", where_slot, M)
        c11 = D1 @ C_best @ D1 + 1e-6
        c22 = jnp.where(two, D2 @ C_best @ D2 + 1e-6, 1.0)
        c12 = jnp.where(two, D1 @ C_best @ D2, 0.0)
        det = jnp.maximum(c11 * c22 - c12 * c12, 1e-12)
        v11, v22, v12 = c22 / det, c11 / det, -c12 / det
        jump = pair_nu[0] * D1 + jnp.where(two, pair_nu[1], 0.0) * D2
        cov = v11 * D1[:, None] * D1[None] + jnp.where(
            two, v22 * D2[:, None] * D2[None] + v12 * (D1[:, None] * D2[None] + D2[:, None] * D1[None]), 0.0
        )
        waiting = (pending >= 0).astype(float)
        shown = jnp.clip(theta + waiting * jump[:n], 0.0, 1.0)
        shown_var = theta_var + jnp.diagonal(P)[n_x:] + waiting * jnp.diagonal(cov)[:n]

        # commit: exactly what an augmented filter with this jump would hold
        s_c = s + M_best @ jump
        P_c = P + M_best @ cov @ M_best.T
        s = jnp.where(commit, s_c, s)
        P = jnp.where(commit, 0.5 * (P_c + P_c.T), P)
        hit = ((D1 + jnp.where(two, D2, 0.0))[:n] > 0.5) & commit
        active_new = active | hit
        # A disturbance that has long been certain becomes part of the biases; the bank starts afresh.
        certain = open_ & (pending < 0) & (log_other > log_fault + 3.0) & (log_other > ABSORB_NATS + BASE_NATS)
        sure_s = jnp.where(certain, carry.sure_s + dt, 0.0)
        absorb = sure_s >= ABSORB_S
        other = jnp.argmax(jnp.where(fault, -jnp.inf, evidence))
        d_slot = (jnp.arange(self.stride.size) == jnp.argmax(jnp.where(live, per_slot[:, other], -jnp.inf))).astype(
            float
        )
        mask = jnp.asarray(self.blocks)[jnp.maximum(other - (len(hyp.names) - len(self.blocks)), 0)]
        C4 = jnp.einsum("w,wab->ab", d_slot, C[:, n:, n:]) * mask[:, None] * mask[None, :] + jnp.diag(1.0 / width**2)
        L4 = hypotheses.cholesky(C4)
        half = hypotheses.forward(jnp.broadcast_to(L4, (4, 4, 4)), jnp.diag(mask)).T
        cov4 = half.T @ half
        nu4 = cov4 @ (jnp.einsum("w,wa->a", d_slot, z[:, n:]) * mask)
        M4 = jnp.einsum("w,wsq->sq", d_slot, M[:, :, n:])
        s = jnp.where(absorb, s + M4 @ nu4, s)
        P = jnp.where(absorb, P + M4 @ cov4 @ M4.T, P)
        age = jnp.where(absorb, -1, age)
        sure_s = jnp.where(absorb, 0.0, sure_s)

        # a loss that a new jump has taken back is over
        th, var = s[n_x:], jnp.diagonal(P)[n_x:]
        over = hit & (th < jnp.maximum(0.02, 2.0 * jnp.sqrt(var))) & (jump[:n] < 0)
        too_small = hit & ~over & (th < jnp.where(active, 0.005, 0.6 * SMALLEST))
        off = over | too_small
        for i in range(n):
            j = n_x + i
            col = P[:, j]
            pjj = jnp.maximum(col[j], 1e-12)
            s = jnp.where(off[i], s - col * (s[j] / pjj), s)
            P = jnp.where(off[i], P - col[:, None] * col[None, :] / pjj, P)
        active_new = active_new & ~off
        learning = jnp.where(hit & ~off, LEARN_LOSS_S, jnp.where(off, 0.0, learning))
        theta_var = jnp.where(off, 0.0, theta_var)
        age = jnp.where(commit, -1, age)
        pending = jnp.where(commit, -1, pending)

        # learn the noise from what the calm parts leave over, never from a growing suspicion
        gains = jnp.zeros(PER_AXIS).at[jnp.array([B1, B2, B3])].set(1.0)
        e = e_raw + (Ct * jnp.tile(gains, 4)[None, :]) @ biases[:n_x]
        trust = R_white / (R_white + model_error)
        suspicious = log_fault > 0.5 * self.log_threshold
        frozen = jnp.where(suspicious, carry.frozen + dt, jnp.maximum(carry.frozen - dt, 0.0))
        calm = (~suspicious | (frozen > FREEZE_S)) & (pending < 0) & flying
        noise_state = noise.step(carry.noise, e, valid & calm, trust, dt)

        own = jnp.where(live[:, None], jnp.diagonal(C, axis1=1, axis2=2)[:, :n], 0.0).max(0)
        detectable = 1.0 / jnp.sqrt(own + 1.0 / hypotheses.LOSS_WIDTH**2)
        out_cov = P[n_x:, n_x:]
        estimate = Estimate(
            s[:n_x],
            P[:n_x, :n_x],
            shown,
            out_cov,
            jnp.stack(innovations),
            jnp.diag(jnp.stack(variances)),
            jnp.where(~flying, 1, jnp.where(valid.any(), 0, 2)).astype(jnp.int32),
        )
        onset_age = where_slot @ jnp.where(live, carry.age + 1.0, 0.0)
        decision = Decision(evidence, statistic, alarm, onset_age, best)
        out = Output(
            estimate,
            decision,
            prob,
            shown,
            jnp.sqrt(jnp.maximum(shown_var, 0.0)),
            alarm,
            commit,
            active_new,
            detectable,
        )
        new_carry = Carry(
            s,
            P,
            noise_state,
            M,
            C,
            z,
            age.astype(jnp.int32),
            carry.count + 1,
            active_new,
            pending.astype(jnp.int32),
            above.astype(jnp.int32),
            level,
            learning,
            theta_var,
            thrust,
            thrust_level,
            slow,
            jnp.minimum(frozen, 2.0 * FREEZE_S),
            sure_s,
            update,
            level_T,
            jnp.where(valid, y, carry.y),
            missing_fast,
            missing_slow,
        )
        return new_carry, out
