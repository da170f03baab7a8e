"""A campaign as one self-contained page: what the summary says, drawn. Bokeh's scripts are inside the file."""

from __future__ import annotations

import os
from html import escape
from pathlib import Path
from typing import Any

from rotorwatch import __version__
from rotorwatch.campaign.summary import cell
from rotorwatch.report.figures import COLOURS

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#222;background:#fff}
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
SIZE = {"width": 520, "height": 360, "toolbar_location": "above", "tools": "pan,wheel_zoom,reset,save"}


def write(summary: dict[str, Any], path: str | os.PathLike) -> None:
    """Write the page."""
    from bokeh.embed import components
    from bokeh.resources import INLINE

    methods = summary["methods"]
    pictures = [
        figure for figure in (_roc(methods), _delays(methods), *map(_errors, *_items(methods))) if figure is not None
    ]
    script, divs = components(tuple(pictures)) if pictures else ("", ())
    title = escape(summary["name"] or "campaign")
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>',
        INLINE.render(),
        f"<h1>{title}</h1><p>{summary['flights']} flights, {summary['healthy_h']:.1f} healthy hours judged; in brackets 95 % intervals. ",
        f"rotorwatch {__version__}.</p>",
        f'<div class="pictures">{"".join(divs)}</div>',
        *(_table(name, found) for name, found in methods.items()),
        script,
        "</html>",
    ]
    Path(path).write_text("\n".join(parts), encoding="utf-8")


def _items(methods: dict) -> tuple[list, list]:
    """Names and results of the methods that estimate losses."""
    found = {k: m for k, m in methods.items() if any(p["rmse"] for p in m["loss_error"])}
    return list(found), list(found.values())


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
    """Share detected against false alarms per hour, threshold by threshold; a cross where the threshold is."""
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    if not any(m["roc"] for m in methods.values()):
        return None
    p = figure(
        title="Detected within 2 s (solid), 10 s (dashed), against false alarms",
        x_axis_type="log",
        y_range=Range1d(start=0, end=1.02),
        **SIZE,
    )
    p.xaxis.axis_label, p.yaxis.axis_label = (
        "false alarms per healthy hour (first of a flight)",
        "share of clear faults",
    )
    for colour, (name, m) in zip(COLOURS, methods.items()):
        points = [q for q in m["roc"] if q["false_alarms_h"] and q["false_alarms_h"]["value"] > 0 and q["detected_2s"]]
        if not points:
            continue
        x = [q["false_alarms_h"]["value"] for q in points]
        for key, dash in (("detected_2s", "solid"), ("detected_10s", "dashed")):
            p.line(x, [q[key]["value"] for q in points], color=colour, line_dash=dash, line_width=2, legend_label=name)
        band = [[q["detected_2s"][edge] for q in points] for edge in ("low", "high")]
        p.varea(x, *band, fill_color=colour, fill_alpha=0.15)
        at = [q for q in points if q["threshold"] == 0.0]
        p.scatter([q["false_alarms_h"]["value"] for q in at], [q["detected_2s"]["value"] for q in at], marker="x", size=14,
                  color=colour, line_width=3)  # fmt: skip
    p.legend.location = "top_left"
    return p


def _delays(methods: dict) -> Any:
    """Share detected within a time, and the best that is possible."""
    from bokeh.models import Range1d
    from bokeh.plotting import figure

    p = figure(
        title="Detected within a time; dashed: the bound", x_axis_type="log", y_range=Range1d(start=0, end=1.02), **SIZE
    )
    p.xaxis.axis_label, p.yaxis.axis_label = "seconds after the onset", "share of clear faults"
    some = False
    for colour, (name, m) in zip(COLOURS, methods.items()):
        points = [q for q in m["delay_curve"] if q["detected"]]
        some |= bool(points)
        x = [q["delay_s"] for q in points]
        p.line(x, [q["detected"]["value"] for q in points], color=colour, line_width=2, legend_label=name)
        p.varea(x, *[[q["detected"][e] for q in points] for e in ("low", "high")], fill_color=colour, fill_alpha=0.15)
        p.line(x, [q["bound"]["value"] for q in points], color="#555555", line_dash="dashed", legend_label="bound")
    p.legend.location = "center_right"
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
    p.legend.location = "top_left"
    return p
