"""What `diagnose` says of flights whose truth is known, with every comparison of a claim: the data that odds are fitted to (odds_fit.py)
and their reliability is read from (reliability.py).

Flights come from a plan that is assessed by logs (open_world.py), from logs of healthy flights, with losses put into them or not, and from
logs with a table of truth: a CSV file with the columns path (beside the file), rotors (1+2; empty: healthy), kind, and onset_s and end_s of
each (a number, or numbers with ; between them; no end: it lasts)."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.toolkit import Conclusion, airborne, diagnose, odds, prepare
from rotorwatch_lab.campaign import batch, open_score
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.experiments import inject, tools
from rotorwatch_lab.simulation.scenario import Scenario

HARMLESS = ("strong", "tilt")  # faults that cost no thrust


class Fault(NamedTuple):
    """rotor: from 1. kind: as in scenarios or tables of truth. grown_s: when it has its whole size; end_s: inf while it lasts."""

    rotor: int
    kind: str
    onset_s: float
    grown_s: float
    end_s: float = np.inf


class Flown(NamedTuple):
    """A flight and its answer. source: "plan", or the log's or table's name; group, kind: of open_world; outcome: of open_score, empty for
    logs."""

    source: str
    name: str
    group: str
    kind: str
    rotors: int
    faults: tuple[Fault, ...]
    verdict: str
    outcome: str
    events: tuple[Event, ...]
    compared: tuple[odds.Comparison, ...]

    @property
    def broken(self) -> set[int]:
        """The rotors that cost thrust, or follow late, at any time."""
        return {f.rotor for f in self.faults if f.kind not in HARMLESS}


def collect(
    plan: Plan | None = None,
    flights: int = 0,
    seed: int | None = None,
    healthy: Sequence[str | PathLike] = (),
    losses: Sequence[float] = (),
    truths: Sequence[str | PathLike] = (),
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> list[Flown]:
    """The flights 0..flights-1 of the plan with another seed (None: its own); logs of healthy flights, as they are and with each of
    `losses` put into every rotor once; and the logs of tables of truth. jobs, progress, scheduler, keep: as of `tools.gathered`. Raises
    ConfigError, LogError."""
    if plan is not None and plan.assess != "log":
        raise ConfigError(f"The plan {plan.name} is not assessed by logs; set assess = 'log' (docs/campaigns.md#plans).")
    parts: list[tuple] = []
    if plan is not None and flights:
        chosen = plan if seed is None else replace(plan, seed=seed)
        width = batch.width() if load_jax().default_backend() != "cpu" else batch.CPU_WIDTH
        parts += [(_of_plan, chosen, numbers, width) for numbers in tools.batches(flights, len(plan.cells), width)]
    parts += [(_of_healthy, str(path), tuple(losses), k) for k, path in enumerate(healthy)]
    parts += [(_of_truth, *row) for path in truths for row in _truth(path)]
    if not parts:
        raise ConfigError("There is no flight: give a plan, or logs.")
    return tools.gathered(_part, parts, jobs, progress, "diagnosing", scheduler, keep)


def _part(part: tuple) -> list[Flown]:
    make, *given = part
    return make(*given)


def _of_plan(plan: Plan, numbers: Sequence[int], size: int) -> Iterable[Flown]:
    found = []
    for k, scenario, drawn, record in batch.simulated(plan, numbers, size):
        kind = plan.kind(k)
        try:
            flight = batch.logged(k, scenario, drawn, record)
            found.append(_flown("plan", flight, faults(scenario), kind.name if kind else "", scenario))
        except RotorwatchError:
            continue  # a log that is refused claims nothing
    return found


def faults(scenario: Scenario) -> tuple[Fault, ...]:
    """The faults of a scenario."""
    return tuple(
        Fault(f["rotor"], f["kind"], f["onset_s"], f["onset_s"] + (f["ramp_s"] or 0.0), np.inf if f["end_s"] is None else f["end_s"])
        for f in scenario.faults
    )


def _of_healthy(path: str, losses: Sequence[float], seed: int) -> list[Flown]:
    """A healthy log, and the same with losses."""
    flight = logs.read(path)
    found = [_flown("healthy logs", flight, (), "healthy")]
    vehicle, air, rng = airframes.identify(flight), airborne(flight), np.random.default_rng(seed)
    room = [(a + inject.ready_s(vehicle) + inject.AFTER_READY_S, b - inject.BEFORE_END_S) for a, b in air]
    room = [(a, b) for a, b in room if b > a]
    for rotor in range(1, len(vehicle.rotors) + 1) if room else ():
        for loss in losses:
            onset = inject.draw(room, rng)
            faulty = inject.inject(flight, vehicle, rotor, loss, onset)
            found.append(_flown("injected", faulty, (Fault(rotor, "loss", onset, onset),), "injected"))
    return found


def _of_truth(name: str, path: str, broken: tuple[Fault, ...], kind: str) -> list[Flown]:
    return [_flown(name, logs.read(path), broken, kind)]


def _truth(path: str | PathLike) -> list[tuple[str, str, tuple[Fault, ...], str]]:
    """(name of the table's folder, log, faults, kind) of each row of a table of truth. Raises ConfigError."""
    place = Path(path)
    try:
        with open(place, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        return [(place.parent.name, str(place.parent / r["path"]), _faults(r), r["kind"]) for r in rows]
    except OSError as why:
        raise ConfigError(f"The table of truth {place} cannot be read: {why.strerror}.") from why
    except (KeyError, ValueError, TypeError) as why:
        raise ConfigError(f"The table of truth {place} lacks a column, or has no number where one must be: {why}.") from why


def _faults(row: dict[str, str]) -> tuple[Fault, ...]:
    rotors = [int(x) for x in row["rotors"].split("+") if x]
    begins, ends = ([float(x) for x in row[key].split(";") if x] for key in ("onset_s", "end_s"))
    grown = np.inf if row["kind"] == "ramp" else 0.0
    return tuple(
        Fault(
            r, row["kind"], onset := (begins[min(k, len(begins) - 1)] if begins else 0.0), max(onset, grown), ends[-1] if ends else np.inf
        )
        for k, r in enumerate(rotors)
    )


def _flown(source: str, flight: Flight, broken: tuple[Fault, ...], kind: str, scenario: Scenario | None = None) -> Flown:
    answer, found, n = _answer(flight)
    outcome = "" if scenario is None else open_score.assessed(scenario, answer)["outcome"]
    group = open_score.group(scenario) if scenario else "loss" if broken else "healthy"
    return Flown(source, flight.name, group, kind, n, broken, answer.verdict, outcome, tuple(answer.events), found)


def _answer(flight: Flight) -> tuple[Diagnosis | Conclusion, tuple[odds.Comparison, ...], int]:
    """(the answer, its comparisons without losses, number of rotors), as `diagnose` gives them."""
    ready = prepare(flight)
    n = len(ready.vehicle.rotors)
    if ready.table is None:
        return diagnose(flight), (), n
    last = ready.answer()
    return last.end, tuple(odds.read(c.to_dict(), n) for c in last.facts.get("compared", ())), n
