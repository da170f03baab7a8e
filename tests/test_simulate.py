"""The simulated vehicle: closed forms, conservation laws, a simulator written elsewhere, air, mixer, faults, closed loop."""

from functools import cache
from importlib import import_module

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.simulation import control, dynamics, faults, loop, record_of, rotation, scenario, simulate_batch, trajectories, wind
from rotorwatch_lab.simulation.multirotor import MULTIROTOR
from rotorwatch_lab.simulation.prepare import induced_velocity, plan, vehicle

jax = load_jax()
flatten = import_module("jax.flatten_util").ravel_pytree
jnp = jax.numpy
G = dynamics.G0
DURATION, DT = 42.0, 1 / 400


def asked(frame="quad-x", **tables):
    rest = {k: v for k, v in tables.items() if k not in ("airframe", "trajectory")}
    way = {"altitude_m": 5.0, **tables.get("trajectory", {})}
    craft = {"frame": frame, **tables.get("airframe", {})}
    return scenario.from_table({"duration_s": DURATION, "airframe": craft, "trajectory": way, **rest})


def craft_of(**changes):
    """A lopsided hexarotor without aerodynamics, rotors' spin kept; `changes` to its numbers."""
    bare = {"k_d": 0.0, "k_z": 0.0, "drag": np.zeros(3), "ground_effect": 0.0}
    J = np.array([[0.03, 0.002, -0.001], [0.002, 0.04, 0.003], [-0.001, 0.003, 0.06]])
    values = {**bare, "J": J, "J_inverse": np.linalg.inv(J), **changes}
    return plan(asked("hexa-x")).craft._replace(**{k: np.asarray(v, float) for k, v in values.items()})


def body_of(p=(0, 0, -50), v=(0, 0, 0), q=(1, 0, 0, 0), omega=(0, 0, 0)):
    q = np.array(q, float)
    return dynamics.Body(*(np.array(a, float) for a in (p, v, q / np.linalg.norm(q), omega)))


AIR = dynamics.Air(np.zeros(3), np.zeros(3), np.array(1.0))


@jax.jit
def glide(craft, body, w, command, lag, air, theta, dt):
    def step(state, c):
        body, w, force = dynamics.step(craft, *state, c, lag, air, theta, dt)
        return (body, w), (body, w, force)

    return jax.lax.scan(step, (body, w), command)[1]


def flown(craft, body, w, command, steps, dt=DT, air=AIR):
    """Body, rotor speeds and specific force after each of `steps` steps; command (n,) or (steps, n)."""
    n = craft.x.size
    w, command, lag = (np.broadcast_to(a, s).astype(float) for a, s in ((w, n), (command, (steps, n)), (craft.lag, n)))
    return jax.tree.map(np.asarray, glide(craft, body, w, command, lag, air, np.zeros(n), dt))


# -- closed forms ----------------------------------------------------------------------------------------------------


def test_free_fall():
    craft = craft_of(thrust_max=np.zeros(6))
    body, _, force = flown(craft, body_of(v=(3, -2, -5)), 0.0, 0.0, 400)
    t = DT * np.arange(1, 401)[:, None]
    assert np.allclose(body.p, [0, 0, -50] + np.array([3, -2, -5]) * t + 0.5 * G * t**2 * [0, 0, 1], rtol=0, atol=1e-10)
    assert np.abs(force).max() < 1e-12  # an accelerometer in free fall feels nothing


def test_thrust_after_a_step_of_command():
    """w = c + (w0 - c) e: the speed gained is the integral of T_max w^2 / m, in closed form."""
    craft = craft_of()
    w0, c, tau = 0.2, 0.75, float(craft.lag)
    body, w, _ = flown(craft, body_of(), w0, c, 400)
    t = DT * np.arange(1, 401)
    e = np.exp(-t / tau)
    assert np.allclose(w, (c + (w0 - c) * e)[:, None], rtol=0, atol=1e-13)
    squares = c * c * t + 2 * c * (w0 - c) * tau * (1 - e) + (w0 - c) ** 2 * tau / 2 * (1 - e * e)
    assert np.allclose(body.v[:, 2], G * t - craft.thrust_max.sum() / craft.mass * squares, rtol=0, atol=2e-7)


