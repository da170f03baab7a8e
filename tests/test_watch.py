"""A flight given piece by piece is assessed as it is in one piece: the law of `rotorwatch watch`."""

import io
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from tests.conftest import hexa_event

from rotorwatch import airframes, diagnose, logs
from rotorwatch.case import conductor
from rotorwatch.commands import cli
from rotorwatch.engine import driver
from rotorwatch.engine.driver import Driver
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch.live import view
from rotorwatch.live.alert_states import Changes
from rotorwatch.live.replay import Replay
from rotorwatch.live.session import Session
from rotorwatch.live.watched import Watched
from rotorwatch_lab.simulation import scenario, simulate

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
SAMPLES = cli.SAMPLES
# ESC telemetry is heard, and a log doubted as a whole, only after the flight: docs/watch.md. None of these has the one or is the other.
LOGS = (
    "ardupilot-sitl/quadx_m1_mul0.90_hover.bin.xz",
    "ardupilot-sitl/quadx_m3_mul0.85_tlog.tlog.xz",
    "ardupilot-real-rrc/5_mm_cut_straight_line_2.bin.xz",
    "ardupilot-real-twoflights/sample.bin.xz",
    "px4-pyulog/sample_px4_events.ulg.xz",
    "crazypad/cut_propeller_M3_3.5mm_3.5mm_40mm__E8_log00.usd.xz",
    "damaged/gap_hides_loss_1.bin.xz",
    "wild/held-off-quadx-1.bin.xz",
    "wild/knock-1.bin.xz",
    "wild/knock-scale-1.bin.xz",
    "wild/output-off-1.ulg.xz",
    "wild/rotor-off-1.ulg.xz",
    "wild/slow-bin-1.bin.xz",
    "crash/climb-weak-1.bin.xz",
    "crash/disarmed-1.bin.xz",
    "crash/quad-half-1.bin.xz",
    "crash/quad-off-1.bin.xz",
    "crash/take-off-swapped-1.bin.xz",
)


def flight_of(name):
    path = SAMPLES / name if "/" not in name else FLIGHTS / name
    if not path.exists():
        pytest.skip(f"the shared flight {name} is not here")
    return logs.read(path)


def pieces(flight, seed=0, most=4.0):
    """(signals, messages, end) of pieces of any length."""
    rng, before = np.random.default_rng(seed), -np.inf
    now = min(float(s.time[0]) for s in flight.signals.values() if len(s))
    end = max(float(s.time[-1]) for s in flight.signals.values() if len(s))
    while before <= end:
        now += rng.choice([0.03, 0.2, most])
        part = {name: s.between(before, now) for name, s in flight.signals.items()}
        yield ({name: s for name, s in part.items() if len(s)}, [m for m in flight.messages if before <= m.time < now], now)
        before = now


def replayed(flight, **options):
    alerts = []
    replay = Replay(flight, Watched("one", alerts.append), **options)
    while replay.poll():
        pass
    return alerts, replay.watched


def last_words(alerts):
    """What was said last of each event, in order of announcement, without those taken back."""
    said = {a["number"]: a for a in alerts if a["type"] == "event"}
    events = [a["event"] for a in said.values() if a["state"] != "withdrawn"]
    return sorted(events, key=lambda e: (e["detected_s"], e["kind"], e["rotors"]))


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("name", LOGS)
def test_a_log_replayed_gives_the_events_of_diagnose(name):
    flight = flight_of(name)
    wanted = diagnose(flight).to_dict()["events"]
    alerts, watched = replayed(flight)
    found = last_words(alerts)
    assert watched.trouble == ""
    assert len(found) == len(wanted)
    for one, other in zip(found, sorted(wanted, key=lambda e: (e["detected_s"], e["kind"], e["rotors"]))):
        near = ["loss", "interval", "loss_2s", "probability"]
        if one["kind"] == "output_override":  # one that lasts until an impact ends with it, or with the first outputs after it
            near.append("end_s")
            np.testing.assert_allclose(one["end_s"] or np.inf, other["end_s"] or np.inf, rtol=0.0, atol=0.2)
        assert {k: v for k, v in one.items() if k not in near} == {k: v for k, v in other.items() if k not in near}
        for key in ("loss", "interval", "probability"):
            np.testing.assert_allclose(one[key], other[key], atol=2e-4)


