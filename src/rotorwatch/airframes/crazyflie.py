"""Bitcraze Crazyflie 2.x: one frame, brushed motors.

Bitcraze's published test-stand measurement ("PWM to Thrust") gives the motor voltage for a thrust of T gram of all four
motors, V = 0.088 T - 0.00062 T^2. Over 0..4.2 V its inverse is T ~ 0.52 a + 0.48 a^2 with a = V / 4.2. The firmware
applies that law itself: ``motor.m1``.. are thrust demands, ``pwm.m1_pwm``.. what reaches the motors.
"""

from __future__ import annotations

from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle

FULL_VOLTAGE = 4.2
ARM = 2**-0.5


def identify(flight: Flight) -> Vehicle | None:
    """The Crazyflie when the log comes from one, else None."""
    if "crazyflie" not in flight.autopilot.lower():
        return None
    motors = flight.signals.get("motors")
    return build(raw=motors is not None and "pwm" in motors.source.lower())


def build(raw: bool = False) -> Vehicle:
    """The Crazyflie. raw: commands are the PWM at the motors, else the firmware's thrust demands."""
    # Crazyflie numbers go round clockwise from the front right.
    rotors = (Rotor(ARM, ARM, 1), Rotor(-ARM, ARM, -1), Rotor(-ARM, -ARM, 1), Rotor(ARM, -ARM, -1))
    if raw:
        note = "Thrust curve from Bitcraze's published measurement, not from this vehicle."
        curve, extra = (ThrustCurve(0.0, 1.0, 0.48, known=False), {"full_voltage": FULL_VOLTAGE, "rests_at_minimum": True})
    else:
        note = "Motor commands taken as thrust demands: the firmware compensates for battery and thrust curve."
        curve, extra = ThrustCurve(0.0, 1.0, 0.0, known=False), {"rests_at_minimum": True}
    return Vehicle("crazyflie", rotors, curve, lag_s=0.05, source="Crazyflie log", assumptions=(note,), extra=extra)


NAMES = {"crazyflie": build}
