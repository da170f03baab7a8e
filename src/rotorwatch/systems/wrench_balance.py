"""Commanded wrench = what the motion needed + slow disturbances + what faulty rotors did not deliver.

The default diagnoser's plant. Nothing of the vehicle but its geometry is needed: for each axis a of roll, pitch, yaw and thrust

    y_a = G_a m_a + c_a r_a + b1_a + b2_a + b3_a + sum_i B_ai T_i theta_i + noise

y = B T: commanded wrench; T (n,): commanded thrusts (hover thrust of one rotor = 1); m: angular acceleration [rad/s^2], and for
thrust the load factor times n; r: angular rate [rad/s] (damping); b1, b2: coloured disturbances with time
constants TAU (gusts, and what the controller makes of them); b3: slow drift (wind,
centre of mass, battery), a random walk. theta_i: loss of rotor i. Per axis the state is (b1, b2, b3, G, c). It is linear
in the state for given u, and in theta.
"""

from __future__ import annotations

import numpy as np

TAU = (0.25, 1.0)  # s
PER_AXIS = 5
B1, B2, B3, GAIN, DAMPING = range(PER_AXIS)
AXES = ("roll", "pitch", "yaw", "thrust")

# What any multirotor is like, in these units: gain and its spread from g / (arm length x squared relative radius of
# gyration) over 3 to 60 cm arms; yaw gains scatter more, being divided by the propellers' drag ratio. Thrust against load
# factor is one to one by the choice of unit.
GAIN_MEAN = np.array([0.012, 0.012, 0.3, 1.0])
GAIN_SD = np.array([0.008, 0.008, 0.3, 0.005])
DAMPING_SD = np.array([0.15, 0.15, 1.0, 1e-9])
BIAS_SD = np.array([0.5, 0.5, 1.0, 0.4])


class WrenchBalance:
    """n rotors with effectiveness matrix B (4, n). x (20,), u (n + 7,): see `pack`; theta (n,) loss; y (4,) wrench."""

    name = "wrench_balance"
    n_y = 4
    n_x = 4 * PER_AXIS
    x_names = tuple(f"{axis}.{what}" for axis in AXES for what in ("b1", "b2", "b3", "gain", "damping"))

    def __init__(self, B, prior=None):
        """prior: (mean (20,), covariance (20, 20)) from healthy flights (calibrate), else what any multirotor is like."""
        self.B = B  # numpy, or traced: one compiled program serves every airframe with n rotors
        self.n_theta = B.shape[1]
        self.n_u = self.n_theta + 7
        mean = np.zeros((4, PER_AXIS))
        mean[:, GAIN] = GAIN_MEAN
        sd = np.zeros((4, PER_AXIS))
        sd[:, B3], sd[:, GAIN], sd[:, DAMPING] = BIAS_SD, GAIN_SD, DAMPING_SD
        self.x0, self.P0 = mean.reshape(-1), np.diag(sd.reshape(-1) ** 2)
        if prior is not None:
            self.x0, self.P0 = prior

    def pack(self, ticks):
        """(T, n + 7) inputs of a table of ticks: thrusts, angular accelerations, n times load factor, angular rates."""
        return np.concatenate([ticks.thrust, ticks.rate_dot, ticks.load[:, None] * self.n_theta, ticks.rate], axis=1)

    def C(self, u):
        """(4, 20) dy/dx."""
        from jax import numpy as jnp

        n = self.n_theta
        one = jnp.ones(4)
        rates = jnp.concatenate([u[n + 4 : n + 7], jnp.zeros(1)])
        rows = jnp.stack([one, one, one, u[n : n + 4], rates], axis=1)
        return (jnp.eye(4)[:, :, None] * rows[:, None, :]).reshape(4, self.n_x)

    def H(self, u):
        """(4, n) dy/dtheta."""
        return self.B * u[: self.n_theta][None, :]

    def f(self, x, u, theta, dt):
        """State after dt: disturbances decay, the rest stays."""
        return self.decay(dt) * x

    def h(self, x, u, theta):
        """Commanded wrench (4,)."""
        return self.C(u) @ x + self.H(u) @ theta

    def decay(self, dt):
        """(20,) diagonal of the state transition."""
        return np.tile([*np.exp(-dt / np.array(TAU)), 1.0, 1.0, 1.0], 4)
