"""PX4 multirotors: CA_ROTOR* geometry (1.13 and later), else the frame that SYS_AUTOSTART or MAV_TYPE stands for.

Motor order of the fixed frames follows PX4's published airframe reference. PX4's mixer is the pseudo-inverse of the
geometry, its roll and pitch columns scaled by their larger root mean square over half of the rotors, yaw by its largest
and thrust by its mean entry; see docs/airframes.md.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np

from rotorwatch import airframes
from rotorwatch.errors import VehicleError
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle, coaxial, lower_of_pairs, note_on_coaxial

# (angle clockwise from the nose, spin: +1 counter-clockwise seen from above)
# Of the coaxial frames the lower rotors are 2, 4, 6 and 5 to 8 (z of PX4's hex_cox.toml and octa_cox.toml): on each arm
# the one listed later.
_HEXA, _OCTA, _STACKED = (-1, 1, -1, 1, 1, -1), (-1, -1, 1, 1, 1, 1, -1, -1), (1, -1, 1, -1, 1, -1, 1, -1)
FRAMES = {
    "quad-x": ((45, -135, -45, 135), (1, 1, -1, -1)),
    "quad-plus": ((90, -90, 0, 180), (1, 1, -1, -1)),
    "hexa-x": ((90, -90, -30, 150, 30, -150), _HEXA),
    "hexa-plus": ((0, 180, -120, 60, -60, 120), _HEXA),
    "hexa-coaxial": ((60, 60, 180, 180, -60, -60), (-1, 1, -1, 1, -1, 1)),
    "octa-x": ((22.5, -157.5, 67.5, 157.5, -22.5, -112.5, -67.5, 112.5), _OCTA),
    "octa-plus": ((0, 180, 45, 135, -45, -135, -90, 90), _OCTA),
    "tri": ((60, -60, 180), (0, 0, 0)),
    "octa-coaxial": ((45, -45, -135, 135, -45, 45, 135, -135), _STACKED),
}
# SYS_AUTOSTART comes in thousands per frame; 1001 and 3010 are simulated quads, 10015 to 10020 quads of wide X shape.
THOUSANDS = {4: "quad-x", 5: "quad-plus", 6: "hexa-x", 7: "hexa-plus", 8: "octa-x", 9: "octa-plus"}
THOUSANDS |= {11: "hexa-coaxial", 12: "octa-coaxial", 14: "tri"}
SINGLE = {1001: "quad-x", 3010: "quad-x", **dict.fromkeys(range(10015, 10021), "quad-x"), 10040: "quad-x"}
TILTING = 8  # CA_AIRFRAME of multirotors with tilting rotors
USUAL_EXPO = 0.65  # ESCs without a thrust model: the usual result of propeller test stands


def identify(flight: Flight) -> Vehicle | None:
    """The frame of a PX4 log; None for other autopilots or when neither parameters nor outputs say which frame.

    Raises VehicleError for airframes that are not multirotors."""
    if not flight.autopilot.lower().startswith("px4"):
        return None
    notes: list[str] = []
    rotors = _rotors_from_parameters(flight, notes)
    if rotors is not None:
        name, source = f"px4-{len(rotors)}-rotors", "CA_ROTOR parameters"
    else:
        frame, source = _frame(flight, notes)
        if frame is None:
            return None
        name, rotors = f"px4-{frame}", place(frame)
    tilts = len(rotors) == 3 and not any(r.spin for r in rotors)
    if tilts:
        notes.append("A tricopter: a servo yaws it, so yaw is not assessed, and its outputs are not compared with the mixer.")
    return Vehicle(
        *(name, rotors, curve(flight, notes)),
        mixer=None if tilts else mix(rotors),
        source=source,
        assumptions=(*notes, *note_on_coaxial(rotors)),
        extra={"mixer_expo": mixer_expo(flight), "rests_at_minimum": True},
    )


def complete(vehicle: Vehicle, flight: Flight) -> Vehicle:
    """The vehicle of a PX4 log with the curve of its mixer, which is a parameter of its own, where its file does not say it."""
    if "mixer_expo" in vehicle.extra or not flight.autopilot.lower().startswith("px4"):
        return vehicle
    return replace(vehicle, extra={**vehicle.extra, "mixer_expo": mixer_expo(flight)})


def place(frame: str) -> tuple[Rotor, ...]:
    """Rotors of one of `FRAMES`, on a circle of radius 1."""
    angles, spins = FRAMES[frame]
    rotors = tuple(Rotor(math.cos(math.radians(a)), math.sin(math.radians(a)), s) for a, s in zip(angles, spins))
    return coaxial(rotors, lower_of_pairs(rotors))


def mix(rotors: tuple[Rotor, ...]) -> np.ndarray:
    """(n, 4) factors (roll, pitch, yaw, thrust) of PX4's normalised allocation for upright rotors of equal strength."""
    x, y, spin = (np.array([getattr(r, k) for r in rotors], float) for k in ("x", "y", "spin"))
    inverse = np.linalg.pinv(np.stack([-y, x, 0.05 * spin, np.ones_like(x)]))
    inverse[np.abs(inverse) < 1e-9] = 0.0
    used = np.maximum(np.count_nonzero(inverse[:, :2], axis=0) / 2, 1)
    tilt = np.max(np.sqrt(np.sum(inverse[:, :2] ** 2, axis=0) / used))
    scale = np.array([tilt, tilt, np.max(np.abs(inverse[:, 2])), np.mean(np.abs(inverse[:, 3]))])
    return inverse / np.where(scale > 0, scale, 1.0)


