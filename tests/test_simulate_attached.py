"""What touches a simulated vehicle, or changes in it: legs, lines, tethers, landings, a centre of mass that moves; laws of each."""

import itertools

import numpy as np
import pytest

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.simulation import attached, beyond, control, dynamics, loop, outside, rotation, scenario, simulate, trajectories
from rotorwatch_lab.simulation.multirotor import MULTIROTOR
from rotorwatch_lab.simulation.prepare import plan, vehicle

jax = load_jax()
G, DT, LONGEST = dynamics.G0, 1 / 400, 3200
BARE = {"inflow": 0.0, "rotor_drag": 0.0, "body_drag": 0.0, "ground_effect": False}
STILL = dynamics.Air(np.zeros(3), np.zeros(3), np.array(1.0))


def asked(frame="quad-x", **tables):
    way = {"altitude_m": 4.0, **tables.pop("trajectory", {})}
    return scenario.from_table(
        {"duration_s": 40.0, "airframe": {"frame": frame, **tables.pop("airframe", {})}, "trajectory": way, **tables}
    )


def craft_of(**airframe):
    """A vehicle without aerodynamics, with parts for everything that is attached."""
    tables = {"outside": airframe.pop("outside", {})}
    return plan(asked(airframe={**BARE, "legs": 4, **airframe}, **tables), more=True).craft


def body_of(craft, p=(0, 0, 0.005), v=(0, 0, 0), q=(1, 0, 0, 0), load=None):
    q, v = np.array(q, float), np.array(v, float)
    body = dynamics.Body(np.array(p, float), v, q / np.linalg.norm(q), np.zeros(3))
    whole = attached.standing(craft.extra, craft.mount, body)
    place = whole.load_p if load is None else np.array(load, float)
    return whole._replace(load_p=place, load_v=np.zeros(3))


@jax.jit
def glide(craft, body, w, push, dt):
    def step(state, push):
        lag = craft.lag + 0.0 * craft.x
        pushed = craft._replace(push=push)
        body, w, force = dynamics.step(pushed, state[0], state[1], state[1], lag, STILL, 0.0 * lag, dt)
        return (body, w), (body, force)

    return jax.lax.scan(step, (body, w), push)[1]


def moved(craft, body, seconds, w=0.0, push=(0.0, 0.0, 0.0), dt=DT):
    """Body and specific force after every step; w: speed of all rotors, held; push (3,) NED [N]."""
    pushes = np.broadcast_to(np.array(push, float), (LONGEST, 3))  # of one length: one program
    made = glide(craft, body, np.full(craft.x.shape, float(w)), pushes, dt)
    return jax.tree.map(lambda a: np.asarray(a)[: round(seconds / dt)], made)


def tilt(q):
    return np.degrees(np.arccos(np.clip(1.0 - 2.0 * (q[..., 1] ** 2 + q[..., 2] ** 2), -1.0, 1.0)))


# ---------------------------------------------------------------- the ground


@pytest.mark.parametrize(("legs", "mass"), [(3, 0.8), (4, 2.0), (4, 30.0)])
def test_at_rest_the_legs_carry_the_weight(legs, mass):
    craft = craft_of(legs=legs, mass_kg=mass)
    body, force = moved(craft, body_of(craft), 3.0)
    end = jax.tree.map(lambda a: a[-1], body)
    ground, torque = attached.ground(craft.extra, craft.mount, end, rotation.axes(end.q), 1.0)
    assert np.asarray(ground) == pytest.approx([0.0, 0.0, -mass * G], abs=1e-4 * mass)
    assert np.abs(torque).max() < 1e-4 * mass and np.abs(end.v).max() < 1e-5 and tilt(end.q) < 0.01
    assert force[-1] == pytest.approx([0.0, 0.0, -G], abs=1e-3)
    assert end.p[2] == pytest.approx(G / attached.CONTACT**2, rel=1e-3)  # of the springs


