"""Rotor thrusts rebuilt from the rate controller, overridden outputs, and what losses cannot be distinguished."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, diagnose, logs
from rotorwatch.engine.driver import fly
from rotorwatch.engine.intake import deviations, mixer
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import ThrustCurve

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the shared test flights are not beside the repository")


@functools.cache
def read(path):
    return logs.read(FLIGHTS / path)


def overrides(flight, vehicle, air):
    """Outputs that left the mixer in flights ((start, end), ...) s, as the engine finds them on the way."""
    flown = fly(flight, vehicle, air, READY_S)
    return () if flown is None else flown[0].overrides


def spans(flight):
    """Where most outputs do more than idle, less take-off and landing: airborne enough for these tests."""
    thrust = allocation.motor_thrusts(flight, airframes.identify(flight))
    up = thrust.time[np.median(thrust.values, axis=1) > 0.12]
    return ((up[0] + 2.0, up[-1] - 1.0),) if up.size else ()


def command_of(thrust, curve, battery=1.0):
    """The command that gives a thrust: inverse of the curve."""
    return curve.u_min + (curve.u_max - curve.u_min) * allocation.drive(curve.expo, thrust) / battery


def hover(frame="ardupilot-quad-x", duration=30.0, rate=50.0, outputs=10.0, gain=1.08, seed=3):
    """A made-up flight whose outputs follow the mixer exactly, rounded to 1 us. Signals motors, control, lift."""
    vehicle = airframes.named(frame)
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 1 / rate)
    waves = np.stack([np.sin(2 * np.pi * f * time + p) for f, p in ((0.9, 0.0), (0.7, 1.0), (0.4, 2.0), (0.2, 3.0))])
    control = (np.array([[0.06, 0.06, 0.05, 0.04]]).T * waves).T + np.array([0, 0, 0, 0.4])
    control += 0.002 * rng.standard_normal(control.shape)
    battery = 0.97 - 0.001 * time
    demand = gain * control @ vehicle.mixer.T
    command = np.round(command_of(demand, vehicle.curve, battery[:, None]))
    every = round(rate / outputs)
    columns = tuple(f"r{k + 1}" for k in range(len(vehicle.rotors)))
    signals = {
        "motors": Signal(time[::every], command[::every], columns, "us", source="RCOU"),
        "control": Signal(time, control, ("roll", "pitch", "yaw", "thrust"), "1", source="RATE"),
        "lift": Signal(time, np.stack([battery**2, battery, np.ones_like(time)], 1), LIFT, "1", source="MOTB"),
    }
    return Flight("made", "ArduPilot", signals, float(time[-1]), name="hover"), vehicle, demand


LIFT = ("lift_max", "voltage_ratio", "limit")


def with_output(flight, rotor, start, value=None, end=np.inf):
    """The flight with one output held at `value` (None: at what it was) from `start` to `end`."""
    motors = flight["motors"]
    values, on = motors.values.copy(), (motors.time >= start) & (motors.time < end)
    values[on, rotor - 1] = values[np.argmax(on), rotor - 1] if value is None else value
    return replace(flight, signals={**flight.signals, "motors": replace(motors, values=values)})


def test_thrust_follows_the_curve_and_the_last_known_battery():
    vehicle = replace(airframes.named("ardupilot-quad-x"), curve=ThrustCurve(1000.0, 2000.0, 0.5))
    motors = Signal([0.0, 1.0, 2.0], np.full((3, 4), 1500.0), ("r1", "r2", "r3", "r4"), "us")
    lift = Signal([0.5, 1.5], np.array([[1.0, 0.8, 1.0], [1.0, 0.6, 1.0]]), LIFT, "1")
    thrust = allocation.motor_thrusts(Flight("t", "", {"motors": motors, "lift": lift}, 2.0), vehicle)
    share = 0.5 * np.array([1.0, 0.8, 0.6])
    assert thrust.values[:, 0] == pytest.approx(0.5 * share + 0.5 * share**2)


@pytest.mark.parametrize("expo", [0.0, 0.3, 0.65, 1.0])
def test_drive_is_the_inverse_of_the_curve(expo):
    share = np.linspace(0, 1, 50)
    assert allocation.drive(expo, ThrustCurve(0.0, 1.0, expo)(share)) == pytest.approx(share)


@pytest.mark.parametrize("frame", ["ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-plus", "ardupilot-y6"])
def test_rebuilt_thrust_equals_what_the_mixer_asked(frame):
    flight, vehicle, demand = hover(frame)
    rebuilt = allocation.mixed_thrusts(flight, vehicle)
    late = rebuilt.time > 1.0
    assert rebuilt.valid[late].all()
    # 1 us is 0.001 of full thrust; the gain is averaged over many.
    assert np.abs(rebuilt.values - demand)[late].max() < 1e-3


def test_an_unknown_mixer_is_learned():
    flight, vehicle, demand = hover()
    rebuilt = allocation.mixed_thrusts(flight, replace(vehicle, mixer=None))
    late = rebuilt.time > 10.0
    assert np.abs(rebuilt.values - demand)[late].max() < 3e-3


def test_rebuilding_brings_nothing_at_equal_rates():
    flight, vehicle, _ = hover(rate=10.0)
    assert allocation.mixed_thrusts(flight, vehicle) is None
    assert len(allocation.rotor_thrusts(flight, vehicle)) == len(flight["motors"])


def test_believed_and_true_curve_may_differ():
    """PX4 with THR_MDL_FAC 0 mixes commands, not thrusts."""
    flight, vehicle, _ = hover()
    shares = flight["control"].values @ vehicle.mixer.T
    motors = Signal(flight["control"].time[::5], shares[::5], flight["motors"].columns, "1", source="actuator_motors")
    flight = replace(flight, signals={"control": flight["control"], "motors": motors})
    vehicle = replace(vehicle, curve=ThrustCurve(0.0, 1.0, 0.65), extra={"mixer_expo": 0.0})
    rebuilt = allocation.mixed_thrusts(flight, vehicle)
    late = rebuilt.time > 1.0
    assert np.abs(rebuilt.values - vehicle.curve(shares))[late].max() < 1e-6


def test_an_output_that_does_not_follow_is_not_trusted_and_the_logged_one_taken():
    flight, vehicle, _ = hover()
    flight = with_output(flight, 2, 15.0, 1900.0)
    rebuilt, best = allocation.mixed_thrusts(flight, vehicle), allocation.rotor_thrusts(flight, vehicle)
    late = rebuilt.time > 15.5
    assert not rebuilt.valid[late, 1].any()
    assert rebuilt.valid[late][:, [0, 2, 3]].all()
    assert best.valid[late].all()
    held = vehicle.curve(np.array(1900.0), allocation.battery_ratio(flight, best.time[late]))
    assert np.abs(best.values[late, 1] - held).max() < 2e-3


def test_nothing_in_the_future_changes_a_rebuilt_value():
    flight, vehicle, _ = hover()
    flight = with_output(flight, 2, 15.0, 1700.0, end=17.0)
    whole = allocation.mixed_thrusts(flight, vehicle)
    for end in (3.03, 14.99, 15.31, 17.2, 22.0):
        cut = allocation.mixed_thrusts(flight.until(end), vehicle)
        size = len(cut)
        assert np.array_equal(cut.values, whole.values[:size])
        assert np.array_equal(cut.valid, whole.valid[:size])


def test_saturation_is_not_trusted():
    flight, vehicle, _ = hover()
    control = flight["control"]
    values = control.values.copy()
    high = (control.time > 15.02) & (control.time < 15.08)  # between two logged outputs: only the limits tell
    values[high, 0] = 2.0
    flight = replace(flight, signals={**flight.signals, "control": replace(control, values=values)})
    rebuilt = allocation.mixed_thrusts(flight, vehicle)
    assert high.sum() >= 2 and not rebuilt.valid[high].any()


def craft(frame="ardupilot-quad-x"):
    """A frame as the definitions take it, with outputs from 0 to 1."""
    one, factors = Vehicle(), airframes.named(frame).mixer.tolist()
    one.rotors, one.mixer_known = len(factors), True
    one.mixer[: one.rotors] = factors
    return one


def test_yaw_beyond_the_headroom_is_not_granted():
    asked = np.array([[0.0, 0.0, 0.19, 0.4], [0.0, 0.0, 0.5, 0.4], [0.0, 0.0, 0.95, 0.4], [0.6, 0.0, 0.4, 0.4]])
    assert [mixer._grants_yaw(craft(), row) for row in asked.tolist()] == [True, True, False, False]


LOGS = {
    # path: largest rms of logged minus rebuilt thrust (rounding to 1 us alone gives 0.0004)
    "ardupilot-sitl/hexax_healthy_square_wind.bin.xz": 1.5e-3,
    "ardupilot-sitl/octa_healthy_circle_wind.bin.xz": 5e-4,
    "ardupilot-real-rrc/good_prop_hover_2.bin.xz": 5e-4,
    "ardupilot-real-rrc/25_mm_cut_straight_line_2.bin.xz": 6e-4,
    "px4-pyulog/sample_px4_events.ulg.xz": 1e-5,
    "px4-rflymad/TestCase_4_1000000003.ulg.xz": 1e-3,
}


@needs_flights
@pytest.mark.parametrize("path", LOGS)
def test_known_mixers_explain_real_outputs(path):
    flight = read(path)
    check = allocation.compare(flight, airframes.identify(flight))
    free = np.all((check.demanded > 0.02) & (check.demanded < 0.97 * check.rows["top"][:, None]), axis=1) & check.yaw_granted
    flying = free & (check.demand.min(axis=1) > 0.1)
    assert flying.sum() > 100
    assert np.sqrt(np.mean(check.deviation[flying] ** 2)) < LOGS[path]


HEALTHY_OUTPUTS = [
    *LOGS,
    "ardupilot-sitl/hexaplus_m6_mul0.00_fwdback_wind.bin.xz",
    "ardupilot-sitl/quadx_m2_mul0.80_hover_wind.bin.xz",
    "ardupilot-sitl/quadx_m3_mul0.85_tlog.tlog.xz",
    "ardupilot-real-dronekit/log171.bin.xz",
    "ardupilot-real-twoflights/sample.bin.xz",
    "crazypad/cut_propeller_M3_4mm_4mm_39mm__E8_log00.usd.xz",
]


@needs_flights
@pytest.mark.parametrize("path", HEALTHY_OUTPUTS)
def test_no_output_is_accused_where_all_follow(path):
    """Losses of effectiveness, a total loss with outputs at both limits, take-offs, landings."""
    flight = read(path)
    assert overrides(flight, airframes.identify(flight), spans(flight)) == ()


INJECTED = [
    ("ardupilot-sitl/hexax_healthy_square_wind.bin.xz", 3, 60.0, None, "stuck", 2.0),
    ("ardupilot-sitl/hexax_healthy_square_wind.bin.xz", 6, 60.0, 1000.0, "off", 0.5),
    ("ardupilot-sitl/octa_healthy_circle_wind.bin.xz", 8, 50.0, None, "stuck", 1.5),
    ("ardupilot-sitl/octa_healthy_circle_wind.bin.xz", 1, 50.0, 1000.0, "off", 0.5),
    ("ardupilot-real-rrc/good_prop_hover_2.bin.xz", 3, 50.0, None, "stuck", 1.0),
    ("ardupilot-real-rrc/good_prop_hover_2.bin.xz", 2, 50.0, 1000.0, "off", 0.5),
    ("ardupilot-sitl/hexaplus_m6_mul0.00_fwdback_wind.bin.xz", 4, 70.0, None, "stuck", 3.0),
    ("ardupilot-sitl/quadx_m3_mul0.85_tlog.tlog.xz", 4, 100.0, 1000.0, "off", 0.5),
    ("ardupilot-real-dronekit/log171.bin.xz", 1, 150.0, None, "stuck", 1.0),
    ("crazypad/normal_flight__E9_log00.usd.xz", 2, 8.0, None, "stuck", 1.0),
    ("px4-pyulog/sample_px4_events.ulg.xz", 4, 23.0, 0.0, "off", 0.6),
]


@needs_flights
@pytest.mark.parametrize("path, rotor, start, value, kind, within", INJECTED)
def test_an_injected_override_is_found_live(path, rotor, start, value, kind, within):
    flight = with_output(read(path), rotor, start, value)
    vehicle, airborne = airframes.identify(flight), spans(read(path))
    found = overrides(flight, vehicle, airborne)
    assert [(o.rotor, o.kind) for o in found] == [(rotor, kind)]
    assert start < found[0].detected < start + within
    assert abs(found[0].onset - start) < 0.35
    assert f"output {rotor}" in found[0].reason
    end = found[0].detected + 0.2
    cut = overrides(flight.until(end), vehicle, tuple((a, min(b, end)) for a, b in airborne if a < end))
    assert [(o.rotor, o.kind, o.detected) for o in cut] == [(rotor, kind, found[0].detected)]
    before = found[0].detected - 0.01
    assert overrides(flight.until(before), vehicle, airborne) == ()


@pytest.mark.parametrize("valid", [True, False])
def test_an_output_that_rests_in_calm_air_beside_a_damaged_record_is_not_stuck(valid):
    flight, vehicle, _ = hover()
    motors = flight["motors"]
    values, known = np.full_like(motors.values, 1591.0), motors.valid.copy()
    values += np.random.default_rng(3).random(values.shape) < 0.1
    values[motors.time > 10.0, 3] = 1591.0
    at = int(np.searchsorted(motors.time, 15.0))
    values[at, :3], known[at, :3] = 1000.0, valid
    signals = {"motors": replace(motors, values=values, valid=known)}
    assert overrides(replace(flight, signals=signals), vehicle, ((1.0, 30.0),)) == ()
    rough = values + np.random.default_rng(4).normal(0.0, 20.0, values.shape)
    rough[motors.time > 10.0, 3] = 1591.0
    signals = {"motors": replace(motors, values=rough, valid=known)}
    (found,) = overrides(replace(flight, signals=signals), vehicle, ((1.0, 30.0),))
    assert (found.rotor, found.kind) == (4, "stuck") and found.onset == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize("rounded_us, rebuilt", [(1.0, False), (10.0, False), (25.0, True), (50.0, True)])
def test_coarse_outputs_are_rebuilt_from_a_rate_controller_that_is_no_faster(rounded_us, rebuilt):
    flight, vehicle, _ = hover(rate=10.0)
    motors = flight["motors"]
    values = rounded_us * np.round(motors.values / rounded_us)
    coarse = replace(flight, signals={**flight.signals, "motors": replace(motors, values=values)})
    assert allocation.faster_control(coarse) == rebuilt
    true = allocation.motor_thrusts(flight, vehicle).values
    error = np.abs(allocation.rotor_thrusts(coarse, vehicle).values - true)[len(true) // 2 :]
    assert np.sqrt((error**2).mean()) < 0.006 and (rebuilt or np.array_equal(coarse["motors"].time, motors.time))


@needs_flights
@pytest.mark.parametrize("rounded_us", [25.0, 50.0])
def test_a_healthy_octa_with_coarse_outputs_is_not_accused(rounded_us):
    flight = read("ardupilot-sitl/octa_healthy_circle_wind.bin.xz")
    motors = replace(flight["motors"], values=rounded_us * np.round(flight["motors"].values / rounded_us))
    assert diagnose(replace(flight, signals={**flight.signals, "motors": motors})).verdict == "healthy"


def test_an_output_that_is_driven_by_something_else():
    flight, vehicle, _ = hover()
    motors = flight["motors"]
    values = motors.values.copy()
    on = motors.time >= 15.0
    values[on, 2] = 1550 + 60 * np.sin(5 * motors.time[on])
    flight = replace(flight, signals={**flight.signals, "motors": replace(motors, values=values)})
    found = overrides(flight, vehicle, ((1.0, 30.0),))
    assert [(o.rotor, o.kind, o.end) for o in found] == [(3, "overridden", None)]


def test_outputs_that_give_way_to_a_limit_are_not_stuck():
    """One rotor at its limit, as beside a lost one in calm air: the mixer takes from the others, and nothing moves for seconds."""
    flight, vehicle, _ = hover()
    time, on = flight["control"].time, flight["control"].time >= 15.0
    control = flight["control"].values.copy()
    control[on] = np.array([-0.3, 0.3, 0.25, 0.75])
    granted = 1.08 * control @ vehicle.mixer.T
    granted[on] = np.where(granted[on] > 1.0, 1.0, granted[on] - 0.1)
    command = np.round(command_of(granted, vehicle.curve, 0.97 - 0.001 * time[:, None]))[::5]
    calm = np.arange(len(command)) > np.argmax(on[::5])
    command[calm] = command[np.argmax(on[::5])]
    motors = replace(flight["motors"], values=command)
    signals = {**flight.signals, "motors": motors, "control": replace(flight["control"], values=control)}
    assert overrides(replace(flight, signals=signals), vehicle, ((1.0, 30.0),)) == ()


def test_an_override_that_ends():
    flight, vehicle, _ = hover()
    flight = with_output(flight, 4, 12.0, 1000.0, end=16.0)
    (found,) = overrides(flight, vehicle, ((1.0, 30.0),))
    assert found.kind == "off" and found.end == pytest.approx(16.0, abs=0.25)


def test_a_mixer_that_never_fitted_accuses_nobody():
    flight, vehicle, _ = hover()
    wrong = replace(vehicle, mixer=airframes.named("ardupilot-quad-plus").mixer)
    assert overrides(flight, wrong, ((1.0, 30.0),)) == ()


def test_flights_without_commands_have_no_overrides():
    flight, vehicle, _ = hover()
    empty = Signal(np.zeros(0), np.zeros((0, 4)), flight["motors"].columns, "us")
    for signals in ({}, {"motors": empty}, {"motors": empty, "control": flight["control"]}):
        assert overrides(replace(flight, signals=signals), vehicle, ((0.0, 9.0),)) == ()
    lonely = replace(flight, signals={**flight.signals, "control": flight["control"].between(0.0, 0.03)})
    assert allocation.mixed_thrusts(lonely, vehicle) is None or not allocation.mixed_thrusts(lonely, vehicle).valid.any()


def pairs(*texts):
    """'1+2=7+8' -> ((1, 2), (7, 8))."""
    return {tuple(tuple(int(r) for r in side.split("+")) for side in text.split("=")) for text in texts}


@pytest.mark.parametrize(
    "frame, expected",
    [
        ("ardupilot-quad-x", pairs()),
        ("ardupilot-hexa-x", pairs("1+2=3+4", "1+2=5+6", "3+4=5+6")),
        (
            "ardupilot-octa-plus",
            pairs(*("1+2=7+8", "1+4=2+3", "1+4=5+8", "1+6=2+5", "1+6=3+7"), *("2+3=6+8", "2+5=4+7", "3+6=4+5", "3+7=5+8", "4+7=6+8")),
        ),
    ],
)
def test_ambiguous_sets_of_known_frames(frame, expected):
    assert set(allocation.ambiguous_sets(airframes.named(frame).effectiveness())) == expected


def test_torque_alone_tells_less():
    effect = airframes.named("ardupilot-octa-plus").effectiveness()
    with_thrust, torque = (set(allocation.ambiguous_sets(b)) for b in (effect, effect[:3]))
    assert with_thrust < torque


def compared(gain, duration=120.0, rate=10.0):
    """Gains that a quad's mixer is believed to have at each of its comparisons, where the true one is gain(time)."""
    factors, state = airframes.named("ardupilot-quad-x").mixer, mixer.Mixer()
    time = np.arange(0.0, duration, 1.0 / rate)
    rng = np.random.default_rng(2)
    inputs = np.column_stack([0.03 * rng.standard_normal((time.size, 3)), np.full(time.size, 0.4)])
    asked, found = inputs @ factors.T, []
    for t, control, thrust in zip(time, inputs.tolist(), (np.reshape(gain(time), (-1, 1)) * asked).tolist()):
        state._learn_gain(craft(), t, control, thrust)
        found.append(state.gain)
    return time, np.array(found), (asked**2).sum(axis=1)


