"""Logs whose outputs, frame, range, clock or axes are not those that flew: nobody is accused, and the reason names what is wrong."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.altered_logs import doubled, later, reordered, slower, with_signals, with_values

from rotorwatch import airframes, diagnose
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion import mixing, order, turning
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch.logs import dataflash_rotors
from rotorwatch_lab.simulation import scenario, simulate


@cache
def flown(frame="quad-x", kind="square", loss=0.3, wind=2.0, seed=4, duration=50.0):
    """Rotor 2 loses a share of its thrust at 28 s."""
    faults = [{"kind": "loss", "rotor": 2, "onset_s": 28.0, "strength": loss}] if loss else []
    table = {
        "duration_s": duration, "seed": seed, "airframe": {"frame": frame}, "wind": {"speed_m_s": wind}, "faults": faults,
        "trajectory": {"kind": kind, "land": False, "speed_m_s": 4.0},
    }  # fmt: skip
    return simulate(scenario.from_table(table)).flight


def accused(diagnosis):
    """Rotors that are accused of a loss or an override without an alternative."""
    kinds = ("loss_of_effectiveness", "output_override")
    return {r for e in diagnosis.events if e.kind in kinds and not e.alternatives for r in e.rotors}


@pytest.mark.parametrize("kind", ["square", "hover"])
@pytest.mark.parametrize(
    "frame, rows", [("quad-x", (2, 1, 0, 3)), ("quad-x", (1, 2, 3, 0)), ("hexa-x", (3, 0, 1, 2, 4, 5)), ("hexa-x", (2, 1, 0, 3, 4, 5))]
)
def test_outputs_in_another_order(frame, rows, kind):
    flight = flown(frame, kind)
    assert accused(diagnose(flight)) == {2}
    answer = diagnose(reordered(flight, rows))
    assert answer.verdict == "inconclusive" and not accused(answer)
    for place, motor in enumerate(rows):
        assert (f"output {place + 1} as motor {motor + 1}" in answer.reason) == (place != motor)


@pytest.mark.parametrize("frame, rows", [("quad-x", (1, 2, 3, 0)), ("hexa-x", (3, 0, 1, 2, 4, 5))])
def test_the_order_by_motion_alone(frame, rows):
    """Without what the rate controller asked for."""
    flight = with_signals(flown(frame), control=None)

    def followed(flight):
        vehicle, air = airframes.identify(flight), airborne(flight)
        table = observe(flight, vehicle, air, READY_S)
        assert table is not None
        return order.followed(table, vehicle.effectiveness())

    assert followed(flight) is None
    assert followed(reordered(flight, rows)) == rows
    assert not accused(diagnose(reordered(flight, rows)))


@pytest.mark.parametrize("frame, kind", [("quad-x", 0.0), ("quad-x", 3.0), ("hexa-x", 0.0)])
def test_a_frame_that_did_not_fly(frame, kind):
    flight = flown(frame)
    answer = diagnose(replace(flight, parameters={**flight.parameters, "FRAME_TYPE": kind}, checked=False))
    assert answer.verdict == "inconclusive" and not accused(answer)
    assert "mixer" in answer.reason or "another order" in answer.reason


@pytest.mark.parametrize(
    "parameters", [{"MOT_PWM_MIN": 500.0, "MOT_PWM_MAX": 2000.0}, {"MOT_PWM_MIN": 1300.0, "MOT_PWM_MAX": 2000.0}, {"MOT_THST_EXPO": 0.0}]
)
def test_a_range_or_a_curve_that_did_not_fly(parameters):
    flight = flown()
    answer = diagnose(replace(flight, parameters={**flight.parameters, **parameters}, checked=False))
    assert answer.verdict == "inconclusive" and not accused(answer)
    assert "range of the outputs" in answer.reason


def test_one_end_of_the_range_is_no_range():
    flight = flown()
    cut = {k: v for k, v in flight.parameters.items() if not k.startswith("MOT_PWM")}
    known, one_end = (diagnose(replace(flight, parameters=cut)), diagnose(replace(flight, parameters={**cut, "MOT_PWM_MIN": 500.0})))
    assert one_end.headline == known.headline


@pytest.mark.parametrize("value", [None, 1000.0, 0.0])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_an_output_that_never_moves(value, loss):
    flight = flown(loss=loss)
    values = flight["motors"].values.copy()
    values[:, 0] = np.median(values[:, 0]) if value is None else value
    answer = diagnose(with_values(flight, "motors", values))
    assert answer.verdict == "inconclusive" and not accused(answer)


@pytest.mark.parametrize("seconds", [0.1, 0.3, -0.2, 1.0])
def test_outputs_of_a_late_clock(seconds):
    flight = flown()
    answer = diagnose(with_signals(flight, motors=later(flight["motors"], seconds)))
    assert accused(answer) == {2}
    assert any(f"{abs(seconds):.2f} s {'later' if seconds > 0 else 'earlier'} than the rate" in w for w in answer.warnings)


@pytest.mark.parametrize("seconds", [0.3, -0.3, 1.0])
def test_a_clock_of_the_outputs_that_steps(seconds):
    flight = flown()
    answer = diagnose(with_signals(flight, motors=later(flight["motors"], seconds, 25.0)))
    assert accused(answer) == {2}
    vehicle, air = airframes.identify(flight), airborne(flight)
    found = mixing.mixing(with_signals(flight, motors=later(flight["motors"], seconds, 25.0)), vehicle, air)
    late = mixing.lags(found) if found is not None else None
    assert late is not None
    assert [round(lag.seconds, 2) for lag in late] == [0.0, seconds] and abs(late[1].start - 25.0) < 4.0


@pytest.mark.parametrize("frame, kind, loss", [("quad-x", "square", 0.3), ("quad-x", "hover", 0.0), ("hexa-x", "square", 1.0)])
def test_sound_logs_keep_their_clock_and_their_order(frame, kind, loss):
    flight = flown(frame, kind, loss)
    vehicle, air = airframes.identify(flight), airborne(flight)
    found = mixing.mixing(flight, vehicle, air)
    assert mixing.aligned(flight, vehicle, air) is flight
    assert mixing.outputs_in_another_order(found) is None and mixing.outputs_of_another_mixer(found) is None
    assert mixing.outputs_of_another_range(found) is None
    assert found is not None
    lags = np.linspace(-0.3, 50.0, 200)  # up to where nothing is asked any more
    for lag, together in zip(lags, found.own(lags), strict=True):
        own = np.diagonal(found.costs(lag, trim=False), axis1=1, axis2=2)
        assert np.array_equal(together, own.mean(axis=1), equal_nan=True)


def test_slow_outputs_beside_a_fast_controller():
    """Outputs at 3 Hz: in between, the controller tells what is commanded."""
    flight = flown(loss=0.4)
    answer = diagnose(slower(flight, 3.0))
    assert accused(answer) == {2} and abs(answer.events[0].onset_s - 28.0) < 1.0


# Motion


def test_commands_without_motion_are_not_assessed():
    flight = with_signals(flown(), gyro=None, rates=None, attitude=None, accel=None)
    answer = diagnose(flight)
    assert answer.verdict == "inconclusive" and not answer.events and "neither gyro nor attitude" in answer.reason
    assert any("gyro" in advice for advice in answer.advice)


def test_rates_of_the_attitude():
    """Where there is no gyro, the attitude's change takes its place: the same rotor is accused, and the answer says so."""
    flight = with_signals(flown(loss=0.4), gyro=None, rates=None)
    made, note = turning.with_rates(flight)
    gyro = flown(loss=0.4)["gyro"]
    true = np.stack([np.interp(made["rates"].time, gyro.time, column) for column in gyro.values.T], axis=1)
    assert np.corrcoef(true[100:-100, 2], made["rates"].values[100:-100, 2])[0, 1] > 0.95
    answer = diagnose(flight)
    assert accused(answer) == {2} and note in answer.assumptions
    assert turning.with_rates(flown(loss=0.4)) == (flown(loss=0.4), "")


