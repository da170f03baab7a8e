"""The words, tables and pages made of a diagnosis."""

import json
import re
import stat
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from conftest import hexa_diagnosis, hexa_trace
from rotorwatch import report
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal, kinds
from rotorwatch.flight.diagnosis import Event, RotorState
from rotorwatch.report import colours, drawing, figures, html, lanes, terminal, thinning, track
from rotorwatch.report.info import info
from rotorwatch.report.sections import other_checks


def text_of(diagnosis):
    screen = terminal.console()
    with screen.capture() as out:
        screen.print(terminal.diagnosis(diagnosis, verbose=True))
    return out.get()


def event(**changes):
    return replace(hexa_diagnosis().events[0], **changes)


@pytest.fixture(scope="module")
def page():
    """The page of the `fault`."""
    return html.page(hexa_diagnosis())


# Words


@pytest.mark.parametrize(("share", "text"), [(0.374, "37 %"), (-0.001, "0 %"), (0.0, "0 %"), (1.0, "100 %"), (-0.021, "-2 %")])
def test_percent_never_says_minus_zero(share, text):
    assert report.percent(share) == text


@pytest.mark.parametrize(("value", "text"), [(0.8, "80 %"), (0.998, "99.8 %"), (0.9999, "> 99.9 %"), (1.0, "> 99.9 %")])
def test_probability_is_never_rounded_up_to_certainty(value, text):
    assert report.probability(value) == text


def test_rotor_lists_read_as_english():
    assert report.rotors(()) == "no rotor"
    assert report.rotors((3,)) == "rotor 3"
    assert report.rotors((1, 2, 4)) == "rotors 1, 2 and 4"
    both = event(rotors=(1, 2), alternatives=((3, 4), (1, 2)))
    assert report.candidates(both) == "rotors 1 and 2, or rotors 3 and 4"


def test_comparison_is_in_time_order_and_says_when_nobody_else_found_anything(fault, healthy):
    assert [(who, at) for who, _, at, _ in other_checks.rows(fault)] == [("rotorwatch", "31.56 s"), ("ardupilot-thrust-loss", "33.40 s")]
    assert other_checks.rows(replace(fault, comparison=()))[1][:2] == ("ardupilot-thrust-loss", "nothing")
    px4 = replace(fault, comparison=(), flight={**fault.flight, "autopilot": "PX4"})
    assert other_checks.rows(px4)[1][:2] == ("px4-current-residual, px4-esc-current", "nothing")
    other = replace(fault, comparison=(), flight={**fault.flight, "autopilot": "Crazyflie"})
    assert other_checks.rows(other)[1][:2] == ("other checks", "none made")
    assert "no built-in check of Crazyflie" in other_checks.rows(other)[1][3]
    assert other_checks.rows(replace(healthy, comparison=())) == []


# Terminal


def test_table_holds_the_whole_answer(fault):
    text = text_of(fault)
    for part in ("FAULT FOUND", "31.56 s", "37.0 %", "33–41 %", "degraded", "98 %", "ardupilot-thrust-loss"):
        assert part in text, part
    for sentence in (*fault.assumptions, *fault.warnings, fault.baseline, "4.0 to 7.5 s: learning what healthy"):
        assert sentence in " ".join(text.split()), sentence


def test_table_fits_80_columns_and_has_no_escape_codes(fault):
    text = text_of(fault)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert "\x1b" not in text


def test_markup_in_a_log_is_text():
    assert "[bold]x[/bold] :skull:" in text_of(hexa_diagnosis(reason="[bold]x[/bold] :skull:"))


def test_unobservable_rotors_have_no_number(healthy):
    unseen = replace(healthy, rotors=(RotorState(1, 0.0, (0.0, 1.0), "unobservable"),), trace=None)
    row = next(line for line in text_of(unseen).splitlines() if "unobservable" in line)
    assert "?" in row and "%" not in row
    assert "bar" not in html.page(unseen).split("<tbody>")[1].split("</tbody>")[0]


# Thinning


def test_thinning_keeps_every_peak_and_the_order_of_time():
    rng = np.random.default_rng(3)
    time = np.arange(60_000) / 100.0
    values = rng.standard_normal(time.size)
    values[12_345], values[50_001] = 40.0, -40.0
    screen = thinning.Screen(time, [])
    line = screen.line(values)
    assert screen.time.size <= 2 * thinning.OVERVIEW_ROWS
    assert np.all(np.diff(screen.time) > 0)
    assert line.max() == 40.0 and line.min() == -40.0
    assert abs(screen.time[line.argmax()] - 123.45) < 2 * 600 / thinning.OVERVIEW_ROWS
    assert np.all(screen.least(values) <= line) and np.all(line <= screen.greatest(values))


