"""Motors that lose step for a moment, in simulated FPV flights and in a Blackbox log."""

import functools
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import agreement
import blackbox_writer as writer
from rotorwatch.commands.cli import main
from rotorwatch.diagnose import diagnose
from rotorwatch.flight.diagnosis import Event
from rotorwatch.report import figures, terminal, upset
from rotorwatch.witnesses.aerobatic import desync, innovation
from rotorwatch.witnesses.healthy import baselines
from rotorwatch_lab.simulation import fpv
from rotorwatch_lab.simulation.fpv import Moment, Push

SHARED = Path(__file__).parents[1] / "../shared/flights/blackbox"
LONG = 50.0
AT = (7.3, 12.1, 18.4, 24.9, 31.7, 38.2)
TIMES = "times"
PUSHES = ((90, 0, 0), (0, -120, 0), (0, 0, 150), (70, 70, 0), (-80, 20, 60), (30, 90, 90))  # rad/s^2
# Flights of one batch: what is wrong in each.
WRONG = {
    "long": tuple(Moment(0, 2, t, 0.2) for t in AT),
    "short": tuple(Moment(1, 0, t, 0.1) for t in AT),
    "healthy": (),
    "dead": (Moment(3, 1, 22.0, LONG),),
    "second": (Moment(4, 3, 22.0, 1.2),),
    "weak": (Moment(5, 1, 15.0, LONG, 0.5),),
    "knocks": tuple(Push(6, t, 0.05, a) for t, a in zip(AT, PUSHES)),
    "gone": (Moment(7, 1, 22.0, LONG, 1.0),),
    "stops": (Moment(8, 2, 14.0, 0.2), Moment(8, 2, 19.0, 0.2), Moment(8, 2, 24.0, LONG)),
}  # fmt: skip


@functools.cache
def flights():
    made = fpv.fly(len(WRONG), LONG, 5, tuple(w for all_ in WRONG.values() for w in all_), rpm=True)
    return dict(zip(WRONG, made))


@functools.cache
def answer(name):
    return diagnose(flights()[name])


@functools.cache
def all_channels(name):
    flight = flights()[name]
    vehicle, _, _ = baselines.settle(flight, None, (), diagnose)
    return innovation.channels(flight, vehicle, ((2.5, LONG - 2.0),))


def seen(name, rpm):
    return all_channels(name) if rpm else all_channels(name)[:3]


@functools.cache
def found(name, rpm):
    return desync.search(seen(name, rpm))


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize(("name", "rotor", "lasting", "rpm", "least"), [
    ("long", 2, 0.2, True, 6),
    ("long", 2, 0.2, False, 4), ("short", 0, 0.1, True, 5), ("short", 0, 0.1, False, 2),
])  # fmt: skip
def test_desyncs_are_found_with_motor_time_and_length(name, rotor, lasting, rpm, least):
    here = found(name, rpm)
    assert {d.rotor for d in here} == {rotor}
    assert least <= len(here) <= len(AT)
    for d in here:
        assert min(abs(d.start - t) for t in AT) < (0.02 if rpm else 0.25)  # a motor that is commanded little is missed late
        assert not d.others
        if rpm:
            assert abs(d.end - d.start - lasting) < 0.03


def test_beginning_and_end_of_a_long_one_are_those_of_the_speed():
    """Where a speed falls the likelihood is a narrow ridge: steps of a fourth of the length went by it, and ended 120 ms too early."""
    flight = fpv.fly(4, 40.0, 6, tuple(Moment(j, 2, t, 0.5) for j in range(4) for t in (11.0, 27.0)), rpm=True)[0]
    vehicle, _, _ = baselines.settle(flight, None, (), diagnose)
    here = desync.search(innovation.channels(flight, vehicle, ((2.5, 38.0),)))
    assert [(d.rotor, d.start, d.end) for d in here] == [
        (2, pytest.approx(t, abs=0.02), pytest.approx(t + 0.5, abs=0.02)) for t in (11.0, 27.0)
    ]


