"""The kind of vehicle of a log that is no multirotor, in words for the refusal."""

from __future__ import annotations

import math

from rotorwatch.flight import Flight

# MAVLink MAV_TYPE: https://mavlink.io/en/messages/minimal.html#MAV_TYPE
PLANE, HELICOPTER, ROVER, BOAT, SUBMARINE, VTOL = 1, 4, 10, 11, 12, 22
OTHERS = {
    **{PLANE: "a fixed-wing aircraft", 3: "a coaxial helicopter", HELICOPTER: "a helicopter"},
    **{5: "an antenna tracker", 7: "an airship", 8: "a balloon", 9: "a rocket", ROVER: "a ground rover"},
    **{BOAT: "a boat", SUBMARINE: "a submarine", 16: "a flapping-wing aircraft", 17: "a kite", 28: "a parafoil"},
    **dict.fromkeys(range(19, 26), "a VTOL aircraft"),
}
FIRMWARES = {"ArduPlane": PLANE, "ArduRover": ROVER, "ArduSub": SUBMARINE, "Blimp": 7, "AntennaTracker": 5}
# PX4's CA_AIRFRAME; its other numbers are multirotors, or anything.
CA_AIRFRAMES = {1: PLANE, **dict.fromkeys((2, 3, 4), VTOL), **dict.fromkeys((5, 6, 13), ROVER)}
CA_AIRFRAMES |= {10: HELICOPTER, 11: HELICOPTER, 12: 3}
HELICOPTER_PARAMETERS = ("H_COL_MIN", "H_COL_MAX", "H_RSC_MODE", "H_SV_MAN")


def other_kind(flight: Flight) -> str:
    """'a fixed-wing aircraft (ArduPlane)': the vehicle and its evidence; empty for a multirotor or when unknown."""
    parameters = {name: v for name, v in flight.parameters.items() if math.isfinite(v)}
    firmware = flight.vehicle_type
    if firmware in FIRMWARES:
        kind = FIRMWARES[firmware]
        if firmware == "ArduPlane" and parameters.get("Q_ENABLE", 0) > 0:
            return f"{OTHERS[VTOL]} ({firmware}, Q_ENABLE)"
        if firmware == "ArduRover" and parameters.get("FRAME_CLASS") == 2:
            kind = BOAT
        return f"{OTHERS[kind]} ({firmware})"
    if flight.autopilot.startswith("ArduPilot") and any(name in parameters for name in HELICOPTER_PARAMETERS):
        return f"{OTHERS[HELICOPTER]} (H_ parameters)"
    airframe = parameters.get("CA_AIRFRAME")
    if airframe in CA_AIRFRAMES:
        return f"{OTHERS[CA_AIRFRAMES[int(airframe)]]} (CA_AIRFRAME {airframe:.0f})"
    number = flight.facts.get("mav_type", parameters.get("MAV_TYPE"))
    return f"{OTHERS[int(number)]} (MAV_TYPE {number:.0f})" if number in OTHERS else ""


def refusal(flight: Flight) -> str:
    """The sentence that refuses this vehicle; empty when it can be assessed."""
    kind = other_kind(flight)
    if not kind:
        return ""
    remedy = " If it flew on fixed lifting rotors alone, describe them with --vehicle FILE." if "VTOL" in kind else ""
    return f"{flight.name or 'This log'}: this log is of {kind}; rotorwatch diagnoses multirotors only.{remedy}"
