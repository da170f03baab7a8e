"""Setpoints of a flight: take-off, one manoeuvre, landing; positions as smooth functions of time.

Velocity and acceleration are differences of the position setpoints of neighbouring ticks, so they always fit.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax

KINDS = ("hover", "square", "figure-eight", "climb", "yaw", "aggressive", "yaw-steps", "turning-square")
CLIMB = 1.0  # m/s on average, up to the working height
DESCENT = 0.8  # m/s, down to the ground
BLEND = 2.0  # s from standstill into the manoeuvre, and out of it
LEVEL = 1.5  # m/s on average, from where a climb was to the working height
HOVER_FIRST = 2.0  # s of hover after the climb
HOLD = 4.0  # s between yaw steps
CUT = 2.0  # s from touchdown until the motors stop
LEVELLED = 1.0
UNDER = 0.5  # m below the ground: how far down the setpoint goes


class Approach(namedtuple("Approach", "slow slow_speed drift cut hops hop hop_time hop_rest levels")):
    """How the ground is met. slow [m]: below it the way down is at slow_speed [m/s]; drift (2,): velocity north, east of the setpoint
    meanwhile [m/s]; cut [s]: from touchdown to the motors' stop; hops: short flights before the long one, hop [m] high, of hop_time [s]
    of hover and with hop_rest [s] on the ground with idle motors after each; levels [s]: from touchdown until the autopilot notices, and
    asks for a level attitude and, within LEVELLED s, a quarter of the thrust."""


class Trajectory(
    namedtuple("Trajectory", "kind altitude size speed yaw yaw_speed take_off landing turn spool rest approach", defaults=[()])
):
    """kind: index into KINDS. altitude, size [m], speed [m/s], yaw [rad] at take-off, yaw_speed [rad/s]; take_off, landing:
    times [s] when the motors start to lift and when the way down begins; turn: time [s] in which a quarter turn is asked for; spool
    [s] from idling motors to what the controller asks; rest [s] that they push on at the end on the ground. approach: an
    `Approach`, or nothing; with hops take_off is when the first one begins."""


class Reference(namedtuple("Reference", "p v a yaw yaw_rate lift stir level", defaults=[(), ()])):
    """p, v, a (3,) NED; yaw, yaw_rate; lift: 0 while the motors idle, rising to 1 as they spool up; stir: nothing asked for, but noise that
    the aircraft meets (`outside`); level: 0, on the ground rising to 1 as the autopilot knows that it is there."""


def smooth(s):
    """0 to 1 over s in [0, 1], at rest with no acceleration at both ends."""
    jnp = load_jax().numpy
    s = jnp.clip(s, 0.0, 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


def touch_down(way: Trajectory):
    """Time [s] when the motors stop after the landing."""
    if way.approach:
        return way.landing + down_time(way.altitude, way.approach.slow, way.approach.slow_speed) + way.approach.cut + way.rest
    return way.landing + way.altitude / DESCENT + 2.0 + way.rest


def down_time(altitude, slow, slow_speed):
    """Time [s] from `altitude` [m] to the ground, below `slow` [m] at slow_speed [m/s]."""
    return (altitude - slow) / DESCENT + slow / slow_speed


def hop_times(way: Trajectory):
    """(period of the hops, way up, beginning of the way down, cut of the motors), all [s] from a hop's begin."""
    hop = way.approach
    up = way.spool - 1.0 + 1.0 + hop.hop / CLIMB
    down = up + hop.hop_time
    cut = down + hop.hop / hop.slow_speed + hop.cut
    return cut + hop.hop_rest, up, down, cut


def last_take_off(way: Trajectory):
    """Time [s] when the long flight begins: after the hops."""
    return way.take_off + way.approach.hops * hop_times(way)[0] if way.approach else way.take_off


def landings(way: Trajectory) -> list[tuple[float, float]]:
    """(begin, cut of the motors) [s] of each hop."""
    if not way.approach:
        return []
    period, _, _, cut = (float(t) for t in hop_times(way))
    begins = float(way.take_off) + period * np.arange(int(way.approach.hops))
    return [(float(t), float(t) + cut) for t in begins]


def table(way: Trajectory, ticks: int, dt: float) -> Reference:
    """Setpoints at ticks of dt seconds: a Reference of arrays with `ticks` rows."""
    jax = load_jax()
    jnp = jax.numpy
    t = (jnp.arange(ticks + 2) - 1.0).astype(jnp.result_type(way.altitude)) * dt
    pose = jax.vmap(_path, in_axes=(None, 0))(way, t)
    speed = (pose[2:] - pose[:-2]) / (2.0 * dt)
    bend = (pose[2:, :3] - 2.0 * pose[1:-1, :3] + pose[:-2, :3]) / (dt * dt)
    begin, level = last_take_off(way), ()
    lift = jnp.clip((t[1:-1] - begin) / way.spool, 0.0, 1.0)
    if way.approach:
        period, _, _, cut = hop_times(way)
        here = jnp.mod(t[1:-1] - way.take_off, period)
        hopping = jnp.where(here < cut, jnp.clip(here / way.spool, 0.0, 1.0), 0.0)
        in_hops = (t[1:-1] >= way.take_off) & (t[1:-1] < begin)
        lift = jnp.where(in_hops, hopping, lift)
        known = jnp.where(in_hops, here - cut, t[1:-1] - touch_down(way) + way.rest) + way.approach.cut - way.approach.levels
        level = jnp.clip(known / LEVELLED, 0.0, 1.0)
    lift = jnp.where(t[1:-1] > touch_down(way), 0.0, lift)
    return Reference(pose[1:-1, :3], speed[:, :3], bend, pose[1:-1, 3], speed[:, 3], lift, level=level)


