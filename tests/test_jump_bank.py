"""The jump bank is what its paper says: an augmented Kalman filter for every onset time, at the price of one filter.

The reference below is that filter written out: dense NumPy, one more state for the jump. The noise is the one the
estimator had learned by then; everything else is computed anew.
"""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.backend import jax as load_jax
from rotorwatch.estimators import jump_bank
from rotorwatch.estimators.jump_bank import JumpBank
from rotorwatch.evidence import caution, hypotheses, jumps, noise
from rotorwatch.evidence.hypotheses import LOSS_WIDTH
from rotorwatch.motion.ticks import GROUND, JUDGE, LEARN
from rotorwatch.systems.wrench_balance import B3, PER_AXIS, SIDEWAYS, WrenchBalance

DT = 0.05
TICKS, READY, ONSET = 160, 60, 100
KNOWN_NOISE = np.tile(np.array([[0.01**2], [0.004**2], [0.004**2], [0.002**2]]), (1, 4))
CERTAIN_WEIGHT = 1e9


@cache
def make(frame):
    """The estimator on a frame and its compiled run over a table: stacked (outputs, carries)."""
    jax = load_jax()
    system = WrenchBalance(airframes.named(frame).effectiveness())
    bank = JumpBank(system, DT, (KNOWN_NOISE, np.array(CERTAIN_WEIGHT)))

    def tick(carry, row):
        carry, out = bank.step(carry, *row)
        return carry, (out, carry)

    def run(*table):
        return jax.lax.scan(tick, bank.init(), table)[1]

    one = jax.jit(run)
    return SimpleNamespace(
        system=system,
        bank=bank,
        over=lambda *table: jax.tree.map(np.asarray, one(*table)),
    )


FULL = 2.5  # hover thrusts that a rotor gives at most


def hover(frame="ardupilot-quad-x", seed=0, losses=(), ready=READY, bias=(), answered=True, scale=1.0):
    """(u, y, valid): steady hover, noise `scale` times as large as known.

    losses: (rotors 0-based, from tick, loss); bias: (axis, from tick, size). answered: the controller asks more of weak
    rotors until all is as before, first order, 0.2 s.
    """
    system, B = make(frame).system, airframes.named(frame).effectiveness()
    n = system.n_theta
    rng = np.random.default_rng(seed)
    sd = scale * np.sqrt(KNOWN_NOISE)
    y = sd[0] * rng.standard_normal((TICKS, 4)) + [0.0, 0.0, 0.0, n]
    y += np.cumsum(sd[3] * np.sqrt(DT) * rng.standard_normal((TICKS, 4)), axis=0)
    for k, tau in ((1, 0.25), (2, 1.0)):
        keep = np.exp(-DT / tau)
        b = sd[k] * rng.standard_normal(4)
        for t in range(TICKS):
            y[t] += b
            b = keep * b + sd[k] * np.sqrt(1 - keep**2) * rng.standard_normal(4)
    healthy = 1.0 + 0.05 * np.cos(np.arange(n))  # some rotors carry more than others, as real ones do
    thrust, loss = np.tile(healthy, (TICKS, 1)), np.zeros((TICKS, n))
    for rotors, start, share in losses:
        loss[start:, list(np.atleast_1d(rotors))] += share
    M = np.linalg.pinv(B)
    for t in range(1, TICKS):
        weak = B * (1.0 - loss[t])
        goal = healthy + M @ np.linalg.solve(weak @ M, (B * loss[t]) @ healthy) * answered
        thrust[t] = goal + (thrust[t - 1] - goal) * np.exp(-DT / 0.2)
    y += (thrust * loss) @ B.T
    for axis, start, size in bias:
        y[start:, axis] += size
    when = np.arange(TICKS)
    mode = np.where(when < 5, GROUND, np.where(when < ready, LEARN, JUDGE))
    zeros = np.zeros((TICKS, 3))
    table = [thrust, zeros, np.full(TICKS, n), zeros, zeros[:, :2], np.full(TICKS, FULL), mode, when == 5]
    return np.column_stack(table).astype(float), y, np.ones((TICKS, 4), bool)


