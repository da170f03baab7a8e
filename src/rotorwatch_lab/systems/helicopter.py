"""A single-rotor helicopter near hover whose four actuators may lose effectiveness and be displaced or jammed.

Six rigid-body equations, body axes FRD: x = (u, v, w, p, q, r). Rotor i of radius R1, root cut-out R0, speed Omega, b blades of
chord c, lift slope a and drag coefficient c_d gives, by momentum and blade element theory with the induced flow V,

    k = rho a b c / 2,   B = k Omega^2 (R1^3 - R0^3) / 3,   C = k Omega (R1^2 - R0^2) / 2,   A = pi (R1^2 - R0^2)
    s = C / (2 rho A),   V = (Vc - s) / 2 + sqrt(((Vc - s) / 2)^2 + B pitch / (2 rho A))
    T = B pitch - C V,   Q = T V / Omega + rho b c c_d Omega^2 (R1^4 - R0^4) / 8

with the climb speed Vc = -w at the main and -(v - l_T r + h_T p) at the tail rotor. The disc tilts by a1 and b1. Actuators
have U_out_i = gamma_i U_in_i + delta_i within [0, 1]: theta = (1 - gamma, delta), so jammed is a loss of 1 and a displacement.
Source: Qi, Song, Dai, Han and Wang, "Adaptive extended set-membership filter for actuator fault detection of a rotorcraft
UAV", 2015, eqs. (1)-(8); equations lost in print from momentum theory (Padfield, Helicopter Flight Dynamics, 2007).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError

PARTS = "mass inertia air_density hub_stiffness drag damping main_arm tail_arm low high trim".split()
ROTOR = ("radius", "inner_radius", "speed", "blades", "chord", "lift_slope", "drag_coefficient")


class _Rotor:
    """Thrust and torque of one rotor from blade pitch [rad] and climb speed [m/s]."""

    def __init__(self, rho: float, data: dict):
        R1, R0, speed, blades, chord, a, c_d = (float(data[part]) for part in ROTOR)
        k = 0.5 * rho * a * blades * chord
        self.B = k * speed**2 * (R1**3 - R0**3) / 3
        self.C = 0.5 * k * speed * (R1**2 - R0**2)
        self.flow = 2 * rho * math.pi * (R1**2 - R0**2)  # 2 rho A
        self.s = self.C / self.flow
        self.speed, self.drag = speed, rho * blades * chord * c_d * speed**2 * (R1**4 - R0**4) / 8

    def thrust_and_torque(self, pitch, climb):
        """(T [N], Q [N m])."""
        mean = 0.5 * (climb - self.s)
        V = mean + jnp.sqrt(mean**2 + self.B / self.flow * pitch)
        T = self.B * pitch - self.C * V
        return T, T * V / self.speed + self.drag


class Helicopter:
    """x (u, v, w [m/s], p, q, r [rad/s]); u: four commands in [0, 1] (main and tail collective, longitudinal and lateral
    cyclic), then roll and pitch attitude [rad], which are known; theta (8,): losses 1 - gamma, displacements delta; y = x."""

    name = "helicopter"
    n_x = n_y = n_u = 6
    n_theta = 8
    x_names = y_names = ("u", "v", "w", "p", "q", "r")
    x_units = y_units = ("m/s",) * 3 + ("rad/s",) * 3
    u_names = ("collective", "tail", "longitudinal", "lateral", "roll", "pitch")
    u_units = ("1",) * 4 + ("rad",) * 2
    theta_names = tuple(f"loss_{name}" for name in u_names[:4]) + tuple(f"bias_{name}" for name in u_names[:4])
    x0 = np.zeros(6)
    P0 = np.diag([0.1] * 3 + [0.05] * 3) ** 2

    def __init__(self, airframe: dict[str, Any], process_sd=(2e-3, 4e-3), velocity_sd=0.01 / 3, rate_sd=0.002 / 3, stops=True):
        """airframe: a helicopter's file, such as airframes.paper("ruav-40kg"). process_sd: of velocities [m/s] and rates
        [rad/s], that a step of 0.02 s adds; velocity_sd, rate_sd: of one measurement. stops: whether an actuator stops at 0 and 1;
        without, it is eq. (6) alone, for who knows that none is reached. Raises ConfigError."""
        jax()  # nothing of the plant may be traced before float64 is on
        missing = [part for part in (*PARTS, "main", "tail") if part not in airframe]
        missing += [f"{r}.{part}" for r in ("main", "tail") for part in ROTOR if part not in airframe.get(r, ())]
        if missing:
            raise ConfigError(f"The helicopter's airframe lacks {', '.join(missing)}.")
        for part, size in (("inertia", 3), ("drag", 3), ("damping", 3), ("main_arm", 3), ("tail_arm", 2)):
            checks.shape(part, airframe[part], size)
        for part in ("low", "high", "trim"):
            checks.shape(part, airframe[part], 4)
        self.m, self.stiffness = checks.positive("mass", airframe["mass"]), float(airframe["hub_stiffness"])
        self.I, self.drag, self.damping = (
            np.asarray(checks.positive(part, airframe[part]), float) for part in ("inertia", "drag", "damping")
        )
        self.low, self.high, self.trim = (np.asarray(airframe[part], float) for part in ("low", "high", "trim"))
        self.x_M, self.y_M, self.h_M = airframe["main_arm"]
        self.l_T, self.h_T = airframe["tail_arm"]
        rho = checks.positive("air_density", airframe["air_density"])
        self.main, self.tail = _Rotor(rho, airframe["main"]), _Rotor(rho, airframe["tail"])
        self.process_sd = checks.positive("process_sd", checks.shape("process_sd", process_sd, 2))
        self.stops = bool(stops)
        self.velocity_sd, self.rate_sd = (checks.positive("velocity_sd", velocity_sd), checks.positive("rate_sd", rate_sd))

    def outputs(self, u, theta):
        """(4,) where the actuators are: U_out."""
        U = u[:4] * (1.0 - theta[:4]) + theta[4:]
        return _within_stops()(U) if self.stops else U

    def derivative(self, x, u, theta):
        """dx/dt (6,)."""
        U = self.low + (self.high - self.low) * self.outputs(u, theta)
        pitch_M, pitch_T, a1, b1 = U[0], U[1], U[2], U[3]
        vx, vy, vz, p, q, r = (x[i] for i in range(6))
        T_M, Q_M = self.main.thrust_and_torque(pitch_M, -vz)
        T_T, Q_T = self.tail.thrust_and_torque(pitch_T, -(vy - self.l_T * r + self.h_T * p))
        sa, ca, sb, cb = jnp.sin(a1), jnp.cos(a1), jnp.sin(b1), jnp.cos(b1)
        X, Y, Z = -T_M * sa, T_M * sb, -T_M * ca * cb
        roll, pitch = u[4], u[5]
        weight = self.m * G0
        force = jnp.stack(
            [X - weight * jnp.sin(pitch), Y - T_T + weight * jnp.sin(roll) * jnp.cos(pitch), Z + weight * jnp.cos(roll) * jnp.cos(pitch)]
        )
        coriolis = jnp.stack([r * vy - q * vz, p * vz - r * vx, q * vx - p * vy])
        I1, I2, I3 = self.I
        torque = jnp.stack(
            [
                self.stiffness * b1 - Q_M * sa + self.h_M * Y + self.y_M * Z - self.h_T * T_T + (I2 - I3) * q * r,
                self.stiffness * a1 + Q_M * sb - Q_T - self.h_M * X - self.x_M * Z + (I3 - I1) * p * r,
                -Q_M * ca * cb + self.x_M * Y - self.y_M * X + self.l_T * T_T + (I1 - I2) * p * q,
            ]
        )
        return jnp.concatenate([(force - self.drag * x[:3]) / self.m + coriolis, (torque - self.damping * x[3:]) / self.I])

    def f(self, x, u, theta, dt):
        """x + dt dx/dt, the paper's model (8)."""
        return x + dt * self.derivative(x, u, theta)

    def h(self, x, u, theta):
        """x: velocities and rates are measured."""
        return x

    def Q(self, dt):
        """(6, 6): process_sd is what a step of 0.02 s adds; over other steps in proportion to time."""
        return jnp.diag(jnp.repeat(jnp.asarray(self.process_sd, float), 3) ** 2) * (dt / 0.02)

    def R(self, u):
        """(6,) variances."""
        return np.repeat([self.velocity_sd, self.rate_sd], 3) ** 2


def _within_stops():
    """Clipping to [0, 1] whose derivative is 1: between two positions within the stops the actuator moves freely, and only
    such positions exist. (Made inside, because JAX is loaded on first use.)"""
    clip: Any = jax.custom_jvp(lambda value: jnp.clip(value, 0.0, 1.0))
    clip.defjvp(lambda primal, tangent: (clip(*primal), tangent[0]))
    return clip
