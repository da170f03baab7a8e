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
    """x, P and the sensitivity of x to theta, step by step; theta is told from outside."""

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
