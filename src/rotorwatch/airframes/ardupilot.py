"""ArduPilot Copter frames: FRAME_CLASS, FRAME_TYPE and the MOT_* parameters.

Motor order and spin follow ArduPilot's published frame drawings ("Connect ESCs and Motors"). The mixer gives motor k

    t_k = throttle + roll r_k + pitch p_k + yaw y_k,   r = cos(angle + 90 deg), p = cos(angle), y = +1 counter-clockwise

each of the three columns scaled to a largest factor of 0.5. Angles run clockwise from the nose.
"""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace

import numpy as np

from rotorwatch import airframes
from rotorwatch.airframes._ardupilot_frames import FRAMES
from rotorwatch.errors import VehicleError
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle, coaxial, note_on_coaxial

CLASSES = {1: "quad", 2: "hexa", 3: "octa", 4: "octaquad", 5: "y6", 7: "tri", 12: "dodecahexa", 14: "deca"}
TYPES = dict(enumerate("plus x v h vtail atail plus-rev".split()))
TYPES |= dict(enumerate("b f bf-x dji-x cw-x i nyt-plus nyt-x bf-x-rev y4 x-cor cw-x-cor".split(), 10))
UNSUPPORTED = {6: "a helicopter", 8: "a single copter", 9: "a coaxial copter", 10: "a bicopter"}
UNSUPPORTED |= {11: "a dual helicopter", 13: "a quad helicopter", **dict.fromkeys((15, 16, 17), "a scripted frame")}
ROTORS = {"tri": 3, "quad": 4, "hexa": 6, "octa": 8, "octaquad": 8, "y6": 6, "dodecahexa": 12, "deca": 10}

# The lower rotors of coaxial frames, counted from 0. ArduPilot's motor test turns clockwise from the front and takes the
# upper motor of an arm before the lower; its numbers of the default Y6 do not follow that order, those of the others do
# (testing_order and the comments "top", "bottom" in AP_MotorsMatrix.cpp; drawings of "Connect ESCs and Motors").
LOWER = {
    **dict.fromkeys([name for name in FRAMES if name.startswith("octaquad")], (4, 5, 6, 7)),
    **dict.fromkeys(["octaquad-cw-x", "octaquad-cw-x-cor"], (1, 3, 5, 7)),
    **dict.fromkeys(["dodecahexa-plus", "dodecahexa-x"], (1, 3, 5, 7, 9, 11)),
    **{"quad-y4": (2,), "y6": (0, 2, 3), "y6-b": (1, 3, 5), "y6-f": (3, 4, 5)},
}
# On co-rotating frames the upper rotor of each arm does 0.9 of the work of the lower one.
CO_ROTATING = ("octaquad-x-cor", "octaquad-cw-x-cor")


def identify(flight: Flight) -> Vehicle | None:
    """The frame of an ArduPilot log by its parameters, else its vehicle type; None for others or when it has neither.

    Raises VehicleError for frames that are not multirotors with fixed rotors, and for types ArduPilot does not have."""
    if not flight.autopilot.lower().startswith(("ardu", "apm")):
        return None
    parameters = airframes.finite(flight)
    notes: list[str] = []
    if parameters.get("FRAME_CLASS", 0) > 0:
        frame = frame_of(int(parameters["FRAME_CLASS"]), int(parameters.get("FRAME_TYPE", 1)))
        source = "FRAME_CLASS, FRAME_TYPE"
    elif "FRAME" in parameters:
        frame = _old_frame(flight, notes)
        source = "FRAME"
    elif (guess := airframes.kind(flight)) is not None:
        frame, source = "tri" if guess == "tri" else f"{guess}-x", "vehicle type"
        if guess != "tri":
            notes.append(f"The log only gives {guess} rotors: frame {guess} X assumed.")
        if guess == "octa":
            notes.append("An octa can also be a + or coaxial frame with other rotor numbers: give --vehicle FILE.")
    else:
        return None
    vehicle = build(frame, curve(flight, notes), source=source, assumptions=tuple(notes))
    # The mixer's factors do not include the extra thrust of the tilted rear motor.
    return replace(vehicle, mixer=None, assumptions=(*notes, TRI_NOTE)) if frame == "tri" else vehicle


