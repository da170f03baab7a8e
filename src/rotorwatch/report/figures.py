"""The report's interactive time plots (Bokeh)."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis, Trace
from rotorwatch.report import colours, lanes, method_plots
from rotorwatch.report.axes import blank, hover, moment, stacked, words
from rotorwatch.report.colours import INK
from rotorwatch.report.thinning import Screen, airborne, windows, within

CHANNELS = ("roll", "pitch", "yaw", "thrust")
ANGLES = ("roll", "pitch", "yaw")
HYPOTHESES = 8
COLUMNS = 1  # of a legend: a telephone is not wide enough for two


def plots(diagnosis: Diagnosis) -> dict[str, Any]:
    """Bokeh figures by name: loss, lane, command, evidence, rate_roll .. rate_yaw, angle_roll .. angle_yaw, roll, pitch, yaw, thrust,
    those of a method's own series (OWN), and those of `lanes.context`. Time axes and crosshairs are linked.

    Empty without `diagnosis.trace`. Losses and commands in percent, residuals in units of
    hover thrust, evidence in log10 odds.
    """
    from bokeh.models import ColumnDataSource, CrosshairTool, Range1d, Span

    trace = diagnosis.trace
    if trace is None or trace.time.size < 2:
        return {}
    n = trace.loss.shape[1]
    flying = airborne(trace)
    screen = Screen(trace.time, windows(diagnosis))
    data: dict[str, Any] = {"time": screen.time}
    for k in range(n):
        data[f"loss{k + 1}"] = screen.line(np.where(flying, 100 * trace.loss[:, k], np.nan))
        data[f"low{k + 1}"] = screen.least(np.where(flying, 100 * trace.lower[:, k], np.nan))
        data[f"high{k + 1}"] = screen.greatest(np.where(flying, 100 * trace.upper[:, k], np.nan))
        data[f"command{k + 1}"] = screen.line(100 * trace.command[:, k])
    for i, name in enumerate(CHANNELS):
        data[name] = screen.line(np.where(flying, trace.residual[:, i], np.nan))
        data[f"{name}_band"] = screen.greatest(np.where(flying, 2 * trace.residual_sd[:, i], np.nan))
        data[f"{name}_bottom"] = -data[f"{name}_band"]
    shown = hypotheses(diagnosis)
    for i, name in enumerate(shown):
        data[f"odds{i}"] = screen.line(np.where(flying, trace.evidence[name], np.nan))
    attitudes, rates = _attitudes(trace), _rates(trace)
    for kind, pairs in (("angle", attitudes), ("rate", rates)):
        for name, values in pairs.items():
            for i, axis in enumerate(ANGLES):
                data[f"{name}_{kind}_{axis}"] = screen.line(np.where(flying, values[:, i], np.nan))
    source = ColumnDataSource(data)
    start, end = float(trace.time[0]), float(trace.time[-1])
    x_range = Range1d(start=start, end=end, bounds=(start, end), min_interval=0.2)
    cross = CrosshairTool(dimensions="height", overlay=Span(dimension="height", line_color=INK, line_dash="dotted"))

    looks = colours.looks(diagnosis, n)
    out = {
        "loss": _loss(diagnosis, source, x_range, n, looks),
        "lane": lanes.messages(diagnosis, x_range),
        "command": _commands(source, x_range, n, looks),
        "evidence": _evidence(trace, source, x_range, shown, looks) if shown else None,
        **_followed(source, x_range, "rate", "°/s", rates),
        **_followed(source, x_range, "angle", "°", attitudes),
        **{name: _residual(trace, source, x_range, name, i) for i, name in enumerate(CHANNELS)},
        **_own(diagnosis, x_range, looks),
        **lanes.context(diagnosis, x_range),
    }
    figures = {name: figure for name, figure in out.items() if figure is not None}
    at = moment()
    for figure in figures.values():
        figure.add_tools(cross)
        figure.add_layout(at)
        _shade(figure, trace)
        _mark(figure, diagnosis)
    return figures


OWN = "own"
"""What the names of the plots of a method's own series begin with: own_loss, own_x_0 .., own_e_0 .."""


