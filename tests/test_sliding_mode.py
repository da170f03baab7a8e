"""Super-twisting observer: against a second implementation; it slides after a finite time, without chatter."""

import numpy as np
import pytest

from measured import FELT, felt_table, flight, run
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.sliding_mode import SlidingMode
from rotorwatch_lab.systems.rigid_body import RigidBody
from test_laws import DT, LOSS, flown, rates_hexa, rates_quad

GROWTH, RATE, VAR, WALK = 0.8, 4.0, 0.3, 0.1
NOMINAL = np.array([0.9, 1.3])


def twisted(e, k1, k2, dt):
    """Solves e = q + dt k1 |q|^1/2 sgn q + dt^2 k2 s by bisection: q and dt k2 s of one error."""
    if abs(e) <= dt * dt * k2:
        return 0.0, e / dt
    low, high = 0.0, abs(e)
    for _ in range(200):
        q = 0.5 * (low + high)
        low, high = (q, high) if q + dt * k1 * np.sqrt(q) + dt * dt * k2 < abs(e) else (low, q)
    return np.sign(e) * q, np.sign(e) * dt * k2


def second(table):
    """Yields x, theta, theta's covariance, state's covariance."""
    G0, D0 = -FELT.B * NOMINAL, -FELT.D * NOMINAL
    g = np.abs(G0).max(axis=1)
    k1, k2 = 1.5 * np.sqrt(GROWTH * g), 1.1 * GROWTH * g
    x, v, w = FELT.x0, np.zeros(3), 0.0
    P = np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = FELT.P0, np.diag((G0**2 * VAR).sum(axis=1))
    var, G, D = (D0[3] ** 2 * VAR).sum(), G0.copy(), D0[3].copy()
    inverse = np.linalg.inv(FELT.C[:3])
    for u, y, valid, dt in zip(*table, strict=True):
        x = FELT.A(dt) @ x + dt * FELT.B @ u + dt * v
        A = np.eye(6)
        A[:3, :3], A[:3, 3:] = FELT.A(dt), dt * np.eye(3)
        P = A @ P @ A.T
        P[:3, :3] += FELT.Q(dt)
        P[3:, 3:] += WALK**2 * dt * np.diag(g**2)
        S = FELT.C[:3] @ P[:3, :3] @ FELT.C[:3].T + np.diag(FELT.R(u)[:3])
        missing = y - FELT.C @ x - FELT.D @ u
        K = np.zeros((6, 3))
        moved_x, moved_v = np.zeros(3), np.zeros(3)
        for j in range(3):
            needs = np.abs(inverse[j]) > 1e-9
            if not valid[:3][needs].all():
                continue
            row = np.where(needs, inverse[j], 0.0)
            e = row[needs] @ missing[:3][needs]
            q, dv = twisted(e, k1[j], k2[j], dt)
            moved_x[j], moved_v[j] = e - q, dv
            sd = np.sqrt(row @ S @ row)
            q, dv = twisted(sd, k1[j], k2[j], dt)
            K[j], K[3 + j] = (1 - q / sd) * row, dv / sd * row
            G[j] = -(FELT.B * u)[j]
        x, v = x + moved_x, v + moved_v
        rest = np.eye(6) - K @ np.hstack([FELT.C[:3], np.zeros((3, 3))])
        P = rest @ P @ rest.T + K @ np.diag(FELT.R(u)[:3]) @ K.T
        var = var + WALK**2 * dt * (D0[3] ** 2).sum()
        if valid[3]:
            a = 1 - np.exp(-RATE * dt)
            w, var, D = w + a * (missing[3] - w), (1 - a) ** 2 * var + a**2 * FELT.R(u)[3], D + a * (-FELT.D[3] * u - D)
        rows, values = np.vstack([G, D]), np.append(v, w)
        weights = 1.0 / np.append(np.diagonal(P)[3:], var)
        cov = np.linalg.inv(rows.T @ np.diag(weights) @ rows + np.eye(2) / VAR)
        yield x, cov @ rows.T @ (weights * values), cov, P[:3, :3]


def test_it_is_what_a_second_implementation_says():
    """Gaps, steps of different length, and a measurement that only losses move."""
    table = felt_table()
    method = SlidingMode(FELT, DT, loss_rate=GROWTH, rate=RATE, theta_var=VAR, walk=WALK, u_nominal=NOMINAL)
    got = run(method, *table)
    wanted = [np.array(column) for column in zip(*second(table), strict=True)]
    for a, b in zip((got.x, got.theta, got.theta_cov, got.x_cov), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def test_without_noise_it_slides_after_a_finite_time_and_without_chatter():
    """The error is 0 to the last digits from some step on, not smaller and smaller; injection and losses are exact and at rest."""
    losses = np.array([0.2, 0.5])
    table = flight(losses, 300)
    method = SlidingMode(FELT, DT)
    x, v, theta = run(method, *table, keep=lambda carry, out: (carry.x, carry.v, out.theta))
    true = np.linalg.solve(FELT.C[:3], table[1][:, :3].T).T
    error = np.abs(x - true).max(axis=1)
    first = int(np.argmax(error < 1e-12))
    assert 5 < first < 150, first  # it takes at least as long as the injection needs at its greatest speed
    assert (error[first:] < 1e-12).all()
    push = -FELT.B @ (table[0][0] * losses)
    np.testing.assert_allclose(v[first + 2 :], np.tile(push, (298 - first, 1)), atol=1e-9)
    np.testing.assert_allclose(theta[-1], losses, atol=0.04)  # but for what theta_var takes off


def test_it_takes_as_long_as_the_bound_says():
    """A loss that is twice as large takes about twice as long, and a bound twice as large half the time."""

    def seconds(losses, loss_rate):
        table = flight(np.array(losses), 600)
        x = run(SlidingMode(FELT, DT, loss_rate=loss_rate), *table, keep=lambda carry, out: carry.x)
        true = np.linalg.solve(FELT.C[:3], table[1][:, :3].T).T
        return DT * np.flatnonzero(np.abs(x - true).max(axis=1) > 1e-12)[-1]

    usual = seconds([0.4, 0.0], 0.5)
    assert 1.5 < seconds([0.8, 0.0], 0.5) / usual < 2.5
    assert 0.3 < seconds([0.4, 0.0], 1.0) / usual < 0.7


@pytest.mark.parametrize("make", [rates_quad, rates_hexa], ids=lambda m: m.__name__)
def test_it_finds_a_loss(make):
    u, y, valid, _ = flown(make, 0, LOSS)
    out = run(SlidingMode(make(), DT), u, y, valid)
    assert out.theta[-1].argmax() == 1 and abs(out.theta[-1, 1] - LOSS) < 0.1
    assert np.abs(np.delete(out.theta[-1], 1)).max() < 0.15


def test_wrong_values_are_named():
    with pytest.raises(ConfigError, match="loss_rate"):
        SlidingMode(FELT, DT, loss_rate=0.0)
    with pytest.raises(ConfigError, match="theta_var"):
        SlidingMode(FELT, DT, theta_var=[0.1, 0.1, 0.1])
    with pytest.raises(ConfigError, match="needs every state measured"):
        SlidingMode(RigidBody(np.eye(3), np.ones((3, 4)), np.ones(4), 1.0), DT)
