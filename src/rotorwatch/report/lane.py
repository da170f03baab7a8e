"""Flight modes and what the autopilot said, as a lane under the plots that shares their time axis."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rotorwatch.diagnosis import Diagnosis
from rotorwatch.report.colours import INK

SHADES = ("#56b4e9", "#009e73", "#9467bd", "#0072b2", "#8c8c8c", "#6aa84f")
MOST = 400  # marks: more are no help
HEIGHTS = {"armed": 0.2, "landed": 0.35, "event": 0.5, "text": 0.65, "dropout": 0.8, "error": 0.9}


def lane(diagnosis: Diagnosis, figure: Callable[..., Any], x_range) -> Any:
    """A Bokeh figure made by `figure(x_range, height, label, tooltips, ...)`, or None when the log holds neither modes nor messages."""
    from bokeh.models import ColumnDataSource, HoverTool, Range1d

    trace = diagnosis.trace
    if trace is None or not trace.messages:
        return None
    p = figure(x_range, 120, "", [("", "@text")], y_range=Range1d(start=0.0, end=1.7))
    p.name = "lane"
    p.yaxis.visible = False
    p.ygrid.visible = False
    end = float(trace.time[-1])
    modes = [(t, text) for t, kind, text in trace.messages if kind == "mode"]
    spans = [(a, b, text) for (a, text), (b, _) in zip(modes, [*modes[1:], (end, "")]) if b > a]
    shade = {name: SHADES[k % len(SHADES)] for k, name in enumerate(dict.fromkeys(text for _, _, text in spans))}
    boxes = ColumnDataSource(
        {
            "left": [a for a, _, _ in spans],
            "right": [b for _, b, _ in spans],
            "text": [f"{text}: {a:.1f} to {b:.1f} s" for a, b, text in spans],
            # The name is written where its box has room for it on a wide screen.
            "name": [text if (b - a) > 0.008 * len(text) * end else "" for a, b, text in spans],
            "fill": [shade[text] for _, _, text in spans],
        }
    )
    fill: dict[str, Any] = dict(fill_color="fill", fill_alpha=0.35, line_color="fill")
    drawn = p.quad("left", "right", 1.6, 1.1, source=boxes, name="modes", **fill)
    look: dict[str, Any] = dict(text_font={"value": "system-ui, sans-serif"}, text_font_size="12px", text_color=INK)
    p.text("left", 1.35, "name", source=boxes, name="mode names", text_baseline="middle", x_offset=4, **look)
    rest = [row for row in trace.messages if row[1] in HEIGHTS]
    rest = sorted(rest, key=lambda row: (row[1] != "error", row[1] == "text"))[:MOST]
    marks = ColumnDataSource(
        {
            "time": [t for t, _, _ in rest],
            "y": [HEIGHTS[kind] for _, kind, _ in rest],
            "text": [f"{t:.1f} s, {kind}: {text}" for t, kind, text in rest],
            "fill": ["#c1121f" if kind == "error" else INK for _, kind, _ in rest],
        }
    )
    said = p.scatter("time", "y", source=marks, size=7, marker="diamond", color="fill", alpha=0.9, name="messages")
    hover = p.select_one(HoverTool)
    hover.renderers, hover.mode, hover.tooltips = [drawn, said], "mouse", [("", "@text")]
    return p
