"""Adaptive Thau observer: against a second implementation; its Lyapunov function falls; its losses are right."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from measured import FELT, felt_table, flight, run
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.thau import Thau
from rotorwatch_lab.systems.rigid_body import RigidBody
from test_laws import DT, LOSS, flown, rates_hexa, rates_quad

RATE, BANDWIDTH, DIRECT, LEAK, SD, WALK = 9.0, 3.0, 2.0, 0.3, 0.4, 0.1
NOMINAL = np.array([0.9, 1.3])


def designed():
    """P, L, weight, gamma, k_f of the plant with an accelerometer, by SciPy's own solver."""
    F, C = FELT.A(DT), FELT.C[:3]
    reach = FELT.C[:3] @ (1.0 / RATE * FELT.B * NOMINAL) * RATE  # that plant's step is Euler's, whatever its length
    W = np.diag(1.0 / (reach**2).sum(axis=1))
    mu = np.exp(-RATE * DT)
    P = solve_discrete_lyapunov(mu * np.linalg.inv(F).T, C.T @ W @ C)
    G = FELT.B * NOMINAL
    gamma = BANDWIDTH**2 / max(g @ P @ g for g in G.T)
    k_f = DIRECT / ((FELT.D * NOMINAL) ** 2).sum()
    pad = np.zeros((3, 1))
    return P, np.hstack([np.linalg.solve(P, C.T @ W), pad]), np.hstack([P @ np.linalg.inv(C), pad]), gamma, k_f


def second(table):
    """Yields x, theta, covariance of both."""
    _, L, weight, gamma, k_f = designed()
    x, theta, P = FELT.x0, np.zeros(2), np.zeros((5, 5))
    P[:3, :3], P[3:, 3:] = FELT.P0, SD**2 * np.eye(2)
    for u, y, valid, dt in zip(*table, strict=True):
        G, D = -FELT.B * u, -FELT.D * u
        x = FELT.A(dt) @ x + dt * FELT.B @ (u * (1 - theta))
        e = np.where(valid, y - FELT.C @ x - FELT.D @ (u * (1 - theta)), 0.0)
        K_theta = gamma * dt * G.T @ weight + dt * k_f * D.T
        K = np.vstack([L, K_theta]) * valid
        A = np.eye(5)
        A[:3, :3], A[:3, 3:] = FELT.A(dt), dt * G
        P = A @ P @ A.T
        P[:3, :3] += FELT.Q(dt)
        P[3:, 3:] += WALK**2 * dt * np.eye(2)
        rest = np.eye(5) - K @ np.hstack([FELT.C, D])
        P = rest @ P @ rest.T + K @ np.diag(FELT.R(u)) @ K.T
        x, theta = x + K[:3] @ e, theta + K[3:] @ e - dt * LEAK * theta * valid.any()
        yield x, theta, P


def thau(system=FELT, **options):
    return Thau(system, DT, rate=RATE, bandwidth=BANDWIDTH, direct_rate=DIRECT, leak=LEAK, theta_sd=SD, walk=WALK, **options)


def test_it_is_what_a_second_implementation_says():
    """Gaps, steps of different length, and a measurement that only losses move."""
    method, table = thau(u_nominal=NOMINAL), felt_table()
    for a, b in zip((method.P, method.L, method.weight, method.gamma, method.k_f), designed(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    got = run(method, *table)
    wanted = [np.array(column) for column in zip(*second(table), strict=True)]
    np.testing.assert_allclose(got.x, wanted[0], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(got.theta, wanted[1], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(got.x_cov, wanted[2][:, :3, :3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got.theta_cov, wanted[2][:, 3:, 3:], rtol=1e-9, atol=1e-12)


def test_its_lyapunov_function_falls_at_the_rate_that_was_asked_for():
    """For every error of the state, and with a nonlinear rest up to the constant that it says, in the worst direction too."""
    method = thau(u_nominal=NOMINAL)
    P, F = np.asarray(method.P), FELT.A(DT)
    step = (np.eye(3) - np.asarray(method.L) @ FELT.C) @ F
    mu = np.exp(-RATE * DT)
    assert np.linalg.eigvalsh(mu**2 * P - step.T @ P @ step).min() > -1e-12 * np.abs(P).max()
    root = np.linalg.cholesky(P).T
    grown = step + DT * 0.99 * float(method.lipschitz) * step  # F^-1 times the rest is 0.99 lipschitz e: straight on
    assert np.linalg.norm(root @ grown @ np.linalg.inv(root), 2) < 1.0


def test_losses_are_exact_without_noise_and_leak():
    losses = np.array([0.2, 0.5])
    method = Thau(FELT, DT, rate=RATE, bandwidth=BANDWIDTH, leak=0.0)
    out = run(method, *flight(losses, 2000))
    np.testing.assert_allclose(out.theta[-1], losses, atol=1e-6)


@pytest.mark.parametrize("make", [rates_quad, rates_hexa], ids=lambda m: m.__name__)
def test_it_finds_a_loss(make):
    u, y, valid, _ = flown(make, 0, LOSS)
    out = run(Thau(make(), DT), u, y, valid)
    assert out.theta[-1].argmax() == 1 and abs(out.theta[-1, 1] - LOSS) < 0.1
    assert np.abs(np.delete(out.theta[-1], 1)).max() < 0.15


def test_losses_that_nothing_holds_fall_back():
    """At zero thrust nothing tells of losses any more: they leak away at the rate that was asked for."""
    losses = np.array([0.2, 0.5])
    u, y, valid = flight(losses, 600)
    method = thau()
    known = run(method, u, y, valid).theta[-1]
    x, quiet = FELT.x0, np.empty((200, 4))
    for k in range(200):
        x = FELT.A(DT) @ x
        quiet[k] = FELT.C @ x
    u, y = np.concatenate([u, np.zeros((200, 2))]), np.concatenate([y, quiet])
    out = run(method, u, y, np.ones((800, 4), bool))
    np.testing.assert_allclose(out.theta[599], known, rtol=1e-12)
    np.testing.assert_allclose(out.theta[-1], known * (1 - LEAK * DT) ** 200, rtol=1e-9)


def test_wrong_values_are_named():
    with pytest.raises(ConfigError, match="slower than the plant"):
        Thau(FELT, DT, rate=0.1)
    with pytest.raises(ConfigError, match="bandwidth"):
        Thau(FELT, DT, bandwidth=100.0)
    with pytest.raises(ConfigError, match="needs every state measured"):
        Thau(RigidBody(np.eye(3), np.ones((3, 4)), np.ones(4), 1.0), DT)
