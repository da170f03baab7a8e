"""Somebody's own detector beside rotorwatch: a Python file (with .py or without), or a module, that defines `name` and

    detect(flight, vehicle, airborne) -> findings, each a dict with rotor (from 1), time_s (when it was raised) and, if it likes, reason

as an entry point `rotorwatch.detectors` does (docs/plug-ins.md). airborne: ((start, end), ...) s."""

from __future__ import annotations

import importlib
import importlib.util
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from rotorwatch import airframes
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, vehicle_file
from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.toolkit import airborne


@cache
def load(spec: str) -> Any:
    """The detector that FILE.py or a module's name stands for. Raises ConfigError, one sentence."""
    try:
        path = Path(spec if spec.endswith(".py") else f"{spec}.py")
        if spec.endswith(".py") or path.exists():
            about = importlib.util.spec_from_file_location(path.stem, path)
            assert about is not None and about.loader is not None
            found = importlib.util.module_from_spec(about)
            about.loader.exec_module(found)
        else:
            found = importlib.import_module(spec)
    except Exception as why:
        raise ConfigError(f"--detector {spec} cannot be loaded: {type(why).__name__}: {why}.") from None
    if missing := next((part for part in ("name", "detect") if not hasattr(found, part)), None):
        raise ConfigError(f"--detector {spec} defines no {missing}: it needs name and detect(flight, vehicle, airborne).")
    return found


def answer(spec: str, flight: Flight, vehicle: str | None, beside: Diagnosis) -> Diagnosis:
    """The detector's findings in the form of an answer: a sure event of its rotor at each. beside: rotorwatch's answer to the flight, of
    which facts are taken. Raises ConfigError where the detector fails, or its findings are not as they should be."""
    rule = load(spec)
    craft = vehicle_file.read(vehicle) if vehicle else airframes.identify(flight)
    try:
        found = [(int(f["rotor"]), float(f["time_s"]), str(f.get("reason", ""))) for f in rule.detect(flight, craft, airborne(flight))]
    except Exception as why:
        raise ConfigError(f"{rule.name} failed on {flight.name}: {type(why).__name__}: {why}.") from None
    if bad := next((f for f in found if not (1 <= f[0] <= len(craft.rotors) and math.isfinite(f[1]))), None):
        raise ConfigError(f"{rule.name} found rotor {bad[0]} at {bad[1]} s in {flight.name}: give a rotor from 1 and a time in s.")
    events = tuple(
        Event(LOSS, (rotor,), time, time, None, (), (), 1.0, (), reason) for rotor, time, reason in sorted(found, key=lambda f: f[1])
    )
    verdict, first = ("fault", events[0].reason) if events else ("healthy", "")
    return replace(
        beside, verdict=verdict, headline=first, reason=first, events=events, rotors=(), main=None, whole_flight=None, estimator=rule.name
    )
