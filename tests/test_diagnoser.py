"""The one driver: samples in, ticks and events out, however the samples are cut into pieces."""

import itertools
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotorwatch import airframes, logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.engine import diagnoser as driver
from rotorwatch.engine import driver as driving
from rotorwatch.engine import window
from rotorwatch.engine.definition import ENGINE, merged
from rotorwatch.engine.diagnoser import Assessed, Diagnoser
from rotorwatch.engine.driver import Driver, fly
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.samples import parts
from rotorwatch.flight import Flight, Message

SECONDS = 52.0


@pytest.fixture(scope="module")
def flown():
    """(vehicle, flight, plan, mixing, samples) of a flight in which a rotor fails."""
    flight = logs.read(SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz").until(SECONDS)
    vehicle, mixing = airframes.identify(flight), allocation.faster_control(flight)
    plan = tick_table.plan(flight, flight["control" if mixing else "motors"], tick_table.READY_S)
    return vehicle, flight, plan, mixing, merged(parts(flight.signals, flight.messages, vehicle, plan.gyro, False))


@pytest.fixture(scope="module")
def short():
    """The same of the first seconds of a quadrotor's, assessed soon."""
    flight = logs.read(SAMPLES / "quadx_healthy_hover.bin.xz").until(18.0)
    vehicle, mixing = airframes.identify(flight), allocation.faster_control(flight)
    plan = tick_table.plan(flight, flight["control" if mixing else "motors"], tick_table.READY_KNOWN_S)
    return vehicle, flight, plan, mixing, merged(parts(flight.signals, flight.messages, vehicle, plan.gyro, False))


def reported(flown, cuts=(), room=driver.ROOM):
    """All ticks with the estimator's outputs, and what is written down at the end, of a flight fed in pieces."""
    vehicle, flight, plan, mixing, whole = flown
    with mock.patch.object(driver, "ROOM", room):
        one = Diagnoser(vehicle, allocation.laid_out(vehicle, flight), plan, mixing)
        edges, assessed = [0, *cuts, len(whole)], []
        for first, last in itertools.pairwise(edges):
            assessed += one.feed(whole.part(first, last))
        assessed += one.finish(flight.duration)
    every = Assessed.joined(assessed)
    assert every is not None
    return every, one.losses.events(), one.report.events(one.losses.events(), ()), one.overrides, one.spans


def same(ours, theirs):
    assert ours[1:] == theirs[1:]
    for name, value in vars(ours[0].table).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(theirs[0].table, name), err_msg=name)
    for name, value in ours[0].out._asdict().items():
        np.testing.assert_array_equal(value, getattr(theirs[0].out, name), err_msg=name)


@pytest.fixture(scope="module")
def at_once(flown):
    return reported(flown)


def test_a_flight_at_once_has_its_event(at_once):
    assert [event.rotors for event in at_once[1]] == [(3,)] and at_once[4][0][1] == pytest.approx(SECONDS, abs=0.1)


def test_interpreted_and_compiled_do_the_same(short):
    if ENGINE.library is None:
        pytest.skip("no C compiler")
    compiled, library = reported(short), ENGINE.library
    assert (compiled[0].table.mode == tick_table.ASSESS).sum() > 80 and compiled[0].table.valid.any(axis=0).all()
    ENGINE.__dict__["library"] = None
    try:
        same(reported(short), compiled)
    finally:
        ENGINE.__dict__["library"] = library


def test_fed_one_by_one_it_is_the_same(flown, at_once):
    same(reported(flown, range(1, len(flown[4]))), at_once)


@given(st.lists(st.floats(0.0, 1.0), max_size=40), st.integers(1, 700))
@settings(max_examples=8, deadline=None)
def test_however_it_is_cut_it_is_the_same(flown, at_once, cuts, room):
    same(reported(flown, sorted(int(cut * len(flown[4])) for cut in cuts), room), at_once)


@pytest.mark.parametrize("fell_s", [None, 35.0])
def test_a_log_is_a_link_that_is_over(flown, at_once, fell_s):
    """A whole flight through the driver has the ticks that the engine makes of its samples, also where it is known to have fallen."""
    vehicle, flight, *_ = flown
    (start, end), *_ = at_once[4]
    whole = fly(flight, vehicle, ((start, fell_s or end),), tick_table.READY_S, whole=True)
    assert whole is not None
    written, assessed = whole
    until = fell_s or end
    before = at_once[0].table.command_time <= until
    for name in ("time", "thrust", "wrench", "rate", "load", "valid", "mode", "restart", "upset", "contact", "axial"):
        ours = getattr(assessed.table, name)[assessed.table.command_time <= until]
        np.testing.assert_array_equal(ours, getattr(at_once[0].table, name)[before], err_msg=name)
    assert (assessed.table.mode[assessed.table.command_time > until] == tick_table.GROUND).all()
    assert written.losses.events() == (() if fell_s else at_once[1])


def test_a_rollback_leads_to_the_same_records(flown, at_once, monkeypatch):
    """A flight that turns out to have ended and then not to have: fed again from a checkpoint, with the same losses and events."""
    vehicle, flight, plan, *_ = flown
    monkeypatch.setattr(driving, "REPLAY_S", 12.0)
    one = Driver(replace(flight, signals={}, messages=()), vehicle, keep_s=60.0)
    one.begin(flight, plan, None)
    for time in np.arange(0.0, SECONDS, 0.5):
        one.add({k: s.between(time, time + 0.5) for k, s in flight.signals.items() if len(s.between(time, time + 0.5))})
        one.advance()
        one.checkpoint()
    diagnoser = one.diagnoser
    (start, _), known = diagnoser.spans[0], diagnoser.losses.events(True)
    assert known and one.follow(diagnoser.spans) is None
    fell = one.follow(((start, known[0].onset_s - 1.0),))
    assert fell is not None and fell.rolled_back and diagnoser.losses.events(True) == ()
    assert not fell.assessed.out.announced.any()
    again = one.follow(((start, np.inf),))
    assert again is not None and diagnoser.losses.events(True) == known
    one.finish(flight.duration)
    assert diagnoser.losses.events() == at_once[1]
    assert diagnoser.report.events(diagnoser.losses.events(), ()) == at_once[2]


def test_what_comes_after_a_fall_lies_on_the_ground(flown, at_once):
    """The flight ended, as only what comes after it shows, before the rotor failed: nothing is said of it, and nothing assessed."""
    vehicle, flight, plan, mixing, whole = flown
    (event,) = at_once[1]
    one = Diagnoser(vehicle, allocation.laid_out(vehicle, flight), plan, mixing)
    until = int(np.searchsorted(whole.time, event.onset_s - 5.0))
    one.feed(whole.part(0, until))
    one.fell(event.onset_s - 6.0)
    after = Assessed.joined([*one.feed(whole.part(until, len(whole))), *one.finish(flight.duration)])
    assert after is not None and not after.out.announced.any() and one.losses.events() == ()


def test_of_too_many_texts_the_newest_are_kept_and_all_states(monkeypatch):
    monkeypatch.setattr(window, "MOST_MESSAGES", 3)
    kept = window.Window(Flight("test", "test", {}, 0.0))
    kept.add({}, [Message(float(k), "text" if k % 3 else "landed", str(k), 1.0) for k in range(10)])
    kept.forget(-1.0)
    assert [m.text for m in kept.flight(-np.inf).messages] == ["0", "3", "5", "6", "7", "8", "9"]
    kept.forget(20.0)
    assert [m.text for m in kept.flight(-np.inf).messages] == ["9"], "the last state stays"
