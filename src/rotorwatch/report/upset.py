"""Plots around a loss of control or a desync (Bokeh): the sequence of moments, wanted against actual attitude and rates, commands and
speeds of every rotor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours
from rotorwatch.report.axes import blank, hover, moment, words
from rotorwatch.report.colours import FAULT, INK, SUSPECT

ANGLES, RATES = ("roll", "pitch"), ("roll", "pitch", "yaw")
NAMES = (
    "moment_strip", *(f"moment_{angle}" for angle in ANGLES), *(f"moment_{axis}_rate" for axis in RATES), "moment_commands",
    "moment_speeds",
)  # fmt: skip
TINTS = {
    "lift-off": "#0072b2",
    "last good second": "#0072b2",
    "first departure": SUSPECT,
    "control lost": FAULT,
    "impact": INK,
    "control back": "#0072b2",
    "gives nothing": FAULT,
    "works again": "#0072b2",
}
HALF_TURN = 180.0
LEAST_SPAN = 20.0  # degrees that an axis shows at least, so that a calm flight looks calm


def plots(diagnosis: Diagnosis) -> dict[str, Any]:
    """Bokeh figures by name, one below the other on one time axis; empty without such a moment, or where nothing of it is logged."""
    from bokeh.models import Range1d, Span

    facts = diagnosis.picture
    if not facts or not any(facts.get(name) for name in ("attitude", "rates", "commands")):
        return {}
    start, end = facts["start_s"], facts["end_s"]
    x_range = Range1d(start=start, end=end, bounds=(start, end), min_interval=0.1)
    out = {"moment_strip": _strip(facts, x_range)}
    if facts["attitude"]:
        out |= {f"moment_{angle}": _followed(facts["attitude"], x_range, angle, "deg", "°") for angle in ANGLES}
    if facts.get("rates"):
        out |= {f"moment_{axis}_rate": _followed(facts["rates"], x_range, axis, "dps", "°/s") for axis in RATES}
    if facts["commands"]:
        share = 100.0 * np.asarray(facts["commands"]["share"], float)
        room = Range1d(start=-3.0, end=108.0)
        out["moment_commands"] = _rotors(diagnosis, facts["commands"], share, x_range, "command [%]", y_range=room)
    if facts.get("speeds"):
        rpm = np.asarray(facts["speeds"]["rpm"], float) / 1000.0
        out["moment_speeds"] = _rotors(diagnosis, facts["speeds"], rpm, x_range, "speed [1000/min]")
    at = moment()
    for name, figure in out.items():
        figure.name = name
        figure.add_layout(at)
        figure.xaxis.visible = name == list(out)[-1]
        for mark in facts["marks"] if name != "moment_strip" else ():
            tint, dash = TINTS.get(mark["what"], INK), "dashed" if mark["what"] == "last good second" else "solid"
            look: dict[str, Any] = dict(line_color=tint, line_dash=dash, line_width=1.6, dimension="height")
            figure.add_layout(Span(location=mark["time_s"], **look))
    return out


def _strip(facts: Mapping[str, Any], x_range) -> Any:
    """Coloured stretches from each moment to the next, and their names with their times, one above the other."""
    from bokeh.models import ColumnDataSource, Label, Range1d

    marks = facts["marks"]
    top = 1.0 + len(marks)
    p = blank(x_range, 30 + 20 * len(marks), "", [("", "@what")], y_range=Range1d(start=0.0, end=top))
    p.yaxis.visible = False
    p.ygrid.visible = False
    ends = [m["time_s"] for m in marks[1:]] + [facts["end_s"]]
    source = ColumnDataSource(
        {
            "left": [m["time_s"] for m in marks], "right": ends, "what": [f"{m['what']}: {report.seconds(m['time_s'])}" for m in marks],
            "tint": [TINTS.get(m["what"], INK) for m in marks],
        }
    )  # fmt: skip
    look: dict[str, Any] = dict(fill_color="tint", line_color=None, fill_alpha=0.85)
    boxes = p.quad("left", "right", 0.9, 0.1, source=source, name="stretches", **look)
    p.segment("left", 0.1, "left", top, source=source, line_color="tint", line_width=1.6)
    middle = 0.5 * (facts["start_s"] + facts["end_s"])
    for k, text in enumerate(source.data["what"]):
        at = marks[k]["time_s"]
        align, offset = ("left", 5) if at < middle else ("right", -5)
        label = Label(x=at, y=top - 0.55 - k, text=text, text_align=align, x_offset=offset, **words("13px"))
        p.add_layout(label)
    hover(p, boxes, mode="mouse", tooltips=[("", "@what")])
    return p


def _followed(facts: Mapping[str, Any], x_range, axis: str, key: str, unit: str) -> Any:
    """Wanted against actual attitude or rate, one axis."""
    from bokeh.models import ColumnDataSource, Range1d

    have = {"actual": facts[f"{axis}_{key}"], "wanted": facts[f"wanted_{axis}_{key}"]}
    known = {name: np.asarray(values, float) for name, values in have.items() if values is not None}
    data = {name: _unbroken(values) if key == "deg" else values for name, values in known.items()}
    source = ColumnDataSource({"time": np.asarray(facts["time_s"], float), **data})
    p = blank(x_range, 150, f"{axis} [{unit}]", [(name, f"@{name}{{0.0}}{unit}") for name in data])
    p.yaxis.ticker.desired_num_ticks = 4
    seen = np.concatenate([v[np.isfinite(v)] for v in data.values()])
    low, high = (float(seen.min()), float(seen.max())) if seen.size else (0.0, 0.0)
    room = 0.08 * (high - low) + max(0.0, 0.5 * (LEAST_SPAN - (high - low)))
    p.y_range = Range1d(start=low - room, end=high + room)
    style: dict[str, dict[str, Any]] = {
        "actual": dict(color="#2b83ba", line_width=2.2),
        "wanted": dict(color=INK, line_width=1.8, line_dash="dashed"),
    }
    lines = [p.line("time", name, source=source, name=name, **style[name]) for name in data]
    hover(p, *lines[:1])
    return p


def _unbroken(degrees) -> np.ndarray:
    """Degrees with a gap in place of a jump across 360."""
    values = np.asarray(degrees, float).copy()
    values[1:][np.abs(np.diff(values)) > HALF_TURN] = np.nan
    return values


def _rotors(diagnosis: Diagnosis, series: Mapping[str, Any], values: np.ndarray, x_range, label: str, **more) -> Any:
    """A line of `values` (n, samples) for every rotor, the accused ones thick and on top."""
    from bokeh.models import ColumnDataSource

    accused = diagnosis.picture["accused"] if diagnosis.picture else ()
    looks = colours.looks(diagnosis, len(values))
    numbers = range(1, len(values) + 1)
    source = ColumnDataSource({"time": np.asarray(series["time_s"], float), **{f"rotor{k}": values[k - 1] for k in numbers}})
    tips = [(f"rotor {k}", f"@rotor{k}{{0.0}}") for k in numbers]
    p = blank(x_range, 230, label, tips, **more)
    lines = []
    for k in sorted(numbers, key=lambda k: k in accused):
        look: dict[str, Any] = dict(name=f"rotor {k}", color=looks[k][0], line_dash=looks[k][1])
        width = 4.0 if k in accused else 1.6
        lines.append(p.step("time", f"rotor{k}", source=source, mode="after", line_width=width, **look))
    hover(p, *lines[:1])
    return p