@pytest.mark.parametrize("after, lasting", [(0.0, 0.03), (0.05, 0.04), (0.1, 0.03), (0.15, 0.04), (0.0, 0.5), (-0.1, 0.3), (-0.3, 0.5)])
def test_from_any_part_of_a_desync_or_more_than_it_the_whole_is_found(after, lasting):
    """The matched filter may peak at a part of a desync of 200 ms; the rest of it lies on another slope of the likelihood."""
    channels = seen("long", True)
    dt, begin = channels[0].width, channels[0].time[0]
    lengths = np.unique(np.round(desync.LENGTHS_S / dt).astype(int))
    for at in (7.3, 24.9):
        peak = round((at + after - begin) / dt), round(lasting / dt)
        start, length = desync._refined(channels, 2, *peak, lengths, 0.0)
        assert channels[0].time[start] == pytest.approx(at, abs=0.005)
        assert length * dt == pytest.approx(0.2, abs=0.005)


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize(("name", "rpm"), [
    *((name, rpm) for name in ("healthy", "dead", "weak", "knocks", "gone") for rpm in (False, True)), ("second", True),
])  # fmt: skip
def test_what_is_no_desync(name, rpm):
    """Flips, propwash and idle; motors that die or stop for a second; a weak motor; knocks; a propeller that is lost."""
    assert found(name, rpm) == []


