"""Attitude in Hamiltonian form: Euler angles and their generalised momenta, angles measured.

    x = [q | p],  q = (phi, theta, psi),  p = M(q) dq/dt,  M = W' J W,  H = p' M^-1 p / 2
    dq/dt = dH/dp = W^-1 omega,   dp/dt = -dH/dq + tau_q,   omega = J^-1 W^-T p
    -dH/dq_i = (dW/dq_i dq/dt)' J omega,   tau_q = B diag(u) (1 - theta)

FRD, SI. W(q) turns Euler rates into body rates; p are generalised momenta, not moments. Steps are Euler's, as in the source.
The source uses the body torque as the generalised force ("printed"), which is right for small angles; W' B u is the
generalised force of a body torque ("physical"), and with it the plant is Newton's and Euler's rigid body.
Source: Rot, Hasan and Manoonpong 2020, eqs. (18)-(26); W is its R' with entry (3,2) corrected to sin phi cos theta.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import linearise, small
from rotorwatch_lab.maths.plant import Rotors

FORCES = ("printed", "physical")
FAULTS = ("multiplicative", "additive")


class PortHamiltonianAttitude:
    """x = (q, p) (6,), u (n,) thrusts [N] or body torques [N m], theta: losses of the suspects, y = q (3,)."""

    name = "port_hamiltonian_attitude"
    n_x = 6
    n_y = 3
    x_names = ("phi", "theta", "psi", "p_phi", "p_theta", "p_psi")
    x_units = ("rad",) * 3 + ("kg m^2/s",) * 3
    y_names = ("phi", "theta", "psi")
    y_units = ("rad",) * 3

    def __init__(
        self,
        J,
        B=None,
        *,
        suspects=None,
        faults: str = "multiplicative",
        generalised_force: str = "printed",
        process_var=10.0,
        measurement_var=0.04,
        x0=None,
        P0=None,
    ):
        """J (3, 3) [kg m^2]; B (3, n): body torque per input, default the identity: torques are the input ("virtual").

        suspects: zero-based inputs that may have lost effectiveness, default all; theta has one entry for each. faults: "additive"
        makes theta a torque missing from the input itself, in the unit of u: u - theta. process_var: variance that states gain
        per second, a number or (6,); measurement_var [rad^2]: a number or (3,). x0 (6,), P0 (6, 6): where
        estimators start, default 0 and the identity. Raises ConfigError.
        """
        jax()  # nothing of the plant may be traced before float64 is on
        self.J = checks.covariance("J", J, 3, definite=True)
        self.B = np.eye(3) if B is None else checks.finite("B", B)
        if np.ndim(self.B) != 2 or np.shape(self.B)[0] != 3:
            raise ConfigError(f"B must have the shape (3, n), not {np.shape(self.B)}.")
        self.n_u = np.shape(self.B)[1]
        suspects = tuple(range(self.n_u)) if suspects is None else tuple(suspects)
        if not suspects or not set(suspects) <= set(range(self.n_u)) or len(set(suspects)) != len(suspects):
            raise ConfigError(f"suspects must be different inputs from 0 to {self.n_u - 1}, not {suspects}.")
        for name, value, known in (("generalised_force", generalised_force, FORCES), ("faults", faults, FAULTS)):
            checks.one_of(name, value, known)
        self.suspects, self.faults, self.generalised_force = suspects, faults, generalised_force
        self.n_theta = len(suspects)
        self.process_var = linearise.variances("process_var", process_var, 6)
        self.measurement_var = linearise.variances("measurement_var", measurement_var, 3)
        self.x0 = np.zeros(6) if x0 is None else checks.finite("x0", checks.shape("x0", x0, 6))
        self.P0 = np.eye(6) if P0 is None else checks.covariance("P0", P0, 6)
        self._spread = np.eye(self.n_u)[:, list(suspects)]  # (n_u, n_theta)
        self._J_inverse = small.inverse(J)
        motors = B is not None
        self.u_names = tuple(f"thrust_{i + 1}" for i in range(self.n_u)) if motors else ("M_x", "M_y", "M_z")
        self.u_units = ("N" if motors else "N m",) * self.n_u
        word = "loss" if faults == "multiplicative" else "missing"
        self.theta_names = tuple(f"{word}_{i + 1}" for i in suspects)

    @classmethod
    def of(cls, airframe: dict, **options) -> PortHamiltonianAttitude:
        """The plant of an airframe file with `inertia`, `[rotors]` x, y [m], spin and `drag_ratio` [m]; inputs are thrusts in N."""
        noise = {k: airframe[k] for k in ("process_var", "measurement_var") if k in airframe}
        return cls(np.diag(np.array(airframe["inertia"], float)), Rotors.levers(airframe), **{**noise, **options})

    def derivative(self, x, u, theta):
        """dx/dt (6,)."""
        (phi, pitch, _), p = x[:3], x[3:]
        s, c, sp, cp = jnp.sin(phi), jnp.cos(phi), jnp.sin(pitch), jnp.cos(pitch)
        zero, one = jnp.zeros_like(phi), jnp.ones_like(phi)
        W_inverse = jnp.stack([jnp.stack([one, s * sp / cp, c * sp / cp]), jnp.stack([zero, c, -s]), jnp.stack([zero, s / cp, c / cp])])
        momentum = W_inverse.T @ p  # J omega
        omega = self._J_inverse @ momentum
        q_dot = W_inverse @ omega
        # dW/dphi q_dot and dW/dtheta q_dot; W does not depend on psi.
        by_phi = jnp.stack([zero, -s * q_dot[1] + c * cp * q_dot[2], -c * q_dot[1] - s * cp * q_dot[2]])
        by_pitch = -q_dot[2] * jnp.stack([cp, s * sp, c * sp])
        p_dot = jnp.stack([by_phi @ momentum, by_pitch @ momentum, zero])
        return jnp.concatenate([q_dot, p_dot + self._force(s, c, sp, cp, u, theta)])

    def _force(self, s, c, sp, cp, u, theta):
        """(3,) generalised force."""
        lost = self._spread @ theta
        torque = self.B @ (u - lost if self.faults == "additive" else u * (1.0 - lost))
        if self.generalised_force == "printed":
            return torque
        L, M, N = torque
        return jnp.stack([L, c * M - s * N, -sp * L + s * cp * M + c * cp * N])  # W' torque

    def f(self, x, u, theta, dt):
        """State after dt seconds: Euler's step."""
        return x + dt * self.derivative(x, u, theta)

    def h(self, x, u, theta):
        """Euler angles (3,) [rad]."""
        return x[:3]

    def Q(self, dt):
        """(6, 6): the tuning value, per second, over dt."""
        return jnp.diag(self.process_var) * dt

    def R(self, u):
        """(3,) variances of the angles [rad^2]: a tuning value."""
        return jnp.asarray(self.measurement_var)
