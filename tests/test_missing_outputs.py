"""Commands of a rotor that a log or a link lacks in the air: what cannot be seen is not healthy, and what was seen stays."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rotorwatch import airframes, diagnose
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion.air_spans import GAP_S, airborne, gaps
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN, READY_S
from rotorwatch.live.session import Session
from rotorwatch_lab.simulation import scenario, simulate


@cache
def flown(seed=1, loss=0.0):
    """A quad in wind, in the air until the end of the log; rotor 2 may lose thrust at 20 s."""
    faults = [{"kind": "loss", "rotor": 2, "onset_s": 20.0, "strength": loss}] if loss else []
    table = {"duration_s": 45.0, "seed": seed, "airframe": {"frame": "quad-x"}, "faults": faults}
    table |= {"trajectory": {"kind": "figure-eight", "land": False, "speed_m_s": 4.0}, "wind": {"speed_m_s": 5.0}}
    return simulate(scenario.from_table(table)).flight


def without(flight, rotors, start, end=np.inf):
    """The flight without the commands of some rotors, from start to end [s]."""
    motors = flight["motors"]
    gone = ((motors.time >= start) & (motors.time < end))[:, None] & np.isin(np.arange(4) + 1, rotors)
    return replace(flight, signals={**flight.signals, "motors": replace(motors, valid=motors.valid & ~gone)})


EVERY = (1, 2, 3, 4)


@pytest.mark.parametrize("rotors", [(3,), (1, 2), EVERY])
def test_what_is_not_seen_to_the_end_is_not_healthy(rotors):
    answer = diagnose(without(flown(), rotors, 30.0))
    assert answer.verdict == "inconclusive" and not answer.events
    assert {r.status for r in answer.rotors} == {"unobservable"}
    (warning,) = [w for w in answer.warnings if "to the end of the flight" in w]
    who = "No motor outputs" if rotors == EVERY else f"rotor{'s' if len(rotors) > 1 else ''} {' and '.join(map(str, rotors))} "
    assert who in warning
    assert all(("no command" in r.note) == (r.rotor in rotors) for r in answer.rotors)
    for text in (warning, answer.reason, answer.headline):
        (since,) = {round(float(s), 1) for s in re.findall(r"(\d+\.\d+) s", text)}
        assert since == pytest.approx(30.0, abs=0.2)


def test_what_was_assessed_before_stays_assessed():
    whole, cut = (diagnose(f) for f in (flown(2, 0.4), without(flown(2, 0.4), (3,), 30.0)))
    assert whole.verdict == cut.verdict == "fault"
    assert whole.events[0].rotors == cut.events[0].rotors == (2,)
    assert cut.events[0].onset_s == whole.events[0].onset_s
    assert [r.status for r in cut.rotors] == ["unobservable", "degraded", "unobservable", "unobservable"]


@pytest.mark.parametrize("missing_s", [GAP_S - 1.0, GAP_S + 1.0])
def test_commands_that_come_back_are_assessed_again(missing_s):
    flight = without(flown(), (3,), 25.0, 25.0 + missing_s)
    answer = diagnose(flight)
    assert answer.verdict == "healthy"
    assert any("rotor 3" in w for w in answer.warnings) == (missing_s > GAP_S) == bool(gaps(flight, airborne(flight)))


@pytest.mark.parametrize("start_s", [0.0, 4.5])
def test_a_flight_is_learned_before_it_is_assessed_whenever_its_commands_begin(start_s):
    """Missing since before lift-off or shortly after it, for longer than the blind time."""
    flight, vehicle = without(flown(), (3,), start_s, 25.0), airframes.identify(flown())
    whole, table = (observe(f, vehicle, airborne(f), READY_S) for f in (flown(), flight))
    assert table is not None and whole is not None and table.seen is not None
    before = (table.mode == LEARN) & table.seen
    assert before.sum() * table.dt >= READY_S / 3.0
    np.testing.assert_allclose(table.hover[table.mode == ASSESS], np.median(whole.hover), rtol=0.3)
    answer = diagnose(flight)
    assert not answer.events and answer.verdict == "inconclusive"  # most of the flight could not be assessed
    assert "s assessed of" in answer.headline


def test_a_rotor_that_is_never_commanded_is_said():
    answer = diagnose(without(flown(), (3,), 0.0))
    assert answer.verdict == "inconclusive" and "no command for rotor 3" in answer.reason


def test_a_link_that_lacks_a_rotor_is_blind_and_says_so():
    flight = without(flown(), (3,), 20.0, 30.0)
    vehicle = airframes.identify(flight)
    session, seen = Session(replace(flight, signals={}), vehicle), {}
    for time in np.arange(0.0, flight.duration, 0.5):
        session.add({k: s.between(time, time + 0.5) for k, s in flight.signals.items() if len(s.between(time, time + 0.5))})
        session.advance(time)
        seen[float(time)] = session.blind(), [gap.rotors for gap in session.missing]
    assert "rotor 3" in seen[28.0][0] and seen[28.0][1] == [(3,)]
    assert seen[40.0] == ("", [])
    (gap,) = gaps(flight, airborne(flight))
    assert (gap.rotors, gap.lasts) == ((3,), False)
    ended = Session(replace(flight, signals={}), vehicle)
    cut = without(flown(), (3,), 30.0)
    ended.add(cut.signals)
    ended.advance(cut.duration)
    ended.finish(cut.duration)
    (live,), (logged,) = ended.missing, gaps(cut, airborne(cut))
    assert live == logged
