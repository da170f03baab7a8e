"""Simulated flights: closed loop, faults, sensors, and the logs that an autopilot would have written.

    from rotorwatch_lab.simulation import scenario, simulate
    made = simulate(scenario.read("hexa-gusts.toml"))
    made.flight                      # as rotorwatch.read would return it: rotorwatch.diagnose(made.flight)
    made.record.theta                # the truth
    made.write("flight.bin")         # ArduPilot DataFlash; .ulg: PX4 ULog; and flight.truth.json, flight.truth.csv

A scenario whose frame is a helicopter writes .csv or .parquet.

See docs/simulation.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rotorwatch.errors import ConfigError
from rotorwatch_lab.simulation import helicopter, logbook, loop
from rotorwatch_lab.simulation.logbook import SUFFIXES
from rotorwatch_lab.simulation.multirotor import MULTIROTOR, Plan, Record
from rotorwatch_lab.simulation.prepare import beyond, plan
from rotorwatch_lab.simulation.scenario import Scenario

__all__ = ["SUFFIXES", "Plan", "Record", "Scenario", "Simulated", "plan", "simulate", "simulate_batch"]


@dataclass(frozen=True)
class Simulated:
    """A simulated flight: its scenario, its numbers, and the record of everything."""

    scenario: Scenario
    plan: Any
    record: Any

    @property
    def flight(self) -> Any:
        """The `Flight` that the log would be read as; no truth in it."""
        return self._book.flight(self.scenario, self.plan, self.record)

    @property
    def _book(self) -> Any:
        return helicopter.table if self.scenario.helicopter else logbook

    def write(self, path: str | os.PathLike, truth: str | os.PathLike | None = None) -> tuple[Path, ...]:
        """Write the log (.bin: ArduPilot DataFlash, .ulg: PX4 ULog; a helicopter's .csv or .parquet) and the truth beside it, as
        TRUTH.truth.json and .csv (default: the log's name without its ending); returns the paths. Raises ConfigError when the vehicle
        writes another kind of log."""
        path = Path(path)
        self._book.write(self.scenario, self.plan, self.record, path)
        stem = path.with_suffix("") if truth is None else Path(truth)
        return (path, *self._book.write_truth(self.scenario, self.plan, self.record, stem))


def simulate(scenario: Scenario) -> Simulated:
    """Fly one scenario.

    scenario: what to fly (`simulation.scenario.Scenario`, docs/simulation.md). Raises ConfigError with one sentence for a vehicle that
    cannot fly.
    """
    rates = scenario.duration_s, scenario.rate_hz, scenario.record_hz
    if scenario.helicopter:
        numbers, craft = helicopter.plan(scenario), helicopter.HelicopterAircraft(scenario.airframe["frame"])
        return Simulated(scenario, numbers, loop.fly(craft, numbers, *rates))
    numbers = plan(scenario)
    return Simulated(scenario, numbers, next(loop.fly_each(MULTIROTOR, [numbers], *rates)))


def simulate_batch(scenarios: Sequence[Scenario], select: Callable = loop.everything, record_hz: float | None = None) -> Any:
    """Fly many scenarios of multirotors side by side: same number of rotors, duration, rate_hz and autopilot's profile; all else is free.

    Returns the records stacked (T, ..., B), flights last, as arrays of the device (a `Record`, or what `select` keeps of it);
    `record_of(records, k)` is the record of flight k. Chunks of 32 to 128 flights are fastest on a CPU. Raises ConfigError.
    """
    if not scenarios:
        raise ConfigError("a batch needs at least one scenario.")
    first = scenarios[0]
    hz = first.record_hz if record_hz is None else record_hz
    for s in scenarios[1:]:
        if (s.duration_s, s.rate_hz) != (first.duration_s, first.rate_hz):
            raise ConfigError("flights of one batch must have the same duration_s and rate_hz.")
        if record_hz is None and s.record_hz != hz:
            raise ConfigError("flights of one batch must be recorded alike: the same autopilot and logging.profile.")
    more = any(beyond(s) for s in scenarios)
    return loop.fly_many(MULTIROTOR, loop.stack([plan(s, more) for s in scenarios]), first.duration_s, first.rate_hz, hz, select)


def record_of(records: Any, k: int) -> Any:
    """Flight k of a batch's records, as NumPy arrays."""
    import numpy as np

    from rotorwatch.base.backend import jax

    return jax().tree.map(lambda a: np.asarray(a[..., k]), records)
