"""Rigid-body rotation with per-rotor thrusts, and the thrust felt by the accelerometer: the plant every method can run on.

    J d(omega)/dt = B_tau diag(u) (1 - theta) - omega x J omega - D omega + tau_0
              f_z = -(B_T diag(u) (1 - theta) + F_0) / m

FRD, SI. omega: body rates [rad/s]. u (n,): thrust command of each rotor, in the unit in which B_tau [N m per unit] and B_T
[N per unit] are given. theta (n,): loss of effectiveness. f_z: specific force along body z [m/s^2], -g in hover.
D: rotational damping [N m s]. tau_0 [N m], F_0 [N]: constant torque and upward force that the rotors trim.
Source: Niermeyer, Pak and Lohmann 2017, eqs. (1)-(6). Without a scale of mass and inertia it holds in any unit of torque and
force: with thrusts in hover thrusts of one rotor, J is what the default diagnoser learns as its motion gains.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch_lab.maths import small
from rotorwatch_lab.maths.plant import Rotors


class RateDynamics(Rotors):
    """x = omega (3,), u (n,) thrust commands, theta (n,) losses, y = (omega, f_z) (4,)."""

    name = "rate_dynamics"
    n_x = 3
    n_y = 4
    x_names = ("p", "q", "r")
    x_units = ("rad/s",) * 3
    y_names = ("p", "q", "r", "f_z")
    y_units = ("rad/s", "rad/s", "rad/s", "m/s^2")
    x0 = np.zeros(3)
    P0 = np.eye(3)  # at rest, give or take 1 rad/s

    def __init__(self, J, B_tau, B_T, m, gyro_sd=0.01, accel_sd=0.3, torque_sd=None, damping=None, tau_0=None, F_0=0.0):
        """J (3, 3) [kg m^2], B_tau (3, n), B_T (n,), m [kg]; gyro_sd (3,) or scalar [rad/s] and accel_sd [m/s^2] of one sample.

        torque_sd (3,) or scalar: disturbance torque as white noise, N m per square root of Hz (default: 2 % of the largest
        lever times a second's square root). damping (3,): diagonal of D. Raises ConfigError for wrong shapes or an inertia that
        is not positive definite.
        """
        n = np.shape(B_T)[0]
        self.name_rotors(n)
        checks.shape("B_tau", B_tau, 3, n)
        self.J = checks.covariance("J", J, 3, definite=True)
        self.J_inverse = small.inverse(self.J)
        self.B_tau, self.B_T, self.m = B_tau, B_T, checks.positive("m", m)
        self.gyro_sd, self.accel_sd = gyro_sd, accel_sd
        self.torque_sd = 0.02 * abs(B_tau).max(axis=1) if torque_sd is None else torque_sd
        self.damping = np.zeros(3) if damping is None else checks.shape("damping", damping, 3)
        self.tau_0, self.F_0 = (np.zeros(3) if tau_0 is None else checks.shape("tau_0", tau_0, 3)), F_0

    @classmethod
    def of(cls, airframe: dict) -> RateDynamics:
        """The plant of an airframe file with `mass`, `inertia`, `[rotors]` x, y [m], spin, `thrust_max` [N], `drag_ratio` [m]."""
        T, levers = float(airframe["thrust_max"]), cls.levers(airframe)
        J, B_T = np.diag(airframe["inertia"]).astype(float), np.full(levers.shape[1], T)
        return cls(J, T * levers, B_T, float(airframe["mass"]))

    def derivative(self, x, u, theta):
        """d(omega)/dt (3,) [rad/s^2]."""
        torque = self.B_tau @ (u * (1.0 - theta)) + self.tau_0
        return self.J_inverse @ (torque - jnp.cross(x, jnp.asarray(self.J) @ x) - self.damping * x)

    def f(self, x, u, theta, dt):
        """omega after dt seconds of constant u: midpoint rule (error of order dt^3)."""
        half = x + 0.5 * dt * self.derivative(x, u, theta)
        return x + dt * self.derivative(half, u, theta)

    def h(self, x, u, theta):
        """(omega, f_z)."""
        f_z = -(self.B_T @ (u * (1.0 - theta)) + self.F_0) / self.m
        return jnp.concatenate([x, jnp.reshape(f_z, (1,))])

    def Q(self, dt):
        """(3, 3): white disturbance torque over dt."""
        root = self.J_inverse * (self.torque_sd * jnp.ones(3))
        return dt * root @ root.T

    def R(self, u):
        """(4,) variances of gyro and accelerometer."""
        return jnp.concatenate([jnp.broadcast_to(self.gyro_sd, (3,)), jnp.reshape(self.accel_sd, (1,))]) ** 2
