"""Evidence: log10 odds of the likeliest hypotheses against a healthy aircraft."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.flight.diagnosis import Diagnosis, Trace
from rotorwatch.report import colours
from rotorwatch.report.axes import blank, flight_range, hover
from rotorwatch.report.colours import INK
from rotorwatch.report.figures import Series, assessed, hypotheses
from rotorwatch.report.thinning import airborne

name, title, order = "evidence", "Evidence", 130
views = ("page",)
COLUMNS = 1  # of the legend: a phone is not wide enough for two


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    """None for a method without evidence over time."""
    return assessed(diagnosis) if hypotheses(diagnosis) else None


def words(data: Diagnosis) -> list[str]:
    return [
        "Odds of each explanation against a healthy aircraft, as powers of ten. The thick grey line is the threshold. "
        "Click a name to hide it."
    ]


def plot(data: Diagnosis) -> dict[str, Any]:
    series, shown = Series(data), hypotheses(data)
    for i, hypothesis in enumerate(shown):
        series.line(f"odds{i}", series.trace.evidence[hypothesis])
    looks = colours.looks(data, series.trace.loss.shape[1])
    return {"evidence": drawn(series.trace, series.source(), flight_range(data), shown, looks)}


def drawn(trace: Trace, source, x_range, shown: list[str], looks) -> Any:
    """source: columns odds0 .. of the hypotheses `shown`, the likeliest first. looks: (colour, dash) of each rotor."""
    from bokeh.models import Legend, LegendItem, Range1d, Span

    tips = [(name, f"@odds{i}{{0.0}}") for i, name in enumerate(shown)]
    seen = np.nan_to_num(np.stack([trace.evidence[name] for name in shown])[:, airborne(trace)])
    top = 1.08 * max(float(seen.max(initial=0.0)), 1.5 * abs(float(trace.threshold)), 1.0)
    low = max(1.05 * float(seen.min(initial=0.0)), -top)  # how unlikely the wrong ones are is of no interest
    p = blank(x_range, 400, "log10 odds against healthy", tips, y_range=Range1d(start=low, end=top))
    p.name = "evidence"
    lines = []
    for i, name in reversed(list(enumerate(shown))):  # the likeliest on top
        look = dict(name=f"odds {i}", line_width=2.2 if i == 0 else 1.4) | look_of(name, i, looks)
        lines.insert(0, p.line("time", f"odds{i}", source=source, **look))
    items = [LegendItem(label=name, renderers=[line]) for name, line in zip(shown, lines, strict=True)]
    hover(p, lines[0])
    p.add_layout(Span(location=float(trace.threshold), dimension="width", line_color=INK, line_width=2.2))
    legend = Legend(items=items, location="left", orientation="horizontal", ncols=COLUMNS, click_policy="hide")
    legend.update(background_fill_alpha=0.0, border_line_color=None)
    legend.update(label_text_color=INK, label_text_font_size="12px", label_text_font="system-ui, sans-serif", spacing=0)
    legend.update(padding=4, label_height=16, glyph_height=16)
    p.add_layout(legend, "above")  # over the lines it would hide them
    return p


def look_of(hypothesis: str, place: int, looks) -> dict[str, Any]:
    """Colour and dash: of the rotor for a hypothesis of one rotor, else grey, distinguished by dashes. place: of the line in the legend."""
    number = hypothesis.rpartition(" ")[2]
    if hypothesis.startswith("rotor ") and number.isdigit() and int(number) in looks:
        return dict(zip(("color", "line_dash"), looks[int(number)], strict=True))
    return dict(color=INK, line_dash=("solid", "dashed", "dotted", "dotdash")[place % 4])
