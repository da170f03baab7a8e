"""The report's plots: their axes, colours, lane of messages, and the headings above them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from conftest import hexa_diagnosis, hexa_trace
from rotorwatch.report import colours, figures, html, lanes
from rotorwatch.report.sections import evidence_plot


def event(**changes):
    return replace(hexa_diagnosis().events[0], **changes)


@pytest.fixture(scope="module")
def pictures():
    return figures.plots(hexa_diagnosis())


def test_plots_begin_and_end_with_the_flight_and_are_in_percent(pictures):
    trace = hexa_trace()
    for p in pictures.values():
        assert (p.x_range.start, p.x_range.end) == (trace.time[0], trace.time[-1])
    data = next(r for r in pictures["loss"].renderers if r.name == "rotor 3").data_source.data
    data = data | next(iter(pictures["command"].renderers)).data_source.data | pictures["roll"].renderers[0].data_source.data
    late = data["time"] > 40.0
    assert np.nanmedian(data["loss3"][late]) == pytest.approx(37.0, abs=1.0)
    assert np.nanmedian(data["command3"][late]) == pytest.approx(58.0, abs=1.0)
    flying, ground = (data["time"] >= 4.2) & (data["time"] <= 57.8), (data["time"] < 3.8) | (data["time"] > 58.2)
    assert np.isnan(data["loss3"][ground]).all() and np.isfinite(data["loss3"][flying]).all()
    assert (data["low3"][flying] <= data["loss3"][flying]).all() and (data["loss3"][flying] <= data["high3"][flying]).all()
    assert data["roll_band"][flying] == pytest.approx(2 * 0.006) and data["roll_bottom"][flying] == pytest.approx(-2 * 0.006)


def test_one_line_of_each_plot_answers_the_pointer(pictures):
    from bokeh.models import HoverTool

    for name in ("loss", "command", "evidence", "roll", "angle_yaw"):
        (line,) = pictures[name].select_one(HoverTool).renderers
        assert line in pictures[name].renderers
    assert pictures["command"].select_one(HoverTool).renderers[0].name == "rotor 1"
    assert pictures["evidence"].select_one(HoverTool).renderers[0].name == "odds 0"


def test_the_axis_of_evidence_holds_what_speaks_for_a_fault_and_as_much_against(pictures):
    """How unlikely the wrong explanations are is of no interest: never further down than up."""
    trace, axis = hexa_trace(), pictures["evidence"].y_range
    top = max(float(np.max(odds)) for odds in trace.evidence.values())
    assert axis.end == pytest.approx(1.08 * max(top, 1.5 * trace.threshold)) and -axis.end <= axis.start < 0.0
    from bokeh.models import ColumnDataSource, Range1d

    shown = ["rotor 3", "common mode"]
    worse = replace(trace, evidence={**trace.evidence, "common mode": np.full(trace.time.size, -500.0)})
    source = ColumnDataSource({"time": [], "odds0": [], "odds1": []})
    axis = evidence_plot.drawn(worse, source, Range1d(), shown, colours.looks(hexa_diagnosis())).y_range
    assert axis.start == -axis.end


def test_a_hypothesis_of_one_rotor_has_its_colour_and_no_other_has():
    looks = colours.looks(hexa_diagnosis())
    assert evidence_plot.look_of("rotor 3", 1, looks) == {"color": colours.FAULT, "line_dash": looks[3][1]}
    for name in ("rotors 1+3", "axis 3", "rotor x", "rotor 9", "common mode"):
        assert evidence_plot.look_of(name, 1, looks) == {"color": colours.INK, "line_dash": "dashed"}


def test_rotors_that_nothing_is_known_against_have_the_palette_in_order(healthy):
    looks = colours.looks(healthy, 20)
    assert [looks[k][0] for k in range(1, 9)] == list(colours.OTHERS) and {looks[k][1] for k in range(1, 9)} == {"solid"}
    assert looks[9] == (colours.OTHERS[0], "dashed") and len(set(looks.values())) == 20
    assert colours.of_event(event()) == colours.FAULT and colours.of_event(event(kind="contact")) == colours.INK
    assert colours.of_event(event(alternatives=((1,),))) == colours.SUSPECT


def test_the_lane_shows_modes_as_spans_and_what_was_said_as_marks(pictures):
    trace = hexa_trace()
    drawn = {r.name: r.data_source.data for r in pictures["lane"].renderers}
    modes, said = drawn["modes"], drawn["messages"]
    assert list(zip(modes["left"], modes["right"])) == [(4.0, 40.0), (40.0, float(trace.time[-1]))]
    assert modes["text"] == ["LOITER: 4.0 to 40.0 s", f"LAND: 40.0 to {trace.time[-1]:.1f} s"] and len(set(modes["fill"])) == 2
    assert sorted(said["time"]) == [3.5, 33.0]
    assert said["text"][0] == "33.0 s, error: crash check" and said["fill"] == ["#c1121f", colours.INK]
    assert lanes.messages(hexa_diagnosis(trace=replace(trace, messages=())), None) is None


def test_the_lane_of_a_log_that_names_no_mode_shows_what_was_said():
    only_said = tuple(row for row in hexa_trace().messages if row[1] != "mode")
    pictures = figures.plots(hexa_diagnosis(trace=replace(hexa_trace(), messages=only_said)))
    drawn = {r.name: r.data_source.data for r in pictures["lane"].renderers}
    assert not len(drawn["modes"]["left"])
    assert sorted(drawn["messages"]["time"]) == [3.5, 33.0]


def test_headings_stand_above_plots_that_are_there(fault):
    text = html.page(fault)
    shown = re.findall(r"<h2>(.*?)</h2>", text)
    first = shown.index("Loss of each rotor over the flight")
    assert shown[first + 1 : first + 5] == [
        "Motor commands", "Evidence", "Attitude: setpoint and actual", "Residuals",  # rates: of vehicles that are flown by rates
    ]  # fmt: skip
    few = html.page(replace(fault, trace=replace(fault.trace, evidence={}, messages=(), attitude=None, wanted=None)))
    shown = re.findall(r"<h2>(.*?)</h2>", few)
    assert shown[first + 1 : first + 3] == ["Motor commands", "Residuals"] and "Evidence" not in shown
    assert 'id="plot-lane"' not in few and 'id="plot-command"' in few and "(4)" in text and "messages of the" not in few
    own, none = html.embed({})
    assert none == {} and own.count("<script") == 1 and len(own) < 30_000  # without plots no library