def test_the_mixers_gain_is_an_average_that_forgets_over_twenty_seconds():
    """Thinner air is a larger gain: against the weighted means written out, and 63 % of the way after one memory."""
    time, found, power = compared(lambda t: np.where(t < 60.0, 1.0, 1.1))
    true = np.where(time < 60.0, 1.0, 1.1)
    for k in (0, 300, 599, 700, 799, 1199):
        fades = np.exp((time[: k + 1] - time[k]) / mixer._GAIN_MEMORY_S) * power[: k + 1]
        assert found[k] == pytest.approx((fades * true[: k + 1]).sum() / fades.sum(), rel=1e-9)
    after = np.searchsorted(time, 60.0 + mixer._GAIN_MEMORY_S)
    assert (found[after] - 1.0) / 0.1 == pytest.approx(1.0 - np.exp(-1.0), abs=0.05)


def test_samples_that_no_gain_explains_teach_no_gain():
    """Between usable samples the last gain holds; before the first it is one."""
    time, found, _ = compared(lambda t: np.where((t < 10.0) | (t > 50.0), 1.9, 1.2))
    assert (found[time < 10.0] == 1.0).all()
    np.testing.assert_allclose(found[time >= 10.0], 1.2, rtol=1e-9)
    _, first, _ = compared(lambda t: np.where(t == 0.0, 1.2, 1.9), duration=5.0)
    np.testing.assert_allclose(first, 1.2, rtol=1e-9)


