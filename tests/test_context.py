"""What a report shows beside the answer: the track and its map, lanes of altitude, speed, battery, vibration and modes."""

import re
from dataclasses import replace

import numpy as np
import pytest

from conftest import hexa_diagnosis, hexa_trace
from rotorwatch import logs
from rotorwatch.answer import context
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.flight import Flight, Signal
from rotorwatch.report import colours, figures, html, lanes, thinning, track

SAMPLE = SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
TICKS = np.arange(0.0, 60.0, 0.05)
AIR = ((5.0, 55.0),)
BARE = dict.fromkeys(("position", "ground_speed", "battery", "vibration"))


def flight(**signals):
    return Flight("test", "", signals, 60.0)


def signal(time, values, columns, valid=None):
    return Signal(time, values, tuple(columns.split()), "", valid=valid)


def accel(time, values):
    return flight(accel=signal(time, values, "x y z"))


# Series on the ticks


def test_vibration_is_the_spread_above_the_motion_whatever_the_rate():
    rng = np.random.default_rng(1)
    for rate in (25.0, 100.0, 1000.0):
        time = np.arange(0.0, 60.0, 1 / rate)
        sway = 3.0 * np.sin(2 * np.pi * 0.3 * time)
        noise = rng.standard_normal((time.size, 3)) * [0.5, 1.0, 2.0]
        noise[time < 30.0] *= 0.0
        found = context.gather(accel(time, noise + sway[:, None]), TICKS, AIR)["vibration"]
        late = (TICKS > 31.0) & (TICKS < 59.0)
        assert np.sqrt(np.mean(found[late] ** 2, axis=0)) == pytest.approx([0.5, 1.0, 2.0], rel=0.05), rate
        assert found[(TICKS > 1.0) & (TICKS < 29.0)].max() < 0.1, "the motion is no vibration"


def test_no_vibration_of_a_slow_accelerometer_and_none_in_a_gap():
    time = np.arange(0.0, 60.0, 0.1)
    assert context.gather(accel(time, np.ones((time.size, 3))), TICKS, AIR)["vibration"] is None
    time = np.arange(0.0, 60.0, 0.01)
    time = time[(time < 20.0) | (time > 30.0)]
    step = np.where(time < 25.0, 0.0, 9.0)[:, None] * np.ones(3)  # before and after a gap is no vibration
    found = context.gather(accel(time, step), TICKS, AIR)["vibration"]
    assert np.isnan(found[(TICKS > 20.5) & (TICKS < 29.5)]).all() and np.nanmax(found) < 1e-6


def test_places_count_from_the_lift_off_and_the_best_source_is_taken():
    time = np.arange(0.0, 60.0, 0.2)
    where = np.stack([100.0 + time, 200.0 - time, -50.0 - 2 * time], axis=1)
    gps = signal(time, np.column_stack([where * 0.0 + 7.0, np.full(time.size, 3.0)]), "n e d speed")
    velocity = signal(time, np.tile([3.0, 4.0, 0.0], (time.size, 1)), "n e d")
    both = flight(position=signal(time, where, "n e d"), velocity=velocity, gps=gps)
    found = context.gather(both, TICKS, AIR)
    at = np.searchsorted(TICKS, 15.0)
    assert found["position"][at] == pytest.approx([10.0, -10.0, -20.0]) and found["ground_speed"][at] == pytest.approx(5.0)
    unknown = np.zeros(where.shape, bool)
    lost = flight(position=signal(time, where, "n e d", unknown), gps=gps)
    found = context.gather(lost, TICKS, AIR)
    assert np.nanmax(np.abs(found["position"])) == 0.0 and found["ground_speed"][at] == pytest.approx(3.0)
    height = context.gather(flight(baro=signal(time, 30.0 + time, "up")), TICKS, AIR)["position"]
    assert np.isnan(height[:, :2]).all() and height[at, 2] == pytest.approx(-10.0)


def test_slow_signals_go_straight_on_and_gaps_stay():
    time = np.r_[np.arange(0.0, 20.0, 1.0), np.arange(40.0, 60.0, 1.0)]
    battery = signal(time, np.column_stack([16.0 - 0.1 * time, np.zeros(time.size)]), "voltage current",
                     np.column_stack([time >= 0, time < 0]))  # fmt: skip
    found = context.gather(flight(battery=battery), TICKS, AIR)["battery"]
    assert found[np.searchsorted(TICKS, 10.5), 0] == pytest.approx(14.95) and np.isnan(found[:, 1]).all()
    assert np.isnan(found[(TICKS > 19.1) & (TICKS < 39.9), 0]).all() and np.isnan(found[-1, 0])
    assert all(v is None for v in context.gather(flight(), TICKS, AIR).values())


