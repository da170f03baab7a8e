"""The intermediate observer: its identities, its poles, its inequality, and that it runs on plants of all kinds."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators import intermediate
from rotorwatch_lab.estimators.intermediate import Intermediate
from rotorwatch_lab.maths import intermediate_design as design
from rotorwatch_lab.systems.linear_hover import LinearHover
from rotorwatch_lab.systems.rate_dynamics import RateDynamics
from rotorwatch_lab.systems.rigid_body import RigidBody

jax = load_jax()
DT = 0.01
F450 = LinearHover.of(airframes.paper("f450"))


class Matrices(NamedTuple):
    """dz/dt = F z + Gu u + Gy y + g, z = [xhat; tauhat]; fhat = out z."""

    F: np.ndarray
    Gu: np.ndarray
    Gy: np.ndarray
    g: np.ndarray
    out: np.ndarray


def matrices(A, B, C, E, G, L, alpha) -> Matrices:
    """The observer of eqs. (11)-(14) as one linear system."""
    S = alpha * E.T
    F = np.block([[A + E @ S - L @ C, E], [-S @ A - S @ E @ S, -S @ E]])
    Gu, Gy = np.vstack([B, -S @ B]), np.vstack([L, np.zeros((E.shape[1], C.shape[0]))])
    return Matrices(F, Gu, Gy, np.concatenate([G, -S @ G]), np.hstack([S, np.eye(E.shape[1])]))


def feasible(alpha, epsilon, lp, lv) -> bool:
    """Whether L = diag(lp I, lv I) with mu = 1 / alpha^2 satisfies the inequality on double integrators, in closed form.

    mu = 1/alpha^2 makes Sigma_12 vanish, so Sigma_22 < 0 iff epsilon > (1 + alpha) / (2 alpha), and Sigma_11 < 0 iff
    lv > alpha + 1 / (2 epsilon) and 4 lp (lv - alpha - 1 / (2 epsilon)) > 1.
    """
    rest = lv - alpha - 0.5 / epsilon
    return bool(epsilon > 0.5 * (1 + alpha) / alpha and rest > 0 and 4 * lp * rest > 1)


def flown(system, theta, u, dt=DT):
    """Noise-free measurements (T, n_y) of the plant itself under u (T, n_u) from its x0, losses theta (T, n) or (n,)."""
    theta = np.broadcast_to(theta, (len(u), system.n_theta))

    def step(x, row):
        x = system.f(x, row[0], row[1], dt)
        return x, system.h(x, *row)

    return np.asarray(jax.jit(lambda u, theta: jax.lax.scan(step, np.asarray(system.x0, float), (u, theta))[1])(u, theta))


def moving(system, T, seed=0, share=0.1):
    """Commands around hover that excite every rotor slowly, (T, n)."""
    rng = np.random.default_rng(seed)
    n = system.n_u
    phase = rng.uniform(0, 2 * np.pi, n)
    return system.hover * (1.0 + share * np.sin(np.linspace(0, 0.05 * T, T)[:, None] * rng.uniform(0.5, 3, n) + phase))


# The paper's form and the proportional-integral form.


def both_forms(drop=0.0, T=400):
    """fhat of the paper's (11)-(14) and of a PI observer, both by Euler's method, on random data; drop: a planted error."""
    rng = np.random.default_rng(1)
    A, C, E = design.double_integrators()
    B, G, L, alpha = E, np.append(np.zeros(7), -9.81), np.diag([10.0] * 4 + [20.0] * 4), 1.7
    m = matrices(A, B, C, E, G, L, alpha)
    Gu = m.Gu.copy()
    Gu[8:] *= 1.0 - drop
    z, x, f, out = np.zeros(12), np.zeros(8), np.zeros(4), []
    for u, y in zip(rng.normal(0, 3, (T, 4)), rng.normal(0, 1, (T, 8)), strict=True):
        e = y - C @ x
        x, f = x + DT * (A @ x + B @ u + E @ f + G + L @ e), f + DT * alpha * E.T @ L @ e
        z = z + DT * (m.F @ z + Gu @ u + m.Gy @ y + m.g)
        out.append((m.out @ z, f))
    return np.array(out).transpose(1, 0, 2)


def test_the_papers_form_is_a_proportional_integral_observer():
    paper, pi = both_forms()
    assert np.abs(paper - pi).max() < 1e-13 * np.abs(pi).max()
    paper, pi = both_forms(drop=1e-3)
    assert np.abs(paper - pi).max() > 1e-5 * np.abs(pi).max()


def test_euler_steps_are_the_proportional_integral_observer():
    """The estimator against a few lines of NumPy, on noise."""
    rng = np.random.default_rng(2)
    u, y = moving(F450, 60), rng.normal(0, 0.1, (60, 8))
    carry, got = run(Intermediate(F450, DT, alpha=2.0, discretisation="euler"), u, y)
    x, f = y[0].copy(), np.zeros(4)  # the first measurement sets the states
    for k in range(1, 60):
        acceleration = F450.B @ u[k] + np.array([0, 0, 0, F450.gravity]) + f
        ahead = np.concatenate([x[:4] + DT * x[4:] + 0.5 * DT**2 * acceleration, x[4:] + DT * acceleration])
        e = y[k] - ahead
        x, f = ahead + DT * np.repeat([10.0, 20.0], 4) * e, f + DT * 2.0 * 20.0 * e[4:]
        np.testing.assert_allclose(got.x[k], x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(got.innovation[k], e, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(carry.fault[4:8], f, rtol=1e-9, atol=1e-10)


# Poles.


def poles(gains, lp, lv, alpha, dt):
    """Eigenvalues of (position, velocity and fault)'s errors after one step."""
    kp, k1, k2 = (float(g) for g in gains(lp, lv, alpha, dt))
    A, K = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[k1], [k2]])
    return 1.0 - kp, np.linalg.eigvals((np.eye(2) - K @ np.array([[1.0, 0.0]])) @ A)