def dense(method, u, y, noises, onset, direction, share, last, prior):
    """State [x; theta; nu], nu ~ N(0, prior) entering `direction` with share(k - onset) at every tick from onset on.

    Returns (mean, covariance) after tick `last`.
    """
    system, n_x = method.system, method.system.n_x
    n_s = n_x + system.n_theta
    A = np.diag([*system.decay(DT), *np.ones(system.n_theta), 1.0])
    mean = np.concatenate([system.x0, np.zeros(system.n_theta + 1)])
    P = np.zeros((n_s + 1, n_s + 1))
    P[:n_x, :n_x] = system.P0
    P[-1, -1] = prior
    for k in range(5, last + 1):
        Q = np.zeros_like(P)
        Q[:n_x, :n_x] = np.diag(np.asarray(noise.process_variance(noises[k - 1], DT)))
        mean, P = A @ mean, A @ P @ A.T + Q
        G = np.eye(n_s + 1)
        if k >= onset:
            G[:n_s, -1] = share(k - onset) * direction
        mean, P = G @ mean, G @ P @ G.T
        H = np.concatenate([system.C(u[k]), system.H(u[k]), np.zeros((4, 1))], axis=1)
        S = H @ P @ H.T + np.diag(noises[k - 1, 0])
        K = np.linalg.solve(S, H @ P).T
        mean = mean + K @ (y[k] - H @ mean)
        keep = np.eye(n_s + 1) - K @ H
        P = keep @ P @ keep.T + K @ np.diag(noises[k - 1, 0]) @ K.T
    return mean, P


