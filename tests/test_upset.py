"""Vehicles that left control: when, why, and which rotor; by a model of their own (tumbling.py), closed forms, and the shared logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests import tumbling

from rotorwatch import airframes, diagnose
from rotorwatch.answer import falls
from rotorwatch.base.physics import G0
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.witnesses import battery as voltages
from rotorwatch.witnesses.upset import balance, find, loss_of_control
from rotorwatch.witnesses.upset.balance import INERTIA, Offset, Window, fit
from rotorwatch.witnesses.upset.explain import Explanation, explain
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import batch, benchmark_plan
from rotorwatch_lab.simulation import scenario, simulate

QUAD = airframes.named("ardupilot-quad-x")
B = QUAD.effectiveness()


def answer(frame: str, case: str, seed: int, rate: float = 10.0, duration: float = 13.0, later: float = 9.0):
    flight, truth = tumbling.fly(frame, case, seed, rate, duration, later)
    return diagnose(flight, airframes.named(f"ardupilot-{frame}")), truth


def of(diagnosis, kind: str) -> list[Event]:
    return [e for e in diagnosis.events if e.kind == kind]


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(("frame", "seed", "rate"), [("quad-x", 5, 5.0), ("quad-x", 1, 10.0), ("quad-plus", 3, 50.0)])
def test_the_rotor_that_stopped_in_a_climb_is_named(frame, seed, rate):
    diagnosis, truth = answer(frame, "climb", seed, rate, 11.0)
    lost = of(diagnosis, "loss_of_control")
    assert truth.lost
    assert len(lost) == 1
    assert abs(lost[0].onset_s - truth.begins_s) < 1.5
    losses = of(diagnosis, "loss_of_effectiveness")
    named = {r for e in losses for who in (e.rotors, *e.alternatives) for r in who}
    sure = {r for e in losses if not e.alternatives for r in e.rotors}
    assert truth.rotors[0] in named
    assert sure <= set(truth.rotors)
    assert diagnosis.verdict in ("fault", "ambiguous")


def test_a_rotor_found_afterwards_says_so_and_the_others_worked():
    diagnosis, truth = answer("quad-x", "climb", 1, 50.0, 11.0)
    (loss,) = of(diagnosis, "loss_of_effectiveness")
    (lost,) = of(diagnosis, "loss_of_control")
    assert loss.rotors == truth.rotors
    assert loss.extra["live"] is False
    assert loss.detected_s > truth.lost_s
    assert loss.interval[0][0] > 0.0
    assert lost.extra["cause"] == "rotor"
    worked = lost.extra["worked_until_s"]
    assert all(t > worked[truth.rotors[0] - 1] for k, t in enumerate(worked, start=1) if k not in truth.rotors)


def test_swapped_outputs_turn_the_vehicle_over_at_take_off():
    diagnosis, truth = answer("quad-x", "swapped", 0, duration=8.0)
    (order,) = of(diagnosis, "motor_order")
    assert set(order.rotors) == set(truth.rotors)
    assert diagnosis.verdict == "fault"
    assert "motor test" in " ".join(diagnosis.advice)
    assert not of(diagnosis, "loss_of_effectiveness")


@pytest.mark.parametrize(("case", "cause"), [("disarmed", "disarmed"), ("power", "power"), ("gyro", "controller")])
def test_what_was_no_rotor_is_said(case, cause):
    diagnosis, truth = answer("quad-x", case, 0, duration=15.0)
    (lost,) = of(diagnosis, "loss_of_control")
    assert lost.extra["cause"] == cause
    # A gyro that is wrong shows first in what the vehicle does, seconds later.
    assert abs(lost.onset_s - truth.begins_s) < (3.0 if case == "gyro" else 1.5)
    assert not of(diagnosis, "loss_of_effectiveness")
    assert diagnosis.verdict != "healthy"
    assert "Not a rotor fault" in diagnosis.headline


@pytest.mark.parametrize("shakes, cause", [(5.0, "controller"), (60.0, "unknown")])
def test_motion_that_shakes_acquits_no_rotor(shakes, cause):
    flight, _ = tumbling.fly("quad-x", "gyro", 0, 10.0, 15.0, 9.0)
    force = flight["accel"]
    values = force.values + shakes * np.where(np.arange(len(force)) % 2, 1.0, -1.0)[:, None] * [1.0, 0.0, 0.0]
    shaken = replace(flight, signals={**flight.signals, "accel": force.with_arrays(force.time, values, force.valid)})
    diagnosis = diagnose(shaken, airframes.named("ardupilot-quad-x"))
    (lost,) = of(diagnosis, "loss_of_control")
    assert lost.extra["cause"] == cause and not of(diagnosis, "loss_of_effectiveness")
    assert ("Not a rotor fault" in diagnosis.headline) is (cause == "controller")


@pytest.mark.parametrize(("push", "cause"), [(0.0, "rotor"), (0.1, "rotor"), (0.8, "unknown")])
def test_a_vehicle_pushed_up_as_it_turns_over_accuses_no_rotor(push, cause):
    """A rotor that stops takes lift away: the ground, or a twig, pushes up by so many g for a few hundredths of a second."""
    flight, truth = tumbling.fly("quad-x", "hover", 1, 50.0, 12.0, 8.0)
    force = flight["accel"]
    touches = (force.time > truth.begins_s) & (force.time < truth.begins_s + 0.08)
    values = force.values - G0 * push * touches[:, None] * [0.0, 0.0, 1.0]
    pushed = replace(flight, signals={**flight.signals, "accel": replace(force, values=values)})
    (assessed,) = find.assessed(pushed, QUAD, airborne(pushed))
    assert assessed.cause == cause
    if cause == "rotor":
        assert assessed.found[0].rotors[0] + 1 == truth.rotors[0]
    else:
        assert not assessed.found and "pushed up" in assessed.evidence[0]


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("case", tumbling.STAYS)
def test_no_loss_of_control_is_claimed(case):
    flight, _ = tumbling.fly("quad-x", case, 4, duration=20.0, later=14.0)
    air = [(3.7, 19.0)]
    assert loss_of_control.find(flight, air) == ()


def still(duration: float = 10.0, hz: float = 10.0) -> Flight:
    """A vehicle that hovers level."""
    time = np.arange(0.0, duration, 1.0 / hz)
    level = Signal(time, np.tile([1.0, 0, 0, 0], (time.size, 1)), ("w", "x", "y", "z"), "1", "FRD->NED")
    return Flight("model", "ArduPilot", {"attitude": level, "attitude_wanted": level}, duration)


def rolled(flight: Flight, name: str, start: float, end: float, degrees: float) -> Flight:
    """The flight with a roll of so many degrees in one signal, from start to end."""
    signal = flight[name]
    half = np.radians(degrees) / 2.0
    q = np.where(((signal.time >= start) & (signal.time < end))[:, None], [np.cos(half), np.sin(half), 0, 0], signal.values)
    return replace(flight, signals={**flight.signals, name: replace(signal, values=q)})


@pytest.mark.parametrize("case", ["climb", "swapped"])
def test_a_loss_of_control_is_found_however_many_samples_are_looked_at_at_a_time(monkeypatch, case):
    flight, _ = tumbling.fly("quad-x", case, 1, 50.0, 11.0, 9.0)
    air = airborne(flight)
    whole = loss_of_control.find(flight, air)
    assert whole
    monkeypatch.setattr(loss_of_control, "BLOCK", 64)
    assert loss_of_control.find(flight, air) == whole


@pytest.mark.parametrize(
    ("outputs", "jitter", "rate", "lasts_s"),
    [((1232, 1200, 1150, 1245), 0.0, 0.5, 1.5), ((1258, 1180, 1150, 1250), 0.0, 0.8, 1.0), ((1250, 1550, 1250, 1250), 40.0, -0.15, 6.0)],
    ids=["tilted by hand", "leaning", "an estimate that drifts"],
)
def test_a_vehicle_on_a_stand_accuses_no_rotor(outputs, jitter, rate, lasts_s):
    """Outputs far below hover's while it tilts; or an attitude that drifts by a gyro's bias while it stands still."""
    time, draw = np.arange(0.0, 12.0, 0.02), np.random.default_rng(0)
    turning = rate * ((time > 6.0) & (time < 6.0 + lasts_s))
    roll, none = np.cumsum(turning) * 0.02, np.zeros(time.size)
    motors = np.where(time[:, None] > 1.0, outputs + draw.normal(0.0, jitter, (time.size, 4)), 1000.0)
    signals = {
        "motors": Signal(time, motors, ("1", "2", "3", "4"), "us"),
        "gyro": Signal(
            time, np.column_stack([turning, none, none]) + draw.normal(0.0, 0.005, (time.size, 3)), ("p", "q", "r"), "rad/s", "FRD"
        ),
        "accel": Signal(time, -G0 * np.column_stack([none, np.sin(roll), np.cos(roll)]), ("x", "y", "z"), "m/s^2", "FRD"),
        "attitude": Signal(time, np.column_stack([np.cos(roll / 2), np.sin(roll / 2), none, none]), ("w", "x", "y", "z"), "1", "FRD->NED"),
        "attitude_wanted": Signal(time, np.tile([1.0, 0, 0, 0], (time.size, 1)), ("w", "x", "y", "z"), "1", "FRD->NED"),
    }
    parameters = {"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0, "MOT_SPIN_MIN": 0.15, "MOT_SPIN_MAX": 0.95, "MOT_SPIN_ARM": 0.1}
    diagnosis = diagnose(Flight("model", "ArduPilot", signals, 12.0, parameters=parameters), QUAD)
    assert diagnosis.verdict == "inconclusive"
    assert not of(diagnosis, "loss_of_effectiveness") and all(not e.rotors for e in of(diagnosis, "loss_of_control"))


@pytest.mark.parametrize(("stops_s", "moves_s"), [(5.2, 0.0), (9.0, 8.5)], ids=["motors at idle", "moved afterwards"])
def test_nothing_logged_of_the_rotors_as_control_was_lost_accuses_none(stops_s, moves_s):
    """The attitude leaves its target between 6 and 7 s. Before it the motors stood still, or only after it anything moves."""
    time = np.arange(0.0, 12.0, 0.02)
    roll = np.interp(time, [6.0, 7.0], [0.0, 1.2])
    q = np.column_stack([np.cos(roll / 2), np.sin(roll / 2), 0 * roll, 0 * roll])
    turns = 2.0 * np.sin(8.0 * time) * (time > moves_s)
    running = ((time > 1.0) & (time < stops_s))[:, None]
    signals = {
        "motors": Signal(time, np.where(running, [1500.0, 1350.0, 1400.0, 1400.0], 1000.0), tuple("1234"), "us"),
        "gyro": Signal(time, np.column_stack([turns, turns, 0 * turns]), ("p", "q", "r"), "rad/s", "FRD"),
        "accel": Signal(time, np.tile([0.0, 0.0, -G0], (time.size, 1)), ("x", "y", "z"), "m/s^2", "FRD"),
        "attitude": Signal(time, q, tuple("wxyz"), "1", "FRD->NED"),
        "attitude_wanted": Signal(time, np.tile([1.0, 0, 0, 0], (time.size, 1)), tuple("wxyz"), "1", "FRD->NED"),
    }
    flight = Flight("model", "ArduPilot", signals, 12.0, parameters={"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0})
    (assessed,) = find.assessed(flight, QUAD, [(5.0 if moves_s else 1.0, 11.0)])
    assert assessed.cause == "unknown" and not assessed.found


def test_control_that_comes_back_at_once_was_not_lost():
    assert loss_of_control.find(rolled(still(), "attitude", 5.0, 5.7, 80.0), [(0.0, 10.0)]) == ()


def test_two_turns_that_were_mastered_are_no_loss_of_control():
    flight = rolled(rolled(still(), "attitude", 5.0, 5.4, 80.0), "attitude", 6.2, 6.6, 80.0)
    assert loss_of_control.find(flight, [(0.0, 10.0)]) == ()


def test_a_vehicle_that_tumbled_and_came_to_rest_upright_was_out_of_control():
    (left,) = loss_of_control.find(rolled(still(), "attitude", 5.0, 5.7, 170.0), [(0.0, 10.0)])
    assert left.onset == pytest.approx(4.9, abs=0.11)


def test_a_take_off_that_ends_on_its_side_was_lost():
    (left,) = loss_of_control.find(rolled(still(), "attitude", 4.0, 10.0, 80.0), [(3.6, 4.3)])
    assert left.onset < 4.1


@pytest.mark.parametrize(("lasts", "lost"), [(1.5, False), (2.5, True)])
def test_a_vehicle_that_leans_for_seconds_as_nobody_asked_is_out_of_control(lasts, lost):
    assert bool(loss_of_control.find(rolled(still(), "attitude", 5.0, 5.0 + lasts, 25.0), [(0.0, 10.0)])) is lost


def test_a_vehicle_that_left_control_before_it_counted_as_in_the_air_lost_it_at_take_off():
    flight = rolled(still(), "attitude", 4.0, 10.0, 60.0)
    time = flight["attitude"].time
    outputs = np.where(time[:, None] < 3.5, 1000.0, 1600.0) * np.ones(4)
    motors = Signal(time, outputs, tuple("1234"), "us", "")
    (left,) = loss_of_control.find(replace(flight, signals={**flight.signals, "motors": motors}), [(7.0, 10.0)])
    assert left.onset == pytest.approx(3.9, abs=0.11)


@pytest.mark.parametrize(("follows", "lost"), [(0.3, False), (None, True)])
def test_rates_that_follow_late_what_was_wanted_are_under_control(follows, lost):
    flight, time = still(), np.arange(0.0, 10.0, 0.1)

    def rolls(at):
        return np.where((at > 5.0) & (at < 8.0), 9.0 * np.sign(np.sin(4.0 * at)), 0.0)[:, None] * [1.0, 0, 0]

    actual = rolls(time - follows) if follows else np.where((time > 5.0)[:, None], [20.0, 0, 0], np.zeros(3))
    rates = {
        name: Signal(time, values, ("p", "q", "r"), "rad/s", "FRD") for name, values in (("rates_wanted", rolls(time)), ("gyro", actual))
    }
    flight = replace(flight, signals={"attitude": flight["attitude"], **rates})
    assert bool(loss_of_control.find(flight, [(0.0, 10.0)])) is lost


def test_a_rotor_dead_since_take_off_is_not_cleared_by_the_trim_it_made():
    flight, truth = tumbling.fly("octa-x", "take-off", 1444559105, 10.0)
    diagnosis = diagnose(flight, airframes.named("ardupilot-octa-x"))
    assert truth.lost
    assert [e.extra["cause"] for e in of(diagnosis, "loss_of_control")] == ["unknown"]


def test_control_that_does_not_come_back_was_lost():
    (left,) = loss_of_control.find(rolled(still(), "attitude", 5.0, 10.0, 80.0), [(0.0, 10.0)])
    assert left.onset == pytest.approx(4.9, abs=0.11)
    assert left.end is None


def test_a_vehicle_that_follows_late_what_was_wanted_is_under_control():
    flight = rolled(rolled(still(), "attitude_wanted", 5.0, 7.0, 80.0), "attitude", 5.4, 7.4, 80.0)
    assert loss_of_control.find(flight, [(0.0, 10.0)]) == ()


def attitudes(time, pitch, heading):
    """(n, 4) of a vehicle that pitches, then turned to a heading, both in degrees."""
    p, h = (np.radians(np.broadcast_to(x, time.shape)) / 2.0 for x in (pitch, heading))
    return np.stack([np.cos(h) * np.cos(p), -np.sin(h) * np.sin(p), np.cos(h) * np.sin(p), np.sin(h) * np.cos(p)], axis=1)


def test_a_heading_that_is_wanted_suddenly_is_no_loss_of_control_and_hides_none():
    """The vehicle leans, and turns for seconds to the heading that is wanted at once; half a minute later it tumbles."""
    time = np.arange(0.0, 60.0, 0.1)
    heading = np.clip((time - 15.0) * 20.0, 0.0, 130.0)
    asked = attitudes(time, -25.0, np.where(time < 15.0, 0.0, 130.0))
    flown = attitudes(time, np.where(time < 50.0, -25.0, 120.0), heading)
    names = tuple("wxyz")
    signals = {"attitude": Signal(time, flown, names, "1"), "attitude_wanted": Signal(time, asked, names, "1")}
    (left,) = loss_of_control.find(Flight("model", "ArduPilot", signals, 60.0), [(0.0, 60.0)])
    assert left.onset == pytest.approx(49.9, abs=0.11)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("seed", [0, 1])
def test_what_a_vehicle_does_with_its_motors_stopped_is_not_its_rotors(seed):
    """Outputs were swapped, and a failsafe stops the motors of the vehicle that tumbles."""
    flight, truth = tumbling.fly("quad-x", "swapped", seed, 50.0, 8.0)
    motors = flight["motors"]
    stopped = np.where((motors.time > truth.lost_s + 0.3)[:, None], 1000.0, motors.values)
    flight = replace(flight, signals={**flight.signals, "motors": replace(motors, values=stopped)})
    (order,) = of(diagnose(flight, QUAD), "motor_order")
    assert set(order.rotors) == set(truth.rotors)


@pytest.mark.parametrize(("logged", "cause"), [("steady", "power"), ("doubles", False), ("none", None)])
def test_a_voltage_that_sags_under_its_current_is_no_failure_of_power(logged, cause):
    """The voltage falls by 20 % as control is lost at 20 s: while the current stays, while it doubles, or without one in the log."""
    time = np.arange(0.0, 22.0, 0.2)
    load = 10.0 + 2.0 * np.sin(time) + np.where(time > 20.0, 10.0, 0.0)
    volts = 16.8 - 0.02 * time - 0.25 * load
    if logged != "doubles":
        volts, load = np.where(time > 20.0, volts.min(), volts), np.minimum(load, 12.0)
    both = np.column_stack([volts, load])[:, : 1 if logged == "none" else 2]
    battery = Signal(time, both, ("voltage", "current")[: both.shape[1]], "V,A")
    flight = Flight("model", "ArduPilot", {"battery": battery}, 22.0)
    assert voltages.fell(flight, 20.0) and voltages.sagged(flight, 20.0) is (True if cause == "power" else cause)


def fallen(speed: float) -> Flight:
    """A vehicle that hovers, then comes down at so many m/s, believed level all the time, and stays where it struck."""
    flight = still(14.0)
    time = flight["attitude"].time
    down = np.where((time > 5.0) & (time < 7.0), speed, 0.0)
    velocity = Signal(time, np.stack([0 * time, 0 * time, down], axis=1), ("n", "e", "d"), "m/s", "NED")
    force = np.where(np.isclose(time, 7.0), -9.0 * 9.8, -9.8)
    accel = Signal(time, np.stack([0 * time, 0 * time, force], axis=1), ("x", "y", "z"), "m/s^2", "FRD")
    return replace(flight, signals={**flight.signals, "velocity": velocity, "accel": accel})


def test_a_vehicle_that_strikes_the_ground_believed_level_was_out_of_control():
    (left,) = loss_of_control.find(fallen(8.0), [(0.0, 7.2)])
    assert left.impact == pytest.approx(7.0, abs=0.11)
    assert left.onset == pytest.approx(5.0, abs=0.3)


def drawn(number: int):
    """Flight `number` of plans/default.toml: (diagnosis, its fault)."""
    scenario = campaign.read(Path(__file__).parents[1] / "plans" / "default.toml").flight(number)
    return diagnose(simulate(scenario).flight), scenario.faults[0]


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("number", [1856, 4176])
def test_a_descent_that_was_asked_for_is_no_loss_of_control(number):
    """Quads that sink as they should, 4 s before a motor stops; they strike the ground at 11 and 12 m/s."""
    diagnosis, fault = drawn(number)
    (lost,) = of(diagnosis, "loss_of_control")
    assert lost.rotors == (fault["rotor"],) and lost.onset_s == pytest.approx(fault["onset_s"], abs=0.3)
    assert diagnosis.verdict == "fault"


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("number", [400, 3848, 4760])
def test_a_loss_that_had_become_trim_is_not_said_to_be_no_rotor(number):
    """Quads that lost 26 to 51 % of a rotor in wind, hard against any explanation but that, flew on, and left control seconds later."""
    diagnosis, fault = drawn(number)
    assert "Not a rotor fault" not in diagnosis.headline
    assert diagnosis.verdict in ("fault", "ambiguous")
    assert [r.rotor for r in diagnosis.rotors if r.status != "healthy"] == [fault["rotor"]]


def test_a_rotor_stuck_high_is_not_taken_for_the_loss_of_the_opposite_one():
    """A hexa of the open world. Both turn it the same way; how it is lifted is no more than a part of the evidence."""
    plan = campaign.read(Path(__file__).parents[1] / "plans" / "open.toml")
    ((number, *simulated),) = batch.simulated(plan, [969], batch.CPU_WIDTH)
    found = diagnose(batch.logged(number, *simulated))
    (loss,) = of(found, "loss_of_effectiveness")
    assert loss.rotors == (2,) and not loss.alternatives and "stuck" in found.headline


def test_a_hard_landing_is_under_control():
    assert loss_of_control.find(fallen(3.5), [(0.0, 7.2)]) == ()


def window(T: np.ndarray, rate_dot: np.ndarray, load: np.ndarray | None = None) -> Window:
    K = len(T)
    ok = np.ones(K, bool)
    load = T.mean(axis=1) if load is None else load
    return Window(np.arange(K) * 0.1, T, 2.5, np.zeros((K, 3)), rate_dot, load, np.ones((K, 3), bool), ok, T, T)


def test_motion_against_the_torque_speaks_against_the_commands_however_wrong_the_gain():
    T = np.ones((8, 4)) + np.where(np.arange(8)[:, None] >= 4, [0.5, -0.5, 0.0, 0.0], 0.0)
    with_it = (T @ B.T)[:, :3] / (4 * INERTIA)
    offset = Offset(np.zeros(3), np.full(3, 0.1))
    for scale in (0.5, 1.0, 2.0):
        along = fit(window(T, scale * with_it), (T @ B.T)[None], B, offset).log_evidence[0]
        against = fit(window(T, -scale * with_it), (T @ B.T)[None], B, offset).log_evidence[0]
        assert along > against + 5.0


@pytest.mark.parametrize("rotor", range(4))
def test_each_rotor_is_reported_from_the_others(rotor):
    rng = np.random.default_rng(rotor)
    T = np.clip(1.0 + rng.normal(0.0, 0.3, (14, 4)), 0.1, 2.0)
    given = T.copy()
    given[6:, rotor] = 0.0
    rate_dot = (given @ B.T)[:, :3] / (4 * INERTIA)
    found, probability = explain(window(T, rate_dot, given.mean(axis=1)), B, Offset(np.zeros(3), np.full(3, 0.1)), np.arange(4, 9), False)
    assert found[0].kind == "rotor"
    assert found[0].rotors == (rotor,)
    assert probability[0] > 0.9
    assert found[0].size > 0.8


def test_swapped_outputs_that_look_alike_are_named_as_candidates():
    pair = explain_kind("order", (0, 1)), explain_kind("order", (2, 3))
    left = loss_of_control.LossOfControl(5.0, 5.4, None, None, "tilted")
    assessed = find.Assessed(left, "motor_order", pair, np.array([0.6, 0.4]), None, 5.0, ())
    order, lost = falls.events([assessed], (), 4)
    assert {order.kind, lost.kind} == {"motor_order", "loss_of_control"}
    assert order.alternatives == lost.alternatives == ((3, 4),)


@pytest.mark.parametrize("misfit, cause, accused", [(1.0, "unknown", True), (2.0, "unknown", False), (2.0, "rotor", True)])
def test_a_rotor_that_leaves_motion_unexplained_is_a_candidate_and_not_accused(misfit, cause, accused):
    left = loss_of_control.LossOfControl(5.0, 5.4, None, None, "tilted")
    best = Explanation("rotor", (3,), 0.0, 5.0, 1.0, 0.9, 1.0, np.full((3, 4), misfit), 1.1)
    assessed = find.Assessed(left, cause, (best,), np.ones(1), None, 5.0, ())
    *losses, lost = falls.events([assessed], (), 4)
    assert [e.rotors for e in losses] == ([(4,)] if accused else [])
    assert lost.rotors == ((4,) if accused else ()) and (accused or lost.alternatives == ((4,),))


def test_what_left_control_after_a_blow_was_knocked():
    left = loss_of_control.LossOfControl(5.0, 5.4, None, None, "tilted")
    assessed = find.Assessed(left, "unknown", (), np.empty(0), None, 5.0, ())
    blow = Event("contact", (), 4.4, 4.4, 4.4, (), (), 1.0, (), "a blow")
    assert falls.events([assessed], [blow], 4)[-1].extra["cause"] == "knock"
    assert falls.events([assessed], [replace(blow, onset_s=1.0)], 4)[-1].extra["cause"] == "unknown"


def explain_kind(kind: str, rotors: tuple[int, ...]) -> Explanation:
    return Explanation(kind, rotors, 0.0, 5.0, 0.0, 0.0, 0.1, np.zeros((3, 4)))


def test_rotors_that_do_as_reported_are_cleared():
    rng = np.random.default_rng(9)
    T = np.clip(1.0 + rng.normal(0.0, 0.3, (14, 4)), 0.1, 2.0)
    rate_dot = (T @ B.T)[:, :3] / (4 * INERTIA)
    found, probability = explain(window(T, rate_dot), B, Offset(np.zeros(3), np.full(3, 0.1)), np.arange(4, 9), False)
    assert found[0].kind == "healthy"
    assert sum(p for e, p in zip(found, probability) if e.kind == "rotor") < 0.1


def test_after_the_impact_nothing_is_assessed():
    flight, truth = tumbling.fly("quad-x", "climb", 1, 50.0, 11.0)
    upsets = find.assessed(flight, QUAD, [(3.7, 11.0)])
    ((_, end),) = find.until_impact(flight, [(3.7, 11.0)], upsets)
    assert truth.lost_s < end < 10.0


def test_who_turns_over_on_the_ground_after_a_landing_is_not_healthy_and_no_rotor_is_accused():
    time = np.arange(0.0, 12.0, 0.05)
    roll = np.radians(np.interp(time, [6.0, 7.0], [0.0, 170.0]))
    q = np.column_stack([np.cos(roll / 2), np.sin(roll / 2), 0 * roll, 0 * roll])
    powered = np.where(time < 10.0, 1300.0, 1000.0)[:, None] * np.ones((1, 4))
    attitude, motors = Signal(time, q, tuple("wxyz"), "1"), Signal(time, powered, tuple("1234"), "us")
    flight = Flight("CSV", "ArduPilot", {"attitude": attitude, "motors": motors}, 12.0)
    (left,) = loss_of_control.find(flight, [(1.0, 5.0)])
    assert left.landed and 6.0 <= left.onset < 6.5 and left.what == "turned over on the ground"
    parked = Signal(time, np.where(time[:, None] < 5.5, powered, 1000.0), tuple("1234"), "us")
    assert loss_of_control.find(replace(flight, signals={"attitude": attitude, "motors": parked}), [(1.0, 5.0)]) == ()


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(("number", "rotor"), [(117, 1), (803, 1)])
def test_a_rotor_that_dies_in_wind_is_named_where_the_battery_was_steady(number, rotor):
    """The controller swings all commands while the vehicle tumbles: rotors that speed up turn it in yaw, and all of them together seem to
    give less than commanded. Neither takes the place of the dead rotor."""
    flights = benchmark_plan.read(Path(__file__).parents[1] / "benchmarks" / "comparison" / "quad-x.toml").plan
    (flown,) = batch.fly(flights, [number], 1)
    (assessed,) = flown.ready.upsets
    assert np.flatnonzero(flown.theta.max(axis=0) > 0.99).tolist() == [rotor]
    assert assessed.cause == "rotor" and assessed.found[0].rotors == (rotor,) and assessed.probability[0] > 0.9


def test_a_rotor_that_dies_while_air_takes_the_thrust_is_not_cleared():
    """The hexarotor sinks, then its sixth motor stops: thrust alone would be best explained by all rotors at once, and the torques stay
    small; yet without that explanation they speak for a rotor."""
    flights = benchmark_plan.read(Path(__file__).parents[1] / "benchmarks" / "comparison" / "hexa-x.toml").plan
    (flown,) = batch.fly(flights, [881], 1)
    (assessed,) = flown.ready.upsets
    assert assessed.found[0].kind == "common" and assessed.cause == "unknown"


@pytest.mark.parametrize(
    "announced, fall, reported",
    [
        ((0.29, 0.2, 0.38), (0.95, 0.81, 1.0), (0.95, 0.81, 1.0)),  # a few ticks saw the loss begin
        ((0.66, 0.43, 0.89), (0.91, 0.75, 1.0), (0.66, 0.43, 0.89)),  # they agree
        ((0.98, 0.95, 1.0), (0.8, 0.65, 0.92), (0.98, 0.95, 1.0)),  # the fall hides some of it
    ],
)
def test_the_size_of_a_loss_is_the_falls_where_that_shows_more_for_certain(announced, fall, reported):
    left = loss_of_control.LossOfControl(5.0, 5.4, 7.0, None, "tilted")
    best = Explanation("rotor", (2,), 0.0, 5.0, *fall, np.zeros((3, 4)))
    assessed = find.Assessed(left, "rotor", (best,), np.ones(1), None, 5.0, ("the motion",))
    known = Event("loss_of_effectiveness", (3,), 4.9, 5.1, None, announced[:1], (announced[1:],), 1.0, (), "announced")
    loss, lost = falls.events([assessed], [known], 4)
    assert (loss.loss, *loss.interval) == (reported[:1], reported[1:]) and loss.detected_s == 5.1 and loss.rotors == lost.rotors == (3,)


@pytest.mark.parametrize("since_s", [0.0, 5.0])
def test_a_rotor_whose_output_is_not_known_clears_and_accuses_nobody(since_s):
    """From so long before control was lost, or from the begin of the log on."""
    flight, truth = tumbling.fly("quad-x", "climb", 1, 50.0, 11.0)
    motors, other = flight["motors"], truth.rotors[0] % 4
    valid = motors.valid & ~((motors.time > (truth.begins_s - since_s if since_s else 0.0))[:, None] & (np.arange(4) == other))
    diagnosis = diagnose(replace(flight, signals={**flight.signals, "motors": replace(motors, valid=valid)}), QUAD)
    (lost,) = of(diagnosis, "loss_of_control")
    assert not lost.rotors and not lost.alternatives
    worked = lost.extra["worked_until_s"][other]
    assert worked is None or worked <= truth.begins_s - since_s
    assert not of(diagnosis, "loss_of_effectiveness")


def test_the_air_carries_a_vehicle_that_falls_the_more_the_faster_it_falls():
    """So that the load of a fall is no thrust of its rotors: none in hover and in a climb, half of the weight at most in the mean."""
    time = np.arange(0.0, 8.0, 0.1)
    none, ok = np.zeros((time.size, 4)), np.ones(time.size, bool)

    def air(load):
        window = Window(time, none, 2.0, none[:, :3], none[:, :3], load, ok[:, None] & ok[:3], ok, none, none, onset=2.0)
        return balance._air(window)

    assert not air(np.ones(time.size)).any() and not air(np.full(time.size, 1.2)).any()
    falling = air(np.where(time > 2.0, 0.6, 1.0))
    assert not falling[time <= 2.0].any() and (np.diff(falling) >= 0.0).all()
    sinks = G0 * 0.4 * 1.0  # m/s, after a second
    assert falling[np.searchsorted(time, 3.0)] == pytest.approx(0.5 * (sinks / balance.FALLS) ** 2, rel=0.25)
    assert falling[-1] == 0.5


def test_what_is_held_at_the_start_of_a_hop_is_the_sample_before_it():
    time = np.arange(10.0)
    signal = Signal(time, time[:, None], ("x",), "1", "body", "test")
    around = loss_of_control._around(signal, 2.5, 5.0)
    assert around.time.tolist() == [2.0, 3.0, 4.0, 5.0]
    assert loss_of_control._around(signal, -1.0, 0.5).time.tolist() == [0.0]
    at = np.array([2.5, 3.0, 4.9])
    assert np.array_equal(loss_of_control.held(around, at)[0], loss_of_control.held(signal, at)[0])


def test_a_rotor_that_fails_in_brisk_flight_is_named_since_it_failed():
    asked = {
        "duration_s": 36.0, "seed": 1, "autopilot": "px4",
        "airframe": {
            "frame": "quad-x", "mass_kg": 2.78, "arm_m": 0.4, "thrust_to_weight": 2.7, "expo": 0.332, "lag_s": 0.031, "payload_kg": 0.1,
            "rotor_spread": 0.022,
        },
        "trajectory": {"kind": "turning-square", "altitude_m": 4.06, "size_m": 6.0, "speed_m_s": 4.5, "turn_s": 2.65},
        "wind": {"speed_m_s": 6.5, "from_deg": 202.0},
        "faults": [{"kind": "loss", "rotor": 2, "onset_s": 27.3, "strength": 0.7}],
    }  # fmt: skip
    answer = diagnose(simulate(scenario.from_table(asked)).flight)
    fault = next(e for e in answer.events if e.means.accuses)
    assert fault.rotors == (2,)
    assert fault.onset_s == pytest.approx(27.3, abs=0.15)
    assert answer.verdict == "fault"
