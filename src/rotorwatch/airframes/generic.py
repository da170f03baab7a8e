"""Logs that only say how many rotors there are (MAVLink telemetry): the usual frame of that autopilot is assumed."""

from __future__ import annotations

from dataclasses import replace

from rotorwatch.airframes import ardupilot, px4
from rotorwatch.flight import Flight
from rotorwatch.vehicle import Vehicle

RANK = 10  # after the modules that read frame parameters
KINDS = {2: "quad", 13: "hexa", 14: "octa", 29: "dodecahexa", 35: "deca"}  # MAVLink MAV_TYPE
WORDS = {"quad": "quad", "hexa": "hexa", "octo": "octa", "octa": "octa", "dodeca": "dodecahexa", "deca": "deca"}


def identify(flight: Flight) -> Vehicle | None:
    """X frame of the vehicle type in the log, with an assumption that says so; None without autopilot or type."""
    kind = _kind(flight)
    autopilot = flight.autopilot.lower()
    if kind is None or not autopilot.startswith(("ardu", "apm", "px4")):
        return None
    notes = [f"The log only says that this is a {kind} rotor vehicle: frame {kind} X assumed."]
    if kind == "octa":
        notes.append(
            "An octa can as well be a +, V or coaxial frame: rotor numbers may then be wrong; give --vehicle FILE."
        )
    if autopilot.startswith("px4"):
        if f"px4-{kind}-x" not in px4.NAMES:
            return None
        vehicle = px4.NAMES[f"px4-{kind}-x"]()
        curve = px4.curve(flight, notes)
        vehicle = replace(vehicle, extra={"mixer_expo": px4.mixer_expo(flight), "rests_at_minimum": True})
    else:
        vehicle = ardupilot.NAMES[f"ardupilot-{kind}-x"]()
        curve = ardupilot.curve(flight, notes)
    return replace(vehicle, curve=curve, source="vehicle type in the log", assumptions=tuple(notes))


def _kind(flight: Flight) -> str | None:
    number = flight.facts.get("mav_type", flight.parameters.get("MAV_TYPE"))
    if number is not None and int(number) in KINDS:
        return KINDS[int(number)]
    text = str(flight.vehicle_type).lower()
    if text.isdigit():
        return KINDS.get(int(text))
    # Longest word first: "dodeca" holds "deca".
    return next((WORDS[w] for w in sorted(WORDS, key=len, reverse=True) if w in text), None)