def test_thinning_keeps_the_full_rate_around_events():
    time = np.arange(60_000) / 100.0
    screen = thinning.Screen(time, [(100.0, 110.0)])
    near = (screen.time >= 100.0) & (screen.time <= 110.0)
    assert near.sum() >= 1000
    assert screen.time.size <= thinning.OVERVIEW_ROWS + thinning.DETAIL_ROWS


def test_thinning_bridges_no_gap_and_survives_few_samples():
    time = np.arange(10.0)
    values = np.where(time < 5, np.nan, time)
    screen = thinning.Screen(time, [])
    assert np.array_equal(screen.time, time)
    assert np.isnan(screen.line(values)[:5]).all() and np.array_equal(screen.line(values)[5:], time[5:])


def test_without_an_airborne_part_all_of_the_flight_counts(fault):
    trace = fault.trace
    flying = thinning.airborne(trace)
    assert not flying[[0, -1]].any() and flying[trace.time.size // 2]
    assert thinning.airborne(replace(trace, airborne=())).all()


# Page


class Tags(HTMLParser):
    """Start tags with their attributes, and the visible text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.words, self.raw = [], [], False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.raw = tag in ("script", "style")

    def handle_endtag(self, tag):
        self.raw = False

    def handle_data(self, data):
        if not self.raw:
            self.words.append(data)


def test_page_holds_the_whole_answer(fault, page):
    words = " ".join(" ".join(Tags(page).words).replace("\u2060", "").split())  # no-break spaces become spaces, too
    for part in (
        "Rotor 3 (front left) lost 37 %",
        report.sentence(fault.reason),
        fault.events[0].reason,
        "31.56 s (0.36 s later)",
        fault.baseline,
    ):
        assert part in words, part
    for part in (*fault.assumptions, *fault.warnings, "learning what healthy means", "ardupilot-thrust-loss"):
        assert part in words, part
    for name in ("loss", "lane", "command", "evidence", "angle_roll", "angle_yaw", "roll", "pitch", "yaw", "thrust"):
        assert f'id="plot-{name}"' in page
    assert page.count('class="rotor ') == 6


def test_page_asks_for_nothing_from_outside(page):
    for tag, attrs in Tags(page).tags:
        assert tag not in ("link", "iframe", "img", "object", "embed"), tag
        assert not {"src", "srcset", "action"} & set(attrs), (tag, attrs)
        assert attrs.get("href", "#t=").startswith("#t="), "a moment of this page, or nothing"


def test_page_embeds_the_json(fault, page):
    data = re.search(r'<script type="application/json" id="diagnosis">(.*?)</script>', page, re.DOTALL)
    assert json.loads(data.group(1)) == json.loads(fault.to_json())


def test_what_a_log_says_is_never_markup(fault, page):
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"
    tainted = replace(
        fault,
        flight={**fault.flight, "name": evil, "frame": evil, "autopilot": evil, "profile": evil},
        reason=evil,
        baseline=evil,
        warnings=(evil,),
        assumptions=(evil,),
        common_mode={evil: evil},
        whole_flight={evil: [evil]},
        comparison=({"detector": evil, "rotor": 3, "time_s": 33.0, "reason": evil},),
        events=(event(reason=evil, extra={evil: evil}),),
        estimator=evil,
        trace=replace(fault.trace, blind=((1.0, 2.0, evil),), evidence={evil: np.ones(fault.trace.time.size)}),
    )
    tags = Tags(html.page(tainted)).tags
    clean = Tags(page).tags
    assert sum(t == "script" for t, _ in tags) == sum(t == "script" for t, _ in clean)
    assert not [t for t, a in tags if t == "img" or "onerror" in a]


def test_size_stays_below_three_megabytes_for_ten_minutes_of_an_octa():
    long = hexa_diagnosis(trace=hexa_trace(duration=600.0, rate=100.0, rotors=8))
    assert len(html.page(long).encode()) < 3e6


def test_page_without_trace_events_or_rotors():
    bare = replace(hexa_diagnosis(events=(), doubts=("Nothing moved.",)), rotors=(), trace=None, comparison=(), common_mode={})
    page = html.page(bare)
    assert "Not assessed: Nothing moved." in page and len(page) < 30_000


def test_page_of_an_odd_trace(fault):
    """No airborne part, estimates that are not finite, an event without rotors."""
    trace = fault.trace
    odd = replace(trace, airborne=(), blind=(), loss=np.full_like(trace.loss, np.nan), evidence={})
    page = html.page(replace(fault, trace=odd, events=(event(kind="contact", rotors=(), loss=(), interval=()),)))
    assert "Contact or collision" in page and 'id="plot-evidence"' not in page
    assert "NaN" not in re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_airframe_drawing_shows_place_spin_and_loss(fault):
    drawn = drawing.airframe(fault)
    titles = re.findall(r"<title>(Rotor .*?)</title>", drawn)
    assert titles[2] == "Rotor 3, front left, clockwise: degraded, loss 37.0 %"
    assert titles[4] == "Rotor 5, front right, counter-clockwise: healthy, loss none seen"
    places = [tuple(map(float, m)) for m in re.findall(r"translate\((-?[\d.]+) (-?[\d.]+)\)", drawn)]
    assert places[0][0] > 90 and abs(places[0][1]) < 1  # rotor 1 of ArduPilot's hexa X is on the right
    assert places[2][0] < 0 and places[2][1] < 0  # rotor 3 is front left


def test_airframe_drawing_keeps_coaxial_rotors_apart(fault):
    pairs = [{"x": x, "y": y, "spin": s} for x, y in ((1, 1), (1, -1), (-1, 0)) for s in (1, -1)]
    drawn = drawing.airframe(replace(fault, flight={**fault.flight, "geometry": pairs}))
    places = {m for m in re.findall(r"translate\((-?[\d.]+ -?[\d.]+)\)", drawn)}
    assert len(places) == 6


def test_unknown_airframe_has_no_drawing(fault):
    assert drawing.airframe(replace(fault, flight={"frame": "flying carpet"})) == ""


def test_report_is_written_whole_or_not_at_all(fault, tmp_path, monkeypatch):
    target = tmp_path / "report.html"
    fault = replace(fault, trace=None)  # a small page
    fault.to_html(target)
    assert target.read_text().startswith("<!doctype html>")
    assert stat.S_IMODE(target.stat().st_mode) & 0o400
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]

    def full(*_):
        raise OSError(28, "No space left on device")

    before = target.read_bytes()
    monkeypatch.setattr("os.replace", full)
    with pytest.raises(ConfigError, match="No space left"):
        fault.to_html(target)
    assert target.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_report_in_a_missing_folder_is_one_sentence(fault, tmp_path):
    with pytest.raises(ConfigError, match="cannot be written"):
        replace(fault, trace=None).to_html(tmp_path / "nowhere" / "report.html")


def test_event_kinds_have_words():
    for kind in (*kinds.table(), "of_another_version"):
        assert "_" not in event(kind=kind).means.noun
    assert isinstance(event(), Event)


# Words and widths


@pytest.mark.parametrize("width", [40, 41, 55, 72, 80, 100, 130, 200])
@pytest.mark.parametrize("changes", [{}, {"verdict": "healthy", "events": ()}, {"doubts": ("Nothing moved.",)}])
def test_nothing_is_cut_at_any_width(changes, width):
    from rich.console import Console

    shown = hexa_diagnosis(**changes)
    whole = set(text_at(shown, 400, Console).split())
    text = text_at(shown, width, Console)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width and "…" not in text
    words = re.compile(r"[\w.%–]{2,}")
    missing = set(words.findall(" ".join(whole))) - set(words.findall(text))
    assert missing <= {"where", "status", "interval", "95", "trend"}  # headings of a table that became lines


def text_at(diagnosis, width, console):
    screen = console(width=width, color_system=None, highlight=False, emoji=False, markup=False)
    with screen.capture() as out:
        screen.print(terminal.diagnosis(diagnosis, verbose=True))
    return out.get()


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1"}, {"TERM": "dumb"}])
def test_without_colours_there_are_none(environment, monkeypatch, fault):
    from rich.console import Console

    for name, value in {"TERM": "xterm-256color", **environment}.items():
        monkeypatch.setenv(name, value)
    screen = Console(force_terminal=True, width=80)
    with screen.capture() as out:
        screen.print(terminal.diagnosis(fault, verbose=True))
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]", out.get())


def test_gaps_between_commands_are_no_cut_outs():
    """A tick without a sample is no command of nothing: the line goes straight on; over a dropout there is none."""
    from rotorwatch.answer.traces import _bridged

    time = np.arange(0.0, 3.0, 0.1)
    values = np.full((30, 2), 0.5)
    values[[5, 6]] = np.nan
    values[15:28] = np.nan
    out = _bridged(time, values)
    assert np.array_equal(out[:15], np.full((15, 2), 0.5)) and np.isnan(out[15:28]).all()


def test_moments_on_the_autopilots_clock_and_in_utc(fault):
    there = replace(fault, flight={**fault.flight, "boot_s": 46.57, "utc_start": "2026-11-21T23:59:58.350Z"})
    assert report.moment(there, 31.2) == "77.77 s since boot, 00:00:29.5 UTC"
    assert report.day(there) == "2026-11-21 23:59:58 UTC" and report.moment(fault, 31.2) == ""
    assert "77.77 s since boot" in text_of(there) and "00:00:29.5" in html.page(replace(there, trace=None))


def test_the_faulty_rotor_has_one_colour_everywhere(fault, page):
    looks = colours.looks(fault)
    assert looks[3][0] == colours.FAULT and all(looks[k][0] != colours.FAULT for k in looks if k != 3)
    assert page.count(f"--rotor:{colours.FAULT}") == 2  # its row and its place in the top view
    line = next(r for r in figures.plots(fault)["loss"].renderers if r.name == "rotor 3" and hasattr(r.glyph, "line_width"))
    assert line.glyph.line_color == colours.FAULT


# Lanes and the map


def test_lanes_show_what_the_log_holds_and_need_more_than_a_moment(fault):
    x_range = figures.plots(fault)["loss"].x_range
    assert set(lanes.context(fault, x_range)) == {*lanes.LANES, "modes"}
    still = {k: v[:1] for k, v in vars(fault.trace).items() if isinstance(v, np.ndarray)}
    moment = replace(fault, trace=replace(fault.trace, evidence={}, **still))
    assert lanes.context(moment, x_range) == lanes.context(replace(fault, trace=None), x_range) == {}


def test_the_lane_marks_messages_by_their_kind_whatever_they_say(fault):
    x_range = figures.plots(fault)["loss"].x_range
    (marks,) = lanes.messages(fault, x_range).select({"name": "messages"})
    assert marks.data_source.data["text"] == ["33.0 s, error: crash check", "3.5 s, armed: armed"]


def test_the_map_shows_every_place_north_up_with_the_middle_in_its_middle():
    north, east = np.array([-10.0, 0.0, 30.0]), np.array([5.0, 0.0, 25.0])
    area = track.fitted(north, east)
    x, y = area.place(north, east)
    assert (0.0 < x).all() and (x < track.WIDTH).all() and (0.0 < y).all() and (y < area.height).all()
    assert np.diff(y)[1] == pytest.approx(-30.0 * area.scale) and np.diff(x)[1] == pytest.approx(25.0 * area.scale)
    middle = area.place(10.0, 12.5)
    assert middle == (pytest.approx(track.WIDTH / 2), pytest.approx(area.height / 2))


def test_the_arrow_to_the_north_lies_below_the_map_and_within_the_picture(fault):
    drawn = track.svg(fault)
    width, height = (float(n) for n in re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawn).groups())
    x, y, *moves = (float(n) for n in re.findall(r"-?[\d.]+", re.search(r'class="north"><path d="(.*?)z', drawn)[1]))
    xs, ys = x + np.cumsum([0.0, *moves[::2]]), y + np.cumsum([0.0, *moves[1::2]])
    assert 0.0 < xs.min() and xs.max() < width
    assert height - track.FOOT < ys.min() and ys.max() < height


def test_an_event_after_the_landing_is_marked_at_the_end_of_the_track(fault):
    late = replace(fault, events=(event(onset_s=1e3, detected_s=1e3 + 0.4),))
    drawn = track.svg(late)
    marked = re.search(r'class="event".*?<circle cx="([\d.]+)" cy="([\d.]+)"', drawn)
    end = re.search(r'class="end".*?<rect x="([\d.]+)" y="([\d.]+)" width="8"', drawn)
    assert float(marked[2]) == pytest.approx(float(end[2]) + 4.0, abs=0.11)  # beside it, at its height
    assert 0.0 < float(marked[1]) - float(end[1]) - 4.0 < 40.0


def test_without_a_position_there_is_no_track(fault):
    nowhere = replace(fault.trace, position=None)
    assert [v.size for v in track.flown(nowhere)] == [0, 0, 0] and track.svg(replace(fault, trace=nowhere)) == ""


# What a log lacks


@pytest.mark.parametrize(("samples", "missed"), [(0, True), (1, True), (2, False)])
def test_a_signal_counts_as_logged_with_two_valid_samples(samples, missed):
    valid = np.arange(50)[:, None] < [samples, 0]
    battery = Signal(0.1 * np.arange(50), np.full((50, 2), 12.0), ("voltage", "current"), "V,A", valid=valid)
    gaps = [gap["signal"] for gap in info(Flight("x", "ArduPilot", {"battery": battery}, 5.0))["missing"]]
    assert ("battery" in gaps) == missed and "motors" in gaps
