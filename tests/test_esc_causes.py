"""The ESC consistency check: causes on simulated flights, notices without a loss, and telemetry that is not to be believed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rotorwatch as rw
from rotorwatch.diagnose import diagnose
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.flight import Signal
from rotorwatch.report.html import page
from rotorwatch.witnesses.esc import changed as watch
from rotorwatch.witnesses.esc import consistency, stopped, telemetry
from rotorwatch.witnesses.healthy import baselines
from rotorwatch_lab.experiments.studies import esc_causes
from rotorwatch_lab.simulation import scenario, simulate

ONSET = 35.0
FAULTS = {
    "propeller": {"kind": "loss", "strength": 0.3},
    "chipped": {"kind": "chipped", "strength": 0.25},
    "motor": {"kind": "weak motor", "strength": 0.3},
    "bearing": {"kind": "bearing", "strength": 0.45},
    "half": {"kind": "weak motor", "strength": 0.45},
    "small": {"kind": "weak motor", "strength": 0.05},
    "rough": {"kind": "bearing", "strength": 0.2},
    "dead": {"kind": "float"},
    "thrown": {"kind": "complete loss"},
    "healthy": None,
}


@cache
def flight(what, autopilot="ardupilot", frame="quad-x", wind=3.0):
    faults = [{"rotor": 2, "onset_s": ONSET, **FAULTS[what]}] if FAULTS[what] else []
    table = {
        "duration_s": 70.0,
        "seed": 3,
        "autopilot": autopilot,
        "airframe": {"frame": frame},
        "wind": {"speed_m_s": wind},
        "trajectory": {"kind": "square", "altitude_m": 6.0},
        "logging": {"esc": True, "profile": "fast"},
        "faults": faults,
    }
    return simulate(scenario.from_table(table)).flight


@cache
def answer(*given):
    return rw.diagnose(flight(*given))


def losses(found):
    return [e for e in found.events if e.kind == "loss_of_effectiveness"]


def notices(found):
    return {(e.kind, e.rotors) for e in found.events if e.kind in watch.SIGN}


@pytest.mark.thorough(keep=3)
@pytest.mark.parametrize("autopilot, frame", [("ardupilot", "quad-x"), ("px4", "hexa-x")])
@pytest.mark.parametrize("what, cause", [("propeller", "propeller"), ("chipped", "propeller"), ("motor", "motor_or_esc")])
def test_the_cause_of_a_loss(what, cause, autopilot, frame):
    (event,) = losses(answer(what, autopilot, frame))
    assert event.rotors == (2,) and event.extra["cause"] == cause
    assert event.extra["causes"][cause] > 0.9 and sum(event.extra["causes"].values()) == pytest.approx(1.0)


def test_a_bearing_that_costs_thrust():
    (event,) = losses(answer("bearing", "px4", "quad-x", 0.0))
    assert event.extra["cause"] == "bearing" and event.extra["esc"][0]["current_ratio"] > 1.4
    assert "more current than this speed needs, so the cause is the bearing" in event.reason


@pytest.mark.parametrize("what, speed, propeller", [("propeller", 0.0, 0.3), ("motor", 0.3, 0.0)])
def test_a_loss_is_split_into_speed_and_propeller(what, speed, propeller):
    (event,) = losses(answer(what))
    (reported,) = event.extra["esc"]
    low, high = reported["speed_loss_interval"]
    assert low - 0.005 <= speed <= high + 0.005, reported
    # What commands and motion make of the whole loss is not this check's.
    assert reported["propeller_loss"] == pytest.approx(propeller, abs=0.09)
    whole = 1.0 - (1.0 - reported["speed_loss"]) * (1.0 - reported["propeller_loss"])
    assert whole == pytest.approx(event.loss[0], abs=0.03)


def test_the_answer_is_the_same_in_every_view():
    found = answer("propeller")
    assert "by its propeller" in found.headline and "so the cause is the propeller" in found.reason
    assert any("the propeller first" in step for step in found.advice)
    html = page(replace(found, trace=None))  # without plots it is made faster
    assert "by its propeller" in html and "so the cause is the propeller" in html
    (event,) = [e for e in found.to_dict()["events"] if e["kind"] == "loss_of_effectiveness"]
    assert event["cause"] == "propeller" and event["esc"][0]["rotor"] == 2


def test_without_telemetry_nothing_changes():
    whole = flight("propeller")
    bare = replace(whole, signals={k: v for k, v in whole.signals.items() if k != "esc"})
    with_, without = answer("propeller"), rw.diagnose(bare)
    assert without.warnings == with_.warnings and without.verdict == with_.verdict
    (a,), (b,) = losses(with_), losses(without)
    assert (a.onset_s, a.detected_s, a.loss, a.interval) == (b.onset_s, b.detected_s, b.loss, b.interval)
    assert "cause" not in b.extra and "ESC" not in b.reason


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("autopilot, frame", [("ardupilot", "quad-x"), ("px4", "hexa-x")])
def test_a_healthy_flight_has_no_notice(autopilot, frame):
    found = answer("healthy", autopilot, frame)
    assert found.verdict == "healthy" and found.events == ()


def test_a_motor_that_becomes_a_little_slow_is_a_notice():
    found = answer("small", "ardupilot", "hexa-x", 6.0)
    assert notices(found) == {("slow_motor", (2,))} and found.verdict == "healthy"
    (event,) = (e for e in found.events if e.kind == "slow_motor")
    assert event.onset_s == pytest.approx(ONSET, abs=1.0) and ONSET + 5.0 < event.detected_s < ONSET + 20.0
    low, high = event.extra["change_interval"]
    assert low - 0.01 < 0.05 < high + 0.01
    assert "turns slower than commanded, since" in found.headline and any("connectors" in step for step in found.advice)
    assert "turns slower than commanded" in found.rotors[1].note


def test_a_motor_that_draws_more_is_a_notice():
    found = answer("rough", "ardupilot", "hexa-x", 6.0)
    assert ("high_current", (2,)) in notices(found) and not {who for _, who in notices(found)} - {(2,)}
    assert "draws more current than before" in found.headline and any("bearings" in step for step in found.advice)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_dead_motor_of_a_quad_is_found_before_it_is_down(autopilot):
    found = answer("dead", autopilot)
    (event,) = losses(found)
    assert event.rotors == (2,) and event.extra["cause"] == "motor_or_esc" and event.interval[0][0] >= 0.9
    named = min(e.detected_s for e in found.events if e.rotors == (2,))  # by its loss, or as what control was lost by
    assert ONSET < named < ONSET + 1.0 and found.verdict == "fault"


def test_a_thrown_propeller_of_a_quad():
    (event,) = losses(answer("thrown", "px4"))
    assert event.rotors == (2,) and event.extra["cause"] == "propeller" and event.detected_s < ONSET + 1.5


def test_a_notice_is_reported_with_what_was_known():
    """Nothing after the moment of telling counts: the log cut there, plus a bin, tells the same."""
    whole = flight("small", "ardupilot", "hexa-x", 6.0)
    (event,) = (e for e in answer("small", "ardupilot", "hexa-x", 6.0).events if e.kind == "slow_motor")
    (cut,) = (e for e in rw.diagnose(whole.until(event.detected_s + 2.0)).events if e.kind == "slow_motor")
    assert cut.detected_s == event.detected_s and cut.extra == event.extra


# -- telemetry that is not to be believed --------------------------------------------------------------------------------


def changed(what, change, *given):
    """The flight with its telemetry changed by `change(time, values, valid)`, a quad's, in place."""
    whole = flight(what, *given)
    esc = whole["esc"]
    values, valid = esc.values.copy(), esc.valid.copy()
    change(esc.time, values, valid)
    return replace(whole, signals={**whole.signals, "esc": replace(esc, values=values, valid=valid)})


