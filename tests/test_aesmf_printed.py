"""The set-membership filters as printed (batch cut, interval Hessians, no restart), step by step against the formulas in plain NumPy."""

import numpy as np
import pytest

from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators.aesmf import AESMF
from rotorwatch_lab.estimators.esmf import ESMF
from rotorwatch_lab.experiments.studies import ruav_filters, small_systems

DT, T = small_systems.DT, 60
PROCESS, MEASUREMENT = np.array([2e-3, 4e-3]), np.array([0.02, 0.03])
REACH, DRIFT, ETA, MU, CEILING, FLOOR = 0.3, 0.05, 1.0, 300.0, 4.0, 1e-3


class Pendulum(small_systems.Pendulum):
    """The pendulum with both its states measured: a batch of two rows."""

    n_y, y_names = 2, ("angle", "rate")

    def h(self, x, u, theta):
        return x

    def R(self, u):
        return MEASUREMENT**2 / 9


def flight():
    rng = np.random.default_rng(0)
    u = np.sin(0.17 * np.arange(T))[:, None]
    x, theta, y = np.array([1.0, 0.0]), 0.2, []
    for k in range(T):
        slope = np.array([x[1], -4 * np.sin(x[0]) - 0.3 * x[1] + 4 * (1 - theta) * u[k, 0]])
        x = x + DT * slope + 0.5 * PROCESS * rng.uniform(-1, 1, 2)
        y.append(x + 0.7 * MEASUREMENT * rng.uniform(-1, 1, 2))
    return u, np.array(y)


def share(P, Q):
    """1 - sqrt tr P / (sqrt tr P + sqrt tr Q)."""
    p, q = np.sqrt(np.trace(P)), np.sqrt(np.trace(Q))
    return q / (p + q)


def plainly(u, y, adaptive):
    """a (T, 3), P (T, 3, 3), q (T, 3) by the printed formulas."""
    a, P, q = np.array([1.0, 0.0, 0.0]), np.diag([0.09, 0.09, REACH**2]), np.ones(3)
    H, R = np.eye(3)[:2], np.diag(MEASUREMENT**2)
    found = []
    for k in range(T):
        Q_x, Q_theta = (np.diag(row * q) for row in ([*PROCESS**2, 0], [0, 0, (DRIFT * DT) ** 2]))
        b = share(Q_x, Q_theta)
        Q = Q_x / (1 - b) + Q_theta / b
        # Lagrange's remainder of the rate: 1/2 4 dt sin(xi) d^2, xi and d anywhere in the box.
        reach = np.sqrt(P[0, 0])
        assert abs(a[0]) + reach < np.pi / 2  # the sine rises
        curve = 4 * DT * np.sin([a[0] - reach, a[0] + reach])
        ends = [0.5 * c * d for c in curve for d in (0.0, reach**2)]
        mid, half = 0.5 * (max(ends) + min(ends)), 0.5 * (max(ends) - min(ends))
        Phi = np.array([[1, DT, 0], [-4 * DT * np.cos(a[0]), 1 - 0.3 * DT, -4 * DT * u[k, 0]], [0, 0, 1]])
        slope = np.array([a[1], -4 * np.sin(a[0]) - 0.3 * a[1] + 4 * (1 - a[2]) * u[k, 0], 0])
        a = a + DT * slope + [0, mid, 0]
        rest, moved = np.diag([0, half**2, 0]), Phi @ P @ Phi.T
        b_Q = share(Q, rest)
        noise = Q / (1 - b_Q) + rest / b_Q
        b = share(moved, noise)
        P = moved / (1 - b) + noise / b
        # The batch: its share by the largest eigenvalues.
        S, e = H @ P @ H.T, y[k] - a[:2]
        p, r = np.sqrt(np.linalg.eigvalsh(S)[-1]), np.sqrt(R.max())
        rho = r / (p + r)
        W = S / (1 - rho) + R / rho
        K = P @ H.T @ np.linalg.inv(W) / (1 - rho)
        delta = 1 - e @ np.linalg.inv(W) @ e
        assert delta > 0
        a, P = a + K @ e, delta * (P - K @ H @ P) / (1 - rho)
        if adaptive:
            new = q.copy()
            for i in range(3):
                E = np.zeros((3, 3))
                E[i, i] = 1
                W_i = H @ (E + Phi @ E @ Phi.T) @ H.T / ((1 - rho) * b * (1 - b_Q))
                solved = np.linalg.solve(W, e)
                down = np.trace(np.linalg.solve(W, W_i)) - MU / delta * solved @ W_i @ solved
                new[i] = np.clip(q[i] * np.exp(-np.clip(ETA * DT * Q[i, i] * down, -0.5, 0.5)), FLOOR, CEILING)
            q = new
        found.append((a, P, q))
    return tuple(np.array(column) for column in zip(*found, strict=True))


@pytest.mark.parametrize("kind", [ESMF, AESMF])
def test_the_printed_filter_is_the_printed_formulas(kind):
    u, y = flight()
    made = kind(Pendulum(), DT, process=PROCESS, measurement=MEASUREMENT, theta_reach=REACH, theta_drift=DRIFT,
                theta_range=(-np.inf, np.inf), **ruav_filters.FORMS["printed"])  # fmt: skip
    z, P, q = plainly(u, y, kind is AESMF)
    carry, out = run(made, u, y)
    np.testing.assert_allclose(np.concatenate([out.x, out.theta], axis=1), z, rtol=1e-6, atol=1e-9)  # the filter iterates for eigenvalues
    np.testing.assert_allclose(out.x_cov, P[:, :2, :2], rtol=1e-6)
    np.testing.assert_allclose(out.theta_cov, P[:, 2:, 2:], rtol=1e-6)
    np.testing.assert_allclose(carry.q, q[-1], rtol=1e-6)
    assert (np.abs(carry.q - 1).max() > 0.01) == (kind is AESMF)
