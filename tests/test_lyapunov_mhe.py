"""Lyapunov, moving-horizon-Lyapunov and moving-horizon estimators: the laws their derivations promise, and that these can fail."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.lyapunov import Lyapunov
from rotorwatch_lab.estimators.mh_lyapunov import MHLyapunov
from rotorwatch_lab.estimators.mhe import MHE, banded, tridiagonal
from rotorwatch_lab.maths import bounded
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

DT = 0.005
KINDS = {"lyapunov": Lyapunov, "mh_lyapunov": MHLyapunov, "mhe": MHE}


def hexa():
    return RateDynamics.of(airframes.paper("niermeyer-hexa"))


def table(count, seed=0, noise=1.0, loss=0.4, onset=0):
    """(u, y, valid) of a free rotation with swinging thrusts; rotor 1 loses `loss` at the row `onset`."""
    jax, system = load_jax(), hexa()
    rng = np.random.default_rng(seed)
    t = DT * np.arange(count)
    u = 0.36 + 0.02 * np.sin(np.outer(t, 3.0 + np.arange(6)) + np.arange(6))
    theta = np.zeros((count, 6))
    theta[onset:, 0] = loss
    # What makes up for the loss keeps the rates small.
    B = np.concatenate([system.B_tau, system.B_T[None]])
    wrench = np.concatenate([0.02 * np.sin(np.outer(t, [5.0, 7.0, 2.0])), np.full((count, 1), 19.6)], axis=1)
    u = u - (u * (1 - theta)) @ B.T @ np.linalg.pinv(B).T / 1.0 + wrench @ np.linalg.pinv(B).T
    walk = jax.jit(lambda u, th: jax.lax.scan(lambda x, r: (lambda z: (z, z))(system.f(x, *r, DT)), np.zeros(3), (u, th))[1])
    x = walk(u, theta)
    y = np.asarray(jax.vmap(system.h)(x, u, theta)) + noise * rng.standard_normal((count, 4)) * [0.01, 0.01, 0.01, 0.3]
    return u, y, np.ones((count, 4), bool)


@functools.cache
def program(estimator):
    """The compiled run of one estimator object: (outputs, carries) after each row."""
    jax = load_jax()

    def run(u, y, valid):
        return jax.lax.scan(lambda c, row: (lambda c, o: (c, (o, c)))(*estimator.step(c, *row)), estimator.init(), (u, y, valid))[1]

    return jax.jit(run)


def over(estimator, u, y, valid):
    return load_jax().tree.map(np.asarray, program(estimator)(u, y, valid))


# The law


def rates(law, x, theta_hat, theta, u):
    """d(w, l)/dt of the noise-free error at the measured state x, with the law's own gains per second, and w, f~ of the point."""
    system, dt = law.system, 1e-7
    at = law.terms(x, u, theta_hat, dt)

    def derivative(w, loss_error):
        e = -at.C @ w - at.D @ loss_error  # y - y_hat; rows of C and D do not mix
        gains = law.gains(at, u, dt)
        w_dot = at.G @ loss_error - law.rate * w
        return w_dot, (gains[1] @ e) / dt, -(at.D @ loss_error) * at.direct

    return derivative, system


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_lyapunov_function_falls_as_the_proof_says(seed):
    """dV/dt = -k_w w'Mw - k_f f~^2, to rounding: nothing but the two squares is left."""
    jax = load_jax()
    law = Lyapunov(hexa(), DT, bounds=(-0.2, 1.0), hold=0.0).law
    rng = np.random.default_rng(seed)
    x, w, error = rng.standard_normal(3), rng.standard_normal(3), 0.3 * rng.standard_normal(6)
    derivative, _ = rates(law, x, np.zeros(6), np.zeros(6), rng.uniform(0.2, 0.8, 6))
    w_dot, l_dot, f = derivative(w, error)

    def V(w, error):
        return 0.5 * w @ (law.M * w) + 0.5 * error @ error / law.gamma

    _, V_dot = jax.jvp(V, (w, error), (w_dot, l_dot))
    expected = -law.rate * w @ (law.M * w) - law.k_f * f @ f
    assert V_dot == pytest.approx(float(expected), rel=1e-9, abs=1e-12)
    _, wrong = jax.jvp(V, (w, error), (w_dot, 1.1 * l_dot))  # an adaptation a tenth too fast
    assert abs(wrong - expected) > 1e-6 * abs(expected)


