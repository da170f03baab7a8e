"""Augmented and adaptive Kalman filters, the exogenous one among them: laws, and that planted errors break them."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators.adaptive_ekf import AdaptiveEKF
from rotorwatch_lab.estimators.akf import AKF
from rotorwatch_lab.estimators.axkf import AXKF
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.maths import adaptive_kalman, linearise
from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

jax = load_jax()
jnp = jax.numpy
EXACT = 1e-12
DT, ROWS = 0.1, 40
ADAPTIVE = (AKF, AdaptiveEKF, AXKF)
each_adaptive = pytest.mark.parametrize("method", ADAPTIVE, ids=lambda m: m.name)
each_method = pytest.mark.parametrize("method", (EKF, *ADAPTIVE), ids=lambda m: m.name)


class Linear:
    """x+ = A x + B diag(u) (1 - theta), y = C x + E diag(u) (1 - theta): losses are felt in the measurement as well."""

    name = "linear"
    n_x, n_u, n_theta, n_y = 3, 2, 2, 2
    A = np.array([[0.95, 0.1, 0.0], [-0.1, 0.9, 0.2], [0.0, 0.05, 0.98]])
    B = np.array([[0.3, -0.1], [0.2, 0.4], [-0.1, 0.2]])
    C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.2]])
    E = np.array([[0.1, 0.0], [0.05, -0.2]])
    x0 = np.array([0.3, -0.2, 0.1])
    P0 = np.diag([0.5, 0.2, 0.1])

    def f(self, x, u, theta, dt):
        return self.A @ x + self.B @ (u * (1.0 - theta))

    def h(self, x, u, theta):
        return self.C @ x + self.E @ (u * (1.0 - theta))

    def Q(self, dt):
        return jnp.asarray(0.01 * dt * np.diag([1.0, 2.0, 0.5]))

    def R(self, u):
        return jnp.array([0.02, 0.05])


@pytest.fixture(scope="module")
def table():
    """u, y, valid of a noisy run with losses and gaps."""
    plant, rng = Linear(), np.random.default_rng(5)
    u, x, y = 1.0 + rng.standard_normal((ROWS, 2)), np.zeros(3), np.empty((ROWS, 2))
    theta = np.array([0.3, 0.1])
    for k in range(ROWS):
        x = plant.A @ x + plant.B @ (u[k] * (1 - theta)) + 0.03 * rng.standard_normal(3)
        y[k] = plant.C @ x + plant.E @ (u[k] * (1 - theta)) + 0.15 * rng.standard_normal(2)
    valid = rng.random((ROWS, 2)) > 0.2
    valid[10:13] = False
    y[~valid] = np.nan
    return u, y, valid


def augmented(plant, u, y, valid, theta_var, walk):
    """Textbook Kalman filter of [x; theta] with dense inverses: (s (T, 5), P (T, 5, 5))."""
    s, P = np.concatenate([plant.x0, np.zeros(2)]), np.zeros((5, 5))
    P[:3, :3], P[3:, 3:] = plant.P0, theta_var * np.eye(2)
    Q = np.zeros((5, 5))
    Q[:3, :3], Q[3:, 3:] = plant.Q(DT), walk * DT * np.eye(2)
    out = []
    for k in range(len(u)):
        A, H = np.eye(5), np.hstack([plant.C, -plant.E * u[k]])
        A[:3, :3], A[:3, 3:] = plant.A, -plant.B * u[k]
        s, P = A @ s + np.concatenate([plant.B @ u[k], np.zeros(2)]), A @ P @ A.T + Q
        H, R = H[valid[k]], np.diag(np.asarray(plant.R(u[k]))[valid[k]])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        s = s + K @ (y[k] - plant.E @ u[k])[valid[k]] - K @ H @ s
        P = (np.eye(5) - K @ H) @ P
        out.append((s, P))
    return tuple(np.stack(column) for column in zip(*out, strict=True))


def weighted_least_squares(plant, u, y, valid, theta_var, forgetting):
    """(theta, covariance) by batch: innovations of Kalman filters that are given theta are affine in it."""

    def innovations(theta):
        x, P, rows = plant.x0, plant.P0, []
        for k in range(len(u)):
            force = u[k] * (1 - theta)
            x, P = plant.A @ x + plant.B @ force, plant.A @ P @ plant.A.T + np.asarray(plant.Q(DT))
            C, R = plant.C[valid[k]], np.diag(np.asarray(plant.R(u[k]))[valid[k]])
            e, S = (y[k] - plant.E @ force)[valid[k]] - C @ x, C @ P @ C.T + R
            K = P @ C.T @ np.linalg.inv(S)
            x, P = x + K @ e, P - K @ C @ P
            rows.append(np.linalg.solve(np.linalg.cholesky(S), e) * forgetting ** (0.5 * (len(u) - 1 - k)))
        return np.concatenate(rows)

    e = innovations(np.zeros(2))
    slope = np.stack([e - innovations(one) for one in np.eye(2)], axis=1)
    information = slope.T @ slope + forgetting ** len(u) / theta_var * np.eye(2)
    return np.linalg.solve(information, slope.T @ e), np.linalg.inv(information)


def from_augmented(method, table, **tuning):
    """Largest difference from the augmented Kalman filter, over states, losses and covariances."""
    plant = Linear()
    walk = tuning.get("theta_walk", 0.0)
    out = run(method(plant, DT, theta_var=0.3, **tuning), *table)[1]
    s, P = augmented(plant, *table, 0.3, walk)
    found = (out.x, out.theta, out.x_cov, out.theta_cov)
    wanted = (s[:, :3], s[:, 3:], P[:, :3, :3], P[:, 3:, 3:])
    return max(np.abs(a - b).max() for a, b in zip(found, wanted, strict=True))


def from_least_squares(method, table, memory_s=1.0):
    """Largest difference from the batch, at the end of the table."""
    out = run(method(Linear(), DT, theta_var=0.3, memory_s=memory_s, s_max=None), *table)[1]
    theta, cov = weighted_least_squares(Linear(), *table, 0.3, np.exp(-DT / memory_s))
    return max(np.abs(out.theta[-1] - theta).max(), np.abs(out.theta_cov[-1] - cov).max())


def test_ekf_is_the_augmented_kalman_filter(table):
    assert from_augmented(EKF, table, theta_walk=0.02) < EXACT


@each_adaptive
def test_without_forgetting_it_is_the_augmented_kalman_filter_of_constant_losses(method, table):
    assert from_augmented(method, table, memory_s=None) < EXACT


@each_adaptive
def test_with_forgetting_losses_are_weighted_least_squares(method, table):
    assert from_least_squares(method, table) < EXACT


def no_feedthrough(plain):
    return lambda *a, **k: plain(*a, **k)._replace(by_theta=np.zeros((2, 2)))


def half_a_loss(plain):
    return lambda *a, **k: (lambda out: out._replace(by_theta=0.5 * out.by_theta))(plain(*a, **k))


def twice_the_noise(plain):
    return lambda *a, **k: plain(*a[:6], 2.0 * a[6], *a[7:], **k)


def forgets_the_state_too(plain):
    def step(state, *a, **k):
        return plain(state._replace(P=state.P / 0.99), *a, **k)

    return step


def forgets_twice(plain):
    return lambda S, memory, dt: plain(plain(S, memory, dt), memory._replace(seconds=1.0), dt)


LAWS = {
    "ekf": lambda table: from_augmented(EKF, table, theta_walk=0.02),
    "constant": lambda table: from_augmented(AdaptiveEKF, table, memory_s=None),
    "weighted": lambda table: from_least_squares(AdaptiveEKF, table),
}


@pytest.mark.parametrize(
    ("module", "function", "error", "law"),
    [
        (linearise, "measurement", no_feedthrough, "ekf"),
        (linearise, "transition", half_a_loss, "weighted"),
        (adaptive_kalman, "step", twice_the_noise, "constant"),
        (adaptive_kalman, "step", forgets_the_state_too, "constant"),
        (adaptive_kalman, "forget", forgets_twice, "weighted"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_planted_errors_break_these_laws(monkeypatch, table, module, function, error, law):
    monkeypatch.setattr(module, function, error(getattr(module, function)))
    assert LAWS[law](table) > 1e-4


def test_on_a_linear_plant_the_observer_does_not_matter(table):
    """Whatever it does: the prediction of an affine plant is the same about any point."""
    usual = run(AdaptiveEKF(Linear(), DT), *table)[1]
    out = run(AXKF(Linear(), DT, gain=np.full((3, 2), 0.2), z0=np.full(3, 5.0), s_max=1.0), *table)[1]
    for a, b in zip(usual, out, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)


def dense(state, x, F, Phi, e, C, D, Q, R, lam):
    """Table 1 with all measurements at once and inverses written out."""
    P = F @ state.P @ F.T + Q
    Sigma = C @ P @ C.T + np.diag(R)
    K = P @ C.T @ np.linalg.inv(Sigma)
    Upsilon = F @ state.Upsilon + Phi
    Omega = C @ Upsilon + D
    Gamma = state.S @ Omega.T @ np.linalg.inv(lam * Sigma + Omega @ state.S @ Omega.T)
    Upsilon = Upsilon - K @ Omega
    dtheta = Gamma @ e
    S = (state.S - Gamma @ Omega @ state.S) / lam
    return x + K @ e + Upsilon @ dtheta, P - K @ C @ P, state.theta + dtheta, S, Upsilon


@settings(max_examples=trials(25), deadline=None)
@given(st.integers(0, 2**31), st.floats(0.6, 0.999))
def test_one_measurement_after_the_other_is_all_at_once(seed, lam):
    rng = np.random.default_rng(seed)

    def covariance(n):
        root = rng.standard_normal((n, n))
        return root @ root.T + 0.1 * np.eye(n)

    n, p, m = 4, 3, 2
    state = adaptive_kalman.State(rng.standard_normal(n), covariance(n), rng.standard_normal(p), covariance(p), rng.standard_normal((n, p)))
    shapes = ((n,), (n, n), (n, p), (m,), (m, n), (m, p))
    table = (*(rng.standard_normal(shape) for shape in shapes), covariance(n), rng.uniform(0.1, 1, m))
    memory = adaptive_kalman.Memory(-1.0 / np.log(lam), np.inf)
    x, F, Phi, e, C, D, Q, R = table
    f, h = linearise.Linear(x, F, Phi), linearise.Linear(np.zeros(m), C, D)
    found, out = adaptive_kalman.step(state, x, f, e, h, Q, R, np.ones(m, bool), memory, 1.0)
    for a, b in zip(found, dense(state, *table, lam), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(out.x_cov, found.P + found.Upsilon @ found.S @ found.Upsilon.T, atol=1e-9)


@settings(max_examples=trials(30), deadline=None)
@given(st.integers(0, 2**31), st.floats(0.02, 1e6), st.floats(1e-3, 1e6))
def test_forgetting_keeps_below_the_bound(seed, memory_s, bound):
    """From any covariance up to the bound, however long nothing is excited, and however long a step is against the memory."""
    root = np.random.default_rng(seed).standard_normal((3, 3))
    S = root @ root.T
    S = S * bound / np.linalg.eigvalsh(S).max()
    memory = adaptive_kalman.Memory(memory_s, bound)
    for _ in range(50):
        S = adaptive_kalman.forget(S, memory, 1.0)
        values = np.linalg.eigvalsh(S)
        assert values.min() > -1e-9 * bound and values.max() <= bound * (1 + 1e-9)
    unbounded = adaptive_kalman.forget(np.eye(3), memory._replace(s_max=np.inf), 1.0)
    np.testing.assert_allclose(unbounded, np.eye(3) * np.exp(1.0 / memory_s), rtol=1e-12)


def hexa(**options):
    return RateDynamics.of(airframes.paper("rot-hexa") | options)


@pytest.mark.thorough(keep=2)
@each_method
def test_on_rate_dynamics_a_weak_rotor_is_found(method):
    """Thrusts that vary, gaps, NaN; losses are felt by the accelerometer at once."""
    plant, rng = hexa(), np.random.default_rng(0)
    rows, dt = 1500, 0.01
    u = 0.4 + 0.1 * rng.standard_normal((rows, 6))
    theta = np.where(np.arange(rows)[:, None] >= 500, [0.0, 0.3, 0.0, 0.0, 0.0, 0.0], 0.0)

    damp = np.linalg.pinv(plant.B_tau) @ (5.0 * plant.J)  # a pilot that stops the turning

    def fly(x, now):
        thrust, loss = now[0] - damp @ x, now[1]
        x = plant.f(x, thrust, loss, dt)
        return x, (thrust, plant.h(x, thrust, loss))

    u, y = map(np.array, jax.jit(lambda: jax.lax.scan(fly, jnp.zeros(3), (u, theta))[1])())
    y += rng.standard_normal(y.shape) * np.sqrt(np.asarray(plant.R(None)))
    y[700:710], y[900:950, 3] = np.nan, np.nan
    tuning = {"theta_walk": 1e-3} if method is EKF else {"memory_s": 5.0}
    estimator = method(plant, dt, **tuning)
    out = run(estimator, u, y)[1]
    assert np.abs(out.theta[450:500]).max() < 0.08
    assert np.abs(out.theta[-1] - theta[-1]).max() < 0.08
    for P in (out.x_cov, out.theta_cov, out.innovation_cov):
        np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
        assert np.linalg.eigvalsh(P).min() > -1e-12
    np.testing.assert_array_equal(out.status == 2, np.isnan(y).all(axis=1))
    assert (out.innovation[np.isnan(y)] == 0).all()
    assert (np.diff(np.trace(out.theta_cov[699:710], axis1=1, axis2=2)) > 0).all()


def test_a_memory_lasts_some_samples_where_losses_outnumber_measurements():
    """Six losses and four measurements at 20 Hz: 20 samples. Enough measurements, fast steps, or no forgetting: as given."""
    assert AXKF(hexa(), 0.05).memory_s == pytest.approx(20 * 0.05) and AKF(hexa(), 0.05, memory_s=3.0).memory_s == 3.0
    assert AXKF(hexa(), 1e-3).memory_s == AKF(Linear(), 0.05).memory_s == adaptive_kalman.MEMORY_S
    assert AXKF(hexa(), 0.05, memory_s=None).memory_s == np.inf
    inside = jax.jit(lambda seconds: AKF(hexa(), 0.05, memory_s=seconds).memory_s)
    assert inside(0.1) == 1.0 and inside(2.5) == 2.5


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("method", (AXKF, EKF), ids=lambda m: m.name)
def test_plants_may_be_built_inside_a_compiled_program(method):
    plant = hexa()

    def last(J, B_tau):
        estimator = method(RateDynamics(J, B_tau, plant.B_T, plant.m), DT)
        return estimator.step(estimator.init(), np.full(6, 0.4), np.zeros(4), np.ones(4, bool))[1].theta

    estimator = method(plant, DT)
    expected = estimator.step(estimator.init(), np.full(6, 0.4), np.zeros(4), np.ones(4, bool))[1].theta
    np.testing.assert_allclose(jax.jit(last)(plant.J, plant.B_tau), expected, atol=1e-9)


@pytest.mark.thorough(keep=2)
@each_method
def test_two_half_steps_leave_as_much_uncertainty_as_one(method):
    """Time steps may change: random walk and forgetting follow the time passed."""
    plant = hexa()
    tuning = {"theta_walk": 0.1} if method is EKF else {"memory_s": 0.45}
    estimator = method(plant, DT, **tuning)
    nothing = (np.zeros(6), np.full(4, np.nan), np.zeros(4, bool))
    _, one = estimator.step(estimator.init(), *nothing)
    carry, _ = estimator.step(estimator.init(), *nothing, dt=0.5 * DT)
    _, two = estimator.step(carry, *nothing, dt=0.5 * DT)
    np.testing.assert_allclose(one.theta_cov, two.theta_cov, rtol=1e-12)


@each_adaptive
def test_the_memory_is_the_papers_at_the_papers_step(method):
    """0.995 a step of 1 ms; in an unbounded direction that nothing measures S grows by its inverse."""
    estimator = method(hexa(), 1e-3, theta_var=0.1, s_max=None)
    out = estimator.step(estimator.init(), np.zeros(6), np.full(4, np.nan), np.zeros(4, bool))[1]
    np.testing.assert_allclose(out.theta_cov, 0.1 / 0.995 * np.eye(6), rtol=1e-12, atol=1e-14)


def test_akf_about_a_trajectory_is_the_extended_filter_there():
    """About the points that the extended filter visits, with forgetting off and losses known, both are the same."""
    plant = PortHamiltonianAttitude.of(airframes.paper("rot-hexa"), suspects=(0, 2))
    rng = np.random.default_rng(1)
    u, y = 0.01 * np.ones((30, 6)), 0.3 * rng.standard_normal((30, 3))
    extended = run(AdaptiveEKF(plant, 0.01, theta_var=0.0), u, y)[1]
    about = np.concatenate([plant.x0[None], extended.x])

    def linearised(about):
        method = AKF(plant, 0.01, theta_var=0.0, about=about)
        rows = (u, y, np.ones(y.shape, bool))
        return jax.lax.scan(lambda carry, row: method.step(carry, *row), method.init(), rows)[1].x

    along, elsewhere = jax.jit(jax.vmap(linearised))(np.stack([about, np.zeros_like(about)]))
    np.testing.assert_allclose(along, extended.x, atol=1e-10)
    assert np.abs(elsewhere - extended.x).max() > 1e-4


NOT_A_PLANT = SimpleNamespace(name="nothing", x0=np.zeros(2))


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: EKF(NOT_A_PLANT, DT), "not defined for the plant nothing: it needs f, h"),
        (lambda: EKF(Linear(), 0.0), "dt must be above zero"),
        (lambda: EKF(Linear(), DT, theta_walk=-1.0), "theta_walk must lie between 0 and inf"),
        (lambda: EKF(Linear(), DT, theta_var=[0.1] * 3), "theta_var must be one number or 2 of them"),
        (lambda: AKF(NOT_A_PLANT, DT), "not defined for the plant nothing"),
        (lambda: AKF(Linear(), DT, memory_s=0.0), "memory_s must be above zero"),
        (lambda: AKF(Linear(), DT, about=np.zeros(4)), r"about must have the shape \(3,\) or \(T, 3\), not \(4,\)"),
        (lambda: AdaptiveEKF(Linear(), DT, theta_var=2.0), "theta_var must lie between 0 and 1"),
        (lambda: AdaptiveEKF(Linear(), DT, s_max=0.0), "s_max must be above zero"),
        (lambda: AXKF(Linear(), DT, gain=np.zeros((2, 3))), r"gain must have the shape \(3, 2\)"),
        (lambda: AXKF(Linear(), DT, gain=np.full((3, 2), np.nan)), "gain holds NaN"),
        (lambda: AXKF(Linear(), DT, z0=np.zeros(2)), r"z0 must have the shape \(3,\)"),
    ],
)
def test_bad_configuration_gets_one_sentence(build, sentence):
    with pytest.raises(ConfigError, match=sentence):
        build()


def test_the_papers_tuning_sees_the_papers_losses_with_the_default_bound():
    """Its Q and R are tuning: with them a bound of the losses' variance at 1 hid both losses altogether."""
    from rotorwatch import airframes
    from rotorwatch_lab.experiments.studies import rot_flights as flights
    from rotorwatch_lab.maths import observer_gain
    from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude

    airframe = airframes.paper("rot-hexa")
    plant = PortHamiltonianAttitude.of(airframe, suspects=flights.MOTORS)
    u, theta = flights.thrusts(), flights.losses()
    y = flights.fly(plant.J, PortHamiltonianAttitude.of(airframe).B, u, theta)[:, :3]
    found = {}
    for name, more in (("default", {}), ("bound of 1", {"s_max": 1.0})):
        method = AXKF(plant, flights.DT, gain=observer_gain.printed(), theta_var=0.001, **more)
        found[name] = run(method, u, y)[1].theta[-1]
    np.testing.assert_allclose(found["default"], flights.LOSSES, rtol=0.01)
    assert np.abs(found["bound of 1"]).max() < 1e-3