rate = st.floats(0.1, 50.0)


@settings(max_examples=trials(60), deadline=None)
@given(lp=rate, lv=rate, alpha=rate, dt=st.floats(1e-4, 10.0))
def test_exact_steps_have_the_continuous_poles_and_are_stable_at_every_rate(lp, lv, alpha, dt):
    first, pair = poles(design.exact_gains, lp, lv, alpha, dt)
    wanted = np.exp(np.roots([1.0, lv, alpha * lv]) * dt)
    assert first == pytest.approx(np.exp(-lp * dt), abs=1e-12)
    # Coefficients, not roots: a double root moves by the square root of rounding.
    np.testing.assert_allclose(np.poly(pair), np.poly(wanted).real, atol=1e-11)
    assert np.abs(pair).max() < 1.0


def test_euler_has_a_limit_and_says_so():
    """lv dt (1 + alpha dt / 2) < 2: a little below lv dt = 2."""
    for alpha, lv in ((1.0, 20.0), (5.0, 20.0), (3.0, 8.0)):
        limit = (np.sqrt(1.0 + 4.0 * alpha / lv) - 1.0) / alpha
        assert lv * limit * (1.0 + 0.5 * alpha * limit) == pytest.approx(2.0)
        assert np.abs(poles(design.euler_gains, 10, lv, alpha, 0.999 * limit)[1]).max() < 1.0
        assert np.abs(poles(design.euler_gains, 10, lv, alpha, 1.001 * limit)[1]).max() > 1.0
    with pytest.raises(ConfigError, match=r"unstable for steps of 0\.1 s"):
        Intermediate(F450, 0.1, discretisation="euler")


@pytest.mark.parametrize("alpha", [1.0, 5.0, 12.0])
def test_a_channel_is_a_second_order_filter_of_its_fault(alpha):
    """alpha lv / (s^2 + lv s + alpha lv): two real poles, a double one, a complex pair; sampled finely."""
    dt, T = 1e-3, 1500
    B = np.array([[0.0], [0.0], [0.0], [-2.0]])
    one = LinearHover(B, gravity=9.81)
    u = np.full((T, 1), one.hover[0])
    theta = 0.2
    y = flown(one, theta, u, dt)
    estimator = Intermediate(one, dt, alpha=alpha)

    def step(carry, row):
        carry, _ = estimator.step(carry, *row)
        return carry, carry.fault[7]

    fault = np.asarray(jax.lax.scan(step, estimator.init(), (u[1:], y[1:], np.ones((T - 1, 8), bool)))[1])
    t = dt * np.arange(T - 1)
    s = np.roots([1.0, 20.0, 20.0 * alpha]).astype(complex) + np.array([1e-6, -1e-6])
    left = (s[0] * np.exp(s[1] * t) - s[1] * np.exp(s[0] * t)) / (s[0] - s[1])
    np.testing.assert_allclose(fault / (2.0 * theta * u[0, 0]), 1.0 - left.real, atol=0.01)