@given(st.integers(0, 10_000))
@example(3820)  # a pure active-set method runs in circles here
@settings(max_examples=10, deadline=None)
def test_proximal_pull_only_lowers_the_lyapunov_function(seed):
    """l'(theta* - theta_hat) <= -|theta* - theta_hat|^2 whenever the window agrees with a truth inside the box."""
    rng = np.random.default_rng(seed)
    truth, estimate = rng.uniform(-0.02, 1.0, (2, 6))
    Phi = rng.standard_normal((rng.integers(1, 9), 6))
    A = Phi.T @ Phi
    wanted = np.asarray(bounded.quadratic(A + 0.7 * np.eye(6), A @ truth + 0.7 * estimate, -0.02, 1.0))
    moved = wanted - estimate
    assert (estimate - truth) @ moved <= -moved @ moved + 1e-9


def test_the_proximal_pull_scatters_as_its_spread_says():
    """The free minimum (A + anchor I)^-1 (Phi' z + anchor theta) of windows whose noise has the information A."""
    rng = np.random.default_rng(2)
    made = MHLyapunov(hexa(), DT)
    Phi, theta = rng.standard_normal((9, 6)), np.full(6, 0.2)
    A = Phi.T @ Phi
    target, pull, spread = map(np.asarray, made.pull_of(A, A @ theta, theta))
    to_target = np.linalg.solve(A + made.anchor * np.eye(6), Phi.T)  # of the noise in z
    np.testing.assert_allclose(spread, made.proximal_rate**2 * to_target @ to_target.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(target - pull @ theta, 0.0, atol=1e-9)  # nothing pulls at the truth


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_quadratic_programs_are_exact(seed):
    rng = np.random.default_rng(seed)
    A, b = rng.standard_normal((8, 6)), rng.standard_normal(8)
    found = bounded.quadratic(A.T @ A, A.T @ b, -0.1, 0.4)
    expected = lsq_linear(A, b, (-0.1, 0.4), method="bvls", tol=1e-15).x
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_quadratic_programs_of_a_flight_are_exact():
    """The windows of a flight whose losses may be -0.2, where many bounds are at work: an inexact solver is easily off by
    0.01 here."""
    low, high = -0.2, 1.0
    estimator = MHLyapunov(hexa(), DT, bounds=(low, high))
    _, carry = over(estimator, *table(600, loss=1.0, onset=100))
    rows = slice(20, None, 10)  # after every block
    H = carry.A[rows].sum(axis=1) + estimator.anchor * np.eye(6)
    g = carry.b[rows].sum(axis=1) + estimator.anchor * carry.state.theta[rows]
    assert np.linalg.cond(H).max() > 10.0
    found = np.asarray(load_jax().vmap(lambda H, g: bounded.quadratic(H, g, low, high))(H, g))
    root = np.linalg.cholesky(H)
    expected = [lsq_linear(L.T, np.linalg.solve(L, b), (low, high), method="bvls", tol=1e-15).x for L, b in zip(root, g, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert ((found == low) | (found == high)).any(axis=1).mean() > 0.1


def test_window_is_the_least_squares_of_its_blocks():
    """Without noise A theta = b holds for the true losses, to rounding; with an accelerometer off by a tenth it does not."""
    u, y, valid = table(400, noise=0.0)
    estimator = MHLyapunov(hexa(), DT, flush=False)
    for scale, most, least in ((1.0, 2e-4, 0.0), (1.1, np.inf, 1e-2)):
        _, carry = over(estimator, u, y * [1, 1, 1, scale], valid)
        A, b = carry.A[-1].sum(axis=0), carry.b[-1].sum(axis=0)
        miss = np.abs(A @ [0.4, 0, 0, 0, 0, 0] - b).max() / np.abs(b).max()
        assert least <= miss <= most, (scale, miss)


def test_a_window_of_one_block_holds_the_last_alone():
    """As long as a block, the window is the newest of what a long window holds."""
    u, y, valid = table(100)
    (_, one), (_, many) = (over(MHLyapunov(hexa(), DT, window_s=s, flush=False), u, y, valid) for s in (0.05, 1.0))
    assert one.A.shape[1] == 1 and many.A.shape[1] == 20
    np.testing.assert_allclose(one.A[-1, -1], many.A[-1, -1], rtol=1e-6)


def test_flush_empties_the_window_after_two_surprising_blocks():
    u, y, valid = table(500, onset=300)
    (_, with_flush), (_, without) = (over(MHLyapunov(hexa(), DT, flush=f), u, y, valid) for f in (True, False))
    used = (np.abs(with_flush.A).sum(axis=(2, 3)) > 0).sum(axis=1)
    assert used[299] == 20 and used[300:360].min() == 1
    assert (np.abs(without.A).sum(axis=(2, 3)) > 0).sum(axis=1)[300:].min() == 20


def test_a_rotor_that_hardly_turns_keeps_its_loss():
    u, y, valid = table(200)
    u[:, 3] = 0.05
    (held, _), (free, _) = (over(Lyapunov(hexa(), DT, hold=h), u, y, valid) for h in (0.22, 0.0))
    assert np.ptp(held.theta[:, 3]) == 0 and np.ptp(free.theta[:, 3]) > 1e-3


# The moving horizon


def test_block_tridiagonal_solver():
    rng = np.random.default_rng(0)
    K, n = 7, 4
    D = rng.standard_normal((K, n, n))
    D = D @ np.swapaxes(D, 1, 2) + 10 * np.eye(n)
    below, b = rng.standard_normal((K - 1, n, n)), rng.standard_normal((K, n))
    x = tridiagonal(D, below, b)
    np.testing.assert_allclose(banded(D, below, x), b, atol=1e-12)
    assert np.abs(banded(D, 1.01 * below, x) - b).max() > 1e-4


class Line:
    """A linear Gaussian plant: two states, a loss of each of two inputs, both states and a thrust measured."""

    name, n_x, n_u, n_theta, n_y = "line", 2, 2, 2, 3
    x0, P0 = np.zeros(2), np.eye(2)
    theta_names = ("loss_1", "loss_2")

    def f(self, x, u, theta, dt):
        A = np.array([[-1.0, 0.5], [0.2, -0.7]])
        return x + dt * (A @ x + np.array([[3.0, 1.0], [-1.0, 2.0]]) @ (u * (1 - theta)))

    def h(self, x, u, theta):
        return load_jax().numpy.concatenate([x, (u @ (1 - theta))[None]])

    def Q(self, dt):
        return 0.01 * dt * np.eye(2)

    def R(self, u):
        return np.array([1e-4, 1e-4, 1e-2])


def kalman(system, u, y, valid, dt, theta_sd, Q_s):
    """Textbook augmented Kalman filter in NumPy: means after each row."""
    jax = load_jax()
    s, P, means = np.zeros(4), np.diag([1.0, 1.0, theta_sd**2, theta_sd**2]), []
    for k in range(len(u)):

        def move(s, k=k):
            return jax.numpy.concatenate([system.f(s[:2], u[k], s[2:], dt), s[2:]])

        def look(s, k=k):
            return system.h(s[:2], u[k], s[2:])

        A = np.asarray(jax.jacfwd(move)(s))
        s, P = np.asarray(move(s)), A @ P @ A.T + Q_s
        H = np.asarray(jax.jacfwd(look)(s))[valid[k]]
        K = np.linalg.solve(H @ P @ H.T + np.diag(system.R(u[k])[valid[k]]), H @ P).T
        s, P = s + K @ (y[k] - np.asarray(look(s)))[valid[k]], P - K @ H @ P
        means.append(s)
    return np.array(means)


def line_table(count=60):
    system, rng = Line(), np.random.default_rng(3)
    u, x, y = 1.0 + 0.3 * rng.standard_normal((count, 2)), np.zeros(2), []
    for row in u:
        x = np.asarray(system.f(x, row, np.array([0.3, 0.0]), 0.05)) + 0.02 * rng.standard_normal(2)
        y.append(np.asarray(system.h(x, row, np.array([0.3, 0.0]))) + 0.01 * rng.standard_normal(3))
    valid = rng.random((count, 3)) < 0.8
    return system, u, np.array(y), valid


@pytest.mark.parametrize("nodes", [2, 6])
def test_without_bounds_it_is_the_kalman_filter(nodes):
    """On a linear plant the arrival cost loses nothing: any window gives the augmented Kalman filter."""
    system, u, y, valid = line_table()
    mhe = MHE(system, 0.05, nodes=nodes, node_s=0.05, bounds=(-1e9, 1e9), walk=0.1, hold=0.0)
    out, _ = over(mhe, u, np.where(valid, y, np.nan), valid)
    expected = kalman(system, u, y, valid, 0.05, mhe.theta_sd, np.asarray(mhe.Q(u[0], 0.05)))
    np.testing.assert_allclose(out.x, expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(out.theta, expected[:, 2:], atol=1e-9)


def test_a_wrong_arrival_cost_is_not_the_kalman_filter(monkeypatch):
    system, u, y, valid = line_table()
    leave = MHE.leave
    monkeypatch.setattr(MHE, "leave", lambda self, carry: (leave(self, carry)[0], 1.1 * leave(self, carry)[1]))
    mhe = MHE(system, 0.05, nodes=6, node_s=0.05, bounds=(-1e9, 1e9), walk=0.1, hold=0.0)
    out, _ = over(mhe, u, y, valid)
    expected = kalman(system, u, y, valid, 0.05, mhe.theta_sd, np.asarray(mhe.Q(u[0], 0.05)))
    assert np.abs(out.theta - expected[:, 2:]).max() > 1e-6


def test_losses_stay_in_their_box():
    u, y, valid = table(200, loss=1.0)
    for kind, options in ((MHLyapunov, {}), (MHE, {"nodes": 4})):
        out, _ = over(kind(hexa(), DT, bounds=(-0.01, 0.4), **options), u, y, valid)
        assert out.theta.min() >= -0.01, kind.name
        assert 0.35 < out.theta.max() <= 0.4, kind.name


# All three


@pytest.fixture(scope="module", params=KINDS)
def method(request):
    estimator = KINDS[request.param](hexa(), DT)
    u, y, valid = table(240)
    valid[100:130] = False
    valid[150:, 1] = False
    out, carries = over(estimator, u, np.where(valid, y, np.nan), valid)
    return SimpleNamespace(estimator=estimator, table=(u, y, valid), out=out, carries=carries)


@pytest.mark.thorough(keep=1)
def test_the_fault_is_found(method):
    out, _ = over(method.estimator, *table(600))
    assert out.theta[-1].argmax() == 0 and out.theta[-1, 0] > 0.3


def test_covariances_are_symmetric_and_not_negative(method):
    for P in (method.out.x_cov, method.out.theta_cov, method.out.innovation_cov):
        np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
        assert (np.linalg.eigvalsh(P).min(axis=1) > -1e-12).all()


def test_gaps_teach_nothing(method):
    out = method.out
    assert all(np.isfinite(leaf).all() for leaf in out)
    assert (out.status[100:130] == 2).all() and (out.status[:100] == 0).all()
    assert (out.innovation[100:130] == 0).all() and (out.innovation[150:, 1] == 0).all()
    variance = np.diagonal(out.theta_cov, axis1=1, axis2=2)[99:130]
    assert (np.diff(variance, axis=0) >= 0).all()


def test_it_runs_with_its_plant_built_inside_the_program(method):
    """Traced parameters, four and eight rotors, in hover thrusts of one rotor."""
    jax = load_jax()
    for name in ("ardupilot-quad-x", "ardupilot-octa-x"):
        B = airframes.named(name).effectiveness()
        n = B.shape[1]

        def last(J, B, n=n):
            estimator = type(method.estimator)(RateDynamics(J, B[:3], B[3], n / 9.80665), 0.02)
            rows = (np.ones((12, n)), np.tile([0, 0, 0, -9.80665], (12, 1)), np.ones((12, 4), bool))
            return jax.lax.scan(lambda c, r: estimator.step(c, *r), estimator.init(), rows)[1].theta[-1]

        np.testing.assert_allclose(jax.jit(last)(np.diag([0.012, 0.012, 0.3]), B), 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "kind, options, words",
    [
        (Lyapunov, {"rate": -1.0}, "rate must be above zero"),
        (Lyapunov, {"bandwidth": 1e4}, "bandwidth times dt"),
        (Lyapunov, {"bounds": (0.1, 1.0)}, "bounds must be"),
        (Lyapunov, {"u_nominal": np.ones(3)}, "u_nominal must have the shape"),
        (MHLyapunov, {"pull": "push"}, "gradient, proximal"),
        (MHLyapunov, {"window_s": 0.01}, "at least one block"),
        (MHE, {"nodes": 1}, "nodes must be a whole number"),
        (MHE, {"iterations": 1.5}, "iterations must be a whole number"),
        (MHE, {"walk": 0.0}, "walk must be above zero"),
    ],
)
def test_bad_configuration_is_one_sentence(kind, options, words):
    with pytest.raises(ConfigError, match=words):
        kind(hexa(), DT, **options)


def test_the_law_needs_every_state_measured():
    class Blind(RateDynamics):
        name = "blind"

        def h(self, x, u, theta):
            return super().h(x * np.array([1.0, 1.0, 0.0]), u, theta)

    table = hexa()
    blind = Blind(table.J, table.B_tau, table.B_T, table.m)
    for kind in (Lyapunov, MHLyapunov):
        with pytest.raises(ConfigError, match="not defined for the plant blind: it needs every state measured"):
            kind(blind, DT)
    MHE(blind, DT)  # this one does not
