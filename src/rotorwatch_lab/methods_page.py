"""Methods' own estimates of a log: a page (Bokeh) with the methods one above the other, and a still picture (matplotlib). The interval or
bound of every loss is shaded, the truth dashed where it is known."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rotorwatch import __version__
from rotorwatch.base import files, optional
from rotorwatch.flight.display import table
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.report import colours, html, markup, percent, seconds, words
from rotorwatch.report.method_plots import axis, drawn, label, limits
from rotorwatch.report.still import DASHES

if TYPE_CHECKING:
    from rotorwatch_lab.estimate import Estimates


def page(found: Estimates) -> str:
    """The page's HTML text. Raises ConfigError without Bokeh."""
    from bokeh.models import Range1d

    optional.library("bokeh", "A page")
    start, end = min(s.time[0] for s in found.series), max(s.time[-1] for s in found.series)
    x_range = Range1d(start=start, end=end, bounds=(start, end), min_interval=0.2)
    y_limits, looks = limits(found.series, found.truth), tints(found)
    plots: dict[str, Any] = {}
    for k, s in enumerate(found.series):
        true = found.true(s)
        plots |= {f"{name}-{k}": p for name, p in drawn(s, x_range, looks, y_limits, true).items()}
    scripts, divs = html.embed(plots)
    title = found.log or "a flight"
    names = list(dict.fromkeys(name for s in found.series for name in s.theta_names))
    chips = "".join(markup.chip(label(name), *looks[name]) for name in names)
    key = " Dashed: the truth." if found.truth is not None else ""
    body = [
        html.masthead(title),
        '<main id="report">',
        f"<h1>{escape(title)}: estimates of each method</h1>",
        "<p>Losses estimated by each method, step by step, with its own interval or bound shaded; nothing is held, clipped or decided. "
        f"<code>rotorwatch diagnose --estimator</code> decides whether a rotor is faulty.{key} Drag over a time span "
        "to zoom all plots.</p>",
        summary(found),
        f'<div class="chips" role="group" aria-label="Losses shown">{chips}</div>',
    ]
    for k, s in enumerate(found.series):
        here = [name for name in plots if name.endswith(f"-{k}")]
        body += [
            f"<h2>{escape(s.title)}</h2><p>{escape(s.whose)}</p>",
            *(markup.plot(name, divs[name]) for name in here if name.startswith(("loss", "m_"))),
            _actuators(found.found.get(s.method, {})),
            "<details><summary>States and innovations</summary>"
            "<p>States with their interval or bound. Innovations: measured less predicted, with what the method expects of them.</p>"
            + "".join(markup.plot(name, divs[name]) for name in here if name.startswith(("x_", "e_")))
            + "</details>",
        ]
    body += [
        _list("Assumptions", [f"{who}: {note}" for note, who in found.notes().items()]),
        _list("Could not run", [f"{name}: {why}" for name, why in found.failed.items()]),
        "</main>",
        f"<footer>Written by rotorwatch {__version__}. Times are in seconds from the first record of the log.</footer>",
        scripts,
    ]
    return html.document(f"{title}: methods", body)


def summary(found: Estimates) -> str:
    """Table of every method's losses at the end of its data, and coverage where the truth is known."""
    names = list(dict.fromkeys(name for s in found.series for name in s.theta_names))
    rows = []
    for s in found.series:
        cells = dict(zip(s.theta_names, (value(s, -1, k) for k in range(len(s.theta_names)))))
        rows.append((s.method, words(s.plant), s.says, seconds(float(s.time[-1])), *(cells.get(n, "") for n in names)))
        share = found.coverage(s)
        if share is not None:
            held = dict(zip(s.theta_names, (percent(float(v)) for v in share)))
            rows.append(("", "", "holds the truth in", "of the steps", *(held.get(n, "") for n in names)))
    heads = ("method", "plant", "what is shaded", "until", *map(label, names))
    return f'<div class="scroll">{table("At the end", heads, rows)}</div>'


def _actuators(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Table of a helicopter's actuators: declared faulty or not, and deviation at the end."""
    rows = [
        (
            name, "sound" if one["found_s"] is None else f"faulty, found at {seconds(one['found_s'])}",
            *(f"{one[key]:+.3f} ± {one[f'{key}_off']:.3f}" for key in ("deviation", "loss", "bias")),
        )
        for name, one in found.items()
    ]  # fmt: skip
    return table("Actuators at the end", ("actuator", "", "off by", "loss", "displaced"), rows)


def _list(title: str, sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(s[0].upper() + s[1:])}</li>" for s in sentences if s)
    return f"<h3>{title}</h3><ul>{items}</ul>" if items else ""


def value(s: MethodSeries, row: int, k: int) -> str:
    """'36 % (30 to 42)' of theta k at a row."""
    return f"{100 * s.theta[row, k]:.0f} % ({100 * s.lower[row, k]:.0f} to {100 * s.upper[row, k]:.0f})"


def tints(found: Estimates) -> dict[str, tuple[str, str]]:
    """theta's name -> (colour, dash), the same for all methods. What is truly lost has the colour of faults."""
    names = list(dict.fromkeys(name for s in found.series for name in s.theta_names))
    number = {name: k for k, name in enumerate(names, start=1)}
    bad = [number[name] for name, (_, values) in (found.truth or {}).items() if name in number and values.any()]
    looks = colours.chosen(number.values(), sorted(set(bad)))
    return {name: looks[k] for name, k in number.items()}


def figure(found: Estimates, path: str | os.PathLike | None = None) -> Any:
    """The losses of every method as a matplotlib figure; written to `path` when given."""
    series: Sequence[MethodSeries] = found.series
    picture = optional.library("matplotlib.figure", "A picture").Figure(figsize=(9.0, 1.0 + 2.1 * len(series)), layout="constrained")
    axes = picture.subplots(len(series), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    looks = tints(found)
    for ax, s in zip(axes, series):
        true, gaps = found.true(s), np.diff(s.hop, prepend=s.hop[:1]) != 0
        for k, name in enumerate(s.theta_names):
            tint, dash = looks[name]
            middle, low, high = (100.0 * np.where(gaps, np.nan, v[:, k]) for v in (s.theta, s.lower, s.upper))
            ax.fill_between(s.time, low, high, color=tint, alpha=0.18, lw=0)
            ax.plot(s.time, middle, color=tint, ls=DASHES[dash], lw=1.2, label=label(name))
            if true is not None and (true[:, k] != 0.0).any():
                ax.plot(s.time, 100.0 * np.where(gaps, np.nan, true[:, k]), color="0.2", ls="--", lw=1.6, label=f"{label(name)}, truth")
        ax.axhline(0.0, color="0.6", lw=0.6, zorder=0)
        ax.set_title(f"{s.title} ({s.says})", fontsize="small", loc="left")
        ax.set(ylabel=axis(s), ylim=limits(series, found.truth))
    axes[0].legend(frameon=False, fontsize="x-small", ncols=4, loc="upper left")
    axes[-1].set_xlabel("time [s]")
    if path is not None:
        with files.replacing(path) as unfinished:
            picture.savefig(unfinished, metadata={"Date": None} if Path(path).suffix.lower() == ".svg" else None)
    return picture