def least_squares(inputs, thrust):
    """(5, n) weights of rows (m, 5) -> (m, n), with unit variance of each before, throttle one for one."""
    prior = np.zeros((5, thrust.shape[1]))
    prior[3] = 1.0
    A = inputs.T @ inputs / mixer.NOISE_SD**2 + np.eye(5)
    return np.linalg.solve(A, inputs.T @ thrust / mixer.NOISE_SD**2 + prior)


def test_an_unknown_mixer_is_least_squares_of_what_came_before():
    """Against the batch solution with the same prior."""
    factors, state, one = airframes.named("ardupilot-quad-x").mixer, mixer.Mixer(), craft()
    rng = np.random.default_rng(3)
    inputs = np.column_stack([0.05 * rng.standard_normal((60, 3)), rng.uniform(0.3, 0.5, 60), np.ones(60)])
    thrust = inputs[:, :4] @ factors.T + 0.002 * rng.standard_normal((60, 4))
    thrust[7, 2], thrust[9, 1] = 0.01, 0.99  # at rest and at its limit: not usable
    use = np.setdiff1d(np.arange(60), [7, 9])
    state._begin(one)
    for k in range(60):
        state._learn_mixer(one, inputs[k].tolist(), thrust[k].tolist(), 1.0)
        if k in (0, 7, 20, 59):
            rows = use[use <= k]
            found = np.array(state.weights)[:, :4]
            np.testing.assert_allclose(found, least_squares(inputs[rows], thrust[rows]), atol=1e-6)


