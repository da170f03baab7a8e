"""Real flights in public repositories whose faults are known, or that are healthy: their labels, and their tables where they are no logs.

    from rotorwatch_lab.experiments import real_flights
    rows = real_flights.recipe("rrc").flights(Path("checkout"), Path("converted"))

A recipe is a module with `flights(checkout, out)`: rows for `evaluate` with a `group` for the page, from a checkout of the repository; what
has to be converted is written into the folder `out`. docs/real_faults.toml names repositories, commits and licences.

rrc.py               cut propellers of a quadrotor
crazypad.py          cut and taped propellers of a nano-quadrotor
degraded_control.py  rotors switched off, the vehicle spins on
openha.py            losses in the firmware
neural_fly.py        healthy flights in wind
others.py            logs without a known fault
tables.py            writes tables and vehicle files
rules.py             the rules of other projects on the same flights
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def recipe(name: str) -> Any:
    """The recipe of that name."""
    return import_module(f"{__name__}.{name}")
