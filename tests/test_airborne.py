"""Intervals in the air: real logs, made-up ones, and the law that a cut log gives the same intervals, cut."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import diagnose, logs
from rotorwatch.engine.motion.air_spans import CONFIRM_S, MOST_GAP_S, airborne, gaps
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.logs.log_memory import from_arrays
from rotorwatch_lab.simulation import scenario, simulate

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the folder of test flights, ../shared/flights, is missing")

# Lift-off and touch-down read off height, specific force and commands by eye, to about half a second.
BY_EYE = {
    "ardupilot-sitl/quadx_healthy_hover.bin.xz": [(3.2, 119.8)],
    "ardupilot-sitl/quadx_m1_mul0.90_hover.bin.xz": [(3.0, 94.1)],
    "ardupilot-sitl/octa_healthy_circle_wind.bin.xz": [(3.2, 89.1)],
    "ardupilot-sitl/hexaplus_m6_mul0.00_fwdback_wind.bin.xz": [(3.1, 94.1)],
    "ardupilot-sitl/quadx_m3_mul0.85_tlog.tlog.xz": [(47.1, 123.0)],
    "ardupilot-sitl/fullrate_excerpt_quadx_m1_mul0.90_hover.bin.xz": [(27.5, 57.5)],  # starts in the air
    "ardupilot-real-twoflights/sample.bin.xz": [(6.4, 41.7), (679.1, 699.5)],
    "ardupilot-real-dronekit/log171.bin.xz": [(72.4, 227.7)],  # ends in a crash, upside down with motors running
    "ardupilot-real-rrc/good_prop_hover_2.bin.xz": [(15.8, 91.0)],
    "ardupilot-real-rrc/20_mm_cut_straight_line_2.bin.xz": [(25.7, 78.7)],
    "px4-pyulog/sample.ulg.xz": [],
    "px4-pyulog/sample_logging_tagged_and_default_params.ulg.xz": [],
    "px4-pyulog/sample_px4_events.ulg.xz": [(18.8, 26.9)],
    "px4-rflymad/TestCase_4_1000000003.ulg.xz": [(14.8, 36.0)],  # flips and falls from 34.0 s on
}
CUT = [*BY_EYE, "px4-ulogassessment", "crazypad/normal_flight__E8_log03.usd.xz"]


@pytest.mark.thorough(keep=5)
@needs_flights
@pytest.mark.parametrize("name", BY_EYE)
def test_real_and_simulated_flights(name):
    found = airborne(logs.read(FLIGHTS / name))
    want = BY_EYE[name]
    assert len(found) == len(want)
    for (start, end), (lift_off, touch_down) in zip(found, want):
        assert lift_off - 0.2 <= start <= lift_off + 0.8
        assert touch_down - 0.6 <= end <= touch_down + 0.6


@needs_flights
def test_every_sitl_flight_lifts_off_two_to_four_seconds_after_the_log_starts():
    for path in (FLIGHTS / "ardupilot-sitl").glob("*[!_]*.bin.xz"):
        if not path.name.startswith("fullrate"):
            assert 2 < airborne(logs.read(path))[0][0] < 4, path.name


@needs_flights
def test_crazyflie_hovers_lie_within_the_intervals():
    for path in sorted((FLIGHTS / "crazypad").glob("*.xz"))[::4]:
        flight = logs.read(path)
        intervals = airborne(flight)
        position = flight["position"]
        high = position.time[-position.values[:, 2] > 0.35]
        inside = np.any([(high >= a) & (high <= b + 0.3) for a, b in intervals], axis=0)
        assert inside.mean() > 0.98 and len(intervals) == 2, path.name


@pytest.mark.thorough(keep=6)
@needs_flights
@pytest.mark.parametrize("name", CUT)
def test_a_cut_log_gives_the_same_intervals_cut(name):
    flight = logs.read(FLIGHTS / name)
    whole = airborne(flight)
    first = flight["motors"].time[0]
    for t in np.linspace(first + 0.5, flight.duration, 25):
        if any(b <= t < b + CONFIRM_S for _, b in whole):
            continue  # the end is not certain yet
        cut = airborne(flight.until(t))
        want = [(a, min(b, t)) for a, b in whole if a < t - 0.2]
        assert len([i for i in cut if i[0] < t - 0.2]) == len(want)
        for (a, b), (start, end) in zip(cut, want):
            assert a == start and b == pytest.approx(end, abs=0.15)


# Made-up flights


def made_up(hops, duration=60.0, idle=0.12, hover=0.45, velocity=True, rate=50, seed=0, ramp=0.6, noise=0.01) -> Flight:
    """A vehicle that climbs at 0.8 m/s for 2 s at the start of each hop and sinks as fast before its end."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration, 1 / rate)
    command, climb = np.full(t.size, idle), np.zeros(t.size)
    for start, end in hops:
        up = np.clip((t - start + ramp) / ramp, 0, 1) * np.clip((end - t) / 0.2, 0, 1)
        command = np.maximum(command, idle + (hover - idle) * up)
        climb += 0.8 * ((t > start) & (t < start + 2)) - 0.8 * ((t > end - 2) & (t < end))
    columns = {"time_s": t}
    columns |= {f"motor_{k}": command + noise * rng.standard_normal(t.size) for k in range(1, 5)}
    columns |= {f"gyro_{a}_rad_s": 0.02 * rng.standard_normal(t.size) for a in "xyz"}
    columns |= {f"accel_{a}_m_s2": v + 0.3 * rng.standard_normal(t.size) for a, v in zip("xyz", (0, 0, -9.81))}
    if velocity:
        zero = 0.02 * rng.standard_normal(t.size)
        columns |= {"velocity_n_m_s": zero, "velocity_e_m_s": zero, "velocity_d_m_s": -climb + zero}
    return from_arrays(columns)


