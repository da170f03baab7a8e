"""What befalls a simulated vehicle that its autopilot knows nothing of: laws of each, and that no log tells of it."""

import numpy as np
import pytest

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.simulation import control, dynamics, faults, outside, rotation, scenario, simulate, trajectories
from rotorwatch_lab.simulation.prepare import plan

G = dynamics.G0
STILL = dynamics.Air(np.zeros(3), np.zeros(3), np.array(0.0))
LEVEL = dynamics.Body(np.array([0.0, 0.0, -9.0]), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))


def asked(frame="quad-x", **tables):
    way = {"altitude_m": 5.0, "land": False, **tables.pop("trajectory", {})}
    craft = {"frame": frame, **tables.pop("airframe", {})}
    return scenario.from_table({"duration_s": 34.0, "airframe": craft, "trajectory": way, **tables})


def wrench(craft, body=LEVEL, w=0.7):
    n = craft.x.size
    rotors = dynamics.sums(craft, np.full(n, w), np.zeros(n), np.zeros(n))
    force, torque = dynamics.wrench(craft, body, rotation.axes(body.q), rotors, STILL)
    return np.asarray(force), np.asarray(torque)


def mean(made, name, start, end):
    time = made.record.time
    return np.asarray(getattr(made.record, name))[(time > start) & (time < end)].mean(axis=0)


@pytest.mark.parametrize("rotor", [0, 3])
def test_a_mount_that_turns_yaws_in_proportion_to_its_thrust_and_hardly_loses_any(rotor):
    craft = plan(asked("hexa-x")).craft._replace(z=np.array(0.0))
    lean = np.zeros(6)
    lean[rotor] = np.sin(np.radians(5.0))
    for w in (0.5, 0.9):
        (force, torque), (leaning, turning) = wrench(craft, w=w), wrench(craft._replace(lean=lean), w=w)
        thrust = craft.thrust_max[rotor] * w * w
        arm = np.hypot(craft.x[rotor], craft.y[rotor])
        drag = craft.drag_ratio * craft.spin[rotor] * thrust * (1.0 - np.cos(np.radians(5.0)))  # turned with it
        assert turning[2] - torque[2] == pytest.approx(arm * thrust * lean[rotor] - drag, rel=1e-4)
        assert np.abs(turning[:2] - torque[:2]).max() < 0.004 * arm * thrust
        assert 0.996 * thrust < thrust - (leaning[2] - force[2]) < thrust
        assert (leaning[:2] - force[:2]) @ [craft.x[rotor], craft.y[rotor]] == pytest.approx(0.0, abs=1e-12)


def test_a_tilt_that_is_positive_yaws_to_the_right():
    made = plan(asked(faults=[{"kind": "tilt", "rotor": 2, "onset_s": 5.0, "angle_deg": 4.0, "ramp_s": 2.0}]))
    lean = [np.asarray(faults.summed(made.faults, made.faults.lean * faults.strength(made.faults, t))) for t in (4.0, 6.0, 9.0)]
    assert lean[0].max() == 0.0 and lean[1][1] == pytest.approx(0.5 * lean[2][1])
    assert lean[2] == pytest.approx([0.0, np.sin(np.radians(4.0)), 0.0, 0.0])
    still, turned = wrench(made.craft), wrench(made.craft._replace(lean=lean[2]))
    assert turned[1][2] > still[1][2]


def test_a_board_askew_sees_the_same_vehicle_from_its_own_axes():
    axes = {"board_roll_deg": 4.0, "board_pitch_deg": -3.0, "board_yaw_deg": 20.0}
    straight, askew = plan(asked("hexa-x")).craft, plan(asked("hexa-x", airframe=axes)).craft
    M = askew.mount
    assert M @ M.T == pytest.approx(np.eye(3)) and M.T @ straight.J @ M == pytest.approx(askew.J)
    # The same motion, reported in both axes.
    v, omega = np.array([3.0, -1.0, 0.5]), np.array([0.4, -0.2, 0.9])
    of_frame = LEVEL._replace(v=v, omega=omega)
    of_board = LEVEL._replace(v=M.T @ v, omega=M.T @ omega)
    for ours, theirs in zip(wrench(askew, of_board), wrench(straight, of_frame), strict=True):
        assert M @ ours == pytest.approx(theirs, abs=1e-9)
    n = np.zeros(6)
    rates = []
    for craft, body in ((straight, of_frame), (askew, of_board)):
        rotors = dynamics.sums(craft, n + np.arange(6) * 0.1, n + np.arange(6), n)
        slope, _ = dynamics.derivative(craft, body, rotors, STILL)
        rates.append(np.asarray(slope.omega))
    assert M @ rates[1] == pytest.approx(rates[0], rel=1e-9, abs=1e-9)


