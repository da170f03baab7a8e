"""Parity space: against the least-squares fit of the window; no state moves its residual, and every gap stops it."""

import jax
import numpy as np
import pytest

from measured import PLANT, run
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.parity import Parity
from rotorwatch_lab.systems.rigid_body import RigidBody
from test_laws import DT, LOSS, flown, rates_hexa, rates_quad

N, VAR, WALK = 6, 0.3, 0.1
NOMINAL = np.array([0.9, 1.3])


def parity(**options):
    return Parity(PLANT, DT, window_s=N * DT, theta_var=VAR, walk=WALK, u_nominal=NOMINAL, **options)


def table(T=30, seed=0):
    """(u, y, valid) with a gap; random."""
    rng = np.random.default_rng(seed)
    valid = np.ones((T, 3), bool)
    valid[12, 1], valid[20] = False, False
    return rng.normal(1, 0.3, (T, 2)), rng.normal(0, 1, (T, 3)), valid


def window_fit(u, y):
    """theta and its covariance by weighted least squares on (x_0, theta): states one after the other, dense."""
    A = PLANT.A(DT)
    x, by_x, by_theta, noise = np.zeros(3), np.eye(3), np.zeros((3, 2)), np.zeros((3, 3 * N))
    rows, target, spread = [], [], []
    for k in range(N):
        x, by_x, by_theta, noise = A @ x + DT * PLANT.B @ u[k], A @ by_x, A @ by_theta - DT * PLANT.B * u[k], A @ noise
        noise[:, 3 * k : 3 * k + 3] += np.linalg.cholesky(PLANT.Q(DT))
        rows.append(np.hstack([PLANT.C @ by_x, PLANT.C @ by_theta - PLANT.D * u[k]]))
        target.append(y[k] - PLANT.C @ x - PLANT.D @ u[k])
        spread.append(PLANT.C @ noise)
    rows, target, spread = np.vstack(rows), np.concatenate(target), np.vstack(spread)
    Sigma = spread @ spread.T + np.diag(np.tile(PLANT.R(u[0]), N))
    information = rows.T @ np.linalg.solve(Sigma, rows) + np.diag([0, 0, 0, 1 / VAR, 1 / VAR])
    found = np.linalg.solve(information, rows.T @ np.linalg.solve(Sigma, target))
    return found[3:], np.linalg.inv(information)[3:, 3:]


def test_losses_are_the_least_squares_fit_of_the_window_and_rest_where_it_has_a_gap():
    u, y, valid = table()
    out = run(parity(), u, y, valid)
    theta, cov = np.zeros(2), VAR * np.eye(2)
    fitted = 0
    for k in range(len(u)):
        here = slice(k - N + 1, k + 1)
        if k >= N - 1 and valid[here].all():
            theta, cov = window_fit(u[here], y[here])
            fitted += 1
        else:
            cov = cov + WALK**2 * DT * np.eye(2)
            assert not out.parity[k].any()
        np.testing.assert_allclose(out.estimate.theta[k], theta, rtol=1e-9, atol=1e-10, err_msg=str(k))
        np.testing.assert_allclose(out.estimate.theta_cov[k], cov, rtol=1e-9, atol=1e-12, err_msg=str(k))
    assert fitted > 8


