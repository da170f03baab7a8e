"""Commanded wrench = what the motion needed + slow disturbances + what faulty rotors did not deliver.

The default diagnoser's plant. Nothing of the vehicle but its geometry is needed: for each axis a of roll, pitch, yaw and thrust

    y_a = G_a m_a + c_a r_a - l_a v_a + b1_a + b2_a + b3_a + sum_i B_ai T_i theta_i + noise

y = B T: commanded wrench; T (n,): commanded thrusts (hover thrust of one rotor = 1); m: angular acceleration [rad/s^2], and for
thrust the load factor times n; r: angular rate [rad/s] (damping); v: rate of change of y [1/s] (what is left of the
lag l [s]); b1, b2: coloured disturbances with time constants TAU; b3: slow drift (wind, centre of mass, battery). theta_i: loss
of rotor i. Per axis the state is (b1, b2, b3, G, c, l). It is linear in the state for given u, and in theta.
"""

from __future__ import annotations

import numpy as np

TAU = (0.25, 2.0)  # s
PER_AXIS = 6
B1, B2, B3, GAIN, DAMPING, LAG = range(PER_AXIS)
AXES = ("roll", "pitch", "yaw", "thrust")

# What any multirotor is like, in these units: gain and its spread from g / (arm length x squared relative radius of gyration)
# over 3 to 60 cm arms; yaw gains scatter more, being divided by the propellers' drag ratio.
GAIN_MEAN = np.array([0.012, 0.012, 0.25, 1.0])
GAIN_SD = np.array([0.008, 0.008, 0.20, 0.005])
DAMPING_SD = np.array([0.15, 0.15, 1.0, 1e-9])
LAG_SD = np.array([1e-6, 1e-6, 1e-6, 1e-6])
BIAS_SD = np.array([0.5, 0.5, 1.0, 0.4])


class WrenchBalance:
    """n rotors with effectiveness matrix B (4, n). x (24,), u (n + 11,): see `pack`; theta (n,) loss; y (4,) wrench."""

    name = "wrench_balance"
    n_y = 4
    n_x = 4 * PER_AXIS
    x_names = tuple(f"{axis}.{what}" for axis in AXES for what in ("b1", "b2", "b3", "gain", "damping", "lag"))

    def __init__(self, B, prior=None):
        """prior: (mean (24,), covariance (24, 24)) from healthy flights (calibrate), else what any multirotor is like."""
        self.B = B  # numpy, or traced: one compiled program serves every airframe with n rotors
        self.n_theta = self.B.shape[1]
        self.n_u = self.n_theta + 11
        mean = np.zeros((4, PER_AXIS))
        mean[:, GAIN] = GAIN_MEAN
        mean[3, GAIN] = 1.0
        sd = np.zeros((4, PER_AXIS))
        sd[:, B3], sd[:, GAIN], sd[:, DAMPING], sd[:, LAG] = BIAS_SD, GAIN_SD, DAMPING_SD, LAG_SD
        self.x0, self.P0 = mean.reshape(-1), np.diag(sd.reshape(-1) ** 2)
        if prior is not None:
            self.x0, self.P0 = prior

    def pack(self, ticks):
        """(T, n + 11) inputs of a table of ticks: thrusts, accelerations, rates, load, rate of change of the wrench."""
        step = np.diff(ticks.wrench, axis=0, prepend=ticks.wrench[:1]) / ticks.dt
        both = ticks.valid & np.roll(ticks.valid, 1, axis=0)
        step = np.where(both, step, 0.0)
        n = self.n_theta
        return np.concatenate([ticks.thrust, ticks.rate_dot, ticks.load[:, None] * n, ticks.rate, step], axis=1)

    def C(self, u):
        """(4, 24) dy/dx."""
        from jax import numpy as jnp

        n = self.n_theta
        m, r, v = u[n : n + 4], u[n + 4 : n + 7], u[n + 7 : n + 11]
        one = jnp.ones(4)
        rows = jnp.stack([one, one, one, m, jnp.concatenate([r, jnp.zeros(1)]), -v], axis=1)
        return (jnp.eye(4)[:, :, None] * rows[:, None, :]).reshape(4, self.n_x)

    def H(self, u):
        """(4, n) dy/dtheta."""
        return self.B * u[: self.n_theta][None, :]

    def f(self, x, u, theta, dt):
        """Coloured disturbances decay; the rest stays."""
        return self.decay(dt) * x

    def h(self, x, u, theta):
        """Commanded wrench (4,)."""
        return self.C(u) @ x + self.H(u) @ theta

    def decay(self, dt):
        """(24,) diagonal of the state transition."""
        from jax import numpy as jnp

        row = jnp.concatenate([jnp.exp(-dt / jnp.array(TAU)), jnp.ones(PER_AXIS - 2)])
        return jnp.tile(row, 4)
