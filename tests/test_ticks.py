"""From uneven samples to ticks: means and slopes are exact, and nothing of a tick was measured after it."""

import itertools
import warnings
from dataclasses import replace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.driver import observe
from rotorwatch.engine.estimator import announcement
from rotorwatch.engine.intake import sense
from rotorwatch.engine.intake import ticks as definition
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.motion import tick_table
from rotorwatch.engine.motion.knocks import G0, Contact
from rotorwatch.flight import Flight, Signal

B = np.array([[-1.0, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]])
END = 12.0
AIR = ((2.0, 11.0),)
SLOPE = np.array([0.3, -0.2, 0.1])


def log(rate=200.0, gyro_rate=400.0, start=0.0, seed=0):
    """(flight, thrusts) with uneven sample times, a gyro that turns up evenly and a level accelerometer."""
    rng = np.random.default_rng(seed)
    time = start + np.arange(0, END, 1 / rate) + rng.uniform(0, 0.3 / rate, round(END * rate))
    gyro = start + np.arange(0, END, 1 / gyro_rate)
    thrust = Signal(time, 0.4 + 0.02 * rng.standard_normal((time.size, 4)), ("r1", "r2", "r3", "r4"), "1")
    signals = {
        "motors": thrust,
        "gyro": Signal(gyro, gyro[:, None] * SLOPE, ("x", "y", "z"), "rad/s"),
        "accel": Signal(gyro, np.tile([0.0, 0.0, -G0], (gyro.size, 1)), ("x", "y", "z"), "m/s^2"),
    }
    return Flight("test", "test", signals, start + END), thrust


def make(flight, thrust, **options):
    return tick_table.cut_ticks(flight, thrust, B, AIR, 3.0, **options)


LENGTHS = [(400.0, 0.05), (50.0, 0.05), (20.0, 0.05), (19.0, 0.05), (10.0, 0.1), (8.5, 0.1), (5.0, 0.2), (0.0, 1.0)]


@pytest.mark.parametrize("rate, dt", LENGTHS)
def test_tick_length_follows_the_rate_of_the_commands(rate, dt):
    """Also of commands that have no rate: those of one record, or all of one time."""
    assert tick_table.tick_length(rate) == pytest.approx(dt)


def test_ticks_longer_than_a_tenth_of_a_second_are_slow_and_it_is_said_how_many_an_announcement_takes():
    assert tick_table.slow(10.0, 0.1, 8.0) == ""
    said = tick_table.slow(5.0, 0.2, 8.0)
    assert "assessed every 0.2 s" in said
    assert f"shows in {announcement.TICKS} of these, {announcement.TICKS * 0.2:g} s" in said


@pytest.mark.parametrize("rate", [10.0, 25.0, 200.0])
def test_a_tick_holds_the_mean_of_its_own_commands_and_every_command_counts_once(rate):
    flight, thrust = log(rate)
    table = make(flight, thrust, hover=0.5)
    end = table.time - tick_table.LAG_S - table.dt / 2  # of each tick's commands
    counted = 0
    for k in range(len(end)):
        inside = (thrust.time > end[k] - table.dt + 1e-9) & (thrust.time <= end[k] + 1e-9)
        counted += inside.sum()
        if inside.any():
            np.testing.assert_allclose(table.thrust[k], thrust.values[inside].mean(axis=0) / 0.5, rtol=1e-9)
            assert table.command_time[k] == pytest.approx(thrust.time[inside].mean())
        else:
            assert not table.valid[k].any()
    assert counted >= len(thrust) - 2 * max(1, rate * table.dt)  # the log's ends may cut a tick
    np.testing.assert_allclose(table.wrench, table.thrust @ B.T)


def test_samples_that_are_not_valid_do_not_count():
    flight, thrust = log()
    bad = np.arange(len(thrust)) % 3 == 0
    values = np.where(bad[:, None], 1e6, thrust.values)
    marked = Signal(thrust.time, values, thrust.columns, "1", valid=~bad)
    table = make(flight, marked, hover=0.5)
    assert np.abs(table.thrust[table.valid[:, 0]]).max() < 1.1