def test_without_damping_and_friction_the_ground_gives_back_all_energy():
    craft = craft_of(friction=0.0)
    craft = craft._replace(extra=craft.extra._replace(damp=0.0 * craft.extra.damp))
    body, _ = moved(craft, body_of(craft, p=(0, 0, -0.5), q=(1.0, 0.05, 0.02, 0.0)), 4.0)
    spin = 0.5 * np.einsum("ti,ij,tj->t", body.omega, craft.J, body.omega)
    energy = 0.5 * craft.mass * (body.v**2).sum(axis=1) + spin - craft.mass * G * body.p[:, 2]
    points = np.asarray(craft.extra.points)
    R = np.stack([np.asarray(rotation.axes(q)) for q in body.q[::10]])
    z = body.p[::10, None, 2] + np.einsum("tj,kj->tk", R[:, 2], points)
    spring = 0.5 * np.asarray(craft.extra.stiff * craft.extra.stands) * np.maximum(z - float(craft.extra.floor), 0.0) ** 2
    total = energy[::10] + spring.sum(axis=1)
    assert np.ptp(body.p[:, 2]) > 0.5 and np.abs(total - total[0]).max() < 4e-3 * craft.mass * G * 0.5  # the step over a contact's begin
    # With both there is only ever less of it.
    lossy = craft_of()
    body, _ = moved(lossy, body_of(lossy, p=(0, 0, -0.5), v=(1.0, 0, 0)), 3.0)
    assert np.abs(body.v[-1]).max() < 1e-4 and tilt(body.q[-1]) < 0.01


@pytest.mark.parametrize("to", [(1.0, 0.0), (-0.6, 0.8)])
def test_friction_holds_below_its_cone_and_slides_above(to):
    craft = craft_of(friction=0.5, leg_m=0.05, leg_at_m=0.3)  # low and wide: it does not tip
    weight = float(craft.mass) * G
    held, _ = moved(craft, body_of(craft), 3.0, push=[*(0.45 * weight * np.array(to)), 0.0])
    assert np.linalg.norm(held.p[-1, :2]) < 0.01 and np.abs(held.v[-1]).max() < 1e-4  # no creep
    slid, _ = moved(craft, body_of(craft), 2.0, push=[*(0.7 * weight * np.array(to)), 0.0])
    pace = (slid.v[-1, :2] - slid.v[-401, :2]) @ to
    assert pace == pytest.approx(0.2 * G, rel=0.01)
    after, _ = moved(craft, jax.tree.map(lambda a: a[-1], slid), 3.0)
    assert np.abs(after.v[-1]).max() < 1e-3 and np.linalg.norm(after.p[-1, :2]) > 0.5


def test_half_carried_it_slides_at_half_the_force():
    craft = craft_of(friction=0.5, leg_m=0.05, leg_at_m=0.3)
    w = np.sqrt(0.5 * float(craft.mass) * G / craft.thrust_max.sum())
    for share, slides in ((0.22, False), (0.28, True)):
        body, _ = moved(craft, body_of(craft), 2.0, w=w, push=[share * float(craft.mass) * G, 0.0, 0.0])
        assert (np.linalg.norm(body.p[-1, :2]) > 0.1) == slides


def test_a_leaning_vehicle_pivots_on_a_leg_and_tips_back():
    craft = craft_of(leg_m=0.15, leg_at_m=0.2, friction=1.0)
    half = np.radians(12.0) / 2.0
    lift = 0.2 / np.sqrt(2.0) * np.sin(2.0 * half) - 0.15 * (1.0 - np.cos(2.0 * half)) - 0.004  # its right legs touch
    body, _ = moved(craft, body_of(craft, p=(0, 0, -lift), q=(np.cos(half), np.sin(half), 0, 0)), 3.0)
    early = jax.tree.map(lambda a: a[int(0.02 / DT)], body)
    _, torque = attached.ground(craft.extra, craft.mount, early, rotation.axes(early.q), 1.0)
    assert tilt(body.q)[0] > 11.0 and torque[0] < -0.1  # rolled to the right: its right legs push it back
    assert tilt(body.q[-1]) < 0.05 and np.abs(body.omega[-1]).max() < 1e-3
    # Beyond the point where its weight is over that leg it falls on its rotors, and stays there.
    half = np.radians(75.0) / 2.0
    over, _ = moved(craft, body_of(craft, p=(0, 0, -0.25), q=(np.cos(half), np.sin(half), 0, 0)), 4.0)
    assert tilt(over.q[-1]) > 60.0 and np.abs(over.v[-1]).max() < 0.01


