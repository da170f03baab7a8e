"""The jump bank is what its paper says: an augmented Kalman filter for every onset time, at the price of one filter.

The reference below is that filter written out: dense NumPy, one more state for the jump. The noise is the one the
estimator had learned by then; everything else is computed anew.
"""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields
from scipy.optimize import lsq_linear
from tests.loss_prior import beside_steps, moments, one_of
from tests.plain import array, measured, tick, unpacked
from tests.plain import plant as plant_of

from rotorwatch import airframes
from rotorwatch.base.compiling.running import Rows
from rotorwatch.engine.bindings import program
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.plant_rows import any_multirotor
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator import announcement, hypotheses, kalman, posterior
from rotorwatch.engine.estimator.bank import FIRST_LOSS, GROUP
from rotorwatch.engine.estimator.estimator import Estimator, Result
from rotorwatch.engine.estimator.hypotheses import AIR_SHARE, LOSS_WIDTH
from rotorwatch.engine.estimator.model_error import Memory
from rotorwatch.engine.estimator.plant import ANSWER_S, B3, BUILT_SD, BURST_S, PER_AXIS, SIDEWAYS, TAU, THETA, YAW_GAIN
from rotorwatch.engine.estimator.plausibility import torque_free
from rotorwatch.engine.events.decisions import FALSE_ALARM_PERIOD_S
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, LEARN
from rotorwatch_lab.experiments import limits

DT = 0.05
HEXA = airframes.named("ardupilot-hexa-x").effectiveness()
TICKS, READY, ONSET = 160, 60, 100
KNOWN_NOISE = np.tile(np.array([[0.01**2], [0.004**2], [0.004**2], [0.002**2]]), (1, 4))
CERTAIN_WEIGHT = 1e9
GRADUAL = np.arange(3 * GROUP) >= 2 * GROUP  # slots of losses that build up


class Carries:
    """What the estimator holds after each tick, of n rotors: of the explanations s, P (T, places, states), weight, active and onset; rows:
    everything, by name, if it is whole."""

    def __init__(self, states, n, whole):
        size, branches = THETA + n, [state["branches"]["all"] for state in states]
        shapes = {"s": (size,), "weight": (), "active": (n,), "onset": ()}
        for name, shape in shapes.items():
            part = (slice(None), slice(None), *map(slice, shape))
            setattr(self, name, np.concatenate([each[name][part] for each in branches]))
        self.P = program.square(np.concatenate([each["P"] for each in branches]), size)
        if whole:
            self.rows = np.concatenate(states)
            self.variances, packs = self.rows["noise"]["v"], self.rows["bank"]["packs"]
            self.slots = {name: of_slots(packs[name]) for name in ("age", "M", "C", "z")}
            self.age = self.slots["age"]


def of_slots(value):
    """Numbers of packs (T, packs, ..., lanes) as of slots (T, slots, ...)."""
    return np.moveaxis(value, -1, 2).reshape(len(value), -1, *value.shape[2:-1])