@pytest.mark.parametrize("gyro_rate", [50.0, 400.0, 1000.0])
def test_an_even_turn_up_has_exactly_its_slope_and_the_load_is_one(gyro_rate):
    flight, thrust = log(gyro_rate=gyro_rate)
    table = make(flight, thrust)
    assessed = table.valid.all(axis=1)
    assert assessed.sum() > 0.9 * (table.mode > tick_table.GROUND).sum() > 0
    np.testing.assert_allclose(table.rate_dot[assessed], np.tile(SLOPE, (assessed.sum(), 1)), atol=1e-9)
    centre = table.command_time + tick_table.LAG_S
    np.testing.assert_allclose(table.rate[assessed], centre[assessed, None] * SLOPE, atol=1e-9)
    np.testing.assert_allclose(table.load[assessed], 1.0, rtol=1e-9)


def test_side_forces_are_means_of_the_half_second_that_has_passed():
    """Forward and right, of a force that grows evenly: their mean is that of a quarter of a second before the tick's end."""
    flight, thrust = log()
    accel = flight["accel"]
    ramp = np.column_stack([0.4 * accel.time, -0.1 * accel.time, accel.values[:, 2]])
    signals = {**flight.signals, "accel": Signal(accel.time, ramp, ("x", "y", "z"), "m/s^2")}
    table = make(Flight("test", "test", signals, END), thrust)
    middle = table.command_time + tick_table.LAG_S + table.dt / 2 - tick_table.SIDE_S / 2
    flying = table.mode > tick_table.GROUND
    np.testing.assert_allclose(table.side[flying], np.outer(middle[flying], [0.4, -0.1]), atol=1e-9)
    assert (middle + tick_table.SIDE_S / 2 <= table.time + 1e-9).all()  # nothing after the tick
    blind = Flight("test", "test", {k: v for k, v in flight.signals.items() if k != "accel"}, END)
    assert make(blind, thrust).side is None


def test_the_unit_of_thrust_is_the_hover_command():
    flight, thrust = log()
    hover = thrust.between(2.0, 3.0).values.mean()
    np.testing.assert_allclose(make(flight, thrust).hover[-1], hover, rtol=0.01)
    heavy = Signal(flight["accel"].time, flight["accel"].values * 1.25, ("x", "y", "z"), "m/s^2")
    climbing = Flight("test", "test", {**flight.signals, "accel": heavy}, END)
    np.testing.assert_allclose(make(climbing, thrust).hover[-1], hover / 1.25, rtol=0.01)
    assert np.all(make(flight, thrust, hover=0.37).hover == 0.37)


def test_modes_ground_learning_assessing():
    flight, thrust = log()
    table = make(flight, thrust)
    when = table.time
    assert np.all(table.mode[when < 2.0 + tick_table.HOVER_LEARN_S] == tick_table.GROUND)
    learning = (when >= 2.0 + tick_table.HOVER_LEARN_S) & (when < 5.0)
    assert np.all(table.mode[learning] == tick_table.LEARN)
    assert np.all(table.mode[(when >= 5.0) & (table.command_time <= 11.0)] == tick_table.ASSESS)
    assert np.all(table.mode[table.command_time > 11.0] == tick_table.GROUND)
    assert np.flatnonzero(table.restart).tolist() == [np.flatnonzero(learning)[0]]
    assert not table.valid[table.mode == tick_table.GROUND].any()


def test_the_first_second_of_flight_ends_where_a_tick_ends():
    """A tick that is complete exactly a second after lift-off is in the air, the one before it is not."""
    flight, thrust = log()
    times = make(flight, thrust).time
    k = next(k for k in range(60, len(times)) if times[k] - 1.0 + tick_table.HOVER_LEARN_S == times[k])
    table = tick_table.cut_ticks(flight, thrust, B, ((times[k] - 1.0, 11.0),), 3.0)
    assert table.mode[k - 1 : k + 1].tolist() == [tick_table.GROUND, tick_table.LEARN]


