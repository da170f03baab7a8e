"""Incremental nonlinear dynamic inversion (INDI): an inner loop that commands changes of thrust, not all of it.

E. J. J. Smeur, Q. Chu and G. C. H. E. de Croon, Adaptive Incremental Nonlinear Dynamic Inversion for Attitude Control of Micro Air
Vehicles, Journal of Guidance, Control, and Dynamics 39 (2016) 450-461. With the angular acceleration a that the gyro shows and the one
that is wanted, nu, rotors of effectiveness G [rad/s^2 at full thrust] at the thrust shares f get the commands u,

    G u = G f_H + nu - a_H,        nu = bandwidth (rate setpoints - rates)

Whatever else turns the vehicle, gusts or a loss nobody knows of, is in a_H and is answered at once; no integrator is needed. H are two
lags with the corner of the gyro's filter, but no more than a radian a step; what is between the two is the angular acceleration. What
the rotors do goes through the same filter (f_H), with their own lag, so that both are late alike.

Rotors that speed up turn the vehicle the other way. About the yaw axis this is strong: their acceleration counts as if it were `lead`
seconds of thrust's drag (the paper's G_2), G (f + lead df/dt), and the command that gives the wanted sum is found backwards in time,

    y + lead dy/dt = (what is wanted of G u),        y = G u

With losses believed, G is G diag(e): `reconfigured`.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from rotorwatch.base.backend import jax as load_jax

Array = Any


class Inversion(namedtuple("Inversion", "used turns steer bandwidth lead lag")):
    """Model of the vehicle used by INDI. used: 0 or 1; turns (3, n): angular acceleration [rad/s^2] by each rotor's full thrust; steer (3,
    3): control in mixer units that gives an angular acceleration; bandwidth (3,) [1/s] of the rates; lead [s]: see the module; lag [s]."""


class Memory(namedtuple("Memory", "demand fast slow first second")):
    """demand (n,): the last thrust shares demanded; fast, slow (3,): measured rates after one lag and after both; first, second (3,):
    acceleration by the rotors, the same."""


def tune(used: bool, mixer, B_tau, J, thrust_max, bandwidth, lead: float, lag: float) -> Inversion:
    """For a vehicle: mixer (n, 4), B_tau (3, n) torque per newton of each rotor, J (3,) [kg m^2], thrust_max (n,) [N]."""
    turns = B_tau * thrust_max / J[:, None]
    # Where a channel cannot be moved at all, as yaw of a tricopter without its servo, it gets no command.
    steer = np.linalg.pinv(turns @ mixer[:, :3], rcond=1e-6)
    return Inversion(np.array(float(used)), turns, steer, bandwidth, np.array(lead), np.array(lag))


def rest(n: int, kind) -> Memory:
    """Motors off."""
    jnp = load_jax().numpy
    none = jnp.zeros(3, kind)
    return Memory(jnp.zeros(n, kind), none, none, none, none)


def control(known: Inversion, memory: Memory, miss, gyro, f, e, lift, cut, dt) -> tuple[Array, Memory]:
    """Control (3,) in mixer units, and the memory except for the demand that follows. miss (3,): rate setpoints minus filtered rates; gyro
    (3,): measured, all [rad/s]; f (n,): thrust shares that the rotors should have reached; e (n,): effectiveness; lift: below 1 while the
    motors idle or spool up; cut [rad/s]: corner of the gyro's filter."""
    jnp = load_jax().numpy
    corner = jnp.minimum(cut, 1.0 / dt)
    fade = jnp.exp(-corner * dt)
    fast = gyro + (memory.fast - gyro) * fade
    slow = fast + (memory.slow - fast) * fade
    seen = corner * (fast - slow)
    upward = known.turns[2] * e
    pushing = (upward * (memory.demand - f)).sum() * known.lead / known.lag
    by_rotors = (known.turns * (e * f)).sum(axis=1) + jnp.stack([0.0 * pushing, 0.0 * pushing, pushing])
    first = by_rotors + (memory.first - by_rotors) * fade
    second = first + (memory.second - first) * fade
    # Feet on the ground, too, turn the vehicle: nothing is made up for before it lifts.
    others = jnp.where(lift < 1.0, 0.0, seen - second)
    wanted = known.bandwidth * miss - others
    ahead = known.lead / dt
    yaw = (wanted[2] + ahead * (upward * memory.demand).sum()) / (1.0 + ahead)
    wanted = jnp.stack([wanted[0], wanted[1], yaw])
    turning = jnp.clip((known.steer * wanted).sum(axis=1), -1.0, 1.0) * lift
    return turning, Memory(memory.demand, fast, slow, first, second)
