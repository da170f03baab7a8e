"""The report's interactive time plots (Bokeh): series thinned to a screen, and what all plots over the flight share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis, Trace
from rotorwatch.report import colours, sections
from rotorwatch.report.axes import FLIGHT, hover, moment, stacked, words
from rotorwatch.report.colours import INK
from rotorwatch.report.thinning import Screen, airborne, windows, within

CHANNELS = ("roll", "pitch", "yaw", "thrust")
ANGLES = ("roll", "pitch", "yaw")
HYPOTHESES = 8


def plots(diagnosis: Diagnosis) -> dict[str, Any]:
    """Bokeh figures of all sections by name, such as loss, command, roll, altitude, moment_strip.

    Losses and commands in percent, residuals in units of hover thrust, evidence in log10 odds; see the sections.
    """
    return drawn(diagnosis, sections.shown(diagnosis, "page"))


def drawn(diagnosis: Diagnosis, shown: Iterable[sections.Shown]) -> dict[str, Any]:
    """Draw the figures of these sections, and link those over the flight. A name that is taken gets its section's in front."""
    out: dict[str, Any] = {}
    for one in shown:
        one.draw()
        one.figures = {f"{one.section.name}_{k}" if k in out else k: figure for k, figure in one.figures.items()}
        out |= one.figures
    _link(diagnosis, [figure for figure in out.values() if figure.x_range.name == FLIGHT])
    return out


def _link(diagnosis: Diagnosis, over_flight: list[Any]) -> None:
    """One time axis, crosshair and mark of a moment for all these figures; in each the ground, blind times and events."""
    from bokeh.models import CrosshairTool, Span

    if not over_flight or diagnosis.trace is None:
        return
    cross = CrosshairTool(dimensions="height", overlay=Span(dimension="height", line_color=INK, line_dash="dotted"))
    shared = [moment(), *_shades(diagnosis.trace), *_marks(diagnosis)]
    for figure in over_flight:
        figure.x_range = over_flight[0].x_range
        figure.add_tools(cross)
        for annotation in shared:
            figure.add_layout(annotation)
        if figure.name == "loss":
            _name_events(figure, diagnosis)


def assessed(diagnosis: Diagnosis) -> Diagnosis | None:
    """The diagnosis if it has a trace to draw: `data` of the sections with plots over the flight."""
    return diagnosis if diagnosis.trace is not None and diagnosis.trace.time.size > 1 else None


class Series:
    """Columns of a plot's source, thinned to what a screen can show. data: name -> values, "time" [s] among them."""

    def __init__(self, diagnosis: Diagnosis):
        """diagnosis: with a trace."""
        assert diagnosis.trace is not None
        self.trace, self.flying = diagnosis.trace, airborne(diagnosis.trace)
        self._screen = Screen(self.trace.time, windows(diagnosis))
        self.data: dict[str, Any] = {"time": self._screen.time.astype(np.float32)}

    def line(self, name: str, values: np.ndarray, on_ground: bool = False) -> None:
        """values (T,); on_ground: also where nothing is airborne."""
        self.data[name] = self._screen.line(values if on_ground else self._in_flight(values))

    def edges(self, low: str, high: str, least: np.ndarray, greatest: np.ndarray) -> None:
        """Lower and upper edge of a band, each (T,)."""
        self.data[low] = self._screen.least(self._in_flight(least))
        self.data[high] = self._screen.greatest(self._in_flight(greatest))

    def _in_flight(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.flying, values, np.nan)

    def source(self) -> Any:
        """The columns for Bokeh."""
        from bokeh.models import ColumnDataSource

        return ColumnDataSource(self.data)


def hypotheses(diagnosis: Diagnosis) -> list[str]:
    """Hypotheses with the highest peaks of evidence, at most HYPOTHESES."""
    evidence = diagnosis.trace.evidence if diagnosis.trace is not None else {}
    peak = {name: float(np.max(odds, initial=-np.inf, where=np.isfinite(odds))) for name, odds in evidence.items()}
    return sorted(peak, key=lambda name: (-peak[name], name))[:HYPOTHESES]