def test_ticks_cut_in_parts_are_the_same_when_joined():
    """Contacts of the last part, which knows those before it; what one part does not measure the whole does not, but contacts it has."""
    flight, thrust = log()
    table = make(flight, thrust)
    first, second = Contact(4.0, 1.5, 0), Contact(9.0, 2.0, 0)
    table = replace(table, contact=np.isin(np.arange(len(table.time)), (70, 170)), contacts=(first, second))
    early = table.time < 6.0
    parts = [replace(table.part(early), contacts=(first,)), table.part(~early)]
    for whole in (tick_table.joined([table]), tick_table.joined(parts)):
        assert whole.contacts == (first, second) and whole.dt == table.dt and whole.notes == table.notes
        for name, values in vars(table).items():
            if isinstance(values, np.ndarray):
                np.testing.assert_array_equal(getattr(whole, name), values, err_msg=name)
    blind = tick_table.joined([parts[0], replace(parts[1], side=None, contact=None)])
    assert blind.side is None and np.flatnonzero(blind.contact).tolist() == [70]


def test_a_flight_without_motors_or_out_of_the_air_has_no_ticks():
    """Nor one where an output is never a command; all others have."""
    flight, thrust = log()
    vehicle = airframes.named("px4-quad-x")
    assert observe(flight, vehicle, AIR, 3.0) is not None
    assert observe(flight, vehicle, (), 3.0) is None
    still = {name: signal for name, signal in flight.signals.items() if name != "motors"}
    assert observe(replace(flight, signals=still), vehicle, AIR, 3.0) is None
    dead = replace(thrust, valid=np.tile([True, True, False, True], (len(thrust), 1)))
    assert observe(replace(flight, signals={**still, "motors": dead}), vehicle, AIR, 3.0) is None


def test_a_tick_needs_two_fifths_of_the_gyros_usual_samples():
    """A gyro that mostly fails for two seconds, and then gives every other sample: the first is not assessed, the second is."""
    flight, thrust = log()
    gyro, k = flight["gyro"], np.arange(len(flight["gyro"]))
    every = np.where((gyro.time > 6.0) & (gyro.time < 8.0), 5, np.where((gyro.time > 8.0) & (gyro.time < 10.0), 2, 1))
    kept = k % every == 0
    thin = Signal(gyro.time[kept], gyro.values[kept], gyro.columns, "rad/s")
    table = make(replace(flight, signals={**flight.signals, "gyro": thin}), thrust)
    fifth, half = ((table.time > begin + 0.2) & (table.time < begin + 1.8) for begin in (6.0, 8.0))
    assert not table.valid[fifth, :3].any() and table.valid[half].all()


def test_a_gyro_whose_records_have_all_one_time_has_no_period():
    """And no warning of an empty median is printed."""
    flight, thrust = log()
    stopped = Signal(np.full(30, 1.0), np.zeros((30, 3)), ("x", "y", "z"), "rad/s")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan = tick_table.plan(replace(flight, signals={**flight.signals, "gyro": stopped}), thrust, 3.0)
    assert np.isnan(plan.period["gyro"]) and plan.period["accel"] == pytest.approx(1 / 400.0)


@pytest.mark.parametrize("axis, degrees, upset", [(0, 64, False), (0, 66, True), (1, -66, True), (2, 170, False)])
def test_a_vehicle_that_leans_by_more_than_65_degrees_is_upset(axis, degrees, upset):
    """By its attitude alone, a quaternion w, x, y, z; heading is no lean."""
    flight, thrust = log()
    time, half = np.arange(0, END, 0.02), np.deg2rad(degrees) / 2.0
    turned = np.append(np.cos(half), np.sin(half) * np.eye(3)[axis])
    values = np.where((time > 6.0)[:, None], turned, [1.0, 0.0, 0.0, 0.0])
    attitude = Signal(time, values, ("w", "x", "y", "z"), "1")
    table = make(replace(flight, signals={**flight.signals, "attitude": attitude}), thrust)
    assert not table.upset[table.time < 5.9].any()
    assert table.upset[table.time > 6.2].all() == upset == table.upset.any()


