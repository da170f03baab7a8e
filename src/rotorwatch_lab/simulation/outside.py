"""External influences besides rotor faults: a lasting push, rotor wake, a dropped payload, quantised outputs.

The autopilot knows none of them, and logs show only their effects. `now` gives the vehicle with all influences at one step.
"""

from __future__ import annotations

from collections import namedtuple

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.simulation import dynamics, faults

STIR_HZ = 8.0  # corner of a rotor's own noise in stirred air: eddies of a rotor's size at the speed of its air


class Changes(namedtuple("Changes", "push_ramp twist shift shift_onset shift_ramp lag_down falls")):
    """What else may change. push_ramp [s]: the push grows over it, and with it the torque twist (3,) in frame axes [N m]; shift (3,):
    way of the centre of mass in the frame [m], from shift_onset over shift_ramp [s]; lag_down: a rotor's time constant of slowing down
    over that of speeding up; falls: 1 where the wind is slower near the ground, else 0."""


class Outside(namedtuple("Outside", "push height onset end wash induced steps lighter drops changes", defaults=[()])):
    """push (3,) NED [N] that acts `height` [m] above the rotors' plane between onset and end [s]; wash: noise of a rotor's thrust, share of
    it (rms), when sinking as fast as its air in hover, induced [m/s]; steps: that the outputs have from 0 to full, 0 for none; lighter:
    `dynamics.Craft` after the time `drops` [s]; changes: `Changes`, or nothing."""


def stirred(seed, rotors: int, ticks: int, dt: float):
    """(ticks, rotors) noise of each rotor: independent, variance 1, correlated over 1 / STIR_HZ. seed: the flight's."""
    jax = load_jax()
    jnp = jax.numpy
    at = jnp.arange(ticks) * (dt * STIR_HZ)
    here = jnp.floor(at).astype(int)
    key = jax.random.fold_in(jax.random.key(seed), 1)
    knots = jax.random.normal(key, (int(ticks * dt * STIR_HZ) + 2, rotors))
    part = (at - here)[:, None]
    mixed = (1.0 - part) * knots[here] + part * knots[here + 1]
    return mixed / jnp.sqrt((1.0 - part) ** 2 + part**2)


def washed(outside: Outside, stir, wind, v):
    """(n,) factors of the rotors' thrust in air that blows with wind (3,) past a vehicle of velocity v (3,), NED [m/s].

    A vehicle that sinks into its own wake shakes; one that leaves it sideways does not. stir (n,): `stirred`, now.
    """
    jnp = load_jax().numpy
    moved = (v - wind) / outside.induced
    sinking = jnp.clip(moved[2], 0.0, 1.0)
    aside = jnp.clip(1.0 - jnp.sqrt(moved[0] ** 2 + moved[1] ** 2), 0.0, 1.0)
    return jnp.clip(1.0 + outside.wash * sinking * aside * stir, 0.0, 2.0)


def now(craft: dynamics.Craft, outside: Outside, broken: faults.Faults, s, t, factors) -> dynamics.Craft:
    """The vehicle at time t [s]. s (F,): `faults.strength`; factors (n,): `washed`."""
    jax = load_jax()
    jnp = jax.numpy
    craft = jax.tree.map(lambda a, b: jnp.where(t < outside.drops, a, b), craft, outside.lighter)
    there = jnp.where((t >= outside.onset) & (t < outside.end), 1.0, 0.0)
    if outside.changes:
        there = there * jnp.clip((t - outside.onset) / jnp.maximum(outside.changes.push_ramp, 1e-6), 0.0, 1.0)
        craft = shifted(craft, outside.changes, t)
        craft = craft._replace(extra=craft.extra._replace(twist=there * outside.changes.twist))
    return craft._replace(
        thrust_max=craft.thrust_max * factors,
        lean=faults.summed(broken, broken.lean * s),
        push=there * outside.push,
        push_z=craft.z - outside.height,
    )


def shifted(craft: dynamics.Craft, changes: Changes, t) -> dynamics.Craft:
    """The vehicle about its centre of mass at time t [s], which moves in the frame; J stays (a few mm change it by less than 1 %)."""
    jnp = load_jax().numpy
    off = changes.shift * jnp.clip((t - changes.shift_onset) / jnp.maximum(changes.shift_ramp, 1e-6), 0.0, 1.0)
    extra = craft.extra
    moved = {"points": extra.points - off, "hook": extra.hook - off, "drag_at": extra.drag_at - off}
    return craft._replace(x=craft.x - off[0], y=craft.y - off[1], z=craft.z - off[2], extra=extra._replace(**moved))


def lag(outside: Outside, craft_lag, w, command):
    """(n,) time constants [s] of rotors at speeds w (n,) driven to `command` (n,)."""
    jnp = load_jax().numpy
    return jnp.where(command < w, craft_lag * outside.changes.lag_down, craft_lag)


def rounded(outside: Outside, command):
    """Commands (n,) as outputs of so many steps give them."""
    jnp = load_jax().numpy
    steps = jnp.maximum(outside.steps, 1.0)
    return jnp.where(outside.steps > 0.0, jnp.floor(command * steps + 0.5) / steps, command)