@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("hops", [[(10, 50)], [(5, 15), (20, 30), (40, 55)], [(8, 59.99)]])
@pytest.mark.parametrize("idle, hover", [(0.0, 0.35), (0.12, 0.45), (0.2, 0.75)])
def test_hops_are_found_without_a_word_from_the_autopilot(hops, velocity, idle, hover):
    found = airborne(made_up(hops, idle=idle, hover=hover, velocity=velocity))
    assert len(found) == len(hops)
    for (a, b), (start, end) in zip(found, hops):
        assert start - 0.3 < a < start + 1.1 and end - 0.3 < b < end + 0.3


@pytest.mark.parametrize("idle, hover", [(0.0, 0.08), (0.02, 0.11), (0.04, 0.16), (0.06, 0.13)])
def test_a_vehicle_with_much_more_thrust_than_weight_takes_off(idle, hover):
    """Its climb says so, however little is commanded; a landing without a climb before it is as low as ever."""
    hops = [(10, 30), (40, 55)]
    found = airborne(made_up(hops, idle=idle, hover=hover, noise=0.002))
    assert len(found) == len(hops)
    for (a, b), (start, end) in zip(found, hops):
        assert start < a < start + 2.0 and end - 0.3 < b < end + 0.3
    said = replace(made_up(hops, idle=idle, hover=hover, noise=0.002), messages=(Message(9.8, "landed", "", 0.0),))
    assert airborne(said)[0][0] <= found[0][0]


@pytest.mark.parametrize("seconds", [4.0, 8.0])
def test_a_hover_that_is_reached_slowly_is_a_flight(seconds):
    """The throttle is raised bit by bit, and the vehicle hovers half a metre up: it hardly climbs, and no command is far above the last."""
    flight = made_up([(20, 50)], idle=0.1, hover=0.44, ramp=seconds)
    velocity, time = flight["velocity"], flight["velocity"].time
    climb = 0.5 / seconds * ((time > 20.0) & (time < 20.0 + seconds)) - 0.15 * ((time > 46.0) & (time < 49.5))
    low = replace(velocity, values=np.stack([velocity.values[:, 0], velocity.values[:, 1], -climb], axis=1))
    ((start, end),) = airborne(replace(flight, signals={**flight.signals, "velocity": low}))
    assert 18.0 < start < 20.0 + seconds + 2.0 and 45.0 < end < 50.5


def test_a_spin_is_no_blow():
    """An accelerometer 2 cm off the axis of a spin of 30 rad/s, whose centripetal force begins 2 s before the landing."""
    flight = made_up([(10, 50)])
    when = flight["gyro"].time
    spin = ((when > 48.0) & (when < 49.9))[:, None]
    gyro, accel = flight["gyro"], flight["accel"]
    turning = gyro.with_arrays(when, gyro.values + 30.0 * spin * [0.0, 0.0, 1.0], gyro.valid)
    off_axis = accel.with_arrays(when, accel.values + 18.0 * spin * [1.0, 0.0, 0.0], accel.valid)
    ends = [airborne(replace(flight, signals={**flight.signals, "accel": off_axis, "gyro": g}))[-1][1] for g in (turning, gyro)]
    assert ends[0] == pytest.approx(50.0, abs=0.3)
    assert ends[1] == pytest.approx(48.0, abs=0.3)  # the same force without a turn is one


