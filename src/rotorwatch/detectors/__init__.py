"""Published threshold detectors, to compare with: what the autopilots themselves would have said, and when.

A module here offers ``name`` and ``detect(flight, vehicle, airborne) -> tuple[dict, ...]`` with a dict per finding:
detector, rotor (1-based), time_s and reason (one sentence). Adding a detector is adding a file.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType
from typing import Any

from rotorwatch.flight import Flight
from rotorwatch.vehicle import Vehicle


def modules() -> tuple[ModuleType, ...]:
    """The detectors found in this folder, by name."""
    found = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    return tuple(sorted(found, key=lambda module: module.name))


def detect(flight: Flight, vehicle: Vehicle, airborne: tuple[tuple[float, float], ...]) -> tuple[dict[str, Any], ...]:
    """What all detectors find in a flight, in time order. airborne: ((start, end), ...) in s."""
    found = [finding for module in modules() for finding in module.detect(flight, vehicle, airborne)]
    return tuple(sorted(found, key=lambda finding: (finding["time_s"], finding["detector"])))