def _own(diagnosis: Diagnosis, x_range, looks) -> dict[str, Any]:
    """Plots of what a published method itself says; none by the default method."""
    if diagnosis.own is None:
        return {}
    tints = {
        name: looks[rotor] for rotor, k in diagnosis.own.rotors.items() for name in (diagnosis.own.theta_names[k],)
    }
    shown = method_plots.drawn(diagnosis.own, x_range, tints, method_plots.limits([diagnosis.own]))
    return {f"{OWN}_{name}": p for name, p in shown.items()}


def _attitudes(trace: Trace) -> dict[str, np.ndarray]:
    """Roll, pitch and yaw (T, 3) [degrees] as flown and as wanted, going on beyond 180 instead of jumping back."""
    out: dict[str, np.ndarray] = {}
    if trace.attitude is not None:
        out["actual"] = _unwrapped(trace.attitude)
    if trace.wanted is not None:
        flown = out.get("actual")
        near = 0.0 if flown is None else 360.0 * np.round(np.nan_to_num((flown - trace.wanted) / 360.0))
        out["wanted"] = _unwrapped(trace.wanted) if flown is None else trace.wanted + near
    return out


def _rates(trace: Trace) -> dict[str, np.ndarray]:
    """Rates (T, 3) [degrees/s] as flown and as wanted."""
    pairs = {"actual": trace.rates, "wanted": trace.rates_wanted}
    return {name: values for name, values in pairs.items() if values is not None}


def _unwrapped(degrees: np.ndarray) -> np.ndarray:
    out = degrees.copy()
    for column in out.T:
        fine = np.isfinite(column)
        column[fine] = np.unwrap(column[fine], period=360.0)
    return out


def hypotheses(diagnosis: Diagnosis) -> list[str]:
    """The hypotheses worth a line: those with the highest peaks."""
    evidence = diagnosis.trace.evidence if diagnosis.trace is not None else {}
    peak = {name: float(np.max(odds, initial=-np.inf, where=np.isfinite(odds))) for name, odds in evidence.items()}
    return sorted(peak, key=lambda name: (-peak[name], name))[:HYPOTHESES]


def _loss(diagnosis: Diagnosis, source, x_range, n: int, looks) -> Any:
    from bokeh.models import Range1d

    tips = [(f"rotor {k}", f"@loss{k}{{0.0}} % (@low{k}{{0}} to @high{k}{{0}})") for k in range(1, n + 1)]
    top = highest_loss(diagnosis)
    y_range = Range1d(start=-0.03 * top, end=top, bounds=(-10, 110))
    p = blank(x_range, 340, "loss of effectiveness [%]", tips, y_range=y_range)
    p.name = "loss"
    named = {*colours.faulty(diagnosis), *colours.suspects(diagnosis)}
    moved = {k for e in diagnosis.events for k in e.rotors}
    line = None
    for k in sorted(range(1, n + 1), key=lambda k: k in named):  # the ones that matter on top
        look: dict[str, Any] = dict(source=source, name=f"rotor {k}", level="glyph")
        (tint, dash), alpha = looks[k], 0.3 if k in moved else 0.12 if k in named else 0.07
        p.varea("time", f"low{k}", f"high{k}", color=tint, alpha=alpha, **look)
        width = 2.6 if k in named else 1.3
        line = p.line("time", f"loss{k}", color=tint, line_width=width, line_dash=dash, **look)
    hover(p, line)
    return p


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


def _commands(source, x_range, n: int, looks) -> Any:
    tips = [(f"rotor {k}", f"@command{k}{{0.0}} %") for k in range(1, n + 1)]
    p = blank(x_range, 250, "command [% of full thrust]", tips)
    p.name = "command"
    lines = []
    for k in range(1, n + 1):
        look: dict[str, Any] = dict(name=f"rotor {k}", color=looks[k][0], line_width=1.3, line_dash=looks[k][1])
        lines.append(p.line("time", f"command{k}", source=source, **look))
    hover(p, lines[0])
    return p


def _evidence(trace: Trace, source, x_range, shown: list[str], looks) -> Any:
    from bokeh.models import Legend, LegendItem, Range1d, Span

    tips = [(name, f"@odds{i}{{0.0}}") for i, name in enumerate(shown)]
    seen = np.nan_to_num(np.stack([trace.evidence[name] for name in shown])[:, airborne(trace)])
    top = 1.08 * max(float(seen.max(initial=0.0)), 1.5 * abs(float(trace.threshold)), 1.0)
    low = max(1.05 * float(seen.min(initial=0.0)), -top)  # how unlikely the wrong ones are is of no interest
    p = blank(x_range, 400, "log10 odds against healthy", tips, y_range=Range1d(start=low, end=top))
    p.name = "evidence"
    lines = []
    for i, name in reversed(list(enumerate(shown))):  # the likeliest on top
        look = dict(name=f"odds {i}", line_width=2.2 if i == 0 else 1.4) | _look(name, i, looks)
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


