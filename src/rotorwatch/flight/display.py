"""Display of a flight in a notebook: a table of its signals, as HTML without scripts in the colours of the page around it; and plots of
series (matplotlib)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rotorwatch.base import files, optional

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


class Panel(NamedTuple):
    """Lines over one time axis. label: with the unit. values (T, k), NaN where unknown; names: of its columns. low, high (T, k): a band."""

    label: str
    values: np.ndarray
    names: Sequence[str]
    low: np.ndarray | None = None
    high: np.ndarray | None = None


def plot(time: np.ndarray, panels: Sequence[Panel], path: str | PathLike | None = None) -> Any:
    """A matplotlib figure of these panels, one above the other; written to `path` (.png, .svg, .pdf) when given. time (T,): s. Raises
    ConfigError where matplotlib is not installed."""
    figure = optional.library("matplotlib.figure", "A plot").Figure(figsize=(9.0, 2.0 + 2.0 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for ax, panel in zip(axes, panels):
        for k, name in enumerate(panel.names):
            (line,) = ax.plot(time, panel.values[:, k], lw=1.2, label=name)
            if panel.low is not None and panel.high is not None:
                ax.fill_between(time, panel.low[:, k], panel.high[:, k], color=line.get_color(), alpha=0.15, lw=0)
        ax.set_ylabel(panel.label)
        ax.legend(frameon=False, fontsize="small", ncols=4, loc="upper left")
    axes[-1].set_xlabel("time [s]")
    if path is not None:
        with files.replacing(path) as unfinished:
            figure.savefig(unfinished)
    return figure
