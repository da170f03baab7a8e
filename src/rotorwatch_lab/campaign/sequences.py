"""Flights with several events: how well the state of all rotors is known between one change and the next.

Second faults, recoveries, changes of size, intermittent faults, pairs at once, both rotors of a coaxial arm; 10 to 50 % each, in winds to
6 m/s. Every stretch between two changes that lasts SETTLE_S is one state. It is read at its end from the events of the whole flight:

    right       exactly the weak rotors are named, without alternatives
    ambiguous   the weak rotors are one of the sets named
    missed      weak rotors are missing, and none is named that is not weak
    wrong       a healthy rotor is named as weak, without an alternative: wrong and sure
    other       a healthy rotor is named, among alternatives that do not hold the truth
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rotorwatch.base import files
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch.toolkit import ASSESS, Ticks
from rotorwatch_lab.campaign import batch
from rotorwatch_lab.campaign.plan import Cell, drawn
from rotorwatch_lab.campaign.summary import INDUCED_EDGES, by_speed
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.simulation import scenario
from rotorwatch_lab.simulation.prepare import induced_velocity
from rotorwatch_lab.simulation.scenario import Scenario

FRAMES = {"quad-x": 4, "hexa-x": 6, "octa-x": 8, "y6": 6, "octaquad-x": 8}
ARMS = {"y6": ((1, 5), (2, 3), (4, 6)), "octaquad-x": ((1, 6), (2, 5), (3, 8), (4, 7))}
KINDS = ("second", "second", "second", "recovery", "change", "intermittent", "equal pair", "pair", "arm")
SETTLE_S, WEAK = 5.0, 0.03
SCENARIO, _ = files.toml(Path(__file__).with_suffix(".toml"), "scenario")
MARGIN_S = 1.0  # an onset may be off by so much
WIDTH = 16  # flights side by side
OUTCOMES = ("right", "ambiguous", "missed", "wrong", "other")


class Sequences:
    """The flights, drawn from (seed, number): what `campaign.batch` needs of a plan."""

    def __init__(self, seed: int = 31):
        self.seed = seed
        self.cells = tuple(Cell(frame, "ardupilot", profile) for frame in FRAMES for profile in ("default", "fast"))

    def kind(self, k: int) -> str:
        """Kind of flight k."""
        return KINDS[(k // len(self.cells)) % len(KINDS)]

    def flight(self, k: int) -> Scenario:
        """The scenario of flight k."""
        rng = np.random.default_rng([self.seed, k])
        cell, kind = self.cells[k % len(self.cells)], self.kind(k)
        table = drawn(SCENARIO, rng)
        table["airframe"]["frame"], table["logging"] = cell.frame, {"profile": cell.profile}
        faults = _faults(kind, cell.frame, rng)
        return scenario.from_table({**table, "name": f"{kind} {k}", "seed": int(rng.integers(2**31 - 1)), "faults": faults})


def _faults(kind: str, frame: str, rng: np.random.Generator) -> list[dict[str, Any]]:
    rotors = [int(r) + 1 for r in rng.permutation(FRAMES[frame])[:2]]
    first, gap = float(rng.uniform(18.0, 24.0)), float(np.exp(rng.uniform(np.log(3.0), np.log(30.0))))
    a, b = (float(v) for v in rng.uniform(0.1, 0.5, 2))

    def loss(rotor: int, onset: float, strength: float, **more) -> dict[str, Any]:
        return {"kind": "loss", "rotor": rotor, "onset_s": onset, "strength": strength, **more}

    if kind == "arm":
        if frame not in ARMS:
            kind = "pair"
        else:
            rotors = list(rng.permutation(ARMS[frame][int(rng.integers(len(ARMS[frame])))]).astype(int).tolist())
            gap *= float(rng.random() < 0.5)
            return [loss(rotors[0], first, a), loss(rotors[1], first + gap, b)]
    if kind == "second":
        return [loss(rotors[0], first, a), loss(rotors[1], first + gap, b)]
    if kind == "recovery":
        return [loss(rotors[0], first, a, end_s=first + max(gap, 6.0))]
    if kind == "change":  # up: two losses of one rotor multiply; down: one of them ends
        if rng.random() < 0.5:
            return [loss(rotors[0], first, a), loss(rotors[0], first + max(gap, 6.0), b)]
        return [loss(rotors[0], first, a), loss(rotors[0], first, b, end_s=first + max(gap, 6.0))]
    if kind == "intermittent":
        return [loss(rotors[0], first, a, period_s=float(rng.uniform(12.0, 24.0)), duty=0.5)]
    return [loss(rotors[0], first, a), loss(rotors[1], first, a if kind == "equal pair" else b)]


@dataclass(frozen=True)
class State:
    """An interval between changes: its end `at` [s], the weak rotors (1-based), the sets named then (the first is the answer), and the
    outcome."""

    at: float
    truth: tuple[int, ...]
    named: tuple[tuple[int, ...], ...]
    outcome: str


def named_at(events: Iterable[Event], at: float) -> tuple[tuple[int, ...], ...]:
    """The sets of rotors that may be weak at a time, the answer first, from events: one of each event's explanations holds."""
    here = [e for e in events if e.onset_s <= at and (e.end_s is None or e.end_s > at)]
    sets = [((tuple(e.rotors)), *e.alternatives) for e in here]
    merged = dict.fromkeys(tuple(sorted(set(itertools.chain(*one)))) for one in itertools.product(*sets))
    return tuple(merged)


