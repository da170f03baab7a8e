"""Flights that never happened: closed loop, faults, sensors, and the logs an autopilot would have kept of them.

    from rotorwatch.simulation import scenario, simulate
    made = simulate(scenario.read("hexa-gusts.toml"))
    made.flight                      # as rotorwatch.read would return it: rotorwatch.diagnose(made.flight)
    made.record.theta                # the truth
    made.write("flight.bin")         # ArduPilot DataFlash; .ulg: PX4 ULog; and flight.truth.json, flight.truth.csv

A scenario whose frame is a helicopter gives a `helicopter.SimulatedHelicopter`, which writes .csv or .parquet.

See docs/simulation.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rotorwatch.errors import ConfigError
from rotorwatch.simulation import helicopter, logbook, loop
from rotorwatch.simulation.multirotor import MULTIROTOR, Plan, Record
from rotorwatch.simulation.prepare import plan
from rotorwatch.simulation.scenario import Scenario

__all__ = ["Plan", "Record", "Scenario", "Simulated", "plan", "simulate", "simulate_batch"]
SUFFIXES = {".bin": "ardupilot", ".ulg": "px4"}


@dataclass(frozen=True)
class Simulated:
    """One simulated flight: what was asked for, its numbers, and everything that happened."""

    scenario: Scenario
    plan: Plan
    record: Record

    @property
    def flight(self) -> Any:
        """The `Flight` that the autopilot's log would be read as; no truth in it."""
        return logbook.flight(self.scenario, self.plan, self.record)

    def write(self, path: str | os.PathLike, truth: str | os.PathLike | None = None) -> tuple[Path, ...]:
        """Write the log (.bin: ArduPilot DataFlash, .ulg: PX4 ULog) and the truth beside it, as TRUTH.truth.json and .csv (default:
        the log's name without its ending); returns the paths. Raises ConfigError when the autopilot writes another kind of log."""
        from rotorwatch.simulation.write_dataflash import write_dataflash
        from rotorwatch.simulation.write_ulog import write_ulog

        path = Path(path)
        if SUFFIXES.get(path.suffix.lower()) != self.scenario.autopilot:
            kind = next(k for k, v in SUFFIXES.items() if v == self.scenario.autopilot)
            raise ConfigError(f"{path.name}: a log of the autopilot {self.scenario.autopilot} is a {kind} file.")
        (write_ulog if self.scenario.autopilot == "px4" else write_dataflash)(self.flight, path)
        stem = path.with_suffix("") if truth is None else Path(truth)
        return (path, *logbook.write_truth(self.scenario, self.plan, self.record, stem))


def simulate(scenario: Scenario) -> Any:
    """Fly one scenario: a `Simulated`, or a `helicopter.SimulatedHelicopter`.

    scenario: what to fly (`simulation.scenario.Scenario`, docs/simulation.md). Raises ConfigError with one sentence for a vehicle that
    cannot fly.
    """
    if scenario.helicopter:
        return helicopter.simulate(scenario)
    numbers = plan(scenario)
    record = loop.fly_each(MULTIROTOR, [numbers], scenario.duration_s, scenario.rate_hz, scenario.record_hz)[0]
    return Simulated(scenario, numbers, record)


def simulate_batch(
    scenarios: Sequence[Scenario], select: Callable = loop.everything, record_hz: float | None = None
) -> Any:
    """Fly many scenarios of multirotors side by side: same number of rotors, duration, rate_hz and autopilot's profile; all else is free.

    Returns the records stacked (T, ..., B), flights last, as arrays of the device (a `Record`, or what `select` keeps of it);
    `one(records, k)` is the record of flight k. Chunks of 32 to 128 flights are fastest on a CPU. Raises ConfigError.
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
    return loop.fly_many(
        MULTIROTOR, loop.stack([plan(s) for s in scenarios]), first.duration_s, first.rate_hz, hz, select
    )


def one(records: Any, k: int) -> Any:
    """Flight k of a batch's records, as NumPy arrays."""
    import numpy as np

    from rotorwatch.backend import jax

    return jax().tree.map(lambda a: np.asarray(a[..., k]), records)
