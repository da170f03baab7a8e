"""Campaigns scored on `diagnose` itself: each flight's log is written in memory in its autopilot's format, read and diagnosed, and the
answers are counted by kind of flight (scores: open_score.py).

    from rotorwatch_lab.campaign import open_world, read
    plan = read("plans/open.toml")
    table = open_world.run(plan, 2000, "results")      # again: goes on where it was stopped
    print(open_world.markdown(open_world.summarise(table, plan.name)))
"""

from __future__ import annotations

import itertools
import os
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.toolkit import Conclusion, diagnose, prepare
from rotorwatch_lab.campaign import batch, open_score, work
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.campaign.score import read_columns
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.simulation.scenario import Scenario

COLUMNS = read_columns("open_world")
GROUPS = {"healthy": "rotors healthy", "other": "a fault that is no loss", "loss": "a loss"}
QUARTER = 0.25
UNANSWERED = ("inconclusive", "error")


def assess(plan: Plan, flights: Sequence[int], size: int) -> list[dict]:
    """A row of COLUMNS for each flight (`work.Assessor`). All flights must be of one cell."""
    rows = []
    for k, scenario, numbers, record in batch.simulated(plan, flights, size):
        kind = plan.kind(k)
        row = _row(k, scenario, numbers, record)
        rows.append(row | {"flight": k, "kind": kind.name if kind else ""})
    return rows


def _row(number: int, scenario: Scenario, numbers: Any, record: Any) -> dict[str, Any]:
    """The columns of one flight."""
    faults, sizes = scenario.faults, open_score.losses(scenario).values()
    crashed = np.flatnonzero(np.asarray(record.flies) < 0.5)
    row: dict[str, Any] = dict.fromkeys(COLUMNS) | {
        "method": "diagnose", "group": open_score.group(scenario), "frame": scenario.airframe["frame"],
        "autopilot": scenario.autopilot, "trajectory": scenario.trajectory["kind"], "wind_m_s": scenario.wind["speed_m_s"],
        "fault": faults[0]["kind"] if faults else "", "broken": "+".join(str(r) for r in sorted({f["rotor"] for f in faults})),
        "loss": min(sizes, default=None), "onset_s": min((f["onset_s"] for f in faults), default=None),
        "crashed_s": float(record.time[crashed[0]]) if crashed.size else None,
    }  # fmt: skip
    try:
        answer, air = _answer(batch.logged(number, scenario, numbers, record))
    except RotorwatchError as why:
        return row | {"verdict": "error", "outcome": "error", "headline": str(why), "accused": ""}
    about = {"verdict": answer.verdict, "headline": answer.headline, "airborne_s": float(air[1] - air[0]) if air else 0.0}
    return row | about | open_score.assessed(scenario, answer)


def _answer(flight: Flight) -> tuple[Diagnosis | Conclusion, list[float]]:
    """Answer of `diagnose` to a flight, without the parts that only pages show, and [first take-off, last landing] s."""
    ready = prepare(flight)
    if ready.table is None:
        answer = diagnose(flight)
        return answer, answer.flight["airborne_s"]
    return ready.answer().end, [round(ready.air[0][0], 3), round(ready.air[-1][1], 3)]


def run(
    plan: Plan,
    flights: int,
    folder: str | os.PathLike,
    jobs: int | None = None,
    progress: work.Progress | None = None,
    scheduler: str | None = None,
) -> Any:
    """`work.run` for a plan whose flights are diagnosed from their logs: the table with COLUMNS. Raises ConfigError."""
    return work.run(plan, flights, folder, jobs, progress, assess, COLUMNS, scheduler)


def summarise(rows: Any, name: str = "") -> dict[str, Any]:
    """{"name", "flights", "lines": [{"name", "group", **measures}]} of a pyarrow table with COLUMNS: all flights with healthy rotors, with
    another fault than a loss, with a loss, with losses of a quarter and more (group ""), and each kind. Raises ConfigError where there is
    none."""
    flights = rows.to_pylist()
    if not flights:
        raise ConfigError("There is no flight in this campaign's table.")
    parts = [("", f"all: {words}", [f for f in flights if f["group"] == key]) for key, words in GROUPS.items()]
    parts.append(("", "all: a loss of a quarter and more", [f for f in flights if (f["loss"] or 0.0) >= QUARTER]))
    order = list(GROUPS)
    kinds = sorted({(order.index(f["group"]), f["kind"]) for f in flights})
    parts += [(order[k], kind, [f for f in flights if f["kind"] == kind]) for k, kind in kinds]
    lines = [{"name": label, "group": group, **measures(part)} for group, label, part in parts if part]
    return {"name": name, "flights": len(flights), "lines": lines}


