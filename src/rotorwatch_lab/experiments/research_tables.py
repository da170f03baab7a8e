"""Tables for a terminal on estimation research: a paper's claims next to the results here; observability; survival; excitation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from rotorwatch import report
from rotorwatch.report.terminal import listing
from rotorwatch_lab.experiments.studies.reproduction import by_form, tables

if TYPE_CHECKING:
    from rotorwatch_lab.experiments.studies.reproduction import Reproduction

VERDICTS = {"holds": "green", "partly": "yellow", "not reproduced": "red", "refuted": "red"}


def reproduction(result: Reproduction) -> RenderableType:
    """A row for every claim, and below it why the verdict is what it is; then the study's tables."""
    title = Text(result.title, style="bold")
    seeds = f"{result.seeds} {'seed' if result.seeds == 1 else 'seeds'}"
    literal = f" · read literally: {', '.join(result.literal)}" if result.literal else ""
    rows = listing("", "claim", "the paper", "here", "verdict")
    for claim in result.claims:
        cell = Text(claim.claim).append(f"\n{claim.why}", style="dim")
        verdict = f"holds only if {claim.only_if}" if claim.verdict == "partly" and claim.only_if else claim.verdict
        rows.add_row(cell, claim.paper, claim.measured, Text(verdict, style=VERDICTS[claim.verdict]))
        rows.add_section()
    parts: list[RenderableType] = [title, Text(f"{result.paper} · {seeds}{literal}", style="dim")]
    for heads, lines in by_form(result.forms):
        forms = listing("", *heads)
        for claim, *verdicts in lines:
            forms.add_row(claim, *(Text(verdict, style=VERDICTS[verdict]) for verdict in verdicts))
        parts.append(forms)
    parts.append(rows)
    for table in tables(result.paper, result.figures):
        extra = listing(table.title, *table.head)
        for row in table.rows:
            extra.add_row(*row)
        parts += [Text(), extra]
    return Group(*parts)


def observability(result) -> RenderableType:
    """Which losses hover and a manoeuvre distinguish; result as from `rotorwatch.observability`."""
    rows = listing("", "in", "rank", "smallest singular value", "least known loss (1 sd)", right=(1, 2, 3))
    for case in result.cases:
        rank, least = f"{case.rank} of {result.unknowns}", f"{case.singular_values[-1]:.1e}"
        rows.add_row(case.name, rank, least, report.percent(case.worst_sd, 1))
    parts: list[RenderableType] = [Text(result.name, style="bold"), rows, Text(result.summary)]
    if result.alike:
        sets = listing("Indistinguishable in hover", "these", "look like", "apart in the manoeuvre", right=(2,))
        for pair in result.alike:
            sets.add_row(report.rotors(pair.one), report.rotors(pair.other), f"{pair.separation:.1f} sd")
        parts += [Text(), sets]
    return Group(*parts)


def survival(result) -> RenderableType:
    """Remaining control after the loss of one and of two rotors, equal cases in one row; result as from `rotorwatch.survive`."""
    names = ("rotors", "loss", "then", "T / W", "roll", "pitch", "yaw", "wind", "turns")
    rows = listing("", *names, right=range(3, 9))
    for column in rows.columns[1:]:
        column.no_wrap = True
    alike: dict[tuple[str, ...], list[str]] = {}
    for case in (result.healthy, *result.cases):
        loss = report.percent(case.loss, 0) if case.rotors else "-"
        moments = [_or_dash(x, ".2g") for x in (case.roll, case.pitch, case.yaw)]
        wind_and_turn = (_or_dash(case.wind, ".0f"), _or_dash(case.rate, ".1f"))
        # The number of rotors keeps singles and pairs apart.
        cells = (str(len(case.rotors)), loss, case.verdict, f"{case.lift:.2f}", *moments, *wind_and_turn)
        alike.setdefault(cells, []).append("+".join(map(str, case.rotors)) or "none")
    for cells, sets in alike.items():
        rows.add_row(", ".join(sets), *cells[1:])
    units = "T / W: largest thrust over weight. Moments left at hover [N m], wind that can be held [m/s], turning there [rad/s]."
    notes = [Text(sentence, style="dim") for sentence in (units, *result.assumptions)]
    return Group(Text(result.name, style="bold"), rows, Text(result.summary), *notes)


def excitation(result) -> RenderableType:
    """Candidates, effect of the excitation on each, and their separation; result as from `rotorwatch.ask`."""
    rows = listing("", "weak rotors", "loss", "turns it by", "lifts it by", "apart from the next", right=(1, 2, 3, 4))
    turn, lift = np.degrees(result.design.tilt), 1e3 * result.design.heave
    for k, rotors in enumerate(result.candidates):
        loss = ", ".join(report.percent(result.losses[k][r - 1], 0) for r in rotors) or "-"
        name = "+".join(map(str, rotors)) or "none"
        rows.add_row(name, loss, f"{turn[k]:.2f} deg", f"{lift[k]:.1f} mm", f"{result.separation[k]:.1f} sd")
    each = ", ".join(f"{k + 1}: {report.percent(a, 1)}" for k, a in enumerate(result.amplitude))
    notes = (f"Largest change of each command, of full thrust: {each}.", *result.assumptions)
    return Group(Text(result.name, style="bold"), rows, Text(result.summary), *(Text(s, style="dim") for s in notes))


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
