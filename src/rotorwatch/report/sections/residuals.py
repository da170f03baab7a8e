"""Residuals of the motion over the flight."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.axes import flight_range, hover, stacked
from rotorwatch.report.figures import CHANNELS, Series, assessed

name, title, order = "residuals", "Residuals", 160
views = ("page",)
data = assessed


def words(data: Diagnosis) -> list[str]:
    return [
        "The motion that the commands do not explain, with the ±2 sd band of a healthy aircraft; "
        "in units of the hover thrust (torques: times the arm)."
    ]


def plot(data: Diagnosis) -> dict[str, Any]:
    """roll, pitch, yaw, thrust: residuals, in hover thrusts of one rotor."""
    series = Series(data)
    for i, channel in enumerate(CHANNELS):
        series.line(channel, series.trace.residual[:, i])
        band = 2 * series.trace.residual_sd[:, i]
        series.edges(f"{channel}_bottom", f"{channel}_band", -band, band)
    source, x_range = series.source(), flight_range(data)
    return {channel: _residual(series, source, x_range, channel, i) for i, channel in enumerate(CHANNELS)}


def _residual(series: Series, source, x_range, name: str, channel: int) -> Any:
    from bokeh.models import Range1d

    tips = [(name, f"@{name}{{0.0000}}"), ("2 sd", f"@{name}_band{{0.0000}}")]
    values = np.abs(series.trace.residual[series.flying, channel])
    band = 2 * series.trace.residual_sd[series.flying, channel]
    top = max(1.5 * float(np.nanquantile(values, 0.995)), 1.6 * float(np.nanmedian(band)), 1e-4) if values.size else 1.0
    p = stacked(name, name == CHANNELS[-1], x_range, name, tips, y_range=Range1d(start=-top, end=top))
    p.varea("time", f"{name}_bottom", f"{name}_band", source=source, color="#56b4e9", alpha=0.22, name="band")
    hover(p, p.line("time", name, source=source, color="#2b83ba", line_width=1.1, name="residual"))
    return p
