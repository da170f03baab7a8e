"""Vehicle parameters."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, Real, Struct, array
from rotorwatch.engine.intake.sizes import ROTORS

ROLL, PITCH, YAW, THRUST = 0, 1, 2, 3


class Vehicle(Struct):
    """Rotors, mixer, thrust curve and outputs. Constant: may be stored in flash."""

    rotors: int = 0
    effectiveness = array(REAL, 4, ROTORS)  # wrench of each rotor's hover thrust, largest lever 1: roll, pitch, yaw, thrust
    mixer = array(REAL, ROTORS, 4)  # thrust of each rotor for roll, pitch, yaw, throttle of the rate controller
    u_min: Real = 0.0  # output at zero thrust, in the outputs' unit
    u_max: Real = 1.0  # output at full thrust
    output_low: Real = 0.0  # ends of the outputs' range, as defined by the autopilot
    output_high: Real = 1.0
    expo: Real = 0.0  # thrust curve: (1 - expo) a + expo a^2, a the share of [u_min, u_max]
    expo_sd: Real = 0.0  # standard deviation of expo
    mixer_expo: Real = 0.0  # expo assumed by the autopilot's mixer
    yaw_headroom: Real = 0.2  # yaw that the mixer always grants (MOT_YAW_HEADROOM / 1000)
    mixer_known: bool = False  # the mixer is known; otherwise its factors are learned
    coaxial: bool = False  # coaxial: rotors in pairs on one arm, one below the other
    rests_at_minimum: bool = False  # outputs never go below u_min: an output at u_min is off (PX4)