def test_stable_at_the_longest_step():
    craft = craft_of(mass_kg=0.3, arm_m=0.08, slung_kg=0.05)
    body, _ = moved(craft, body_of(craft, p=(0, 0, -1.0), q=(1.0, 0.2, 0.1, 0.3)), 4.0, dt=1 / 200)
    assert np.isfinite(body.p).all() and np.abs(body.v[-1]).max() < 0.01


# ---------------------------------------------------------------- lines


def test_a_slung_load_swings_with_a_pendulums_period():
    """The vehicle's place is held by a mass a thousand times the load's: T = 2 pi sqrt(L / g)."""
    long = 1.5
    craft = craft_of(mass_kg=100.0, slung_kg=0.1, sling_m=long, hook_m=0.0, thrust_to_weight=2.0)
    w = np.sqrt(float(craft.mass + 0.1) * G / craft.thrust_max.sum())
    angle = 0.1
    load = np.array([long * np.sin(angle), 0.0, -50.0 + long * np.cos(angle)])
    body, _ = moved(craft, body_of(craft, p=(0, 0, -50.0), load=load), 8.0, w=w)
    swing = body.load_p[:, 0] - body.p[:, 0]
    crossings = np.flatnonzero((swing[:-1] > 0) != (swing[1:] > 0))
    period = 2.0 * np.diff(crossings).mean() * DT
    assert period == pytest.approx(2.0 * np.pi * np.sqrt(long / G) * (1.0 + angle**2 / 16.0), rel=0.005)
    apart = np.linalg.norm(body.load_p - body.p, axis=1)
    assert apart[-1] == pytest.approx(long, abs=0.01)


def test_a_load_pulls_vehicle_and_load_alike_and_a_slack_line_not():
    craft = craft_of(slung_kg=0.4, sling_m=2.0, hook_m=0.1)
    # Nothing but weight acts on both together: momentum.
    body, _ = moved(craft, body_of(craft, p=(0, 0, -90.0), load=(1.9, 0.0, -89.0)), 2.0)
    p = float(craft.mass) * body.v + 0.4 * body.load_v
    t = DT * np.arange(1, len(p) + 1)
    assert p[:, :2] == pytest.approx(np.zeros((len(p), 2)), abs=1e-9)
    assert p[:, 2] == pytest.approx(G * (float(craft.mass) + 0.4) * t, rel=1e-6)
    slack, force = moved(craft, body_of(craft, p=(0, 0, -90.0), load=(0.0, 0.0, -89.0)), 0.5)
    assert np.abs(force).max() < 1e-9 and np.abs(slack.omega).max() < 1e-12  # both fall freely


@pytest.mark.parametrize(("height", "pull"), [(2.0, 0.0), (2.9, 0.0), (4.0, 1.0), (5.0, 2.0)])
def test_a_tether_pulls_one_way(height, pull):
    craft = craft_of(hook_m=0.0, outside={"tether_m": 3.0, "tether_stiffness": 2.0})
    floor = float(craft.extra.floor)
    body = body_of(craft, p=(0, 0, floor - height))
    force, torque, _ = attached.lines(craft.extra, craft.mount, body, rotation.axes(body.q), STILL)
    assert np.asarray(force) == pytest.approx([0.0, 0.0, pull * 2.0 * float(craft.mass)], abs=1e-6)
    assert np.abs(torque).max() < 1e-9


# ---------------------------------------------------------------- what changes


