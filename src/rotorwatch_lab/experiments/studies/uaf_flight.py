"""The hovering UAF-02E with weakening motors: truth and closed loop, independent of the estimators' code.

The rigid body turns by quaternion and is integrated by Runge-Kutta's fourth-order rule at a quarter of the control step; the
controller, which the paper leaves open, is a cascade of PID loops on the true state that keeps the vehicle 1 m above ground.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.experiments.studies.runge_kutta import rk4
from rotorwatch_lab.simulation import rotation

DT = 0.01  # s: control, measurement and filter step
SUBSTEPS = 4
SECONDS = 90.0
ONSET = 50.0  # s: the step of the loss
STEP = 0.4
TARGET = (0.0, 0.0, -1.0)  # m, NED

# Gains of the position loop [1/s^2, 1/s, 1/s^3] and of the attitude loop, per axis.
POSITION_P, POSITION_D, POSITION_I = 2.0, 2.5, (0.5, 0.5, 1.0)
ATTITUDE_P, ATTITUDE_D, ATTITUDE_I = (100.0, 100.0, 16.0), (18.0, 18.0, 8.0), (150.0, 150.0, 10.0)
TILT = 0.4  # rad, at most


def losses(scenario: int, motors: int = 4) -> np.ndarray:
    """(T, motors) true losses: 0.02 (t - 30) from 30 to 40 s and 0.4 from 50 to 80 s, of motor 1 or of all (scenario 2)."""
    t = np.arange(round(SECONDS / DT)) * DT
    loss = np.where((t >= 30) & (t < 40), 0.02 * (t - 30), 0.0) + np.where((t >= ONSET) & (t < 80), STEP, 0.0)
    return loss[:, None] * (np.eye(motors)[0] if scenario == 1 else np.ones(motors))


def fly(airframe: dict, loss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Commands u (T, n) and pose (T, 6) [m, rad] after each, of a flight with these true losses (T, n)."""
    jax = load_jax()
    jnp = jax.numpy
    m, g, J = float(airframe["mass"]), float(airframe["gravity"]), np.array(airframe["inertia"])
    x, y, spin = (np.array(airframe["rotors"][k], float) for k in ("x", "y", "spin"))
    wrench = airframe["thrust_max"] * np.stack([np.ones_like(x), -y, x, airframe["drag_ratio"] * spin])
    allocation = np.linalg.pinv(wrench)

    def rate(s, thrust):
        q, v, omega = s[3:7], s[7:10], s[10:]
        force, torque = (wrench @ thrust)[0], (wrench @ thrust)[1:]
        body_down = jnp.stack([row[2] for row in rotation.axes(q)])
        acceleration = jnp.array([0.0, 0.0, g]) - body_down * force / m
        return jnp.concatenate([v, rotation.rate(q, omega), acceleration, (torque - jnp.cross(omega, J * omega)) / J])

    def angles(s):
        a, b, c, d = s[3:7]
        roll = jnp.arctan2(2 * (c * d + a * b), 1 - 2 * (b * b + c * c))
        pitch = jnp.arcsin(2 * (a * c - b * d))
        return jnp.stack([roll, pitch, jnp.arctan2(2 * (b * c + a * d), 1 - 2 * (c * c + d * d))])

    def control(s, integral):
        attitude, off = angles(s), jnp.array(TARGET) - s[:3]
        acceleration = POSITION_P * off - POSITION_D * s[7:10] + integral[:3]
        cos, sin = jnp.cos(attitude[2]), jnp.sin(attitude[2])
        forward, right = cos * acceleration[0] + sin * acceleration[1], cos * acceleration[1] - sin * acceleration[0]
        wanted = jnp.clip(jnp.stack([right, -forward]) / g, -TILT, TILT)
        tilt = jnp.concatenate([wanted, jnp.zeros(1)]) - attitude
        torque = J * (jnp.array(ATTITUDE_P) * tilt - jnp.array(ATTITUDE_D) * s[10:] + integral[3:])
        u = jnp.clip(allocation @ jnp.concatenate([jnp.stack([m * (g - acceleration[2])]), torque]), 0.0, 1.0)
        return u, integral + DT * jnp.concatenate([jnp.array(POSITION_I) * off, jnp.array(ATTITUDE_I) * tilt])

    def step(carry, loss):
        s, integral = carry
        u, integral = control(s, integral)
        thrust, h = u * (1.0 - loss), DT / SUBSTEPS
        for _ in range(SUBSTEPS):
            s = rk4(lambda s: rate(s, thrust), s, h)
        return (s, integral), (u, jnp.concatenate([s[:3], angles(s)]))

    start = jnp.array([*TARGET, 1.0, *np.zeros(9)])
    u, pose = jax.jit(lambda loss: jax.lax.scan(step, (start, jnp.zeros(6)), loss)[1])(loss)
    return np.asarray(u), np.asarray(pose)
