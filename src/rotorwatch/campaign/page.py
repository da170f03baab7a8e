"""A campaign as one self-contained page: what the summary says, drawn. Bokeh's scripts are inside the file."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from rotorwatch import __version__
from rotorwatch.campaign.summary import DRAWN, cell
from rotorwatch.report.colours import PALETTE as COLOURS

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:84rem;margin:2rem auto;padding:0 1rem;color:#222;background:#fff}
table{border-collapse:collapse;font-size:.85rem;margin:1rem 0}td,th{padding:.15rem .6rem;text-align:right;border-bottom:1px solid #ddd}
td:first-child,th:first-child{text-align:left}.pictures{display:flex;flex-wrap:wrap;gap:1rem}h2{margin-top:2rem}"""
COLUMNS = {
    "flights": "flights",
    "false_alarms_h": "false alarms/h",
    "sure_false_alarms_h": "of these sure",
    "detected": "detected",
    "right": "right rotor",
    "delay_s": "delay, s",
    "delay_ratio": "times the bound",
    "loss_rmse": "loss RMSE",
    "rmse_ratio": "times the bound",
    "typical_ratio": "typically",
    "coverage": "coverage",
}
TITLES = {
    "all": "All flights",
    "frame": "By frame",
    "profile": "By logging profile",
    "wind": "By wind",
}
GROUPED: dict[str, tuple[str, str, str, Callable, bool]] = {
    "roc": (
        "detected within 2 s",
        "false alarms per healthy hour (first of a flight)",
        "share of clear faults",
        lambda point: (point["false_alarms_h"], point["detected_2s"]),
        False,
    ),
    "delay_curve": (
        "detected within a time",
        "seconds after the onset",
        "share of clear faults",
        lambda point: (point["delay_s"], point["detected"]),
        False,
    ),
    "loss_error": (
        "error of announced losses",
        "true loss",
        "root mean square error",
        lambda point: ((point["low"] * point["high"]) ** 0.5, point["rmse"]),
        True,
    ),
}
"""What is drawn of each group: title, axes, a point's place, whether y is logarithmic."""
SIZE = {"width": 430, "height": 340, "toolbar_location": "above", "tools": "pan,wheel_zoom,reset,save"}


def write(summary: dict[str, Any], path: str | os.PathLike) -> None:
    """Write the page."""
    from bokeh.embed import components
    from bokeh.resources import INLINE

    methods = summary["methods"]
    shown = _of_all(methods)
    for name, found in methods.items():
        shown |= _of_groups(name, found)
    pictures = {key: figure for key, figure in shown.items() if figure is not None}
    script, divs = components(pictures) if pictures else ("", {})
    grouped = {kind: [key for key in divs if key.startswith(f"{kind}|")] for kind in ("all", *DRAWN)}
    title = escape(summary["name"] or "campaign")
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>',
        INLINE.render(),
        f"<h1>{title}</h1><p>{summary['flights']} flights, {summary['healthy_h']:.1f} healthy hours judged; in brackets 95 % intervals. ",
        f"rotorwatch {__version__}.</p>",
        *(_pictures(TITLES[kind], [divs[key] for key in keys]) for kind, keys in grouped.items() if keys),
        *(_table(name, found) for name, found in methods.items()),
        script,
        "</html>",
    ]
    Path(path).write_text("\n".join(parts), encoding="utf-8")


def _pictures(title: str, divs: list[str]) -> str:
    return f'<h2>{title}</h2><div class="pictures">{"".join(divs)}</div>'


def _of_all(methods: dict) -> dict[str, Any]:
    """Key -> figure: all methods beside each other, and the errors of those that estimate losses."""
    found = {"all|roc": _roc(methods), "all|delays": _delays(methods)}
    for name, m in methods.items():
        if any(point["rmse"] for point in m["loss_error"]):
            found[f"all|{name}"] = _errors(name, m)
    return found


def _of_groups(name: str, found: dict) -> dict[str, Any]:
    """Key -> figure: ROC, delays and errors of one method for each frame, profile and wind. Nothing for one that has no statistic, or
    where a group is the only one."""
    shown = {}
    for kind in DRAWN:
        groups = found["curves"][kind]
        if found["roc"] and len(groups) > 1:
            for what, (title, x, y, points, log_y) in GROUPED.items():
                shown[f"{kind}|{name}|{what}"] = _lines(f"{name}: {title}", x, y, groups, what, points, log_y)
    return shown


def _lines(title: str, x: str, y: str, groups: dict, what: str, points: Callable, log_y: bool) -> Any:
    """A line per group; None where no group has a point."""
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    ends = {} if log_y else {"y_range": Range1d(start=0, end=1.02)}
    p = figure(title=title, x_axis_type="log", y_axis_type="log" if log_y else "linear", **ends, **SIZE)
    p.xaxis.axis_label, p.yaxis.axis_label = x, y
    some = False
    for colour, (label, curves) in zip(itertools.cycle(COLOURS), groups.items()):
        pairs = [pair for pair in map(points, curves[what]) if pair[0] > 0.0]
        if pairs:
            some = True
            p.line(*zip(*pairs, strict=True), color=colour, line_width=2, legend_label=label)
            p.scatter(*zip(*pairs, strict=True), color=colour, size=4, legend_label=label)
    if some:
        p.legend.click_policy = "hide"
        p.legend.location = "top_left" if what == "delay_curve" else "bottom_right"
    return p if some else None