@pytest.mark.parametrize("end", [12.6, 15.6, 16.05])
def test_overrides_of_a_log_that_stops_are_those_known_by_then(end):
    """A live observer: what comes later neither finds an override sooner nor takes one back."""
    flight, vehicle, _ = hover()
    flight = with_output(with_output(flight, 2, 12.0, 1000.0, end=14.0), 3, 15.0, 1000.0)
    whole = overrides(flight, vehicle, ((1.0, 30.0),))
    cut = overrides(flight.until(end), vehicle, ((1.0, end),))
    assert [(o.rotor, o.kind, o.onset, o.detected) for o in cut] == [
        (o.rotor, o.kind, o.onset, o.detected) for o in whole if o.detected < end
    ]
    assert [o.rotor for o in whole] == [2, 3] and len(cut) == (1 if end < 15.0 else 2)


def test_a_mixer_has_to_pass_twenty_comparisons_before_it_accuses():
    """An output that is off from the first second on: nothing has been compared by then, and what comes later does not count."""
    flight, vehicle, _ = hover()
    for start, accused in ((1.0, False), (6.0, True)):
        found = overrides(with_output(flight, 2, start, 1560.0, end=start + 2.5), vehicle, ((0.0, 30.0),))
        assert bool([o for o in found if o.reason.startswith("output 2 was at 1560")]) == accused


