"""Lone values: what the neighbours of a sample give away, and what they do not."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes, diagnose, logs
from rotorwatch.flight import Flight, Signal
from rotorwatch.logs import lone_values, parameter_ranges, plausible, series

FLIGHTS = Path(__file__).parents[1] / "../shared/flights"
HZ = 10.0
MANY = settings(max_examples=trials(150), deadline=None)


def times(n):
    return np.arange(n) / HZ


def noise(n, sd, seed=0):
    return sd * np.random.default_rng(seed).standard_normal(n)


def found(x, floor=1e-9):
    return np.flatnonzero(plausible.lone(times(len(x)), np.asarray(x)[:, None], floor)[:, 0]).tolist()


@MANY
@given(st.integers(30, 170), st.floats(-1000.0, 1000.0), st.integers(1, 8), st.booleans())
def test_a_step_is_no_damage(at, height, over, back):
    """A rotor switched off, a limit reached: at once or over a few samples, for good or for a second."""
    x = 1500.0 + height * np.clip((np.arange(200) - at) / over, 0.0, 1.0)
    if back:
        x[at + over + 10 :] = 1500.0
    assert found(x) == []


@MANY
@given(st.floats(-500.0, 500.0), st.floats(-1e4, 1e4))
def test_a_ramp_is_no_damage(slope, start):
    assert found(start + slope * times(200), 1e-6) == []


@MANY
@given(st.floats(10.0, 200.0), st.floats(0.0, 6.3), st.floats(0.01, 1e4))
def test_an_oscillation_of_ten_samples_and_more_is_no_damage(samples, phase, size):
    assert found(size * np.sin(2.0 * np.pi * np.arange(400) / samples + phase), 1e-9 * size) == []


def test_how_often_white_noise_is_taken_for_damage():
    """6 values in 100,000, as the module says: 500,000 of them hold 33 or so."""
    x = np.random.default_rng(1).standard_normal((125_000, 4))
    assert plausible.lone(times(len(x)), x, 1e-9).mean() < 1e-4


@MANY
@given(st.integers(30, 169), st.sampled_from([-1.0, 1.0]), st.floats(1.0, 1e6), st.floats(0.0, 3.0), st.integers(0, 10))
def test_a_value_far_off_in_a_smooth_signal_is_found(at, sign, beyond, sd, seed):
    x = 1500.0 + 50.0 * np.sin(2.0 * np.pi * np.arange(200) / 60.0) + noise(200, sd, seed)
    rough = np.median(np.abs(x[1:-1] - (x[2:] + x[:-2]) / 2.0))
    apart = np.abs(x[at + 1] - x[at - 1])
    x[at] += sign * (40.0 * rough + 4.0 * apart + beyond)
    assert at in found(x)


@pytest.mark.parametrize("alike", [False, True])
def test_a_long_signal_is_looked_at_a_stretch_at_a_time(monkeypatch, alike):
    """What is lone in it is the same, at the ends of the stretches as well."""
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.01, 0.03, 2000))
    values = rng.normal(size=(2000, 3)).cumsum(axis=0)
    values[rng.integers(0, 2000, 60), rng.integers(0, 3, 60)] += 40.0
    values[[499, 500, 999, 1000, 1500], 1] += [50.0, 50.0, 50.0, 0.0, 50.0]
    how = time, values, np.ones(values.shape, bool), 0.1, alike
    whole = plausible._size(*how)
    monkeypatch.setattr(plausible, "PIECE", 500)
    assert len(whole.rows) > 30
    for one, other in zip(whole, plausible._size(*how), strict=True):
        np.testing.assert_array_equal(one, other)


def test_two_in_a_row_are_found():
    x = 1500.0 + noise(200, 1.0)
    x[[100, 101]] += [512.0, -256.0]
    assert found(x) == [100, 101]


def test_a_gap_says_nothing():
    """Beside a pause there is no neighbour."""
    time = np.r_[times(100), 60.0, 100.0 + times(100)]
    x = 1500.0 + noise(201, 1.0)
    x[100] = 1900.0
    assert not plausible.lone(time, x[:, None], 1e-9).any()


@pytest.mark.parametrize(("further", "wild"), [(0, True), (1, False)])
def test_a_neighbour_counts_up_to_so_many_typical_intervals_away(further, wild):
    """An interval that is a power of two makes the limit exact."""
    time = 0.125 * np.arange(200)
    time[100:] += 0.125 * (plausible.FAR - 1 + further)
    x = 1500.0 + noise(200, 1.0)
    x[100] = 1900.0
    assert plausible.lone(time, x[:, None], 1e-9)[100, 0] == wild


@pytest.mark.parametrize("n", [1, 2, 10])
def test_of_a_few_samples_nobody_knows_what_is_usual(n):
    x = 1500.0 + noise(n, 1.0)
    x[n // 2] = 1900.0
    assert found(x) == []


# -- a whole flight ----------------------------------------------------------------------------------------------------


def signals(n=400):
    """A quad's flight with commands that follow its controller, some noise on all of it."""
    rng = np.random.default_rng(3)
    control = np.column_stack([0.1 * rng.standard_normal((n, 3)), 0.4 + 0.02 * rng.standard_normal(n)])
    mixer = np.array([[-0.5, 0.5, 0.5, 1.0], [0.5, -0.5, 0.5, 1.0], [0.5, 0.5, -0.5, 1.0], [-0.5, -0.5, -0.5, 1.0]])
    motors = 1100.0 + 800.0 * control @ mixer.T + rng.normal(0.0, 0.5, (n, 4))
    return {
        "motors": Signal(times(n), motors, ("r1", "r2", "r3", "r4"), "us", source="RCOU"),
        "control": Signal(times(n), control, ("roll", "pitch", "yaw", "thrust"), "1", source="RATE"),
        "gyro": Signal(times(n), 0.02 * rng.standard_normal((n, 3)), ("x", "y", "z"), "rad/s", "FRD", "IMU"),
        "accel": Signal(times(n), [0, 0, -9.8] + 0.1 * rng.standard_normal((n, 3)), ("x", "y", "z"), "m/s^2", "", "IMU"),
        "lift": Signal(times(n), np.column_stack([np.ones(n), np.linspace(1.0, 0.9, n)]), ("lift_max", "voltage_ratio"), "1"),
    }


