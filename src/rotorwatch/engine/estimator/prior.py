"""The estimator's knowledge of any multirotor before take-off, from the vehicle's geometry alone; `set_plant` completes it."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Real, Time, real
from rotorwatch.engine.estimator.estimator_sizes import PLANT_STATES
from rotorwatch.engine.estimator.noise import GENERIC, GENERIC_WEIGHT
from rotorwatch.engine.estimator.plant import (
    AIR,
    B3,
    BIAS_SD,
    DAMPING,
    DAMPING_RATE,
    DAMPING_RATE_SD,
    GAIN,
    GAIN_MEAN,
    GAIN_SD,
    INFLOW,
    INFLOW_SD,
    ONE_ARM,
    PER_AXIS,
    SHARE,
    SHARE_SD,
    SIDE,
    SIDE_SD,
    SIDEWAYS,
    Plant,
)
from rotorwatch.engine.intake.craft import THRUST, Vehicle


def any_multirotor(p: Plant) -> None:
    """Mean and variance of the state of an unknown vehicle with p.rotors rotors."""
    n = real(p.rotors)
    for r in range(PLANT_STATES):
        p.mean[r] = 0.0
        for c in range(PLANT_STATES):
            p.variance[r][c] = 0.0
    for axis in range(4):
        first = axis * PER_AXIS
        gain: Real = 1.0
        sd: Real = GAIN_SD[axis]
        rate: Real = 0.0
        rate_sd: Real = 0.0
        if axis < THRUST:
            gain = n * GAIN_MEAN[axis]
            sd = n * GAIN_SD[axis]
            rate = DAMPING_RATE
            rate_sd = DAMPING_RATE_SD
        p.mean[first + GAIN] = gain
        p.mean[first + DAMPING] = rate * gain
        p.variance[first + B3][first + B3] = BIAS_SD[axis] * BIAS_SD[axis]
        p.variance[first + GAIN][first + GAIN] = sd * sd
        p.variance[first + GAIN][first + DAMPING] = rate * (sd * sd)
        p.variance[first + DAMPING][first + GAIN] = rate * (sd * sd)
        p.variance[first + DAMPING][first + DAMPING] = (rate * sd) * (rate * sd) + rate_sd * rate_sd * (gain * gain + sd * sd)
    p.mean[SIDEWAYS] = n * SIDE
    p.variance[SIDEWAYS][SIDEWAYS] = (n * SIDE_SD) * (n * SIDE_SD)
    p.mean[AIR] = INFLOW
    p.variance[AIR][AIR] = INFLOW_SD * INFLOW_SD


def lower_rotors(p: Plant) -> bool:
    """Set p.lower: 1 for each rotor at the place of a stronger one, the lower ones of coaxial arms; return whether there are any."""
    found = False
    for i in range(p.rotors):
        p.lower[i] = 0.0
        for j in range(p.rotors):
            x = abs(p.effect[0][i] / p.effect[3][i] - p.effect[0][j] / p.effect[3][j])
            y = abs(p.effect[1][i] / p.effect[3][i] - p.effect[1][j] / p.effect[3][j])
            if max(x, y) < ONE_ARM and p.effect[3][j] > 1.02 * p.effect[3][i]:
                p.lower[i] = 1.0
                found = True
    return found


def before_take_off(p: Plant, v: Vehicle, dt: Time) -> bool:
    """The plant of a vehicle of which nothing but its geometry is known, in ticks of dt seconds; return whether its frame is coaxial."""
    p.rotors = v.rotors
    p.dt = real(dt)
    for axis in range(4):
        for i in range(v.rotors):
            p.effect[axis][i] = v.effectiveness[axis][i]
    any_multirotor(p)
    coaxial = lower_rotors(p)
    if coaxial:
        p.variance[SHARE][SHARE] = SHARE_SD * SHARE_SD
    for axis in range(4):
        for k in range(4):
            p.noise[k][axis] = GENERIC[k]
    p.noise_weight = GENERIC_WEIGHT
    return coaxial