def _path(way: Trajectory, t):
    """(4,): north, east, down [m] and yaw [rad]."""
    jnp = load_jax().numpy
    up_time = 1.0 + way.altitude / CLIMB
    # The manoeuvre's own time runs from the end of the climb to the landing, starting and ending at standstill.
    up = last_take_off(way) + way.spool - 1.0
    begin = up + up_time + HOVER_FIRST
    s = _eased(t - begin) - _eased(t - (way.landing - BLEND))
    a, v = way.size, way.speed
    north, east, rise, turn = (jnp.select([way.kind == k for k in range(len(KINDS))], row) for row in _shapes(a, v, s, way.turn))
    level_time = 1.0 + a / LEVEL  # before the way down: back to the working height
    rise = rise * (1.0 - smooth((t - way.landing + level_time) / level_time))
    height = way.altitude * smooth((t - up) / up_time) + rise
    since = jnp.maximum(t - way.landing, 0.0)
    if way.approach:
        north, east, height, descent = _approached(way, t, since, north, east, height)
    else:
        descent = DESCENT * since
    down = jnp.where(t > way.landing, jnp.minimum(-height + descent, UNDER), -height)
    return jnp.stack([north, east, down, way.yaw + way.yaw_speed * s + turn])


def _approached(way: Trajectory, t, since, north, east, height):
    """(north, east, height, descent) [m] with hops before the flight and a slow, drifting way down. since: time on the way down [s]."""
    jnp = load_jax().numpy
    hop = way.approach
    fast = (way.altitude - hop.slow) / DESCENT
    descent = DESCENT * jnp.minimum(since, fast) + hop.slow_speed * jnp.maximum(since - fast, 0.0)
    period, up, down, cut = hop_times(way)
    here = jnp.mod(t - way.take_off, period)
    hopping = (t >= way.take_off) & (t < last_take_off(way))
    falling = jnp.maximum(here - down, 0.0)
    rise = hop.hop * smooth((here - (way.spool - 1.0)) / (up - way.spool + 1.0)) - hop.slow_speed * falling
    height = jnp.where(hopping, jnp.where(here < cut, jnp.maximum(rise, -UNDER), 0.0), height)
    # Drift begins with the slow part of the way down, and ends when the motors do.
    slow = jnp.maximum(since - fast, 0.0) + jnp.where(hopping & (here < cut), falling, 0.0)
    drifted = _eased(jnp.minimum(slow, hop.slow / hop.slow_speed + hop.cut + 30.0))
    return north + hop.drift[0] * drifted, east + hop.drift[1] * drifted, height, descent


def _eased(t):
    """Integral of a ramp from 0 to 1 over BLEND seconds."""
    jnp = load_jax().numpy
    t = jnp.maximum(t, 0.0)
    return jnp.where(t < BLEND, t * t / (2.0 * BLEND), t - 0.5 * BLEND)


def _shapes(a, v, s, quarter):
    """(north, east, rise, turn) of each kind at manoeuvre time s >= 0, size a, speed v; quarter: time of a quarter turn [s]."""
    jnp = load_jax().numpy
    zero = 0.0 * s
    # Square: a stop at each corner; the polynomial's top speed is 15/8 of its mean.
    leg_time = 1.875 * a / v
    leg = jnp.floor(s / leg_time)
    part = a * smooth(s / leg_time - leg)
    side = jnp.mod(leg, 4.0)
    square_n = jnp.select([side == 0.0, side == 1.0, side == 2.0], [part, a + zero, a - part], zero)
    square_e = jnp.select([side == 0.0, side == 1.0, side == 2.0], [zero, part, a + zero], a - part)
    eight = v / (a * math.sqrt(2.0)) * s
    climb = 0.5 * a * (1.0 - jnp.cos(2.0 * v / a * s))
    spin = v / 2.0 * jnp.sin(0.5 * s)  # yaw to and fro, up to v/4 rad/s
    fast = v / a * s
    steps = s / (quarter + HOLD)
    whole = jnp.floor(steps)
    quarters = whole + smooth((steps - whole) * (quarter + HOLD) / quarter)
    corners = jnp.maximum(leg - 1.0 + smooth((s - leg * leg_time) / quarter), 0.0)  # the nose follows the legs
    right = 0.5 * math.pi
    north = [zero, square_n, a * jnp.sin(eight), zero, zero, a * jnp.sin(fast), zero, square_n]
    east = [zero, square_e, 0.5 * a * jnp.sin(2.0 * eight), zero, zero, a * jnp.sin(1.5 * fast), zero, square_e]
    rise = [zero, zero, zero, climb, zero, 0.25 * a * jnp.sin(0.7 * fast), zero, zero]
    turn = [zero, zero, zero, zero, spin, 0.5 * jnp.sin(0.4 * fast), right * quarters, right * corners]
    return north, east, rise, turn