def test_wash_shakes_a_rotor_only_in_descents_straight_down():
    stir, still = np.array([1.0, -1.0, 0.5, 0.0]), np.zeros(3)
    air = plan(asked(airframe={"wash": 0.3})).outside
    induced = float(air.induced)

    def factors(*v, wind=still):
        return np.asarray(outside.washed(air, stir, wind, induced * np.array(v)))

    for calm in ((0, 0, 0), (0, 0, -2), (0.5, 0, 0), (1.5, 0, 0.8)):
        assert factors(*calm) == pytest.approx(1.0)
    assert factors(0, 0, 0.5) == pytest.approx(1.0 + 0.15 * stir)
    assert factors(0, 0, 0.25) == pytest.approx(1.0 + 0.075 * stir)
    assert factors(0, 0, 0.5, wind=np.array([0.0, 0.0, 0.5 * induced])) == pytest.approx(1.0)  # sinks with its air


def test_stirred_air_is_each_rotors_own():
    noise = np.asarray(outside.stirred(7, 4, 40_000, 0.01))
    assert noise.std(axis=0) == pytest.approx(np.ones(4), abs=0.08)
    assert np.abs(np.corrcoef(noise.T) - np.eye(4)).max() < 0.08
    later = int(1.5 * 100 / outside.STIR_HZ)
    assert abs(np.corrcoef(noise[:-later, 0], noise[later:, 0])[0, 1]) < 0.2
    assert np.abs(np.asarray(outside.stirred(8, 4, 100, 0.01)) - noise[:100]).max() > 0.1


@pytest.mark.parametrize(("steps", "got"), [(0.0, 0.4321), (10.0, 0.4), (125.0, 54 / 125)])
def test_outputs_in_steps(steps, got):
    air = plan(asked(airframe={"output_steps": steps})).outside
    assert float(outside.rounded(air, np.array(0.4321))) == pytest.approx(got)


def test_rotors_as_built_are_within_their_spread_and_the_autopilot_does_not_know():
    nominal, built = plan(asked("octa-x")), plan(asked("octa-x", airframe={"rotor_spread": 0.03}))
    off = built.craft.thrust_max / nominal.craft.thrust_max - 1.0
    assert np.abs(off).max() <= 0.03 and np.ptp(off) > 0.01
    assert built.pilot.rate_p == pytest.approx(nominal.pilot.rate_p) and built.pilot.hover == nominal.pilot.hover


def test_an_autopilot_that_believes_in_another_curve_knows_what_carries_it():
    """Its hover throttle, through the curve that it believes in and then the true one, is the weight."""
    made = plan(asked(airframe={"expo": 0.1, "believed_expo": 0.65, "thrust_to_weight": 2.0}))
    reported = float(control.drive(0.65, float(made.pilot.hover)))
    assert float(dynamics.thrust_share(0.1, reported)) == pytest.approx(0.5)


def test_against_a_push_the_vehicle_leans_and_holds_and_its_payload_falls_off_once():
    push = asked(outside={"push_m_s2": 2.0, "push_to_deg": 90.0, "push_onset_s": 18.0, "push_end_s": 30.0})
    made = simulate(push)
    roll = 2.0 * mean(made, "q", 24.0, 29.5)[1]
    assert roll == pytest.approx(-np.arctan(2.0 / G), abs=0.01)  # to the west, against it
    assert abs(2.0 * mean(made, "q", 15.0, 18.0)[1]) < 0.002 and np.abs(mean(made, "v", 26.0, 29.5)).max() < 0.1
    drops = simulate(asked(airframe={"payload_kg": 0.5, "payload_drops_s": 20.0}, battery={"resistance_ohm": 0.0}))
    before, after = mean(drops, "w", 15.0, 20.0) ** 2, mean(drops, "w", 28.0, 34.0) ** 2
    assert after.sum() / before.sum() == pytest.approx(2.0 / 2.5, abs=0.01)