def test_variances_of_a_channel_are_those_of_its_recursion():
    """lag <- (1 - k1)(lag + dt fault + noise), fault <- fault - k2 (lag + dt fault + noise): against the 2x2 covariance equation."""
    k1, k2, dt, q, drift = 0.3, 1.7, 0.25, 0.02, 0.003
    A = np.array([[1.0 - k1, (1.0 - k1) * dt], [-k2, 1.0 - k2 * dt]])
    enters = np.array([1.0 - k1, -k2])
    P = np.array([[0.5, 0.2], [0.2, 0.8]])
    want = A @ P @ A.T + q * np.outer(enters, enters) + np.diag([0.0, drift])
    found = intermediate._block(np.array([P[0, 0], P[0, 1], P[1, 1]]), k1, k2, dt, q, drift)
    np.testing.assert_allclose(found, [want[0, 0], want[0, 1], want[1, 1]], rtol=1e-12)


def test_rates_place_a_double_pole():
    alpha, lv = design.rates(0.4, 0.1)
    assert lv == pytest.approx(4 * alpha)
    assert (1 + 0.5 * lv * 0.4) * np.exp(-0.5 * lv * 0.4) == pytest.approx(0.1)


# Matched regressors.


def regressor_error(monkeypatch=None, system=F450, T=600):
    """Largest difference between the fault and filtered regressors times theta, through gaps, relative to the fault."""
    theta = np.zeros(system.n_theta)
    theta[1], theta[-1] = 0.25, 0.1
    u = moving(system, T)
    y = flown(system, theta, u)
    valid = np.ones(y.shape, bool)
    valid[100:130], valid[200:260, 4:] = False, False
    estimator = Intermediate(system, DT, alpha=3.0, allocation="least_squares")

    def step(carry, row):
        carry, _ = estimator.step(carry, *row)
        return carry, (carry.fault, carry.regressor.value @ theta)

    start = estimator.init()._replace(started=jax.numpy.array(True))  # a filter at rest: losses are there from the start
    start = start._replace(known=jax.numpy.ones_like(start.known))
    fault, wanted = jax.tree.map(np.asarray, jax.lax.scan(step, start, (u, y, valid))[1])
    return np.abs(fault - wanted).max() / np.abs(fault).max()


def test_faults_are_filtered_regressors_times_losses(monkeypatch):
    """Exactly, while commands move and measurements are missing; not when the two filters differ."""
    assert regressor_error() < 1e-9
    monkeypatch.setattr(intermediate.linearise, "transition", _slower(intermediate.linearise.transition))
    assert regressor_error() > 1e-3


def _slower(transition):
    """A planted error: regressors of another time step."""
    return lambda system, x, u, theta, dt: transition(system, x, u, theta, dt)._replace(
        by_theta=transition(system, x, u, theta, 0.95 * dt).by_theta
    )


def test_filtered_commands_keep_losses_still_in_a_manoeuvre():
    theta = np.array([0.0, 0.0, 0.2, 0.0])
    u = moving(F450, 1500, share=0.2)
    y = flown(F450, theta, u)
    error = {}
    for matched in (True, False):
        _, got = run(Intermediate(F450, DT, alpha=5.0, matched=matched), u, y)
        error[matched] = np.abs(got.theta[500:] - theta).max()
    assert error[True] < 1e-6 and error[False] > 0.01


# The yaw gain.


