"""The helicopter in closed loop: `simulate` of a scenario whose frame is a helicopter's ends here. See docs/simulation.md."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.simulation import loop
from rotorwatch.simulation.helicopter import table
from rotorwatch.simulation.helicopter.aircraft import HelicopterAircraft, Plan, Record, plan
from rotorwatch.simulation.scenario import Scenario

__all__ = ["Plan", "Record", "SimulatedHelicopter", "plan", "simulate"]


@dataclass(frozen=True)
class SimulatedHelicopter:
    """One simulated flight of a helicopter: what was asked for, its numbers, and everything that happened."""

    scenario: Scenario
    plan: Plan
    record: Record

    @property
    def flight(self) -> Flight:
        """The `Flight` that the written table would be read as; no truth in it."""
        return table.flight(self.scenario, self.plan, self.record)

    def write(self, path: str | os.PathLike, truth: str | os.PathLike | None = None) -> tuple[Path, ...]:
        """Write the table (.csv or .parquet) and the truth beside it, as TRUTH.truth.json and .csv (default: the table's name without
        its ending); returns the paths. Raises ConfigError for other endings."""
        path = Path(path)
        table.write(self.scenario, self.plan, self.record, path)
        stem = path.with_suffix("") if truth is None else Path(truth)
        return (path, *table.write_truth(self.scenario, self.plan, self.record, stem))


def simulate(scenario: Scenario) -> SimulatedHelicopter:
    """Fly one scenario of a helicopter. Raises ConfigError with one sentence."""
    if not scenario.helicopter:
        raise ConfigError(f"airframe.frame: {scenario.airframe['frame']} is no helicopter.")
    numbers, craft = plan(scenario), HelicopterAircraft(scenario.airframe["frame"])
    record = loop.fly(craft, numbers, scenario.duration_s, scenario.rate_hz, scenario.record_hz)
    return SimulatedHelicopter(scenario, numbers, record)
