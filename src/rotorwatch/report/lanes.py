"""Lanes on the plots' time axis (Bokeh): flight modes and messages of the autopilot, altitude and speed, battery, vibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.flight.diagnosis import Diagnosis, Trace
from rotorwatch.report.axes import blank, hover, stacked
from rotorwatch.report.colours import INK
from rotorwatch.report.thinning import Screen, airborne, windows

SHADES = ("#56b4e9", "#009e73", "#9467bd", "#0072b2", "#8c8c8c", "#6aa84f")
MARKS = 400  # at most, of messages
HEIGHTS = {"armed": 0.2, "landed": 0.35, "event": 0.5, "text": 0.65, "dropout": 0.8, "error": 0.9}
OVERVIEW, DETAIL = 500, 500  # rows; slow quantities need fewer than the estimates
LINE = "#2b83ba"
# name: what it is, in the sentence on what is not logged; label of the axis; the lines: (name, colour, dash).
ONE = (("", LINE, "solid"),)
LANES: dict[str, tuple[str, str, tuple[tuple[str, str, str], ...]]] = {
    "altitude": ("altitude", "altitude [m]", ONE),
    "ground_speed": ("ground speed", "speed [m/s]", ONE),
    "voltage": ("battery voltage", "battery [V]", ONE),
    "current": ("battery current", "current [A]", ONE),
    "vibration": (
        "vibration (it needs an accelerometer at 20 Hz or more)", "vibration [m/s²]",
        (("x", LINE, "solid"), ("y", "#009e73", "dashed"), ("z", "#9467bd", "dotted")),
    ),
}  # fmt: skip
ALOFT = ("altitude", "ground_speed", "vibration")
"""Lanes whose axes are scaled to airborne time: on the ground and after an impact estimates diverge."""
FROM_ZERO = ("ground_speed", "current", "vibration")
LEAST_SPAN = {"altitude": 2.0, "ground_speed": 2.0, "voltage": 1.0, "current": 2.0, "vibration": 1.0}
"""Least span of an axis, so that a calm flight looks calm."""
PEAK, USUAL = 3.0, 0.995
"""Peaks are shown up to PEAK times the quantile USUAL of the values."""


def messages(diagnosis: Diagnosis, x_range) -> Any:
    """Flight modes and messages of the autopilot; None when the log holds neither."""
    from bokeh.models import ColumnDataSource, Range1d

    trace = diagnosis.trace
    if trace is None or not trace.messages:
        return None
    p = blank(x_range, 120, "", [("", "@text")], y_range=Range1d(start=0.0, end=1.7))
    p.name = "lane"
    p.yaxis.visible = False
    p.ygrid.visible = False
    drawn = _bands(p, trace, 1.1, 1.6)
    rest = [row for row in trace.messages if row[1] in HEIGHTS]
    rest = sorted(rest, key=lambda row: (row[1] != "error", row[1] == "text"))[:MARKS]
    marks = ColumnDataSource(
        {
            "time": [t for t, _, _ in rest],
            "y": [HEIGHTS[kind] for _, kind, _ in rest],
            "text": [f"{t:.1f} s, {kind}: {text}" for t, kind, text in rest],
            "fill": ["#c1121f" if kind == "error" else INK for _, kind, _ in rest],
        }
    )
    symbols = p.scatter("time", "y", source=marks, size=7, marker="diamond", color="fill", alpha=0.9, name="messages")
    hover(p, drawn, symbols, mode="mouse", tooltips=[("", "@text")])
    return p


def modes(trace: Trace) -> list[tuple[float, float, str]]:
    """(start, end, name) of each flight mode that the vehicle was in."""
    end = float(trace.time[-1])
    entered = [(t, text) for t, kind, text in trace.messages if kind == "mode"]
    return [(a, b, text) for (a, text), (b, _) in zip(entered, [*entered[1:], (end, "")]) if b > a]


def _bands(p, trace: Trace, low: float, high: float) -> Any:
    """Flight modes as coloured bands with their names, between two heights of a plot."""
    from bokeh.models import ColumnDataSource

    spans, end = modes(trace), float(trace.time[-1])
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
    drawn = p.quad("left", "right", high, low, source=boxes, name="modes", **fill)
    look: dict[str, Any] = dict(text_font={"value": "system-ui, sans-serif"}, text_font_size="12px", text_color=INK)
    middle = 0.5 * (low + high)
    p.text("left", middle, "name", source=boxes, name="mode names", text_baseline="middle", x_offset=4, **look)
    return drawn


def logged(trace: Trace) -> dict[str, np.ndarray]:
    """Lane -> its lines (T, k), of those that the log holds: altitude [m], ground_speed [m/s], voltage [V], current [A],
    vibration [m/s^2]."""
    found = {"vibration": trace.vibration}
    if trace.position is not None:
        found["altitude"] = -trace.position[:, 2:]
    if trace.ground_speed is not None:
        found["ground_speed"] = trace.ground_speed[:, None]
    if trace.battery is not None:
        found |= {"voltage": trace.battery[:, :1], "current": trace.battery[:, 1:]}
    return {k: v for k in LANES if (v := found.get(k)) is not None and np.isfinite(v).any()}


def context(diagnosis: Diagnosis, x_range) -> dict[str, Any]:
    """Bokeh figures by name, one below the other on one time axis: those of LANES that the log holds, and modes. Empty without a trace."""
    from bokeh.models import ColumnDataSource

    trace = diagnosis.trace
    if trace is None or trace.time.size < 2:
        return {}
    found, screen = logged(trace), Screen(trace.time, windows(diagnosis), OVERVIEW, DETAIL)
    data: dict[str, Any] = {"time": screen.time.astype(np.float32)}
    for name, values in found.items():
        for (part, *_), column in zip(LANES[name][2], values.T):
            data[f"{name}{part}"] = screen.line(column)
    source = ColumnDataSource(data)
    last = "modes" if modes(trace) else next(reversed(found), "")
    flying = airborne(trace)
    out = {}
    for name, values in found.items():
        aloft = values[flying] if name in ALOFT else values
        room = aloft if np.isfinite(aloft).any() else values
        out[name] = _lane(name, room, source, x_range, name == last)
    return out | ({"modes": _modes(trace, x_range)} if last == "modes" else {})


def _range(values: np.ndarray) -> tuple[float, float]:
    """Range of an axis for these values, without peaks that would flatten the rest, as at an impact."""
    seen = values[np.isfinite(values)]
    low, high, usual = float(seen.min()), float(seen.max()), float(np.quantile(seen, USUAL))
    return low, min(high, low + PEAK * max(usual - low, 1e-9))


def _lane(name: str, values: np.ndarray, source, x_range, last: bool) -> Any:
    """Plot of one lane. values: those that the axis is scaled to."""
    from bokeh.models import Legend, LegendItem, Range1d

    _, label, lines = LANES[name]
    unit = label.partition("[")[2].rstrip("]")
    low, high = _range(values)
    low = 0.0 if name in FROM_ZERO else low
    room = 0.06 * (high - low) + max(0.0, 0.5 * (LEAST_SPAN[name] - (high - low)))
    top = 1.3 * high if len(lines) > 1 else high  # room for the legend
    y_range = Range1d(start=low if name in FROM_ZERO else low - room, end=top + room)
    p = stacked(name, last, x_range, label, [(part, f"@{name}{part}{{0.0}} {unit}") for part, *_ in lines], y_range=y_range)
    drawn = []
    for part, tint, dash in lines:
        look: dict[str, Any] = dict(color=tint, line_dash=dash, line_width=1.6, name=part or name)
        drawn.append(p.line("time", f"{name}{part}", source=source, **look))
    if len(lines) > 1:
        items = [LegendItem(label=part, renderers=[line]) for (part, *_), line in zip(lines, drawn)]
        legend = Legend(items=items, location="top_left", orientation="horizontal", click_policy="hide")
        legend.update(background_fill_alpha=0.0, border_line_color=None, padding=2, label_height=14, glyph_height=14)
        legend.update(label_text_color=INK, label_text_font_size="11px", label_text_font="system-ui, sans-serif")
        p.add_layout(legend)
    hover(p, drawn[0])
    return p


def _modes(trace: Trace, x_range) -> Any:
    """The flight modes alone."""
    from bokeh.models import Range1d

    p = stacked("modes", True, x_range, "mode", [], y_range=Range1d(start=0.0, end=1.0))
    p.height, p.ygrid.visible = 84, False
    p.yaxis.ticker = []
    hover(p, _bands(p, trace, 0.12, 0.88), mode="mouse", tooltips=[("", "@text")])
    return p


def absent(trace: Trace) -> list[str]:
    """Names of the track, lanes and flight modes that the log does not hold."""
    found = logged(trace)
    out = [] if has_track(trace) else ["position"]
    out += [text for name, (text, *_) in LANES.items() if name not in found]
    return out if modes(trace) else [*out, "flight modes"]


def has_track(trace: Trace) -> bool:
    """True if the log has at least two positions over ground."""
    return trace.position is not None and bool(np.isfinite(trace.position[:, :2]).all(axis=1).sum() > 1)


def summary(trace: Trace) -> dict[str, str]:
    """Name -> words: ends and extremes of the lanes in airborne time."""
    flying, found = airborne(trace), logged(trace)
    seen = {name: v[flying & np.isfinite(v).all(axis=1)] for name, v in found.items()}
    seen = {name: values for name, values in seen.items() if len(values)}
    out: dict[str, str] = {}
    if "altitude" in seen:
        out["highest above the lift-off"] = f"{float(seen['altitude'].max()):.1f} m"
    if "ground_speed" in seen:
        out["fastest over ground"] = f"{float(seen['ground_speed'].max()):.1f} m/s"
    if "voltage" in seen:
        first, last, least = (float(v) for v in (seen["voltage"][0, 0], seen["voltage"][-1, 0], seen["voltage"].min()))
        steady = max(first, last) - least < 0.1
        out["battery"] = f"{first:.1f} V" if steady else f"{first:.1f} V at lift-off, {last:.1f} V at the end, never below {least:.1f} V"
    if "current" in seen:
        out["current"] = f"{float(seen['current'].mean()):.1f} A on average, up to {float(seen['current'].max()):.1f} A"
    if "vibration" in seen:
        usual = ", ".join(f"{axis} {float(np.median(column)):.2g}" for axis, column in zip("xyz", seen["vibration"].T))
        out["usual vibration"] = f"{usual} m/s²"
    return out
