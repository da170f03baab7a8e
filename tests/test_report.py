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
from rotorwatch.diagnosis import Event, RotorState
from rotorwatch.errors import ConfigError
from rotorwatch.report import colours, drawing, figures, html, terminal


def text_of(diagnosis):
    screen = terminal.console()
    with screen.capture() as out:
        screen.print(terminal.diagnosis(diagnosis))
    return out.get()


def event(**changes):
    return replace(hexa_diagnosis().events[0], **changes)


@pytest.fixture(scope="module")
def page():
    """The page of the `fault`."""
    return html.page(hexa_diagnosis())


# Words


@pytest.mark.parametrize(
    ("share", "text"), [(0.374, "37 %"), (-0.001, "0 %"), (0.0, "0 %"), (1.0, "100 %"), (-0.021, "-2 %")]
)
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
    assert [(who, at) for who, _, at, _ in report.comparison(fault)] == [
        ("rotorwatch", "31.56 s"),
        ("ardupilot-thrust-loss", "33.40 s"),
    ]
    assert report.comparison(replace(fault, comparison=()))[1][:2] == ("ardupilot-thrust-loss", "nothing")
    px4 = replace(fault, comparison=(), flight={**fault.flight, "autopilot": "PX4"})
    assert report.comparison(px4)[1][:2] == ("px4-esc-current", "nothing")
    other = replace(fault, comparison=(), flight={**fault.flight, "autopilot": "Crazyflie"})
    assert report.comparison(other)[1][:2] == ("other checks", "none made")
    assert "no check of Crazyflie itself" in report.comparison(other)[1][3]
    assert report.comparison(replace(healthy, comparison=())) == []


# Terminal


def test_table_holds_the_whole_answer(fault):
    text = text_of(fault)
    for part in ("FAULT FOUND", "31.56 s", "37.0 %", "33–41 %", "degraded", "99.8 %", "ardupilot-thrust-loss"):
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
    screen = figures.Screen(time, [])
    line = screen.line(values)
    assert screen.time.size <= 2 * figures.OVERVIEW_ROWS
    assert np.all(np.diff(screen.time) > 0)
    assert line.max() == 40.0 and line.min() == -40.0
    assert abs(screen.time[line.argmax()] - 123.45) < 2 * 600 / figures.OVERVIEW_ROWS
    assert np.all(screen.least(values) <= line) and np.all(line <= screen.greatest(values))


def test_thinning_keeps_the_full_rate_around_events():
    time = np.arange(60_000) / 100.0
    screen = figures.Screen(time, [(100.0, 110.0)])
    near = (screen.time >= 100.0) & (screen.time <= 110.0)
    assert near.sum() >= 1000
    assert screen.time.size <= figures.OVERVIEW_ROWS + figures.DETAIL_ROWS


def test_thinning_bridges_no_gap_and_survives_few_samples():
    time = np.arange(10.0)
    values = np.where(time < 5, np.nan, time)
    screen = figures.Screen(time, [])
    assert np.array_equal(screen.time, time)
    assert np.isnan(screen.line(values)[:5]).all() and np.array_equal(screen.line(values)[5:], time[5:])


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
        assert not {"src", "href", "srcset", "action"} & set(attrs), (tag, attrs)


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
    bare = replace(
        hexa_diagnosis(events=(), doubts=("Nothing moved.",)), rotors=(), trace=None, comparison=(), common_mode={}
    )
    page = html.page(bare)
    assert "This log cannot say." in page and len(page) < 30_000


def test_page_of_an_odd_trace(fault):
    """No airborne part, estimates that are not finite, a common-mode event without rotors."""
    trace = fault.trace
    odd = replace(trace, airborne=(), blind=(), loss=np.full_like(trace.loss, np.nan), evidence={})
    page = html.page(replace(fault, trace=odd, events=(event(kind="common_mode", rotors=(), loss=(), interval=()),)))
    assert "Common mode: no single rotor" in page and 'id="plot-evidence"' not in page
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
    for kind in ("loss_of_effectiveness", "output_override", "common_mode", "torque_bias"):
        assert "_" not in report.kind(event(kind=kind))
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
    assert missing <= {"where", "status", "interval", "95"}  # headings of a table that became lines


def text_at(diagnosis, width, console):
    screen = console(width=width, color_system=None, highlight=False, emoji=False, markup=False)
    with screen.capture() as out:
        screen.print(terminal.diagnosis(diagnosis))
    return out.get()


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1"}, {"TERM": "dumb"}])
def test_without_colours_there_are_none(environment, monkeypatch, fault):
    from rich.console import Console

    for name, value in {"TERM": "xterm-256color", **environment}.items():
        monkeypatch.setenv(name, value)
    screen = Console(force_terminal=True, width=80)
    with screen.capture() as out:
        screen.print(terminal.diagnosis(fault))
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


