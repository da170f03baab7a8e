"""The command that scores the diagnosis on labelled flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from rotorwatch.toolkit.commands import JSON, LOG, OUT, common, label, option, print_json, progress, resumable, say, show, spread


@click.command(short_help="Score the diagnosis on labelled flights.")
@click.argument("labels", type=LOG, metavar="LIST")
@option("--out -o", "Page (.html), flights (.csv) or all results (.json); may be repeated.", type=OUT, metavar="FILE", multiple=True)
@spread
@resumable
@JSON
@common
def evaluate(labels, out, jobs, scheduler, keep, as_json, quiet) -> None:
    """Diagnose the flights of LIST, a CSV file with the columns path, rotor, onset_s .. (docs/evaluate.md), and count what is found.

    \b
    rotorwatch evaluate labels.csv -o page.html
    """
    from rotorwatch_lab.experiments import evaluate as evaluation

    for path in out:
        evaluation.writable(path)

    def answered(path: str, rows: Sequence[Mapping[str, Any]]) -> None:
        if rows[0]["sentence"] and not quiet:
            say(f"refused: {rows[0]['sentence']}")

    with progress(quiet) as report:
        result = evaluation.evaluate(labels, jobs, report, scheduler, keep, answered)
    if as_json:
        print_json(result)
    else:
        show(lambda terminal: _table(terminal, result, evaluation.lines(result["summary"])))
    for path in out:
        evaluation.write(result, path)
        if not quiet:
            say(f"written to {path}")


def _table(terminal: Any, result: Mapping[str, Any], summary: Sequence[tuple[str, str]]) -> Any:
    """The faults, the healthy flights that are not called healthy, and the summary."""
    from rich.console import Group
    from rich.text import Text

    from rotorwatch_lab.experiments.evaluation_page import cells

    rows = [row for row in result["flights"] if row["rotor"] or row["outcome"] != "clean"]
    shown = [[Text(label(row["path"].rpartition("/")[2])), *map(Text, cells(row))] for row in rows]
    names = ["flight", "broken", "outcome", "accused", "candidates", "delay", "loss"]
    parts = [terminal.Fitted("Flights", names, shown, wide=(0,), short=(4, 5, 6)), Text("")] if shown else []
    return Group(*parts, terminal.Notes(summary))
