"""Commanded wrench = what the motion needed + slow disturbances + what faulty rotors did not deliver.

The default diagnoser's plant. Nothing of the vehicle but its geometry is needed: for each axis a of roll, pitch, yaw and thrust

    y_a = G_a m_a + c_a r_a + b1_a + b2_a + b3_a + sum_i B_ai T_i theta_i + noise

y = B T: commanded wrench; T (n,): commanded thrusts (hover thrust of one rotor = 1); m: angular acceleration [rad/s^2], and for
thrust the load factor times n; r: angular rate [rad/s] (damping), and for thrust the climb [m/s]: rotors give less in air that comes
down through them; b1, b2: coloured disturbances with time
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

# What any multirotor is like, in these units. Angular gains of roll, pitch and yaw, per rotor: squared radius of gyration over
# g times the arm (over g times the propellers' drag ratio for yaw), 3 to 60 cm arms. Motion dies out, at DAMPING_RATE in
# 1/s, from air through the rotors and past the body: damping is that rate times the gain, whatever the gain turns out to be.
# Thrust against load factor is one to one by the choice of unit.
GAIN_MEAN = np.array([0.005, 0.005, 0.13, 0.0])
GAIN_SD = np.array([0.004, 0.004, 0.1, 0.005])
DAMPING_RATE, DAMPING_RATE_SD = 2.0, 1.5
# Share of a rotor's hover thrust that one m/s of climb takes (blade-element theory: about a tenth of 1 m/s over the induced
# velocity, which is 3 to 10 m/s).
CLIMB, CLIMB_SD = 0.05, 0.03
CLIMB_MEMORY_S, LOAD_MEMORY_S = 3.0, 6.0
G0 = 9.80665
BIAS_SD = np.array([0.5, 0.5, 1.0, 0.4])


class WrenchBalance:
    """n rotors with effectiveness matrix B (4, n). x (20,), u (n + 8,): see `pack`; theta (n,) loss; y (4,) wrench."""

    name = "wrench_balance"
    n_y = 4
    n_x = 4 * PER_AXIS
    x_names = tuple(f"{axis}.{what}" for axis in AXES for what in ("b1", "b2", "b3", "gain", "damping"))

    def __init__(self, B, prior=None):
        """prior: (mean (20,), covariance (20, 20)) from healthy flights (calibrate), else what any multirotor is like."""
        self.B = B  # numpy, or traced: one compiled program serves every airframe with n rotors
        self.n_theta = B.shape[1]
        self.n_u = self.n_theta + 8
        self.x0, self.P0 = any_multirotor(self.n_theta) if prior is None else prior

    def pack(self, ticks):
        """(T, n + 8) inputs of a table of ticks: thrusts, angular accelerations, n times load factor, angular rates, climb."""
        load = ticks.load[:, None] * self.n_theta
        climb = climbing(ticks.load, ticks.valid[:, 3], ticks.restart, ticks.dt)[:, None]
        return np.concatenate([ticks.thrust, ticks.rate_dot, load, ticks.rate, climb], axis=1)

    def C(self, u):
        """(4, 20) dy/dx."""
        from jax import numpy as jnp

        n = self.n_theta
        one = jnp.ones(4)
        rates = u[n + 4 : n + 8]
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
    mean[3, DAMPING], P[3, DAMPING, 3, DAMPING] = n * CLIMB, (n * CLIMB_SD) ** 2
    return mean.reshape(-1), P.reshape(4 * PER_AXIS, 4 * PER_AXIS)


def usual_gains(n: int) -> np.ndarray:
    """(4,) gains of an n-rotor vehicle that nothing is known of."""
    return any_multirotor(n)[0].reshape(4, PER_AXIS)[:, GAIN]


def climbing(load, valid, restart, dt: float) -> np.ndarray:
    """(T,) climb in m/s from load factors (T,): what exceeds their mean over LOAD_MEMORY_S adds up and fades over CLIMB_MEMORY_S.

    Quick changes of climb are right, steady climbs and the load of a lean are lost: those are slow, and drift stands for them.
    """
    out, speed, mean = np.zeros(len(load)), 0.0, 1.0
    for k, (now, ok, new) in enumerate(zip(load.tolist(), valid.tolist(), restart.tolist())):
        if new:
            speed, mean = 0.0, now if ok else 1.0
        speed *= 1.0 - dt / CLIMB_MEMORY_S
        if ok:
            speed += (now - mean) * G0 * dt
            mean += (now - mean) * (dt / LOAD_MEMORY_S)
        out[k] = speed
    return out