@pytest.mark.parametrize(
    ("shift", "words"), [(0.01, "the same thrust"), (0.6, "10 % more thrust"), (-0.6, "10 % less thrust")]
)
def test_common_mode_in_words(fault, shift, words):
    said = report.common_mode(replace(fault, common_mode={"thrust_shift": shift, "unit": "hover thrusts of one rotor"}))
    assert words in said


def test_the_faulty_rotor_has_one_colour_everywhere(fault, page):
    looks = colours.looks(fault)
    assert looks[3][0] == colours.FAULT and all(looks[k][0] != colours.FAULT for k in looks if k != 3)
    assert page.count(f"--rotor:{colours.FAULT}") == 2  # its row and its place in the top view
    line = next(
        r for r in figures.plots(fault)["loss"].renderers if r.name == "rotor 3" and hasattr(r.glyph, "line_width")
    )
    assert line.glyph.line_color == colours.FAULT


# What a picture holds


@pytest.fixture(scope="module")
def pictures():
    return figures.plots(hexa_diagnosis())


def rendered(renderable, width=120):
    from rich.console import Console

    screen = Console(width=width, color_system=None, highlight=False, emoji=False, markup=False)
    with screen.capture() as out:
        screen.print(renderable)
    return out.get()


def test_plots_begin_and_end_with_the_flight_and_are_in_percent(pictures):
    trace = hexa_trace()
    for p in pictures.values():
        assert (p.x_range.start, p.x_range.end) == (trace.time[0], trace.time[-1])
    data = next(r for r in pictures["loss"].renderers if r.name == "rotor 3").data_source.data
    late = data["time"] > 40.0
    assert np.nanmedian(data["loss3"][late]) == pytest.approx(37.0, abs=1.0)
    assert np.nanmedian(data["command3"][late]) == pytest.approx(58.0, abs=1.0)
    flying, ground = (data["time"] >= 4.2) & (data["time"] <= 57.8), (data["time"] < 3.8) | (data["time"] > 58.2)
    assert np.isnan(data["loss3"][ground]).all() and np.isfinite(data["loss3"][flying]).all()
    assert (data["low3"][flying] <= data["loss3"][flying]).all() and (
        data["loss3"][flying] <= data["high3"][flying]
    ).all()
    assert data["roll_band"][flying] == pytest.approx(2 * 0.006) and data["roll_bottom"][flying] == pytest.approx(
        -2 * 0.006
    )


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
    worse = replace(trace, evidence={**trace.evidence, "common mode": np.full(trace.time.size, -500.0)})
    odds = figures.plots(hexa_diagnosis(trace=worse))["evidence"].y_range
    assert odds.start == -odds.end


def test_a_hypothesis_of_one_rotor_has_its_colour_and_no_other_has():
    looks = colours.looks(hexa_diagnosis())
    assert figures._look("rotor 3", 1, looks) == {"color": colours.FAULT, "line_dash": looks[3][1]}
    for name in ("rotors 1+3", "axis 3", "rotor x", "rotor 9", "common mode"):
        assert figures._look(name, 1, looks) == {"color": colours.INK, "line_dash": "dashed"}


def test_rotors_that_nothing_is_known_against_have_the_palette_in_order(healthy):
    looks = colours.looks(healthy, 20)
    assert [looks[k][0] for k in range(1, 9)] == list(colours.OTHERS) and {looks[k][1] for k in range(1, 9)} == {
        "solid"
    }
    assert looks[9] == (colours.OTHERS[0], "dashed") and len(set(looks.values())) == 20
    assert colours.of_event(event()) == colours.FAULT and colours.of_event(event(kind="contact")) == colours.INK
    assert colours.of_event(event(alternatives=((1,),))) == colours.SUSPECT


def test_the_lane_shows_modes_as_spans_and_what_was_said_as_marks(pictures):
    trace = hexa_trace()
    drawn = {r.name: r.data_source.data for r in pictures["lane"].renderers}
    modes, said = drawn["modes"], drawn["messages"]
    assert list(zip(modes["left"], modes["right"])) == [(4.0, 40.0), (40.0, float(trace.time[-1]))]
    assert (
        modes["text"] == ["LOITER: 4.0 to 40.0 s", f"LAND: 40.0 to {trace.time[-1]:.1f} s"]
        and len(set(modes["fill"])) == 2
    )
    assert sorted(said["time"]) == [3.5, 33.0]
    assert said["text"][0] == "33.0 s, error: crash check" and said["fill"] == ["#c1121f", colours.INK]
    assert figures.plots(hexa_diagnosis(trace=replace(trace, messages=()))).get("lane") is None


