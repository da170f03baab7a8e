"""Loss of each rotor over the flight, with the autopilot's modes and messages below it."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours, lanes, markup
from rotorwatch.report.axes import blank, flight_range, hover
from rotorwatch.report.figures import Series, assessed, highest_loss

name, title, order = "losses", "Loss of each rotor over the flight", 100
views = ("page",)
data = assessed
MARKS = {"mark": "onset", "mark full": "announced", "mark end": "end", "ground": "on the ground", "blind": "blind"}


def plot(data: Diagnosis) -> dict[str, Any]:
    """loss: the estimates with their 95 % bands [%]; lane: modes and messages, where the log has them."""
    x_range = flight_range(data)
    drawn = {"loss": _loss(data, x_range), "lane": lanes.messages(data, x_range)}
    return {name: figure for name, figure in drawn.items() if figure is not None}


def _loss(diagnosis: Diagnosis, x_range) -> Any:
    from bokeh.models import Range1d

    series = Series(diagnosis)
    loss, lower, upper = (100 * v for v in (series.trace.loss, series.trace.lower, series.trace.upper))
    n = loss.shape[1]
    for k in range(n):
        series.line(f"loss{k + 1}", loss[:, k])
        series.edges(f"low{k + 1}", f"high{k + 1}", lower[:, k], upper[:, k])
    source, looks = series.source(), colours.looks(diagnosis, n)
    tips = [(f"rotor {k}", f"@loss{k}{{0.0}} % (@low{k}{{0}} to @high{k}{{0}})") for k in range(1, n + 1)]
    top = highest_loss(diagnosis)
    y_range = Range1d(start=-0.03 * top, end=top, bounds=(-10, 110))
    p = blank(x_range, 340, "loss of effectiveness [%]", tips, y_range=y_range)
    p.name = "loss"
    named = {*colours.faulty(diagnosis), *colours.suspects(diagnosis)}
    moved = {k for e in diagnosis.events for k in e.rotors}
    line = None
    for k in sorted(range(1, n + 1), key=lambda k: k in named):  # the ones that matter on top
        look: dict[str, Any] = dict(source=source, name=f"rotor {k}", level="glyph")
        (tint, dash), alpha = looks[k], 0.3 if k in moved else 0.12 if k in named else 0.07
        p.varea("time", f"low{k}", f"high{k}", color=tint, alpha=alpha, **look)
        width = 2.6 if k in named else 1.3
        line = p.line("time", f"loss{k}", color=tint, line_width=width, line_dash=dash, **look)
    hover(p, line)
    return p


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    looks = colours.looks(data)
    chips = "".join(markup.chip(f"rotor {r.rotor}", *looks[r.rotor]) for r in data.rotors)
    marks = " &ensp; ".join(f'<span class="key {name}"></span>{text}' for name, text in MARKS.items())
    return (
        f"<h2>{title}</h2><p>The estimate as a live observer would have had it, with its "
        "95 % band. Drag over a time span to zoom all plots; the arrow in a plot's corner resets it.</p>"
        f'<div class="chips" role="group" aria-label="Rotors shown">{chips}</div>'
        + "".join(markup.plot(*item) for item in divs.items())
        + f'<p class="note">{marks}</p>{_moment_form(data)}'
    )


def _moment_form(diagnosis: Diagnosis) -> str:
    """Form that sets the moment marked in all plots by keyboard and copies its address."""
    assert diagnosis.trace is not None
    first, last = float(diagnosis.trace.time[0]), float(diagnosis.trace.time[-1])
    return (
        f'<form class="at" id="at"><label for="at-time">Moment</label> <input id="at-time" type="number" inputmode="decimal" step="0.1" '
        f'min="{first:.2f}" max="{last:.2f}" aria-describedby="at-help"> s <span id="at-set" hidden>'
        '<button type="button" id="at-copy" aria-label="Copy link to this moment">Copy link</button> '
        '<button type="button" id="at-clear">Clear</button></span> '
        '<span role="status" id="at-status"></span><span class="help" id="at-help">Click in a plot or type a time: all plots mark that '
        "moment, and the address of this page leads to it.</span></form>"
    )