def test_yaw_gain_divides_out_in_hover_and_not_in_a_turn():
    theta = np.array([0.0, 0.0, 0.2, 0.0])
    B = np.linalg.inv(F450.B)
    hover = np.tile((B @ np.array([0, 0, 0, -9.81])) / (1 - theta), (1200, 1))
    _, plain = run(Intermediate(F450, DT, alpha=5.0), hover, flown(F450, theta, hover))
    _, scaled = run(Intermediate(F450, DT, alpha=5.0, yaw_gain=10.0), hover, flown(F450, theta, hover))
    np.testing.assert_allclose(plain.theta[-1], theta, atol=1e-9)
    np.testing.assert_allclose(scaled.theta[-1], theta, atol=1e-9)
    turn = hover + 3.0 * np.sin(np.linspace(0, 20, 1200))[:, None] * np.array([1, 1, -1, -1])
    _, plain = run(Intermediate(F450, DT, alpha=5.0), turn, flown(F450, theta, turn))
    _, scaled = run(Intermediate(F450, DT, alpha=5.0, yaw_gain=10.0), turn, flown(F450, theta, turn))
    assert np.abs(plain.theta[600:] - theta).max() < 1e-6 < 1e-3 < np.abs(scaled.theta[600:] - theta).max()


# Covariances.


def test_losses_scatter_as_their_covariance_says():
    """Measurement noise only: 64 runs of noise against the variance that the observer states."""
    u = np.tile(F450.hover, (300, 1))
    calm = LinearHover(F450.B, gravity=F450.gravity, walk=(0.0,) * 4)
    estimator = Intermediate(calm, DT, alpha=5.0, drift_sd=1e-9, loss_sd=1e-9)
    y = np.random.default_rng(3).standard_normal((64, 300, 8)) * calm.measured_sd
    valid = np.ones(8, bool)

    def one(y):
        return jax.lax.scan(lambda c, row: estimator.step(c, row[0], row[1], valid), estimator.init(), (u, y))[1]

    got = jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(y))
    said = np.diagonal(got.theta_cov[0, -1])
    assert np.all(np.abs(got.theta[:, 200:].var(axis=(0, 1)) / said - 1.0) < 0.25)
    x = got.x[:, -1].var(axis=0) / np.diagonal(got.x_cov[0, -1])
    assert np.all((x > 0.5) & (x < 1.7))


def test_innovations_scatter_as_their_covariance_says_where_measurements_feel_losses():
    """Of an accelerometer the innovation has the noise of the sample and that of the filtered fault, which adds to it: more than half
    as much, with a filter so fast."""
    hexa = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    calm = RateDynamics(hexa.J, hexa.B_tau, hexa.B_T, hexa.m, torque_sd=np.full(3, 1e-9))
    estimator = Intermediate(calm, 0.05, alpha=20.0, velocity_rate=80.0, drift_sd=1e-9, loss_sd=1e-9)
    u = np.full((300, 6), calm.m * 9.80665 / calm.B_T.sum())
    sd = np.sqrt(np.asarray(calm.R(u[0])))
    y = flown(calm, np.zeros(6), u, 0.05) + sd * np.random.default_rng(4).standard_normal((32, 300, 4))
    valid = np.ones(4, bool)

    def one(y):
        return jax.lax.scan(lambda c, row: estimator.step(c, row[0], row[1], valid), estimator.init(), (u, y))[1]

    got = jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(y))
    said = np.diagonal(got.innovation_cov[0, -1])
    np.testing.assert_allclose(got.innovation[:, 100:].var(axis=(0, 1)) / said, 1.0, atol=0.1)
    assert said[3] > 1.3 * sd[3] ** 2  # the fault's part counts


# The matrix inequality.


@settings(max_examples=trials(80), deadline=None)
@given(alpha=st.floats(0.05, 10.0), epsilon=st.floats(0.01, 100.0), lp=st.floats(0.01, 40.0), lv=st.floats(0.01, 40.0))
def test_closed_form_says_what_eigenvalues_say(alpha, epsilon, lp, lv):
    A, C, E = design.double_integrators(1)
    values = np.linalg.eigvalsh(design.sigma(A, C, E, E, np.diag([lp, lv]), alpha, epsilon, 1 / alpha**2))
    if np.abs(values.max()) > 1e-9 * np.abs(values).max():
        assert feasible(alpha, epsilon, lp, lv) == (values.max() < 0)


def test_printed_epsilon_is_infeasible_and_its_inverse_is_not():
    A, C, E = design.double_integrators()
    with pytest.raises(ConfigError, match=r"no solution for alpha = 1, epsilon = 0.02: Sigma_22 has the eigenvalue 98 mu"):
        design.synthesize(A, C, E, E, 1.0, 0.02)
    found = design.synthesize(A, C, E, E, 1.0, 50.0)
    assert found.largest < 0 and found.mu > 0
    again = design.sigma(A, C, E, E, found.L, 1.0, 50.0, found.mu)
    assert np.linalg.eigvalsh(again).max() == pytest.approx(found.largest)


