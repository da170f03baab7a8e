"""Three-stage Kalman filter: it is the augmented filter of state, disturbance and losses; and tells gusts from losses."""

import numpy as np
import pytest

from measured import PLANT, run
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.estimators.three_stage import ThreeStage
from test_laws import DT, LOSS, flown, linear_table, rates_hexa, rates_quad

WALK, VAR, SHARE, TIME = 0.02, 0.3, 0.4, 0.15


def second(table, g):
    """Textbook Kalman filter of (x, d, theta), dense: yields x, its covariance, theta, its covariance, d, its covariance, S."""
    s, P = np.concatenate([PLANT.x0, np.zeros(5)]), np.zeros((8, 8))
    P[:3, :3], P[3:6, 3:6], P[6:, 6:] = PLANT.P0, SHARE**2 * np.eye(3), VAR * np.eye(2)
    for u, y, valid, dt in zip(*table, strict=True):
        a = np.exp(-dt / TIME)
        A = np.eye(8)
        A[:3, :3], A[:3, 3:6], A[:3, 6:], A[3:6, 3:6] = PLANT.A(dt), dt * np.diag(g), -dt * PLANT.B * u, a * np.eye(3)
        H = np.hstack([PLANT.C, np.zeros((3, 3)), -PLANT.D * u])
        s = A @ s
        s[:3] += dt * PLANT.B @ u
        P = A @ P @ A.T
        P[:3, :3] += PLANT.Q(dt)
        P[3:6, 3:6] += (1 - a * a) * SHARE**2 * np.eye(3)
        P[6:, 6:] += dt * WALK * np.eye(2)
        S = H @ P @ H.T + np.diag(PLANT.R(u))
        K = np.linalg.solve(S[np.ix_(valid, valid)], H[valid] @ P).T
        s = s + K @ (y - H @ s - PLANT.D @ u)[valid]
        P = P - K @ H[valid] @ P
        yield s[:3], P[:3, :3], s[6:], P[6:, 6:], s[3:6], P[3:6, 3:6], S


def test_it_is_the_augmented_filter_of_all_three():
    """Gaps, steps of different length and feedthrough included."""
    table = linear_table()
    method = ThreeStage(PLANT, DT, theta_walk=WALK, theta_var=VAR, disturbance_share=SHARE, disturbance_s=TIME, u_nominal=[0.7, 1.4])
    g = np.abs(PLANT.B * [0.7, 1.4]).max(axis=1)
    np.testing.assert_allclose(method.g, g, rtol=1e-12)
    got = run(method, *table)
    wanted = [np.array(column) for column in zip(*second(table, g), strict=True)]
    for a, b in zip((*got.estimate[:4], got.disturbance, got.disturbance_cov), wanted, strict=False):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(got.estimate.innovation_cov, wanted[6], rtol=1e-9)


def test_without_disturbance_it_is_the_augmented_kalman_filter():
    table = linear_table()
    got = run(ThreeStage(PLANT, DT, theta_walk=WALK, theta_var=VAR, disturbance_share=0.0), *table)
    wanted = run(EKF(PLANT, DT, theta_walk=WALK, theta_var=VAR), *table)
    for a, b in zip(got.estimate[:6], wanted[:6], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("make", [rates_quad, rates_hexa], ids=lambda m: m.__name__)
def test_it_finds_a_loss(make):
    u, y, valid, _ = flown(make, 0, LOSS)
    out = run(ThreeStage(make(), DT), u, y, valid)
    assert out.estimate.theta[-1].argmax() == 1
    error, sd = (out.estimate.theta[-1] - LOSS * np.eye(make().n_theta)[1], np.sqrt(np.diagonal(out.estimate.theta_cov[-1])))
    assert (np.abs(error) < 3 * sd).all() and np.abs(error).max() < 0.15


def gusty(system, push, seed):
    """(u, y, valid) of a healthy hover in which rolling gusts come and go within a second."""
    rng = np.random.default_rng(seed)
    T = 300
    u = np.ones((T, 4)) * system.m * 9.80665 / np.sum(system.B_T) * (1 + 0.03 * rng.standard_normal((T, 4)))
    gust, x, y = 0.0, np.zeros(3), np.empty((T, 4))
    for k in range(T):
        gust = np.exp(-DT) * gust + np.sqrt(1 - np.exp(-2 * DT)) * rng.standard_normal()
        x = np.asarray(system.f(x, u[k], np.zeros(4), DT)) + DT * push * gust * np.array([1.0, 0.0, 0.0])
        y[k] = np.asarray(system.h(x, u[k], np.zeros(4))) + np.sqrt(system.R(u[k])) * rng.standard_normal(4)
    return u, y, np.ones((T, 4), bool)


def test_gusts_are_disturbances_and_no_losses():
    """Where gusts have the size the filter was given, losses are nearer to 0 than the plain filter's."""
    system = rates_quad()
    share = 0.3
    method = ThreeStage(system, DT, disturbance_share=share)
    u, y, valid = gusty(system, share * float(method.g[0]), 0)
    found = run(method, u, y, valid).estimate.theta[100:]
    plain = run(EKF(system, DT), u, y, valid).theta[100:]
    assert np.sqrt((found**2).mean()) < 0.5 * np.sqrt((plain**2).mean())


@pytest.mark.parametrize(
    ("wrong", "says"),
    [({"disturbance_share": -0.1}, "disturbance_share"), ({"disturbance_s": 0.0}, "disturbance_s"), ({"theta_walk": [1.0]}, "theta_walk")],
)
def test_wrong_values_are_named(wrong, says):
    with pytest.raises(ConfigError, match=says):
        ThreeStage(rates_quad(), DT, **wrong)
