"""The answer of `evaluate` as one self-contained HTML page: the summary, and a line for each flight, worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from rotorwatch import __version__
from rotorwatch.report import overview

WORST = ("wrong", "extra", "accused", "astray", "missed", "partly", "refused", "among", "doubt", "right", "clean")
COLUMNS = ("outcome", "flight", "broken", "onset", "size", "answer", "accused", "candidates", "delay", "loss", "false alarms")
STYLE = """table.summary td { padding: 2px 14px 2px 0; } td.wrong, td.extra, td.accused { color: var(--fault); font-weight: 650; }"""


def page(result: Mapping[str, Any], lines: Sequence[tuple[str, str]]) -> str:
    """The page's HTML text. lines: of the summary."""
    summary = "".join(f"<tr><td>{escape(what)}</td><td>{escape(text)}</td></tr>" for what, text in lines)
    rows = sorted(result["flights"], key=lambda row: (WORST.index(row["outcome"]), row["path"]))
    head = "".join(f"<th>{name}</th>" for name in COLUMNS)
    title = f"{result['summary']['flights']} labelled flights"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{overview.POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title} – rotorwatch</title>\n<style>{overview.css()}{STYLE}</style>\n</head>\n<body>\n"
        f'<div class="masthead"><b>{title}</b><span class="brand">rotorwatch {escape(__version__)}</span></div>\n'
        f'<main id="logs">\n<table class="summary">{summary}</table>\n'
        '<div class="tools"><label>Find <input id="find" type="search" placeholder="words of a path, a rotor, an outcome"></label> '
        '<span id="shown" class="small" role="status"></span></div>\n'
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>\n{"".join(map(_line, rows))}</tbody></table></div>\n'
        f"</main>\n<script>{overview.SCRIPT}</script>\n</body>\n</html>\n"
    )


def cells(row: Mapping[str, Any]) -> list[str]:
    """Broken rotors, outcome, accused rotors, candidates, delay and loss of a row, as text."""
    loss = "" if row["loss"] is None else f"{row['loss']:.0%} ({row['low']:.0%} to {row['high']:.0%})"
    return [row["rotor"] or "none", row["outcome"], row["accused"] or "", row["candidates"] or "", _s(row["delay_s"]), loss]


def _line(row: Mapping[str, Any]) -> str:
    broken, outcome, *rest = cells(row)
    size = "" if row["size"] is None else f"{row['size']:.0%}"
    shown = (row["path"], broken, _s(row["onset_s"]), size, row["sentence"] or row["headline"], *rest, row["false_alarms"] or "")
    body = "".join(f"<td>{escape(overview.printable(str(cell)))}</td>" for cell in shown)
    return f'<tr><td class="{outcome}">{outcome}</td>{body}</tr>\n'


def _s(value: float | None) -> str:
    return "" if value is None else f"{value:.1f} s"