def test_a_centre_of_mass_that_moves_is_trimmed_by_its_torque():
    """m g dx: what the rotors give about the frame's middle at the end of a calm hover."""
    made = simulate(asked(airframe={**BARE, "shift_m": [0.012, -0.008, 0.0], "shift_onset_s": 12.0, "shift_ramp_s": 8.0}))
    r, craft, time = made.record, made.plan.craft, made.record.time
    thrust = craft.thrust_max * r.w**2
    pitch, roll = thrust @ craft.x, -(thrust @ craft.y)
    late, early = (time > 24.0) & (time < 30.0), (time > 9.5) & (time < 11.5)
    assert np.array([pitch[late].mean(), roll[late].mean()]) == pytest.approx(float(craft.mass) * G * np.array([0.012, 0.008]), rel=0.02)
    assert np.abs([pitch[early].mean(), roll[early].mean()]).max() < 0.01 * float(craft.mass) * G * 0.012


@pytest.mark.parametrize("ratio", [1.0, 1.5])
def test_rotors_slow_down_with_another_time_constant(ratio):
    changes = plan(asked(airframe={"lag_down": ratio}), more=True).outside
    w, asks = np.array([0.5, 0.5]), np.array([0.8, 0.2])
    lag = np.asarray(outside.lag(changes, 0.04, w, asks))
    assert lag == pytest.approx([0.04, 0.04 * ratio])
    craft = craft_of()
    command, start = np.array([0.8, 0.2, 0.8, 0.2]), np.full(4, 0.5)
    lag = outside.lag(changes, craft.lag, start, command)
    _, w, _ = dynamics.step(craft, body_of(craft, p=(0, 0, -9)), start, command, lag, STILL, np.zeros(4), DT)
    assert np.asarray(command + (start - command) * np.exp(-DT / np.asarray(lag))) == pytest.approx(np.asarray(w), rel=1e-12)


def test_drag_acts_where_it_is_put_and_a_twist_turns():
    wind = STILL._replace(wind=np.array([-5.0, 0.0, 0.0]), ground=np.array(0.0))
    rotors = dynamics.Sums(np.zeros(4), np.zeros(6), np.array(0.0), np.array(0.0), np.zeros(3))
    level = rotation.axes(np.array([1.0, 0, 0, 0]))
    flown = []
    for at in ((0.0, 0.0, 0.0), (0.0, 0.03, -0.05)):
        craft = plan(asked(airframe={"drag_at_m": at, "rotor_drag": 0.0}), more=True).craft
        craft = craft._replace(extra=craft.extra._replace(twist=np.array([0.0, 0.0, 0.2])))
        flown.append([np.asarray(a) for a in dynamics.wrench(craft, body_of(craft, p=(0, 0, -50)), level, rotors, wind)])
    (force, torque), (same, turned) = flown
    drag = 0.01 * 2.0 * 25.0
    assert force == pytest.approx([-drag, 0.0, 0.0]) and same == pytest.approx(force)
    assert torque == pytest.approx([0.0, 0.0, 0.2]) and turned == pytest.approx([0.0, 0.05 * drag, 0.2 + 0.03 * drag])


def test_a_push_grows():
    made = plan(asked(outside={"push_m_s2": 2.0, "push_onset_s": 10.0, "push_ramp_s": 4.0, "twist_rad_s2": [1.0, 0.0, 0.0]}))
    off = np.zeros(2)
    for t, share in ((9.0, 0.0), (11.0, 0.25), (14.0, 1.0), (20.0, 1.0)):
        now = outside.now(made.craft, made.outside, made.faults, off, t, np.ones(4))
        assert np.asarray(now.push) == pytest.approx([share * 2.0 * 2.0, 0.0, 0.0])
        assert np.asarray(now.extra.twist) == pytest.approx([share * made.craft.J[0, 0], 0.0, 0.0])


