"""Steady wind and Dryden turbulence: MIL-F-8785C at low altitude, with the rotational gusts of its section 3.7.

Along the wind sigma sqrt(2 tau) / (1 + tau s), across and down sigma sqrt(tau) (1 + sqrt(3) tau s) / (1 + tau s)^2 of unit
white noise: variance sigma^2 each. tau = L / V with the scale length L and the airspeed V.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax

NOISES = 6
FOOT = 0.3048
ROOT3 = math.sqrt(3.0)


class Wind(namedtuple("Wind", "mean heading sigma tau turn_sigma turn_tau")):
    """mean (3,) NED [m/s]; heading (2,): unit vector north, east that the wind blows to; sigma, tau (3,) [m/s, s] along,
    across, down; turn_sigma [rad/s], turn_tau [s]: rotational gusts about each body axis."""


class Gusts(namedtuple("Gusts", "along first second turning")):
    """State of the filters. along (): first order. first, second (2,): across and down. turning (3,)."""


def dryden(speed, direction_deg, turbulence, altitude, airspeed, span) -> Wind:
    """Wind of `speed` [m/s] at 6 m height from `direction_deg`, its turbulence times `turbulence` (1: the standard's).

    altitude [m], airspeed [m/s] of the vehicle in the air on average, span [m] of the vehicle.
    """
    h = float(np.clip(altitude / FOOT, 10.0, 1000.0))
    shape = 0.177 + 0.000823 * h
    down = 0.1 * speed * turbulence
    level = down / shape**0.4
    V = max(airspeed, 1.0)
    length = h / shape**1.2 * FOOT
    tau = np.array([length, length, h * FOOT]) / V
    # Phi_p(W) = 0.8 sigma_w^2 (pi L / 4 b)^(1/3) / (V L (1 + (4 b W / pi V)^2)): its integral, and its corner.
    L = h * FOOT
    turn = down * math.sqrt(0.1 * math.pi**2 / (span * L) * (math.pi * L / (4.0 * span)) ** (1.0 / 3.0))
    to = math.radians(direction_deg + 180.0)
    heading = np.array([math.cos(to), math.sin(to)])
    mean = np.array([*(speed * heading), 0.0])
    return Wind(mean, heading, np.array([level, level, down]), tau, np.array(turn), np.array(4.0 * span / (math.pi * V)))


def still(dtype=float) -> Gusts:
    """No gusts yet."""
    return Gusts(np.zeros((), dtype), np.zeros(2, dtype), np.zeros(2, dtype), np.zeros(3, dtype))


def step(wind: Wind, gusts: Gusts, noise, dt) -> Gusts:
    """Gusts dt later; noise (6,) standard normal. Exact for noise that is held during dt."""
    jnp = load_jax().numpy
    e = jnp.exp(-dt / wind.tau)
    along = e[0] * gusts.along + wind.sigma[0] * jnp.sqrt(1.0 - e[0] * e[0]) * noise[0]
    d, k = e[1:], dt / wind.tau[1:] * e[1:]
    w = noise[1:3] / math.sqrt(dt)
    first = d * gusts.first + (1.0 - d) * w
    second = d * gusts.second + k * gusts.first + (1.0 - d - k) * w
    t = jnp.exp(-dt / wind.turn_tau)
    turning = t * gusts.turning + wind.turn_sigma * jnp.sqrt(1.0 - t * t) * noise[3:6]
    return Gusts(along, first, second, turning)


def velocity(wind: Wind, gusts: Gusts):
    """Wind with its gusts (3,) NED [m/s]."""
    jnp = load_jax().numpy
    wave = wind.sigma[1:] * jnp.sqrt(wind.tau[1:]) * ((1.0 - ROOT3) * gusts.second + ROOT3 * gusts.first)
    c, s = wind.heading[0], wind.heading[1]
    gust = jnp.stack([c * gusts.along - s * wave[0], s * gusts.along + c * wave[0], wave[1]])
    return wind.mean + gust