def test_rotors_that_are_capped_slow_or_strong():
    rows = [{"kind": "capped", "rotor": 1, "level": 0.4, "onset_s": 20.0}, {"kind": "slow", "rotor": 2, "times": 3.0, "onset_s": 20.0}]
    made = simulate(asked(faults=rows, wind={"speed_m_s": 7.0}))
    time, w, sag = made.record.time, made.record.w, made.record.volts / float(made.plan.battery.full)
    late = time > 21.0
    assert w[late, 0].max() ** 2 <= 0.4 + 1e-9 < w[time < 20.0, 0].max() ** 2
    assert w[late, 2].max() ** 2 > 0.45
    # First order: the slope of a speed is its distance from what is asked, over the lag.
    gap = np.sqrt(dynamics.thrust_share(0.65, made.record.command * sag[:, None])) - w
    slope = np.gradient(w, time, axis=0)
    for rotor, span, lag in ((1, late, 0.09), (2, late, 0.03), (1, (time > 15.0) & ~late & (time < 19.9), 0.03)):
        g, v = gap[span, rotor], slope[span, rotor]
        assert (g @ g) / (g @ v) == pytest.approx(lag, rel=0.25)
    strong = simulate(asked(faults=[{"kind": "strong", "rotor": 3, "strength": 0.1, "onset_s": 0.0}]))
    assert mean(strong, "demand", 25.0, 34.0)[2] == pytest.approx(mean(strong, "demand", 25.0, 34.0)[:2].mean() / 1.1, rel=0.01)
    assert strong.record.theta[-1] == pytest.approx([0.0, 0.0, -0.1, 0.0])


def test_an_estimators_reset_is_in_the_log_only():
    jump = {"reset_s": 20.0, "reset_tilt_deg": 4.0, "reset_yaw_deg": 25.0, "reset_m_s": 2.0}
    quiet, reset = simulate(asked()), simulate(asked(sensors=jump))
    np.testing.assert_array_equal(quiet.record.q, reset.record.q)
    for name, before, after in (("velocity", 1e-9, 1.5), ("attitude", 1e-9, 0.15), ("gyro", 1e-9, None)):
        a, b = (made.flight.signals[name] for made in (quiet, reset))
        off, early = np.abs(a.values - b.values).max(axis=1), a.time < 19.99
        assert off[early].max() <= before
        soon = off[(a.time > 20.01) & (a.time < 20.4)]
        assert soon.max() <= before if after is None else soon.min() > 0.5 * after
        assert after is None or off[-1] < 0.1 * after  # finds back


def test_yaw_steps_are_quarter_turns():
    jax = load_jax()
    made = plan(asked(trajectory={"kind": "yaw-steps", "turn_s": 0.5}))
    yaw = np.degrees(np.asarray(jax.jit(trajectories.table, static_argnums=(1, 2))(made.way, 3400, 0.01).yaw))
    here = yaw[1600:]
    rests = here[np.abs(np.diff(here, append=here[-1])) < 1e-6]
    assert np.abs(rests / 90.0 - np.round(rests / 90.0)).max() < 1e-4 and np.ptp(np.round(rests / 90.0)) >= 3
    assert (np.abs(np.diff(here)) > 1e-6).mean() < 0.15  # 0.5 of 4.5 s


def test_on_the_ground_before_and_after():
    """Slow spooling up keeps it on the ground under power; after the landing the motors push on, and the log says that it flies."""
    way = {"land": True, "altitude_m": 2.0, "spool_s": 5.0, "rest_s": 4.0}
    made, usual = simulate(asked(trajectory=way)), simulate(asked(trajectory={"land": True, "altitude_m": 2.0}))
    height, time = -made.record.p[:, 2], made.record.time
    grounded = (time > 4.0) & (time < 6.5)
    assert height[grounded].max() < 0.02 and made.record.command[grounded].max() > 0.2

    def landed(one):
        return max(m.time for m in one.flight.messages if m.kind == "landed")

    down = time[np.flatnonzero(height > 0.05)[-1]]
    assert landed(made) - down > 4.0 and landed(made) == pytest.approx(landed(usual))
    assert made.record.command[(time > down + 1.0) & (time < down + 4.0)].min() > 0.0
