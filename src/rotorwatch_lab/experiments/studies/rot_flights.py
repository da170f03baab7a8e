"""Flights for the adaptive exogenous Kalman filter: truth by the Newton-Euler equations, RK4.

Rot, Hasan and Manoonpong 2020, section 5: motors off for 1 s, then 0.01 N each, in balance; motor 1 loses 12.4 % at
3.5 s and motor 3 loses 13.5 % at 5.5 s; 8 s in steps of 1 ms. The truth is written in body rates, not in the momenta of the plant
that the filters believe in, so that an error in one of them shows.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.experiments.studies.runge_kutta import rk4

DT, DURATION = 1e-3, 8.0
ON, THRUST = 1.0, 0.01  # s, N
ONSETS, LOSSES, MOTORS = (3.5, 5.5), (0.124, 0.135), (0, 2)
TONES, DEPTH = (0.7, 1.1, 1.3, 1.7, 1.9, 2.3), 0.5  # Hz of each motor's thrust, and its share of the mean


def clock() -> np.ndarray:
    """(T,) start time of each step [s]."""
    return np.arange(round(DURATION / DT)) * DT


def thrusts(excited: bool = False) -> np.ndarray:
    """(T, 6) thrusts [N]: constant as in the paper, or with a separate tone on each motor."""
    t = clock()[:, None]
    tones = np.sin(2.0 * np.pi * np.array(TONES) * (t - ON))
    return np.where(t >= ON, THRUST, 0.0) * (1.0 + (DEPTH * tones if excited else np.zeros(6)))


def losses() -> np.ndarray:
    """(T, 6) loss of each motor."""
    theta = np.zeros((clock().size, 6))
    for onset, loss, motor in zip(ONSETS, LOSSES, MOTORS, strict=True):
        theta[clock() >= onset, motor] = loss
    return theta


def fly(J, B, u, theta, *, shock=None) -> np.ndarray:
    """(T, 6) angles and generalised momenta after each step, from rest; the torque B diag(u) (1 - theta) is the generalised force.

    J (3, 3), B (3, n), u and theta (T, n); shock: (T, 6) added to angles and momenta after each step.
    """
    jax = load_jax()
    jnp, J = jax.numpy, np.asarray(J, float)
    J_inverse = np.linalg.inv(J)
    force = (u * (1.0 - theta)) @ np.asarray(B).T
    shock = np.zeros((len(u), 6)) if shock is None else shock

    def derivative(s, tau):
        W_inverse, omega = euler_rates(s[:3]), s[3:]
        moment = W_inverse.T @ tau - jnp.cross(omega, J @ omega)
        return jnp.concatenate([W_inverse @ omega, J_inverse @ moment])

    def step(s, now):
        tau, push = now
        s = rk4(lambda s: derivative(s, tau), s, DT)
        q, momentum = s[:3], J @ s[3:]
        q_after, p = q + push[:3], body_rates(q).T @ momentum + push[3:]
        s = jnp.concatenate([q_after, J_inverse @ (euler_rates(q_after).T @ p)])
        return s, jnp.concatenate([q_after, p])

    return np.asarray(jax.jit(lambda *table: jax.lax.scan(step, jnp.zeros(6), table)[1])(force, shock))


def body_rates(q):
    """(3, 3) W(q): body rates from Euler rates."""
    from jax import numpy as jnp

    (s, c), (sp, cp) = ((jnp.sin(a), jnp.cos(a)) for a in (q[0], q[1]))
    return jnp.array([[1.0, 0.0, -sp], [0.0, c, s * cp], [0.0, -s, c * cp]])


def euler_rates(q):
    """(3, 3) the inverse of W(q): Euler rates from body rates."""
    from jax import numpy as jnp

    (s, c), (sp, cp) = ((jnp.sin(a), jnp.cos(a)) for a in (q[0], q[1]))
    return jnp.array([[1.0, s * sp / cp, c * sp / cp], [0.0, c, -s], [0.0, s / cp, c / cp]])
