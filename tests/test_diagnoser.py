"""The one driver: samples in, ticks and events out, however the samples are cut into pieces."""

import itertools
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotorwatch import airframes, logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.engine import diagnoser as driver
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.diagnoser import Diagnoser, Judged, fly
from rotorwatch.engine.host import program
from rotorwatch.engine.motion import allocation, ticks
from rotorwatch.engine.motion.samples import samples
from rotorwatch.live import account

SECONDS = 52.0


@pytest.fixture(scope="module")
def flown():
    """(vehicle, flight, plan, mixing, samples) of a flight in which a rotor fails."""
    flight = logs.read(SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz").until(SECONDS)
    vehicle, mixing = airframes.identify(flight), allocation.faster_control(flight)
    plan = ticks.plan(flight, flight["control" if mixing else "motors"], ticks.READY_S)
    return vehicle, flight, plan, mixing, samples(flight.signals, flight.messages, vehicle, plan.gyro, False)


@pytest.fixture(scope="module")
def short():
    """The same of the first seconds of a quadrotor's, judged soon."""
    flight = logs.read(SAMPLES / "quadx_healthy_hover.bin.xz").until(18.0)
    vehicle, mixing = airframes.identify(flight), allocation.faster_control(flight)
    plan = ticks.plan(flight, flight["control" if mixing else "motors"], ticks.READY_KNOWN_S)
    return vehicle, flight, plan, mixing, samples(flight.signals, flight.messages, vehicle, plan.gyro, False)


def told(flown, cuts=(), room=driver.ROOM):
    """All ticks with the estimator's outputs, and what is written down at the end, of a flight fed in pieces."""
    vehicle, flight, plan, mixing, whole = flown
    with mock.patch.object(driver, "ROOM", room):
        one = Diagnoser(vehicle, allocation.laid_out(vehicle, flight), plan, mixing)
        edges, judged = [0, *cuts, len(whole)], []
        for first, last in itertools.pairwise(edges):
            judged += one.feed(whole.part(first, last))
        judged += one.finish(flight.duration)
    every = Judged.joined(judged)
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
    return told(flown)


def test_a_flight_at_once_has_its_event(at_once):
    assert [event.rotors for event in at_once[1]] == [(3,)] and at_once[4][0][1] == pytest.approx(SECONDS, abs=0.1)


def test_interpreted_and_compiled_do_the_same(short):
    if ENGINE.library is None:
        pytest.skip("no C compiler")
    compiled, library = told(short), ENGINE.library
    assert (compiled[0].table.mode == ticks.JUDGE).sum() > 80 and compiled[0].table.valid.any(axis=0).all()
    ENGINE.__dict__["library"] = None
    try:
        same(told(short), compiled)
    finally:
        ENGINE.__dict__["library"] = library


def test_fed_one_by_one_it_is_the_same(flown, at_once):
    same(told(flown, range(1, len(flown[4]))), at_once)


@given(st.lists(st.floats(0.0, 1.0), max_size=40), st.integers(1, 700))
@settings(max_examples=8, deadline=None)
def test_however_it_is_cut_it_is_the_same(flown, at_once, cuts, room):
    same(told(flown, sorted(int(cut * len(flown[4])) for cut in cuts), room), at_once)


@pytest.mark.parametrize("fell_s", [None, 35.0])
def test_a_log_is_a_link_that_is_over(flown, at_once, fell_s):
    """A whole flight through the driver has the ticks that the parts make of all of it at once, also where it is known to have fallen."""
    vehicle, flight, *_ = flown
    (start, end), *_ = at_once[4]
    air = ((start, fell_s or end),)
    one, judged = fly(flight, vehicle, air, ticks.READY_S)
    table = driver.observe(flight, vehicle, air, ticks.READY_S)
    assert table is not None
    for name in (
        "time",
        "command_time",
        "thrust",
        "wrench",
        "rate",
        "load",
        "valid",
        "mode",
        "restart",
        "upset",
        "contact",
        "axial",
    ):
        np.testing.assert_array_equal(getattr(judged.table, name), getattr(table, name), err_msg=name)
    assert one.losses.events() == (() if fell_s else at_once[1])
    last, out = program.estimate(table, vehicle.effectiveness())
    np.testing.assert_array_equal(judged.out.theta, out.theta)
    np.testing.assert_array_equal(one.learned.s, last.s)


def test_the_way_back_leads_to_the_same_books(flown, at_once, monkeypatch):
    """A flight that turns out to have ended and then not to have: gone through again, whatever had been kept."""
    vehicle, flight, plan, mixing, whole = flown
    monkeypatch.setattr(account, "REPLAY_S", 12.0)
    one = Diagnoser(vehicle, allocation.laid_out(vehicle, flight), plan, mixing)
    back = account.Account(one)
    for first, last in itertools.pairwise([*range(0, len(whole), 400), len(whole)]):
        judged = Judged.joined(one.feed(whole.part(first, last)))
        if judged is not None:
            back.add(judged)
    back.keep(one.spans)
    (start, _), known = one.spans[0], one.losses.events(True)
    assert known
    back.keep(((start, known[0].onset_s - 1.0),))
    assert one.losses.events(True) == ()
    back.keep(((start, np.inf),))
    assert one.losses.events(True) == known
    one.finish(flight.duration)
    assert one.losses.events() == at_once[1] and one.report.events(one.losses.events(), ()) == at_once[2]


def test_what_comes_after_a_fall_lies_on_the_ground(flown, at_once):
    """The flight ended, as only what comes after it shows, before the rotor failed: nothing is said of it, and nothing judged."""
    vehicle, flight, plan, mixing, whole = flown
    (event,) = at_once[1]
    one = Diagnoser(vehicle, allocation.laid_out(vehicle, flight), plan, mixing)
    until = int(np.searchsorted(whole.time, event.onset_s - 5.0))
    one.feed(whole.part(0, until))
    one.fell(event.onset_s - 6.0)
    after = Judged.joined([*one.feed(whole.part(until, len(whole))), *one.finish(flight.duration)])
    assert after is not None and not after.out.announced.any() and one.losses.events() == ()