def moving(gap=(np.inf, np.inf), wrong=np.inf):
    """(flight, thrusts, the true speed along the thrust axis as a function of time) of a vehicle that flies curves; gap: no velocity in
    between; wrong: from when on the velocity is nonsense."""
    flight, thrust = log()
    time = np.arange(0, END, 0.02)

    def at(t):
        t = np.asarray(t, float)
        lean, heading = 0.6 * np.sin(0.7 * t), 0.4 * t  # forward, about the axis that points to the right
        speed = np.stack([3.0 * np.cos(0.4 * t), 2.0 * np.sin(t), -np.cos(0.9 * t)], axis=-1)
        turned, leant = ([np.cos(a / 2), np.sin(a / 2)] for a in (heading, lean))
        q = np.stack([turned[0] * leant[0], -turned[1] * leant[1], turned[0] * leant[1], turned[1] * leant[0]], axis=-1)
        up = -np.stack([np.sin(lean) * np.cos(heading), np.sin(lean) * np.sin(heading), np.cos(lean)], axis=-1)
        return q, speed, (up * speed).sum(axis=-1)

    q, speed, _ = at(time)
    speed = np.where((time >= wrong)[:, None], 1e20, speed)
    known = (time < gap[0]) | (time > gap[1])
    signals = {
        "attitude": Signal(time, q, ("w", "x", "y", "z"), "1"),
        "velocity": Signal(time[known], speed[known], ("n", "e", "d"), "m/s"),
    }
    return replace(flight, signals={**flight.signals, **signals}), thrust, lambda t: at(t)[2]


def test_the_speed_along_the_thrust_axis_is_that_of_velocity_and_attitude():
    """The velocity's part along the axis that points up out of the rotors, at the last attitude that a tick knows."""
    flight, thrust, truth = moving()
    table = make(flight, thrust)
    assert np.abs(truth(table.time)).max() > 2.0
    np.testing.assert_allclose(table.axial, truth(table.time), atol=0.02 * 4.0)


def test_without_velocity_or_attitude_the_speed_along_the_thrust_axis_is_not_known():
    """Nor where the velocity stopped more than a second ago, or cannot be true."""
    flight, thrust, _ = moving(gap=(5.0, 8.0), wrong=9.0)
    table = make(flight, thrust)
    blank = np.isnan(table.axial)
    gone = ((table.time > 6.1) & (table.time < 8.0)) | (table.time > 9.1)
    assert blank[gone].all() and not blank[(table.time < 5.9) | ((table.time > 8.1) & (table.time < 8.9))].any()
    for name in ("velocity", "attitude"):
        less = {k: v for k, v in flight.signals.items() if k != name}
        assert np.isnan(make(replace(flight, signals=less), thrust).axial).all()


def test_a_tumbling_vehicle_is_not_assessed_any_more():
    flight, thrust = log()
    gyro = flight["gyro"]
    rolling = gyro.values + (gyro.time[:, None] > 8.0) * np.array([10.0, 0, 0])
    table = make(Flight("t", "t", {**flight.signals, "gyro": Signal(gyro.time, rolling, gyro.columns, "rad/s")}, END), thrust)
    assert table.valid[(table.time > 5.0) & (table.time < 7.9), 0].all()
    assert not table.valid[table.time > 8.5].any()


@pytest.mark.parametrize("rate", [10.0, 200.0])
@pytest.mark.parametrize("cut", [6.03, 9.5])
def test_what_comes_later_changes_no_tick(rate, cut):
    """Garbage after the cut, of the same time stamps: every tick up to then stays as it was, to the last bit."""
    flight, thrust = log(rate)
    rng = np.random.default_rng(1)

    def spoilt(signal):
        late = signal.time > cut
        return Signal(
            signal.time, np.where(late[:, None], rng.standard_normal(signal.values.shape) * 50, signal.values), signal.columns, signal.unit
        )

    other = Flight("test", "test", {k: spoilt(s) for k, s in flight.signals.items()}, END)
    one, two = make(flight, thrust), make(other, spoilt(thrust))
    before = one.time <= cut
    assert before.sum() > 30
    for name in ("time", "command_time", "hover", "mode", "valid", "upset"):
        np.testing.assert_array_equal(getattr(one, name)[before], getattr(two, name)[before], err_msg=name)
    for name in ("thrust", "wrench", "rate", "rate_dot", "load"):
        np.testing.assert_array_equal(getattr(one, name)[before], getattr(two, name)[before], err_msg=name)
    assert not np.array_equal(one.thrust[~before], two.thrust[~before])