def test_a_loss_of_control_is_reported_as_soon_as_it_is_certain():
    flight = flight_of("crash/quad-off-1.bin.xz")
    (lost,) = [e for e in diagnose(flight).events if e.kind == "loss_of_control"]
    session, reported = Session(flight), np.inf
    for signals, messages, end in pieces(flight, seed=2, most=0.5):
        session.add(signals, messages)
        session.advance(np.nextafter(end, -np.inf))
        first = [e for e in session.events() if e.kind == "loss_of_control"]
        if first and reported == np.inf:
            reported = end
            assert (2,) in (first[0].rotors, *first[0].alternatives)
    assert lost.detected_s <= reported < lost.detected_s + 1.0


def test_a_pair_is_never_reported_as_the_rotor_between_them_alone():
    table = {
        "duration_s": 44.0, "seed": 5, "airframe": {"frame": "hexa-x"}, "wind": {"speed_m_s": 2.0}, "logging": {"profile": "full"},
        "faults": [{"kind": "loss", "rotor": r, "onset_s": 32.0, "strength": 0.6} for r in (1, 3)],
    }  # fmt: skip
    replay = Replay(simulate(scenario.from_table(table)).flight, Watched("one", (alerts := []).append), speed=1e6)
    replay._step = 0.05
    while replay.poll():
        pass
    reported = [a["event"] for a in alerts if a["type"] == "event" and a["event"]["rotors"]]
    assert len(reported) > 1 and reported[-1]["rotors"] == [1, 3] and reported[-1]["alternatives"] == []
    assert [e for e in reported if [1, 3] not in (e["rotors"], *e["alternatives"])] == []


def test_what_the_ground_does_after_a_touch_down_is_never_reported():
    """A healthy hexarotor whose controller winds up on the ground in wind before its motors stop: ticks wait until that is known."""
    table = {
        "duration_s": 65.0, "seed": 10370, "airframe": {"frame": "hexa-plus"}, "trajectory": {"kind": "figure-eight"},
        "wind": {"speed_m_s": 5.737747721237923}, "logging": {"profile": "fast"},
    }  # fmt: skip
    alerts, _ = replayed(simulate(scenario.from_table(table)).flight)
    assert [a for a in alerts if a["type"] == "event"] == []


def test_aerobatics_are_never_reported_as_a_loss_of_control():
    alerts, _ = replayed(flight_of("crash/flips-1.bin.xz"))
    assert [a for a in alerts if a["type"] == "event" and a["event"]["kind"] == "loss_of_control"] == []


@pytest.mark.parametrize("name", ["ardupilot-sitl/quadx_m1_mul0.90_hover.bin.xz", "wild/output-off-1.ulg.xz", "wild/slow-bin-1.bin.xz"])
def test_the_table_of_ticks_is_the_same_tick_for_tick(name):
    flight = flight_of(name)
    vehicle = airframes.identify(flight)
    stream, found = Driver(flight, vehicle), []
    for signals, messages, _ in pieces(flight, seed=1):
        stream.add(signals, messages)
        piece = stream.advance()
        stream.replanned()
        if piece is not None and piece.assessed is not None:
            found.append(piece.assessed.table)
    last = stream.finish(flight.duration)
    found += [last.assessed.table] if last.assessed is not None else []
    assert len(found) > 5
    together, plan = tick_table.joined(found), stream.plan
    commands = flight["control" if allocation.faster_control(flight) else "motors"]
    assert (plan.dt, plan.gyro, plan.accel) == (tick_table.plan(flight, commands, READY_S).dt, plan.gyro, plan.accel)
    whole = tick_table.assemble(
        tick_table.sense(flight, allocation.rotor_thrusts(flight, vehicle), plan), plan, vehicle.effectiveness(), last.spans
    )
    assert last.spans == airborne(flight)
    count = min(len(whole.time), len(together.time))
    assert abs(len(whole.time) - len(together.time)) <= 1.5 / plan.dt  # after the last command nothing flies
    for key in ("time", "thrust", "wrench", "valid", "mode", "restart", "hover", "upset", "contact", "seen"):
        np.testing.assert_array_equal(getattr(together, key)[:count], getattr(whole, key)[:count], err_msg=key)
    flying = whole.valid[:count].all(axis=1)
    for key in ("rate", "rate_dot", "load", "side", "axial"):
        np.testing.assert_array_equal(getattr(together, key)[:count][flying], getattr(whole, key)[:count][flying], key)
    assert together.contacts == whole.contacts