def test_symmetric_top_precesses():
    """Torque-free rotation of a body with J = (a, a, c): the axis component stays, the rest turns at (c - a) / a omega_z."""
    a, c = 0.03, 0.05
    craft = craft_of(thrust_max=np.zeros(6), J=np.diag([a, a, c]), J_inverse=np.diag([1 / a, 1 / a, 1 / c]))
    body, _, _ = flown(craft, body_of(omega=(2, 0, 5)), 0.0, 0.0, 400)
    turn = (c - a) / a * 5 * DT * np.arange(1, 401)
    assert np.allclose(body.omega, np.stack([2 * np.cos(turn), 2 * np.sin(turn), 5 + 0 * turn], axis=1), rtol=0, atol=1e-7)


def test_terminal_velocity():
    craft = craft_of(thrust_max=np.zeros(6), drag=[0.1, 0.1, 0.2])
    body, _, _ = flown(craft, body_of(p=(0, 0, -1e4)), 0.0, 0.0, 400, dt=0.05)
    assert body.v[-1, 2] == pytest.approx(np.sqrt(craft.mass * G / 0.2), rel=1e-9)


def test_ground_effect_is_cheeseman_and_bennett():
    craft = craft_of(ground_effect=1.0)
    heights = (0.5, 1.0, 2.0)
    R = rotation.axes(body_of().q)
    full = craft.thrust_max.sum()
    for z in heights:
        body = body_of(p=(0, 0, 0.5 * craft.radius - craft.z - z))
        rotors = dynamics.sums(craft, np.ones(6), np.zeros(6), np.zeros(6))
        force, _ = dynamics.wrench(craft, body, R, rotors, AIR)
        assert -force[2] / full == pytest.approx(1 / (1 - (craft.radius / (4 * z)) ** 2), rel=1e-12)


def test_rests_on_the_ground():
    body, _, force = flown(craft_of(), body_of(p=(0, 0, -0.2), q=(1, 0.1, 0.1, 0), omega=(1, 1, 1)), 0.0, 0.0, 4000)
    assert np.abs(body.v[-1]).max() < 1e-6 and np.abs(body.omega[-1]).max() < 1e-6 and 0 < body.p[-1, 2] < 0.02
    assert force[-1] == pytest.approx([0, 0, -G], abs=1e-5)


def test_fourth_order():
    craft = craft_of(k_d=0.03, k_z=0.1, drag=[0.05, 0.05, 0.1])
    start = body_of(v=(5, 1, -2), q=(1, 0.3, -0.2, 0.5), omega=(3, -4, 2))
    command = np.array([0.9, 0.5, 0.7, 0.6, 0.8, 0.4])
    ends = [flown(craft, start, 0.3, command, 640, 0.4 / k)[0].v[k - 1] for k in (20, 40, 80, 640)]
    errors = [np.abs(e - ends[-1]).max() for e in ends[:-1]]
    assert errors[0] / errors[1] > 12 and errors[1] / errors[2] > 12


# -- laws ------------------------------------------------------------------------------------------------------------


def energy(craft, body):
    spin = np.einsum("ti,ij,tj->t", body.omega, np.asarray(craft.J), body.omega)
    return 0.5 * craft.mass * (body.v**2).sum(axis=1) + 0.5 * spin - craft.mass * G * body.p[:, 2]


def momentum(craft, body, w):
    """Angular momentum in world axes, rotors included (T, 3)."""
    L = body.omega @ np.asarray(craft.J)
    L[:, 2] -= craft.rotor_momentum * (w @ craft.spin)
    turned = [np.array(rotation.axes(q)) @ row for q, row in zip(body.q, L)]
    return np.stack(turned)


def tumbled(seed):
    rng = np.random.default_rng(seed)
    omega = rng.uniform(-6, 6, 3)
    return body_of(p=(0, 0, -500), v=rng.uniform(-9, 9, 3), q=rng.standard_normal(4), omega=omega), rng


def energy_drift(seed=0):
    """Largest relative change of energy of a free tumbling body without air, rotors at rest."""
    craft = craft_of(thrust_max=np.zeros(6))
    body, _ = tumbled(seed)
    total = energy(craft, flown(craft, body, 0.0, 0.0, 200)[0])
    return np.ptp(total) / abs(total[0])


def momentum_drift(seed=0):
    """The same of angular momentum, while rotors without blades speed up and slow down."""
    craft = craft_of(thrust_max=np.zeros(6), rotor_momentum=0.02)
    body, rng = tumbled(seed)
    states, w, _ = flown(craft, body, rng.uniform(0, 1, 6), rng.uniform(0, 1, (200, 6)), 200)
    total = momentum(craft, states, w)
    return np.abs(total - total[0]).max() / np.linalg.norm(total[0])