@pytest.mark.parametrize("rate", [10.0, 25.0, 200.0])
def test_a_log_that_stops_earlier_has_the_same_ticks_until_then(rate):
    flight, thrust = log(rate)
    whole = make(flight, thrust)
    short = make(flight.until(8.0), thrust.between(-np.inf, 8.0))
    done = short.time <= 8.0
    assert done.sum() > 50
    count = np.flatnonzero(done)[-1] + 1
    np.testing.assert_array_equal(short.time[:count], whole.time[:count])
    for name in ("thrust", "rate", "rate_dot", "load"):
        np.testing.assert_allclose(getattr(short, name)[:count], getattr(whole, name)[:count], atol=1e-12, err_msg=name)


def test_without_gyro_or_accelerometer_the_rest_is_still_assessed_and_said():
    _, thrust = log()
    bare = Flight("test", "test", {"motors": thrust}, END)
    table = make(bare, thrust)
    flying = table.mode > tick_table.GROUND
    assert table.valid[flying, :3].all() and not table.valid[:, 3].any()
    assert len(table.notes) == 2 and "angular rate" in table.notes[0] and "accelerometer" in table.notes[1]
    assert not np.abs(table.rate_dot).any() and np.all(table.load == 1.0)


def test_the_slope_is_what_the_ends_of_the_window_differ_by():
    """An eighth of the window at each end: a spike between them, or outside the window, does not turn the vehicle."""
    plan = sense.Plan()
    plan.gyro_half = half = 0.1
    for at, felt in ((0.5, 0), (0.44, 0), (0.56, 0), (0.39, 0), (0.61, 0), (0.41, -1), (0.59, 1)):
        state, out = sense.Sense(), sense.Sensed()
        for k in range(1000):
            state.gyros.add(0.001 * k, float(abs(0.001 * k - at) < 5e-4), 0.0, 0.0)
        state._turn(plan, 0.5, out)
        slope = out.rate_dot[0]
        assert out.rate_ok and np.sign(np.round(slope, 12)) == felt, at
        if felt:  # a spike 1 ms wide in a mean over 25 ms, over the distance of the means
            assert abs(slope) == pytest.approx(0.001 / 0.025 / (2 * half - 0.025), rel=1e-6)


def kept(seed, count=400):
    """Samples of uneven times, and the same as arrays."""
    rng = np.random.default_rng(seed)
    time, values = np.cumsum(rng.uniform(0.001, 0.03, count)), rng.standard_normal((count, 3))
    samples = sense.Samples()
    for t, row in zip(time.tolist(), values.tolist()):
        samples.add(t, *row)
    return samples, time, values


def test_the_area_between_two_times_is_that_of_straight_lines_between_samples():
    samples, time, values = kept(1)
    rng = np.random.default_rng(2)
    for _ in range(50):
        begin, end = np.sort(rng.uniform(time[0] - 0.2, time[-1] + 0.2, 2))
        total = [0.0] * 3
        samples.area(float(begin), float(end), total)
        a, b = np.clip([begin, end], time[0], time[-1])
        at = np.concatenate([[a], time[(time > a) & (time < b)], [b]])
        lines = np.stack([np.interp(at, time, x) for x in values.T])
        wanted = ((lines[:, 1:] + lines[:, :-1]) / 2.0 * np.diff(at)).sum(axis=1)
        np.testing.assert_allclose(total, wanted, atol=1e-12)


