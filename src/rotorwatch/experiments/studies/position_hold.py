"""Quadrotors that hold their position when rotors weaken: the figures of position and PWM of the intermediate observer's paper.

    d2x/dt2 = U_T (cos phi sin theta cos psi + sin phi sin psi),   d2y/dt2 = U_T (cos phi sin theta sin psi - sin phi cos psi)

on top of the attitude, height and rotors of `hover_flights`, without noise and drag. The paper flew an autopilot's position hold and
prints no gains, so they are assumed: position and velocity loops with the autopilot's usual 1 / s, 1 / s and 0.5 / s^2 and tilt of at most
20 degrees, around the attitude and height PID of `hover_flights`, of which that of attitude is slowed down in time by `stiffness` s (gains
KP s^2, KD s, KI s^3): how far a vehicle is pushed off depends on it by the cube.

Source: Nguyen, Huynh, Do, Mung and Hong, Sensors 20 (2020) 4917, eq. (5).
"""

from __future__ import annotations

import functools

import numpy as np

from rotorwatch.backend import jax as load_jax
from rotorwatch.experiments.studies.hover_flights import KD, KI, KP, OBSERVER_HZ, PER_SAMPLE, PLANT_HZ, Craft

POSITION, VELOCITY, VELOCITY_I = 1.0, 1.0, 0.5  # 1/s, 1/s, 1/s^2
TILT = np.radians(20.0)
DT = 1.0 / OBSERVER_HZ


def hold(vehicle: Craft, gamma: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flights (N) from rest at the wanted place: position (N, T, 3) [m], x and y as in the equations, z up, and counts u (N, T, 4).

    gamma (N, T, 4): losses during each of T samples; stiffness (N,): 1 is the controller of `hover_flights`.
    """
    jax = load_jax()
    found = _program()(vehicle.M, vehicle.D, vehicle.gravity, vehicle.counts_max, gamma, np.asarray(stiffness, float))
    place, u = jax.tree.map(np.asarray, found)
    return place, u


@functools.cache
def _program():
    jax = load_jax()
    jnp = jax.numpy
    dt = 1.0 / PLANT_HZ

    def derivative(x, U, D, gravity):
        phi, theta, psi, p, q, r = x[0], x[1], x[2], x[4], x[5], x[6]
        I_1, I_2, I_3 = 1.0 / D[:3]
        turn = jnp.stack([(I_2 - I_3) * q * r, (I_3 - I_1) * p * r, (I_1 - I_2) * p * q])
        lift = D[3] * U[3]
        east = lift * (jnp.cos(phi) * jnp.sin(theta) * jnp.cos(psi) + jnp.sin(phi) * jnp.sin(psi))
        north = lift * (jnp.cos(phi) * jnp.sin(theta) * jnp.sin(psi) - jnp.sin(phi) * jnp.cos(psi))
        climb = lift * jnp.cos(phi) * jnp.cos(theta) - gravity
        return jnp.concatenate([x[4:8], D[:3] * (U[:3] + turn), jnp.stack([climb]), x[10:], jnp.stack([east, north])])

    def flight(M, D, gravity, counts_max, gamma, stiffness):
        inverse = jnp.linalg.pinv(D[:, None] * M)
        lift = jnp.array([0.0, 0.0, 0.0, 1.0]) * gravity
        slow_down = jnp.where(np.arange(4) < 3, stiffness, 1.0)
        kp, kd, ki = KP * slow_down**2, KD * slow_down, KI * slow_down**3

        def plant(carry, _):
            x, integral, slow, loss = carry
            missing = -POSITION * x[8:10] - x[10:]
            slow = slow + missing * dt
            push = (VELOCITY * missing + VELOCITY_I * slow) / gravity
            wanted = jnp.concatenate([jnp.clip(jnp.stack([-push[1], push[0]]), -TILT, TILT), jnp.zeros(2)])
            error = wanted - x[:4]
            integral = integral + error * dt
            u = jnp.clip(inverse @ (kp * error - kd * x[4:8] + ki * integral + lift), 0.0, counts_max)
            U = M @ (u * (1.0 - loss))
            k1 = derivative(x, U, D, gravity)
            k2 = derivative(x + 0.5 * dt * k1, U, D, gravity)
            k3 = derivative(x + 0.5 * dt * k2, U, D, gravity)
            k4 = derivative(x + dt * k3, U, D, gravity)
            return (x + dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4), integral, slow, loss), u

        def sample(carry, loss):
            (x, integral, slow, _), u = jax.lax.scan(plant, (*carry, loss), None, length=PER_SAMPLE)
            return (x, integral, slow), (jnp.stack([x[8], x[9], x[3]]), u.mean(axis=0))

        start = (jnp.zeros(12), jnp.zeros(4), jnp.zeros(2))
        return jax.lax.scan(sample, start, gamma)[1]

    return jax.jit(jax.vmap(flight, in_axes=(None, None, None, None, 0, 0)))
