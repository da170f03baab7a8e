"""The estimator's plant in arrays: its prior for any multirotor, its inputs from ticks, and the lower rotors of coaxial frames.

engine/estimator/plant.py has its equation and its constants. The state is the same: (b1, b2, b3, G, c) of each axis, where for thrust,
which has no damping, the last one is the side force; then the air and the lower rotors' share.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator import prior
from rotorwatch.engine.estimator.plant import AIR, GAIN, PER_AXIS, Plant

AXES = ("roll", "pitch", "yaw", "thrust")
AXIS_STATES = 4 * PER_AXIS


def packed(ticks, n: int) -> np.ndarray:
    """(T, n + 13) inputs of a table of ticks of n rotors: thrusts, angular accelerations, n times load factor, angular rates, side forces
    forward and right [m/s^2], full thrust of a rotor, expo of the thrust curve and its standard deviation, speed along the thrust axis
    [m/s; NaN: not known]. Thrusts in hover thrusts."""
    load = ticks.load[:, None] * n
    side = np.zeros((len(load), 2)) if ticks.side is None else ticks.side
    full = 1.0 / ticks.hover[:, None]
    curve = np.broadcast_to(np.asarray(ticks.curve, float), (len(load), 2))
    axial = np.full((len(load), 1), np.nan) if ticks.axial is None else ticks.axial[:, None]
    return np.concatenate([ticks.thrust, ticks.rate_dot, load, ticks.rate, side, full, curve, axial], axis=1)


def any_multirotor(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(mean (20,), covariance (20, 20)) of the prior state of an unknown vehicle with n rotors."""
    mean, P = _prior(n)
    return mean[:AXIS_STATES], P[:AXIS_STATES, :AXIS_STATES]


def _prior(n: int) -> tuple[np.ndarray, np.ndarray]:
    made = ENGINE.new(Plant)
    made.set(rotors=n)
    ENGINE.call(prior.any_multirotor, made)
    return made["mean"][0].copy(), made["variance"][0].copy()


def lower_rotors(B: np.ndarray) -> np.ndarray | None:
    """(n,) 1 for each rotor at the place of a stronger one: the lower ones of coaxial arms. None where there are none."""
    made, n = ENGINE.new(Plant), B.shape[1]
    made.set(rotors=n, effect=np.asarray(B, float))
    return made["lower"][0, :n].astype(float) if ENGINE.call(prior.lower_rotors, made) else None


def any_air() -> np.ndarray:
    """(2,) prior mean and variance of the effect of air along the thrust axis."""
    mean, P = _prior(1)
    return np.array([mean[AIR], P[AIR, AIR]])


def usual_gains(n: int) -> np.ndarray:
    """(4,) gains of an unknown n-rotor vehicle."""
    return any_multirotor(n)[0].reshape(4, PER_AXIS)[:, GAIN]