def test_a_tick_is_assessed_with_the_sample_that_completes_it():
    """On a link that stamps whole milliseconds the end of a tick and a sample are often one moment, but two sums of floating-point
    numbers: the tick must not wait for the next sample, 20 ms later."""
    flight = flight_of("quadx_healthy_hover.bin.xz")
    grid = np.arange(20_000, 40_000_000, 20_000) * 1e-6
    held = {}
    for name in ("motors", "gyro", "accel"):
        signal = flight[name]
        at = np.minimum(np.searchsorted(signal.time, signal.time[0] + grid), len(signal) - 1)
        held[name] = signal.with_arrays(grid, signal.values[at], signal.valid[at])
    stream, waited = Driver(flight, airframes.identify(flight)), []
    for k, now in enumerate(grid):
        stream.add({name: signal.part(slice(k, k + 1)) for name, signal in held.items()})
        due, piece = stream.due_s, stream.advance()
        if piece is not None and piece.assessed is not None and k > 100 and not stream.diagnoser.doubting:
            assert due <= now
            waited.append(now - piece.assessed.table.time[-1])  # `time`: when all is known of the tick
    assert len(waited) > 100
    assert max(waited) < 0.02 - 1e-6


def test_memory_does_not_grow_with_the_flight(monkeypatch):
    """What is kept at the end is what was kept after twenty seconds, of samples."""
    monkeypatch.setattr(conductor, "WINDOW_S", 10.0)
    monkeypatch.setattr(driver, "REPLAY_S", 5.0)
    flight = flight_of("ardupilot-sitl/quadx_m3_mul0.85_tlog.tlog.xz").until(100.0)
    replay, sizes = Replay(flight, Watched("one", lambda alert: None)), []
    while replay.poll():
        case = replay.watched.session.case
        if case is not None and case.last is not None:
            sizes.append(sum(len(s) for s in case.driver.window._signals.values()))
    assert len(sizes) > 80
    assert max(sizes[30:]) < 1.3 * max(sizes[15:30]) + 3


def test_what_is_written_to_a_file_names_the_rotor_first_and_no_more_often_than_there_is_news(capsys, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    sample = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
    with pytest.raises(SystemExit):
        cli.main(["watch", str(sample), "--speed", "max"])
    announced, final = [line.partition(": ")[2] for line in capsys.readouterr().out.splitlines()]
    assert announced.startswith("announced: rotor 3 lost ") and "missing from the motion" in announced
    assert final.startswith("final: rotor 3 lost ") and len(final) < 60


def test_the_command_replays_a_log_and_ends(capsys):
    sample = SAMPLES / "quadx_healthy_hover.bin.xz"
    with pytest.raises(SystemExit) as left:
        cli.main(["watch", str(sample), "--speed", "max", "--jsonl", "--quiet"])
    (said,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert said == {"type": "vehicle", "vehicle": sample.name, "frame": "ardupilot-quad-x", "rotors": 4}
    assert left.value.code == 0


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["nowhere.bin"], "no such log"),
        (["a.bin", "--speed", "0"], "--speed 0: give a number above 0, or max"),
        (["a.bin", "--speed", "fast"], "--speed fast"),
    ],
)
def test_what_cannot_be_watched_is_said_in_a_sentence(arguments, says, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["watch", *arguments])
    said = capsys.readouterr().err
    assert left.value.code == 2 and says in said and "Traceback" not in said