@pytest.fixture(scope="module")
def quad():
    """A calm quad whose rotor 3 loses 5 % at ONSET; caution with outliers and jumping commands is switched off."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jump_bank, "OUTLIER", 1e9)
        patch.setattr(caution, "LAG_ERROR_S", 0.0)
        patch.setattr(caution, "SNAPSHOT", 0.0)
        patch.setattr(caution, "BURST_POWER", 0.0)
        patch.setattr(hypotheses, "SLOP", (0.0,) * 4)  # geometry counts as exact
        method = make("ardupilot-quad-x")
        table = hover(losses=[(2, ONSET, 0.05)], answered=False, scale=0.3)
        out, carries = method.over(*table)
    assert out.announced.sum() == 1 and out.committed.sum() == 1
    return SimpleNamespace(method=method, table=table, out=out, carries=carries)


def test_noise_that_is_known_stays_known(quad):
    np.testing.assert_allclose(quad.carries.noise.variances[-1], KNOWN_NOISE, rtol=1e-3)


@pytest.mark.parametrize("slot", [2, 9, 18, 30, 35, 47])
def test_every_slot_is_an_augmented_kalman_filter(quad, slot):
    """Information C and z of a jump, and what it does to the state: sudden and gradual onsets, rotors and biases."""
    bank, system = quad.method.bank, quad.method.system
    u, y, _ = quad.table
    last = int(np.flatnonzero(quad.out.announced)[0]) - 1  # later, the bank stands still
    age = int(quad.carries.bank.age[last, slot])
    assert age >= 0
    carry = SimpleNamespace(
        s=quad.carries.s[last], P=quad.carries.P[last], **{k: getattr(quad.carries.bank, k)[last] for k in "MCz"}
    )
    build_up = 1.0 - np.exp(-DT / jumps.BUILD_UP_S)

    def share(since):
        return build_up * np.exp(-since * DT / jumps.BUILD_UP_S) if bank.jumps.slow[slot] else float(since == 0)

    noises = quad.carries.noise.variances
    for d in (0, 2, system.n_theta + 1, system.n_theta + 3):
        direction = np.zeros(bank.n_s)
        if d < system.n_theta:
            direction[system.n_x + d] = 1.0
        else:
            direction[(d - system.n_theta) * PER_AXIS + B3] = 1.0
        prior = LOSS_WIDTH**2
        mean, P = dense(quad.method, u, y, noises, last - age, direction, share, last, prior)
        precision = carry.C[slot, d, d] + 1.0 / prior
        nu = carry.z[slot, d] / precision
        M = carry.M[slot, :, d]
        np.testing.assert_allclose(P[-1, -1], 1.0 / precision, rtol=1e-6)
        np.testing.assert_allclose(mean[-1], nu, atol=1e-6 * LOSS_WIDTH, rtol=1e-6)
        np.testing.assert_allclose(mean[:-1], carry.s + M * nu, atol=1e-8)
        np.testing.assert_allclose(P[:-1, :-1], carry.P + np.outer(M, M) / precision, atol=1e-9)
        np.testing.assert_allclose(P[:-1, -1], M / precision, atol=1e-9)


def test_a_committed_jump_is_the_augmented_filters(quad):
    """At the commit the estimate and its covariance become those of a filter that knew the onset all along."""
    k = int(np.flatnonzero(quad.out.committed)[0])
    bank, system = quad.method.bank, quad.method.system
    onset = k - int(quad.out.decision.onset[k])  # the one that the bank chose
    assert abs(onset - ONSET) <= 6
    slow = [bool(bank.jumps.slow[w]) for w in np.flatnonzero(quad.carries.bank.age[k - 1] == k - 1 - onset)]
    u, y, _ = quad.table
    direction = np.zeros(bank.n_s)
    direction[system.n_x + 2] = 1.0
    build_up = 1.0 - np.exp(-DT / jumps.BUILD_UP_S)
    found = []
    for gradual in set(slow):

        def share(since, gradual=gradual):
            return build_up * np.exp(-since * DT / jumps.BUILD_UP_S) if gradual else float(since == 0)

        mean, P = dense(quad.method, u, y, quad.carries.noise.variances, onset, direction, share, k, LOSS_WIDTH**2)
        found.append((mean[:-1], P[:-1, :-1]))
    s, cov = quad.carries.s[k], quad.carries.P[k]
    j = system.n_x + 2
    best = min(found, key=lambda f: abs(f[0][j] - s[j]))
    sd = np.sqrt(best[1][j, j])
    assert abs(best[0][j] - s[j]) < 0.02 * sd  # the prior of the loss is all that differs
    assert np.sqrt(cov[j, j]) == pytest.approx(sd, rel=0.02)
    scale = np.sqrt(np.maximum(np.diag(best[1]), 1e-16))
    assert np.abs((best[1] - cov) / scale[:, None] / scale[None, :]).max() < 0.03
    assert abs(s[j] - 0.05) < 4 * sd


def test_every_covariance_is_symmetric_and_not_negative(quad):
    """Through announcement and commit: the filter's covariance with all cross terms, the information of every jump."""
    P, C = quad.carries.P, quad.carries.bank.C
    np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
    sd = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-20))
    assert np.linalg.eigvalsh(P / sd[:, :, None] / sd[:, None, :]).min() > -1e-9
    np.testing.assert_allclose(C, np.swapaxes(C, 2, 3), rtol=1e-12, atol=1e-9)
    top = np.linalg.norm(C, axis=(2, 3))[..., None] + 1.0
    assert (np.linalg.eigvalsh(C) / top).min() > -1e-12


@pytest.mark.parametrize("frame, rotor", [("ardupilot-quad-x", 1), ("ardupilot-hexa-x", 4)])
def test_a_loss_is_announced_with_its_rotor_and_size(frame, rotor):
    method = make(frame)
    out, _ = method.over(*hover(frame, seed=3, losses=[(rotor, ONSET, 0.25)]))
    ticks = np.flatnonzero(out.announced)
    assert ticks.size == 1 and ONSET < ticks[0] <= ONSET + 10
    assert method.bank.hyp.rotors[out.decision.best[ticks[0]]] == (rotor,)
    alone = [who == (rotor,) for who in method.bank.hyp.rotors]
    assert out.probability[ticks[0]][alone].sum() > 0.9
    assert abs(out.theta[-1, rotor] - 0.25) < 0.03
    assert np.all(np.delete(out.theta[-1], rotor) == 0.0)
    assert not out.theta[: ticks[0]].any()
    onset = ticks[0] - out.decision.onset[ticks[0]]
    assert abs(onset - ONSET) <= 4
    assert abs(out.theta[-1, rotor] - 0.25) < 4 * np.hypot(out.theta_sd[-1, rotor], 0.004)


