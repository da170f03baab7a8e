"""A detector: an output that stays at its top for a second. This is Acme's own check, shown beside the diagnosis of an Acme log."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

name = "template-full-output"
autopilot = "Acme"

TOP, HOLD_S = 0.98, 1.0


def detect(flight: Flight, vehicle: Vehicle, airborne: tuple[tuple[float, float], ...]) -> tuple[dict[str, Any], ...]:
    """One finding for each spell in the air in which an output stays at its top for HOLD_S seconds."""
    if not flight.has("motors"):
        return ()
    time, found = flight["motors"].time, []
    flying = np.any([(start <= time) & (time < end) for start, end in airborne], axis=0)
    for k in range(len(vehicle.rotors)):
        since = None
        for t, full in zip(time, flying & (flight["motors"].values[:, k] > TOP), strict=True):
            if not full:
                since = None
                continue
            since = t if since is None else since
            if t - since >= HOLD_S:
                reason = f"output {k + 1} was at its top for {HOLD_S:.0f} s"
                found.append({"detector": name, "rotor": k + 1, "time_s": float(t), "reason": reason})
                since = np.inf  # once a spell
    return tuple(found)
