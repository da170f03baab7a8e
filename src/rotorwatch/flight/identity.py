"""Identity of the aircraft, from a log, and the autopilot's number of the flight.

In this order: the serial number of the autopilot's processor (ArduPilot logs it as the message "BOARD XXXXXXXX XXXXXXXX XXXXXXXX", PX4 as
sys_uuid); the calibration of its accelerometers, whose digits no two boards share. A log with neither identifies no aircraft, and none is
guessed: simulators leave both at their defaults.
"""

from __future__ import annotations

import hashlib
import re
from typing import NamedTuple

from rotorwatch.flight.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

UID = re.compile(r"^(\S+) ((?:[0-9A-F]{8} ?){3})$")
MACHINE = re.compile(r"^[0-9a-f]{32}$")  # boards that run Linux, and simulators
CALIBRATION = re.compile(r"^(INS_ACC\d?(OFFS|SCAL)_[XYZ]|CAL_ACC\d_[XYZ](OFF|SCALE))$")
DIGITS = 4  # of a calibration that was measured; 0.001 was not
LEAST = 3  # of them, at least
# Counted up by the autopilot: boots of ArduPilot, flights of PX4.
COUNTS = ("STAT_BOOTCNT", "COM_FLIGHT_UUID")


class Identity(NamedTuple):
    """text: identity of the aircraft, or "" when unknown. called: a short name for display. by: serial number, calibration or ""."""

    text: str
    called: str
    by: str


def identify(flight: Flight) -> Identity:
    """The aircraft of a flight."""
    system = flight.parameters.get("MAV_SYSID", flight.parameters.get("SYSID_THISMAV", 1.0))
    for message in flight.messages:
        if message.kind != "text":
            continue
        if match := UID.match(message.text):
            digits = match.group(2).replace(" ", "")
            return Identity(f"serial {match.group(1)} {digits}", f"{match.group(1)}-{digits[-4:]}", "serial number")
        if MACHINE.match(message.text):
            text = f"machine {message.text} system {system:.0f}"
            return Identity(text, f"{message.text[:4]}-{system:.0f}", "serial number")
    if uuid := str(flight.facts.get("sys_uuid", "")):
        board = str(flight.facts.get("ver_hw") or "PX4")
        return Identity(f"serial {board} {uuid}", f"{board}-{uuid[-4:]}", "serial number")
    return _by_calibration(flight)


def _by_calibration(flight: Flight) -> Identity:
    simulated = "SITL" in str(flight.facts.get("ver_hw", ""))
    values = {k: float(v) for k, v in sorted(flight.parameters.items()) if CALIBRATION.match(k)}
    measured = sum(_digits(v) >= DIGITS for v in values.values())
    if simulated or measured < LEAST:
        return Identity("", "", "")
    text = " ".join(f"{k}={v:.7g}" for k, v in values.items())
    mark = hashlib.sha256(text.encode()).hexdigest()[:16]
    return Identity(f"calibration {flight.autopilot} {mark}", f"{flight.autopilot}-{mark[:4]}", "calibration")


def _digits(value: float) -> int:
    """Significant decimal digits of a number that went through 32 bits."""
    text = f"{abs(value):.6e}".partition("e")[0].rstrip("0").replace(".", "")
    return len(text)


def count(flight: Flight) -> int | None:
    """The autopilot's number of the boot or flight; None where it has none."""
    for name in COUNTS:
        if name in flight.parameters and flight.parameters[name] >= 0:
            return int(flight.parameters[name])
    return None


def build(vehicle: Vehicle) -> str:
    """The build as a text: frame, rotors' places, thrust curve. Aircraft with the same text are compared with one another."""
    B = vehicle.effectiveness().round(2) + 0.0
    mark = hashlib.sha256(B.tobytes()).hexdigest()[:6]
    c = vehicle.curve
    return f"{vehicle.name}, {len(vehicle.rotors)} rotors ({mark}), commands {c.u_min:.4g} to {c.u_max:.4g}, expo {c.expo:.2g}"
