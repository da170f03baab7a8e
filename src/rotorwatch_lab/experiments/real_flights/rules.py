"""Rules of other projects on any flight that has their signals, whatever its autopilot: what they find, as `detectors` say it.

ArduPilot's and PX4's checks are those of `rotorwatch.detectors`. Flight Review's second version names a motor whose output drops to 0 while
armed after it was active, and one whose output stays at 1900 us or more for 50 samples
(github.com/PX4/flight-review-rs, crates/converter/src/diagnostics/motor_failure.rs at 0b1d5ee, from its description).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch import airframes, detectors
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import airborne

REVIEW = "flight-review-motor"
SAMPLES, LOCKED = 50, 0.9  # of the second rule; 1900 us as a share of 1000 to 2000 us


def findings(flight: Flight, vehicle: Vehicle | None = None) -> list[dict[str, Any]]:
    """Findings of all rules: detector, rotor, time_s, reason."""
    vehicle = vehicle or airframes.identify(flight)
    air = airborne(flight)
    found = [finding for module in detectors.modules() for finding in module.detect(flight, vehicle, air)]
    return sorted([*map(dict, found), *review(flight, vehicle)], key=lambda f: f["time_s"])


def review(flight: Flight, vehicle: Vehicle) -> list[dict[str, Any]]:
    """Flight Review's rule on the outputs between the first take-off and the last landing, the log's `armed` where it has it."""
    air = airborne(flight)
    if not flight.has("motors") or not air:
        return []
    motors = flight["motors"]
    low, high = vehicle.curve.u_min, vehicle.curve.u_max
    flown = (motors.time >= air[0][0]) & (motors.time <= air[-1][1])
    share = (motors.values[flown] - low) / (high - low)
    time, found = motors.time[flown], []
    for k in range(share.shape[1]):
        active = np.maximum.accumulate(share[:, k] > 0.0)
        zero = np.flatnonzero(active & (motors.values[flown][:, k] <= 0.0))
        at_top = share[:, k] >= LOCKED
        run = np.convolve(at_top, np.ones(SAMPLES), "valid") if len(at_top) >= SAMPLES else np.zeros(0)
        locked = np.flatnonzero(run >= SAMPLES)
        for rows, why in ((zero, "output 0"), (locked, f"{SAMPLES} samples at 1900 us or more")):
            if rows.size:
                found.append({"detector": REVIEW, "rotor": k + 1, "time_s": float(time[rows[0]]), "reason": why})
    return found
