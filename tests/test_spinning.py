"""Vehicles that lose rotors, spin and fly on: who went off, when, and how the answer, the story and a link tell it."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests import onboard_law
from tests.spinning_flights import HOVER_S, IDLE_S, fly

from rotorwatch import diagnose
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.base.physics import G0
from rotorwatch.engine.definition import ENGINE, craft
from rotorwatch.engine.intake.sense import Sensed
from rotorwatch.engine.intake.sizes import ROTORS, SETS
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.spin import many_ticks
from rotorwatch.engine.spin.rotors_off import RotorsOff
from rotorwatch.engine.spin.subsets import sets_of
from rotorwatch.engine.spin.turning import SPUN
from rotorwatch.flight import Flight
from rotorwatch.flight.kinds import CONTACT, LOSS, LOST
from rotorwatch.live.session import Session
from rotorwatch.witnesses.upset import loss_of_control, spinning

REAL = Path(__file__).parent / "real"
BEGINS_S = IDLE_S + HOVER_S
ONE = ((0.0, (2,)),)
THEN_OPPOSITE = ((0.0, (0,)), (8.0, (1,)))
AT_ONCE = ((0.0, (0, 1)),)
OVER = ((0.0, (0,)), (5.0, (1,)), (10.0, ()))  # all work again at last


@functools.cache
def flown(losses, hz=20.0):
    return fly(losses, 16.0, seed=len(losses), hz=hz)


@functools.cache
def answer(losses, hz=20.0):
    return diagnose(*flown(losses, hz))


def lost(diagnosis):
    return next(e for e in diagnosis.events if e.kind == LOST)


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("hz", [20.0, 10.0])
@pytest.mark.parametrize("losses", [ONE, THEN_OPPOSITE, AT_ONCE])
def test_every_rotor_that_went_off_is_named_and_nobody_else(losses, hz):
    diagnosis = answer(losses, hz)
    assert diagnosis.verdict == "fault"
    truth = sorted((BEGINS_S + at, rotor + 1) for at, who in losses for rotor in who)
    reported = sorted((e.rotors[0], e.onset_s) for e in diagnosis.events if e.kind == LOSS)
    assert [rotor for rotor, _ in reported] == sorted(rotor for _, rotor in truth)
    for rotor, onset in reported:
        assert abs(onset - next(at for at, who in truth if who == rotor)) < 0.3
    assert all(not e.alternatives and e.end_s is None for e in diagnosis.events if e.kind == LOSS)
    assert not any(e.kind == CONTACT for e in diagnosis.events)


@pytest.mark.parametrize("losses", [ONE, THEN_OPPOSITE, AT_ONCE])
def test_a_spin_is_no_fall(losses):
    event = lost(answer(losses))
    flight, _ = flown(losses)
    rate = np.abs(flight["gyro"].values[:, 2])
    fast = flight["gyro"].time[rate > SPUN]
    assert event.extra["impact_s"] is None and event.end_s is None
    assert event.extra["spins_from_s"] == pytest.approx(fast[0], abs=0.5)
    assert event.extra["spins_until_s"] == pytest.approx(flight.duration, abs=0.1)
    assert 2.0 * np.pi * event.extra["turns_per_s"] == pytest.approx(np.median(rate[rate > SPUN]), rel=0.1)


def test_the_story_says_that_it_flew_on_and_what_it_lost_then():
    text = [line.text for line in answer(THEN_OPPOSITE).story]
    flew = next(k for k, t in enumerate(text) if "It flew on for" in t and "times a second" in t)
    assert "rotor 2" in text[flew + 1] and "Control was lost" in text[flew - 1]
    assert not any("hit the ground" in t for t in text)


def test_a_link_names_them_while_the_vehicle_spins():
    flight, vehicle = flown(THEN_OPPOSITE)
    session = Session(Flight(flight.format, flight.autopilot, {}, 0.0), vehicle)
    named, revision = {}, None
    for t in np.arange(0.0, flight.duration, 0.2):
        session.add({name: part for name, s in flight.signals.items() if len(part := s.between(t, t + 0.2))})
        session.advance(t + 0.2)
        if session.revision != revision:
            revision = session.revision
            for e in session.events():
                if e.kind == LOSS and not e.alternatives:
                    named.setdefault(e.rotors, t + 0.2)
                assert e.kind != LOST or e.extra["impact_s"] is None
    assert set(named) == {(1,), (2,)}
    assert named[(1,)] < BEGINS_S + 1.0
    assert named[(2,)] < BEGINS_S + 8.0 + 2.0
    assert session.flying
    assert session.blind().startswith("spinning")
    session.finish(flight.duration)
    assert session.spans[-1][1] == pytest.approx(flight.duration, abs=0.2)
    assert {e.rotors for e in session.events() if e.kind == LOSS and e.end_s is None} == {(1,), (2,)}


def test_a_loss_that_ends_is_said_to_be_over():
    diagnosis = answer(OVER)
    ends = {e.rotors: e.end_s for e in diagnosis.events if e.kind == LOSS}
    assert set(ends) == {(1,), (2,)}
    assert all(end is not None and BEGINS_S + 10.0 < end < BEGINS_S + 12.0 for end in ends.values())


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """(events, verdict) of a flight by the C library in single precision, fed by a loop of 100 Hz. All have the same rates: one library."""
    folder = tmp_path_factory.mktemp("board")

    def reported(losses):
        flight, vehicle = flown(losses)
        events, verdict, _ = onboard_law.events_in_c(folder, onboard_law.on_board(flight, 100.0, vehicle), single=True)
        return [dict(zip(("kind", "onset", "detected", "end", "rotors", "loss", "lower"), e)) for e in events], verdict

    return reported


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("losses", [AT_ONCE, ONE, THEN_OPPOSITE, OVER])
def test_a_board_tells_what_a_log_tells(board, losses):
    events, verdict = board(losses)
    desk = {sum(1 << r - 1 for r in e.rotors): e for e in answer(losses).events if e.kind == LOSS}
    assert verdict == 2 and {int(e["rotors"]) for e in events} == set(desk), "a fault, and no contact or other rotor"
    for e in events:
        same = desk[int(e["rotors"])]
        assert e["onset"] == pytest.approx(same.onset_s, abs=0.15)
        assert e["end"] >= LASTS if same.end_s is None else e["end"] == pytest.approx(same.end_s, abs=0.5)
        assert e["lower"] > 0.3


def test_rotors_that_carried_no_part_before_are_not_named():
    """Without controlled flight before the spin nothing shows that all rotors worked."""
    flight, vehicle = flown(ONE)
    left = loss_of_control.find(flight, airborne(flight))[0]
    whole, late = (spinning.find(flight, vehicle, left, start) for start in (IDLE_S, BEGINS_S - 0.5))
    assert whole is not None and late is not None
    assert whole.off and not late.off


def test_a_vehicle_that_sinks_fast_does_not_fly_on():
    flight, vehicle = flown(ONE)
    v = flight["velocity"]
    sinks = v.with_arrays(v.time, v.values + np.array([0.0, 0.0, 4.0]), v.valid)
    falling = replace(flight, signals={**flight.signals, "velocity": sinks})
    left = loss_of_control.find(flight, airborne(flight))[0]
    assert spinning.find(flight, vehicle, left, IDLE_S) is not None
    assert spinning.find(falling, vehicle, left, IDLE_S) is None


def test_a_yaw_rate_that_is_commanded_is_no_loss_of_control():
    flight, _ = flown(ONE)
    gyro = flight["gyro"]
    slow = gyro.with_arrays(gyro.time, gyro.values * [1.0, 1.0, 0.9], gyro.valid)
    wanted = replace(slow, source="wanted")
    fast = replace(flight, signals={**flight.signals, "gyro": slow})
    asked = replace(fast, signals={**fast.signals, "rates_wanted": wanted})
    time = flight["attitude"].time
    assert loss_of_control._spins(fast, time).any()
    assert not loss_of_control._spins(asked, time).any()


B = np.array([[-1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])


def chain_of(off, power=1.0, seed=1):
    """(probability of each rotor to be off (K, 4), sets as bits, probability of each at last) of ticks in which the rotors `off` [of each
    tick] are off: the others turn and carry the vehicle as `subsets` says, and those are demanded as much."""
    rng, state, rows, p = np.random.default_rng(seed), ENGINE.new(RotorsOff), ENGINE.array(Sensed, 1), []
    vehicle = craft(4, effectiveness=B)
    ENGINE.call(many_ticks.begin, state)
    chain = state.part("chain")
    sets = each = np.zeros(0)
    J, k, lever, usual = np.array([0.02, 0.02, 0.5]), 0.8, np.array([0.01, -0.01, -0.02]), np.array([0.5, -5.0, -25.0])
    for at, who in enumerate(off):
        rate = usual + rng.normal(0.0, 0.3, 3)
        thrust = (4 / (4 - len(who))) ** (1 / power) * rng.uniform(0.8, 1.2, 4)
        wrench = B @ np.where(np.isin(np.arange(4), who), 0.0, thrust**power)
        spin = k * np.array([rate[1] * rate[2], -rate[0] * rate[2], 0.0])
        turn = (wrench[:3] - [0.0, 0.0, 0.004 * rate[2] * abs(rate[2])]) / J - spin
        force = np.array([0.0, 0.0, -wrench[3] / 4.0 * G0]) + np.cross(turn, lever) + np.cross(rate, np.cross(rate, lever))
        rows.set(
            time=0.05 * at,
            some=True,
            rate_ok=True,
            load_ok=True,
            share=0.5 * thrust,
            rate=rate,
            rate_dot=turn,
            push=force[:2],
            load=-force[2] / G0,
        )
        ENGINE.call(many_ticks.follow, state, vehicle, 0.05, 0.5, 1, rows, -1.0, 1e9)
        count = int(chain["count"][0])
        sets, each = chain["off"].reshape(-1)[:count], chain["probability"].reshape(-1)[:count]
        p.append([each[sets >> i & 1 == 1].sum() for i in range(4)])
    return np.array(p), sets, each


@pytest.mark.parametrize("off", [(), (2,), (0, 1), (0, 3)])
@pytest.mark.parametrize("power", [1.0, 1.5])  # a stronger curve than in hover needs flight that shows it
def test_the_balance_of_a_spinning_body_tells_every_set(off, power):
    _, sets, each = chain_of([()] * 61 + [off] * 239, power)
    assert sets[int(np.argmax(each))] == sum(1 << i for i in off)
    assert each.max() > 0.9
    assert each.sum() == pytest.approx(1.0)


def test_a_rotor_that_comes_back_is_reported():
    p, _, _ = chain_of([()] * 101 + [(2,)] * 199 + [()] * 300, seed=2)
    assert p[:100, 2].max() < 0.1 and p[130:300, 2].min() > 0.9 and p[340:, 2].max() < 0.1


def test_sets_of_many_rotors_stay_few():
    assert sets_of(4) == 15 and sets_of(8) == 37 and sets_of(12) == 79
    assert max(map(sets_of, range(1, ROTORS + 1))) == SETS


def test_a_real_quadrotor_that_lost_two_rotors():
    """tests/real/SOURCE.md: a controller that does not know, outputs at 10 Hz, a thrust curve that is not in the vehicle's file."""
    diagnosis = diagnose(REAL / "lost_rotors.csv.xz", REAL / "lost_rotors.toml")
    losses = {e.rotors: e.onset_s for e in diagnosis.events if e.kind == LOSS and not e.alternatives and e.end_s is None}
    assert losses == {(1,): pytest.approx(7.53, abs=0.3), (2,): pytest.approx(12.1, abs=0.3)}
    assert lost(diagnosis).extra["impact_s"] is None
    assert lost(diagnosis).extra["spins_until_s"] > 14.5
