"""Public data sets of real flights, by path: an index lists the healthy logs, and the faulty rotor and onset of the others.

An index is a TOML file. The first entry whose pattern fits a file's path below the data set's folder decides; files that no entry fits
are no part of it:

    about = "one sentence: what it is and where to get it"
    [[logs]]
    path = "motor_data/normal_flight/*"          # as in shells: * any name, ** any folders
    healthy = true
    [[logs]]
    path = "**/cut_M2_*/*"
    rotors = [2]                                 # 1-based, as the autopilot counts
    onset_s = 0.0                                # from the log's first record
    loss = 0.2                                   # left out where nobody knows

Indices that come with rotorwatch lie in datasets/; a file rotorwatch-index.toml in the data set's folder goes before them. Formats are
those of `rotorwatch.read`. The rows are those of simulated flights (score.py); what a real flight has no value for is empty.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from rotorwatch import logs
from rotorwatch.base import files
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.toolkit import LAG_S, prepare
from rotorwatch_lab.campaign import batch
from rotorwatch_lab.campaign.batch import Flown
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.simulation.scenario import Scenario, brief, number, only_fields, whole

SHIPPED, OWN = Path(__file__).parent / "datasets", "rotorwatch-index.toml"
FIELDS = ("path", "healthy", "rotors", "onset_s", "loss")
NOT_ASSESSED = {
    "alfa": "ALFA's flights are of a fixed-wing aircraft, whose control surfaces fail; rotorwatch assesses multirotors.",
    "uav-sead": "UAV-SEAD's labels name kinds of anomalies and no rotor: write an index of the flights whose rotor you know.",
}


@dataclass(frozen=True)
class Entry:
    """An entry [[logs]] of an index. rotors: none for healthy flights; onset_s; loss: None where unknown."""

    path: str
    rotors: tuple[int, ...] = ()
    onset_s: float = 0.0
    loss: float | None = None

    def fits(self, path: str) -> bool:
        """True if a path below the data set's folder (with /) matches the pattern, with or without .xz or .gz."""
        bare = path.removesuffix(".xz").removesuffix(".gz")
        return any(re.fullmatch(_expression(self.path), text) for text in (path, bare))


@dataclass(frozen=True)
class DataSet:
    """A data set on this computer. text: its index; logs: (path, entry) of the files that the index knows."""

    name: str
    folder: Path
    text: str
    logs: tuple[tuple[Path, Entry], ...]