# The map


def test_the_map_has_one_scale_and_north_is_up():
    area = track.fitted(np.array([0.0, 20.0]), np.array([-30.0, 50.0]))
    (x0, y0), (x1, y1), (x2, y2) = (area.place(*p) for p in ((0.0, 0.0), (10.0, 0.0), (0.0, 10.0)))
    assert (x1 - x0, y0 - y1) == (pytest.approx(0.0), pytest.approx(10 * area.scale))
    assert (x2 - x0, y2 - y0) == (pytest.approx(10 * area.scale), pytest.approx(0.0))
    x, y = area.place([0.0, 20.0], [-30.0, 50.0])
    assert x.min() >= track.MARGIN - 1e-6 and x.max() <= track.WIDTH - track.MARGIN + 1e-6
    assert 0 <= y.min() and y.max() <= area.height
    for size, least in ((0.001, 0.5), (1.0, 0.5), (3.0, 0.5), (80.0, 20.0), (1900.0, 200.0), (5e4, 1e4)):
        area = track.fitted(np.array([0.0, size]), np.array([0.0, size]))
        first = f"{area.bar:.0e}"[0]
        assert first in "125" and area.bar >= least and area.bar * area.scale <= track.BAR * track.WIDTH + 1e-6
        assert area.bar * area.scale > track.BAR * track.WIDTH / 2.6


def test_the_thinned_track_is_right_at_every_time():
    time = np.arange(0.0, 300.0, 0.02)
    x = 200 + 150 * np.sin(2 * np.pi * time / 60.0)
    y = np.interp(time, [0, 100, 200, 300], [0, 0, 300, 310])  # 100 s of one place, then a straight leg
    x[time < 100.0] = 200.0
    kept = track.thinned(time, x, y, 0.6)
    assert kept[0] == 0 and kept[-1] == time.size - 1 and 20 < kept.size < 400
    off = np.hypot(np.interp(time, time[kept], x[kept]) - x, np.interp(time, time[kept], y[kept]) - y)
    assert off.max() <= 0.6 + 1e-9
    assert (time[kept] < 99.0).sum() < 4, "a hover needs no points"


def test_marks_stand_where_they_belong():
    diagnosis = hexa_diagnosis()
    drawn = track.svg(diagnosis)
    time, north, east = track.flown(diagnosis.trace)
    area = track.fitted(north, east)
    assert time[0] >= 4.0 and time[-1] <= 58.0, "in the air"
    event = diagnosis.events[0]
    x, y = (float(v) for v in area.place(np.interp(event.onset_s, time, north), np.interp(event.onset_s, time, east)))
    found = re.search(r'class="event" style="--tint:(#\w+)"><title>([^<]*)</title><circle cx="([\d.]+)" cy="([\d.]+)"', drawn)
    assert found[1] == colours.of_event(event) and found[2].startswith("1: ") and "31.20 s" in found[2]
    assert (float(found[3]), float(found[4])) == (pytest.approx(x, abs=0.8), pytest.approx(y, abs=0.8))
    bar = re.search(r'class="scale"><path d="M14 [\d.]+v5h([\d.]+)v-5"/><text[^>]*>(\d+) m<', drawn)
    assert float(bar[1]) == pytest.approx(area.scale * float(bar[2]), abs=0.1) and bar[2] == "10"
    start = re.search(r'class="start".*?cx="([\d.]+)" cy="([\d.]+)"', drawn)
    assert (float(start[1]), float(start[2])) == tuple(pytest.approx(float(v), abs=0.1) for v in area.place(0.0, 0.0))
    twice = replace(diagnosis, events=(event, replace(event, onset_s=event.onset_s + 0.01)))
    spots = [float(v) for v in re.findall(r'class="event".*?cx="([\d.]+)"', track.svg(twice))]
    assert len(spots) == 2 and abs(spots[0] - spots[1]) >= 17


def test_a_gap_is_not_drawn_over():
    trace = hexa_trace()
    where = trace.position.copy()
    where[(trace.time > 30) & (trace.time < 33)] = np.nan
    assert track.svg(hexa_diagnosis(trace=replace(trace, position=where))).count("<polyline") == 2


# Lanes