def highest_loss(diagnosis: Diagnosis) -> float:
    """Upper end of the loss axis [%]: room for everything that was found, closer for small losses."""
    trace = diagnosis.trace
    assert trace is not None
    flying = airborne(trace)
    blind = within(trace.time, [(start, end) for start, end, _ in trace.blind])
    seen = trace.loss[flying & ~blind]
    high = [0.12, *(i[1] for e in diagnosis.events for i in e.interval), *(r.loss for r in diagnosis.rotors)]
    if seen.size:
        high.append(float(np.quantile(np.nan_to_num(seen).max(axis=1), 0.999)))
    return min(105.0, 125 * max(high))


def followed(series: Series, x_range, kind: str, unit: str, pairs: dict[str, np.ndarray]) -> dict[str, Any]:
    """Figures of actual against wanted attitude (kind "angle") or rates ("rate"), one for each axis.

    pairs: "actual", "wanted" -> (T, 3).
    """
    style = {"actual": dict(color="#2b83ba", line_width=1.6), "wanted": dict(color=INK, line_width=1.3, line_dash="dashed")}
    for name, values in pairs.items():
        for i, axis in enumerate(ANGLES):
            series.line(f"{name}_{axis}", values[:, i])
    source, out = series.source(), {}
    for axis in ANGLES if pairs else ():
        tips = [(name, f"@{name}_{axis}{{0.0}}{unit}") for name in pairs]
        p = out[f"{kind}_{axis}"] = stacked(f"{kind}_{axis}", axis == ANGLES[-1], x_range, f"{axis} [{unit}]", tips)
        lines = [p.line("time", f"{name}_{axis}", source=source, name=name, **style[name]) for name in pairs]
        hover(p, lines[0])
    return out


def _shades(trace: Trace) -> list[Any]:
    """Grey boxes over time on the ground, hatched ones over blind time."""
    from bokeh.models import BoxAnnotation

    grey: dict[str, Any] = dict(fill_color=INK, fill_alpha=0.20, line_color=None)
    hatch: dict[str, Any] = dict(hatch_pattern="right_diagonal_line", hatch_color=INK, hatch_alpha=0.35, hatch_scale=10.0)
    edges = [float(trace.time[0]), *(t for span in trace.airborne for t in span), float(trace.time[-1])]
    ground = zip(edges[::2], edges[1::2], strict=True) if trace.airborne else ()
    return [
        *(BoxAnnotation(left=start, right=end, **grey) for start, end in ground if end > start),
        *(BoxAnnotation(left=float(start), right=float(end), fill_color=None, line_color=None, **hatch) for start, end, _ in trace.blind),
    ]


def _marks(diagnosis: Diagnosis) -> list[Any]:
    """Lines of the events: dashed at the onset, full at the announcement, dotted at the end."""
    from bokeh.models import Span

    return [
        Span(location=float(when), line_dash=dash, dimension="height", line_color=colours.of_event(event), line_width=1.5)
        for event in diagnosis.events
        for when, dash in ((event.onset_s, "dashed"), (event.detected_s, "solid"), (event.end_s, "dotted"))
        if when is not None
    ]


def _name_events(figure, diagnosis: Diagnosis) -> None:
    """Number and rotors of each event at its announcement."""
    from bokeh.models import Label

    for number, event in enumerate(diagnosis.events, 1):
        text = f"{number}: {report.rotors(event.rotors) if event.rotors else event.means.noun}"
        where: dict[str, Any] = dict(x=float(event.detected_s), y=highest_loss(diagnosis), x_offset=5)
        figure.add_layout(Label(text=text, y_offset=-4 - 16 * ((number - 1) % 4), **where, **words("12px", "top")))
