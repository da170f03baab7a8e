"""Multirotors of Betaflight, INAV, EmuFlight and Cleanflight.

Their Blackbox logs do not name the mixer. Where the log holds the controller's sums, the reader fits each output's factors of roll, pitch
and yaw (facts["mixer"]), which give the frame, and whether the motors turn the other way round (yaw_motors_reversed). Otherwise the usual
frame of as many motors is assumed.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np

from rotorwatch import airframes
from rotorwatch.airframes._betaflight_frames import FRAMES
from rotorwatch.errors import VehicleError
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle, coaxial, lower_of_pairs, note_on_coaxial

FIRMWARES = ("betaflight", "inav", "emuflight", "cleanflight", "baseflight", "butterflight", "rotorflight")
USUAL = {3: "tri", 4: "quad-x", 6: "hexa-x", 8: "octa-x8"}
FEATURE_3D = 1 << 12
NEAR = 0.35  # root mean square error of a frame's factors, which have one of about 0.8
EXPO = 0.65  # ESCs without a thrust model: the usual result of propeller test stands
UNSEEN = (
    "The log does not name its frame: {frame} with {autopilot}'s motor order assumed, and propellers that turn as is usual (props in); "
    "give --vehicle FILE if it is another, or if the motors are reversed (props out)."
)
TRI_NOTE = "A tricopter: a servo yaws it, so yaw is not assessed, and its outputs are not compared with the mixer."


def identify(flight: Flight) -> Vehicle | None:
    """The frame of a log of these firmwares; None for others, and where it commands no rotors.

    Raises VehicleError for motors that turn both ways (3D mode), and for numbers of motors that no multirotor here has."""
    if flight.autopilot.lower() not in FIRMWARES or not flight.rotor_count:
        return None
    parameters = airframes.finite(flight)
    if int(parameters.get("features", 0)) & FEATURE_3D:
        raise VehicleError(
            f"{flight.name or 'This log'} is of motors that turn both ways (feature 3D): their outputs alone do not determine the thrust, "
            "so it cannot be diagnosed."
        )
    count = flight.rotor_count
    if count not in USUAL:
        raise VehicleError(
            f"{flight.name or 'This log'} commands {count} motor{'s' if count > 1 else ''}, which no known frame has; "
            "describe a multirotor with --vehicle FILE."
        )
    frame, turned, notes = _seen(flight, count)
    vehicle = build(frame, curve(flight, notes), turned)
    return replace(vehicle, source=f"{count} motor outputs", assumptions=(*notes, *vehicle.assumptions))


def _seen(flight: Flight, count: int) -> tuple[str, bool, list[str]]:
    """(frame, motors reversed?, assumptions) by the fitted mixer."""
    seen = np.array(flight.facts.get("mixer") or np.zeros((0, 3)), float)
    frame = USUAL[count]
    if frame == "tri":
        return frame, False, [TRI_NOTE]
    if seen.shape != (count, 3) or not np.isfinite(seen).all() or (np.abs(seen).max(axis=0) < 1e-3).any():
        return frame, False, [UNSEEN.format(frame=frame, autopilot=flight.autopilot)]
    seen = seen / np.abs(seen).max(axis=0)
    off = {}
    for name, motors in FRAMES.items():
        if len(motors) == count:
            factors = _factors(motors)
            turned = bool(seen[:, 2] @ factors[:, 2] < 0)
            factors[:, 2] *= -1.0 if turned else 1.0
            off[name] = float(np.sqrt(np.square(seen - factors).mean())), turned
    frame = min(off, key=lambda name: off[name][0])
    error, turned = off[frame]
    notes = [f"The frame {frame}{', motors reversed (props out),' if turned else ''} was identified from the mixing of the outputs."]
    if error > NEAR:
        notes = [f"The mixing of the outputs matches no known frame; {frame} is closest. Describe the vehicle with --vehicle FILE."]
    return frame, turned, notes


def build(frame: str, thrust: ThrustCurve, turned: bool = False) -> Vehicle:
    """The vehicle of one entry of `FRAMES`. turned: motors reversed, props out."""
    places = [_place(motor) for motor in FRAMES[frame]]
    rotors = tuple(Rotor(forward, right, int(-yaw if turned else yaw)) for right, forward, yaw in places)
    rotors = coaxial(rotors, lower_of_pairs(rotors))
    name = f"betaflight-{frame}{'-reversed' if turned else ''}"
    return Vehicle(name, rotors, thrust, source="airframe name", assumptions=note_on_coaxial(rotors))


def curve(flight: Flight, notes: list[str]) -> ThrustCurve:
    """Thrust from the output at idle to the largest one; assumptions are added to `notes`."""
    low, high = flight.facts.get("motor_low"), flight.facts.get("motor_high")
    pulses = "motors" in flight.signals and flight["motors"].unit == "us"
    if low is None or high is None or not low < high:
        low, high = (1070.0, 2000.0) if pulses else (0.05, 1.0)
        notes.append(f"The log has no range of its outputs: {low:g} to {high:g} assumed.")
    linear = airframes.finite(flight).get("thrust_linear", 0.0)
    note = f", thrust_linear {linear:g} included, which is in the logged outputs," if linear else ""
    notes.append(
        f"The firmware has no thrust curve of the motors: thrust{note} taken as {1 - EXPO:.2f} u + {EXPO:.2f} u^2 of the command u, "
        "which affects the estimated size of a loss."
    )
    return ThrustCurve(float(low), float(high), EXPO, known=False)


def _factors(motors: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """(n, 3) factors of roll, pitch and yaw (body FRD) of each output, the largest of each column 1."""
    right, forward, yaw = np.array([_place(motor) for motor in motors]).T
    return np.stack([v / np.abs(v).max() for v in (-right, forward, yaw)], axis=1)


def _place(motor: tuple[float, ...]) -> tuple[float, float, float]:
    """(right, forward, yaw) of one motor of `FRAMES`."""
    if len(motor) == 3:
        return motor[0], motor[1], motor[2]
    angle = math.radians(motor[0])
    return math.sin(angle), math.cos(angle), motor[1]


DEFAULT_CURVE = ThrustCurve(0.0455, 1.0, EXPO, known=False)  # DShot, idle at 4.5 %
NAMES = {f"betaflight-{frame}": functools.partial(build, frame, DEFAULT_CURVE) for frame in FRAMES}
NAMES |= {f"betaflight-{frame}-reversed": functools.partial(build, frame, DEFAULT_CURVE, True) for frame in FRAMES if frame != "tri"}