def flight(**changed):
    return Flight("test", "ArduPilot", {**signals(), **changed}, 40.0)


def changed(name, rows, columns, by):
    signal = signals()[name]
    values = signal.values.copy()
    values[rows, columns] += by
    return {name: Signal(signal.time, values, signal.columns, signal.unit, signal.frame, signal.source)}


def test_an_intact_flight_keeps_its_signals():
    one = flight()
    found = plausible.checked(one)
    assert all(found[name] is one[name] for name in one.signals) and not found.warnings and not found.facts


@pytest.mark.parametrize(("name", "column", "by"), [("motors", 2, 64.0), ("lift", 1, 0.25), ("gyro", 0, 2.0), ("accel", 2, 20.0)])
def test_one_wrong_value_is_dropped_and_said(name, column, by):
    checked = plausible.checked(flight(**changed(name, 200, column, by)))
    assert np.argwhere(~checked[name].valid).tolist() == [[200, column]]
    assert any(w.startswith(name) and "1 value that does not fit" in w for w in checked.warnings)
    assert checked.facts["damage"] == {name: pytest.approx(1.0 / checked[name].values.size)}


def test_a_command_that_rough_flight_hides_is_found_by_what_the_mixer_makes_of_the_controller():
    """64 us are within what these commands do from sample to sample (80 us), but nothing asked for them."""
    one = flight(**changed("motors", 200, 2, 64.0))
    alone = {"motors": one["motors"]}
    assert plausible.checked(Flight("test", "ArduPilot", alone, 40.0)).warnings == ()
    assert not plausible.checked(one)["motors"].valid[200, 2]


def test_wrong_values_in_records_that_follow_each_other_do_not_support_each_other():
    one = changed("lift", 200, 1, -0.06)["lift"]
    values = one.values.copy()
    values[201, 0] = 0.004
    lift = Signal(one.time, values, one.columns, "1")
    assert np.argwhere(~plausible.checked(flight(lift=lift))["lift"].valid).tolist() == [[200, 1], [201, 0]]


