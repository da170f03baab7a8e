"""PX4's motor failure check by ESC current, re-built from its documented parameters.

A motor has failed when, for FD_ACT_MOT_TOUT (100 ms), its command c is over FD_ACT_MOT_THR (0.2) while its ESC reports
less current than c times FD_ACT_MOT_C2T (2 A at full command). Only ESCs that have reported current before count.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.engine.motion import allocation
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

name = "px4-esc-current"
autopilot = "PX4"
HAS_CURRENT = 0.1  # A that an ESC must have reported once to be believed at all


def detect(flight: Flight, vehicle: Vehicle, airborne: allocation.Spans) -> tuple[dict[str, Any], ...]:
    """At most one finding for each rotor; none where ESC currents are not logged."""
    if not flight.has("esc", "motors"):
        return ()
    esc, parameters = flight["esc"], flight.parameters
    above = parameters.get("FD_ACT_MOT_THR", 0.2)
    per_command = parameters.get("FD_ACT_MOT_C2T", 2.0)
    patience = parameters.get("FD_ACT_MOT_TOUT", 100.0) / 1000.0
    low, high = vehicle.curve.u_min, vehicle.curve.u_max
    command = np.clip((flight["motors"].values - low) / (high - low), 0.0, 1.0)
    commanded = allocation.hold(flight["motors"].time, command, esc.time)
    inside = allocation.within(esc.time, airborne)
    findings = []
    for rotor in range(1, command.shape[1] + 1):
        if f"current{rotor}" not in esc.columns:
            continue
        column = esc.columns.index(f"current{rotor}")
        current, valid = esc.values[:, column], esc.valid[:, column]
        believed = np.maximum.accumulate(np.where(valid, current, 0.0)) > HAS_CURRENT
        drive = commanded[:, rotor - 1]
        low_current = inside & valid & believed & (drive > above) & (current < drive * per_command)
        since = None
        for k in np.flatnonzero(inside & valid):
            since = (esc.time[k] if since is None else since) if low_current[k] else None
            if since is not None and esc.time[k] - since >= patience:
                reason = f"ESC {rotor} drew {current[k]:.1f} A at a command of {drive[k]:.0%}"
                findings.append({"detector": name, "rotor": rotor, "time_s": float(esc.time[k]), "reason": reason})
                break
    return tuple(findings)