def outcome(truth: Sequence[int], named: Sequence[Sequence[int]]) -> str:
    """Outcome of an answer, one of OUTCOMES."""
    want, sets = set(truth), [set(s) for s in named]
    if len(sets) == 1 and sets[0] == want:
        return "right"
    if any(s == want for s in sets):
        return "ambiguous"
    if all(s <= want for s in sets):
        return "missed"
    return "wrong" if len(sets) == 1 else "other"


class Truth(Protocol):
    """A flight with known truth: its ticks, true losses theta (T, n) at them, and the time of its crash, or None."""

    @property
    def ticks(self) -> Ticks: ...
    @property
    def theta(self) -> np.ndarray: ...
    @property
    def lost_s(self) -> float | None: ...


def states(f: Truth, events: Sequence[Event]) -> list[State]:
    """All states of a flight, up to its crash."""
    time, assessing = f.ticks.time, f.ticks.mode == ASSESS
    weak = f.theta > WEAK
    steps = (weak[1:] != weak[:-1]) | (np.abs(np.diff(f.theta, axis=0)) > 0.02)
    edges = [0, *(np.flatnonzero(steps.any(axis=1)) + 1), len(time)]
    answers = []
    for a, b in itertools.pairwise(edges):
        here = np.flatnonzero(assessing[a:b] & ~f.ticks.upset[a:b]) + a
        if f.lost_s is not None:
            here = here[time[here] < f.lost_s - 1.0]
        if len(here) * f.ticks.dt < SETTLE_S:
            continue
        at = float(time[here[-1]]) - MARGIN_S
        truth = tuple(int(i) + 1 for i in np.flatnonzero(weak[here[-1]]))
        named = named_at(events, at)
        answers.append(State(at, truth, named, outcome(truth, named)))
    return answers


def run(
    flights: int = 300,
    seed: int = 31,
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """Fly, assess and score: {"flights", "seed", "table": rows with all states, by kind and by frame, "states": all of them}.

    jobs, scheduler: as for `many.run`. progress: called as progress(share, text). keep: a folder for what is finished, from
    which the same call goes on. Raises ConfigError.
    """
    if flights < 1:
        raise ConfigError(f"flights must be at least 1, not {flights}.")
    parts = [(seed, numbers) for numbers in tools.batches(flights, len(Sequences(seed).cells), WIDTH)]
    rows = tools.gathered(_part, parts, jobs, progress, "flying", scheduler, keep)
    rows.sort(key=lambda row: (row["flight"], row["at"]))
    return {"flights": flights, "seed": seed, "table": table(rows), "states": rows}


def _part(work: tuple[int, range]) -> list[dict[str, Any]]:
    seed, numbers = work
    plan = Sequences(seed)
    return assessed(plan, batch.fly(plan, numbers, WIDTH))


def describe(result: Mapping[str, Any]) -> str:
    """The table, as text."""
    lines = [f"{result['flights']} flights, seed {result['seed']}: the answer about all rotors between one change and the next", ""]
    lines.append(f"{'':24}{'states':>8}" + "".join(f"{name:>22}" for name in OUTCOMES))
    for row in result["table"]:
        cells = (f"{100 * v['value']:.1f} % ({100 * v['low']:.0f}-{100 * v['high']:.0f})" for v in map(row.get, OUTCOMES))
        lines.append(f"{row['by'] + ' ' + row['name']:24}{row['states']:>8}" + "".join(f"{cell:>22}" for cell in cells))
    return "\n".join(lines)


def assessed(plan: Sequences, flown: Sequence[batch.Flown]) -> list[dict[str, Any]]:
    """A row for every state of these flights, all of one cell."""
    if not flown:
        return []
    rows = []
    for f, estimated in zip(flown, batch.by_default(flown)):
        end = f.ready.by(estimated).answer().end
        accusing = [e for e in end.events if e.means.weakens]
        induced = induced_velocity(f.scenario)
        for s in states(f, accusing):
            rows.append(
                {"flight": f.number, "kind": plan.kind(f.number), "frame": f.scenario.airframe["frame"], "at": s.at,
                 "induced_m_s": induced, "truth": s.truth, "named": s.named, "outcome": s.outcome}
            )  # fmt: skip
    return rows


def table(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Shares of outcomes, with Wilson's intervals: all states, by kind, by frame, by velocity of the air through the rotors in hover."""
    lines = []
    groups = [("all", "", rows)]
    groups += [("kind", k, [r for r in rows if r["kind"] == k]) for k in dict.fromkeys(KINDS)]
    groups += [("frame", f, [r for r in rows if r["frame"] == f]) for f in FRAMES]
    speeds = by_speed(np.array([r["induced_m_s"] for r in rows]), INDUCED_EDGES)
    groups += [("induced", s, [r for r, here in zip(rows, speeds) if here == s]) for s in sorted(set(speeds))]
    for by, name, part in groups:
        if part:
            shares = {o: tools.share([r["outcome"] == o for r in part]) for o in OUTCOMES}
            lines.append({"by": by, "name": name, "states": len(part), **shares})
    return lines
