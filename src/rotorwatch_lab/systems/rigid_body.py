"""Rigid body in space with n rotors: position, attitude, velocity and body rates; measured are position and attitude.

    dp/dt = v                          m dv/dt = m g e_3 - R(phi, theta, psi) e_3 F,       F = B_T diag(u) (1 - loss)
    d(phi, theta, psi)/dt = W omega    J d(omega)/dt = B_tau diag(u) (1 - loss) - omega x J omega

World NED, body FRD, SI, Euler angles yaw-pitch-roll. B_T (n,), B_tau (3, n): thrust [N] and torque [N m] of each rotor at
u = 1. Source: Zhang, Zhang, Li, Qin and Xu, ATSUKF-based actuator health assessment, Drones 7 (2023) 12, eqs. (1)-(2) and
(6), with two differences: signs lost in print are restored, and Euler angles follow the body rates exactly
(W omega) where the paper takes one for the other, as is right near hover. Discretised by Euler's method, eq. (10).
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import small
from rotorwatch_lab.maths.plant import Rotors

POSE = ("north", "east", "down", "roll", "pitch", "yaw")


class RigidBody(Rotors):
    """x = (position, Euler angles, velocity, body rates) (12,), u (n,) commands in [0, 1], theta (n,) losses, y as chosen."""

    name = "rigid_body"
    n_x = 12
    x_names = (*POSE, "v_north", "v_east", "v_down", "p", "q", "r")
    x_units = ("m",) * 3 + ("rad",) * 3 + ("m/s",) * 3 + ("rad/s",) * 3

    def __init__(self, J, B_tau, B_T, m, *, gravity=G0, measured=POSE, measured_sd=3e-4, walk=(1e-3,) * 6 + (1e-6,) * 6, x0=None, P0=None):
        """J (3, 3) [kg m^2], B_tau (3, n) [N m], B_T (n,) [N], m [kg], gravity [m/s^2].

        measured: which of x_names; measured_sd: of one sample of each, scalar or (n_y,), in their units. walk (12,): white
        process noise, growth of each state's variance [unit^2/s]. x0 (12,), P0 (12, 12): where an estimator starts (at the
        origin, give or take one unit). Raises ConfigError for wrong shapes, names or an inertia that is not positive definite.
        """
        n = np.shape(B_T)[0]
        self.name_rotors(n)
        self.J = checks.covariance("J", J, 3, definite=True)
        self.J_inverse = small.inverse(self.J)
        self.B_tau, self.B_T = checks.shape("B_tau", B_tau, 3, n), B_T
        self.m, self.gravity = checks.positive("m", m), gravity
        unknown = [name for name in measured if name not in self.x_names]
        if unknown or not measured:
            raise ConfigError(f"measured must name some of {', '.join(self.x_names)}, not {', '.join(unknown) or 'none of them'}.")
        self.index = np.array([self.x_names.index(name) for name in measured])
        self.y_names, self.y_units = tuple(measured), tuple(self.x_units[k] for k in self.index)
        self.n_y = len(self.index)
        self.measured_sd = checks.positive("measured_sd", measured_sd)
        if np.ndim(measured_sd):
            checks.shape("measured_sd", measured_sd, self.n_y)
        self.walk = checks.between("walk", checks.shape("walk", walk, 12), 0.0, np.inf)
        self.x0 = np.zeros(12) if x0 is None else checks.finite("x0", checks.shape("x0", x0, 12))
        self.P0 = np.eye(12) if P0 is None else checks.covariance("P0", P0, 12)

    @classmethod
    def of(cls, airframe: dict, **options) -> RigidBody:
        """The plant of an airframe file with `mass`, `inertia`, `[rotors]` x, y [m], spin, `thrust_max` [N], `drag_ratio` [m].

        `gravity`, `walk` and `measured_sd` are taken where it has them; options: the constructor's keywords, first choice.
        """
        T, levers = float(airframe["thrust_max"]), cls.levers(airframe)
        from_airframe = {k: airframe[k] for k in ("gravity", "walk", "measured_sd") if k in airframe}
        J = np.diag(airframe["inertia"]).astype(float)
        return cls(J, T * levers, np.full(levers.shape[1], T), float(airframe["mass"]), **(from_airframe | options))

    def derivative(self, x, u, theta):
        """dx/dt (12,)."""
        angles, velocity, omega = x[3:6], x[6:9], x[9:12]
        (s_phi, s_theta, s_psi), (c_phi, c_theta, c_psi) = jnp.sin(angles), jnp.cos(angles)
        thrust = u * (1.0 - theta)
        down = jnp.stack(  # body z axis in the world
            [c_phi * s_theta * c_psi + s_phi * s_psi, c_phi * s_theta * s_psi - s_phi * c_psi, c_phi * c_theta]
        )
        acceleration = jnp.array([0.0, 0.0, self.gravity]) - down * (self.B_T @ thrust) / self.m
        p, q, r = omega
        turning = q * s_phi + r * c_phi
        euler_rates = jnp.stack([p + turning * s_theta / c_theta, q * c_phi - r * s_phi, turning / c_theta])
        torque = self.B_tau @ thrust - jnp.cross(omega, jnp.asarray(self.J) @ omega)
        return jnp.concatenate([velocity, euler_rates, acceleration, self.J_inverse @ torque])

    def f(self, x, u, theta, dt):
        """State after dt seconds of constant u: Euler's step."""
        return x + dt * self.derivative(x, u, theta)

    def h(self, x, u, theta):
        """The measured states."""
        return x[self.index]

    def Q(self, dt):
        """(12, 12): white noise on every state over dt."""
        return dt * jnp.diag(jnp.asarray(self.walk, float))

    def R(self, u):
        """(n_y,) measurement variances."""
        return jnp.broadcast_to(jnp.asarray(self.measured_sd, float), (self.n_y,)) ** 2
