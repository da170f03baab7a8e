"""A campaign's summary as one self-contained HTML page with Bokeh figures."""

from __future__ import annotations

import itertools
import os
from html import escape
from pathlib import Path
from typing import Any

from rotorwatch import __version__
from rotorwatch.report.colours import PALETTE as COLOURS
from rotorwatch_lab.campaign.summary import DRAWN, cell, lines_of

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:84rem;margin:2rem auto;padding:0 1rem;color:#222;background:#fff}
table{border-collapse:collapse;font-size:.85rem;margin:1rem 0}td,th{padding:.15rem .6rem;text-align:right;border-bottom:1px solid #ddd}
td:first-child,th:first-child{text-align:left}.pictures{display:flex;flex-wrap:wrap;gap:1rem}h2{margin-top:2rem}"""
COLUMNS = {
    "flights": "flights", "false_alarms_h": "false alarms/h", "sure_false_alarms_h": "of these sure", "accused_h": "healthy accused/h",
    "detected": "detected", "answered": "named by the answer", "right": "right rotor", "delay_s": "delay, s",
    "delay_ratio": "times the bound", "loss_rmse": "loss RMSE", "rmse_ratio": "times the bound", "typical_ratio": "typically",
    "coverage": "coverage",
}  # fmt: skip
TITLES = {"all": "All flights", "frame": "By frame", "profile": "By logging profile", "wind": "By wind",
          "induced velocity": "By velocity of the air through the rotors in hover"}  # fmt: skip
AXES = {
    "roc": ("false alarms per healthy hour (first of a flight)", "share of clear faults"),
    "delay_curve": ("seconds after the onset", "share of clear faults"),
    "loss_error": ("true loss", "root mean square error"),
}
GROUPED = {
    "roc": ("detected within 2 s", "false_alarms_h", "detected_2s"),
    "delay_curve": ("detected within a time", "delay_s", "detected"),
    "loss_error": ("error of announced losses", "size", "rmse"),
}
"""What is drawn of each group: title, and what of a point is x and y."""
SIZE = {"width": 430, "height": 340, "toolbar_location": "above", "tools": "pan,wheel_zoom,reset,save"}
GREY = "#555555"


def write(summary: dict[str, Any], path: str | os.PathLike) -> None:
    """Write the page."""
    from bokeh.embed import components
    from bokeh.resources import INLINE

    methods = summary["methods"]
    pictures = {"all|roc": _roc(methods), "all|delays": _delays(methods)}
    pictures |= {f"all|{name}": _errors(name, m["loss_error"]) for name, m in methods.items()}
    for name, results in methods.items():
        for kind, groups in results["curves"].items():
            if results["roc"] and len(groups) > 1:  # not of a method without a statistic, nor of the only group
                pictures |= {f"{kind}|{name}|{what}": _groups(name, what, groups) for what in GROUPED}
    pictures = {key: figure for key, figure in pictures.items() if figure is not None}
    script, divs = components(pictures) if pictures else ("", {})
    grouped = {kind: [key for key in divs if key.startswith(f"{kind}|")] for kind in ("all", *DRAWN)}
    title = escape(summary["name"] or "campaign")
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>',
        INLINE.render(),
        f"<h1>{title}</h1><p>{summary['flights']} flights, {summary['healthy_h']:.1f} healthy hours assessed; in brackets 95 % intervals. ",
        f"rotorwatch {__version__}.</p>",
        *(
            f'<h2>{TITLES[kind]}</h2><div class="pictures">{"".join(divs[key] for key in keys)}</div>'
            for kind, keys in grouped.items()
            if keys
        ),
        *(_table(name, results) for name, results in methods.items()),
        script,
        "</html>",
    ]
    Path(path).write_text("\n".join(parts), encoding="utf-8")


def _table(name: str, results: dict) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in ("", *COLUMNS.values()))
    body = "".join(
        f"<tr><td>{escape(label)}</td>"
        + "".join(f"<td>{escape(str(m[k]) if k == 'flights' else cell(k, m[k]))}</td>" for k in COLUMNS)
        + "</tr>"
        for label, m in lines_of(results)
    )
    return f"<h2>{escape(name)}</h2><table><tr>{head}</tr>{body}</table>"


def _figure(title: str, what: str) -> Any:
    """Empty axes for one of AXES; shares reach from 0 to 1, errors are drawn on a logarithmic scale."""
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    log_y = what == "loss_error"
    ends = {} if log_y else {"y_range": Range1d(start=0, end=1.02)}
    p = figure(title=title, x_axis_type="log", y_axis_type="log" if log_y else "linear", **ends, **SIZE)
    p.xaxis.axis_label, p.yaxis.axis_label = AXES[what]
    return p


def _line(p: Any, x: list, points: list[dict], key: str, colour: str, label: str, dash: str = "solid") -> None:
    """A measure with an interval over x; solid lines get the interval as a band."""
    p.line(x, [q[key]["value"] for q in points], color=colour, line_dash=dash, line_width=2, legend_label=label)
    if dash == "solid":
        p.varea(x, *[[q[key][edge] for q in points] for edge in ("low", "high")], fill_color=colour, fill_alpha=0.15)


def _groups(name: str, what: str, groups: dict) -> Any:
    """A line per group of one method's flights; None where no group has a point."""
    title, x, y = GROUPED[what]
    p, drawn = _figure(f"{name}: {title}", what), False
    for colour, (label, curves) in zip(itertools.cycle(COLOURS), groups.items()):
        points = [q if x in q else {**q, x: (q["low"] * q["high"]) ** 0.5} for q in curves[what]]
        pairs = [(q[x], q[y]) for q in points if q[x] > 0.0]
        if pairs:
            drawn = True
            p.line(*zip(*pairs, strict=True), color=colour, line_width=2, legend_label=label)
            p.scatter(*zip(*pairs, strict=True), color=colour, size=4, legend_label=label)
    if drawn:
        p.legend.click_policy = "hide"
        p.legend.location = "top_left" if what == "delay_curve" else "bottom_right"
    return p if drawn else None


def _roc(methods: dict) -> Any:
    """Share detected against false alarms per hour, threshold by threshold; a cross where the threshold is. A method without a statistic
    is one point: a diamond, on its interval's upper end where it gave no false alarm."""
    if not any(m["roc"] for m in methods.values()):
        return None
    p = _figure("Detected within 2 s (solid), 10 s (dashed)", "roc")
    for colour, (name, m) in zip(itertools.cycle(COLOURS), methods.items()):
        points = [q for q in m["roc"] if q["false_alarms_h"] and q["false_alarms_h"]["value"] > 0 and q["detected_2s"]]
        x = [q["false_alarms_h"]["value"] for q in points]
        rate, detected = m["overall"]["false_alarms_h"], m["overall"]["detected"]
        if points:
            _line(p, x, points, "detected_2s", colour, name)
            _line(p, x, points, "detected_10s", colour, name, "dashed")
            at = [(here, q["detected_2s"]["value"]) for here, q in zip(x, points) if q["threshold"] == 0.0]
            p.scatter([a for a, _ in at], [b for _, b in at], marker="x", size=14, color=colour, line_width=3)
        elif rate and detected:
            alarms = rate["value"] if rate["n"] else rate["high"]
            p.scatter([alarms], [detected["value"]], marker="diamond", size=12, color=colour, legend_label=name)
    p.legend.location, p.legend.click_policy = "bottom_right", "hide"
    return p


def _delays(methods: dict) -> Any:
    """Share detected within a time, and the best that is possible."""
    p, drawn = _figure("Detected within a time; dashed: the bound", "delay_curve"), False
    for colour, (name, m) in zip(itertools.cycle(COLOURS), methods.items()):
        points = [q for q in m["delay_curve"] if q["detected"]]
        drawn |= bool(points)
        x = [q["delay_s"] for q in points]
        _line(p, x, points, "detected", colour, name)
        _line(p, x, points, "bound", GREY, "bound", "dashed")
    p.legend.location, p.legend.click_policy = "top_left", "hide"
    return p if drawn else None


def _errors(name: str, errors: list[dict]) -> Any:
    """RMS error of announced losses against their size, and the bound; None where no loss was announced."""
    points = [q for q in errors if q["rmse"]]
    if not points:
        return None
    x, p = [(q["low"] * q["high"]) ** 0.5 for q in points], _figure(f"{name}: error of announced losses", "loss_error")
    for key, colour, dash, label in (("rmse", COLOURS[0], "solid", "achieved"), ("bound_rmse", GREY, "dashed", "Cramer-Rao bound")):
        p.line(x, [q[key]["value"] for q in points], color=colour, line_dash=dash, line_width=2, legend_label=label)
        p.segment(x, [q[key]["low"] for q in points], x, [q[key]["high"] for q in points], color=colour, line_width=2)
    p.legend.location = "bottom_right"
    return p
