"""Commanded wrench = what the motion needed + slow disturbances + what faulty rotors did not deliver.

The default diagnoser's plant. Nothing of the vehicle but its geometry is needed: for each axis a of roll, pitch, yaw and thrust

    y_a = G_a m_a + c_a r_a + l f_a + b1_a + b2_a + b3_a + sum_i B_ai T_i theta_i + noise

y = B T: commanded wrench; T (n,): commanded thrusts (hover thrust of one rotor = 1); m: angular acceleration [rad/s^2], and for
thrust the load factor times n; r: angular rate [rad/s] (damping, none for thrust); f: side force per mass [m/s^2], -right for roll
and forward for pitch, with one l; b1, b2: coloured disturbances with time
constants TAU (gusts, and what the controller makes of them); b3: slow drift (wind,
centre of mass, battery), a random walk. theta_i: loss of rotor i. Per axis the state is (b1, b2, b3, G, c). It is linear
in the state for given u, and in theta.
"""

from __future__ import annotations

import numpy as np

TAU = (0.25, 1.0)  # s
PER_AXIS = 5
B1, B2, B3, GAIN, DAMPING = range(PER_AXIS)
SIDEWAYS = 3 * PER_AXIS + DAMPING  # thrust has no damping: its place holds l
AXES = ("roll", "pitch", "yaw", "thrust")

# What any multirotor is like, in these units. Angular gains of roll, pitch and yaw, per rotor: squared radius of gyration over
# g times the arm (over g times the propellers' drag ratio for yaw), 3 to 60 cm arms. Motion dies out, at DAMPING_RATE in
# 1/s, from air through the rotors and past the body: damping is that rate times the gain, whatever the gain turns out to be.
# Thrust against load factor is one to one by the choice of unit.
GAIN_MEAN = np.array([0.005, 0.005, 0.13, 0.0])
GAIN_SD = np.array([0.004, 0.004, 0.1, 0.005])
DAMPING_RATE, DAMPING_RATE_SD = 2.0, 1.5
# Hover thrusts per m/s^2 of side force and rotor: air that pushes the body sideways also tilts it, by the flapping of its blades and by
# where it pushes. Real quadrotors: 0.05 to 0.2; rigid rotors in the plane of the centre of mass: 0.
SIDE, SIDE_SD = 0.05, 0.07
BIAS_SD = np.array([0.5, 0.5, 1.0, 0.4])


class WrenchBalance:
    """n rotors with effectiveness matrix B (4, n). x (20,), u (n + 10,): see `pack`; theta (n,) loss; y (4,) wrench."""

    name = "wrench_balance"
    n_y = 4
    n_x = 4 * PER_AXIS
    x_names = tuple(
        "side force" if axis == "thrust" and what == "damping" else f"{axis}.{what}"
        for axis in AXES
        for what in ("b1", "b2", "b3", "gain", "damping")
    )

    def __init__(self, B, prior=None):
        """prior: (mean (20,), covariance (20, 20)) from healthy flights (calibrate), else what any multirotor is like."""
        self.B = B  # numpy, or traced: one compiled program serves every airframe with n rotors
        self.n_theta = B.shape[1]
        self.n_u = self.n_theta + 10
        self.x0, self.P0 = any_multirotor(self.n_theta) if prior is None else prior

    def pack(self, ticks):
        """(T, n + 10) inputs of a table of ticks: thrusts, angular accelerations, n times load factor, angular rates, side forces
        forward and right [m/s^2], full thrust of a rotor. Thrusts in hover thrusts."""
        load = ticks.load[:, None] * self.n_theta
        side = np.zeros((len(load), 2)) if ticks.side is None else ticks.side
        full = 1.0 / ticks.hover[:, None]
        return np.concatenate([ticks.thrust, ticks.rate_dot, load, ticks.rate, side, full], axis=1)

    def C(self, u):
        """(4, 20) dy/dx."""
        from jax import numpy as jnp

        n = self.n_theta
        one = jnp.ones(4)
        rates = jnp.concatenate([u[n + 4 : n + 7], jnp.zeros(1)])
        rows = jnp.stack([one, one, one, u[n : n + 4], rates], axis=1)
        C = (jnp.eye(4)[:, :, None] * rows[:, None, :]).reshape(4, self.n_x)
        push = jnp.stack([-u[n + 8], u[n + 7], *jnp.zeros(2)])
        return C + push[:, None] * (np.arange(self.n_x) == SIDEWAYS)

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
        """(20,) diagonal of the state transition: constant for a dt that is known, traced for one that is not."""
        left = fading(dt)
        if isinstance(left, np.ndarray):
            return np.tile([*left, 1.0, 1.0, 1.0], 4)
        from jax import numpy as jnp

        return jnp.tile(jnp.stack([*left, 1.0, 1.0, 1.0]), 4)


def fading(dt):
    """(2,) share of b1 and b2 that is left after dt seconds: constant for a dt that is known, traced for one that is not."""
    if isinstance(dt, (int, float)):
        return np.exp(-dt / np.array(TAU))
    from jax import numpy as jnp

    return jnp.exp(-dt / jnp.array(TAU))


def any_multirotor(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(mean (20,), covariance (20, 20)) of the state before anything is known of a vehicle with n rotors."""
    mean, P = np.zeros((4, PER_AXIS)), np.zeros((4, PER_AXIS, 4, PER_AXIS))
    for axis in range(4):
        gain, sd = (n * GAIN_MEAN[axis], n * GAIN_SD[axis]) if axis < 3 else (1.0, GAIN_SD[axis])
        rate, rate_sd = (DAMPING_RATE, DAMPING_RATE_SD) if axis < 3 else (0.0, 0.0)
        mean[axis, GAIN], mean[axis, DAMPING] = gain, rate * gain
        P[axis, B3, axis, B3] = BIAS_SD[axis] ** 2
        P[axis, GAIN, axis, GAIN] = sd**2
        P[axis, GAIN, axis, DAMPING] = P[axis, DAMPING, axis, GAIN] = rate * sd**2
        P[axis, DAMPING, axis, DAMPING] = (rate * sd) ** 2 + rate_sd**2 * (gain**2 + sd**2)
    mean, P = mean.reshape(-1), P.reshape(4 * PER_AXIS, 4 * PER_AXIS)
    mean[SIDEWAYS], P[SIDEWAYS, SIDEWAYS] = n * SIDE, (n * SIDE_SD) ** 2
    return mean, P


def usual_gains(n: int) -> np.ndarray:
    """(4,) gains of an n-rotor vehicle that nothing is known of."""
    return any_multirotor(n)[0].reshape(4, PER_AXIS)[:, GAIN]