def test_a_side_force_that_tilts_the_vehicle_is_no_loss_and_is_learned():
    """Gusts push the vehicle about and tilt it: without the push in its plant the filter would have to call that torque a jump."""
    method, lever = make("ardupilot-quad-x"), 0.6
    u, y, valid = hover()
    rng = np.random.default_rng(7)
    push = np.zeros((TICKS, 2))
    for t in range(1, TICKS):
        push[t] = 0.95 * push[t - 1] + 0.1 * rng.standard_normal(2)
    push[ONSET:] += [0.5, -0.4]
    y[:, 0] -= lever * push[:, 1]
    y[:, 1] += lever * push[:, 0]
    blind, _ = method.over(u, y, valid)
    u[:, -5:-3] = push
    out, carries = method.over(u, y, valid)
    assert not out.announced.any()
    assert carries.s[-1, SIDEWAYS] == pytest.approx(lever, abs=0.05)
    assert out.decision.log_odds.max() < 10.0 < 50.0 < blind.decision.log_odds.max()
    assert (
        np.abs(out.estimate.x[-1, [B3, PER_AXIS + B3]]).max()
        < 0.5 * np.abs(blind.estimate.x[-1, [B3, PER_AXIS + B3]]).max()
    )


def test_an_unknown_yaw_gain_is_integrated_out():
    """Schur complement: what is left of (C, z) is the information on the other directions, whatever the last one did."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((3, 20, 6))
    C, z = np.einsum("wki,wkj->wij", A, A), rng.standard_normal((3, 6))
    bank = jumps.Bank(np.zeros((3, 9, 6)), C, z, np.zeros(3, np.int32), np.int32(0))
    told = jumps.without_last(bank, 0.3)
    for w in range(3):
        full = np.linalg.inv(C[w] + np.diag([0.0] * 5 + [1 / 0.3]))
        assert np.asarray(told.C)[w] == pytest.approx(np.linalg.inv(full[:5, :5]), rel=1e-9)
        assert np.linalg.solve(np.asarray(told.C)[w], np.asarray(told.z)[w]) == pytest.approx(
            (full @ z[w])[:5], rel=1e-9
        )


def test_a_loss_that_ends_is_over():
    method = make("ardupilot-quad-x")
    out, _ = method.over(*hover(seed=5, ready=40, losses=[(0, 60, 0.3), (0, 115, -0.3)]))
    assert out.active[100].tolist() == [True, False, False, False]
    assert not out.active[-1].any() and out.theta[-1].max() < 1e-9


def test_nothing_is_announced_before_it_may_be_judged():
    method = make("ardupilot-quad-x")
    out, _ = method.over(*hover(seed=6, losses=[(1, 30, 0.4)], ready=TICKS))
    assert not out.announced.any() and not out.active.any() and not out.theta.any()


@pytest.mark.parametrize("axis", range(4))
def test_a_gust_or_a_payload_is_no_loss(axis):
    method = make("ardupilot-hexa-x")
    out, _ = method.over(*hover("ardupilot-hexa-x", seed=7, bias=[(axis, ONSET, 0.12)]))
    assert not out.announced.any()


def test_opposite_rotors_of_a_hexa_are_never_named_with_confidence():
    """Equal losses of two opposite rotors make no torque: a common shift of thrust, as from a battery."""
    method = make("ardupilot-hexa-x")
    out, _ = method.over(*hover("ardupilot-hexa-x", seed=8, losses=[((0, 1), ONSET, 0.2)]))
    for k in np.flatnonzero(out.announced | out.committed):
        assert out.probability[k].max() < 0.9, method.bank.hyp.names[out.probability[k].argmax()]


def test_a_shift_of_thrust_in_steady_hover_may_be_opposite_rotors_but_not_after_a_climb():
    """Who has just pushed up or down meets other air: the shift that stays is explained by that."""
    method, n = make("ardupilot-hexa-x"), 6
    u, y, valid = hover("ardupilot-hexa-x", seed=8, losses=[((0, 1), ONSET, 0.25)])
    steady, _ = method.over(u, y, valid)
    assert (steady.opposite.pair >= 0).sum() == 1
    assert set(method.bank.hyp.rotors[steady.opposite.pair.max()]) in ({0, 1}, {2, 3}, {4, 5})
    pushed = slice(ONSET - 12, ONSET - 4)
    u, y = u.copy(), y.copy()
    u[pushed, n + 3] += 0.4 * n
    u[pushed, :n] += 0.4
    y[pushed, 3] += 0.4 * n
    climbed, _ = method.over(u, y, valid)
    assert (climbed.opposite.pair < 0).all() and not climbed.announced.any()


def test_false_alarms_are_as_rare_as_the_threshold_says():
    """Without a fault the evidence, summed over onset times, grows by no more than one a tick and rotor set on average
    (a Shiryaev-Roberts statistic), so that the threshold bounds how often it is crossed: Markov's inequality."""
    method = make("ardupilot-quad-x")
    hyp = method.bank.hyp
    runs = 48
    tables = [method.over(*hover(seed=1000 + r))[0] for r in range(runs)]
    total = np.exp(np.stack([out.decision.log_odds[READY:, hyp.fault] for out in tables])).sum(axis=2)
    each = hyp.weight[hyp.fault].sum()
    judged = np.arange(1, TICKS - READY + 1)
    assert total.mean(axis=0)[-1] < 2.0 * each * judged[-1]
    worst = (total / (each * judged[-1])).max(axis=1)
    for level in (5.0, 20.0):
        expected = runs / level
        assert (worst > level).sum() <= expected + 3 * np.sqrt(expected), level
    assert not any(out.announced.any() for out in tables)
    assert np.median(total[:, -1]) < each * judged[-1]


