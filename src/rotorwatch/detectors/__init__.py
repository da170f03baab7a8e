"""Published threshold detectors, for comparison: the failure checks of the autopilots themselves.

A module here offers ``name``, ``autopilot`` (whose check it is, as `Flight.autopilot` names it) and
``detect(flight, vehicle, airborne) -> tuple[dict, ...]`` with a dict per finding: detector, rotor (1-based), time_s and reason (one
sentence). Adding a detector is adding a file, or an entry point `rotorwatch.detectors` of another package: a module or an object with the
same three.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from rotorwatch.base import discovery
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

PARTS = ("name", "autopilot", "detect")


def modules() -> tuple[Any, ...]:
    """The detectors found in this folder and those that other packages offer, by name; one that is broken is left out, with a
    PluginWarning."""
    rules: list[Any] = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    taken = {known.name for known in rules}
    others = discovery.others("rotorwatch.detectors", PARTS, lambda rule: "its name is taken" if rule.name in taken else "")
    rules += [rule for _, rule in others]
    return tuple(sorted(rules, key=lambda module: module.name))


def for_autopilot(autopilot: str) -> tuple[Any, ...]:
    """The checks that this autopilot itself makes; none for one that no module is of."""
    return tuple(module for module in modules() if module.autopilot.lower() == autopilot.lower())


def detect(flight: Flight, vehicle: Vehicle, airborne: tuple[tuple[float, float], ...]) -> tuple[dict[str, Any], ...]:
    """Findings of the flight's own autopilot checks, in time order. airborne: ((start, end), ...) in s."""
    findings = [finding for module in for_autopilot(flight.autopilot) for finding in module.detect(flight, vehicle, airborne)]
    return tuple(sorted(findings, key=lambda finding: (finding["time_s"], finding["detector"])))