def test_a_solver_that_errs_is_not_believed():
    A, C, E = design.double_integrators()
    good = np.diag([10.0] * 4 + [20.0] * 4)
    assert design.checked(A, C, E, E, 1.0, 50.0, good, 1.0).largest < -1
    with pytest.raises(ConfigError, match="do not satisfy the matrix inequality"):
        design.checked(A, C, E, E, 1.0, 50.0, 0.04 * good, 1.0)
    with pytest.raises(ConfigError, match="do not satisfy the matrix inequality"):
        design.checked(A, C, E, E, 1.0, 50.0, good, -1.0)


def ranks(A, C, E, points):
    """Rank of the pencil of eq. (8) at each of some numbers, as it is written."""
    n, q = E.shape
    none = np.zeros((len(C), q))
    return [np.linalg.matrix_rank(np.block([[A - z * np.eye(n), E], [C, none]]), tol=1e-7) for z in points]


def test_rank_test_on_the_hovering_quadrotor():
    """Assumption 4 holds with all states or the pose; with rates alone constants of the pose hide, with angles alone the lift's fault."""
    A, C, E = design.double_integrators()
    points = [0.0, 1.0, 2.0 + 3.0j, 1e-3]
    for some, holds in ((C, True), (C[:4], True), (C[4:], False), (C[:3], False)):
        assert design.rank_test(A, some, E).holds is holds
        assert (min(ranks(A, some, E, points)) == 12) == holds
    np.testing.assert_allclose(design.rank_test(A, C[4:], E).zeros, 0.0, atol=1e-12)
    assert design.rank_test(A, C[:3], E).everywhere and not design.rank_test(A, C[4:], E).everywhere


@settings(max_examples=trials(25), deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([-2.0, -0.5, 0.7, 3.0]))
def test_rank_test_finds_the_zero_that_was_built_in(seed, zero):
    """Any plant with y = C x, one fault and a zero where it was put: c (z I - A)^-1 e = 0."""
    rng = np.random.default_rng(seed)
    A, e = rng.standard_normal((4, 4)), rng.standard_normal((4, 1))
    x = np.linalg.solve(zero * np.eye(4) - A, e)[:, 0]
    c = rng.standard_normal(4)
    c = (c - x * (c @ x) / (x @ x))[None]
    found = design.rank_test(A, c, e)
    assert ranks(A, c, e, [zero]) == [4]  # one short
    assert np.isclose(found.zeros, zero, atol=1e-5).any() == (zero > 0)
    if zero > 0:
        assert not found.holds
    assert all(rank == 4 for rank in ranks(A, c, e, found.zeros))


def test_table_1s_procedure_solves_the_inequality_with_the_least_gain():
    A, C, E = design.double_integrators(1)
    for mu in (1.0, 0.05):
        alpha, found = design.table_1(A, C, E, E, mu, 50.0)
        assert found.mu == pytest.approx(mu)
        assert np.linalg.eigvalsh(design.sigma(A, C, E, E, found.L, alpha, 50.0, mu)).max() < 0
        for other in (0.7 * alpha, 1.4 * alpha):
            assert np.linalg.norm(design.synthesize(A, C, E, E, other, 50.0, mu=mu).L) > np.linalg.norm(found.L)
    with pytest.raises(ConfigError, match="no solution for epsilon = 0\\.02, whatever alpha, L and mu are"):
        design.table_1(A, C, E, E, 0.1, 0.02)


# Plants.


def test_f450_has_the_papers_matrix():
    """Eq. (3), whose sign table is orthogonal; thrust lifts, so its row turns over in NED. Hover at 500.65 counts."""
    signs = np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]])
    np.testing.assert_array_equal(signs @ signs.T, 4 * np.eye(4))
    size = np.array([0.0087 * 0.225 * np.sqrt(2) / 2 / 0.0035] * 2 + [0.0055e-2 / 0.0055, -0.0087 / 1.776])
    np.testing.assert_allclose(F450.B, size[:, None] * signs, rtol=1e-12)
    np.testing.assert_allclose(F450.hover, 500.65, atol=0.005)


