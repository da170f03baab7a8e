"""Faults of single rotors, as numbers for a compiled program.

A fault is active from its onset to its end, wholly or in periods (`period`, `duty`), and grows over `ramp` seconds:

    loss          thrust and torque times 1 - strength           chipped    the same, and an imbalance that shakes
    bias          strength is added to the command               stuck      the command stays what it was, or `level`
    float         the rotor is not driven any more               saturated  the command is full, or `level`
    weak motor    the rotor turns so much slower that its       bearing    friction, a share of the motor's full torque: more
                  thrust is 1 - strength of the command           current, a little less speed (motor.py)
    strong        thrust and torque times 1 + strength           capped     thrust never above `level` of full
    slow          its lag times `times`                          tilt       the mount turned about its arm by `angle_deg`: the
                                                                              vehicle is yawed, hardly any thrust is lost
"""

from __future__ import annotations

import functools
from collections import namedtuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax

MOST = 2  # at once
KINDS = (
    "loss",
    "complete loss",
    "stuck",
    "bias",
    "float",
    "saturated",
    "chipped",
    "weak motor",
    "bearing",
    "strong",
    "capped",
    "slow",
    "tilt",
)
SPIN_DOWN = 5.0  # a rotor that only the air brakes takes this many times its lag
HELD = -1.0  # level of a stuck command: what it was at onset
NEVER = 1e9


class Faults(
    namedtuple("Faults", "rotor onset end ramp period duty loss bias frozen level undriven shake weak friction ceiling slower lean")
):
    """MOST faults in rows. rotor (F, n): 1 at the rotor, else 0. onset, end, ramp, period [s], duty: part of a period that
    the fault is there; loss, bias: strengths; frozen 0 or 1 with level; undriven 0 or 1; shake [m/s^2 at full speed];
    weak: thrust lost by turning slower; friction: share of full torque; ceiling: most thrust, share of full; slower: lag gained, times
    the rotor's own; lean: sine of the angle that the mount is turned by."""


def none(rotors: int) -> Faults:
    """No fault: no row ever starts."""
    zero = np.zeros(MOST)
    never = dict.fromkeys(("onset", "end", "period"), zero + NEVER)
    rest = never | {"rotor": np.zeros((MOST, rotors)), "duty": zero + 1.0, "level": zero + HELD, "ceiling": zero + 1.0}
    return Faults(**{name: rest.get(name, zero) for name in Faults._fields})


def strength(faults: Faults, t):
    """(F,) severity of each fault at time t: 0 absent, 1 fully developed."""
    jnp = load_jax().numpy
    since = t - faults.onset
    there = (since >= 0.0) & (t < faults.end) & (jnp.mod(since, faults.period) < faults.duty * faults.period)
    grown = jnp.clip(since / jnp.maximum(faults.ramp, 1e-9), 0.0, 1.0)
    return jnp.where(there, jnp.where(faults.ramp > 0.0, grown, 1.0), 0.0)


def _each(faults: Faults, amount) -> list:
    """(n,) of each fault: its amount at the rotor that has it."""
    return [faults.rotor[k] * amount[k] for k in range(MOST)]


def remaining(faults: Faults, s):
    """(n,) effectiveness that losses leave to each rotor: two of one rotor multiply. s (F,): `strength`."""
    return functools.reduce(lambda a, b: a * b, (1.0 - there for there in _each(faults, faults.loss * s)))


def loss(faults: Faults, s):
    """theta (n,), the loss of each rotor. s (F,): `strength`."""
    return 1.0 - remaining(faults, s)


def weak(faults: Faults, s):
    """(n,) share of thrust that weak motors lack because they turn slower than commanded: of two on one rotor the larger."""
    return functools.reduce(load_jax().numpy.maximum, _each(faults, faults.weak * s))


def summed(faults: Faults, amount):
    """(n,) amounts (F,) of the faults, added up at the rotors that have them."""
    return functools.reduce(lambda a, b: a + b, _each(faults, amount))


def ceiling(faults: Faults, s):
    """(n,) most thrust of each rotor, share of full: of two limits the lower. s (F,): `strength`."""
    jnp = load_jax().numpy
    most = _each(faults, (1.0 - faults.ceiling) * jnp.where(s > 0.0, 1.0, 0.0))
    return 1.0 - functools.reduce(jnp.maximum, most)


def act(faults: Faults, s, command, held):
    """(command that reaches the motors (n,), undriven (n,) 0 or 1, what a stuck motor will be stuck at (n,))."""
    jnp = load_jax().numpy
    undriven = 0.0 * command
    for k in range(MOST):
        there = faults.rotor[k] * jnp.where(s[k] > 0.0, 1.0, 0.0)
        command = jnp.clip(command + faults.rotor[k] * (faults.bias * s)[k], 0.0, 1.0)
        level = jnp.where(faults.level[k] < 0.0, held, faults.level[k])
        command = jnp.where(there * faults.frozen[k] > 0.0, level, command)
        undriven = jnp.maximum(undriven, there * faults.undriven[k])
    return jnp.where(undriven > 0.0, 0.0, command), undriven, command


def imbalance(faults: Faults, s):
    """(n,) what faults add to each rotor's vibration [m/s^2 at full speed]."""
    return summed(faults, faults.shake * s)