def test_a_time_is_covered_by_enough_samples_within_it():
    samples, time, _ = kept(3)
    rng = np.random.default_rng(4)
    for _ in range(50):
        begin, end = np.sort(rng.uniform(time[0], time[-1], 2)).tolist()
        inside = int(((time >= begin) & (time <= end)).sum())
        assert samples.covers(begin, end, inside) and not samples.covers(begin, end, inside + 1)
    first, last = float(time[0]), float(time[-1])
    assert samples.covers(first, last, len(time))
    assert not samples.covers(first - 1e-6, last, 1) and not samples.covers(first, last + 1e-6, 1)


def test_the_oldest_samples_make_room_and_late_ones_are_left_out():
    samples = sense.Samples()
    for k in range(sense.MOTION_SAMPLES + 5):
        assert samples.add(float(k), float(k), 0.0, 0.0)
    assert not samples.add(float(k), 1.0, 0.0, 0.0) and not samples.add(3.0, 1.0, 0.0, 0.0)
    assert (samples.count, samples.newest(), samples.start) == (sense.MOTION_SAMPLES, float(k), 0.0)
    assert samples.time[samples.place(0)] == 5.0 and samples.at_or_after(7.5) == 3
    total = [0.0] * 3
    samples.area(0.0, 7.0, total)
    assert total[0] == 0.5 * (7.0**2 - 5.0**2)  # nothing before the first that is kept


@pytest.mark.parametrize("seed", range(5))
def test_long_gaps_cost_no_ticks_but_at_their_ends(seed):
    """Against sets: every tick of the log, and of a gap of more than twice `most` the `most` that touch it on either side."""
    rng = np.random.default_rng(seed)
    at = np.sort(np.concatenate([[0], rng.integers(0, 40, 9), rng.integers(90, 130, 9), [131, 148, 170, 1000]]))
    state, craft, plan, row, numbers = sense.Sense(), Vehicle(), sense.Plan(), sense.Sensed(), []
    craft.rotors, plan.dt = 4, 0.5  # exact in binary
    most = int(sense.GAP_S / plan.dt)
    for time in [*(0.5 * at + 0.125).tolist(), LASTS]:
        while state.ready(plan, time):
            state.measure(craft, plan, row)
            numbers.append(row.number)
        if time < LASTS:
            state.thrust(craft, plan, time, [0.4] * 4, True)
    wanted = set()
    for a, b in itertools.pairwise(np.maximum(at - 1, 0).tolist()):  # ticks that a command says to be complete
        near = range(a, b + 1) if b - a <= 2 * most else (*range(a, a + most), *range(b - most, b + 1))
        wanted |= set(near)
    assert numbers == sorted(wanted)


@pytest.mark.parametrize("axis, rate, upset", [(0, 5.9, False), (0, 6.1, True), (1, -6.1, True), (2, 9.0, False)])
def test_a_vehicle_tumbles_from_six_radians_a_second_of_roll_or_pitch_on(axis, rate, upset):
    flight, thrust = log()
    gyro = flight["gyro"]
    turned = np.where((gyro.time > 6.0)[:, None], rate * np.eye(3)[axis], 0.0)
    table = make(Flight("t", "t", {**flight.signals, "gyro": Signal(gyro.time, turned, gyro.columns, "rad/s")}, END), thrust)
    assert table.upset[table.time > 6.5].all() == upset == table.upset.any()


@pytest.mark.parametrize("lasts, gone", [(0.15, False), (0.8, True)])
def test_who_has_tumbled_for_long_does_not_hover_again_in_this_hop(lasts, gone):
    flight, thrust = log()
    gyro = flight["gyro"]
    turned = np.where(((gyro.time > 7.0) & (gyro.time < 7.0 + lasts))[:, None], [9.0, 0.0, 0.0], 0.0)
    table = make(Flight("t", "t", {**flight.signals, "gyro": Signal(gyro.time, turned, gyro.columns, "rad/s")}, END), thrust)
    later = (table.time > 8.2) & (table.mode > tick_table.GROUND)
    assert table.upset[later].all() == gone == table.upset[later].any() and not table.upset[table.time < 6.9].any()
    assert table.valid[later].any() != gone