@pytest.mark.parametrize("hover", [0.1, 0.2])
def test_rotors_that_turn_faster_on_the_ground_are_no_flight(hover):
    """Run up twice without a climb; the velocity drifts by less than the least climb. The autopilot may believe that it is in the air."""
    flight = made_up([(10, 30), (40, 55)], idle=0.03, hover=hover, noise=0.002)
    velocity, time = flight["velocity"], flight["velocity"].time
    drift = 0.1 * np.sin(0.3 * time)[:, None] * [0.3, 0.3, 1.0]
    still = {**flight.signals, "velocity": replace(velocity, values=drift)}
    assert airborne(replace(flight, signals=still)) == ()
    assert airborne(replace(flight, signals=still, messages=(Message(9.8, "landed", "", 0.0),))) == ()


def test_a_vehicle_that_is_lifted_while_its_rotors_idle_is_no_flight():
    flight = made_up([(10, 30)], idle=0.05, hover=0.05, noise=0.002)
    assert airborne(flight) == ()


def test_running_up_on_the_ground_is_no_flight():
    flight = made_up([], duration=30)
    assert airborne(flight) == ()
    # A short burst of throttle that does not lift the vehicle
    assert airborne(made_up([(10, 10.8)], hover=0.3, velocity=False, ramp=0.3)) == ()


def test_drifting_velocity_on_the_ground_is_no_flight():
    flight = made_up([(20, 40)])
    velocity = flight["velocity"]
    values = velocity.values.copy()
    values[:, 2] -= 0.3  # the estimator thinks that it climbs all the time
    drifting = replace(flight, signals={**flight.signals, "velocity": replace(velocity, values=values)})
    ((start, end),) = airborne(drifting)
    assert 19.7 < start < 21 and 39.7 < end < 40.3


@pytest.mark.parametrize("again", [False, True])
def test_a_command_that_has_just_not_carried_the_vehicle_does_not_lift_it(again):
    """The rotors push on for some seconds after the touch-down, far above their idle, while the velocity says that it climbs."""
    flight = made_up([(10, 30), (33, 45)] if again else [(10, 30)], idle=0.03, noise=0.002)
    motors, velocity = flight["motors"], flight["velocity"]
    pushes, climbs = motors.values.copy(), velocity.values.copy()
    after = (motors.time > 30.0) & (motors.time < 35.0)
    pushes[after] = np.maximum(pushes[after], 0.17)
    climbs[(velocity.time > 30.0) & (velocity.time < 33.0), 2] = -0.4
    signals = {"motors": replace(motors, values=pushes), "velocity": replace(velocity, values=climbs)}
    found = [(round(a), round(b)) for a, b in airborne(replace(flight, signals={**flight.signals, **signals}))]
    assert found[0][1] == 30 and len(found) == 1 + again
    assert not again or (33 <= found[1][0] <= 34 and found[1][1] == 45)


def test_a_stale_landed_word_does_not_hide_a_climb():
    flight = replace(made_up([(10, 50)]), messages=(Message(0.0, "landed", "landed", 1.0),))
    ((start, _),) = airborne(flight)
    assert 10 < start < 12


def test_falling_with_motors_off_is_still_in_the_air():
    flight = made_up([(10, 50)])
    t = flight["motors"].time
    values = flight["motors"].values.copy()
    values[(t > 25) & (t < 28)] = 0.0
    force = flight["accel"].values.copy()
    force[(t > 25) & (t < 28)] *= 0.1
    signals = {**flight.signals, "motors": replace(flight["motors"], values=values)}
    fallen = replace(flight, signals={**signals, "accel": replace(flight["accel"], values=force)})
    assert len(airborne(fallen)) == 1
    landed = replace(flight, signals=signals)  # the same command while something carries the weight
    assert len(airborne(landed)) >= 1 and airborne(landed)[0][1] == pytest.approx(25, abs=0.2)