def power_gained(seed=0):
    """Power of all aerodynamic forces in still air on rotors without thrust: W; friction only takes."""
    rng = np.random.default_rng(seed)
    craft = craft_of(thrust_max=np.zeros(6), k_d=0.05, k_z=0.2, drag=[1e-3, 1e-3, 2e-3])
    body, w = tumbled(seed)[0], rng.uniform(0, 1, 6)
    R = rotation.axes(body.q)
    force, torque = dynamics.wrench(craft, body, R, dynamics.sums(craft, w, 0 * w, 0 * w), AIR)
    return float(np.dot(force, rotation.to_body(R, body.v)) + np.dot(torque, body.omega))


def drift_with_the_wind(seed=0):
    """Air that moves with the vehicle exerts what still air does on a vehicle at rest: difference of the forces."""
    rng = np.random.default_rng(seed)
    craft = craft_of(k_d=0.05, k_z=0.2, drag=[0.1, 0.1, 0.2])
    body, w = tumbled(seed)[0], rng.uniform(0, 1, 6)
    R, rotors = rotation.axes(body.q), dynamics.sums(craft, w, 0 * w, 0 * w)
    moving = dynamics.wrench(craft, body, R, rotors, AIR._replace(wind=body.v))
    still = dynamics.wrench(craft, body._replace(v=np.zeros(3)), R, rotors, AIR)
    return max(np.abs(np.asarray(a) - np.asarray(b)).max() for a, b in zip(moving, still))


LAWS = {
    energy_drift: lambda v: v < 1e-9,
    momentum_drift: lambda v: v < 2e-7,
    power_gained: lambda v: v < 0,
    drift_with_the_wind: lambda v: v < 1e-10,
}


@pytest.mark.parametrize("law", LAWS, ids=lambda f: f.__name__)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=8, deadline=None)
def test_law(law, seed):
    value = law(seed)
    assert LAWS[law](value), value