def test_the_threshold_follows_from_a_false_alarm_rate():
    hyp = make("ardupilot-quad-x").bank.hyp
    hours = jump_bank.FALSE_ALARM_PERIOD_S / 3600.0
    assert hours >= 10.0  # what is promised: at most one in ten flight hours
    weight = hyp.weight[hyp.fault].sum()
    assert np.exp(jump_bank.threshold(hyp, DT)) * DT / 3600.0 / weight == pytest.approx(hours * jump_bank.GATES)
    assert jump_bank.threshold(hyp, DT, 10 * 3600.0) < jump_bank.threshold(hyp, DT, 100 * 3600.0)


def test_no_torque_free_pair_is_added_to_a_known_loss():
    """A third rotor's loss whose torque passed for a gust leaves a shift of thrust: opposite rotors would explain it, three failures."""
    n = 6
    bank = make("ardupilot-hexa-x").bank
    hyp = bank.hyp
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    free = [k for k, (i, j) in enumerate(hyp.pairs) if np.abs(B[:2, i] + B[:2, j]).max() < 0.05]
    assert len(free) == 3 and np.flatnonzero(np.asarray(bank._torque_free())).tolist() == free
    table = hover("ardupilot-hexa-x", seed=8, losses=[((0, 1), ONSET, 0.2)])
    u, y, valid = (np.asarray(a) for a in table)
    for known in (False, True):
        carry = bank.init()
        active = np.arange(n) == 2
        carry = carry._replace(standing=carry.standing._replace(active=active & known))
        odds = _evidence_after(bank, carry, u, y, valid, ONSET + 20)
        barred = odds[n + np.array(free)] < -20.0
        assert barred.tolist() == [known and 2 not in hyp.pairs[k] for k in free]


def _evidence_after(bank, carry, u, y, valid, ticks):
    """Log odds (n_h,) after so many ticks from `carry` on."""
    jax = load_jax()

    def tick(carry, row):
        carry, out = bank.step(carry, *row)
        return carry, out.decision.log_odds

    # restart would forget what is known
    u = u.copy()
    u[:, -1] = 0.0
    return np.asarray(jax.jit(lambda c, *t: jax.lax.scan(tick, c, t))(carry, u[:ticks], y[:ticks], valid[:ticks])[1])[
        -1
    ]
