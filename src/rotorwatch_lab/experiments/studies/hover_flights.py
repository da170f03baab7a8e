"""Simulated hovering flights with weakened rotors, for the intermediate observer's study: truth, made without any estimator.

    d2(phi, theta, psi)/dt2 = (U_2, U_3, U_4) / I + gyroscopic torque / I,   d2z/dt2 = -g + U_1 cos(phi) cos(theta) / m
    gyroscopic torque = ((I_2 - I_3) q r - J_r Omega q, (I_3 - I_1) p r + J_r Omega p, (I_1 - I_2) p q),   (p, q, r) = rates
    d2x/dt2 = U_T (cos phi sin theta cos psi + sin phi sin psi),   d2y/dt2 = U_T (cos phi sin theta sin psi - sin phi cos psi)
    (U_2, U_3, U_4, U_1) = M diag(pwm) (1 - gamma),   U_T = U_1 / m

z points up; angles are the autopilot's (roll right, nose up, nose right). Source: Nguyen, Huynh, Do, Mung and Hong, Sensors 20
(2020) 4917, eqs. (3), (5), (6) and (39), Runge-Kutta at 400 Hz, under a PID controller that sees noisy measurements. Omega is the sum
of the rotors' speeds with their directions, a speed growing with the root of the thrust; eq. (6) prints the second gyroscopic term of
the rotors with the sign of the first, which would do work on the vehicle. Air drag (eq. 5) acts in `uncertain` alone.

For the figures of position the paper flew an autopilot's position hold and prints no gains, so they are assumed: position and velocity
loops with the autopilot's usual 1 / s, 1 / s and 0.5 / s^2 and tilt of at most 20 degrees, around the PID of attitude and height, of
which that of attitude is slowed down in time by `stiffness` s (gains KP s^2, KD s, KI s^3): how far a vehicle is pushed off depends on
it by the cube.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.experiments.studies.runge_kutta import rk4

PLANT_HZ, OBSERVER_HZ = 400, 100
PER_SAMPLE = PLANT_HZ // OBSERVER_HZ
# PID on (phi, theta, psi, z): stiff in roll and pitch, where 20 % of one motor is 40 rad/s^2.
KP, KD, KI = (np.array([600.0, 600.0, 25.0, 9.0]), np.array([40.0, 40.0, 10.0, 5.0]), np.array([1500.0, 1500.0, 20.0, 5.0]))
POSITION, VELOCITY, VELOCITY_I = 1.0, 1.0, 0.5  # 1/s, 1/s, 1/s^2
TILT = np.radians(20.0)
DOWN = np.array([1, 1, 1, -1] * 2)  # from the paper's frame, z up, to NED
SD = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.01, 0.01, 0.01, 0.05])  # rad, m, rad/s, m/s


@dataclass(frozen=True)
class Craft:
    """M (4, n): (U_2, U_3, U_4, U_1) per count; D (4,): 1 / (I_1, I_2, I_3, m); spun (n,): J_r Omega is its product with the root of
    the counts that turn the rotors; gravity; counts_max; file: as an airframe file."""

    M: np.ndarray
    D: np.ndarray
    spun: np.ndarray
    gravity: float
    counts_max: float
    file: dict

    @property
    def hover(self) -> float:
        """Counts of every motor in hover."""
        return self.gravity / (self.D[3] * self.M[3].sum())


def craft(file: dict) -> Craft:
    """The craft of an airframe file: eq. (3), for any number of rotors."""
    x, y, spin = (np.array(file["rotors"][k], float) for k in ("x", "y", "spin"))
    thrust = file["thrust_max"] / file["counts_max"]
    M = thrust * np.stack([-y, x, file["drag_ratio"] * spin, np.ones(x.size)])
    D = 1.0 / np.array([*file["inertia"], file["mass"]])
    # A rotor turns against the torque that it leaves to the vehicle.
    spun = -spin * file["rotor_inertia"] * file["rotor_speed_max"] / np.sqrt(file["counts_max"])
    return Craft(M, D, spun, file["gravity"], file["counts_max"], file)


def ring(file: dict, rotors: int) -> dict:
    """The same motors on a regular ring of the same arm; mass and inertia grow with the number of rotors."""
    azimuth = np.pi * (2 * np.arange(rotors) + 1) / rotors
    share = rotors / len(file["rotors"]["x"])
    where = {"x": file["arm"] * np.cos(azimuth), "y": file["arm"] * np.sin(azimuth), "spin": 1.0 - 2.0 * (np.arange(rotors) % 2)}
    return {**file, "rotors": where, "mass": share * file["mass"], "inertia": share * np.array(file["inertia"])}


def fly(vehicle: Craft, gamma, reference, noise):
    """Flights (N): u (N, T, n) mean counts over each of T samples, y (N, T, 8) = (roll, pitch, yaw, down, their rates), NED/FRD.

    gamma (N, T, n): loss during each sample; reference (N, T, 4): wanted (phi, theta, psi, z); noise (N, 4 T, 8): on what the
    controller and the observer see, every fourth row by both.
    """
    u, x = _flown(False, vehicle, gamma, reference, noise, np.ones(len(gamma)))
    # The controller saw sample k's end with the noise of the first row of sample k + 1: the observer sees the same.
    ends = np.concatenate([noise[:, PER_SAMPLE::PER_SAMPLE], noise[:, :1]], axis=1)
    return u, (x[..., :8] + ends) * DOWN


def hold(vehicle: Craft, gamma: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flights (N) without noise from rest at the wanted place: position (N, T, 3) [m], x and y as in the equations, z up, and counts u
    (N, T, 4).

    gamma (N, T, 4): losses during each of T samples; stiffness (N,): 1 is the controller of `fly`.
    """
    N, T = gamma.shape[:2]
    still = np.zeros((N, T, 4)), np.zeros((N, PER_SAMPLE * T, 8))
    u, x = _flown(True, vehicle, gamma, *still, np.asarray(stiffness, float))
    return x[..., [8, 9, 3]], u