def build(frame: str, curve: ThrustCurve, source: str = "airframe name", assumptions: tuple[str, ...] = ()) -> Vehicle:
    """The vehicle of one entry of `FRAMES`, with ArduPilot's normalised mixer."""
    right, forward, yaw = np.array([_place(motor) for motor in FRAMES[frame]]).T
    below = np.isin(np.arange(len(yaw)), LOWER.get(frame, ()))
    rotors = coaxial(tuple(Rotor(float(x), float(y), int(np.sign(s))) for x, y, s in zip(forward, right, yaw)), below)
    columns = [0.5 * v / max(np.abs(v).max(), 1e-9) for v in (-right, forward, yaw)]
    mixer = np.stack([*columns, np.ones(len(rotors))], axis=1)
    if frame == "tri":
        mixer[:2, 1] = 0.5  # AP_MotorsTri.cpp: as much as the rear motor
    if frame in CO_ROTATING:
        mixer[~below] *= 0.9
    return Vehicle(f"ardupilot-{frame}", rotors, curve, mixer=mixer, source=source, assumptions=(*assumptions, *note_on_coaxial(rotors)))


def curve(flight: Flight, notes: list[str]) -> ThrustCurve:
    """Thrust curve from the MOT_* (3.5 and later) or THR_* (before) parameters; assumptions are added to `notes`."""
    p = airframes.finite(flight)
    low, high = p.get("MOT_PWM_MIN", 0.0), p.get("MOT_PWM_MAX", 0.0)
    if not 0 < low < high:
        low, high = p.get("RC3_MIN", 0.0), p.get("RC3_MAX", 0.0)
    if not 0 < low < high:
        low, high = 1000.0, 2000.0
        notes.append("The log has neither MOT_PWM_MIN/MAX nor RC3_MIN/MAX: motor pulses taken as 1000 to 2000 us.")
    if "MOT_SPIN_MAX" in p or "THR_MIN" not in p:
        start, full = p.get("MOT_SPIN_MIN", 0.15), p.get("MOT_SPIN_MAX", 0.95)
        if "MOT_SPIN_MAX" not in p:
            notes.append("The log has no MOT_SPIN_MIN/MAX: ArduPilot's defaults 0.15 and 0.95 assumed.")
    else:
        # Before 3.5 the thrust curve starts at THR_MIN and MOT_THST_MAX is a share of what lies above it; up to 3.2 outputs end at
        # MOT_TCRV_MAXPCT of the whole range.
        start = p["THR_MIN"] / 1000.0
        full = start + (1.0 - start) * p.get("MOT_THST_MAX", 0.95)
        if "MOT_TCRV_MAXPCT" in p:
            full = p["MOT_TCRV_MAXPCT"] / 100.0 if p.get("MOT_TCRV_ENABLE", 1.0) else 1.0
    if not 0 <= start < full <= 1.0:
        start, full = 0.15, 0.95
        notes.append("MOT_SPIN_MIN/MAX in the log are invalid: ArduPilot's defaults 0.15 and 0.95 assumed.")
    known = "MOT_THST_EXPO" in p
    expo = float(np.clip(p.get("MOT_THST_EXPO", 0.65), 0.0, 1.0))
    if not known:
        notes.append("The log has no MOT_THST_EXPO: ArduPilot's default 0.65 assumed, which affects the estimated size of a loss.")
    span = high - low
    return ThrustCurve(low + start * span, low + full * span, expo, known)


def frame_of(number: int, kind: int) -> str:
    """The frame of a FRAME_CLASS and a FRAME_TYPE. Raises VehicleError."""
    if number in UNSUPPORTED:
        raise VehicleError(
            f"FRAME_CLASS {number} is {UNSUPPORTED[number]}, which is not supported: only multirotors with fixed rotors are."
        )
    name = CLASSES.get(number)
    if name is None:
        raise VehicleError(f"FRAME_CLASS {number} is not a multirotor frame; describe the airframe with --vehicle FILE.")
    if name == "tri":
        return name
    frame = _of_type(name, kind)
    if frame not in FRAMES:
        raise VehicleError(
            f"FRAME_CLASS {number} with FRAME_TYPE {kind} is not a frame of ArduPilot; describe the airframe with --vehicle FILE."
        )
    return frame


