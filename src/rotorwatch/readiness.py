"""Can this log be judged at all? Asked of the very functions that the diagnosis itself calls, so that it promises no more and no less."""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch import airframes, trust
from rotorwatch.airborne import airborne
from rotorwatch.diagnose import READY_S, observe
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.vehicle import Vehicle


class Obstacle(NamedTuple):
    """What keeps `diagnose` from judging a flight. what: frame, motors, airborne or trust. why: one sentence."""

    what: str
    why: str


def obstacle(flight: Flight, vehicle: Vehicle | None = None) -> Obstacle | None:
    """The first reason for which `diagnose` refuses this flight, or answers that nothing in it can be judged; None when it judges it.

    vehicle: the airframe, for logs that do not name theirs.
    """
    try:
        craft = vehicle or airframes.identify(flight)
        airframes.check(craft, flight)
    except RotorwatchError as why:
        return Obstacle("frame", str(why))
    if not flight.has("motors"):
        return Obstacle("motors", "The log shows no motor outputs: without them no rotor can be judged.")
    air = airborne(flight)
    table = observe(flight, craft, air, READY_S)
    if table is None:
        return Obstacle("airborne", "No part of this log is in the air.")
    doubts = trust.doubts(flight, craft, air, table)
    return Obstacle("trust", doubts[0]) if doubts else None
