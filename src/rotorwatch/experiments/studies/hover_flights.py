"""Simulated hovering flights with weakened rotors, for the intermediate observer's study: truth, made without any estimator.

    d2(phi, theta, psi)/dt2 = (U_2, U_3, U_4) / I + gyroscopic torque / I,   d2z/dt2 = -g + U_1 cos(phi) cos(theta) / m
    (U_2, U_3, U_4, U_1) = M diag(pwm) (1 - gamma)

z points up; angles are the autopilot's (roll right, nose up, nose right). Source: Nguyen, Huynh, Do, Mung and Hong, Sensors 20
(2020) 4917, eqs. (3), (5) and (39) without air drag, Runge-Kutta at 400 Hz, under a PID controller that sees noisy measurements.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rotorwatch.backend import jax as load_jax

PLANT_HZ, OBSERVER_HZ = 400, 100
PER_SAMPLE = PLANT_HZ // OBSERVER_HZ
# PID on (phi, theta, psi, z): stiff in roll and pitch, where 20 % of one motor is 40 rad/s^2.
KP, KD, KI = (
    np.array([600.0, 600.0, 25.0, 9.0]),
    np.array([40.0, 40.0, 10.0, 5.0]),
    np.array([1500.0, 1500.0, 20.0, 5.0]),
)
SD = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.01, 0.01, 0.01, 0.05])  # rad, m, rad/s, m/s


@dataclass(frozen=True)
class Craft:
    """M (4, n): (U_2, U_3, U_4, U_1) per count; D (4,): 1 / (I_1, I_2, I_3, m); gravity; counts_max; file: as an airframe file."""

    M: np.ndarray
    D: np.ndarray
    gravity: float
    counts_max: float
    file: dict

    @property
    def hover(self) -> float:
        """Counts of every motor in hover."""
        return self.gravity / (self.D[3] * self.M[3].sum())


def craft(file: dict) -> Craft:
    """Of an airframe file: eq. (3), for any number of rotors."""
    x, y, spin = (np.array(file["rotors"][k], float) for k in ("x", "y", "spin"))
    thrust = file["thrust_max"] / file["counts_max"]
    M = thrust * np.stack([-y, x, file["drag_ratio"] * spin, np.ones(x.size)])
    D = 1.0 / np.array([*file["inertia"], file["mass"]])
    return Craft(M, D, file["gravity"], file["counts_max"], file)


def ring(file: dict, rotors: int) -> dict:
    """The same motors on a regular ring of the same arm; mass and inertia grow with the number of rotors."""
    azimuth = np.pi * (2 * np.arange(rotors) + 1) / rotors
    share = rotors / len(file["rotors"]["x"])
    where = {
        "x": file["arm"] * np.cos(azimuth),
        "y": file["arm"] * np.sin(azimuth),
        "spin": 1.0 - 2.0 * (np.arange(rotors) % 2),
    }
    return {**file, "rotors": where, "mass": share * file["mass"], "inertia": share * np.array(file["inertia"])}


def fly(vehicle: Craft, gamma, reference, noise):
    """Flights (N): u (N, T, n) mean counts over each of T samples, y (N, T, 8) = (roll, pitch, yaw, down, their rates), NED/FRD.

    gamma (N, T, n): loss during each sample; reference (N, T, 4): wanted (phi, theta, psi, z); noise (N, 4 T, 8): on what the
    controller and the observer see, every fourth row by both.
    """
    jax = load_jax()
    u, y = jax.tree.map(
        np.asarray, _program(vehicle.M.shape[1])(vehicle.M, vehicle.D, vehicle.gravity, gamma, reference, noise)
    )
    return u, y * np.array([1, 1, 1, -1] * 2)  # z up -> down: the border between the paper's frame and ours


@functools.cache
def _program(rotors: int):
    """Compiled once for each number of rotors (and size of the tables)."""
    jax = load_jax()
    jnp = jax.numpy
    dt, counts_max = 1.0 / PLANT_HZ, 1000.0

    def derivative(x, U, D, gravity):
        p, q, r = x[4:7]
        I_1, I_2, I_3 = 1.0 / D[:3]
        turn = jnp.stack([(I_2 - I_3) * q * r, (I_3 - I_1) * p * r, (I_1 - I_2) * p * q])
        climb = D[3] * U[3] * jnp.cos(x[0]) * jnp.cos(x[1]) - gravity
        return jnp.concatenate([x[4:], D[:3] * (U[:3] + turn), jnp.reshape(climb, (1,))])

    def flight(M, D, gravity, gamma, reference, noise):
        inverse = jnp.linalg.pinv(D[:, None] * M)
        lift = jnp.array([0.0, 0.0, 0.0, 1.0]) * gravity

        def plant(carry, row):
            x, integral, loss, wanted = carry
            seen = x + row
            error = wanted - seen[:4]
            integral = integral + error * dt
            u = jnp.clip(inverse @ (KP * error - KD * seen[4:] + KI * integral + lift), 0.0, counts_max)
            U = M @ (u * (1.0 - loss))
            k1 = derivative(x, U, D, gravity)
            k2 = derivative(x + 0.5 * dt * k1, U, D, gravity)
            k3 = derivative(x + 0.5 * dt * k2, U, D, gravity)
            k4 = derivative(x + dt * k3, U, D, gravity)
            return (x + dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4), integral, loss, wanted), u

        def sample(carry, row):
            x, integral = carry
            loss, wanted, noise = row
            (x, integral, _, _), u = jax.lax.scan(plant, (x, integral, loss, wanted), noise)
            return (x, integral), (u.mean(axis=0), x)

        T = gamma.shape[0]
        start = (jnp.zeros(8), jnp.zeros(4))
        _, (u, x) = jax.lax.scan(sample, start, (gamma, reference, noise.reshape(T, PER_SAMPLE, 8)))
        # The controller saw sample k's end with the noise of the first row of sample k + 1: the observer sees the same.
        ends = jnp.concatenate([noise[PER_SAMPLE::PER_SAMPLE], noise[:1]])
        return u, x + ends

    return jax.jit(jax.vmap(flight, in_axes=(None, None, None, 0, 0, 0)))