def uncertain(vehicle: Craft, real: Sequence[Craft], gamma, wind, drag, lever: float):
    """Flights (N) without noise that hold their place, of vehicles `real` (N) whose controller takes them for `vehicle`: counts u
    (N, T, 4), and y (N, T, 8) as in `fly`.

    wind (N, T, 3): along x, y and up [m/s]. The air pushes with drag (N,) [1/s] times the difference of speeds, `lever` [m] above the
    centre of mass.
    """
    N, T = gamma.shape[:2]
    still = np.zeros((N, T, 4)), np.zeros((N, PER_SAMPLE * T, 8))
    u, x = _flown(True, vehicle, gamma, *still, np.ones(N), real, (wind, drag, np.full(N, lever)))
    return u, x[..., :8] * DOWN


def _flown(
    holds: bool, vehicle: Craft, gamma, reference, noise, stiffness, real: Sequence[Craft] = (), air=None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean counts (N, T, n) over each sample, and the states (N, T, 12) at its end: angles and height, their rates, x, y, their rates."""
    N, T = gamma.shape[:2]
    real = real or [vehicle] * N
    flown = tuple(np.stack([getattr(one, name) for one in real]) for name in ("M", "D", "spun"))
    air = (np.zeros((N, T, 3)), np.zeros(N), np.zeros(N)) if air is None else air
    known = vehicle.M, vehicle.D, vehicle.gravity, vehicle.counts_max
    rows = noise.reshape(N, T, PER_SAMPLE, 8)
    results = _program(holds)(known, flown, air, gamma, reference, rows, stiffness)
    return np.asarray(results[0]), np.asarray(results[1])


@functools.cache
def _program(holds: bool):
    """Compiled. holds: the setpoint is the initial position, else `reference` (T, 4) gives angles and height."""
    jax = load_jax()
    jnp = jax.numpy
    dt = 1.0 / PLANT_HZ

    def derivative(x, U, momentum, D, gravity, push, lever):
        phi, theta, psi, p, q, r = x[0], x[1], x[2], x[4], x[5], x[6]
        I_1, I_2, I_3 = 1.0 / D[:3]
        turn = jnp.stack([(I_2 - I_3) * q * r - momentum * q, (I_3 - I_1) * p * r + momentum * p, (I_1 - I_2) * p * q])
        # A lean towards x is +theta, towards y -phi.
        blown = lever / D[3] * jnp.stack([-push[1], push[0], 0.0 * push[2]])
        lift = D[3] * U[3]
        east = lift * (jnp.cos(phi) * jnp.sin(theta) * jnp.cos(psi) + jnp.sin(phi) * jnp.sin(psi)) + push[0]
        north = lift * (jnp.cos(phi) * jnp.sin(theta) * jnp.sin(psi) - jnp.sin(phi) * jnp.cos(psi)) + push[1]
        climb = lift * jnp.cos(phi) * jnp.cos(theta) - gravity + push[2]
        return jnp.concatenate([x[4:8], D[:3] * (U[:3] + turn + blown), climb[None], x[10:], jnp.stack([east, north])])

    def flight(known, flown, air, gamma, reference, noise, stiffness):
        (M, D, gravity, counts_max), (winds, drag, lever) = known, air
        real_M, real_D, spun = flown
        inverse = jnp.linalg.pinv(D[:, None] * M)
        lift = jnp.array([0.0, 0.0, 0.0, 1.0]) * gravity
        slow_down = jnp.where(np.arange(4) < 3, stiffness, 1.0)
        kp, kd, ki = KP * slow_down**2, KD * slow_down, KI * slow_down**3

        def plant(carry, row):
            x, integral, slow, loss, wanted, wind = carry
            if holds:
                missing = -POSITION * x[8:10] - x[10:]
                slow = slow + missing * dt
                push = (VELOCITY * missing + VELOCITY_I * slow) / gravity
                wanted = jnp.concatenate([jnp.clip(jnp.stack([-push[1], push[0]]), -TILT, TILT), jnp.zeros(2)])
            seen = x[:8] + row
            error = wanted - seen[:4]
            integral = integral + error * dt
            u = jnp.clip(inverse @ (kp * error - kd * seen[4:] + ki * integral + lift), 0.0, counts_max)
            turning = u * (1.0 - loss)

            def rate(x):
                pushed = drag * (wind - jnp.stack([x[10], x[11], x[7]]))
                return derivative(x, real_M @ turning, spun @ jnp.sqrt(turning), real_D, gravity, pushed, lever)

            return (rk4(rate, x, dt), integral, slow, loss, wanted, wind), u

        def sample(carry, row):
            loss, wanted, wind, noise = row
            (x, integral, slow, *_), u = jax.lax.scan(plant, (*carry, loss, wanted, wind), noise)
            return (x, integral, slow), (u.mean(axis=0), x)

        start = (jnp.zeros(12), jnp.zeros(4), jnp.zeros(2))
        return jax.lax.scan(sample, start, (gamma, reference, winds, noise))[1]

    return jax.jit(jax.vmap(flight, in_axes=(None, 0, 0, 0, 0, 0, 0)))
