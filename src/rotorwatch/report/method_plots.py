"""A method's own estimates over a flight on the report's time axis (Bokeh): losses with their interval or bound shaded, states and
innovations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.report import words
from rotorwatch.report.axes import blank, hover, stacked
from rotorwatch.report.colours import INK
from rotorwatch.report.thinning import Screen

WIDEST = (-60.0, 160.0)  # % that an axis of losses shows at most: a diverging estimate must not flatten the rest
LEAST = (-10.0, 30.0)
ROWS = 1200  # of a plot: the whole flight
Truths = Mapping[str, tuple[np.ndarray, np.ndarray]]


def label(name: str) -> str:
    """Label of a theta: 'rotor 3' for loss_3, 'loss tail' for loss_tail."""
    number = name.removeprefix("loss_")
    return f"rotor {number}" if number.isdigit() else words(name)


def axis(series: MethodSeries) -> str:
    """Label of the axis of losses."""
    return "loss [%]" if all(name.startswith("loss") for name in series.theta_names) else "loss, displacement [%]"


def limits(series: Iterable[MethodSeries], truth: Truths | None = None) -> tuple[float, float]:
    """Limits of the axis of losses of these methods [%]."""
    low, high = LEAST
    for s in series:
        if len(s.theta):
            low = min(low, 100 * float(np.nanquantile(s.theta, 0.002)))
            high = max(high, 100 * float(np.nanquantile(s.theta, 0.998)))
    high = max([high, *(100 * float(values.max(initial=0.0)) for _, values in (truth or {}).values())])
    room = 0.08 * (high - low)
    return max(low - room, WIDEST[0]), min(high + room, WIDEST[1])


def drawn(
    s: MethodSeries, x_range: Any, looks: Mapping[str, tuple[str, str]], y_limits: tuple[float, float], true: np.ndarray | None = None
) -> dict[str, Any]:
    """Bokeh figures of one method by name: loss, then states x_.. and innovations e_.., one below the other on one time axis."""
    from bokeh.models import ColumnDataSource, Range1d

    screen = Screen(s.time, [], ROWS)
    apart = np.diff(s.hop, prepend=s.hop[:1]) != 0  # no line from one flight of the log to the next
    data: dict[str, Any] = {"time": screen.time}

    def put(name: str, value: np.ndarray, off: np.ndarray, scale: float = 1.0) -> None:
        value = np.where(apart, np.nan, scale * value)
        data[name] = screen.line(value)
        data[f"{name}_low"], data[f"{name}_high"] = (screen.least(value - scale * off), screen.greatest(value + scale * off))

    off, x_off, e_off = s.theta_off, s.off(s.x_var), s.off(s.innovation_var)
    for k in range(len(s.theta_names)):
        put(f"t{k}", s.theta[:, k], off[:, k], 100.0)
        if true is not None:
            data[f"true{k}"] = screen.line(np.where(apart, np.nan, 100.0 * true[:, k]))
    for k, (values, off_of) in enumerate(s.made_of.values()):
        put(f"m{k}", values, off_of)
    for k in range(len(s.x_names)):
        put(f"x{k}", s.x[:, k], x_off[:, k])
    for k in range(len(s.y_names)):
        put(f"e{k}", s.innovation[:, k], np.zeros(len(s.time)))
        data[f"e{k}_high"] = screen.greatest(np.where(apart, np.nan, e_off[:, k]))
        data[f"e{k}_low"] = -data[f"e{k}_high"]
    source = ColumnDataSource(data)
    tips = [(label(n), f"@t{k}{{0.0}} % (@t{k}_low{{0}} to @t{k}_high{{0}})") for k, n in enumerate(s.theta_names)]
    p = blank(x_range, 300, axis(s), tips, y_range=Range1d(start=y_limits[0], end=y_limits[1]))
    p.name, line = "loss", None
    for k, name in enumerate(s.theta_names):
        tint, dash = looks[name]
        named = label(name)
        p.varea("time", f"t{k}_low", f"t{k}_high", source=source, color=tint, alpha=0.16, name=named)
        line = p.line("time", f"t{k}", source=source, color=tint, line_dash=dash, line_width=1.6, name=named)
        if true is not None and (true[:, k] != 0.0).any():
            p.line("time", f"true{k}", source=source, color=INK, line_dash="dashed", line_width=2.2, name=named)
    hover(p, line)
    out: dict[str, Any] = {"loss": p}
    rows = [("m", k, words(name), "") for k, name in enumerate(s.made_of)]
    rows += [("x", k, n, u) for k, (n, u) in enumerate(zip(s.x_names, s.x_units))]
    rows += [("e", k, f"e {n}", u) for k, (n, u) in enumerate(zip(s.y_names, s.y_units))]
    for row, (kind, k, what, unit) in enumerate(rows):
        named = f"{kind}_{k}"
        tips = [(what, f"@{kind}{k}{{0.0000}} {unit}")]
        p = stacked(named, row == len(rows) - 1, x_range, f"{what} [{unit}]" if unit else what, tips)
        p.varea("time", f"{kind}{k}_low", f"{kind}{k}_high", source=source, color="#56b4e9", alpha=0.22)
        hover(p, p.line("time", f"{kind}{k}", source=source, color="#2b83ba", line_width=1.1))
        out[named] = p
    return out
