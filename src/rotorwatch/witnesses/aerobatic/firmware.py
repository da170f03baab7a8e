"""Firmware for pilots who command rates, in manoeuvres without hover."""

from rotorwatch.flight import Flight

FIRMWARES = ("betaflight", "inav", "emuflight", "cleanflight", "baseflight", "butterflight")


def flown_by_rates(flight: Flight) -> bool:
    """Whether the firmware is for pilots who command rates."""
    return flight.autopilot.lower() in FIRMWARES
