"""Output of each motor by an autopilot's parameters: one table for logs, telemetry and links.

    ArduPilot   SERVOn_FUNCTION                          33 to 40: motors 1 to 8; 82 to 85: motors 9 to 12
    PX4         PWM_MAIN_FUNCn, UAVCAN_EC_FUNCn and so on   101 to 112: motors 1 to 12                      1.13 and later

https://ardupilot.org/copter/docs/common-rcoutput-mapping.html and https://docs.px4.io/main/en/config/actuators.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

SERVO = "SERVO"  # ArduPilot's only driver
DRIVERS = ("PWM_MAIN", "PWM_AUX", "UAVCAN_EC", "HIL_ACT", "PCA9685", "VOXL_ESC", "TAP_ESC")  # PX4's
SERVO_MOTORS = {**{32 + k: k for k in range(1, 9)}, **{73 + k: k for k in range(9, 13)}}  # function -> motor
MOTOR_1, MOTOR_12 = 101, 112  # of PX4
_NAME = re.compile(rf"({SERVO})(\d{{1,2}})_FUNCTION|({'|'.join(DRIVERS)})_FUNC(\d{{1,2}})")


class Function(NamedTuple):
    """The function of one output. driver: its bus; output: its number, from 1; motor: from 1, or 0 for none."""

    driver: str
    output: int
    motor: int


def function(name: str, value: float) -> Function | None:
    """The output function that a parameter sets; None for any other parameter."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    if match[1]:
        return Function(SERVO, int(match[2]), SERVO_MOTORS.get(int(value), 0))
    return Function(match[3], int(match[4]), int(value) - MOTOR_1 + 1 if MOTOR_1 <= value <= MOTOR_12 else 0)


def motor_outputs(parameters: Mapping[str, float]) -> dict[str, dict[int, int]]:
    """Driver -> {motor: output}, both from 1, of drivers that drive a motor."""
    drivers: dict[str, dict[int, int]] = {}
    for name, value in parameters.items():
        setting = function(name, value)
        if setting is not None and setting.motor:
            drivers.setdefault(setting.driver, {})[setting.motor] = setting.output
    return drivers


def in_order(outputs: Mapping[int, int]) -> tuple[int, ...]:
    """The output of each motor from 1 on; empty where a motor is left out."""
    motors = sorted(outputs)
    return tuple(outputs[k] for k in motors) if motors == list(range(1, len(motors) + 1)) else ()
