"""A plant: a quadrotor that only climbs and sinks, with a barometer and an accelerometer.

h' = v,   v' = sum_i k u_i (1 - theta_i) / m - g,   y = (h, v' + g)
"""

from __future__ import annotations

import numpy as np

G = 9.80665


class Height:
    """x = (height [m], climb [m/s]); u (4,): commands, 0 to 1; theta (4,): loss of each rotor; y = (height [m], lift [m/s^2])."""

    name = "template_height"
    n_x, n_u, n_theta, n_y = 2, 4, 4, 2
    x_names, x_units = ("height", "climb"), ("m", "m/s")
    x0, P0 = np.zeros(2), np.diag([0.1, 0.1])

    def __init__(self, m: float = 1.4, thrust: float = 8.0):
        """m: mass [kg]. thrust: of one rotor at full command [N]."""
        self.m, self.thrust = m, thrust

    def lift(self, u, theta):
        """Thrust of all rotors by mass [m/s^2]."""
        return self.thrust * (u * (1.0 - theta)).sum() / self.m

    def f(self, x, u, theta, dt):
        """State (2,) after dt seconds."""
        import jax.numpy as jnp

        a = self.lift(u, theta) - G
        return jnp.stack([x[0] + dt * x[1] + 0.5 * dt**2 * a, x[1] + dt * a])

    def h(self, x, u, theta):
        """Measurement (2,)."""
        import jax.numpy as jnp

        return jnp.stack([x[0], self.lift(u, theta)])

    def Q(self, dt):
        """(2, 2) covariance of the process noise over dt."""
        return np.diag([1e-6, 1e-2]) * dt

    def R(self, u):
        """(2,) variances of the measurements."""
        return np.array([0.05, 0.3]) ** 2