def shipped() -> dict[str, Path]:
    """Name -> index of the data sets that rotorwatch knows."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def read(name: str, path: str | os.PathLike) -> DataSet:
    """The data set of that name in that folder. Raises ConfigError, one sentence: no folder, no index, or none of its logs there."""
    files.no_address(path)
    folder, key = Path(path), name.lower()
    if not folder.is_dir():
        raise ConfigError(f"--data {name}={path}: there is no such folder.")
    own_index = folder / OWN
    if not own_index.is_file() and key not in shipped():
        known = NOT_ASSESSED.get(key, f"rotorwatch knows {', '.join(shipped())}; for others put an index, {OWN}, into the folder.")
        raise ConfigError(f"--data {name}={path}: {known} docs/benchmark.md says how.")
    index = own_index if own_index.is_file() else shipped()[key]
    table, text = files.toml(index, "index")
    entries = _entries(table, index)
    matched = []
    for file in sorted(p for p in folder.rglob("*") if p.is_file() and p != own_index):
        inside = file.relative_to(folder).as_posix()
        entry = next((e for e in entries if e.fits(inside)), None)
        if entry is not None:
            matched.append((file, entry))
    if not matched:
        raise ConfigError(f"--data {name}={path}: no file in it fits a pattern of {index}.")
    return DataSet(name, folder, text, tuple(matched))


def assess(data: DataSet, plan: Plan, failed: Callable[[str, Exception], None] | None = None) -> tuple[list[dict], list[list[str]]]:
    """(rows as of simulated flights, [[log, why]] of those left out). Flights of one geometry and length of a tick go side by side."""
    groups: dict[tuple, list[Flown]] = {}
    left_out = []
    for k, (path, entry) in enumerate(data.logs):
        try:
            flown = _flown(k, path, entry)
        except RotorwatchError as why:
            left_out.append([path.relative_to(data.folder).as_posix(), str(why).replace(str(path), path.name)])
            continue
        B = flown.vehicle.effectiveness()
        groups.setdefault((B.shape, B.tobytes(), flown.ticks.dt), []).append(flown)
    rows = []
    for flights in groups.values():
        size = 1 << (len(flights) - 1).bit_length()
        try:
            rows += batch.rows(plan, flights, size, failed)
        except RotorwatchError as why:  # concerns these flights, whatever the method: commands too slow to learn from, say
            left_out += [[data.logs[f.number][0].relative_to(data.folder).as_posix(), str(why)] for f in flights]
    return rows, sorted(left_out)


def _flown(number: int, path: Path, entry: Entry) -> Flown:
    """A log, prepared as by `diagnose`. Raises RotorwatchError where it cannot be diagnosed."""
    ready = prepare(logs.read(path))
    n, table = len(ready.vehicle.rotors), ready.table
    if entry.rotors and max(entry.rotors) > n:
        raise ConfigError(f"the index names rotor {max(entry.rotors)} of a vehicle with {n}.")
    if table is None:
        raise ConfigError("it holds no flight that can be assessed.")
    theta = np.zeros((len(table.time), n))
    after = table.command_time + LAG_S >= entry.onset_s
    for rotor in entry.rotors:
        theta[after, rotor - 1] = np.nan if entry.loss is None else entry.loss
    return Flown(number, _scenario(ready.flight, entry), ready, theta)


def _scenario(flight: Flight, entry: Entry) -> Scenario:
    """The part of a scenario that score.py needs, as far as a log has it."""
    lasting = {"ramp_s": 0.0, "period_s": None, "end_s": None}
    fault = {"kind": "loss", "onset_s": entry.onset_s, "strength": entry.loss, **lasting}
    scenario = SimpleNamespace(
        airframe={"frame": "log"}, autopilot=flight.autopilot, logging={"profile": "log"}, trajectory={"kind": "log"},
        wind={"speed_m_s": None}, faults=tuple({**fault, "rotor": rotor} for rotor in entry.rotors),
    )  # fmt: skip
    return cast(Scenario, scenario)


def _entries(table: Mapping[str, Any], index: Path) -> tuple[Entry, ...]:
    rows = table.get("logs")
    if not isinstance(rows, Sequence) or not rows or not all(isinstance(row, Mapping) for row in rows):
        raise ConfigError(f"The index {index} has no [[logs]] tables.")
    return tuple(_entry(row, f"The index {index}: logs[{k + 1}]") for k, row in enumerate(rows))


def _entry(row: Mapping[str, Any], where: str) -> Entry:
    only_fields(row, FIELDS, f"{where}.")
    path, healthy, rotors = row.get("path"), row.get("healthy", False), row.get("rotors", [])
    if not isinstance(path, str) or not path:
        raise ConfigError(f"{where}.path must be a pattern, not {brief(path)}.")
    if not isinstance(rotors, list) or not isinstance(healthy, bool) or healthy == bool(rotors):
        raise ConfigError(f"{where} must have either healthy = true or rotors = [..].")
    if healthy:
        return Entry(path)
    if "onset_s" not in row:
        raise ConfigError(f"{where}.onset_s is missing; give 0.0 where the rotor was weak from take-off.")
    numbers = tuple(whole(f"{where}.rotors", r, 1, 32) for r in rotors)
    loss = number(f"{where}.loss", row["loss"], 0.0, 1.0) if "loss" in row else None
    return Entry(path, numbers, number(f"{where}.onset_s", row["onset_s"], 0.0, 1e6), loss)


def _expression(pattern: str) -> str:
    """A pattern as a regular expression: ** any folders, * and ? within a name."""
    parts = re.split(r"(\*\*/|\*\*|\*|\?)", pattern)
    known = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    return "".join(known.get(part, re.escape(part)) for part in parts)
