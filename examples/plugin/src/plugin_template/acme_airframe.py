"""The one airframe that Acme sells: a quadrotor X whose rotors count clockwise from the front left."""

from __future__ import annotations

from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle

ARM = 2**-0.5


def identify(flight: Flight) -> Vehicle | None:
    """The vehicle of an Acme log; None for any other, which somebody else may know."""
    return build() if flight.autopilot == "Acme" else None


def build() -> Vehicle:
    """The Acme quadrotor. x forward, y right; spin +1 counter-clockwise seen from above."""
    rotors = (Rotor(ARM, -ARM, -1), Rotor(ARM, ARM, 1), Rotor(-ARM, ARM, -1), Rotor(-ARM, -ARM, 1))
    note = "Thrust curve of the Acme quadrotor: half linear, half quadratic, not measured on this vehicle."
    curve = ThrustCurve(0.0, 1.0, 0.65, known=False)
    return Vehicle("acme-quad", rotors, curve, source="Acme log", assumptions=(note,))


NAMES = {"acme-quad": build}