def later(flight, by=0.007):
    """The flight with its outputs logged between the controller's samples."""
    motors = replace(flight["motors"], time=flight["motors"].time + by)
    return replace(flight, signals={**flight.signals, "motors": motors})


def test_an_override_is_known_when_the_later_of_its_two_control_samples_has_come():
    """Live, up to the very moment of detection: a millisecond sooner nobody could have known."""
    flight, vehicle, _ = hover()
    motors = flight["motors"]
    driven = np.where(motors.time >= 15.0, 1550 + 60 * np.sin(5 * motors.time), motors.values[:, 2])  # never at rest
    motors = replace(motors, values=np.column_stack([*motors.values[:, :2].T, driven, motors.values[:, 3]]))
    flight = later(replace(flight, signals={**flight.signals, "motors": motors}))
    (found,) = overrides(flight, vehicle, ((1.0, 30.0),))
    assert found.detected in flight["control"].time and found.detected > found.onset
    for moment, known in ((found.detected + 1e-6, True), (found.detected - 1e-3, False)):
        assert bool(overrides(flight.until(moment), vehicle, ((1.0, moment),))) == known


@pytest.mark.parametrize("known", [True, False])
def test_a_sample_is_assessed_by_what_was_known_before_it(known):
    """What is asked of the outputs comes from the factors as they were after the sample before, not after its own or a later one."""
    flight, vehicle, _ = hover(duration=8.0)
    check = allocation.compare(flight, vehicle if known else replace(vehicle, mixer=None))
    at = np.searchsorted(flight["control"].time, check.time)
    inputs = np.column_stack([flight["control"].values[at], np.ones(at.size)])
    if known:
        gain = np.concatenate([check.gain[:1], check.gain[:-1]])
        asked = gain[:, None] * (inputs[:, :4] @ vehicle.mixer.T)
        assert np.ptp(gain) > 1e-6
    else:
        taught = [slice(max(k, 1)) for k in range(at.size)]  # the first one by what it has taught itself
        asked = np.array([inputs[k] @ least_squares(inputs[t], check.demand[t]) for k, t in enumerate(taught)])
    np.testing.assert_allclose(check.demanded, asked, rtol=1e-12 if known else 1e-7)
    top = check.rows["top"][:, None]
    np.testing.assert_allclose(check.deviation, check.demand - np.clip(check.demanded, 0.0, top), atol=1e-15)