def test_the_mixer_is_known_for_what_the_vehicle_does_for_the_first_time():
    """Hover on end, then the first roll: what it teaches of the mixer counts where it is flown."""
    n = 400
    rng = np.random.default_rng(5)
    control = np.column_stack([1e-3 * rng.standard_normal((n, 3)), 0.4 + 1e-4 * rng.standard_normal(n)])
    control[200:230, 0] += 0.1 * rng.standard_normal(30)
    mixer = np.array([[-0.5, 0.5, 0.5, 1.0], [0.5, -0.5, 0.5, 1.0], [0.5, 0.5, -0.5, 1.0], [-0.5, -0.5, -0.5, 1.0]])
    motors = np.round(1100.0 + 800.0 * control @ mixer.T)
    motors[215, 2] += 64.0
    kinds = {"motors": (motors, ("r1", "r2", "r3", "r4"), "us"), "control": (control, ("roll", "pitch", "yaw", "thrust"), "1")}
    made = {k: Signal(times(n), v, c, unit, source=k) for k, (v, c, unit) in kinds.items()}
    checked = plausible.checked(Flight("test", "ArduPilot", made, 40.0))
    assert np.argwhere(~checked["motors"].valid).tolist() == [[215, 2]]


def test_a_knock_shakes_more_than_one_axis_and_stays():
    knock = changed("accel", 200, [0, 1], [30.0, -20.0]) | changed("gyro", 200, [0], 2.0)
    checked = plausible.checked(flight(**knock))
    assert checked["accel"].valid.all() and checked["gyro"].valid.all()


def test_a_kick_of_all_motors_stays():
    checked = plausible.checked(flight(**changed("motors", 200, slice(None), 300.0)))
    assert checked["motors"].valid.all()


def rough_commands(seed, n=4000):
    """(n, 4): a lively flight of a quad at 1 kHz; motor 3 is commanded less than it can, so that it mostly lies at idle."""
    return np.clip([0.4, 0.3, 0.0, 0.35] + 0.025 * np.random.default_rng(seed).standard_normal((n, 4)), 0.055, 1.0)


def commanded(values):
    motors = Signal(1e-3 * np.arange(len(values)), values, ("a", "b", "c", "d"), "1", source="motor[0] ..")
    return plausible.checked(Flight("test", "Betaflight", {"motors": motors}, 1e-3 * len(values)))["motors"].valid


@pytest.mark.parametrize("seed", range(3))
def test_a_motor_that_rises_from_idle_for_a_sample_is_no_damage(seed):
    """At idle it has no residual, so that its own tells nothing of how rough the commands are: those of the others do."""
    assert (~commanded(rough_commands(seed))).mean() < 1e-4


def test_a_wrong_value_of_a_motor_at_idle_is_found():
    values = rough_commands(3)
    values[1000, 2] = 0.5
    assert not commanded(values)[1000, 2]


def test_a_rotor_that_is_switched_off_stays():
    one = signals()["motors"]
    values = one.values.copy()
    values[200:, 1] = 1000.0
    motors = Signal(one.time, values, one.columns, "us", source="RCOU")
    assert plausible.checked(flight(motors=motors))["motors"].valid.all()


@pytest.mark.parametrize(("by", "stays"), [(30.0, True), (900.0, False)])
def test_a_motor_at_idle_is_as_rough_as_the_others_when_it_moves(by, stays):
    """FPV vehicles fly with motors at idle that come up for one sample."""
    one = signals()["motors"]
    values = one.values.copy()
    values[150:250, 1] = 1000.0
    values[200, 1] += by
    flown = Flight("test", "Betaflight", {"motors": Signal(one.time, values, one.columns, "us")}, 40.0)
    assert plausible.checked(flown)["motors"].valid[200, 1] == stays