CROSS, SUMS, WRENCH = rotation.cross, dynamics.sums, dynamics.wrench
PLANTED = {
    "gyroscopic torque that does work": (energy_drift, rotation, "cross", lambda a, b: CROSS(a, b) + 0.01 * a),
    "gyroscopic torque reversed": (momentum_drift, rotation, "cross", lambda a, b: -CROSS(a, b)),
    "reaction of the rotors reversed": (momentum_drift, dynamics, "sums", lambda c, w, d, t: SUMS(c, w, -d, t)),
    "inflow adds power": (power_gained, dynamics, "sums", lambda c, w, d, t: SUMS(c, -w, d, t)),
    "wind counted twice": (
        *(drift_with_the_wind, dynamics, "wrench"),
        lambda craft, body, R, rotors, air: WRENCH(craft, body, R, rotors, air._replace(wind=2 * air.wind)),
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_law_notices(name, monkeypatch):
    law, module, part, wrong = PLANTED[name]
    monkeypatch.setattr(module, part, wrong)
    glide.clear_cache()
    value = law(3)
    glide.clear_cache()
    assert not LAWS[law](value), value


@pytest.mark.parametrize("autopilot, frame", [("ardupilot", "octaquad-x"), ("ardupilot", "y6"), ("px4", "octaquad-x"), ("px4", "y6")])
def test_lower_rotors_of_coaxial_arms_give_their_share(autopilot, frame):
    made = scenario.from_table({"autopilot": autopilot, "airframe": {"frame": frame, "lower_rotor": 0.8}})
    rotors, thrust = vehicle(made).rotors, np.asarray(plan(made).craft.thrust_max)
    assert sum(r.lower for r in rotors) == len(rotors) // 2
    assert thrust / thrust.max() == pytest.approx([0.8 if r.lower else 1.0 for r in rotors])
    assert thrust / thrust.mean() == pytest.approx(vehicle(made).effectiveness()[3])  # what an allocation goes by


def test_same_as_a_simulator_written_elsewhere(monkeypatch):
    """RotorPy (University of Pennsylvania): another formulation, frames (z up, FLU) and integrator, the same commands."""
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
    monkeypatch.setattr(dynamics, "G0", 9.81)  # as they round it
    from rotorpy.vehicles.hummingbird_params import quad_params

    other = {**quad_params, "k_h": 0.0, "tau_m": 0.03}
    full = 1500.0
    places = np.array(list(other["rotor_pos"].values()))
    craft = plan(asked("quad-x")).craft
    J = np.diag([other["Ixx"], other["Iyy"], other["Izz"]])
    craft = craft._replace(
        **{"mass": np.array(other["mass"]), "J": J, "J_inverse": np.linalg.inv(J), "x": places[:, 0], "y": -places[:, 1]},
        **{"z": np.array(0.0), "spin": -other["rotor_directions"].astype(float), "rotor_momentum": np.array(0.0)},
        **{"thrust_max": np.full(4, other["k_eta"] * full**2), "drag_ratio": np.array(other["k_m"] / other["k_eta"])},
        **{"k_d": np.array(other["k_d"] * full), "k_z": np.array(other["k_z"] * full), "lag": np.array(0.03)},
        **{"drag": np.zeros(3), "ground_effect": np.array(0.0)},
    )
    other |= {"c_Dx": 0.0, "c_Dy": 0.0, "c_Dz": 0.0}  # its drag takes |v| v by axis, ours |v| v as a whole: both 0 here
    rng = np.random.default_rng(4)
    hover = np.sqrt(other["mass"] * 9.81 / (4 * other["k_eta"]))
    commands = np.repeat(hover * (1 + 0.15 * rng.standard_normal((10, 4))), 20, axis=0)  # a new one every 50 ms, 0.5 s
    wind_enu = np.array([2.0, -1.0, 0.5])
    state = {"x": np.array([0.0, 0.0, 50.0]), "v": np.array([1.0, 0.5, 0.0]), "q": np.array([0.0, 0.0, 0.0, 1.0])}
    state |= {"w": np.array([0.2, -0.1, 0.3]), "wind": wind_enu, "rotor_speeds": np.full(4, hover)}
    vehicle = multirotor.Multirotor(other, state, integrator_kwargs={"method": "RK45", "rtol": 1e-9, "atol": 1e-10})
    theirs = []
    for command in commands:
        state = vehicle.step(state, {"cmd_motor_speeds": command}, DT)
        theirs.append(np.concatenate([state[k] for k in ("x", "v", "w", "rotor_speeds")]))
    flip = np.array([1.0, -1.0, -1.0])  # both FLU -> FRD, and their world, taken as north-west-up, -> NED
    start = body_of(p=(0, 0, -50), v=(1.0, -0.5, 0.0), omega=flip * [0.2, -0.1, 0.3])
    air = AIR._replace(wind=flip * wind_enu)
    ours, w, _ = flown(craft, start, hover / full, commands / full, len(commands), air=air)
    glide.clear_cache()
    theirs = np.array(theirs)
    apart = [np.abs(w * full - theirs[:, 9:]).max()]
    apart += [np.abs(a * flip - theirs[:, k : k + 3]).max() for a, k in ((ours.p, 0), (ours.v, 3), (ours.omega, 6))]
    assert apart[0] < 1e-4 and apart[1] < 1e-7 and apart[2] < 1e-6 and apart[3] < 1e-5, apart  # rad/s, m, m/s, rad/s


# -- air -------------------------------------------------------------------------------------------------------------


def gust_covariance(air, dt):
    """Stationary covariance of the wind (3, 3) and its correlation one step apart, from the filter's own matrices."""
    flat, shape = flatten(wind.still())
    n = flat.size

    def step(x, noise):
        return flatten(wind.step(air, shape(x), noise, dt))[0]

    A = np.array(jax.jacfwd(step)(np.zeros(n), np.zeros(6)))
    B = np.array(jax.jacfwd(step, argnums=1)(np.zeros(n), np.zeros(6)))
    C = np.array(jax.jacfwd(lambda x: jnp.concatenate([wind.velocity(air, shape(x)) - air.mean, shape(x).turning]))(np.zeros(n)))
    from scipy.linalg import solve_discrete_lyapunov

    P = solve_discrete_lyapunov(A, B @ B.T)
    return C @ P @ C.T, C @ A @ P @ C.T


def test_turbulence_has_the_standards_size_and_length():
    air = wind.dryden(6.0, 180.0, 1.0, 10.0, 6.0, 0.6)  # blows to the north: along is north
    h = 10.0 / 0.3048
    assert air.sigma[2] == pytest.approx(0.6)
    assert air.sigma[0] == pytest.approx(0.6 / (0.177 + 0.000823 * h) ** 0.4)
    assert air.tau == pytest.approx(np.array([h / (0.177 + 0.000823 * h) ** 1.2, h / (0.177 + 0.000823 * h) ** 1.2, h]) * 0.3048 / 6)
    now, next_ = gust_covariance(air, 0.01)
    assert np.allclose(np.diag(now)[:3], air.sigma**2, rtol=0.01)
    assert np.allclose(np.diag(now)[3:], air.turn_sigma**2, rtol=1e-9)
    assert np.abs(now - np.diag(np.diag(now))).max() < 1e-12
    assert next_[0, 0] / now[0, 0] == pytest.approx(np.exp(-0.01 / air.tau[0]), rel=1e-9)
    # Across: sigma^2 (1 - t / 2 tau) e^(-t / tau), the transverse correlation of Dryden's model.
    r = 0.01 / air.tau[1]
    assert next_[1, 1] / now[1, 1] == pytest.approx((1 - r / 2) * np.exp(-r), rel=1e-3)


def test_no_wind_no_gusts():
    air = wind.dryden(0.0, 0.0, 1.0, 10.0, 0.0, 0.6)
    gusts = wind.step(air, wind.still(), np.ones(6), 0.01)
    assert not np.any(wind.velocity(air, gusts)) and not np.any(gusts.turning)


# -- mixer, faults, ways ---------------------------------------------------------------------------------------------

SHARES = st.floats(-1, 1)


@given(roll=SHARES, pitch=SHARES, yaw=SHARES, throttle=st.floats(0.05, 0.95), frame=st.sampled_from(["quad-x", "hexa-x", "octaquad-x"]))
@settings(max_examples=trials(60), deadline=None)
def test_mixer(roll, pitch, yaw, throttle, frame):
    M = mixer_of(frame)
    out, free = (np.asarray(a) for a in mixed(M, np.array([roll, pitch, yaw]), throttle))
    plain = M @ [roll, pitch, yaw, throttle]
    assert out.min() >= 0 and out.max() <= 1
    if free:
        assert np.allclose(out, plain, atol=1e-12)
    elif plain.min() > 0.01 and plain.max() < 0.99 and abs(yaw) < control.YAW_ROOM:
        pytest.fail("limited without need")
    # Roll and pitch come out in the proportion asked for, as long as yaw leaves them alone.
    if abs(yaw) < 1e-9 or abs(yaw) < control.YAW_ROOM:
        got = np.linalg.pinv(M) @ out
        assert abs(got[0] * pitch - got[1] * roll) < 1e-9


tabled = jax.jit(trajectories.table, static_argnums=(1, 2))


def asked_of(way):
    return jax.tree.map(np.asarray, tabled(way, 4200, 0.01))


@cache
def mixer_of(frame):
    return np.asarray(plan(asked(frame)).pilot.mixer)


mixed = jax.jit(control.mix)


@given(thrust=st.floats(0, 1), expo=st.sampled_from([0.0, 0.3, 0.65, 1.0]))
@settings(max_examples=trials(40), deadline=None)
def test_drive_inverts_the_thrust_curve(thrust, expo):
    assert float(dynamics.thrust_share(expo, control.drive(expo, thrust))) == pytest.approx(thrust, abs=2e-6)


def test_faults_come_and_go():
    rows = [
        {"kind": "loss", "rotor": 2, "onset_s": 10.0, "end_s": 20.0, "strength": 0.4, "ramp_s": 4.0},
        {"kind": "loss", "rotor": 4, "onset_s": 12.0, "strength": 0.5, "period_s": 2.0, "duty": 0.25},
    ]
    table = plan(asked(faults=rows)).faults
    for t, second, fourth in ((9.99, 0, 0), (10, 0, 0), (11, 0.1, 0), (14.2, 0.4, 0.5), (14.6, 0.4, 0), (20, 0, 0.5), (30.4, 0, 0.5)):
        theta = faults.loss(table, faults.strength(table, t))
        assert np.asarray(theta) == pytest.approx([0, second, 0, fourth], abs=1e-9), t


def test_two_faults_of_one_rotor_multiply():
    rows = [{"kind": "loss", "rotor": 1, "onset_s": 1.0, "strength": s} for s in (0.5, 0.2)]
    table = plan(asked(faults=rows)).faults
    assert float(faults.loss(table, faults.strength(table, 5.0))[0]) == pytest.approx(1 - 0.5 * 0.8)


@pytest.mark.parametrize("kind", trajectories.KINDS)
def test_ways_are_smooth_and_end_on_the_ground(kind):
    way = plan(asked(trajectory={"kind": kind, "speed_m_s": 3.0, "size_m": 8.0})).way
    ask = asked_of(way)
    assert ask.p[0] == pytest.approx([0, 0, 0]) and ask.p[-1, 2] >= 0
    flying = (ask.lift == 1) & (np.arange(4200) * 0.01 < float(way.landing))
    assert np.abs(np.cumsum(ask.v, axis=0) * 0.01 + ask.p[0] - ask.p).max() < 0.05  # velocity is the slope
    assert np.linalg.norm(ask.v[flying], axis=1).max() < 3.0 * 2.1 and np.abs(ask.a[flying]).max() < 10.0
    moved = np.ptp(ask.p[1100:3000], axis=0).max() + np.ptp(ask.yaw[1100:3000])
    assert (moved < 1e-6) == (kind == "hover")


# -- closed loop -----------------------------------------------------------------------------------------------------

BREAKS = [
    {"kind": "loss", "strength": 0.25},
    {"kind": "chipped", "strength": 0.15},
    {"kind": "bias", "strength": 0.05},
    {"kind": "stuck", "end_s": 20.5},
    {"kind": "saturated", "end_s": 20.1},
    {"kind": "float"},
    {"kind": "complete loss"},
]


def turned(record):
    """What flights are asked for besides their record as it is: each of its fields, one of them of another sign."""
    return record._replace(believed=-record.believed)


@cache
def fleet():
    """(scenarios, `turned` records) flown in one batch: each trajectory, each fault in hover, a payload off centre."""
    flights = [asked(trajectory={"kind": kind}, wind={"speed_m_s": 4.0}, seed=3) for kind in trajectories.KINDS]
    flights += [asked(airframe={"ground_effect": False}, faults=[{"rotor": 3, "onset_s": 20.0, **b}]) for b in BREAKS]
    flights.append(asked(airframe={"payload_kg": 0.4, "payload_at_m": (0.1, 0.0, 0.0)}))
    many = simulate_batch(flights, turned, record_hz=100)
    return flights, [record_of(many, k) for k in range(len(flights))]


def record_flown(flight):
    flights, records = fleet()
    return records[flights.index(flight)] if not isinstance(flight, int) else records[flight]


@pytest.mark.thorough
def test_every_flight_is_finite():
    for flight, record in zip(*fleet()):
        assert all(np.isfinite(a).all() for a in record), flight
        assert np.abs(np.linalg.norm(record.q, axis=1) - 1).max() < 1e-12
        assert record.demand.min() >= 0 and record.demand.max() <= 1


@pytest.mark.parametrize("k", range(len(trajectories.KINDS)), ids=trajectories.KINDS)
def test_ways_are_followed(k):
    flights, records = fleet()
    way = plan(flights[k]).way
    ask = asked_of(way)
    part = slice(1200, 3000)
    assert np.linalg.norm(records[k].p - ask.p, axis=1)[part].max() < (2.5 if flights[k].trajectory["kind"] == "aggressive" else 1.2)
    assert records[k].p[-1, 2] > 0 and np.abs(records[k].v[-1]).max() < 0.01 and records[k].w[-1].max() < 0.01


def hover_demand(record, start, end):
    return record.demand[(record.time > start) & (record.time < end)].mean(axis=0)


def test_a_quad_in_steady_hover_gives_every_rotor_its_thrust_back():
    """Four rotors, four balances: after a loss each delivers what it did before, so the command rises by 1 / (1 - loss)."""
    record = record_flown(len(trajectories.KINDS))
    before, after = hover_demand(record, 15, 19.9), hover_demand(record, 27, 30)
    lift_max = [record.lift_max[(record.time > a) & (record.time < b)].mean() for a, b in ((15, 19.9), (27, 30))]
    expected = before * lift_max[0] / lift_max[1] / np.array([1, 1, 0.75, 1])
    assert after == pytest.approx(expected, rel=0.01)


def test_velocity_of_the_air_that_carries_a_vehicle():
    """Momentum: each rotor's thrust is the mass flow through it, rho A v, times what the air gains far below, 2 v."""
    table = {"airframe": {"frame": "hexa-x", "mass_kg": 3.0, "rotor_radius_m": 0.127, "payload_kg": 0.5}}
    v = induced_velocity(scenario.from_table(table))
    assert 6 * (1.225 * np.pi * 0.127**2 * v) * 2.0 * v == pytest.approx(3.0 * 9.80665)
    assert 5.0 < v < 6.5


def test_payload_is_carried_where_it_hangs():
    """Lever balance: sum T = m g and sum x T = 0 about the common centre of mass."""
    flights, records = fleet()
    craft = plan(flights[-1]).craft
    T = craft.thrust_max * (records[-1].w[1800:3000] ** 2).mean(axis=0)
    assert T.sum() == pytest.approx(craft.mass * G, rel=3e-3) and float(craft.mass) == pytest.approx(2.4)
    assert abs(craft.x @ T) < 2e-3 * craft.mass * G and abs(craft.y @ T) < 2e-3 * craft.mass * G


def test_dead_rotor_brings_a_quad_down():
    flights, records = fleet()
    for fault in (-3, -2):  # float, complete loss
        assert records[fault].flies[-1] == 0 and records[fault].w[-1].max() < 0.01
        crash = records[fault].time[np.argmax(records[fault].flies < 0.5)]
        assert 20.5 < crash < 25, flights[fault]


def test_stuck_is_what_it_was_and_ends():
    record = record_flown(len(trajectories.KINDS) + 3)
    held = (record.time > 20.1) & (record.time < 20.45)
    assert np.ptp(record.w[held][:, 2]) < 0.02 * record.w[held][:, 2].mean()
    assert record.flies[-1] == 1


def test_chipped_propeller_shakes():
    record = record_flown(len(trajectories.KINDS) + 1)
    assert record.shake[2500, 2] > 5 * record.shake[2500, 0] and record.shake[1500, 2] < 2 * record.shake[1500, 0]


def test_batch_is_one_by_one_and_seeds_repeat():
    flights, records = fleet()
    again = loop.fly(MULTIROTOR, plan(flights[1]), DURATION)
    same = loop.fly(MULTIROTOR, plan(flights[1]), DURATION)
    other = loop.fly(MULTIROTOR, plan(flights[1].with_seed(4)), DURATION)
    assert again.believed.max() > 0
    for name, a, b, c in zip(again._fields, turned(again), turned(same), records[1]):
        assert np.array_equal(a, b), name
        assert np.allclose(a, c, rtol=0, atol=1e-7), name
    assert np.abs(other.wind - again.wind).max() > 0.1


@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_each_flight_is_the_batchs(backend, monkeypatch):
    """As native code where there is a compiler, and without: there by the program that has flown the batch, with what that selects."""
    monkeypatch.setenv("ROTORWATCH_BACKEND", backend)
    flights, records = fleet()
    numbers = [plan(flights[k]) for k in (2, 1)]
    found = loop.fly_each(MULTIROTOR, numbers, DURATION, select=turned, size=len(flights))
    for k, record in zip((2, 1), found, strict=True):
        assert record.believed.max() < 0
        for name in ("time", "p", "q", "rates", "accel", "command", "theta", "volts", "flies", "believed"):
            assert getattr(record, name).shape == getattr(records[k], name).shape
            assert np.allclose(getattr(record, name), getattr(records[k], name), rtol=0, atol=1e-7), name


@pytest.mark.thorough
def test_single_precision_flies_the_same_way():
    flights, records = fleet()
    plans = loop.stack([plan(f) for f in flights[:2]])
    single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == np.float64 else a, plans)
    flown_ = loop.fly_many(MULTIROTOR, single, DURATION)
    assert all(a.dtype == np.float32 for a in flown_)
    for k in range(2):
        assert np.abs(record_of(flown_, k).p - records[k].p)[:3300].max() < 5e-3  # until the landing: contact is touchy


def test_bad_batches_and_rates():
    with pytest.raises(ConfigError, match="same number of rotors"):
        simulate_batch([asked(), asked("hexa-x")])
    with pytest.raises(ConfigError, match="at least one"):
        simulate_batch([])
    with pytest.raises(ConfigError, match="record_hz 150 must divide rate_hz 400"):
        loop.grid(10.0, 400.0, 150.0)
    with pytest.raises(ConfigError, match="same duration_s"):
        simulate_batch([asked(), asked(trajectory={"land": False}, duration_s=41.0)])
