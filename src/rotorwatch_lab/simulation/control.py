"""The autopilot: position, velocity, attitude and rate loops in cascade, and a mixer with realistic saturation.

Outer loops run once a tick, attitude and rate loops every step. Outputs are in the autopilot's own mixer units (roll, pitch, yaw,
throttle), as in logs.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.simulation import rotation
from rotorwatch_lab.simulation.trajectories import Reference

Array = Any
YAW_ROOM = 0.2  # share that yaw may always claim (ArduPilot: MOT_YAW_HEADROOM)
BEST = 0.5  # throttle around which the mixer makes room for roll and pitch
WIND_UP = 0.35  # limit of the rate integrators, mixer units


class Autopilot(
    namedtuple(
        "Autopilot",
        "mixer hover position velocity velocity_i attitude rate_p rate_i rate_d speed_most climb_most tilt_most turn_most gyro_cut expo "
        "compensates inversion sequential",
        defaults=[(), ()],
    )
):
    """mixer (n, 4); hover: throttle that carries the nominal vehicle; gains of the loops, outer to inner.

    position [1/s], velocity [1/s], velocity_i [1/s^2], attitude (3,) [1/s], rate_p (3,) [mixer units per rad/s], rate_i, rate_d;
    speed_most, climb_most [m/s], tilt_most [rad], turn_most (3,) [rad/s]; gyro_cut [rad/s] corner of the gyro filter; expo of the
    thrust curve it believes in; compensates 0 or 1: divides the battery's sag out of its commands. inversion: of `incremental`, what flies
    instead of the rate loop's gains where it says so; sequential: 1 where `mix_sequential` mixes, 0 or nothing where `mix` does.
    """


class Target(namedtuple("Target", "q yaw_rate throttle")):
    """Setpoints of the outer loops for the inner ones: attitude q (4,), yaw rate [rad/s] and throttle."""


class Loops(namedtuple("Loops", "rate_integral gyro free")):
    """rate_integral (3,); gyro (3,) filtered [rad/s]; free: 0 while the mixer is at its limits."""


def tune(mixer, B_tau, J, thrust_max, hover, lag, gyro_hz=40.0, tilt_deg=40.0, expo=0.65, compensates=1.0) -> Autopilot:
    """Gains for a vehicle: the rate loops as fast as the motors' lag allows with good damping, each outer loop slower.

    mixer (n, 4), B_tau (3, n) torque per newton of each rotor, J (3,) [kg m^2], thrust_max (n,) [N], lag [s].
    """
    authority = (B_tau * thrust_max) @ mixer[:, :3]
    authority = np.maximum(np.abs(np.diag(authority)) / J, 1e-3)  # rad/s^2 per unit of control
    cut = 2.0 * np.pi * gyro_hz
    fast = 1.0 / (2.2 * (lag + 1.0 / cut))
    yaw = np.minimum(0.5 * fast, 0.5 * authority[2] / 1.5)
    bandwidth = np.array([fast, fast, min(yaw, 8.0)])
    rate_p = bandwidth / authority
    return Autopilot(
        mixer=mixer,
        hover=np.array(hover),
        position=np.array(1.0),
        velocity=np.array(2.5),
        velocity_i=np.array(1.0),
        attitude=bandwidth / 3.0,
        rate_p=rate_p,
        rate_i=rate_p * bandwidth / 8.0,
        rate_d=rate_p * np.array([lag / 3.0, lag / 3.0, 0.0]),
        speed_most=np.array(12.0),
        climb_most=np.array(3.0),
        tilt_most=np.array(np.radians(tilt_deg)),
        turn_most=np.array([4.0, 4.0, 2.0]),
        gyro_cut=np.array(cut),
        expo=np.array(expo),
        compensates=np.array(compensates),
    )


def outer(pilot: Autopilot, ref: Reference, body, integral, dt) -> tuple[Target, Array]:
    """Position and velocity loops. Returns the target and the velocity integral (3,) [m/s^2]."""
    jnp = load_jax().numpy
    wanted = pilot.position * (ref.p - body.p)
    reach = jnp.maximum(jnp.sqrt(wanted[0] ** 2 + wanted[1] ** 2) / pilot.speed_most, 1.0)
    most = pilot.climb_most
    wanted = jnp.stack([wanted[0] / reach, wanted[1] / reach, jnp.clip(wanted[2], -most, most)])
    error = ref.v + wanted - body.v
    integral = jnp.clip(integral + pilot.velocity_i * dt * error, -5.0, 5.0) * jnp.where(ref.lift < 1.0, 0.0, 1.0)
    a = ref.a + pilot.velocity * error + integral
    up = jnp.clip(G0 - a[2], 0.3 * G0, 2.0 * G0)
    horizontal = jnp.sqrt(a[0] ** 2 + a[1] ** 2)
    fit = jnp.minimum(1.0, jnp.tan(pilot.tilt_most) * up / jnp.maximum(horizontal, 1e-6))
    n, e = a[0] * fit, a[1] * fit
    size = jnp.sqrt(n * n + e * e + up * up)
    # Shortest turn that takes "down" to -f / |f|, after the turn by the yaw angle.
    tilt = rotation.unit(jnp.stack([1.0 + up / size, e / size, -n / size, 0.0 * n]))
    R = rotation.axes(body.q)
    along = jnp.maximum(-n * R[0][2] - e * R[1][2] + up * R[2][2], 0.0)
    throttle = jnp.clip(pilot.hover * along / G0, 0.05, 0.95) * ref.lift
    return Target(rotation.multiply(tilt, rotation.heading(ref.yaw)), ref.yaw_rate, throttle), integral


def inner(pilot: Autopilot, target: Target, q, gyro, loops: Loops, lift, dt) -> tuple[Array, Array, Loops]:
    """Attitude and rate loops on the measured rates `gyro` (3,). Returns control (3,), the rate setpoints (3,) and the loops."""
    jnp = load_jax().numpy
    d = rotation.multiply(rotation.conjugate(q), target.q)
    side = jnp.where(d[0] < 0.0, -2.0, 2.0)
    error = side * jnp.stack([d[1], d[2], d[3]])
    wanted = pilot.attitude * error + jnp.stack([0.0 * side, 0.0 * side, target.yaw_rate])
    wanted = jnp.clip(wanted, -pilot.turn_most, pilot.turn_most)
    fade = jnp.exp(-pilot.gyro_cut * dt)
    filtered = gyro + (loops.gyro - gyro) * fade
    slope = (filtered - loops.gyro) / dt
    miss = wanted - filtered
    integral = jnp.clip(loops.rate_integral + pilot.rate_i * miss * dt * loops.free, -WIND_UP, WIND_UP) * lift
    control = jnp.clip(pilot.rate_p * miss + integral - pilot.rate_d * slope, -1.0, 1.0) * lift
    return control, wanted, Loops(integral, filtered, loops.free)


def mix(mixer, control, throttle):
    """Thrust demands (n,) in [0, 1] of control (3,) and throttle, and 1 where all of it was granted, else 0.

    Roll and pitch first, scaled only when their spread exceeds the range; yaw gets the room that is left, at least YAW_ROOM; the
    throttle moves so that no rotor is below 0, then above 1. ArduPilot's order of priorities.
    """
    jnp = load_jax().numpy
    tilt = mixer[:, 0] * control[0] + mixer[:, 1] * control[1]
    factor = mixer[:, 2]
    best = jnp.minimum(throttle, BEST)
    up = control[2] * factor > 0.0
    room = jnp.where(up, 1.0 - (best + tilt), best + tilt) / jnp.maximum(jnp.abs(factor), 1e-6)
    allowed = jnp.maximum(jnp.min(jnp.where(jnp.abs(factor) > 1e-6, room, 10.0)), YAW_ROOM)
    yaw = jnp.clip(control[2], -allowed, allowed)
    apart = tilt + factor * yaw
    low, high = jnp.min(apart), jnp.max(apart)
    scale = jnp.minimum(1.0, 1.0 / jnp.maximum(high - low, 1e-6))
    low, high = low * scale, high * scale
    level = jnp.maximum(jnp.minimum(throttle, 1.0 - high), -low)
    granted = (scale == 1.0) & (yaw == control[2]) & (level == throttle)
    return jnp.clip(level + scale * apart, 0.0, 1.0), granted.astype(apart.dtype)


def mix_sequential(mixer, control, throttle):
    """The same as PX4 mixes with MC_AIRMODE 0: the throttle is only ever lowered, then roll and pitch give way, and yaw is added last.

    After ControlAllocationSequentialDesaturation of PX4 1.15 (mixAirmodeDisabled): at little throttle outputs stay at 0 that `mix` would
    raise.
    """
    jnp = load_jax().numpy

    def gain(u, d, most):
        safe = jnp.where(jnp.abs(d) > 1e-6, d, 1.0)
        k = jnp.where(u < 0.0, -u / safe, jnp.where(u > most, (most - u) / safe, 0.0))
        k = jnp.where(jnp.abs(d) > 1e-6, k, 0.0)
        return jnp.minimum(jnp.min(k), 0.0) + jnp.maximum(jnp.max(k), 0.0)

    def free(u, d, most=1.0, down_only=False):
        first = gain(u, d, most)
        eased = u + first * d
        eased = eased + 0.5 * gain(eased, d, most) * d
        return jnp.where(first > 0.0, u, eased) if down_only else eased

    roll, pitch, yaw = mixer[:, 0], mixer[:, 1], mixer[:, 2]
    up = jnp.ones_like(roll)
    level = mixer[:, 0] * control[0] + mixer[:, 1] * control[1] + throttle
    u = free(level, up, down_only=True)
    u = free(free(u, roll), pitch)
    turned = u + yaw * control[2]
    u = free(free(turned, yaw, most=1.15), up, down_only=True)
    granted = jnp.max(jnp.abs(u - level - yaw * control[2])) < 1e-6
    return jnp.clip(u, 0.0, 1.0), granted.astype(u.dtype)


def drive(expo, thrust):
    """Command share that gives this share of full thrust: the inverse of the thrust curve."""
    jnp = load_jax().numpy
    curved = jnp.maximum(expo, 1e-6)
    root = jnp.sqrt((1.0 - curved) ** 2 + 4.0 * curved * thrust)
    return jnp.where(expo < 1e-5, thrust, (root - (1.0 - curved)) / (2.0 * curved))
