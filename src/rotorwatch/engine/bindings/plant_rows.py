"""The estimator's plant in arrays: its prior for any multirotor, its inputs from ticks, and the lower rotors of coaxial frames.

engine/estimator/plant.py has its equation and its constants. The state is the same: (b1, b2, b3, G, c) of each axis, where for thrust,
which has no damping, the last one is the side force; then the thrust curve, the air and the lower rotors' share.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.estimator import plant as definition
from rotorwatch.engine.estimator.plant import B3, DAMPING, GAIN, ONE_ARM, PER_AXIS, SIDEWAYS

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
    mean, P = np.zeros((4, PER_AXIS)), np.zeros((4, PER_AXIS, 4, PER_AXIS))
    for axis in range(4):
        gain, sd = (n * definition.GAIN_MEAN[axis], n * definition.GAIN_SD[axis]) if axis < 3 else (1.0, definition.GAIN_SD[axis])
        rate, rate_sd = (definition.DAMPING_RATE, definition.DAMPING_RATE_SD) if axis < 3 else (0.0, 0.0)
        mean[axis, GAIN], mean[axis, DAMPING] = gain, rate * gain
        P[axis, B3, axis, B3] = definition.BIAS_SD[axis] ** 2
        P[axis, GAIN, axis, GAIN] = sd**2
        P[axis, GAIN, axis, DAMPING] = P[axis, DAMPING, axis, GAIN] = rate * sd**2
        P[axis, DAMPING, axis, DAMPING] = (rate * sd) ** 2 + rate_sd**2 * (gain**2 + sd**2)
    mean, P = mean.reshape(-1), P.reshape(AXIS_STATES, AXIS_STATES)
    mean[SIDEWAYS], P[SIDEWAYS, SIDEWAYS] = n * definition.SIDE, (n * definition.SIDE_SD) ** 2
    return mean, P


def lower_rotors(B: np.ndarray) -> np.ndarray | None:
    """(n,) 1 for each rotor at the place of a stronger one: the lower ones of coaxial arms. None where there are none."""
    place = B[:2] / B[3]
    one_arm = abs(place[:, :, None] - place[:, None, :]).max(axis=0) < ONE_ARM
    lower = (one_arm & (B[3][None, :] > 1.02 * B[3][:, None])).any(axis=1)
    return lower.astype(float) if lower.any() else None


def any_curve() -> np.ndarray:
    """(2,) prior mean and variance of the thrust curve's bend."""
    return np.array([0.0, 1.0])


def any_air() -> np.ndarray:
    """(2,) prior mean and variance of the effect of air along the thrust axis."""
    return np.array([definition.INFLOW, definition.INFLOW_SD**2])


def usual_gains(n: int) -> np.ndarray:
    """(4,) gains of an unknown n-rotor vehicle."""
    return any_multirotor(n)[0].reshape(4, PER_AXIS)[:, GAIN]