def test_the_last_value_known_is_held_and_none_that_comes_later():
    time, values = np.array([1.0, 2.0, 4.0]), np.array([10.0, 20.0, 40.0])
    at = np.array([0.5, 1.0, 1.5, 2.0, 3.999, 4.0, 9.0])
    assert allocation.hold(time, values, at, before=-1.0).tolist() == [-1.0, 10.0, 10.0, 20.0, 20.0, 40.0, 40.0]
    table = np.column_stack([values, -values])
    assert allocation.hold(time, table, at, before=7.0)[[0, 1, 4]].tolist() == [[7.0, 7.0], [10.0, -10.0], [20.0, -20.0]]
    assert allocation.hold(time[:0], values[:0], at, before=3.0).tolist() == [3.0] * 7
    assert allocation.hold(time[:0], table[:0], at[:2]).tolist() == [[0.0, 0.0]] * 2


def test_spans_hold_their_start_and_not_their_end():
    assert allocation.within(np.array([0.9, 1.0, 1.5, 2.0, 3.0]), ((1.0, 2.0), (3.0, 4.0))).tolist() == [
        False, True, True, False, True,
    ]  # fmt: skip
    assert not allocation.within(np.arange(3.0), ()).any()


def test_before_any_output_is_logged_no_thrust_is_known():
    flight, vehicle, _ = hover()
    late = replace(flight, signals={**flight.signals, "motors": flight["motors"].between(5.0, 99.0)})
    best = allocation.rotor_thrusts(late, vehicle)
    assert not best.valid[best.time < 4.9].any() and best.valid[best.time > 6.0].all()