@pytest.mark.parametrize("rotors", [4, 8])
def test_on_rate_dynamics_it_finds_the_rotor(rotors):
    """Rates are single integrators, and the accelerometer feels thrust directly: both are filtered alike."""
    azimuth = np.pi * (2 * np.arange(rotors) + 1) / rotors
    B = np.stack([-np.sin(azimuth), np.cos(azimuth), 0.1 * (-1.0) ** np.arange(rotors)])
    system = RateDynamics(np.diag([0.02, 0.02, 0.04]), B, np.ones(rotors), rotors / 9.80665, torque_sd=np.full(3, 1e-3))
    theta = np.where(np.arange(rotors) == 2, 0.3, 0.0)
    hover = np.ones(rotors)
    hover[2] = 1 / 0.7
    u = hover * (1.0 + 1e-3 * np.sin(0.1 * np.arange(1500))[:, None] * np.cos(np.arange(rotors)))
    _, got = run(Intermediate(system, DT, alpha=5.0), u, flown(system, theta, u))
    np.testing.assert_allclose(got.theta[-1], theta, atol=1e-5)
    assert (got.status == 0).all()


@pytest.mark.thorough
def test_where_rates_are_not_measured_riccati_gains_are_taken():
    """Pose only: faults are observable through two integrations."""
    body = RigidBody.of(airframes.paper("f450"))
    theta = np.array([0.0, 0.1, 0.0, 0.0])
    hover = np.full(4, body.m * body.gravity / np.sum(body.B_T))
    u = np.tile(hover / (1 - theta), (1200, 1))
    estimator = Intermediate(body, DT)
    assert estimator.steady is not None
    _, got = run(estimator, u, flown(body, theta, u))
    np.testing.assert_allclose(got.theta[-1], theta, atol=1e-3)


def test_built_inside_a_compiled_program():
    hexa = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    u = np.full((40, 6), 0.36)
    y = flown(hexa, 0.1 * np.eye(6)[3], u)
    valid = np.ones((40, 4), bool)

    def last(estimator):
        return jax.lax.scan(lambda c, row: estimator.step(c, *row), estimator.init(), (u, y, valid))[1].theta[-1]

    traced = jax.jit(lambda J, B, alpha: last(Intermediate(RateDynamics(J, B, hexa.B_T, hexa.m), DT, alpha=alpha)))
    np.testing.assert_allclose(traced(hexa.J, hexa.B_tau, 5.0), last(Intermediate(hexa, DT, alpha=5.0)), atol=1e-9)


# What is wrong is said in a sentence.


class Deaf(LinearHover):
    """Only attitude and height rates of other things than what the rotors drive: nothing tells of a fault."""

    n_y = 1
    y_names, y_units = ("roll",), ("rad",)

    def h(self, x, u, theta):
        return x[:1]

    def R(self, u):
        return np.array([1e-6])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Intermediate(F450, 0.0), "dt must be above zero"),
        (lambda: Intermediate(F450, DT, alpha=-1.0), "alpha must be above zero"),
        (lambda: Intermediate(F450, DT, allocation="magic"), "allocation must be one of auto, least_squares, sparse, temporal"),
        (lambda: Intermediate(F450, DT, discretisation="tustin"), "discretisation must be one of exact, euler"),
        (lambda: Intermediate(object(), DT), "The intermediate observer is not defined for the plant object: it needs f"),
        (lambda: Intermediate(Deaf(F450.B), DT), "not observable from them"),
        (lambda: LinearHover(np.ones((3, 4))), "B must have the shape"),
        (lambda: LinearHover(F450.B, measured_sd=(0.0,) * 8), "measured_sd must be above zero"),
        (lambda: design.rates(-1.0), "settling_time_s must be above zero"),
    ],
)
def test_wrong_configuration(make, said):
    with pytest.raises(ConfigError, match=said):
        make()


@pytest.mark.thorough
def test_yaw_gain_needs_a_yaw_rate():
    class Nameless(LinearHover):
        x_names = tuple("abcdefgh")

    with pytest.raises(ConfigError, match="yaw_gain is for plants with a yaw rate"):
        Intermediate(Nameless(F450.B), DT, yaw_gain=2.0)