def _old_frame(flight: Flight, notes: list[str]) -> str:
    """Before 3.5 the class was compiled in: the firmware's 'Frame: QUAD' text has it, else the number of motors."""
    if not flight.rotor_count:
        raise VehicleError(
            f"{flight.name or 'The log'} holds no motor outputs (RCOU records, or MOT before ArduCopter 3.2), so its rotors "
            "cannot be diagnosed; include motors in LOG_BITMASK for the next flight."
        )
    kind = int(airframes.finite(flight)["FRAME"])
    texts = [m.text for m in flight.messages if m.kind == "text"] + [flight.firmware, flight.vehicle_type]
    for text in texts:
        match = re.search(r"\b(OCTA_?QUAD|QUAD|HEXA|OCTA|Y6|TRI|HELI)\b", text.upper())
        if match:
            name = match.group(1).replace("_", "").lower()
            break
    else:
        classes = {4: ("quad",), 6: ("hexa", "y6"), 8: ("octa", "octaquad")}.get(flight.rotor_count, ("",))
        name, unique = _class_by_outputs(flight, classes, kind)
        how = "the only one that matches the mixing of its outputs" if unique else f"its {flight.rotor_count} motor outputs"
        notes.append(f"The log does not name its frame class: {name} taken from {how}.")
    if name == "tri":
        return name
    if name == "heli" or not name:
        raise VehicleError("The firmware of this log flies a frame that is not supported: only multirotors with fixed rotors are.")
    frame = _of_type(name, kind)
    if frame not in FRAMES:
        raise VehicleError(f"FRAME {kind} is not a {name} frame; describe the airframe with --vehicle FILE.")
    return frame


def _of_type(name: str, kind: int) -> str:
    """The frame of a class and a FRAME_TYPE; every Y6 but B and F is the same default one."""
    return {10: "y6-b", 11: "y6-f"}.get(kind, "y6") if name == "y6" else f"{name}-{TYPES.get(kind)}"


def _class_by_outputs(flight: Flight, classes: tuple[str, ...], kind: int) -> tuple[str, bool]:
    """(class, True) when one mixer alone can explain the outputs' variation, else (the first class, False).

    A mixer moves n outputs along four directions only. The part of their differences outside these is compared."""
    motors, thrust = flight["motors"], curve(flight, [])
    rows = motors.whole & (motors.values > thrust.u_min).all(axis=1)
    able = [c for c in classes if _of_type(c, kind) in FRAMES]
    if len(able) < 2 or rows.sum() < 50:
        return able[0] if able else classes[0], False
    apart = thrust(motors.values[rows])
    apart = apart - apart.mean(axis=1, keepdims=True)
    apart = apart - apart.mean(axis=0)
    off = []
    for name in able:
        span, _ = np.linalg.qr(np.array(build(_of_type(name, kind), thrust).mixer, float))
        off.append(float(np.square(apart - apart @ span @ span.T).sum()))
    order = np.argsort(off)
    unique = off[order[0]] < OFF_MIXER * off[order[1]]
    return (able[int(order[0])], True) if unique else (able[0], False)


def _place(motor: tuple) -> tuple[float, float, float]:
    """(right, forward, yaw factor) of one motor of `FRAMES`."""
    if len(motor) == 3:
        return motor
    angle, yaw = math.radians(motor[0]), motor[1]
    return math.sin(angle), math.cos(angle), yaw


OFF_MIXER = 0.25  # of the next class's residual: by chance the sums differ by far less
TRI_NOTE = (
    "A tricopter: a servo yaws it, so yaw is not assessed, and its outputs are not compared with the mixer; "
    "rotor 3 is motor 4, the rear one."
)
DEFAULT_CURVE = ThrustCurve(1150.0, 1950.0, 0.65, known=False)
NAMES = {f"ardupilot-{frame}": functools.partial(build, frame, DEFAULT_CURVE) for frame in FRAMES}
