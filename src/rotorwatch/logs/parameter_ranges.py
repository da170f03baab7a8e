"""Possible ranges of the parameters that a diagnosis uses; a value out of range is damage of the log and is ignored.

Ranges: ArduPilot's and PX4's parameter references (https://ardupilot.org/copter/docs/parameters.html,
https://docs.px4.io/main/en/advanced_config/parameter_reference.html), widened where users exceed them.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping
from typing import Any

# (name, least, most, whole numbers only); the first that matches counts.
RANGES = (
    (r"FRAME(?:_CLASS|_TYPE)?", 0, 30, True),
    (r"SERVO\d{1,2}_FUNCTION", -1, 1000, True),
    (r"AHRS_EKF_TYPE", 0, 20, True),
    (r"MOT_PWM_(?:MIN|MAX)", 0, 3000, True),
    (r"RC\d{1,2}_(?:MIN|MAX|TRIM)", 0, 3000, True),
    (r"THR_(?:MIN|MID|MAX)", 0, 1000, True),
    (r"MOT_SPIN_(?:ARM|ARMED|MIN|MAX)", 0, 1000, False),  # shares; pulses before 3.5
    (r"MOT_THST_EXPO", -1, 1, False),
    (r"MOT_THST_(?:HOVER|MAX)", 0, 1, False),
    (r"MOT_TCRV_M(?:AX|ID|IN)PCT", 0, 100, False),
    (r"MOT_YAW_HEADROOM", 0, 1000, True),
    (r"MOT_BAT_VOLT_(?:MIN|MAX)", 0, 120, False),
    (r"CA_ROTOR_COUNT", 0, 12, True),
    (r"CA_ROTOR\d{1,2}_(?:PX|PY|PZ)", -100, 100, False),
    (r"CA_ROTOR\d{1,2}_(?:AX|AY|AZ)", -100, 100, False),
    (r"CA_ROTOR\d{1,2}_CT", 0, 100, False),
    (r"CA_ROTOR\d{1,2}_KM", -1, 1, False),
    (r"MAV_TYPE", 0, 60, True),
    (r"SYS_AUTOSTART", 0, 9_999_999, True),
    (r"THR_MDL_FAC", 0, 1, False),
    (r"PWM_(?:MAIN_|AUX_)?(?:MIN|MAX)\d{0,2}", -1, 3000, True),  # -1: the common one counts
    (r"(?:PWM_MAIN|PWM_AUX|UAVCAN_EC|HIL_ACT|PCA9685|VOXL_ESC|TAP_ESC)_FUNC\d{1,2}", 0, 10_000, True),
    (r"UAVCAN_EC_(?:MIN|MAX)\d{1,2}", 0, 8191, True),
)


def is_parameter(name: str, value: Any) -> bool:
    """Numbers only, and none of the simulator's: SIM_* parameters can disclose a fault."""
    return isinstance(value, (int, float)) and math.isfinite(value) and not name.startswith("SIM_")


def checked(parameters: Mapping[str, float]) -> tuple[dict[str, float], list[str]]:
    """(the possible parameters, sentences on the impossible ones)."""
    fine, notes = {}, []
    for name, value in parameters.items():
        if possible(name, value):
            fine[name] = value
        else:
            notes.append(f"Parameter {name} is {value:.6g} in the log, which is not possible; it was ignored.")
    return fine, notes


def possible(name: str, value: float) -> bool:
    """True if a parameter can have this value; True for names without a known range."""
    limits = _range(name)
    if limits is None:
        return True
    _, low, high, whole = limits
    return low <= value <= high and (not whole or float(value).is_integer())


_ANY = re.compile("|".join(f"({name})" for name, *_ in RANGES))


@functools.lru_cache(maxsize=10_000)
def _range(name: str) -> tuple[str, float, float, bool] | None:
    """The row of RANGES for a name: all logs of an autopilot have the same thousand."""
    match = _ANY.fullmatch(name)
    return None if match is None or match.lastindex is None else RANGES[match.lastindex - 1]
