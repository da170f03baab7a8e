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
SAMPLES, PULSE_US, FULL_US = 50, 1900.0, 2000.0  # of the second rule; full thrust of usual pulses
LOCKED = 0.9  # the same as a share of the range, for other outputs
LANDS_S = 1.0


def findings(flight: Flight, vehicle: Vehicle | None = None) -> list[dict[str, Any]]:
    """Findings of all rules: detector, rotor, time_s, reason."""
    vehicle = vehicle or airframes.identify(flight)
    air = airborne(flight)
    found = [finding for module in detectors.modules() for finding in module.detect(flight, vehicle, air)]
    return sorted([*map(dict, found), *review(flight, vehicle)], key=lambda f: f["time_s"])


def review(flight: Flight, vehicle: Vehicle) -> list[dict[str, Any]]:
    """Flight Review's rule on the outputs in the air, until LANDS_S before each landing: not every log says when the vehicle was armed."""
    if not flight.has("motors"):
        return []
    motors, curve = flight["motors"], vehicle.curve
    flown = np.any([(motors.time >= a) & (motors.time <= b - LANDS_S) for a, b in airborne(flight)] or [motors.time < 0.0], axis=0)
    if not flown.any():
        return []
    time, values, valid = motors.time[flown], motors.values[flown], motors.valid[flown]
    top = PULSE_US if curve.u_max > FULL_US / 2.0 else curve.u_min + LOCKED * (curve.u_max - curve.u_min)
    found = []
    for k in range(values.shape[1]):
        active = np.maximum.accumulate(valid[:, k] & (values[:, k] > 0.0))
        zero = np.flatnonzero(active & valid[:, k] & (values[:, k] <= 0.0))
        locked = np.flatnonzero(np.convolve(valid[:, k] & (values[:, k] >= top), np.ones(SAMPLES))[: len(time)] >= SAMPLES)
        for rows, why in ((zero, "output 0"), (locked, f"{SAMPLES} samples at 1900 us or more")):
            if rows.size:
                found.append({"detector": REVIEW, "rotor": k + 1, "time_s": float(time[rows[0]]), "reason": why})
    return found
