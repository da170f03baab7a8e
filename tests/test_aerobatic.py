"""Vehicles that never hover: the response of their angular motion, and losses that it shows over seconds."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rotorwatch import airframes, diagnose
from rotorwatch.calibrate import calibrate
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion.tick_table import ASSESS, READY_S
from rotorwatch.flight import Flight, Signal
from rotorwatch.witnesses.aerobatic import assess
from rotorwatch.witnesses.aerobatic.response import respond
from rotorwatch_lab.simulation import fpv, scenario, simulate

CRAFT = airframes.named("betaflight-quad-x")
B = CRAFT.effectiveness()
GAIN, DAMPING, LAG_S, DT, ALOFT = np.array([140.0, 90.0, 30.0]), np.array([0.5, 1.0, 0.5]), 0.03, 0.001, ((2.0, 59.0),)


# Flights of one batch: a seed, and (rotor from 0, share, from s) of each loss.
LOST = {
    "healthy": (0, ()),
    "first": (1, ((0, 0.3, 30.0),)),
    "last": (4, ((3, 0.5, 30.0),)),
    "weak": (1, ((0, 0.4, 30.0),)),
    "two": (9, ((1, 0.4, 20.0), (2, 0.4, 40.0))),
    "again": (5, ((1, 0.5, 20.0), (1, 0.0, 40.0))),
}


@cache
def flights(seconds=60.0, gust=0.03):
    """A quad that rolls and pitches as commanded, with thrust from idle to full. gust: coloured torque noise [full thrusts of a rotor].
    A rate controller at 1 kHz, thrusts by the airframe's curve."""
    count, many, mix = round(seconds / DT), len(LOST), np.linalg.inv(B)
    time, health = DT * np.arange(count), np.ones((count, many, 4))
    wanted, throttle, noise = np.zeros((count, many, 3)), np.zeros((count, many)), np.zeros((count, many, 3))
    for j, (seed, losses) in enumerate(LOST.values()):
        rng = np.random.default_rng(seed)
        wanted[:, j] = np.repeat(rng.normal(0.0, [6.0, 4.0, 1.0], (count // 400 + 1, 3)), 400, axis=0)[:count]
        throttle[:, j] = np.repeat(rng.uniform(0.15, 0.55, count // 700 + 1), 700)[:count]
        noise[:, j] = rng.normal(0.0, 1.0, (count, 3))
        for rotor, share, start in losses:
            health[time >= start, j, rotor] = 1.0 - share
    rate, thrust, integral, wind = (np.zeros((many, 3)), np.full((many, 4), 0.3), np.zeros((many, 3)), np.zeros((many, 3)))
    asked, seen = np.zeros((count, many, 4)), np.zeros((count, many, 3))
    for k in range(count):
        seen[k] = rate + 0.02 * noise[k]
        integral = np.clip(integral + 0.1 * (wanted[k] - seen[k]) * DT, -0.5, 0.5)
        torque = np.clip(0.03 * (wanted[k] - seen[k]), -0.25, 0.25) + integral
        asked[k] = np.clip(torque @ mix[:, :3].T + 4.0 * throttle[k][:, None] * mix[:, 3], 0.02, 1.0)
        thrust += (asked[k] - thrust) * DT / LAG_S
        wind += -wind * DT / 0.4 + gust * np.sqrt(2.0 * DT / 0.4) * noise[k - 1]
        rate = rate + DT * (GAIN * ((thrust * health[k]) @ B[:3].T + wind) - DAMPING * rate)
    expo, low, high = CRAFT.curve.expo, CRAFT.curve.u_min, CRAFT.curve.u_max
    drive = (np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * asked) - (1.0 - expo)) / (2.0 * expo)
    motors = low + drive * (high - low)
    return {
        name: Flight(
            "Blackbox",
            "Betaflight",
            {"motors": Signal(time, motors[:, j], tuple("0123"), "1"), "gyro": Signal(time, seen[:, j], ("x", "y", "z"), "rad/s", "FRD")},
            seconds,
        )
        for j, name in enumerate(LOST)
    }


def assessed(flight):
    """Losses of a flight in the air from 2 to 59 s."""
    table, out = assess.estimate(flight, CRAFT, ALOFT, observe(flight, CRAFT, ALOFT, READY_S))
    return event_rows.read(out, table, B), table, out


@pytest.fixture(scope="module")
def healthy():
    return flights()["healthy"]


def test_the_response_is_that_of_the_vehicle(healthy):
    seen = respond(healthy, CRAFT, ALOFT)
    assert seen is not None and seen.lag_s == pytest.approx(LAG_S, abs=0.011)
    np.testing.assert_allclose(seen.gain, GAIN, rtol=0.12)
    assert np.abs(seen.missing[seen.flies].mean(axis=0)).max() < 0.03


def test_motion_that_does_not_answer_the_outputs_is_not_assessed(healthy):
    gyro = healthy["gyro"]
    still = replace(healthy, signals={**healthy.signals, "gyro": gyro.with_arrays(gyro.time, -gyro.values, gyro.valid)})
    found, table, _ = assessed(still)
    assert found == () and not (table.mode == ASSESS).any()


def test_nothing_is_found_in_healthy_flight(healthy):
    found, table, out = assessed(healthy)
    assert found == () and (table.mode == ASSESS).sum() * table.dt == pytest.approx(46.0, abs=1.5)
    assert 0.03 < 1.96 * out.detectable[table.mode == ASSESS][-1].max() < 0.4  # a loss that could have gone undetected


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", ["first", "last"])
def test_a_loss_is_found_in_rolls_and_flips(name):
    ((rotor, share, _),) = LOST[name][1]
    (event,), _, _ = assessed(flights()[name])
    assert event.rotors == (rotor + 1,) and event.end_s is None and event.alternatives == ()
    assert event.onset_s == pytest.approx(30.0, abs=2.5) and 30.0 < event.detected_s < 42.0
    low, high = event.interval[0]
    assert low <= share <= high and event.loss[0] == pytest.approx(share, abs=0.1)


def test_a_second_loss_is_another_event():
    found, _, _ = assessed(flights()["two"])
    assert [e.rotors for e in found] == [(2,), (3,)]


def test_a_rotor_that_works_again_ends_its_event():
    """Half of its thrust is lost from 20 to 40 s."""
    (event,), _, _ = assessed(flights()["again"])
    assert event.rotors == (2,) and event.end_s == pytest.approx(40.0, abs=3.0)


def test_a_step_of_the_trim_is_no_loss(healthy):
    """A battery that slips turns the vehicle in roll alone, which no rotor does."""
    time, turned = healthy["gyro"].time, healthy["gyro"].values.copy()
    motors = healthy["motors"].values.copy()
    motors[time > 30.0] += 0.06 * (CRAFT.curve.u_max - CRAFT.curve.u_min) * np.sign(B[0])
    slipped = replace(
        healthy,
        signals={
            "motors": healthy["motors"].with_arrays(time, motors, motors > 0),
            "gyro": healthy["gyro"].with_arrays(time, turned, np.ones_like(turned, bool)),
        },
    )
    assert assessed(slipped)[0] == ()


def test_it_is_what_diagnose_does_with_logs_of_such_firmware(healthy):
    answer = diagnose(healthy, vehicle=CRAFT)
    assert answer.verdict == "healthy" and any("does not hover" in a for a in answer.assumptions)
    assert not any(e.kind == "contact" for e in answer.events)  # turning at 15 rad/s^2 is no knock
    weak = diagnose(flights()["weak"], vehicle=CRAFT)
    assert weak.verdict == "fault" and weak.rotors[0].loss > 0.2


def test_flights_that_never_hover_are_not_compared_with_healthy_ones():
    """The balance of hover says nothing here: what was wrong from take-off on is not assessed, and the answer says so."""
    first, second = fpv.fly(2, 30.0, 3)
    known = calibrate([first])
    answer = diagnose(second, vehicle=known)
    assert known.identified and known.identified["whole_flight"]
    assert answer.whole_flight is None and all(r.from_takeoff == "not assessed" for r in answer.rotors)
    assert any("not compared with healthy ones" in sentence for sentence in answer.assumptions)


def flown_without(names, spoilt=()):
    """A flight with a weak rotor whose log lacks signals, or the second axis of some."""
    flight = flights()["weak"]
    signals = {k: s for k, s in flight.signals.items() if k not in names}
    signals |= {k: replace(signals[k], valid=signals[k].valid & [True, False, True]) for k in spoilt}
    return replace(flight, signals=signals)


@pytest.mark.parametrize("spoilt", [False, True])
def test_without_a_gyro_the_answer_says_so(spoilt):
    answer = diagnose(flown_without(() if spoilt else ("gyro",), ("gyro",) if spoilt else ()), CRAFT)
    assert answer.verdict == "inconclusive" and not answer.events
    assert {r.status for r in answer.rotors} == {"unobservable"}
    assert "gyro" in answer.reason


def test_without_a_gyro_the_rates_of_the_controller_tell_the_same():
    flight = flights()["weak"]
    rates = {"motors": flight["motors"], "rates": flight["gyro"]}
    assert diagnose(replace(flight, signals=rates), CRAFT).events == diagnose(flight, CRAFT).events


def test_the_motion_decides_which_way_assesses_and_not_the_firmware(healthy):
    """One that hovers is assessed by its balance, one that rolls and flips by its angular motion, whoever wrote the log."""
    table = {"duration_s": 40.0, "autopilot": "px4", "airframe": {"frame": "quad-x"}, "logging": {"profile": "full"}}
    calm = replace(simulate(scenario.from_table(table)).flight, autopilot="INAV")
    answers = (diagnose(calm, vehicle=airframes.named("px4-quad-x")), diagnose(replace(healthy, autopilot="PX4"), vehicle=CRAFT))
    assert [any("does not hover" in a for a in answer.assumptions) for answer in answers] == [False, True]
    assert max(r.since_takeoff[1] for r in answers[0].rotors) < 0.1
    mute = replace(calm, signals={k: v for k, v in calm.signals.items() if k not in ("gyro", "rates")})
    assert assess.applies(mute, None) and not assess.applies(replace(mute, autopilot="PX4"), None)