def test_rates_wanted_without_a_gyro():
    """Set points of rates do not make up for a gyro."""
    flight = flown()
    wanted = replace(flight["gyro"], source="set points")
    assert diagnose(with_signals(flight, gyro=None, rates=None, rates_wanted=wanted)).verdict != "healthy"


@pytest.mark.parametrize("axes, signs", [((1, 0, 2), (1, 1, 1)), ((0, 2, 1), (1, 1, 1)), ((0, 1, 2), (-1, 1, 1)), ((1, 2, 0), (1, 1, 1))])
@pytest.mark.parametrize("missing", [(), ("attitude",)])
def test_axes_of_the_gyro(axes, signs, missing):
    flight = with_signals(flown(), **dict.fromkeys(missing))
    gyro = flight["gyro"].values[:, list(axes)] * signs
    answer = diagnose(with_values(flight, "gyro", gyro))
    assert answer.verdict == "inconclusive" and not accused(answer)


# Two logs, and one twice


def test_records_that_stand_twice_count_once():
    flight = flown()
    once, both = diagnose(flight), diagnose(doubled(flight))
    assert both.headline == once.headline and both.rotors == once.rotors
    assert any("duplicate records" in warning for warning in both.warnings)


@pytest.mark.parametrize("every", [1, 3])
def test_records_of_two_flights(every):
    """Merged by time, at equal rates and at others."""
    one, other = flown(), flown("quad-x", "figure-eight", 0.0, 3.0, 9)

    def merged(a, b):
        rows = np.arange(0, len(b), every)
        time = np.concatenate([a.time, b.time[rows] + 1e-4])
        by_time = np.argsort(time, kind="stable")
        return a.with_arrays(
            time[by_time], np.concatenate([a.values, b.values[rows]])[by_time], np.concatenate([a.valid, b.valid[rows]])[by_time]
        )

    answer = diagnose(with_signals(one, **{n: merged(one[n], other[n]) for n in one.signals if n in other.signals}))
    assert answer.verdict == "inconclusive" and not accused(answer)
    assert "two flights" in answer.reason


