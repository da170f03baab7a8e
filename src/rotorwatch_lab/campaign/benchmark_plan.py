"""A benchmark's plan: a campaign's plan with a table [benchmark], which sets the number of flights and the false-alarm rate at which
methods are compared.

    [benchmark]
    version = 1                # another number when anything in the plan changes
    flights = 64
    false_alarms_h = 6.0       # each method's threshold is set to leave so many in an hour of healthy flight
    within_s = 5.0             # a fault found later counts as missed

Those that come with rotorwatch lie in benchmark_plans/.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

from rotorwatch.base import files
from rotorwatch.base.choices import meant
from rotorwatch.base.optional import tomllib
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import plan as plans
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.campaign.score import RISE_S
from rotorwatch_lab.simulation.scenario import number, plain, whole

SHIPPED = Path(__file__).parent / "benchmark_plans"
TABLE = ("version", "flights", "false_alarms_h", "within_s")


class Benchmark(NamedTuple):
    """A checked plan. flights: how many; false_alarms_h, within_s: detections count within so many seconds, at the threshold that leaves so
    many false alarms in an hour. text: the file's."""

    plan: Plan
    version: int
    flights: int
    false_alarms_h: float
    within_s: float
    text: str

    @property
    def sha256(self) -> str:
        """By which results know their plan."""
        return digest(self.text)


def digest(text: str) -> str:
    """SHA-256 of a text, whatever its line ends are."""
    return hashlib.sha256(text.replace("\r\n", "\n").encode()).hexdigest()


def shipped() -> dict[str, Path]:
    """Name -> file of the plans that come with rotorwatch."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def read(plan: str | os.PathLike) -> Benchmark:
    """A plan that comes with rotorwatch, by name, or one in a TOML file. Raises ConfigError with one sentence that names the field."""
    known = shipped()
    if os.fspath(plan) not in known and not Path(plan).exists():
        raise ConfigError(f"There is no benchmark {plan}{meant(plan, known)}: give {' or '.join(known)}, or the file of a plan.")
    path = known.get(os.fspath(plan), Path(plan))
    _, text = files.toml(path, "benchmark's plan", plans.MAX_BYTES)
    try:
        return parsed(text, path.stem)
    except ConfigError as why:
        raise ConfigError(f"Plan {path}: {why}") from why


def parsed(text: str, name: str = "") -> Benchmark:
    """The benchmark of a plan's text. Raises ConfigError."""
    table = {"name": name, **tomllib.loads(text)}
    goals = table.pop("benchmark", None)
    if not isinstance(goals, dict):
        raise ConfigError("it has no table [benchmark] with version, flights, false_alarms_h and within_s.")
    for key in (*TABLE, *goals):
        if key not in goals or key not in TABLE:
            fault = "missing" if key in TABLE else "not a field"
            raise ConfigError(f"benchmark.{plain(key)} is {fault}; the fields are {', '.join(TABLE)}.")
    version = whole("benchmark.version", goals["version"], 1, 1_000_000)
    flights = whole("benchmark.flights", goals["flights"], 1, 10_000_000)
    rate = number("benchmark.false_alarms_h", goals["false_alarms_h"], 0.0, 1e4)
    if goals["within_s"] not in RISE_S:
        raise ConfigError(f"benchmark.within_s must be one of {', '.join(f'{s:g}' for s in RISE_S)}.")
    return Benchmark(plans.from_table(table, text), version, flights, rate, float(goals["within_s"]), text)