def test_changes_are_reported_once():
    changes, event = Changes(), hexa_event()
    (first,) = changes.since_last([event])
    assert (first.what, first.number) == ("announced", 1) and changes.since_last([event]) == []
    assert changes.since_last([hexa_event(loss=(0.38,))]) == []
    (more,) = changes.since_last([hexa_event(loss=(0.45,), rotors=(3,))])
    assert (more.what, more.number) == ("changed", 1)
    (other,) = changes.since_last([hexa_event(loss=(0.45,), rotors=(4,))])
    assert (other.what, other.number) == ("changed", 1)
    (gone,) = changes.since_last([])
    assert gone.what == "withdrawn" and changes.since_last([]) == []
    (again,) = changes.since_last([event])
    assert (again.what, again.number) == ("announced", 2)
    (last,) = changes.since_last([hexa_event(loss=(0.371,))], final=True)
    assert last.what == "final"


def watched_with(events, **known):
    watched = Watched("udp:14550/1", lambda alert: None)
    watched.changes.since_last(events)
    for name, value in known.items():
        setattr(watched.health, name, value)
    return watched


def test_the_view_says_what_is_wrong_first():
    fault = view.line(watched_with([hexa_event()]))
    assert fault.state == "FAULT" and fault.link == "good"
    assert fault.events == ("rotor 3 lost 37 % (33–41 %) since 31.2 s (0 s ago)",)
    maybe = view.line(watched_with([hexa_event(alternatives=((4,),))]))
    assert maybe.state == "MAYBE" and maybe.events[0].endswith("; or 4")
    over = view.line(watched_with([hexa_event(end_s=40.0)], lost=5, taken=95, reboots=1), "parameters, 40 %")
    assert (over.state, over.blind) == ("GROUND", "waiting for parameters, 40 %")
    assert over.link == "5.0 % lost, 1 reboots" and over.events[0].endswith(", over at 40.0 s")
    lost = hexa_event(kind="loss_of_control", rotors=(2,), loss=(), interval=(), end_s=33.0, extra={"cause": "rotor"})
    crash = view.line(watched_with([hexa_event(), lost]))
    assert crash.state == "LOST"
    assert crash.events[0] == "loss of control at 31.2 s (0 s ago), rotor 2: a rotor lost its thrust"
    fell = hexa_event(kind="loss_of_control", rotors=(), loss=(), interval=(), extra={"cause": "disarmed"})
    assert view.line(watched_with([fell])).state == "LOST"
    gone = watched_with([])
    gone.session, gone.gone = (SimpleNamespace(flying=True, losses=lambda: None, now=50.0), "no motor outputs that can be used")
    assert (view.line(gone).state, view.line(gone).blind) == ("BLIND", gone.gone)
    silent = view.line(watched_with([], last_frame=-100.0))
    assert silent.state == "SILENT" and "silent for" in silent.link
    knock = hexa_event(kind="contact", rotors=(), loss=(), interval=(), end_s=31.2)
    assert view.line(watched_with([knock])).events == ("contact or collision at 31.2 s (0 s ago)",)


def test_the_view_fits_a_narrow_terminal():
    class Source:
        def shown(self):
            return [(watched_with([hexa_event()]), "")]

    screen = Console(width=60, color_system=None, file=io.StringIO())
    screen.print(view.table([Source()]))
    said = screen.file.getvalue()
    assert "FAULT" in said and "rotor 3 lost 37 %" in said and max(map(len, said.splitlines())) <= 60