@pytest.mark.parametrize("impossible, damaged", [(0, False), (1, False), (40, True)])
def test_heavy_damage_is_said_where_something_is_impossible(impossible, damaged):
    """Jolts alone are what vehicles do that tumble, are tuned or lose a motor's step."""
    notes = (series.Impossible(impossible, "records with an impossible time stamp"),) if impossible else ()
    one = replace(flight(**changed("lift", np.arange(20, 390, 37), 1, 0.3)), warnings=("first", *notes))
    said = plausible.checked(one).warnings
    assert any(w.startswith("This log is damaged: 40 of its records") and "lift" in w for w in said) == damaged
    assert {type(w) for w in said} == {str} and said[: 1 + len(notes)] == one.warnings


NOT_DAMAGED = ["open/ap_quad_autotune", "wild/desync-called-damage-1", "crash/take-off-dead-1", "crash/take-off-swapped-2"]


@pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the shared test flights are not beside the repository")
@pytest.mark.parametrize("name", [*NOT_DAMAGED, "damaged/flip5_healthy_0", "damaged/flip5_healthy_3"])
def test_logs_of_vehicles_that_jolt_are_not_called_damaged(name):
    said = any("Copy the log" in w for w in logs.read(FLIGHTS / f"{name}.bin.xz").warnings)
    assert said == (name not in NOT_DAMAGED)


def test_a_log_cut_short_keeps_what_was_said_before_the_cut():
    """Only the last samples may be assessed otherwise: nothing later than AHEAD of them counts."""
    whole = flight(**changed("lift", [100, 240], 1, 0.3), **changed("motors", [150, 290], 2, 200.0))
    cut, all_of_it = plausible.checked(whole.until(30.0)), plausible.checked(whole)
    for name in ("motors", "lift"):
        n = len(cut[name]) - lone_values.AHEAD - 2
        assert (cut[name].valid[:n] == all_of_it[name].valid[:n]).all()
    assert not all_of_it["motors"].valid[290, 2] and not cut["motors"].valid[290, 2]


# -- parameters --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [("FRAME_CLASS", 1.5), ("MOT_PWM_MIN", 4.3e12), ("MOT_THST_EXPO", 1e38), ("SERVO3_FUNCTION", 34.25), ("CA_ROTOR_COUNT", 1e9)],
)
def test_parameters_that_cannot_be_are_not_believed(name, value):
    fine, notes = parameter_ranges.checked({name: value, "WPNAV_SPEED": 500.0})
    assert fine == {"WPNAV_SPEED": 500.0} and name in notes[0]


def test_every_bit_of_a_whole_parameter_that_makes_it_no_whole_number_is_seen():
    bits = np.float32(34.0).view(np.uint32) ^ (np.uint32(1) << np.arange(32, dtype=np.uint32))
    believed = [v for v in bits.view(np.float32).tolist() if parameter_ranges.possible("SERVO1_FUNCTION", v)]
    assert len(believed) <= 7  # those that are other whole numbers


def test_what_no_diagnosis_would_notice_is_left_alone():
    """A lone value counts from its signal's floor on; floors are sizes, and every signal that is assessed on has one."""
    assert all(0.0 < floor for floor in plausible.FLOORS.values())
    for name, columns in (("battery", ("voltage", "current")), ("accel", ("x", "y", "z"))):
        for times_floor, wild in ((0.5, 0), (5.0, 1)):
            values = 10.0 + np.zeros((200, len(columns))) + 1e-4 * np.random.default_rng(1).standard_normal((200, len(columns)))
            values[100, 0] += times_floor * plausible.FLOORS[name]
            flight = plausible.checked(Flight("t", "t", {name: Signal(times(200), values, columns, "1")}, 20.0))
            assert (~flight[name].valid).any(axis=1).sum() == wild, (name, times_floor)


def outputs(rows, invalid=(), rate=10.0, n=200):
    values = 1590.0 + noise(4 * n, 1.0).reshape(n, 4)
    values[rows, :3] = 0.0
    valid = values > 0.0
    for row in invalid:
        valid[row] = False
    return Flight("x", "ArduPilot", {"motors": Signal(np.arange(n) / rate, values, tuple("abcd"), "us", "", "RCOU", valid)}, n / rate)