def test_sinking_on_little_command_is_no_landing():
    # Five seconds down at 2 m/s on half of what hover takes, as light vehicles with large rotors do; then up again, and a landing.
    flight = made_up([(10.0, 50.0)])
    time = flight["motors"].time
    down = (time > 20.0) & (time < 25.0)
    motors, velocity = flight["motors"].values.copy(), flight["velocity"].values.copy()
    motors[down] = 0.25
    velocity[np.interp(flight["velocity"].time, time, down) > 0.5, 2] = 2.0
    signals = dict(flight.signals)
    for name, values in (("motors", motors), ("velocity", velocity)):
        signals[name] = signals[name].with_arrays(signals[name].time, values, signals[name].valid)
    assert len(airborne(replace(flight, signals=signals))) == 1
    still = velocity.copy()
    still[:, 2] = np.where(still[:, 2] == 2.0, 0.0, still[:, 2])
    signals["velocity"] = signals["velocity"].with_arrays(signals["velocity"].time, still, signals["velocity"].valid)
    assert len(airborne(replace(flight, signals=signals))) == 2  # the same without sinking: it stood on the ground


def pushes_on(seconds, speed=0.0, hover=1.0) -> Flight:
    """A landing at 30 s whose rotors push nearly as in hover for so long on the ground, or by this part of it; speed: over it, m/s."""
    flight = made_up([(10, 30 + seconds)])
    motors = flight["motors"]
    less = np.where((motors.time > 30) & (motors.time < 30 + seconds), hover, 1.0)[:, None]
    flight = replace(flight, signals={**flight.signals, "motors": replace(motors, values=motors.values * less)})
    velocity = flight["velocity"]
    values = velocity.values.copy()
    t = velocity.time
    values[t > 20, 2] = np.where((t[t > 20] > 27) & (t[t > 20] < 30), 0.6, 0.02 * np.sin(40 * t[t > 20]))
    values[t > 30, 0] += speed
    return replace(flight, signals={**flight.signals, "velocity": replace(velocity, values=values)})


@pytest.mark.parametrize(
    ("seconds", "speed", "hover", "ends_s"),
    [
        (2.0, 0.0, 1.0, 30.0),
        (4.5, 0.0, 1.0, 34.5),  # longer than a landing takes: it hovered after it had sunk
        (15.0, 0.0, 0.8, 30.0),  # ... but not on so much less
        (15.0, 1.0, 0.8, 45.0),  # a lighter vehicle that moves
        (2.0, 1.0, 1.0, 32.0),  # it moves: it flies on, level
    ],
)
def test_rotors_that_push_on_after_the_touch_down_do_not_make_it_fly(seconds, speed, hover, ends_s):
    ((_, end),) = airborne(pushes_on(seconds, speed, hover))
    assert end == pytest.approx(ends_s, abs=0.3)


def test_what_the_ground_does_to_a_vehicle_in_wind_is_no_loss():
    """A healthy hexarotor whose controller winds up for two seconds after the touch-down, before its motors stop."""
    table = {
        "duration_s": 65.0, "seed": 10370, "airframe": {"frame": "hexa-plus"}, "trajectory": {"kind": "figure-eight"},
        "wind": {"speed_m_s": 5.737747721237923}, "logging": {"profile": "fast"},
    }  # fmt: skip
    found = diagnose(simulate(scenario.from_table(table)).flight)
    assert found.verdict == "healthy" and not found.events
    assert 59.9 < found.flight["airborne_s"][1] < 60.5


def test_a_hover_after_a_descent_goes_on():
    flight = pushes_on(25.0)
    assert [(round(a), round(b)) for a, b in airborne(flight)] == [(10, 55)]


def test_a_vehicle_that_turns_with_idle_motors_is_no_landing():
    """A dive of three seconds, as pilots fly it; the same without turning is a stand on the ground."""
    flight = made_up([(10.0, 50.0)], velocity=False)
    time = flight["motors"].time
    motors = flight["motors"].values.copy()
    motors[(time > 20.0) & (time < 23.0)] = 0.13
    signals = {**flight.signals, "motors": replace(flight["motors"], values=motors)}
    for rate, flights in ((2.0, 1), (0.1, 2)):
        gyro = np.zeros((time.size, 3))
        gyro[(time > 20.0) & (time < 23.0), 0] = rate
        signals["gyro"] = Signal(time, gyro, ("x", "y", "z"), "rad/s", "FRD", "made up")
        assert len(airborne(replace(flight, signals=signals))) == flights


