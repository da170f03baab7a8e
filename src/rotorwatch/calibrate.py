"""Calibration of a vehicle description from healthy flights of its build."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from rotorwatch.diagnose import diagnose
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.healthy import baselines
from rotorwatch.witnesses.healthy.baselines import Given
from rotorwatch.witnesses.healthy.learned import learned


def calibrate(
    flights: Given | Iterable[Given], progress: Callable | None = None, dynamics: Callable | None = None, vehicle: Vehicle | None = None
) -> Vehicle:
    """The flights' airframe with what was learned from them in ``identified``:

    flights, airborne_s, steady_s   amount of data
    hover                           mean share of full thrust of a rotor in steady hover
    thrust_offset (n)               extra thrust (+) of each rotor relative to that mean: trim of this build
    whole_flight                    a table for each flight: whole_flight.Features.from_dict reads them
    dynamics                        motion gains and noise (engine/bindings/learning.py), when the flights show enough

    flights: healthy flights of one build, or their log files; others are rejected, as `assumptions` state (`baselines.healthy`). progress:
    called with the finished share. dynamics: called as dynamics(list of ticks.Ticks, B) -> mapping of floats and lists, in place of learn.
    vehicle: the airframe, for logs that do not name theirs. Raises ConfigError without a flight, VehicleError when no healthy flight of one
    build is left, LogError for an unreadable file."""
    kept, rejected = baselines.healthy(flights, diagnose, vehicle, progress=(lambda share: progress(0.9 * share)) if progress else None)
    calibrated = learned(kept, dynamics)
    if progress:
        progress(1.0)
    return replace(calibrated, assumptions=(*calibrated.assumptions, *rejected))