def mixer_expo(flight: Flight) -> float:
    """The expo of the thrust curve that lies between PX4's mixer and the logged commands."""
    motors = flight.signals.get("motors")
    # actuator_motors holds thrust demands: the thrust model is applied to them on the way out.
    if motors is not None and "actuator_motors" in motors.source:
        return 0.0
    return float(np.clip(airframes.finite(flight).get("THR_MDL_FAC", 0.0), 0.0, 1.0))


def curve(flight: Flight, notes: list[str]) -> ThrustCurve:
    """Thrust curve from THR_MDL_FAC and the output limits; assumptions are added to `notes`."""
    factor = airframes.finite(flight).get("THR_MDL_FAC", 0.0)
    known = 0.0 < factor <= 1.0
    if not known:
        notes.append(
            f"THR_MDL_FAC is not set: thrust taken as {1 - USUAL_EXPO:.2f} u + {USUAL_EXPO:.2f} u^2 of the command u, "
            "which affects the estimated size of a loss."
        )
    expo = factor if known else USUAL_EXPO
    motors = flight.signals.get("motors")
    if motors is None or motors.unit == "us":
        low, high = flight.facts.get("pwm_min"), flight.facts.get("pwm_max")
        if not low or not high or not low < high:
            low, high = 1000.0, 2000.0
            notes.append("The log has no PWM limits: motor pulses taken as 1000 to 2000 us.")
        return ThrustCurve(float(low), float(high), expo, known)
    demands = known and "actuator_motors" in motors.source
    return ThrustCurve(0.0, 1.0, 0.0 if demands else expo, known)


def _rotors_from_parameters(flight: Flight, notes: list[str]) -> tuple[Rotor, ...] | None:
    p = airframes.finite(flight)
    count = int(p.get("CA_ROTOR_COUNT", 0))
    if not 3 <= count <= 12:
        return None
    tricopter = p.get("CA_AIRFRAME", 0) == TILTING and count == 3 and p.get("CA_SV_TL_COUNT", 0) > 0
    if p.get("CA_AIRFRAME", 0) != 0 and not tricopter:
        raise VehicleError(
            f"CA_AIRFRAME {int(p['CA_AIRFRAME'])} is not a plain multirotor; "
            "describe its lifting rotors with --vehicle FILE if they fly it alone."
        )
    names = ("PX", "PY", "PZ", "KM", "AX", "AY", "CT")
    rows = [[p.get(f"CA_ROTOR{k}_{name}", 0.0) for name in names] for k in range(count)]
    x, y, z, moment, tilt_x, tilt_y, strength = np.array(rows, float).T
    if max(np.abs(x).max(), np.abs(y).max()) < 1e-3:
        return None
    if np.abs(np.stack([tilt_x, tilt_y])).max() > 0.1:
        notes.append("Rotors are tilted (CA_ROTOR*_AX, _AY): treated as upright.")
    if strength.min() <= 0.0:
        strength = np.ones(count)
    if tricopter:
        moment = np.zeros(count)
    # Positions count from the centre of gravity.
    rotors = tuple(Rotor(float(a), float(b), int(np.sign(m))) for a, b, m in zip(x, y, moment))
    rotors = coaxial(rotors, lower_of_pairs(rotors, z))
    return tuple(replace(r, share=r.share * float(c / strength.mean())) for r, c in zip(rotors, strength))


def _frame(flight: Flight, notes: list[str]) -> tuple[str | None, str]:
    start = int(airframes.finite(flight).get("SYS_AUTOSTART", 0))
    frame = SINGLE.get(start) or THOUSANDS.get(start // 1000)
    if frame is not None:
        if start in SINGLE and start > 10000:
            notes.append(f"SYS_AUTOSTART {start} is a quad of wide X shape: taken as a square X.")
        return frame, f"SYS_AUTOSTART {start}"
    if airframes.kind(flight) == "tri":
        return "tri", "vehicle type"
    guess = f"{airframes.kind(flight)}-x"
    if guess in FRAMES and flight.rotor_count in (0, len(FRAMES[guess][0])):  # a heartbeat may name another kind
        notes.append(f"The log only names its vehicle type: frame {guess} assumed.")
        return guess, "vehicle type"
    frame = {4: "quad-x", 6: "hexa-x", 8: "octa-x"}.get(flight.rotor_count)
    if frame is not None:
        notes.append(f"The log has no frame parameters: frame {frame} assumed for {flight.rotor_count} motor outputs.")
    return frame, f"{flight.rotor_count} motor outputs"


def _named(frame: str) -> Vehicle:
    rotors = place(frame)
    extra = {"mixer_expo": 0.0, "rests_at_minimum": True}  # THR_MDL_FAC is 0 by default
    return Vehicle(f"px4-{frame}", rotors, ThrustCurve(0.0, 1.0, USUAL_EXPO, False), mix(rotors), source="airframe name", extra=extra)


NAMES = {f"px4-{frame}": functools.partial(_named, frame) for frame in FRAMES}