def _look(hypothesis: str, place: int, looks) -> dict[str, Any]:
    """One rotor's hypothesis has the rotor's colour; the others are distinguished by grey and dashes."""
    number = hypothesis.rpartition(" ")[2]
    if hypothesis.startswith("rotor ") and number.isdigit() and int(number) in looks:
        return dict(zip(("color", "line_dash"), looks[int(number)], strict=True))
    return dict(color=INK, line_dash=("solid", "dashed", "dotted", "dotdash")[place % 4])


def _followed(source, x_range, kind: str, unit: str, pairs) -> dict[str, Any]:
    """Wanted against actual attitude ("angle") or rates ("rate"), a plot for each axis."""
    style = {
        "actual": dict(color="#2b83ba", line_width=1.6),
        "wanted": dict(color=INK, line_width=1.3, line_dash="dashed"),
    }
    out = {}
    for axis in ANGLES if pairs else ():
        tips = [(name, f"@{name}_{kind}_{axis}{{0.0}}{unit}") for name in pairs]
        p = out[f"{kind}_{axis}"] = stacked(f"{kind}_{axis}", axis == ANGLES[-1], x_range, f"{axis} [{unit}]", tips)
        lines = [p.line("time", f"{name}_{kind}_{axis}", source=source, name=name, **style[name]) for name in pairs]
        hover(p, lines[0])
    return out


def _residual(trace: Trace, source, x_range, name: str, channel: int) -> Any:
    from bokeh.models import Range1d

    tips = [(name, f"@{name}{{0.0000}}"), ("2 sd", f"@{name}_band{{0.0000}}")]
    values = np.abs(trace.residual[airborne(trace), channel])
    band = 2 * trace.residual_sd[airborne(trace), channel]
    top = max(1.5 * float(np.nanquantile(values, 0.995)), 1.6 * float(np.nanmedian(band)), 1e-4) if values.size else 1.0
    p = stacked(name, name == CHANNELS[-1], x_range, name, tips, y_range=Range1d(start=-top, end=top))
    p.varea("time", f"{name}_bottom", f"{name}_band", source=source, color="#56b4e9", alpha=0.22, name="band")
    hover(p, p.line("time", name, source=source, color="#2b83ba", line_width=1.1, name="residual"))
    return p


def _shade(figure, trace: Trace) -> None:
    """Ground grey, blind time hatched."""
    from bokeh.models import BoxAnnotation

    edges = [float(trace.time[0]), *(t for span in trace.airborne for t in span), float(trace.time[-1])]
    if trace.airborne:
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            if end > start:
                ground = BoxAnnotation(left=start, right=end, fill_color=INK, fill_alpha=0.20, line_color=None)
                figure.add_layout(ground)
    hatch: dict[str, Any] = dict(
        hatch_pattern="right_diagonal_line", hatch_color=INK, hatch_alpha=0.35, hatch_scale=10.0
    )
    for start, end, _ in trace.blind:
        box = BoxAnnotation(left=float(start), right=float(end), fill_color=None, line_color=None, **hatch)
        figure.add_layout(box)


def _mark(figure, diagnosis: Diagnosis) -> None:
    """Events: dashed line at the onset, full one at the announcement, dotted one at the end; named on the loss plot."""
    from bokeh.models import Label, Span

    for number, event in enumerate(diagnosis.events, 1):
        tint = colours.of_event(event)
        style: dict[str, Any] = dict(dimension="height", line_color=tint, line_width=1.5)
        for when, dash in ((event.onset_s, "dashed"), (event.detected_s, "solid"), (event.end_s, "dotted")):
            if when is not None:
                figure.add_layout(Span(location=float(when), line_dash=dash, **style))
        if figure.name == "loss":
            text = f"{number}: {report.rotors(event.rotors) if event.rotors else event.means.noun}"
            where: dict[str, Any] = dict(x=float(event.detected_s), y=highest_loss(diagnosis), x_offset=5)
            figure.add_layout(Label(text=text, y_offset=-4 - 16 * ((number - 1) % 4), **where, **words("12px", "top")))
