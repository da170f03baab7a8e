"""Tables for a terminal, by rich: readable at 80 columns, in a pipe and without colours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from rotorwatch import report
from rotorwatch.diagnosis import Diagnosis
from rotorwatch.report import plain, words

STYLES = {
    "healthy": "bold green",
    "fault": "bold red",
    "ambiguous": "bold yellow",
    "inconclusive": "bold yellow",
    "error": "bold red",
    "degraded": "red",
    "failed": "bold red",
    "unobservable": "dim",
}


def console(stderr: bool = False) -> Console:
    """Where tables go: colours only in a terminal, 80 columns in a pipe, no markup or emoji read from names."""
    out = Console(stderr=stderr, highlight=False, emoji=False, markup=False)
    if not out.is_terminal:
        out = Console(stderr=stderr, highlight=False, emoji=False, markup=False, width=80, color_system=None)
    return out


def diagnosis(result: Diagnosis) -> RenderableType:
    """The whole answer for one flight."""
    parts: list[RenderableType] = [_heading(result), Text()]
    parts.append(_rotors(result))
    if result.events:
        parts.append(_events(result))
    parts += _mentions(result)
    rows = report.comparison(result)
    if rows:
        parts += [Text(), _comparison(rows)]
    parts += [*([] if rows else [Text()]), _small_print(result)]
    return Group(*parts)


def line(name: str, result: Diagnosis) -> Text:
    """One flight of several on one line."""
    text = Text(f"{report.VERDICTS[result.verdict].lower():<13}", style=STYLES[result.verdict])
    return text.append(f"{name}  ", style="default not bold").append(result.headline, style="default not bold")


def error_line(name: str, sentence: str) -> Text:
    """A flight of several that could not be judged."""
    return Text(f"{'error':<13}", style=STYLES["error"]).append(f"{name}  {sentence}", style="default not bold")


def _heading(result: Diagnosis) -> RenderableType:
    facts = result.flight
    text = Text(report.VERDICTS[result.verdict].upper(), style=STYLES[result.verdict])
    text.append("  ").append(result.headline, style="default bold")
    what = [str(facts["name"])] if facts.get("name") else []
    what += [report.frame(result), *(str(facts[k]) for k in ("autopilot", "profile") if facts.get(k))]
    what.append(f"{float(facts.get('duration_s') or 0):.0f} s")
    return Group(Text(" · ".join(what), style="dim"), Text(), text, Text(result.reason))


def listing(title: str, *columns: str, right: Iterable[int] = ()) -> Table:
    """An empty table: a title and its columns; `right`: the places of those with numbers."""
    table = Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1)
    )
    for i, name in enumerate(columns):
        number = i in set(right)
        table.add_column(name, justify="right" if number else "left", no_wrap=number, header_style="default")
    return table


def _rotors(result: Diagnosis) -> RenderableType:
    table = listing("Rotors, at the end of the flight", "rotor", "loss", "95 % interval", "", "status", right=(0, 1, 2))
    for r in result.rotors:
        bar = Text("█" * round(20 * min(max(r.loss, 0.0), 1.0)), style=STYLES.get(r.status, ""))
        bar.append("·" * (20 - len(bar)), style="dim")
        unknown = r.status == "unobservable"
        table.add_row(
            str(r.rotor),
            "?" if unknown else report.percent(r.loss, 1),
            "" if unknown else report.interval(*r.interval),
            Text("") if unknown else bar,
            Text(r.status, style=STYLES.get(r.status, "")),
        )
    return table if result.rotors else Text("The log shows no rotors.")


def _events(result: Diagnosis) -> RenderableType:
    table = listing("Events", "what", "since", "announced", "until", "loss (95 %)", "sure", right=(1, 2, 3, 4, 5))
    for e in result.events:
        what = Text(f"{report.kind(e)}\n").append(report.candidates(e) if e.rotors else "no single rotor", style="bold")
        loss = "\n".join(report.losses(e).split(", ")) or "–"
        sure = report.probability(e.probability)
        table.add_row(what, *(report.seconds(t) for t in (e.onset_s, e.detected_s, e.end_s)), loss, sure)
    reasons = [
        Padding(Text(f"{report.seconds(e.detected_s)}: {e.reason}"), (0, 0, 0, 1)) for e in result.events if e.reason
    ]
    return Group(table, *reasons)


def _comparison(rows: Iterable[tuple[str, str, str, str]]) -> RenderableType:
    table = listing("Who found what, when", "check", "found", "at", "why", right=(2,))
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def _mentions(result: Diagnosis) -> list[RenderableType]:
    """Common mode and whole-flight findings, as pairs of name and value."""
    out: list[RenderableType] = []
    for title, facts in (("Common mode", result.common_mode), ("Against healthy flights", result.whole_flight)):
        if facts:
            grid = Table.grid(padding=(0, 2))
            for key, value in facts.items():
                grid.add_row(Text(f" {words(key)}", style="dim"), Text(plain(value)))
            out += [Text(), Text(title, style="bold"), grid]
    return out


def _small_print(result: Diagnosis) -> RenderableType:
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column()
    for sentence in result.warnings:
        grid.add_row(Text("warning", style="yellow"), Text(sentence))
    grid.add_row("baseline", Text(result.baseline))
    for sentence in result.assumptions:
        grid.add_row("assumed", Text(sentence))
    if result.trace is not None:
        for start, end, why in result.trace.blind:
            grid.add_row("blind", Text(f"{start:.1f} to {end:.1f} s: {why}"))
    if result.timing:
        grid.add_row("took", Text(", ".join(f"{words(k)} {v:.2f} s" for k, v in result.timing.items())))
    return grid


def info(facts: Mapping[str, Any]) -> RenderableType:
    """What `rotorwatch info` prints; facts as from `rotorwatch.info.info`."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column()
    airborne = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in facts["airborne_s"]) or "never found airborne"
    for key, value in (
        ("log", facts["name"]),
        ("format", facts["format"]),
        (
            "autopilot",
            facts["firmware"]
            if facts["autopilot"] in facts["firmware"]
            else f"{facts['autopilot']} {facts['firmware']}",
        ),
        ("vehicle", facts["frame"] or facts["vehicle_type"] or "unknown"),
        ("rotors", facts["rotors"] or "no commands found"),
        ("duration", f"{facts['duration_s']:.1f} s"),
        ("airborne", airborne),
        ("parameters", facts["parameters"]),
    ):
        if value not in ("", None):
            grid.add_row(key, Text(str(value)))
    table = listing("Signals", "signal", "rate", "unit", "frame", "valid", "source", right=(1, 4))
    for s in facts["signals"]:
        table.add_row(
            s["name"],
            f"{s['rate_hz']:.4g} Hz",
            s["unit"],
            s["frame"],
            f"{int(100 * s['valid'])} %",  # 99.9 % is not all of it
            s["source"],
        )
    parts: list[RenderableType] = [grid, Text(), table]
    if facts["messages"]:
        said = listing("Messages", "at", "what", "text", right=(0,))
        for m in facts["messages"]:
            said.add_row(f"{m['time_s']:.1f} s", m["kind"], Text(m["text"]))
        parts.append(said)
    parts.append(Text("For a diagnosis", style="bold"))
    ready = "This log has what a diagnosis needs." if facts["ready"] else "This log cannot be diagnosed as it is."
    parts.append(Text(f" {ready}", style="green" if facts["ready"] else "red"))
    list_ = Table.grid(padding=(0, 1))
    for gap in facts["missing"]:
        list_.add_row(
            Text(" •", style="red" if gap["needed"] else "dim"), Text(gap["why"]).append(f" {gap['setting']}", "dim")
        )
    for sentence in facts["warnings"]:
        list_.add_row(Text(" !", style="yellow"), Text(sentence))
    return Group(*parts, list_)