def freeze(time, values, valid):
    values[time > 30.0, 1::4] = values[np.searchsorted(time, 30.0), 1::4]


def silence(time, values, valid):
    valid[:, 1::4] = False


def zeros(time, values, valid):
    values[:, :8] = 0.0


def one_zero(time, values, valid):
    values[:, 1] = 0.0


def late(time, values, valid):
    n = round(1.5 / np.median(np.diff(time)))
    values[n:] = values[:-n].copy()


def swap(time, values, valid):
    for k in range(0, 16, 4):
        values[:, [k, k + 1, k + 2, k + 3]] = values[:, [k + 1, k + 2, k + 3, k]]


@pytest.mark.thorough(keep=3)
@pytest.mark.parametrize(
    "change, said",
    [
        (freeze, "ESC telemetry of rotor 2 does not change between 3"),
        (silence, "ESC telemetry of rotor 2 is missing in flight"),
        (zeros, "reports no speed in flight (not connected"),
        (one_zero, "ESC telemetry of rotor 2 reports no speed in flight"),
        (late, " s after they were sent: its time stamps are wrong"),
        (swap, "numbered differently"),
    ],
)
def test_telemetry_that_lies_is_noticed_and_not_used(change, said):
    found = rw.diagnose(changed("motor", change))
    assert [w for w in found.warnings if said in w], found.warnings
    (event,) = losses(found)
    assert "cause" not in event.extra and event.rotors == (2,)
    healthy = rw.diagnose(changed("healthy", change))
    assert healthy.verdict == "healthy" and healthy.events == ()
    assert [w for w in healthy.warnings if said in w] or change is freeze