def test_outputs_alone_say_which_was_off_or_did_not_move_and_until_when():
    """Without a controller's outputs. Off is below the minimum; at the minimum again it is not back, in flight it is."""
    flight, vehicle, _ = hover()
    bare = replace(flight, signals={k: v for k, v in flight.signals.items() if k != "control"})
    low = vehicle.curve.u_min
    off = with_output(with_output(bare, 2, 12.0, low - 50.0, end=16.0), 2, 16.0, low, end=19.0)
    (found,) = overrides(off, vehicle, ((1.0, 30.0),))
    assert (found.rotor, found.kind, found.demanded) == (2, "off", None)
    assert found.reason == f"output 2 was off at {low - 50.0:.4g} while the others kept working"
    assert found.onset == pytest.approx(12.0) and 12.2 < found.detected < 12.8
    assert found.end == pytest.approx(19.0, abs=0.15)
    (stuck,) = overrides(with_output(bare, 3, 12.0, end=16.0), vehicle, ((1.0, 30.0),))
    assert (stuck.rotor, stuck.kind) == (3, "stuck") and stuck.reason.startswith("output 3 did not move at ")
    assert stuck.onset == pytest.approx(12.0, abs=0.15) and stuck.detected - stuck.onset > deviations._SILENT_S
    assert stuck.end == pytest.approx(16.0, abs=0.15)


