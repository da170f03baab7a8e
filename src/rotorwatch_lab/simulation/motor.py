"""Motor current, and loss of speed under a load that the command does not account for: an electrical model in shares.

A motor of resistance R, back-emf constant K and no-load torque Q_0 behind an ESC that gives it the share d of the supply voltage V obeys

    d V = i R + K W,        i = (Q + Q_0) / K,        I = d i

i its current, I what the ESC draws from the battery (the first-order model of M. Drela, First-Order DC Electric Motor Model, MIT 2007).
In shares of what they are at full speed, w = W / W_max, q = Q / Q_max, COPPER = i_max R / V_max and IDLE = Q_0 / (Q_max + Q_0):

    i / i_max = (1 - IDLE) q + IDLE,      d V / V_max = COPPER i / i_max + (1 - COPPER) w,
    I / I_max = (d V / V_max) (i / i_max) / (V / V_max)

The propeller's torque is q = w^2 (1 - its loss); a bad bearing adds a friction torque, a share of (Q_max + Q_0), at any speed.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.backend import jax as load_jax

COPPER = 0.12  # of full voltage lost in the windings at full load: usual of multirotor motors, whose efficiency there is 0.8 to 0.85
IDLE = 0.04  # of full current without a propeller
REST = 0.05  # of full speed, below which friction fades: nothing rubs at rest


def slowed(commanded, theta, friction):
    """Speeds (n,) that motors settle at when they turn at `commanded` (n,) without friction: the same d V, another load.

    theta (n,): what the propellers have lost; friction (n,): shares of full torque; speeds as shares of full.
    """
    jnp = load_jax().numpy
    # COPPER (1 - IDLE)(1 - theta) w^2 + (1 - COPPER) w = c, with c of the healthy bearing less the voltage that the friction takes.
    a = COPPER * (1.0 - IDLE) * (1.0 - theta)
    b = 1.0 - COPPER
    c = jnp.maximum(a * commanded * commanded + b * commanded - COPPER * friction * _turning(commanded), 0.0)
    return 2.0 * c / (b + jnp.sqrt(b * b + 4.0 * a * c))


def current(full, w, theta, friction, sag, driven):
    """Currents (n,) [A] into the ESCs. full: of each at full speed and voltage [A]; w, theta, friction: as in `slowed`, at the speeds that
    they have; sag: supply voltage as a share of full; driven (n,): 0 where a motor gets nothing."""
    jnp = load_jax().numpy
    moving = _turning(w)
    i = (1.0 - IDLE) * w * w * (1.0 - theta) + (IDLE + friction) * moving
    volts = COPPER * i + (1.0 - COPPER) * w
    return full * driven * volts * i / jnp.maximum(sag, 0.1)


def unloaded(w: np.ndarray) -> np.ndarray:
    """Speeds at the same d V without a propeller, of motors that turn at w with one; shares of full."""
    return w * (1.0 + COPPER * (1.0 - IDLE) / (1.0 - COPPER) * w)


def _turning(w):
    return load_jax().numpy.minimum(w / REST, 1.0)