def measures(flights: Sequence[dict]) -> dict[str, Any]:
    """Counts, shares and rates of some flights with 95 % intervals; None where there is nothing to count. accused: a healthy rotor is
    accused with certainty; named: faults that are no loss whose kind the answer names, with no healthy rotor accused; hours: of flights
    without a fault, accused_h: accusations in them per hour; ended: lasting faults reported as over; unanswered: logs that are
    inconclusive or refused."""
    healthy = [f for f in flights if f["group"] == "healthy"]
    hours = sum(f["airborne_s"] or 0.0 for f in healthy) / 3600.0
    errors = [f["error"] for f in flights if f["error"] is not None]
    outcomes = [f["outcome"] for f in flights]
    return {
        "flights": len(flights),
        "accused": tools.share([o in open_score.FALSE for o in outcomes]),
        "doubt": tools.share([o in open_score.DOUBTS for o in outcomes]),
        "right": tools.share([f["outcome"] == "right" for f in flights if f["group"] != "healthy"]),
        "named": tools.share([f["named"] for f in flights if f["named"] is not None]),
        "hours": hours,
        "accused_h": tools.rate(sum(f["outcome"] in open_score.FALSE for f in healthy), hours),
        "error": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
        "holds": tools.share([f["holds"] for f in flights if f["holds"] is not None]),
        "ended": sum(bool(f["ended"]) for f in flights),
        "crashed": sum(f["crashed_s"] is not None for f in flights),
        "unanswered": sum(f["verdict"] in UNANSWERED for f in flights),
    }


HEADS = (
    "kind of flight", "flights", "a healthy rotor accused", "ambiguous", "right", "kind named", "healthy hours", "accused an hour",
    "size, rms", "intervals hold", "said to be over", "crashed", "no answer",
)  # fmt: skip
BRIEF = {"kind of flight", "flights", "a healthy rotor accused", "ambiguous", "right", "kind named", "no answer"}


def markdown(summary: dict[str, Any], brief: bool = False) -> str:
    """The summary as Markdown tables: all flights, and the kinds of each group; brief: of kinds only the most important counts.

    Columns without a value in any row are left out; healthy kinds without an accusation or doubt are listed in a sentence.
    """
    parts = [f"{summary['flights']} flights of {summary['name']}: counts, with the 95 % interval of their share of the kind in per cent.\n"]
    for group, lines in itertools.groupby(summary["lines"], key=lambda line: line["group"]):
        found, short = list(lines), brief and group
        quiet = [line for line in found if group and _quiet(line)]
        rows = [_cells(line) for line in found if line not in quiet]
        rates = {"healthy hours", "accused an hour"} if group else set()  # a kind has flown too little for them
        shown = (BRIEF if short else set(HEADS)) - rates
        kept = [k for k, head in enumerate(HEADS) if head in shown and any(row[k] not in ("-", 0) for row in rows)]
        if short:
            rows = [[str(cell).partition(" (")[0] if k else cell for k, cell in enumerate(row)] for row in rows]
        if rows:
            parts.append(tools.table([HEADS[k] for k in kept], ([row[k] for k in kept] for row in rows)) + "\n")
        if quiet:
            names = [f"{_short(line['name'])} ({line['flights']}{_unanswered(line)})" for line in quiet]
            parts.append(textwrap.fill(f"No rotor accused, none ambiguous: {', '.join(names)}.", 140) + "\n")
    return "\n".join(parts)


def table(summary: dict[str, Any]) -> list[list[Any]]:
    """Head and rows of the summary with all columns, for a file."""
    return [list(HEADS), *(_cells(line) for line in summary["lines"])]


def _quiet(line: dict[str, Any]) -> bool:
    """A kind of healthy flights without an accusation or doubt."""
    return line["right"] is None and not line["accused"]["value"] and not line["doubt"]["value"]


def _short(name: str) -> str:
    """A kind's name without that of its group."""
    return name.rpartition(": ")[2]


def _unanswered(line: dict[str, Any]) -> str:
    return f", {line['unanswered']} without an answer" if line["unanswered"] else ""


def _cells(m: dict[str, Any]) -> list[Any]:
    """A line of the summary as the cells of a row."""
    return [
        *(m["name"], m["flights"], *(_share(m[key]) for key in ("accused", "doubt", "right", "named"))),
        *(f"{m['hours']:.2f}" if m["hours"] else "-", _dashed(tools.interval(m["accused_h"], 2))),
        *("-" if m["error"] is None else f"{m['error']:.3f}", _share(m["holds"])),
        *(m["ended"], m["crashed"], m["unanswered"]),
    ]


def _dashed(interval: str) -> str:
    """A number with its interval as a narrow column has it."""
    return interval.replace(" to ", "–")


def _share(value: dict[str, float] | None) -> str:
    """Count, and the interval of its share in per cent; a tenth of a per cent counts here."""
    if value is None:
        return "-"
    return f"{round(value['value'] * value['n'])} ({100.0 * value['low']:.1f}–{100.0 * value['high']:.1f})"