def test_a_lone_record_without_commands_is_dropped_and_said():
    flight = plausible.checked(outputs([85, 120]))
    assert not flight["motors"].valid[[85, 120]].any() and flight["motors"].valid.all(axis=1).sum() == 198
    assert flight.warnings == ("motors (RCOU): 2 records in which most outputs are no command dropped, at 8.5 s, 12.0 s.",)
    (many,) = plausible.checked(outputs([85, 120, 130, 140])).warnings
    assert many.endswith("at 8.5 s, 12.0 s, 13.0 s and later.")


def test_outputs_that_are_switched_off_are_not_damage():
    assert plausible.checked(outputs(slice(85, 88))).warnings == ()
    assert plausible.checked(outputs(slice(85, 200))).warnings == ()
    assert plausible.checked(outputs([0, 199])).warnings == ()
    assert plausible.checked(outputs(slice(10, 190, 5))).warnings == ()  # too many for damage: what the log is like


# -- flights in memory -------------------------------------------------------------------------------------------------


def flight_in_memory(n=900):
    """A minute and a half of hover: take-off at 5 s."""
    rng, time = np.random.default_rng(4), times(n)
    aloft = np.clip((time - 5.0) / 0.5, 0.0, 1.0)[:, None]
    values = {
        "motors": (1100.0 + 400.0 * aloft + rng.normal(0.0, 4.0, (n, 4)), "us"),
        "gyro": (0.02 * rng.standard_normal((n, 3)), "rad/s"),
        "accel": ([0.0, 0.0, -9.80665] + 0.1 * rng.standard_normal((n, 3)), "m/s^2"),
        "velocity": (0.02 * rng.standard_normal((n, 3)) - [0.0, 0.0, 1.0] * (aloft * (time < 8.0)[:, None]), "m/s"),
        "battery": (np.tile([12.0, 9.0], (n, 1)), "V,A"),
    }
    made = {k: Signal(time, v, tuple("abcd"[: v.shape[1]]), unit, source=k) for k, (v, unit) in values.items()}
    return Flight("arrays", "ArduPilot", made, float(time[-1]))


QUAD = airframes.named("ardupilot-quad-x")


@functools.cache
def clean_answer():
    return diagnose(flight_in_memory(), QUAD)


@pytest.mark.thorough(keep=8)
@pytest.mark.parametrize("name", ["motors", "gyro", "accel", "velocity", "battery"])
@pytest.mark.parametrize("wrong", [1e300, -1e300, np.inf, np.nan])
def test_one_value_that_cannot_be_changes_no_answer_of_a_flight_in_memory(name, wrong):
    flight = flight_in_memory()
    values = flight[name].values.copy()
    values[600, 0] = wrong
    damaged = replace(flight, signals={**flight.signals, name: replace(flight[name], values=values)})
    answer, clean = diagnose(damaged, QUAD), clean_answer()
    assert (answer.verdict, answer.events) == (clean.verdict, clean.events) == ("healthy", ())
    said = [text for text in answer.warnings if "ends in the air" not in text]
    assert bool(said) == np.isfinite(wrong)


@pytest.mark.parametrize("wrong", [1e300, -1e300, np.inf, np.nan, 0.0])
def test_one_time_that_cannot_be_costs_one_sample_of_a_flight_in_memory(wrong):
    flight = flight_in_memory()
    time = flight["motors"].time.copy()
    time[600] = wrong
    damaged = replace(flight, signals={**flight.signals, "motors": replace(flight["motors"], time=time)})
    assert len(plausible.checked(damaged)["motors"]) == len(time) - 1
    assert diagnose(damaged, QUAD).verdict == "healthy"


def test_a_flight_is_looked_over_for_lone_values_once_and_for_impossible_ones_always():
    flight = flight_in_memory()
    values = flight["accel"].values.copy()
    values[600, 0] += 60.0
    signals = {**flight.signals, "accel": replace(flight["accel"], values=values)}
    found = plausible.checked(replace(flight, signals=signals))
    assert not found["accel"].valid[600, 0] and found["accel"].valid.sum() == found["accel"].valid.size - 1
    assert plausible.checked(found) is found
    values[600, 0] = 1e300
    again = plausible.checked(replace(found, signals={**signals, "accel": replace(flight["accel"], values=values)}))
    assert not again["accel"].valid[600, 0]
