"""The command that scores the diagnosis on labelled flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from rotorwatch.toolkit.commands import JSON, LOG, OUT, common, label, option, print_json, progress, resumable, say, show, spread


@click.command(short_help="Score the diagnosis on labelled flights.")
@click.argument("labels", type=LOG, metavar="LIST")
@option("--out -o", "Page (.html), flights (.csv) or all results (.json); may be repeated.", type=OUT, metavar="FILE", multiple=True)
@option("--detector", "Your own detector (docs/evaluate.md#your-own-detector), scored beside rotorwatch.", metavar="FILE|MODULE")
@spread
@resumable
@JSON
@common
def evaluate(labels, out, detector, jobs, scheduler, keep, as_json, quiet) -> None:
    """Diagnose the flights of LIST, a CSV file with the columns path, rotor, onset_s .. (docs/evaluate.md), and count what is found. LIST
    may be a folder: its labels.csv, or all its logs.

    \b
    rotorwatch evaluate labels.csv -o page.html
    rotorwatch evaluate LOGS --detector mine -o both.csv
    """
    from rotorwatch_lab.experiments import evaluate as evaluation

    for path in out:
        evaluation.writable(path)

    def answered(path: str, rows: Sequence[Mapping[str, Any]]) -> None:
        if rows[0]["sentence"] and not quiet:
            say(f"refused: {rows[0]['sentence']}")

    with progress(quiet) as report:
        result = evaluation.evaluate(labels, jobs, report, scheduler, keep, answered, detector or "")
    if as_json:
        print_json(result)
    else:
        show(lambda terminal: _table(terminal, result, _lines(result)))
    for path in out:
        evaluation.write(result, path)
        if not quiet:
            say(f"written to {path}")


def _lines(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(what, text) of the summary; with another detector of both, where flights are labelled, and which alarmed first on how many."""
    from rotorwatch_lab.experiments import evaluate as evaluation

    compared = result.get("compared")
    if not compared:
        return evaluation.lines(result["summary"])
    names, both = list(compared), [evaluation.lines(summary) for summary in compared.values()]
    out = [(what, f"{text}; {names[-1]} {other}") for (what, text), (_, other) in zip(both[0], both[-1])]
    labelled = any(row["outcome"] != "unknown" for row in result["flights"])
    return [*(out if labelled else ()), *evaluation.first(result["flights"])]


def _table(terminal: Any, result: Mapping[str, Any], summary: Sequence[tuple[str, str]]) -> Any:
    """The faults, the healthy flights that are not called healthy, and the summary."""
    from rich.console import Group
    from rich.text import Text

    from rotorwatch_lab.experiments.evaluation_page import cells

    rows = [row for row in result["flights"] if row["rotor"] or row["outcome"] not in ("clean", "unknown")]
    several = len({row["detector"] for row in rows}) > 1
    beside = {id(row): f" by {row['detector']}" if several else "" for row in rows}
    shown = [[Text(label(row["path"].rpartition("/")[2]) + beside[id(row)]), *map(Text, cells(row))] for row in rows]
    names = ["flight", "broken", "outcome", "accused", "candidates", "delay", "loss"]
    parts = [terminal.Fitted("Flights", names, shown, wide=(0,), short=(4, 5, 6)), Text("")] if shown else []
    return Group(*parts, terminal.Notes(summary))
