"""Tables for a terminal on estimation research: a paper's claims beside what came out here; what can be told apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.text import Text

from rotorwatch import report
from rotorwatch.report.terminal import listing

if TYPE_CHECKING:
    from rotorwatch.experiments.studies.reproduction import Reproduction

VERDICTS = {"holds": "green", "partly": "yellow", "not reproduced": "red"}


def reproduction(result: Reproduction) -> RenderableType:
    """A row for every claim, and below it why the verdict is what it is."""
    title = Text(result.title, style="bold")
    seeds = f"{result.seeds} {'seed' if result.seeds == 1 else 'seeds'}"
    literal = f" · read literally: {', '.join(result.literal)}" if result.literal else ""
    rows = listing("", "claim", "the paper", "here", "verdict")
    for claim in result.claims:
        said = Text(claim.claim).append(f"\n{claim.why}", style="dim")
        rows.add_row(said, claim.paper, claim.measured, Text(claim.verdict, style=VERDICTS[claim.verdict]))
        rows.add_section()
    return Group(title, Text(f"{result.paper} · {seeds}{literal}", style="dim"), rows)


def observability(result) -> RenderableType:
    """What hover and a manoeuvre tell apart; result as from `rotorwatch.observability`."""
    rows = listing("", "in", "rank", "smallest singular value", "least known loss (1 sd)", right=(1, 2, 3))
    for case in result.cases:
        rows.add_row(
            case.name,
            f"{case.rank} of {result.unknowns}",
            f"{case.singular_values[-1]:.1e}",
            report.percent(case.worst_sd, 1),
        )
    parts: list[RenderableType] = [Text(result.name, style="bold"), rows, Text(result.summary)]
    if result.alike:
        sets = listing("Cannot be told apart in hover", "these", "look like", "apart in the manoeuvre", right=(2,))
        for pair in result.alike:
            sets.add_row(report.rotors(pair.one), report.rotors(pair.other), f"{pair.separation:.1f} sd")
        parts += [Text(), sets]
    return Group(*parts)