def test_the_state_is_a_kalman_filters():
    """The losses' covariance as noise of the step and of the measurement."""
    u, y, valid = table()
    out = run(parity(), u, y, valid)
    x, P, theta, cov = PLANT.x0, PLANT.P0, np.zeros(2), VAR * np.eye(2)
    for k in range(len(u)):
        A, G, D = PLANT.A(DT), -DT * PLANT.B * u[k], -PLANT.D * u[k]
        x = A @ x + DT * PLANT.B @ (u[k] * (1 - theta))
        P = A @ P @ A.T + G @ cov @ G.T + PLANT.Q(DT)
        v = valid[k]
        R = np.diag(PLANT.R(u[k])) + np.diag(np.diagonal(D @ cov @ D.T))
        K = P @ PLANT.C[v].T @ np.linalg.inv((PLANT.C @ P @ PLANT.C.T + R)[np.ix_(v, v)])
        x = x + K @ (y[k] - PLANT.C @ x - PLANT.D @ (u[k] * (1 - theta)))[v]
        P = P - K @ PLANT.C[v] @ P
        np.testing.assert_allclose(out.estimate.x[k], x, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(out.estimate.x_cov[k], P, rtol=1e-9, atol=1e-11)
        theta, cov = out.estimate.theta[k], out.estimate.theta_cov[k]


def test_no_state_moves_the_parity_vector():
    """The same noise from another state: the same residual, though measurements differ by far."""
    u, y, _ = table()
    valid, x, moved = np.ones_like(y, bool), np.array([30.0, -20.0, 50.0]), np.empty_like(y)
    for k in range(len(u)):
        x = PLANT.A(DT) @ x
        moved[k] = y[k] + PLANT.C @ x
    one, other = (run(parity(), u, t, valid).parity for t in (y, moved))
    assert np.abs(one[N - 1 :]).min() > 0 and np.abs(moved - y).max() > 10
    np.testing.assert_allclose(one, other, atol=1e-8)


def test_the_parity_vector_of_a_healthy_flight_has_the_covariance_one():
    rng, T = np.random.default_rng(1), 3000
    u, x, y = rng.normal(1, 0.3, (T, 2)), PLANT.x0, np.empty((T, 3))
    for k in range(T):
        x = PLANT.A(DT) @ x + DT * PLANT.B @ u[k] + np.linalg.cholesky(PLANT.Q(DT)) @ rng.standard_normal(3)
        y[k] = PLANT.C @ x + PLANT.D @ u[k] + np.sqrt(PLANT.R(u[k])) * rng.standard_normal(3)
    r = run(parity(), u, y, np.ones((T, 3), bool)).parity[N - 1 :: N]  # windows that share nothing
    assert r.shape[1] == 3 * N - 3
    np.testing.assert_allclose(np.cov(r.T), np.eye(3 * N - 3), atol=0.25)
    assert abs((r**2).mean() - 1.0) < 0.06


@pytest.mark.parametrize("make", [rates_quad, rates_hexa], ids=lambda m: m.__name__)
def test_it_finds_a_loss(make):
    u, y, valid, _ = flown(make, 0, LOSS)
    theta = run(Parity(make(), DT), u, y, valid).estimate.theta[-60:].mean(axis=0)
    assert theta.argmax() == 1 and abs(theta[1] - LOSS) < 0.1 and np.abs(np.delete(theta, 1)).max() < 0.1


def test_states_that_are_not_measured_are_no_hindrance():
    """A rigid body whose velocities are not measured: their part of the window is eliminated like any other."""
    plant = RigidBody(
        np.diag([0.01, 0.01, 0.02]), 0.2 * np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [0.1, 0.1, -0.1, -0.1]]), 5 * np.ones(4), 1.0
    )
    assert Parity(plant, DT).V.shape == (20 * 6 - 12, 20 * 6)


def test_wrong_values_are_named():
    with pytest.raises(ConfigError, match="window_s"):
        Parity(PLANT, DT, window_s=-1.0)
    with pytest.raises(ConfigError, match="theta_var"):
        Parity(PLANT, DT, theta_var=0.0)
    plant = RigidBody(np.eye(3), np.ones((3, 4)), np.ones(4), 1.0, measured=("roll", "pitch", "yaw"))
    with pytest.raises(ConfigError, match="never measured"):
        Parity(plant, DT)


def test_the_design_is_the_same_inside_a_program():
    """As when a tuning is searched, or when one program serves many aircraft."""

    def made(noise):
        plant = rates_quad()
        plant.gyro_sd = noise
        return Parity(plant, DT).V

    np.testing.assert_allclose(jax.jit(made)(0.02), made(0.02), atol=1e-9)
    assert np.abs(made(0.02) - made(0.01)).max() > 1e-3