def test_headings_stand_above_plots_that_are_there(fault, pictures):
    divs = {name: f"<i>{name}</i>" for name in pictures}
    shown = re.findall(r"<h2>(.*?)</h2>", html._plots(fault, divs))
    assert shown == ["Loss of each rotor over the flight", *(title for _, title, _ in html.PLOTS)]
    few = {name: div for name, div in divs.items() if name not in ("evidence", "lane") and not name.startswith("angle")}
    text = html._plots(fault, few)
    assert (
        re.findall(r"<h2>(.*?)</h2>", text) == [shown[0], "Motor commands", "Residuals"]
        and 'id="plot-lane"' not in text
    )
    assert all(f'id="plot-{name}"><i>{name}</i>' in text for name in few) and html._plots(fault, {}) == ""
    own, none = html._embed({})
    assert none == {} and own.count("<script") == 1 and len(own) < 30_000  # without plots no library
    assert "(4)" in html._messages(fault) and html._messages(replace(fault, trace=None)) == ""


def test_the_main_event_is_pointed_out_among_several_only(fault):
    two = hexa_diagnosis(events=(event(), event(rotors=(5,), onset_s=40.0, detected_s=40.5)))
    assert "main event" not in html._events(fault) and html._events(two).count("main event") == 1
    assert "(main)" not in text_of(fault) and text_of(two).count("(main)") == 1


# Words of the tables


def test_what_is_known_of_the_frame(fault):
    assert report.frame(fault) == "ardupilot-hexa-x, 6 rotors"
    assert report.frame(replace(fault, flight={"rotors": 4})) == "4 rotors"
    assert report.frame(replace(fault, flight={"frame": "hexa"})) == "hexa"
    assert report.frame(replace(fault, flight={})) == "unknown frame"


@pytest.mark.parametrize(
    "state, loss, interval",
    [
        (RotorState(1, 0.374, (0.33, 0.41), "degraded"), "37.4 %", "33–41 %"),
        (RotorState(1, 0.0, (0.0, 1.0), "unobservable"), "?", ""),
        (RotorState(1, 0.0, (0.0, 0.5), "suspect"), "?", "0–50 %"),
        (RotorState(1, 0.2, (0.0, 0.5), "suspect"), "20.0 %", "0–50 %"),
        (RotorState(1, 0.0, (0.0, 1.0), "healthy", "", (-0.01, 0.04)), "none seen", "changed by at most 4 %"),
        (RotorState(1, 0.01, (0.0, 0.03), "healthy", "", (-0.01, 0.04), "healthy"), "1.0 %", "0–3 %"),
    ],
)
def test_a_rotor_in_words(state, loss, interval):
    assert (report.rotor_loss(state), report.rotor_interval(state)) == (loss, interval)


def whole(**more):
    """A comparison with three healthy flights."""
    facts = {
        "verdict": "fault", "reason": "rotor 3 lost thrust", "flights": 3, "loss": [0.0, 0.02, 0.3, 0.0, 0.0, 0.05],
        "interval": [(0.0, 0.05)] * 2 + [(0.2, 0.4)] + [(0.0, 0.1)] * 3, "shift": [0.1, -0.02, 0.0], "shift_sd": [0.02, 0.02, 0.01],
        "causes": [{"rotors": [3], "probability": 0.9}, {"kind": "centre_of_mass", "probability": 0.06},
                   {"rotors": [1], "probability": 0.04}], "common": 0.1,
    }  # fmt: skip
    return hexa_diagnosis(whole_flight=facts | more)


def test_the_comparison_with_healthy_flights_in_words():
    rows = dict(report.whole_flight(whole()))
    assert (
        rows["answer"] == "fault found: rotor 3 lost thrust"
        and rows["compared with"] == "3 healthy flights of this build"
    )
    assert rows["what explains the difference"] == "rotor 3 (front left) 90 %; a shifted centre of mass 6 %"
    assert rows["all rotors together"].startswith("11 % more command")
    assert dict(report.whole_flight(whole(common=-0.1)))["all rotors together"].startswith("10 % less command")
    assert dict(report.whole_flight(whole(flights=1)))["compared with"] == "1 healthy flight of this build"
    assert "all rotors together" not in dict(report.whole_flight(whole(verdict="inconclusive")))
    assert report.whole_flight(hexa_diagnosis()) == []


