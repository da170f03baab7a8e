"""Motor commands over the flight."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours
from rotorwatch.report.axes import blank, flight_range, hover
from rotorwatch.report.figures import Series, assessed

name, title, order = "commands", "Motor commands", 120
views = ("page",)
data = assessed


def words(data: Diagnosis) -> list[str]:
    return ["The autopilot's command of each rotor; a weak rotor gets a higher one."]


def plot(data: Diagnosis) -> dict[str, Any]:
    """command: shares of full thrust [%]."""
    series = Series(data)
    n = series.trace.command.shape[1]
    for k in range(n):
        series.line(f"command{k + 1}", 100 * series.trace.command[:, k], on_ground=True)
    source, looks = series.source(), colours.looks(data, n)
    tips = [(f"rotor {k}", f"@command{k}{{0.0}} %") for k in range(1, n + 1)]
    p = blank(flight_range(data), 250, "command [% of full thrust]", tips)
    p.name = "command"
    lines = []
    for k in range(1, n + 1):
        look: dict[str, Any] = dict(name=f"rotor {k}", color=looks[k][0], line_width=1.3, line_dash=looks[k][1])
        lines.append(p.line("time", f"command{k}", source=source, **look))
    hover(p, lines[0])
    return {"command": p}