def test_a_frame_longer_than_wide():
    square, long = vehicle(asked()), vehicle(asked(airframe={"length_to_width": 1.4}))
    ratio = [abs(r.x / r.y) / abs(s.x / s.y) for r, s in zip(long.rotors, square.rotors, strict=True)]
    assert ratio == pytest.approx([1.4] * 4) and np.hypot(long.rotors[0].x, long.rotors[0].y) == pytest.approx(0.3)
    J = plan(asked(airframe={"length_to_width": 1.4})).craft.J
    assert J[1, 1] / J[0, 0] == pytest.approx(1.4**2) and np.trace(J) == pytest.approx(np.trace(plan(asked()).craft.J))
    thinks = asked(airframe={"length_to_width": 1.4, "believed_length_to_width": 1.0}).with_autopilot("px4")
    assert vehicle(thinks).mixer == pytest.approx(vehicle(asked().with_autopilot("px4")).mixer)


def test_a_battery_that_sags_by_a_quarter():
    made = simulate(asked(airframe={"thrust_to_weight": 3.0}, battery={"empty_V": 3.15, "hover_min": 0.65, "resistance_ohm": 0.0}))
    volts = made.record.volts / 16.8
    assert volts[0] > 0.999 and 0.72 < volts[-1] < 0.8


# ---------------------------------------------------------------- take-off and landing


def test_hops_and_landing_come_when_they_should():
    way = {"hops": 2, "hop_m": 1.0, "hop_s": 1.0, "hop_rest_s": 1.5, "slow_m": 1.0, "slow_m_s": 0.5, "cut_s": 0.5, "altitude_m": 3.0}
    made = simulate(asked(trajectory=way, airframe={"legs": 3}))
    time, height = made.record.time, -made.record.p[:, 2]
    up = height > 0.3
    starts = time[1:][np.diff(up.astype(int)) > 0]
    lasts = trajectories.landings(made.plan.way)
    assert len(starts) == 3 and [begin < s < cut for (begin, cut), s in zip(lasts, starts[:2], strict=True)] == [True, True]
    for _, cut in lasts:
        rests = (time > cut + 0.2) & (time < cut + 1.4)
        assert np.abs(height[rests]).max() < 0.03 and made.record.command[rests].max() == 0.0
    said = [m.text for m in made.flight.messages if m.kind == "landed"]
    assert said == ["landed", "in the air", "landed", "in the air", "landed", "in the air", "landed"]
    slow = (height < 0.8) & (height > 0.2) & (time > lasts[-1][1] + 8.0)
    assert made.record.v[slow, 2].mean() == pytest.approx(0.5, abs=0.1)


def test_wind_to_the_ground_makes_it_lean_until_the_legs_stand():
    way = {"slow_m": 1.5, "slow_m_s": 0.3, "cut_s": 1.2, "drift_m_s": 0.3, "drift_to_deg": 90.0}
    air = {"speed_m_s": 5.0, "turbulence": 0.0, "from_deg": 0.0}
    asks = {"airframe": {"legs": 4, "body_drag": 3.0, "rotor_drag": 1.5}, "trajectory": way}
    leaning, falls = (simulate(asked(**asks, wind={**air, "falls": f})) for f in (False, True))
    touch = trajectories.touch_down(leaning.plan.way) - 1.2
    leans = [tilt(m.record.q)[np.searchsorted(m.record.time, touch - 0.3)] for m in (leaning, falls)]
    assert 10.0 < leans[0] < 22.0 and leans[1] < 0.5 * leans[0]
    r, at = leaning.record, np.searchsorted(leaning.record.time, touch - 0.3)
    assert r.v[at, 1] == pytest.approx(0.3, abs=0.05)
    stands = (r.time > touch + 0.3) & (r.time < touch + 1.1)
    assert np.ptp(r.demand[stands], axis=1).mean() > 0.1  # outputs apart: the ground holds it, and the autopilot wants to lean
    assert tilt(r.q[-1]) < 0.5


