"""The helicopter's autopilot: the multirotor's cascade of loops (`simulation.control`), and an allocation to four actuators.

Position, velocity, attitude and rate loops demand a specific force along the mast and three angular accelerations; the plant, linearised
in trim, gives the collective, tail and cyclic commands:

    U = U_trim + M^-1 (f_z - f_z,trim, dp/dt, dq/dt, dr/dt),      M = d(f_z, dp/dt, dq/dt, dr/dt) / dU

A helicopter hovers leaning against its tail rotor's thrust: attitude setpoints are turned by that of trim.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.simulation import control, rotation
from rotorwatch_lab.simulation.control import Autopilot, Loops, Target
from rotorwatch_lab.simulation.helicopter import dynamics

Array = Any
FASTEST = 8.0  # rad/s of a rate loop: blades that flap follow no faster, though the plant neglects that
HALF = 0.5  # throttle of `control.outer` that stands for one g along the mast
SWING = np.array([12.0, 12.0, 12.0])  # rad/s^2 that one unit of the rate loops' control stands for


class Pilot(NamedTuple):
    """loops: gains of the cascade. M_inverse (4, 4): command per specific force and angular accelerations; U (4,): trim; q (4,): its
    attitude without heading; along [m/s^2]: specific force along the mast in trim."""

    loops: Autopilot
    M_inverse: Array
    U: Array
    q: Array
    along: Array


def tune(system, lag: float, gyro_hz: float) -> Pilot:
    """Gains for a plant whose actuators lag by `lag` seconds. Raises ConfigError for one that cannot hover."""
    U, (roll, pitch) = dynamics.trim(system)
    jax = load_jax()

    def answer(U):
        d = system.derivative(np.zeros(6), jax.numpy.concatenate([U, np.zeros(2)]), dynamics.SOUND)
        return d[np.array([2, 3, 4, 5])]

    M = np.asarray(jax.jacfwd(answer)(U))
    cut = 2.0 * np.pi * gyro_hz
    fast = min(FASTEST, 1.0 / (2.2 * (lag + 1.0 / cut)))
    bandwidth = np.array([fast, fast, 0.7 * fast])
    rate_p = bandwidth / SWING
    attitude = bandwidth / 3.0
    speed = attitude[0] / 2.5
    loops = Autopilot(
        mixer=np.eye(4),
        hover=np.array(HALF),
        position=np.array(0.4 * speed),
        velocity=np.array(speed),
        velocity_i=np.array(0.3 * speed**2),
        attitude=attitude,
        rate_p=rate_p,
        rate_i=rate_p * bandwidth / 8.0,
        rate_d=0.0 * rate_p,
        speed_most=np.array(8.0),
        climb_most=np.array(2.0),
        tilt_most=np.array(np.radians(25.0)),
        turn_most=np.array([1.5, 1.5, 1.0]),
        gyro_cut=np.array(cut),
        expo=np.array(0.0),
        compensates=np.array(0.0),
    )
    half_roll, half_pitch = 0.5 * roll, 0.5 * pitch
    q = np.array([np.cos(half_pitch) * np.cos(half_roll), np.cos(half_pitch) * np.sin(half_roll),
                  np.sin(half_pitch) * np.cos(half_roll), -np.sin(half_pitch) * np.sin(half_roll)])  # fmt: skip
    return Pilot(loops, np.linalg.inv(M), U, q, np.array(G0 * np.cos(roll) * np.cos(pitch)))


def outer(pilot: Pilot, reference, body, integral, dt) -> tuple[Target, Array]:
    """Position and velocity loops: the target, turned by the attitude of trim, and the velocity integral (3,)."""
    target, integral = control.outer(pilot.loops, reference, body, integral, dt)
    return target._replace(q=rotation.multiply(target.q, pilot.q)), integral


def inner(pilot: Pilot, target: Target, q, gyro, loops: Loops, dt) -> tuple[Array, Loops]:
    """Attitude and rate loops, and the allocation. Returns commands (4,) in [0, 1] and the loops."""
    jnp = load_jax().numpy
    turning, _, loops = control.inner(pilot.loops, target, q, gyro, loops, 1.0, dt)
    push = pilot.along - G0 / HALF * target.throttle
    U = pilot.U + pilot.M_inverse @ jnp.concatenate([push[None], SWING * turning])
    command = jnp.clip(U, 0.0, 1.0)
    return command, loops._replace(free=jnp.where(jnp.all(command == U), 1.0, 0.0))