def test_an_airframe_that_changes_between_two_flights():
    flight = replace(flown(), parameter_changes=((20.0, "FRAME_CLASS", 2.0),))
    assert "FRAME_CLASS becomes 2" in diagnose(flight).reason
    before = replace(flown(), parameter_changes=((0.0, "FRAME_CLASS", 1.0),))
    assert accused(diagnose(before)) == {2}


def test_outputs_that_a_frame_leaves_out():
    """Motors beyond the frame's, by their functions; without functions, outputs that are made of the same demands."""
    rng = np.random.default_rng(3)
    demands = 1500.0 + 60.0 * rng.standard_normal((400, 4))
    mix = np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [1, -1, -1, 1], [-1, 1, -1, 1], [0.5, 0.9, -1, 1]]) / 4.0
    pwm = {k + 1: column for k, column in enumerate(((demands - 1500.0) @ mix.T + 1500.0).T)}
    pwm[6] = 1500.0 + 60.0 * rng.standard_normal(400)  # a servo of its own
    outputs = {k: k for k in range(1, 5)}
    functions = {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 6)}
    assert dataflash_rotors.left_out(functions, outputs, pwm) == [5]
    assert dataflash_rotors.left_out({}, outputs, pwm) == [5]
    assert dataflash_rotors.left_out({**functions, "SERVO5_FUNCTION": 39.0}, outputs, pwm) == []
    still = {**pwm, 5: np.full(400, 1100.0)}
    assert dataflash_rotors.left_out(functions, outputs, still) == []
    assert "output 5 moves as a motor's" in diagnose(replace(flown(), facts={"outputs_left_out": [5]})).reason