def test_the_drawing_of_the_comparison_has_its_dots_where_the_numbers_are():
    """A row for each rotor and axis: bar from low to high, dot at the value; on one scale, whose zero line is where 0 is."""
    drawn = drawing.baseline(whole())
    losses, balance = drawn.split("<figure>")[1:]
    span = drawing.WIDTH - drawing.LEFT - 60
    dots = [float(x) for x in re.findall(r'class="dot" cx="([\d.]+)"', losses)]
    assert dots == pytest.approx([drawing.LEFT + span * v / 0.4 for v in (0.0, 0.02, 0.3, 0.0, 0.0, 0.05)], abs=0.06)
    bars = re.findall(r'class="band" x1="([\d.]+)" y1="\d+" x2="([\d.]+)"', losses)
    assert [float(v) for v in bars[2]] == pytest.approx([drawing.LEFT + span / 2, drawing.LEFT + span], abs=0.06)
    assert f'class="zero" x1="{drawing.LEFT:.1f}"' in losses and re.findall(r">(\d+ %)<", losses)[2] == "30 %"
    middle = drawing.LEFT + span / 2
    assert f'class="zero" x1="{middle:.1f}"' in balance
    dots = [float(x) for x in re.findall(r'class="dot" cx="([\d.]+)"', balance)]
    assert dots[0] > middle + 1 > middle > dots[1] and dots[2] == pytest.approx(middle, abs=0.06)
    for left, right in re.findall(r'class="band" x1="([\d.]+)" y1="\d+" x2="([\d.]+)"', balance):
        assert float(left) + float(right) == pytest.approx(2 * middle, abs=0.2) and float(left) < middle
    assert dots[0] == pytest.approx(drawing.LEFT + span, abs=0.06)  # the furthest is at the end


@pytest.mark.parametrize(
    "change", [{"verdict": "inconclusive"}, {"verdict": None}, {"loss": []}, {"interval": None}, {"loss": [0.1] * 4}]
)
def test_a_comparison_that_says_nothing_of_every_rotor_is_not_drawn(change):
    assert drawing.baseline(whole(**change)) == "" and drawing.baseline(hexa_diagnosis()) == ""


def test_the_airframe_fits_its_frame(fault):
    drawn = drawing.airframe(fault)
    left, top, width, height = map(float, re.search(r'viewBox="([-\d. ]+)"', drawn).group(1).split())
    for x, y in re.findall(r"translate\((-?[\d.]+) (-?[\d.]+)\)", drawn):
        assert left + 30 < float(x) < left + width - 30 and top + 30 < float(y) < top + height - 30
    assert (left + width / 2, width) == (pytest.approx(0.0), pytest.approx(height - 14))


def info_of(**more):
    return {
        "name": "a.bin", "format": "F", "firmware": "ArduCopter V4", "autopilot": "ArduPilot", "frame": "", "vehicle_type": "hexarotor",
        "rotors": 6, "duration_s": 60.04, "airborne_s": [(4.0, 58.0)], "parameters": 3, "ready": True, "missing": [], "warnings": [],
        "messages": [], "signals": [{"name": "gyro", "rate_hz": 100.0, "unit": "rad/s", "frame": "body", "valid": 0.999, "source": "IMU"}],
    } | more  # fmt: skip


def test_what_info_says_of_a_log():
    text = rendered(terminal.info(info_of()))
    for words in (
        "hexarotor",
        "ArduPilot ArduCopter V4",
        "4.0 to 58.0 s",
        "60.0 s",
        "99 %",
        "100 Hz",
        "what a diagnosis needs",
    ):
        assert words in text, words
    bad = rendered(terminal.info(info_of(frame="hexa X", autopilot="ArduCopter", ready=False, airborne_s=[], rotors=0)))
    for words in ("hexa X", "cannot be diagnosed", "never found airborne", "no commands found"):
        assert words in bad, words
    assert "hexarotor" not in bad and "ArduCopter ArduCopter" not in bad
    assert "unknown" in rendered(terminal.info(info_of(vehicle_type="")))


def test_failures_of_the_fuzzer_are_in_colour_and_counted():
    result = {"log": "a.bin", "mutations": 40, "seed": 1, "outcomes": {"read": 39, "FAILED": 1}, "failures": [
        {"number": 7, "mutation": "cut", "what": "boom"}]}  # fmt: skip
    table = terminal.fuzz(result).renderables[1]
    styles = {cell.plain: cell.style for cell in table.columns[0].cells}
    assert styles == {"read": "", "FAILED": terminal.STYLES["error"]}
    fine = terminal.fuzz({**result, "outcomes": {"read": 40, "FAILED": 0}, "failures": []}).renderables[1]
    assert {cell.style for cell in fine.columns[0].cells} == {""}
    assert "97.5 %" in rendered(terminal.fuzz(result)) and "FAILED number 7 (cut): boom" in rendered(
        terminal.fuzz(result)
    )


def test_a_note_stands_beside_its_word_where_there_is_room():
    notes = terminal.Notes([("warning", "first"), ("assumed", "second one")])
    assert [line.split() for line in rendered(notes, 60).splitlines()] == [
        ["warning", "first"],
        ["assumed", "second", "one"],
    ]
    assert rendered(notes, 59).splitlines() == ["warning: first", "assumed: second one"]
    long = terminal.Notes([("warning", "x" * 60)])
    assert rendered(long, 69).startswith("warning  x") and rendered(long, 68).startswith("warning: ")