def test_sequential_desaturation_never_raises_the_throttle():
    mixer = vehicle(asked()).mixer
    for roll, pitch, yaw, throttle in itertools.product((-0.4, 0.0, 0.3), (0.0, 0.2), (-0.3, 0.0), (0.05, 0.4, 0.95)):
        turning = np.array([roll, pitch, yaw])
        u, granted = (np.asarray(a) for a in control.mix_sequential(mixer, turning, throttle))
        plain = mixer[:, :3] @ turning + throttle
        assert u.min() >= 0.0 and u.max() <= 1.0
        if plain.min() >= 0.0 and plain.max() <= 1.0:
            assert u == pytest.approx(plain) and granted == 1.0
    low = np.asarray(control.mix_sequential(mixer, np.array([0.4, 0.0, 0.0]), 0.05)[0])
    assert low.min() == 0.0 and low.mean() < 0.1 < np.asarray(control.mix(mixer, np.array([0.4, 0.0, 0.0]), 0.05)[0]).mean()


def test_sequential_desaturation_is_that_of_a_real_px4():
    """Setpoints (roll, pitch, yaw, thrust) and outputs as logged by PX4 1.17 with MC_AIRMODE 0, an X quad on the ground."""
    rows = [
        ((-0.006, 0.075, 0.532, 0.439), (0.888, 0.772, 0.098, 0.0)),
        ((-0.048, 0.031, -0.412, 0.403), (0.111, 0.0, 0.737, 0.762)),
        ((0.197, -0.066, -0.131, 0.276), (0.0, 0.371, 0.459, 0.274)),
        ((-0.099, -0.064, 0.33, 0.333), (0.575, 0.525, 0.0, 0.231)),
        ((-0.127, -0.158, 0.168, 0.12), (0.017, 0.223, 0.0, 0.24)),
        ((-0.113, 0.179, 0.114, 0.12), (0.24, 0.0, 0.24, 0.0)),
    ]
    mixer = vehicle(asked().with_autopilot("px4")).mixer
    for setpoint, outputs in rows:
        u, granted = control.mix_sequential(mixer, np.array(setpoint[:3]), setpoint[3])
        assert np.asarray(u) == pytest.approx(outputs, abs=2e-3) and granted == 0.0


# ---------------------------------------------------------------- none of it


def test_scenarios_that_ask_for_none_of_it_have_no_part_for_it():
    """So their program is the old one, to the last bit."""
    usual = asked(outside={"push_m_s2": 1.0}, battery={"capacity_Ah": 3.0})
    made = plan(usual)
    assert not beyond(usual) and (made.craft.extra, made.outside.changes, made.way.approach, made.pilot.sequential) == ((), (), (), ())
    assert type(MULTIROTOR.start(made)[0]) is dynamics.Body
    start = loop.start(MULTIROTOR, made)
    reference = MULTIROTOR.reference(made, 3, 0.01)
    assert reference.level == () and len(jax.tree.leaves(start.body)) == 4
    for tables in ({"airframe": {"legs": 4}}, {"wind": {"falls": False}}, {"trajectory": {"hops": 1}}, {"outside": {"tether_m": 4.0}}):
        assert beyond(asked(**tables))


def test_with_every_part_and_nothing_in_it_it_flies_the_same_in_the_air():
    usual = asked(wind={"speed_m_s": 5.0}, trajectory={"kind": "square", "land": False}, airframe={"ground_effect": False})
    rates = usual.duration_s, usual.rate_hz, usual.record_hz
    old, new = (next(loop.fly_each(MULTIROTOR, [plan(usual, more)], *rates)) for more in (False, True))
    air = -old.p[:, 2] > 1.0
    # Legs carry it elsewhere than level feet until it lifts off; the autopilot makes up for that.
    late = air & (old.time > 20.0)
    assert np.abs(old.p - new.p)[late].max() < 2e-3 and np.abs(old.w - new.w)[late].max() < 2e-3


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ({"airframe": {"legs": 2}}, "airframe.legs must be 0, 3 or 4"),
        ({"airframe": {"slung_kg": 3.0}}, "airframe.slung_kg: 5 kg are too much"),
        ({"trajectory": {"slow_m": 5.0}}, "trajectory.slow_m is 5, above altitude_m, 4"),
        ({"trajectory": {"hops": 6}}, "duration_s is 40, but"),
    ],
)
def test_what_cannot_be_is_said_by_field(tables, says):
    with pytest.raises(ConfigError, match=says):
        plan(asked(**tables))