class Method:
    """The estimator on a frame whose noise is known."""

    def __init__(self, frame, yaw_known=False):
        if ENGINE.library is None:
            pytest.skip("no C compiler: its Python lines give the same bits (test_engine.py), and take minutes here")
        self.B = airframes.named(frame).effectiveness()
        self.n, (x0, P0) = self.B.shape[1], any_multirotor(self.B.shape[1])
        self.hyp = list_hypotheses(self.n)
        if yaw_known:
            P0[YAW_GAIN, :] = P0[:, YAW_GAIN] = 0.0
        known = {"x0": x0, "P0": P0, "noise": KNOWN_NOISE, "noise_weight": CERTAIN_WEIGHT}
        self._made = lambda: program.steps(DT, self.B, known)
        self.usual = self._made().plant
        self.plant = plant_of(self.B, DT, variance=self.usual["variance"][0])

    def reported(self, u, y, valid):
        """The outputs."""
        return self._made().run(u, y, valid)

    def over(self, u, y, valid, carry=None, whole=False):
        """(outputs, carries) of a flight; carry: the state (1,) before its first tick."""
        steps, parts, states = self._made(), [], []
        if carry is not None:
            steps.state = Rows(Estimator, carry.copy(), None)
        for k in range(len(u)):
            parts.append(steps.run(u[k : k + 1], y[k : k + 1], valid[k : k + 1]))
            states.append(steps.state.native.copy() if whole else repack_fields(steps.state.native[["branches"]]))
        out = program.TickOutput(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        return out, Carries(states, self.n, whole)

    def drag(self, u):
        """(T, n) yaw that each rotor's drag makes."""
        return limits.balance(u, self.usual)[1]


make = cache(Method)


FULL = 2.5  # hover thrusts that a rotor gives at most
EXPO = 0.65


def hover(frame="ardupilot-quad-x", seed=0, losses=(), ready=READY, bias=(), answered=True, scale=1.0):
    """(u, y, valid): steady hover, noise `scale` times as large as known.

    losses: (rotors 0-based, from tick, loss); bias: (axis, from tick, size). answered: the controller asks more of weak
    rotors until all is as before, first order, 0.2 s.
    """
    B = make(frame).B
    n = B.shape[1]
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
    mode = np.where(when < 5, GROUND, np.where(when < ready, LEARN, ASSESS))
    zeros = np.zeros((TICKS, 3))
    curve = np.full(TICKS, EXPO), np.zeros(TICKS)  # known: the tests of an unknown one are in test_thrust_curve.py
    table = [thrust, zeros, np.full(TICKS, n), zeros, zeros[:, :2], np.full(TICKS, FULL), *curve, np.full(TICKS, np.nan), mode, when == 5]
    return np.column_stack(table).astype(float), y, np.ones((TICKS, 4), bool)


def dense(method, u, y, noises, onset, directions, share, last, prior):
    """State [x; theta; nu], nu ~ N(0, prior) entering the directions (n_nu, n_s) with share(k - onset) at every tick from onset on.

    Returns (mean, covariance) after tick `last`.
    """
    p, n, n_nu = method.plant, method.n, len(directions)
    n_s = THETA + n
    mean = np.concatenate([p.mean, np.zeros(n + n_nu)])
    P = np.zeros((n_s + n_nu, n_s + n_nu))
    P[:THETA, :THETA] = p.variance
    P[THETA:n_s, THETA:n_s] = BUILT_SD**2 * (np.eye(n) - 1.0 / n)  # rotors differ, about their mean
    P[n_s:, n_s:] = prior * np.eye(n_nu)
    for k in range(5, last + 1):
        G = np.eye(n_s + n_nu)
        if k >= onset:
            G[:n_s, n_s:] = share(k - onset) * np.transpose(directions)
        mean, P, _, _ = stepped(method, u[k], y[k], noises[k - 1], mean, P, G)
    return mean, P


def walks(noises):
    """(states of the plant,) process noise variances of a tick: coloured disturbances stay as large as they are, the drift walks."""
    Q = np.zeros(THETA)
    for a in range(4):
        Q[a * PER_AXIS : a * PER_AXIS + 3] = noises[1:, a] * [*(1.0 - np.exp(-2.0 * DT / np.array(TAU))), DT]
    return Q


def stepped(method, u, y, noises, mean, P, G=None, walk=0.0):
    """One tick of a Kalman filter in matrices: (mean, covariance, innovation, its covariance). walk: variances (states,) or 0."""
    size, states = len(mean), THETA + method.n
    G = np.eye(size) if G is None else G
    A = np.diag([*array(method.plant.decay, states), *np.ones(size - states)])
    Q = np.diag([*walks(noises), *np.zeros(size - THETA)]) + np.diag(walk * np.ones(size))
    mean, P = G @ A @ mean, G @ (A @ P @ A.T + Q) @ G.T
    H = np.concatenate([measured(method.plant, u[:-2])[0], np.zeros((4, size - states))], axis=1)
    R = np.diag(noises[0])
    e, S = y - H @ mean, H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    keep = np.eye(size) - K @ H
    return mean + K @ e, keep @ P @ keep.T + K @ R @ K.T, e, S


def shares_of(slow):
    """What part of a jump enters how long after its onset."""
    build_up = 1.0 - np.exp(-DT / ANSWER_S)
    return lambda since: build_up * np.exp(-since * DT / ANSWER_S) if slow else float(since == 0)


@pytest.fixture(scope="module")
def quad():
    """A calm quad whose rotor 3 loses 5 % at ONSET; caution with outliers and jumping commands is switched off, yaw gain and geometry
    count as exact, and every explanation is kept however unlikely."""
    other = {
        "kalman.OUTLIER": 1e9, "model_error.LAG_ERROR_S": 0.0, "noise.CLIP": 1.0, "hypotheses.SLOP": (0.0,) * 4, "posterior.OUT": -400.0,
    }  # fmt: skip
    with ENGINE.changed(other):
        method = make("ardupilot-quad-x", yaw_known=True)
        table = hover(losses=[(2, ONSET, 0.05)], answered=False, scale=0.3)
        out, carries = method.over(*table, whole=True)
        assert out.announced.sum() == 1
        k = int(np.flatnonzero(out.announced)[0])
        # As it would go on had rotor 3 been taken for healthy, and the truth only been a second thought.
        doubting = carries.rows[k : k + 1].copy()
        b, before = doubting["branches"]["all"][0], carries.rows[k - 1]["branches"]["all"]
        for name in ("s", "P", "active", "learning", "variance", "mean"):
            b[name][1] = b[name][0]
            b[name][0] = before[name][0]
        b["weight"] = [0.0, -8.0, posterior.NEVER, posterior.NEVER]
        swapped = method.over(*(a[k + 1 :] for a in table), carry=doubting, whole=True)
    return SimpleNamespace(method=method, table=table, out=out, carries=carries, born=k, swapped=swapped)


def test_noise_that_is_known_stays_known(quad):
    np.testing.assert_allclose(quad.carries.variances[-1], KNOWN_NOISE, rtol=1e-3)


@pytest.mark.thorough(keep=3)
@pytest.mark.parametrize("slot", [2, 9, 18, 30, 35, 47])
def test_every_slot_is_an_augmented_kalman_filter(quad, slot):
    """Information C and z of a jump, and what it does to the state: sudden and gradual onsets, rotors and biases."""
    method, carries, (u, y, _) = quad.method, quad.carries, quad.table
    last, states = quad.born - 1, THETA + method.n  # at the announcement the bank starts anew
    age = int(carries.age[last, slot])
    assert age >= 0
    one = {name: value[last, slot] for name, value in carries.slots.items()}
    s, P0 = carries.s[last, 0], carries.P[last, 0]
    share = shares_of(GRADUAL[slot])
    for rotor, axis in ((0, None), (2, None), (None, 1), (None, 3)):
        direction, d = np.zeros(states), axis if rotor is None else FIRST_LOSS + rotor
        direction[axis * PER_AXIS + B3 if rotor is None else THETA + rotor] = 1.0
        prior = LOSS_WIDTH**2
        mean, P = dense(method, u, y, carries.variances, last - age, [direction], share, last, prior)
        precision = one["C"][d * (d + 3) // 2] + 1.0 / prior
        nu = one["z"][d] / precision
        M = one["M"][:states, d]
        np.testing.assert_allclose(P[-1, -1], 1.0 / precision, rtol=1e-6)
        np.testing.assert_allclose(mean[-1], nu, atol=1e-6 * LOSS_WIDTH, rtol=1e-6)
        np.testing.assert_allclose(mean[:-1], s + M * nu, atol=1e-8)
        np.testing.assert_allclose(P[:-1, :-1], P0 + np.outer(M, M) / precision, atol=1e-9)
        np.testing.assert_allclose(P[:-1, -1], M / precision, atol=1e-9)


def in_air_that_moves_or_not(quad, k, age, slow, directions):
    """Mean (1,) and variance (1, 1) of one loss in `directions`, where the air may have changed thrust as well: by dense filters."""
    n_s, (u, y, _), noises = THETA + quad.method.n, quad.table, quad.carries.variances
    air = 0.1 * quad.method.n * quad.carries.rows["missing"]["climb"][k]
    thrust = np.zeros((1, n_s))
    thrust[0, 3 * PER_AXIS + B3] = 1.0
    both = np.concatenate([directions, thrust])
    prior = np.array([LOSS_WIDTH**2, max(air**2, 1e-12)])
    m, V = dense(quad.method, u, y, noises, k - age, both, shares_of(slow), k, prior)
    C = np.linalg.inv(V[n_s:, n_s:])
    z, C = C @ m[n_s:], C - np.diag(1.0 / prior)
    moved, steady = beside_steps(C, z, prior[1:]), moments(C[0, 0], z[0])
    _, size, variance = one_of([(AIR_SHARE, *moved), (1.0 - AIR_SHARE, *steady)])
    return np.clip([size], 0.0, 1.0), np.array([[variance]])  # the most probable of 0..1


@pytest.mark.parametrize("place", range(posterior.PLACES - 1))
def test_a_born_branch_is_the_augmented_filters(quad, place):
    """At the announcement each explanation holds the state and covariance of a dense filter that knew of this jump, of the rotors it
    names, all along; losses of two rotors at the best point of 0..1."""
    k, carries, n_s = quad.born, quad.carries, THETA + quad.method.n
    who = np.flatnonzero(carries.active[k, place])
    age = int(carries.onset[k, place]) - 1
    directions = np.zeros((who.size, n_s))
    directions[np.arange(who.size), THETA + who] = 1.0
    assert who.size >= 1 and (place > 0 or who.tolist() == [2])
    kinds = set(GRADUAL[carries.age[k - 1] == age - 1])
    assert kinds
    u, y, _ = quad.table
    off = []
    for slow in kinds:
        mean, P = dense(quad.method, u, y, quad.carries.variances, k - age, directions, shares_of(slow), k, LOSS_WIDTH**2)
        root = np.linalg.cholesky(np.linalg.inv(P[n_s:, n_s:])).T
        if who.size == 1:  # parts of a prior instead of the one Gaussian of the dense filter
            nu, after = in_air_that_moves_or_not(quad, k, age, slow, directions)
        else:
            nu, after = lsq_linear(root, root @ mean[n_s:], (0.0, 1.0), tol=1e-14).x, P[n_s:, n_s:]
        lean = P[:n_s, n_s:] @ np.linalg.inv(P[n_s:, n_s:])
        mean, P = mean[:n_s] + lean @ (nu - mean[n_s:]), P[:n_s, :n_s] + lean @ (after - P[n_s:, n_s:]) @ lean.T
        sd = np.sqrt(np.maximum(np.diag(P), 1e-14))
        off.append(
            (
                np.abs((carries.s[k, place] - mean) / sd).max(),
                np.abs((carries.P[k, place] - P) / sd[:, None] / sd[None, :]).max(),
                np.abs(carries.s[k, place] - mean)[THETA + who].max(),
            )
        )
    best = min(off, key=lambda o: max(o[:2]))
    assert best[0] < 1e-3 and best[1] < 1e-3, off


def test_one_explanation_at_least_is_without_the_rotor_that_leads(quad):
    """Pairs of that rotor and another one explain nearly as much as it does alone; they do not take all places."""
    active = quad.carries.active[quad.born]
    assert active[0].tolist() == [False, False, True, False]
    assert not active[posterior.PLACES - 2][2] and active[posterior.PLACES - 2].any()
    assert any(who[2] and who.sum() == 2 for who in active)


def test_gains_learn_without_what_the_known_loss_takes(quad, monkeypatch):
    """Torque that a weak rotor lacks was commanded and made no motion."""
    k, look, given, (u, y, _) = quad.born + 20, Memory.weigh_inputs, [], quad.table

    def spied(self, p, now, s, lost, *rest):
        given.append(list(lost))
        return look(self, p, now, s, lost, *rest)

    monkeypatch.setattr(Memory, "weigh_inputs", spied)
    now = tick(u[k + 1], quad.method.n)
    now.mode, now.wrench = ASSESS, y[k + 1].tolist()
    unpacked(Estimator, quad.carries.rows[k]).step(quad.method.plant, now, Result())
    theta = quad.carries.s[k, 0, THETA:]
    assert theta[2] > 0.05
    np.testing.assert_allclose(given[0], quad.method.B @ (u[k + 1, : quad.method.n] * theta), rtol=1e-9, atol=1e-12)


def test_explanations_go_on_as_kalman_filters_and_are_weighed_by_what_they_predict(quad):
    """From the announcement on, each against a filter in matrices, whose innovations' joint log-densities give the weights."""
    k, method, last, carries = quad.born, quad.method, quad.born + 25, quad.carries
    u, y, _ = quad.table
    weight, active = carries.weight[k], carries.active[k]
    alive = np.flatnonzero(weight > 0.5 * posterior.NEVER)
    assert alive.size >= 2
    assert (active[alive] == carries.active[last, alive]).all()  # no other has taken the lead
    fits = np.zeros((last - k, alive.size))
    for column, b in enumerate(alive):
        mean, P = carries.s[k, b], carries.P[k, b]
        walk = np.concatenate([np.zeros(THETA), active[b] * kalman.THETA_WALK * DT])
        for j in range(k + 1, last + 1):
            mean, P, e, S = stepped(method, u[j], y[j], quad.carries.variances[j - 1], mean, P, walk=walk)
            fits[j - k - 1, column] = -0.5 * np.linalg.slogdet(S)[1] - 0.5 * e @ np.linalg.solve(S, e)
        np.testing.assert_allclose(carries.s[last, b], mean, atol=1e-8)
        np.testing.assert_allclose(carries.P[last, b], P, atol=1e-9)
    counts = posterior.TEMPER * np.exp(-DT * np.arange(last - k) / BURST_S)
    expected = weight[alive] + counts @ (fits - fits[:, :1])
    assert np.abs(expected - weight[alive]).max() > 0.01  # there was something to distinguish
    np.testing.assert_allclose(carries.weight[last, alive], expected, atol=1e-6)
    share = quad.out.share[last]
    np.testing.assert_allclose(np.log(share[alive] / share[0]), expected, atol=1e-6)


def test_the_better_explanation_takes_the_lead_and_the_bank_starts_anew(quad):
    """That nothing broke leads, the loss comes second: what was missing keeps missing."""
    out, carries = quad.swapped
    assert not out.active[0, 0].any() and out.active[0, 1].tolist() == [False, False, True, False]
    leads = out.active[:, 0, 2]
    j = int(np.argmax(leads))
    assert j > 0 and leads[j:].all() and not leads[:j].any() and not out.announced[: j + 1].any()
    assert carries.weight[j - 1, 1] <= hypotheses.CLEAR
    assert (carries.age[j] == -1).all() and (carries.age[j - 1] >= 0).any()
    assert out.theta[j - 1].max() == 0.0
    assert out.theta[j:, 2] == pytest.approx(0.05, abs=0.02)


def test_every_covariance_is_symmetric_and_not_negative(quad):
    """Through the announcement: the covariances of all explanations with all cross terms, the information of every jump."""
    P, q = quad.carries.P, FIRST_LOSS + quad.method.n
    C = program.square(quad.carries.slots["C"], q)
    np.testing.assert_array_equal(P, np.swapaxes(P, 2, 3))
    sd = np.sqrt(np.maximum(np.diagonal(P, axis1=2, axis2=3), 1e-20))
    assert np.linalg.eigvalsh(P / sd[..., None] / sd[..., None, :]).min() > -1e-9
    top = np.linalg.norm(C, axis=(2, 3))[..., None] + 1.0
    assert (np.linalg.eigvalsh(C) / top).min() > -1e-12


@pytest.mark.parametrize("frame, rotor", [("ardupilot-quad-x", 1), ("ardupilot-hexa-x", 4)])
def test_a_loss_is_announced_with_its_rotor_and_size(frame, rotor):
    method = make(frame)
    out = method.reported(*hover(frame, seed=3, losses=[(rotor, ONSET, 0.25)]))
    ticks = np.flatnonzero(out.announced)
    assert ticks.size == 1 and ONSET < ticks[0] <= ONSET + 10
    assert method.hyp.rotors[out.best[ticks[0]]] == (rotor,)
    alone = [who == (rotor,) for who in method.hyp.rotors]
    assert out.probability[ticks[0]][alone].sum() > 0.9
    assert abs(out.theta[-1, rotor] - 0.25) < 0.03
    assert np.all(np.delete(out.theta[-1], rotor) == 0.0)
    assert not out.theta[: ticks[0]].any()
    onset = ticks[0] - out.onset[ticks[0]]
    assert abs(onset - ONSET) <= 4
    assert abs(out.theta[-1, rotor] - 0.25) < 4 * np.hypot(out.theta_sd[-1, rotor], 0.004)


def test_a_rotor_that_a_turn_commands_less_is_announced_all_the_same():
    """Yaw swings the commands: more is asked of the rotor that fails than at the onset, and only half a second later more than usual."""
    method, period = make("ardupilot-quad-x"), 40
    u, y, valid = hover(seed=3, losses=[(1, ONSET, 0.2)])
    B, lost = airframes.named("ardupilot-quad-x").effectiveness(), np.zeros((TICKS, 4))
    lost[ONSET:, 1] = 0.2
    swing = 0.3 * np.cos(2.0 * np.pi * (np.arange(TICKS) - ONSET) / period)
    turn = -swing[:, None] * np.sign(B[2] * B[2, 1])
    u[:, :4] += turn
    y += (turn * lost) @ B.T
    with ENGINE.changed({"decisions.CERTAIN_NATS": 1e9}):  # evidence this large asks nothing of the command
        out = method.reported(u, y, valid)
    (announced,) = np.flatnonzero(out.announced)
    assert announced - ONSET < 12
    assert out.active[announced, 0].tolist() == [False, True, False, False]


def test_a_side_force_that_tilts_the_vehicle_is_no_loss_and_is_learned():
    """Gusts push the vehicle about and tilt it: without the push in its plant the filter would have to call that torque a jump."""
    method, lever = make("ardupilot-quad-x"), 0.15
    u, y, valid = hover()
    rng = np.random.default_rng(7)
    push = np.zeros((TICKS, 2))
    for t in range(1, TICKS):
        push[t] = 0.95 * push[t - 1] + 0.4 * rng.standard_normal(2)
    push[ONSET:] += [2.0, -1.6]
    y[:, 0] -= lever * push[:, 1]
    y[:, 1] += lever * push[:, 0]
    blind, unseen = method.over(u, y, valid)
    u[:, -8:-6] = push
    y[:, 2] -= method.drag(u).sum(axis=1)  # unequal rotors yaw in it as well
    out, carries = method.over(u, y, valid)
    assert not out.announced.any()
    assert carries.s[-1, 0, SIDEWAYS] == pytest.approx(lever, abs=0.0125)
    assert out.log_odds.max() < 10.0 < 50.0 < blind.log_odds.max()
    drifts = [B3, PER_AXIS + B3]
    assert np.abs(carries.s[-1, 0, drifts]).max() < 0.5 * np.abs(unseen.s[-1, 0, drifts]).max()


@pytest.mark.parametrize("dragged", [False, True])
@pytest.mark.parametrize("side", [(0.0, 8.0), (-8.0, 0.0)])
def test_a_loss_in_wind_has_its_size_whether_or_not_the_rotors_take_the_side_force(side, dragged):
    """How much of it they take nobody knows: of a dead rotor's drag, here three times its torque, all may be missing, or nothing."""
    method = make("ardupilot-quad-x")
    u, y, valid = hover(seed=5, losses=[(0, ONSET, 0.3)])
    u[:, -8:-6] = side
    if dragged:
        drag = method.drag(u)
        y[:, 2] -= drag.sum(axis=1)
        y[ONSET:, 2] += 0.3 * drag[ONSET:, 0]
    out = method.reported(u, y, valid)
    (found,) = np.flatnonzero(out.announced)
    assert ONSET <= found < ONSET + 5
    assert out.theta[[found, -1]] == pytest.approx(np.tile([0.3, 0.0, 0.0, 0.0], (2, 1)), abs=0.025)


def test_noise_of_the_accelerometer_teaches_nothing_about_side_forces():
    """A regressor that is all noise would show that side forces turn nothing, and the first manoeuvre would look like a jump."""
    method, lever = make("ardupilot-quad-x"), 0.6
    u, y, valid = hover()
    rng = np.random.default_rng(8)
    push = np.zeros((TICKS, 2))
    push[ONSET:] = np.cumsum(0.2 * rng.standard_normal((TICKS - ONSET, 2)), axis=0)
    y[:, 0] -= lever * push[:, 1]
    y[:, 1] += lever * push[:, 0]
    u[:, -8:-6] = push + 0.2 * rng.standard_normal((TICKS, 2))
    out, carries = method.over(u, y, valid)
    known = carries.s[:, 0, SIDEWAYS]
    assert known[ONSET - 1] == pytest.approx(method.plant.mean[SIDEWAYS], abs=0.02)
    assert known[-1] == pytest.approx(lever, abs=0.12)
    assert not out.announced.any()


def test_a_loss_that_ends_is_announced_as_a_recovery():
    method = make("ardupilot-quad-x")
    out = method.reported(*hover(seed=5, ready=40, losses=[(0, 60, 0.3), (0, 115, -0.3)]))
    failed, ended = np.flatnonzero(out.announced)
    assert 60 < failed < 75 and 115 < ended < 130
    hyp, best = method.hyp, out.best[ended]
    assert (hyp.kinds[best], hyp.rotors[best]) == ("recovery", (0,))
    assert (out.active[failed:ended, 0] == [True, False, False, False]).all()
    assert abs(ended - out.onsets[ended, 0] + 1 - 115) <= 4
    assert not out.active[-1, 0].any() and out.theta[ended:].max() < 1e-9


def test_a_rotor_of_which_nothing_is_known_cannot_recover():
    method = make("ardupilot-quad-x")
    out = method.reported(*hover(seed=9, losses=[(1, ONSET, -0.3)]))
    well = [kind == "recovery" for kind in method.hyp.kinds]
    assert out.log_odds[READY:, well].max() < -40.0
    assert not out.announced.any()


def test_a_second_rotor_joins_the_first():
    method = make("ardupilot-quad-x")
    out = method.reported(*hover(seed=5, ready=40, losses=[(0, 60, 0.3), (3, 115, 0.25)]))
    first, second = np.flatnonzero(out.announced)
    assert 60 < first < 75 and 115 < second < 130
    assert (out.active[first:second, 0] == [True, False, False, False]).all()
    assert out.active[-1, 0].tolist() == [True, False, False, True]
    assert out.theta[-1] == pytest.approx([0.3, 0.0, 0.0, 0.25], abs=0.05)
    assert out.share[-1, 0] > 0.9
    np.testing.assert_allclose(out.share.sum(axis=1), 1.0, rtol=1e-9)


@pytest.mark.parametrize("restart, kept", [(1.0, False), (2.0, True)])
def test_a_new_hop_starts_anew_and_a_contact_ends_the_competition_only(restart, kept):
    method = make("ardupilot-hexa-x")
    u, y, valid = hover("ardupilot-hexa-x", seed=3, losses=[(4, ONSET, 0.25)])
    u[ONSET + 30, -1] = restart
    out, carries = method.over(u, y, valid)
    assert out.active[ONSET + 29, 0].any()
    assert bool(out.active[ONSET + 30, 0, 4]) == kept and not np.delete(out.active[ONSET + 30, 0], 4).any()
    assert (out.theta[ONSET + 30, 4] > 0.1) == kept
    assert carries.weight[ONSET + 30].tolist() == [0.0] + [posterior.NEVER] * 3


def test_nothing_is_announced_before_it_may_be_assessed():
    method = make("ardupilot-quad-x")
    out = method.reported(*hover(seed=6, losses=[(1, 30, 0.4)], ready=TICKS))
    assert not out.announced.any() and not out.active.any() and not out.theta.any()


@pytest.mark.parametrize("axis", range(4))
def test_a_gust_or_a_payload_is_no_loss(axis):
    method = make("ardupilot-hexa-x")
    out = method.reported(*hover("ardupilot-hexa-x", seed=7, bias=[(axis, ONSET, 0.12)]))
    if axis < 3:
        assert not out.announced.any()
    else:  # opposite rotors would look the same
        assert only_pairs_that_look_alike(method, out)


def only_pairs_that_look_alike(method, out):
    """Whatever leads is a pair of opposite rotors, another such pair is left beside it, and any of both may lack nothing."""
    free = {who for who in method.hyp.rotors if len(who) == 2 and torque_free(method.plant, *who)}
    for k in np.flatnonzero(out.active[:, 0].any(axis=1)):
        who = np.flatnonzero(out.active[k, 0])
        low = out.theta[k, who] - 1.96 * out.theta_sd[k, who]
        if tuple(who) not in free or out.share[k, 0] >= 0.99 or low.min() > 0.0:
            return False
    return True


def test_opposite_rotors_of_a_hexa_are_never_named_with_confidence():
    """Equal losses of two opposite rotors make no torque: a common shift of thrust, as from a battery."""
    method = make("ardupilot-hexa-x")
    out = method.reported(*hover("ardupilot-hexa-x", seed=8, losses=[((0, 1), ONSET, 0.2)]))
    assert out.announced.any() and only_pairs_that_look_alike(method, out)


def test_a_shift_of_thrust_in_steady_hover_may_be_opposite_rotors_but_not_after_a_climb():
    """Who has just pushed up or down meets other air: the shift that stays is explained by that."""
    method, n = make("ardupilot-hexa-x"), 6
    u, y, valid = hover("ardupilot-hexa-x", seed=8, losses=[((0, 1), ONSET, 0.25)])
    steady = method.reported(u, y, valid)
    assert steady.announced.sum() == 1 and only_pairs_that_look_alike(method, steady)
    pushed = slice(ONSET - 12, ONSET - 4)
    u, y = u.copy(), y.copy()
    u[pushed, n + 3] += 0.4 * n
    u[pushed, :n] += 0.4
    y[pushed, 3] += 0.4 * n
    climbed = method.reported(u, y, valid)
    assert not climbed.announced.any()


def test_false_alarms_are_as_rare_as_the_threshold_says(amount):
    """Without a fault the evidence, summed over onset times, grows by no more than one a tick and rotor set on average
    (a Shiryaev-Roberts statistic), so that the threshold bounds how often it is crossed: Markov's inequality."""
    method = make("ardupilot-quad-x")
    hyp = method.hyp
    new = hyp.fault & (np.array(hyp.kinds) != "recovery")
    runs = amount(10, 24)
    tables = [method.reported(*hover(seed=1000 + r)) for r in range(runs)]
    total = np.exp(np.stack([out.log_odds[READY:, new] for out in tables])).sum(axis=2)
    each = hyp.weight[new].sum()
    assessed = np.arange(1, TICKS - READY + 1)
    assert total.mean(axis=0)[-1] < 2.0 * each * assessed[-1]
    worst = (total / (each * assessed[-1])).max(axis=1)
    for level in (5.0, 20.0):
        expected = runs / level
        assert (worst > level).sum() <= expected + 3 * np.sqrt(expected), level
    assert not any(out.announced.any() for out in tables)
    assert np.median(total[:, -1]) < each * assessed[-1]


def test_the_threshold_follows_from_a_false_alarm_rate():
    hyp = list_hypotheses(4)
    hours = FALSE_ALARM_PERIOD_S / 3600.0
    assert hours >= 10.0  # what is promised: at most one in ten flight hours
    weight = hyp.weight[hyp.fault & (np.array(hyp.kinds) != "recovery")].sum()
    assert np.exp(program.threshold(4, DT)) * DT / 3600.0 / weight == pytest.approx(hours * announcement.GATES)


def test_the_noise_learns_from_what_is_left_with_the_biases_in_it():
    """A steady push of 0.3 hover thrusts in roll stays in the residual, although the filter's biases take it."""
    _, carries = make("ardupilot-quad-x").over(*hover(bias=[(0, 5, 0.3)], scale=0.3), whole=True)
    ring, ok = carries.rows["noise"]["ring"][-1, :, 0], carries.rows["noise"]["known"][-1, :, 0]
    assert ok.sum() > 30 and ring[ok].mean() == pytest.approx(0.3, abs=0.05)
    biases = carries.s[-1, 0, :3]
    assert biases.sum() == pytest.approx(0.3, abs=0.05)
