"""Empty time plots in the report's style (Bokeh), and what they share."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.colours import INK, MOMENT

FLIGHT = "flight"
"""Name of the ranges that the page makes one time axis."""


def flight_range(diagnosis: Diagnosis) -> Any:
    """Time axis of a plot over the whole flight [s], for `blank` and `stacked`. diagnosis: with a trace."""
    from bokeh.models import Range1d

    assert diagnosis.trace is not None
    start, end = float(diagnosis.trace.time[0]), float(diagnosis.trace.time[-1])
    return Range1d(name=FLIGHT, start=start, end=end, bounds=(start, end), min_interval=0.2)


def blank(x_range, height: int, y_label: str, tooltips: list[tuple[str, str]], **more) -> Any:
    """An empty plot in the report's style. tooltips: (name, value) pairs, for the renderers that `hover` sets."""
    from bokeh.models import BoxZoomTool, HoverTool, PanTool, ResetTool, SaveTool, WheelZoomTool
    from bokeh.plotting import figure

    box = BoxZoomTool(dimensions="width")
    tools = [box, PanTool(dimensions="width"), WheelZoomTool(dimensions="width"), ResetTool(), SaveTool()]
    look: dict[str, Any] = dict(background_fill_color=None, border_fill_color=None, outline_line_color=None)
    look |= dict(sizing_mode="stretch_width", min_border_left=72, min_border_top=6, output_backend="canvas")
    bar: dict[str, Any] = dict(tools=tools, active_drag=box, toolbar_location="above", toolbar_inner=True)
    p = figure(height=height, x_range=x_range, **look, **bar, **more)
    p.add_tools(HoverTool(tooltips=[("time", "@time{0.00} s"), *tooltips], mode="vline", renderers=[]))
    p.toolbar.logo = None
    p.toolbar.autohide = True
    p.yaxis.axis_label = y_label
    p.xaxis.axis_label = "time [s]"
    for axis in (*p.xaxis, *p.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.update(axis_label_text_color=INK, major_label_text_color=INK, axis_line_color=INK)
        axis.update(major_tick_line_color=INK, minor_tick_line_color=None)
        axis.update(axis_label_text_font="system-ui, sans-serif", major_label_text_font="system-ui, sans-serif")
        axis.update(axis_label_text_font_size="12px", major_label_text_font_size="11px")
    for grid in (*p.xgrid, *p.ygrid):
        grid.update(grid_line_color=INK, grid_line_alpha=0.22)
    return p


def words(size: str, baseline: str = "middle") -> dict[str, Any]:
    """Font and colour of a plot's labels."""
    return dict(text_font="system-ui, sans-serif", text_font_size=size, text_color=INK, text_baseline=baseline)


def hover(p, *renderers, **more) -> None:
    """Attach the tooltip of a plot to these renderers: to one line, so that each time has one. more: properties of the tool."""
    from bokeh.models import HoverTool

    (tool,) = (one for one in p.toolbar.tools if isinstance(one, HoverTool))  # select_one looks through the whole plot
    tool.update(renderers=[*renderers], **more)


def stacked(name: str, last: bool, x_range, label: str, tips, **more) -> Any:
    """A low plot for a stack of them: only the last one has a time axis."""
    p = blank(x_range, 165 if last else 135, label, tips, **more)
    p.name, p.xaxis.visible, p.yaxis.ticker.desired_num_ticks = name, last, 3
    return p


def moment() -> Any:
    """Line of the moment in the page's address, placed by the page's script; one for all plots of a time axis."""
    from bokeh.models import Span

    return Span(name="moment", location=0.0, dimension="height", line_color=MOMENT, line_width=2.0, visible=False)