def test_a_rotor_that_is_said_to_stand_while_the_vehicle_flies_on():
    def stop(time, values, valid):
        values[time > 40.0, 1] = 0.0

    found = rw.diagnose(changed("healthy", stop))
    assert found.verdict == "healthy" and found.events == ()
    assert [w for w in found.warnings if "flies on without a loss" in w]


def test_a_gap_in_the_telemetry_is_no_dead_motor():
    def gap(time, values, valid):
        values[(time > 40.0) & (time < 41.0), 1] = 0.0
        valid[(time > 45.0) & (time < 50.0)] = False

    assert rw.diagnose(changed("healthy", gap)).events == ()


def test_a_speed_that_the_motion_denies_is_wrong_telemetry():
    def slower(time, values, valid):
        values[time > 40.0, 1] *= 0.7

    found = rw.diagnose(changed("healthy", slower))
    assert found.events == ()
    assert [w for w in found.warnings if "the speed is not used" in w]


def test_a_large_loss_of_speed_that_the_motion_missed():
    """Where commands and motion were silent, a speed that falls and a current that falls with it are a loss."""
    whole = flight("half")
    craft, _, _ = baselines.settle(whole, None, (), diagnose)
    air = airborne(whole)
    events, warnings = consistency.check(whole, craft, air, observe(whole, craft, air, 8.0), ())
    (event,) = events
    assert event.kind == "loss_of_effectiveness" and event.rotors == (2,) and event.extra["cause"] == "motor_or_esc"
    assert event.interval[0][0] - 0.02 < 0.45 < event.interval[0][1] + 0.02 and warnings == ()
    assert event.onset_s == pytest.approx(ONSET, abs=1.0) and "its current fell with it" in event.reason


def test_without_current_sensors_speed_alone_tells_motor_from_propeller():
    def none(time, values, valid):
        values[:, 4:8] = 0.0

    for what, cause in (("motor", "motor_or_esc"), ("propeller", "propeller")):
        (event,) = losses(rw.diagnose(changed(what, none)))
        reported = event.extra["esc"][0]
        assert reported["current_ratio"] is None and max(reported["causes"], key=reported["causes"].get) == cause


def test_frozen_needs_a_command_that_asks_for_a_change():
    time = np.arange(0.0, 20.0, 0.1)
    still = telemetry.Quantity(np.full((200, 1), 500.0), np.ones((200, 1), bool))
    inside = np.ones(200, bool)
    calm, moving = np.full((200, 1), 0.4), 0.4 + 0.05 * np.sin(time)[:, None]
    assert not telemetry.frozen(time, still, calm, 0.5, inside).any()
    assert telemetry.frozen(time, still, moving, 0.5, inside).all()
    coarse = telemetry.Quantity(np.round(500.0 * np.sqrt(moving / 0.4) / 20.0) * 20.0, still.valid)  # 20 rad/s fine
    assert not telemetry.frozen(time, coarse, moving, 0.5, inside).any()


def test_no_telemetry_no_words():
    whole = flight("healthy")
    bare = replace(whole, signals={k: v for k, v in whole.signals.items() if k != "esc"})
    craft, _, _ = baselines.settle(bare, None, (), diagnose)
    assert telemetry.read(bare, allocation.rotor_thrusts(bare, craft), airborne(bare)) == (None, [])


def test_a_spell_must_last_to_the_end():
    at, reported = np.arange(10), np.ones(10, bool)
    assert stopped._last(at, np.r_[np.zeros(7, bool), np.ones(3, bool)], reported, 2) == (6, 7, 8)
    assert stopped._last(at, np.r_[np.zeros(6, bool), np.ones(3, bool), False], reported, 2) is None
    assert stopped._last(at, np.ones(10, bool), reported, 2) is None


def test_the_study_counts_answers():
    rows = list(esc_causes.flights(8, 1))
    assert [cause for cause, _, _ in rows[:4]] == list(esc_causes.KINDS)
    found = {what: esc_causes.answer(answer(what), 2) for what in ("propeller", "motor")}
    assert found == {"propeller": "propeller", "motor": "motor or ESC"}
    assert esc_causes.answer(answer("healthy"), None) == "nothing"
    assert esc_causes.answer(answer("small", "ardupilot", "hexa-x", 6.0), 2) == "slow"
    assert "| healthy |" in esc_causes.markdown({cause: {a: 1 for a in esc_causes.ANSWERS} for cause in esc_causes.KINDS})


def test_signals_without_columns_of_a_quantity():
    time = np.arange(5.0)
    esc = Signal(time, np.ones((5, 2)), ("speed1", "speed2"), "rad/s")
    assert telemetry.quantity(esc, "speed", 2).valid.all() and not telemetry.quantity(esc, "current", 2).valid.any()