def test_rotors_without_yaw_torque_are_not_assessed_by_yaw():
    flight, thrust = log()
    flat = B * [[1.0], [1.0], [0.0], [1.0]]
    valid = tick_table.cut_ticks(flight, thrust, flat, AIR, 3.0).valid
    both = make(flight, thrust).valid
    assert not valid[:, 2].any() and both[:, 2].any()
    np.testing.assert_array_equal(valid[:, [0, 1, 3]], both[:, [0, 1, 3]])


def test_fast_commands_have_ticks_on_whole_multiples_and_slow_ones_in_their_middle():
    for rate in (40.0, 200.0):
        flight, thrust = log(rate)
        table = make(flight, thrust, dt=0.05)
        begin = (table.time - tick_table.LAG_S - 0.025) / 0.05 - 0.5
        np.testing.assert_allclose(begin, np.round(begin), atol=1e-6)
    time = 0.037 + np.arange(0, END, 0.1)
    slow = Signal(time, np.full((time.size, 4), 0.4), ("r1", "r2", "r3", "r4"), "1")
    table = make(Flight("t", "t", {**flight.signals, "motors": slow}, END), slow)
    end = table.time - tick_table.LAG_S - 0.05
    assert table.dt == 0.1 and table.seen[table.mode > tick_table.GROUND].all()
    np.testing.assert_allclose((end - time[0]) % 0.1, 0.05, atol=1e-6)


def test_commands_of_nothing_are_no_hover():
    """Rotors that spin up late: what the vehicle hovers at is the median of the commands there were."""
    flight, thrust = log()
    values = np.where((thrust.time < 2.7)[:, None], 0.0, thrust.values)
    late = Signal(thrust.time, values, thrust.columns, "1")
    table = make(Flight("t", "t", {**flight.signals, "motors": late}, END), late)
    assert table.hover[-1] == pytest.approx(thrust.between(2.7, 3.0).values.mean(), rel=0.02)


def test_blind_time_is_at_least_thirty_ticks():
    assert tick_table.ready_after(8.0, 0.05) == 8.0 and tick_table.ready_after(3.0, 0.5) == tick_table.READY_TICKS * 0.5 == 15.0
    rates = (0.3, 1.9, 4.6, 8.1, 19.1)
    assert [tick_table.tick_length(rate) for rate in rates] == [1.0, 0.5, 0.2, 0.1, 0.05]


def test_after_a_contact_the_trim_is_learned_from_controlled_flight_alone():
    """So many ticks of it: outputs off their limits, turning slowly; a contact of an earlier hop is forgotten."""

    def modes(hits):
        state, craft, plan = definition.Ticks(), Vehicle(), sense.Plan()
        craft.rotors, plan.hover, plan.accel, plan.ready = 4, 0.4, True, 5 * plan.dt
        found = []
        for k in range(60):
            row, made = sense.Sensed(), definition.Made()
            row.time = row.when = 10.0 + plan.dt * k
            row.some = row.load_ok = True
            row.share[:4] = [0.4] * 4
            row.rate_dot[0] = 900.0 if k in hits else 0.0
            row.share[2] = 0.92 if k in (14, 15) else 0.4
            row.rate[1] = 2.5 if k == 17 else 0.0
            row.rate_ok = k != 18
            state.assemble(craft, plan, row, 5.0 if k < 40 else 6.0, made)
            assert made.touch.hit == (k in hits) and made.restart == (k in (0, 40))
            found.append(made.mode)
        return np.array(found)

    assert np.flatnonzero(modes({10, 11}) == tick_table.LEARN).tolist() == list(range(10, 20))
    assert (modes({10, 11, 39})[40:] == tick_table.ASSESS).all() and (modes(set()) == tick_table.ASSESS).all()


def test_learning_is_neither_on_the_ground_nor_assessed():
    """The estimator tells them apart by size, half-way between; what is learned from has to be measured."""
    assert tick_table.GROUND < tick_table.LEARN - 0.5 < tick_table.ASSESS - 1.0
    flight, thrust = log()
    table = make(flight, thrust)
    learning = (table.time >= 2.0 + tick_table.HOVER_LEARN_S) & (table.time < 5.0)
    assert learning.sum() > 30 and table.valid[learning].all()