def test_an_output_is_accused_with_what_is_left_under_the_share_of_yaw_that_suits_it_best():
    """A mixer that has given up half of its yaw, and output 2 off by 0.2: of the shares under which the others agree, the least is left."""
    yaw = 0.15 * np.array([1.0, 1.0, -1.0, -1.0, 1.0, -1.0])
    asked = 0.5 + yaw + 0.01 * np.arange(6)
    demand = asked - 0.5 * yaw + 0.2 * np.eye(6)[1]
    left = []
    for share in 0.1 * np.arange(11):
        off = demand - (asked - share * yaw)
        others = np.delete(off, 1)
        if np.sum(np.abs(others - np.median(others)) < mixer.PART) > deviations._AGREEING * 5:
            left.append(off[1] - np.median(others))
    assert len(left) > 1 and min(left, key=abs) != left[-1]
    alone, known = single(asked, demand, yaw, False)
    assert known.all() and alone[1] == pytest.approx(min(left, key=abs), abs=1e-9)
    assert np.abs(np.delete(alone, 1)).max() < mixer.PART
    granted, known = single(asked, demand, yaw, True)
    assert not known.all() or np.abs(granted).max() > 0.2  # all of the yaw was to be had


def single(asked, demand, yaw, granted):
    """(n,) by how much each output deviates from the mixer by itself, and (n,) whether that can be assessed."""
    n, check = len(asked), mixer.Comparison()
    check.top, check.yaw_granted = 1.0, granted
    check.demanded[:n], check.thrust[:n], check.yaw[:n] = asked.tolist(), demand.tolist(), yaw.tolist()
    alone, known = [0.0] * n, [False] * n
    deviations._single(n, check, [True] * n, alone, known)
    return np.array(alone), np.array(known)


def test_outputs_range_from_none_to_all_or_over_the_pulse_widths_that_the_log_names():
    def ends(unit, **known):
        outputs = Signal([0.0], np.full((1, 4), 0.5), ("r1", "r2", "r3", "r4"), unit)
        return allocation.output_range(Flight("t", "", {"motors": outputs}, 1.0, **known))

    assert ends("1") == ends("1", parameters={"MOT_PWM_MIN": 1100.0}) == (0.0, 1.0)
    assert ends("us") == (1000.0, 2000.0)
    assert ends("us", parameters={"MOT_PWM_MIN": 1100.0, "MOT_PWM_MAX": 1900.0}) == (1100.0, 1900.0)
    fact = {"pwm_min": 1050.0, "pwm_max": 1950.0}
    assert ends("us", parameters={"MOT_PWM_MIN": 1100.0, "MOT_PWM_MAX": 1900.0}, facts=fact) == (1050.0, 1950.0)