@pytest.mark.parametrize("turns, flies", [(3.0, True), (0.1, False)])
def test_a_pilot_who_idles_in_every_roll_has_lifted_off(turns, flies):
    """Without a velocity, rotors that never push for a second on end lift a vehicle that turns, and no vehicle that stands."""
    time = np.arange(0.0, 20.0, 0.01)
    pulses = (time > 3.0) & (time < 16.0) & (np.mod(time, 0.9) < 0.5)
    thrust = np.where(pulses, 0.5, 0.05)[:, None] * np.ones(4)
    rate = np.where((time > 3.3) & (time < 16.0), turns, 0.0)[:, None] * np.array([1.0, 0.0, 0.0])
    signals = {
        "motors": Signal(time, thrust, ("r1", "r2", "r3", "r4"), "1", "body", "made up"),
        "gyro": Signal(time, rate, ("x", "y", "z"), "rad/s", "FRD", "made up"),
    }
    found = airborne(Flight("made up", "Betaflight", signals, 20.0))
    assert bool(found) == flies
    if flies:
        ((start, end),) = found
        assert 3.0 < start < 5.5 and 15.0 < end < 17.5


def test_lying_upside_down_ends_the_flight_at_the_crash():
    flight = made_up([(10, 59.9)])
    force = flight["accel"].values.copy()
    t = flight["accel"].time
    force[t > 40] *= -1
    force[(t > 40) & (t < 40.1)] = (60.0, 0, 0)
    crashed = replace(flight, signals={**flight.signals, "accel": replace(flight["accel"], values=force)})
    ((_, end),) = airborne(crashed)
    assert end == pytest.approx(40.05, abs=0.1)


def without(flight, start, end, names=None):
    """The flight without the samples between two times, of all signals or of those named."""
    cut = {name: signal.with_arrays(*(a[(signal.time < start) | (signal.time > end)] for a in (signal.time, signal.values, signal.valid)))
           for name, signal in flight.signals.items() if names is None or name in names}  # fmt: skip
    return replace(flight, signals={**flight.signals, **cut})


@pytest.mark.parametrize("names", [None, ("motors",)])
def test_a_gap_in_the_air_is_no_landing(names):
    flight = without(made_up([(10, 50)]), 25, 45, names)
    ((start, end),) = airborne(flight)
    assert (start, end) == pytest.approx(airborne(made_up([(10, 50)]))[0])
    (gap,) = gaps(flight, ((start, end),))
    assert (gap.start, gap.end) == pytest.approx((25, 45), abs=0.1)
    assert gap.rotors == (1, 2, 3, 4) and not gap.first and not gap.lasts
    assert gaps(flight, ((46.0, end),)) == ()


def test_a_gap_that_hides_a_landing_ends_the_flight():
    landing = without(made_up([(10, 30)]), 25, 40)  # on the ground when the commands come back
    assert [b for _, b in airborne(landing)] == pytest.approx([25], abs=0.1)
    said = replace(without(made_up([(10, 50)]), 25, 35, ("motors",)), messages=(Message(28.0, "landed", "", 1.0),))
    assert len(airborne(said)) == 2
    assert len(airborne(without(made_up([(10, 110)], duration=120), 25, 25 + MOST_GAP_S + 1))) == 2


def test_a_short_gap_is_no_landing():
    """A link or a disk that stops for 3 s in the air: what was learned before holds after it."""
    flight = made_up([(10, 50)])
    assert len(airborne(without(flight, 25, 28))) == 1


def test_missing_commands_are_held():
    flight = made_up([(10, 50)])
    valid = flight["motors"].valid.copy()
    valid[(flight["motors"].time > 30) & (flight["motors"].time < 31.5)] = False
    found = airborne(replace(flight, signals={**flight.signals, "motors": replace(flight["motors"], valid=valid)}))
    assert len(found) == 1


def test_nothing_without_commands():
    flight = made_up([(10, 50)])
    assert airborne(replace(flight, signals={"gyro": flight["gyro"]})) == ()


def test_ten_minutes_at_400_hz_take_a_moment():
    flight = made_up([(10, 590)], duration=600, rate=400)
    begin = time.perf_counter()
    assert len(airborne(flight)) == 1
    assert time.perf_counter() - begin < 2


@pytest.mark.parametrize("velocity", [True, False])
def test_made_up_flights_cut_anywhere(velocity):
    flight = made_up([(5, 15), (20, 30), (40, 55)], velocity=velocity)
    whole = airborne(flight)
    for t in np.arange(1, 60, 0.43):
        if any(b <= t < b + CONFIRM_S for _, b in whole):
            continue
        cut = airborne(flight.until(t))
        assert [a for a, _ in cut] == [a for a, _ in whole if a < t - 0.1] or abs(cut[-1][0] - t) < 0.1
        assert cut == () or cut[-1][1] <= t
