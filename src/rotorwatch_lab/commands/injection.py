"""Commands that put losses into healthy flights, or noise of healthy flights into simulated ones, and count what the diagnosis finds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from rotorwatch.toolkit.commands import JSON, LOG, answer, common, option, print_json, progress, resumable, shares, show, spread

if TYPE_CHECKING:
    from rich.console import RenderableType


@click.command(short_help="Inject losses and count what is found.")
@click.argument("logs", nargs=-1, required=True, type=LOG, metavar="LOG...")
@option("--loss losses", "Losses to inject, above 0 and below 1.", "0.2,0.3,0.4", metavar="L,L,...")
@option("--repeats", "Injections per flight, rotor and loss.", 3, type=click.IntRange(1, 1000))
@option("--seed", "Seed of the random onsets.", 0, type=click.IntRange(0))
@spread
@resumable
@JSON
@common
def inject(logs, losses, repeats, seed, jobs, scheduler, keep, as_json, quiet) -> None:
    """Inject losses into healthy flights and count what the diagnosis finds of them."""
    from rotorwatch_lab.experiments.inject import campaign

    wanted = shares("--loss", losses)
    with progress(quiet) as report:
        result = campaign(logs, wanted, repeats, seed, report, jobs, scheduler, keep)
    if as_json:
        print_json(result)
    else:
        show(lambda terminal: _shown(terminal, result))


def _shown(terminal: Any, result: Mapping[str, Any]) -> RenderableType:
    """The table of a campaign, and what it was."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from rotorwatch.report import plain, words

    rows = _by_loss(result["table"])
    columns = list(rows[0]) if rows else []
    table = terminal.listing("Injected losses", *map(words, columns), right=range(len(columns)))
    for row in rows:
        table.add_row(*("–" if row[c] is None else plain(row[c]) for c in columns))
    rest = Table.grid(padding=(0, 2))
    for key in [key for key in result if key not in ("table", "flights", "trials", "runs")]:
        rest.add_row(Text(words(key), style="dim"), Text(plain(result[key])))
    return Group(table, Text(), rest)


def _by_loss(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A campaign's table turned over: a line for each measure, a column for each loss."""
    from rotorwatch.report import percent, seconds, words

    counts = {"loss", "injections", "false_alarms", "at_limit"}

    def cell(key: str, value: Any) -> Any:
        if value is None or key in counts:
            return value
        return seconds(value) if key.endswith("_s") else percent(value, 1 if key.startswith("loss_") else 0)

    keys = [key for key in rows[0] if key != "loss"] if rows else []
    return [{"loss": words(key)} | {percent(row["loss"]): cell(key, row.get(key)) for row in rows} for key in keys]


@click.command("false-alarms", short_help="Measure the false-alarm rate on real noise.")
@click.argument("logs", nargs=-1, required=True, type=LOG, metavar="LOG...")
@option("--hours", "Flight hours to simulate, over all logs.", 20.0, type=float)
@option("--seed", "Seed of the surrogate flights.", 0, type=click.IntRange(0))
@spread
@resumable
@JSON
@common
def false_alarms(logs, hours, seed, jobs, scheduler, keep, as_json, quiet) -> None:
    """Assess surrogate flights with the noise of healthy LOGs, and count the false alarms per flight hour."""
    from rotorwatch_lab.experiments.studies.false_alarms import describe
    from rotorwatch_lab.experiments.studies.false_alarms import false_alarms as run

    with progress(quiet) as report:
        result = run(logs, hours, seed, report, jobs=jobs, scheduler=scheduler, keep=keep)
    answer(as_json, result, describe(result))
