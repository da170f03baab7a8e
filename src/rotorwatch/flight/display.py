"""Display of a flight in a notebook: a table of its signals. HTML without scripts, in the colours of the page around it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rotorwatch.flight.flight import Flight


def page(log: Flight) -> str:
    """The log's signals with their rates, and warnings."""
    signals = [
        (name, ", ".join(s.columns), s.unit, s.frame, str(len(s)), f"{s.rate_hz:.1f}", s.source) for name, s in sorted(log.signals.items())
    ]
    about = ", ".join(text for text in (log.autopilot, log.firmware, log.format, f"{log.duration:.1f} s") if text)
    heads = ("signal", "columns", "unit", "frame", "samples", "Hz", "source")
    warnings = "".join(f"<li>{escape(text)}</li>" for text in log.warnings)
    return f"<p><b>{escape(log.name)}</b> {escape(about)}</p>{table('Signals', heads, signals)}" + (
        f"<ul>{warnings}</ul>" if warnings else ""
    )


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of text under heads; nothing where there are no rows."""
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    if not body:
        return ""
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    return f"<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