def campaign(result: Mapping[str, Any]) -> RenderableType:
    """The table of an injection campaign (`rotorwatch.inject.campaign`)."""
    rows = list(result.get("table", ()))
    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = listing("Injected losses", *(words(c) for c in columns), right=range(len(columns)))
    shares = {"loss", "detected", "right", "right_rotor", "loss_rms", "detected_share", "right_share"}
    for row in rows:
        table.add_row(*(_campaign_cell(c, row.get(c), shares) for c in columns))
    rest = {k: v for k, v in result.items() if k not in ("table", "flights", "trials", "runs")}
    grid = Table.grid(padding=(0, 2))
    for key, value in rest.items():
        grid.add_row(Text(words(key), style="dim"), Text(plain(value)))
    return Group(table, Text(), grid)


def _campaign_cell(column: str, value: Any, shares: set[str]) -> str:
    if value is None:
        return "–"
    if column in shares and isinstance(value, float):
        return report.percent(value, 1 if column == "loss_rms" else 0)
    return report.seconds(value) if column.endswith("_s") else plain(value)


def fuzz(result: Mapping[str, Any]) -> RenderableType:
    """What `rotorwatch fuzz` prints; result as from `rotorwatch.fuzz.fuzz`."""
    table = listing("Outcomes", "outcome", "mutations", "share", right=(1, 2))
    for outcome, count in result["outcomes"].items():
        style = STYLES["error"] if outcome == "FAILED" and count else ""
        table.add_row(Text(outcome, style=style), str(count), report.percent(count / max(result["mutations"], 1), 1))
    parts: list[RenderableType] = [
        Text(f"{result['log']}: {result['mutations']} mutations, seed {result['seed']}"),
        table,
    ]
    for f in result["failures"]:
        parts.append(Text(f"FAILED number {f['number']} ({f['mutation']}): {f['what']}", style="red"))
    return Group(*parts)