def test_air_that_is_rough_for_a_moment_is_none():
    """Propwash lasts less than the second over which the noise is measured: taken for as calm as that second, it was a desync of 120 ms."""
    rng, windows, often = np.random.default_rng(0), 15000, 50
    thrust = np.repeat(rng.uniform(0.2, 0.5, (windows // often, 4)), often, axis=0)
    rough = np.where(np.arange(windows) // often % 5 == 0, 2.5, 1.0)
    answer = np.exp(-np.arange(innovation.LAGS) * innovation.WIDTH_S / 0.025)
    answer *= 20.0 / answer.sum()
    time, there = np.arange(windows) * innovation.WIDTH_S, np.ones(windows, bool)
    channels = [
        innovation.Channel(
            None, time, innovation.WIDTH_S, there, thrust, rough * rng.standard_t(7, windows), np.full(windows, 8.0),
            thrust * fpv.MIX[axis], answer,
        )
        for axis in range(3)
    ]  # fmt: skip
    assert desync.search(channels) == []


@pytest.mark.skipif(not SHARED.is_dir(), reason="the flight logs for tests are not here (../shared/flights)")
def test_a_motor_that_comes_from_rest_is_none():
    """A real freestyle flight: the motor is commanded nothing for 100 ms, then all at once, and takes 60 ms to turn."""
    assert "desync" not in {e.kind for e in diagnose(SHARED / "Hiro_highP_highD.BFL.xz").events}


def test_speed_of_another_motor_says_nothing():
    """A desync that the motion shows, while the motor's own speed stays as it was reported, is none."""
    channels = seen("long", True)
    healthy = {c.rotor: c for c in seen("healthy", True)}
    mixed = [c if c.rotor != 2 else healthy[2] for c in channels]
    assert len(desync.search(mixed)) < len(found("long", True))


def test_a_short_or_slow_log_is_not_assessed():
    flight = flights()["healthy"]
    vehicle, _, _ = baselines.settle(flight, None, (), diagnose)
    assert innovation.channels(flight, vehicle, ((10.0, 15.0),)) == []
    assert innovation.channels(flight, vehicle, ()) == []
    few = {name: s.part(slice(None, None, 20)) for name, s in flight.signals.items()}
    assert innovation.channels(type(flight)(flight.format, "Betaflight", few, LONG), vehicle, ((2.5, LONG - 2.0),)) == []


def test_the_fit_stays_right_in_closed_loop():
    """The step response of each axis is the simulation's gain, though a controller answers the air."""
    for c, gain in zip(seen("healthy", False)[:2], fpv.GAIN):
        assert len(c.answer) == innovation.LAGS
        assert 0.0 < c.answer.sum() < gain


def test_a_motor_turns_to_what_it_is_reported_with_a_lag():
    reported = np.random.default_rng(1).uniform(size=(1000, 4))
    keep, slow = np.exp(-0.004 / innovation.TURNING_S), reported.copy()
    for k in range(1, len(reported)):
        slow[k] = keep * slow[k - 1] + (1.0 - keep) * reported[k]
    assert innovation._slow(reported, 0.004) == pytest.approx(slow, abs=1e-8)


def one(rotor=0, start=10.0, lasting=0.1, ratio=5.0, others=()):
    return desync.Desync(rotor, start, start + lasting, ratio, 1.0, lasting, others)


def test_events_are_one_a_motor():
    first, second = desync.events([one(2, 12.0, 0.03), one(0), one(2, 34.0, 0.14)], False)
    assert (first.rotors, first.extra["count"], first.onset_s) == ((1,), 1, 10.0)
    assert first.reason == "motor 1 desynced once, at 10.00 s: it was commanded up and gave no thrust for 100 ms"
    assert (second.rotors, second.extra[TIMES], second.end_s) == ((3,), [12.0, 34.0], pytest.approx(34.14))
    assert second.reason == "motor 3 desynced 2 times, first at 12.00 s: it was commanded up and gave no thrust for 30 to 140 ms"
    assert second.loss == () and second.extra["rpm"] is False


def test_motors_that_nothing_tells_apart():
    (event,) = desync.events([one(1, others=(2,))], False)
    assert (event.rotors, event.alternatives, event.probability) == ((2,), ((3,),), 0.5)
    (event,) = desync.events([one(1, 5.0), one(2, 20.0, others=(1,))], False)  # one that certainly did it did it again
    assert (event.rotors, event.alternatives, event.extra["count"]) == ((2,), (), 2)


def test_none_counts_once_control_is_lost_or_of_a_motor_that_is_gone(monkeypatch):
    channels, every = seen("long", True), found("long", True)
    monkeypatch.setattr(desync, "channels", lambda *_: channels)
    monkeypatch.setattr(desync, "search", lambda _: every)
    assert max(desync.find(None, None, ())[0].extra[TIMES]) > 20.0
    lost = Event("loss_of_control", (), 20.0, 20.1, None, (), (), 1.0)
    (event,) = desync.find(None, None, (), (lost,))
    assert max(event.extra[TIMES]) < 20.0
    gone = Event("loss_of_effectiveness", (3,), 6.0, 8.0, None, (0.9,), ((0.8, 1.0),), 1.0)
    assert desync.find(None, None, (), (gone,)) == ()


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", ["long", "healthy"])
def test_all_views_of_the_answer_say_the_same(name):
    assert agreement.walk(answer(name)) == []


def test_a_blackbox_log_from_the_command_line(tmp_path, capsys):
    log = writer.simulated(flights()["long"].until(28.0), tmp_path / "desync.bbl")
    with pytest.raises(SystemExit) as end:
        main(["diagnose", str(log), "--json"])
    shown = json.loads(capsys.readouterr().out)
    assert end.value.code == 1
    assert shown["verdict"] == "fault"
    event = shown["events"][shown["main_event"]]
    assert (event["kind"], event["rotors"], event["rpm"]) == ("desync", [3], True)
    assert event["count"] == len(event["times"]) == len(event["durations"]) >= 3


def test_the_terminal_counts_them():
    screen = Console(width=150, file=io.StringIO())
    with screen.capture() as out:
        screen.print(terminal.diagnosis(answer("long"), verbose=True))
    text = " ".join(out.get().split())
    assert f"Motor 3 (rear left) desynced {answer('long').events[0].extra['count']} times, first at" in text
    assert "motor desync" in text and "motor timing, demag compensation" in text


def test_the_picture_shows_the_moment_of_the_first_desync():
    """Command up, speed to nothing, rates as wanted and as flown; the same numbers in JSON and in the report's plots."""
    long = answer("long")
    shown = json.loads(long.to_json())["picture"]
    start = long.events[0].extra[TIMES][0]
    assert [m["what"] for m in shown["marks"]] == ["gives nothing", "works again"] and shown["marks"][0]["time_s"] == start
    assert shown["accused"] == [3] and shown["start_s"] < start < shown["end_s"]
    time, rpm = np.array(shown["speeds"]["time_s"]), np.array(shown["speeds"]["rpm"])
    before, last = time < start - 0.05, np.argmin(np.abs(time - shown["marks"][1]["time_s"]))
    assert rpm[2, last] < 0.3 * rpm[2, before].mean() and np.delete(rpm[:, last], 2).min() > 2 * rpm[2, last]
    flown = flights()["long"]["gyro"]
    k = np.searchsorted(flown.time, shown["rates"]["time_s"])
    assert shown["rates"]["roll_dps"] == pytest.approx(np.degrees(flown.values[k, 0]), abs=0.06)
    plots = {**upset.plots(long), **figures.plots(long)}
    names = {f"rate_{axis}" for axis in ("roll", "pitch", "yaw")} | {f"moment_{axis}_rate" for axis in ("roll", "pitch", "yaw")}
    assert names | {"moment_speeds", "moment_commands"} <= set(plots)
    (line,) = (r for r in plots["moment_speeds"].renderers if r.name == "rotor 3")
    assert np.allclose(line.data_source.data["rotor3"], rpm[2] / 1000.0)
    assert answer("healthy").picture is None


def test_the_headline_says_that_the_motor_stopped_for_good():
    flight = flights()["stops"]
    cut = {name: s.between(0.0, 25.5) for name, s in flight.signals.items()}  # it fell
    stopped = diagnose(replace(flight, signals=cut, duration=25.5))
    assert re.match(r"Motor 3 \(rear left\) desynced 2 times, first at (13\.9|14\.0)", stopped.headline)
    assert "and gave no thrust from 24." in stopped.headline
    assert "any more" not in answer("long").headline