def test_lanes_are_thinned_and_keep_peaks():
    long = hexa_trace(duration=600.0)
    speed = long.ground_speed.copy()
    speed[20_001] = 33.0
    pictures = figures.plots(hexa_diagnosis(trace=replace(long, ground_speed=speed)))
    data = pictures["ground_speed"].renderers[0].data_source.data
    assert len(data["time"]) <= 2 * (lanes.OVERVIEW + lanes.DETAIL) and np.nanmax(data["ground_speed"]) == 33.0
    assert pictures["altitude"].x_range is pictures["loss"].x_range, "all lanes share the axis of time"
    spans = [thing for thing in pictures["vibration"].center if thing.__class__.__name__ == "Span"]
    tints = {s.line_color for s in spans if s.name != "moment"}
    assert tints == {colours.of_event(e) for e in hexa_diagnosis().events}
    assert data["time"].dtype == np.float32 and len(data["time"]) < thinning.OVERVIEW_ROWS


def test_a_peak_of_an_impact_does_not_flatten_the_axis():
    trace = hexa_trace()
    shaken = trace.vibration.copy()
    shaken[(trace.time > 57.8) & (trace.time < 57.9)] = 400.0
    shown = figures.plots(hexa_diagnosis(trace=replace(trace, vibration=shaken)))["vibration"].y_range
    calm = figures.plots(hexa_diagnosis())["vibration"].y_range
    assert calm.end < shown.end < 5 * calm.end


def test_lanes_and_lines_are_there_only_where_logged():
    trace = hexa_trace()
    whole = html.page(hexa_diagnosis())
    assert "Not in this log" not in whole and 'id="track"' in whole and 'id="plot-current"' in whole
    volts = trace.battery.copy()
    volts[:, 1] = np.nan
    half = html.page(hexa_diagnosis(trace=replace(trace, **BARE | {"battery": volts})))
    fold = half.partition('<details class="context"')[2].partition("</details>")[0]
    assert 'id="plot-voltage"' in fold and 'id="plot-current"' not in fold and "<svg" not in fold
    note = re.search(r"Not in this log: ([^<]*)\.</p>$", fold)
    assert note[1].startswith("position, altitude, ground speed, battery current, vibration") and "modes" not in note[1]
    none = html.page(hexa_diagnosis(trace=replace(trace, messages=(), **BARE)))
    assert '<details class="context"' not in none and "Not in this log: position, altitude" in none
    assert "flight modes." in none
    assert "Not in this log" not in html.page(hexa_diagnosis(trace=None))


def test_the_fold_is_closed_and_stands_below_the_answer():
    text = html.page(hexa_diagnosis())
    assert '<details class="context" id="context"><summary>' in text, "closed"
    assert text.index('id="plot-loss"') < text.index('id="context"') and text.index("<h2>Events</h2>") < text.index('id="context"')


def test_a_summary_in_words():
    said = lanes.summary(hexa_trace())
    assert said["highest above the lift-off"] == "12.0 m" and said["fastest over ground"] == "2.7 m/s"
    assert said["battery"] == "16.5 V at lift-off, 15.4 V at the end, never below 15.4 V"
    assert said["current"] == "21.0 A on average, up to 21.0 A"
    assert [track.metres(v) for v in (0.349, 8.44, 412.3, 2435.0)] == ["0.35 m", "8.4 m", "412 m", "2.44 km"]


def test_the_series_are_in_the_table_of_a_trace():
    table = hexa_trace().to_pandas()
    assert table["position_down"].min() == pytest.approx(-12.0) and table["battery_voltage"].iloc[0] == pytest.approx(16.6)
    assert {"ground_speed", "vibration_z", "position_north", "battery_current"} <= set(table.columns)
    assert "ground_speed" not in replace(hexa_trace(), **BARE).to_pandas().columns


def test_no_place_on_earth_is_left_in_a_flight():
    """The sample flew at 35.363 degrees south, 149.165 east; the signals are metres from the first fix."""
    sample = logs.read(SAMPLE)
    gps, position = sample["gps"], sample["position"]
    assert np.abs(gps.values).max() < 1000 and np.abs(gps.values[0, :3]).max() == 0.0
    late = gps.time[(gps.time > 20) & (gps.time < 100)]
    for k in range(2):  # the same track as the estimate's
        gps_m, estimated = (np.interp(late, s.time, s.values[:, k]) for s in (gps, position))
        assert np.abs(gps_m - estimated).max() < 1.5
