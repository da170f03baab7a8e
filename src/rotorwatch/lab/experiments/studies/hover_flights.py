"""Simulated hovering flights with weakened rotors, for the intermediate observer's study: truth, made without any estimator.

    d2(phi, theta, psi)/dt2 = (U_2, U_3, U_4) / I + gyroscopic torque / I,   d2z/dt2 = -g + U_1 cos(phi) cos(theta) / m
    d2x/dt2 = U_T (cos phi sin theta cos psi + sin phi sin psi),   d2y/dt2 = U_T (cos phi sin theta sin psi - sin phi cos psi)
    (U_2, U_3, U_4, U_1) = M diag(pwm) (1 - gamma),   U_T = U_1 / m

z points up; angles are the autopilot's (roll right, nose up, nose right). Source: Nguyen, Huynh, Do, Mung and Hong, Sensors 20
(2020) 4917, eqs. (3), (5) and (39) without air drag, Runge-Kutta at 400 Hz, under a PID controller that sees noisy measurements.

For the figures of position the paper flew an autopilot's position hold and prints no gains, so they are assumed: position and velocity
loops with the autopilot's usual 1 / s, 1 / s and 0.5 / s^2 and tilt of at most 20 degrees, around the PID of attitude and height, of
which that of attitude is slowed down in time by `stiffness` s (gains KP s^2, KD s, KI s^3): how far a vehicle is pushed off depends on
it by the cube.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.lab.experiments.studies.runge_kutta import rk4

PLANT_HZ, OBSERVER_HZ = 400, 100
PER_SAMPLE = PLANT_HZ // OBSERVER_HZ
# PID on (phi, theta, psi, z): stiff in roll and pitch, where 20 % of one motor is 40 rad/s^2.
KP, KD, KI = (
    np.array([600.0, 600.0, 25.0, 9.0]),
    np.array([40.0, 40.0, 10.0, 5.0]),
    np.array([1500.0, 1500.0, 20.0, 5.0]),
)
POSITION, VELOCITY, VELOCITY_I = 1.0, 1.0, 0.5  # 1/s, 1/s, 1/s^2
TILT = np.radians(20.0)
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
    u, x = _flown(False, vehicle, gamma, reference, noise, np.ones(len(gamma)))
    # The controller saw sample k's end with the noise of the first row of sample k + 1: the observer sees the same.
    ends = np.concatenate([noise[:, PER_SAMPLE::PER_SAMPLE], noise[:, :1]], axis=1)
    return u, (x[..., :8] + ends) * np.array(
        [1, 1, 1, -1] * 2
    )  # z up -> down: the border between the paper's frame and ours


def hold(vehicle: Craft, gamma: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flights (N) without noise from rest at the wanted place: position (N, T, 3) [m], x and y as in the equations, z up, and counts u
    (N, T, 4).

    gamma (N, T, 4): losses during each of T samples; stiffness (N,): 1 is the controller of `fly`.
    """
    N, T = gamma.shape[:2]
    still = np.zeros((N, T, 4)), np.zeros((N, PER_SAMPLE * T, 8))
    u, x = _flown(True, vehicle, gamma, *still, np.asarray(stiffness, float))
    return x[..., [8, 9, 3]], u


def _flown(holds: bool, vehicle: Craft, gamma, reference, noise, stiffness) -> tuple[np.ndarray, np.ndarray]:
    """Mean counts (N, T, n) over each sample, and the states (N, T, 12) at its end: angles and height, their rates, x, y, their rates."""
    M, D = vehicle.M, vehicle.D
    rows = noise.reshape(*gamma.shape[:2], PER_SAMPLE, 8)
    found = _program(holds)(M, D, vehicle.gravity, vehicle.counts_max, gamma, reference, rows, stiffness)
    return np.asarray(found[0]), np.asarray(found[1])


@functools.cache
def _program(holds: bool):
    """Compiled. holds: where the vehicle should be is the place it began at, else `reference` (T, 4) says its angles and height."""
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
        return jnp.concatenate([x[4:8], D[:3] * (U[:3] + turn), climb[None], x[10:], jnp.stack([east, north])])

    def flight(M, D, gravity, counts_max, gamma, reference, noise, stiffness):
        inverse = jnp.linalg.pinv(D[:, None] * M)
        lift = jnp.array([0.0, 0.0, 0.0, 1.0]) * gravity
        slow_down = jnp.where(np.arange(4) < 3, stiffness, 1.0)
        kp, kd, ki = KP * slow_down**2, KD * slow_down, KI * slow_down**3

        def plant(carry, row):
            x, integral, slow, loss, wanted = carry
            if holds:
                missing = -POSITION * x[8:10] - x[10:]
                slow = slow + missing * dt
                push = (VELOCITY * missing + VELOCITY_I * slow) / gravity
                wanted = jnp.concatenate([jnp.clip(jnp.stack([-push[1], push[0]]), -TILT, TILT), jnp.zeros(2)])
            seen = x[:8] + row
            error = wanted - seen[:4]
            integral = integral + error * dt
            u = jnp.clip(inverse @ (kp * error - kd * seen[4:] + ki * integral + lift), 0.0, counts_max)
            U = M @ (u * (1.0 - loss))
            return (rk4(lambda x: derivative(x, U, D, gravity), x, dt), integral, slow, loss, wanted), u

        def sample(carry, row):
            loss, wanted, noise = row
            (x, integral, slow, *_), u = jax.lax.scan(plant, (*carry, loss, wanted), noise)
            return (x, integral, slow), (u.mean(axis=0), x)

        start = (jnp.zeros(12), jnp.zeros(4), jnp.zeros(2))
        return jax.lax.scan(sample, start, (gamma, reference, noise))[1]

    return jax.jit(jax.vmap(flight, in_axes=(None, None, None, None, 0, 0, 0, 0)))
