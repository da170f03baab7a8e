"""Ablation of witnesses: flights of a plan assessed by their logs without each witness that was heard, and counted as `open_world` does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from os import PathLike
from typing import Any

from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.toolkit import prepare, witness
from rotorwatch_lab.campaign import batch, open_score
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.experiments import tools

ALL = "all witnesses"
COUNTS: dict[str, Callable[[str, str], bool]] = {
    "healthy vehicle accused": lambda group, outcome: group == "healthy" and outcome in open_score.FALSE,
    "healthy rotor accused beside a fault": lambda group, outcome: group != "healthy" and outcome in open_score.FALSE,
    "healthy vehicle ambiguous": lambda group, outcome: group == "healthy" and outcome == "doubt",
    "loss right": lambda group, outcome: group == "loss" and outcome == "right",
    "other fault right": lambda group, outcome: group == "other" and outcome == "right",
    "fault ambiguous": lambda group, outcome: group != "healthy" and outcome in open_score.DOUBTS,
    "loss missed": lambda group, outcome: group == "loss" and outcome == "missed",
}


def run(
    plan: Plan,
    flights: int,
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """{"flights", "names": witness -> {count: number, "heard": flights in which it was, "changed": flights with another outcome}}; jobs,
    progress, scheduler, keep: as of `tools.gathered`. Raises ConfigError."""
    if plan.assess != "log":
        raise ConfigError(f"The plan {plan.name} is not assessed by logs; set assess = 'log' (docs/campaigns.md#plans).")
    parts = [(plan, numbers) for numbers in tools.batches(flights, len(plan.cells), batch.CPU_WIDTH)]
    rows = tools.gathered(_part, parts, jobs, progress, "assessing", scheduler, keep)
    names = [ALL, *(w.name for w in witness.registered())]
    return {"flights": len(rows), "names": {name: _counted(rows, name) for name in dict.fromkeys(names)}}


def _counted(rows: Sequence[tuple[str, Mapping[str, str]]], name: str) -> dict[str, int]:
    outcomes = [(group, said.get(name, said[ALL])) for group, said in rows]
    heard = sum(name in said for _, said in rows)
    found = {count: sum(of(*outcome) for outcome in outcomes) for count, of in COUNTS.items()}
    return found | {"heard": heard, "changed": sum(o != said[ALL] for (_, o), (_, said) in zip(outcomes, rows))}


def _part(part: tuple[Plan, Sequence[int]]) -> Iterable[tuple[str, dict[str, str]]]:
    """(group, ALL or witness that is left out -> outcome) of each flight. A witness that was not heard cannot change it."""
    plan, numbers = part
    found = []
    for k, scenario, drawn, record in batch.simulated(plan, numbers, batch.CPU_WIDTH):
        try:
            ready = prepare(batch.logged(k, scenario, drawn, record))
        except RotorwatchError:
            continue
        if ready.table is None:
            continue
        outcome: Callable[[], str] = lambda: open_score.assessed(scenario, ready.answer().end)["outcome"]  # noqa: E731, B023
        with listening() as heard:
            said = {ALL: outcome()}
        for name in heard:
            with without(name):
                said[name] = outcome()
        found.append((open_score.group(scenario), said))
    return found


def without(name: str) -> AbstractContextManager[None]:
    """Context in which this witness is not asked."""
    return witness.changed(lambda one: None if one.name == name else one)


@contextmanager
def listening() -> Iterator[set[str]]:
    """Context that yields the names of the witnesses that were heard in it: they changed events or the view."""
    heard: set[str] = set()

    def listened(one: witness.Witness) -> witness.Witness:
        def hear(view: witness.View, before: witness.Events) -> witness.Events:
            was = _state(view, before)
            after = one.hear(view, before)
            if _state(view, after) != was:
                heard.add(one.name)
            return after

        return one._replace(hear=hear)

    with witness.changed(listened):
        yield heard


def _state(view: witness.View, events: witness.Events) -> tuple:
    """What a witness may change, by identity: of equal events it may still have made others."""
    objects = (*events, *view.open, *view.facts.values())
    return tuple(map(id, objects)), len(view.testimony), tuple(view.warnings), tuple(view.assumptions)


def markdown(result: Mapping[str, Any]) -> str:
    """A table of the witnesses that were heard, and a sentence with the others."""
    base, flights = result["names"][ALL], result["flights"]
    reported = {name: n for name, n in result["names"].items() if name != ALL and n["heard"]}
    rows = [[ALL, flights, *(base[count] for count in COUNTS), 0]]
    rows += [[f"without `{name}`", n["heard"], *(f"{n[c] - base[c]:+d}" for c in COUNTS), n["changed"]] for name, n in reported.items()]
    quiet = [name for name in result["names"] if name not in reported and name != ALL]
    text = tools.table(("witness", "flights in which it is heard", *COUNTS, "flights that end otherwise"), rows)
    return text + (f"\n\nNever heard here: {', '.join(f'`{name}`' for name in quiet)}." if quiet else "")
