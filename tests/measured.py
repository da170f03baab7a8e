"""What tests of regressions on measured states share: the regression once more, dense and in NumPy, on the plant of the laws."""

import jax
import numpy as np

from test_laws import Linear

PLANT = Linear()


def run(estimator, *table, keep=lambda carry, out: out):
    """Stacked outputs, or what `keep` makes of carry and output."""

    def tick(carry, row):
        carry, out = estimator.step(carry, *row)
        return carry, keep(carry, out)

    step = jax.jit(lambda table: jax.lax.scan(tick, estimator.init(), table)[1])
    return jax.tree.map(np.asarray, step(table))


class Regression:
    """x, P and the sensitivity of x to theta, step by step; theta is given from outside."""

    def __init__(self):
        self.x, self.P, self.sensitivity = PLANT.x0, PLANT.P0, np.zeros((3, 2))
        self.left = np.linalg.inv(PLANT.C)

    def rows(self, u, y, valid, theta, dt):
        """Whitened (z, Omega) of what is valid."""
        A, B = PLANT.A(dt), dt * PLANT.B * u
        self.x = A @ self.x + B @ (1.0 - theta)
        self.P = A @ self.P @ A.T + PLANT.Q(dt)
        self.sensitivity = A @ self.sensitivity - B
        self.e = y - PLANT.C @ self.x - PLANT.D @ (u * (1.0 - theta))
        self.Omega = PLANT.C @ self.sensitivity - PLANT.D * u
        S = (PLANT.C @ self.P @ PLANT.C.T + np.diag(PLANT.R(u)))[np.ix_(valid, valid)]
        root = np.linalg.inv(np.linalg.cholesky(S))
        return root @ (self.e + self.Omega @ theta)[valid], root @ self.Omega[valid]

    def measured(self, valid, moved, R):
        """Take the states in whose measurements are all there, after theta has moved."""
        self.x = self.x + self.sensitivity @ moved
        e = self.e - self.Omega @ moved
        for j in [j for j in range(3) if valid[np.abs(self.left[j]) > 1e-9].all()]:
            self.x[j] += self.left[j] @ np.where(np.abs(self.left[j]) > 1e-9, e, 0.0)
        K = np.array([self.left[j] * valid[np.abs(self.left[j]) > 1e-9].all() for j in range(3)])
        self.P = (np.eye(3) - K @ PLANT.C) @ self.P @ (np.eye(3) - K @ PLANT.C).T + K @ np.diag(R) @ K.T
        self.sensitivity = self.sensitivity - K @ self.Omega


class Felt(Linear):
    """The plant of the laws with an accelerometer: the last measurement is moved by theta alone."""

    name, n_y = "felt", 4
    C = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.0], [0.3, 0.0, 1.0], [0.0, 0.0, 0.0]])
    D = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.7, -0.9]])

    def R(self, u):
        return np.array([1e-2, 2e-2, 1.5e-2, 3e-2])


FELT = Felt()


def felt_table(T=40, seed=0):
    """(u, y, valid, dt) for it: random, with gaps and steps of different length."""
    rng = np.random.default_rng(seed)
    valid = rng.random((T, 4)) < 0.8
    valid[[0, 1, 20, 21]] = False
    return rng.normal(1, 0.3, (T, 2)), rng.normal(0, 1, (T, 4)), valid, rng.uniform(0.5, 1.5, T) * 0.02


def flight(theta, T, dt=0.02):
    """(u, y, valid) of that plant without any noise, with constant inputs and losses theta (2,)."""
    u, x, y = np.array([1.2, 0.8]), FELT.x0, np.empty((T, 4))
    for k in range(T):
        x = FELT.A(dt) @ x + dt * FELT.B @ (u * (1.0 - theta))
        y[k] = FELT.C @ x + FELT.D @ (u * (1.0 - theta))
    return np.tile(u, (T, 1)), y, np.ones((T, 4), bool)
