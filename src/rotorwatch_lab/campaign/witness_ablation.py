"""Ablation of the witnesses: every flight of a plan judged by its log with each witness left out, and counted as `open_world` does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from typing import Any

from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.toolkit import prepare, witness
from rotorwatch_lab.campaign import batch, open_score
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.experiments import tools

ALL = "all witnesses"
COUNTS: dict[str, Callable[[str, str], bool]] = {
    "healthy rotor accused": lambda group, outcome: outcome in open_score.FALSE,
    "healthy vehicle ambiguous": lambda group, outcome: group == "healthy" and outcome == "doubt",
    "fault right": lambda group, outcome: outcome == "right",
    "fault ambiguous": lambda group, outcome: group != "healthy" and outcome in open_score.DOUBTS,
}


def run(
    plan: Plan,
    flights: int,
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """{"flights", "names": witness -> {count: number, "changed": flights with another outcome}}; jobs, progress, scheduler, keep: as of
    `tools.gathered`. Raises ConfigError."""
    if plan.judge != "log":
        raise ConfigError(f"The plan {plan.name} is not judged by logs; set judge = 'log' (docs/campaigns.md#plans).")
    parts = [(plan, numbers) for numbers in tools.batches(flights, len(plan.cells), batch.CPU_WIDTH)]
    rows = tools.gathered(_part, parts, jobs, progress, "judging", scheduler, keep)
    names = [ALL, *(w.name for w in witness.registered())]
    return {"flights": len(rows), "names": {name: _counted(rows, name) for name in dict.fromkeys(names)}}


def _counted(rows: Sequence[tuple[str, Mapping[str, str]]], name: str) -> dict[str, int]:
    found = {count: sum(of(group, said[name]) for group, said in rows) for count, of in COUNTS.items()}
    return found | {"changed": sum(said[name] != said[ALL] for _, said in rows)}


def _part(part: tuple[Plan, Sequence[int]]) -> Iterable[tuple[str, dict[str, str]]]:
    """(group, witness that is left out -> outcome) of each flight."""
    plan, numbers = part
    found = []
    for k, scenario, drawn, record in batch.simulated(plan, numbers, batch.CPU_WIDTH):
        try:
            ready = prepare(batch.logged(k, scenario, drawn, record))
        except RotorwatchError:
            continue
        if ready.table is None:
            continue
        said = {ALL: open_score.judged(scenario, ready.answer().end)["outcome"]}
        for one in witness.registered():
            with witness.without(one.name):
                said[one.name] = open_score.judged(scenario, ready.answer().end)["outcome"]
        found.append((open_score.group(scenario), said))
    return found


def markdown(result: Mapping[str, Any]) -> str:
    """A table of the witnesses that change an outcome, and a sentence with the others."""
    base = result["names"][ALL]
    rows = [[ALL, *(base[count] for count in COUNTS), result["flights"]]]
    told = {name: found for name, found in result["names"].items() if found["changed"]}
    rows += [[f"without `{name}`", *(f"{n[c] - base[c]:+d}" for c in COUNTS), n["changed"]] for name, n in told.items()]
    quiet = [name for name in result["names"] if name not in told and name != ALL]
    text = tools.table(("witness", *COUNTS, "flights that end otherwise"), rows)
    return text + (f"\n\nWithout effect here: {', '.join(f'`{name}`' for name in quiet)}." if quiet else "")