def _table(name: str, found: dict) -> str:
    rows = [("all", found["overall"])]
    rows += [(f"{kind}: {label}", m) for kind, groups in found["groups"].items() for label, m in groups.items()]
    head = "".join(f"<th>{escape(text)}</th>" for text in ("", *COLUMNS.values()))
    body = "".join(
        f"<tr><td>{escape(label)}</td>"
        + "".join(f"<td>{escape(str(m[k]) if k == 'flights' else cell(k, m[k]))}</td>" for k in COLUMNS)
        + "</tr>"
        for label, m in rows
    )
    return f"<h2>{escape(name)}</h2><table><tr>{head}</tr>{body}</table>"


def _roc(methods: dict) -> Any:
    """Share detected against false alarms per hour, threshold by threshold; a cross where the threshold is. Rules: a diamond."""
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    if not any(m["roc"] for m in methods.values()):
        return None
    p = figure(
        title="Detected within 2 s (solid), 10 s (dashed)",
        x_axis_type="log",
        y_range=Range1d(start=0, end=1.02),
        **SIZE,
    )
    p.xaxis.axis_label, p.yaxis.axis_label = (
        "false alarms per healthy hour (first of a flight)",
        "share of clear faults",
    )
    for colour, (name, m) in zip(itertools.cycle(COLOURS), methods.items()):
        points = [q for q in m["roc"] if q["false_alarms_h"] and q["false_alarms_h"]["value"] > 0 and q["detected_2s"]]
        if not points:
            _rule(p, name, m["overall"], colour)
            continue
        x = [q["false_alarms_h"]["value"] for q in points]
        for key, dash in (("detected_2s", "solid"), ("detected_10s", "dashed")):
            p.line(x, [q[key]["value"] for q in points], color=colour, line_dash=dash, line_width=2, legend_label=name)
        band = [[q["detected_2s"][edge] for q in points] for edge in ("low", "high")]
        p.varea(x, *band, fill_color=colour, fill_alpha=0.15)
        at = [q for q in points if q["threshold"] == 0.0]
        p.scatter([q["false_alarms_h"]["value"] for q in at], [q["detected_2s"]["value"] for q in at], marker="x", size=14,
                  color=colour, line_width=3)  # fmt: skip
    p.legend.location, p.legend.click_policy = "bottom_right", "hide"
    return p


def _rule(p: Any, name: str, overall: dict, colour: str) -> None:
    """A method without a statistic is one point: a diamond, on its interval's upper end where it gave no false alarm."""
    rate, found = overall["false_alarms_h"], overall["detected"]
    if rate and found:
        x = rate["value"] if rate["n"] else rate["high"]
        p.scatter([x], [found["value"]], marker="diamond", size=12, color=colour, legend_label=name)


def _delays(methods: dict) -> Any:
    """Share detected within a time, and the best that is possible."""
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    p = figure(
        title="Detected within a time; dashed: the bound", x_axis_type="log", y_range=Range1d(start=0, end=1.02), **SIZE
    )
    p.xaxis.axis_label, p.yaxis.axis_label = "seconds after the onset", "share of clear faults"
    some = False
    for colour, (name, m) in zip(itertools.cycle(COLOURS), methods.items()):
        points = [q for q in m["delay_curve"] if q["detected"]]
        some |= bool(points)
        x = [q["delay_s"] for q in points]
        p.line(x, [q["detected"]["value"] for q in points], color=colour, line_width=2, legend_label=name)
        p.varea(x, *[[q["detected"][e] for q in points] for e in ("low", "high")], fill_color=colour, fill_alpha=0.15)
        p.line(x, [q["bound"]["value"] for q in points], color="#555555", line_dash="dashed", legend_label="bound")
    p.legend.location, p.legend.click_policy = "top_left", "hide"
    return p if some else None


def _errors(name: str, m: dict) -> Any:
    """RMS error of announced losses against their size, and the bound."""
    from bokeh.plotting import figure

    points = [q for q in m["loss_error"] if q["rmse"]]
    x = [(q["low"] * q["high"]) ** 0.5 for q in points]
    p = figure(title=f"{name}: error of announced losses", x_axis_type="log", y_axis_type="log", **SIZE)
    p.xaxis.axis_label, p.yaxis.axis_label = "true loss", "root mean square error"
    for key, colour, dash, label in (
        ("rmse", COLOURS[0], "solid", "achieved"),
        ("bound_rmse", "#555555", "dashed", "Cramer-Rao bound"),
    ):
        p.line(x, [q[key]["value"] for q in points], color=colour, line_dash=dash, line_width=2, legend_label=label)
        p.segment(x, [q[key]["low"] for q in points], x, [q[key]["high"] for q in points], color=colour, line_width=2)
    p.legend.location = "bottom_right"
    return p
