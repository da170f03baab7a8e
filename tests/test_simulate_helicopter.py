"""The simulated helicopter: the plant it is made of, closed forms and laws, closed loop, faults, its log, and who finds what broke."""

import json
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner

import rotorwatch
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.logs import log_memory
from rotorwatch_lab.published import helicopter_log
from rotorwatch_lab.simulation import faults, rotation, scenario, simulate, simulate_batch
from rotorwatch_lab.simulation.helicopter import aircraft, dynamics
from rotorwatch_lab.simulation.rigid import Air, Body

jax = load_jax()
jnp = jax.numpy
DATA = airframes.paper("ruav-40kg")
STILL = Air(np.zeros(3), np.zeros(3), np.array(0.0))
U = np.array([0.5, 0.2, 0.55, 0.42])


def asked(**tables):
    craft = {"frame": "ruav-40kg", **tables.pop("airframe", {})}
    return scenario.from_table({"duration_s": 24.0, "airframe": craft, **tables})


@cache
def calm():
    """An eight in a light breeze, tail jammed from 15 s on."""
    jam = {"kind": "stuck", "actuator": "tail", "onset_s": 15.0, "level": 0.22}
    return simulate(asked(trajectory={"kind": "figure-eight"}, wind={"speed_m_s": 1.0}, faults=[jam]))


def in_vacuum(**changes):
    thin = {"air_density": 1e-14, "hub_stiffness": 0.0, "drag": [1e-14] * 3, "damping": [1e-14] * 3}
    return dynamics.plant({**DATA, **thin, **changes})


def body_of(p=(0, 0, -50), v=(0, 0, 0), q=(1, 0, 0, 0), omega=(0, 0, 0)):
    q = np.array(q, float)
    return Body(*(np.array(a, float) for a in (p, v, q / np.linalg.norm(q), omega)))


def flown(system, body, command, steps=400, dt=1 / 400, air=STILL, at=None):
    """Bodies after each step; the actuators start at `at` (default: where they are driven to)."""

    @jax.jit
    def run(body, at):
        def one(state, _):
            body, U, _ = dynamics.step(system, *state, command, 0.03, air, dt)
            return (body, U), (body, U)

        return jax.lax.scan(one, (body, at), None, length=steps)[1]

    return jax.tree.map(np.asarray, run(body, command if at is None else at))


# -- the plant and the laws ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_still_air_is_the_published_plant(seed):
    """Body accelerations at any attitude are those of rotorwatch_lab/systems/helicopter.py, whose roll and pitch are Euler angles."""
    rng = np.random.default_rng(seed)
    system = dynamics.plant(DATA)
    roll, pitch, yaw = rng.uniform(-1.2, 1.2, 3)
    half = 0.5 * np.array([roll, pitch, yaw])
    (c_r, c_p, c_y), (s_r, s_p, s_y) = np.cos(half), np.sin(half)
    q = rotation.multiply(np.array([c_y, 0, 0, s_y]), rotation.multiply(np.array([c_p, 0, s_p, 0]), np.array([c_r, s_r, 0, 0])))
    v, omega, at = rng.normal(0, 3, 3), rng.normal(0, 0.5, 3), rng.uniform(0.1, 0.9, 4)
    R = rotation.axes(q)
    slope, _ = dynamics.derivative(system, Body(np.zeros(3), rotation.to_world(R, v), q, omega), at, STILL)
    wanted = system.derivative(jnp.concatenate([v, omega]), jnp.concatenate([at, jnp.array([roll, pitch])]), np.zeros(8))
    v_dot = rotation.to_body(R, slope.v) - np.cross(omega, v)
    assert np.allclose(np.concatenate([v_dot, slope.omega]), wanted, rtol=0, atol=1e-11)


def energy(system, body):
    turning = 0.5 * (system.I * body.omega**2).sum(axis=1)
    return 0.5 * system.m * (body.v**2).sum(axis=1) + turning - system.m * G0 * body.p[:, 2]


def spin(system, body):
    """Angular momentum in world axes (T, 3)."""
    return np.array([rotation.to_world(rotation.axes(q), system.I * w) for q, w in zip(body.q, body.omega, strict=True)])


def vacuum_law():
    """In a vacuum energy and angular momentum stay, and the centre of mass falls along a parabola."""
    system = in_vacuum()
    body, _ = flown(system, body_of(v=(3, -2, -5), q=(1, 0.2, -0.3, 0.4), omega=(1.0, 2.0, -0.7)), U)
    t = np.arange(1, 401)[:, None] / 400
    fall = [0, 0, -50] + np.array([3, -2, -5]) * t + 0.5 * G0 * t**2 * [0, 0, 1]
    E, L = energy(system, body), spin(system, body)
    return max(np.abs(E - E[0]).max() / E[0], np.abs(L - L[0]).max(), np.abs(body.p - fall).max()) < 1e-8


def damping_law():
    """With nothing but damping about the mast the rate of yaw decays exponentially."""
    system = in_vacuum(damping=[1e-14, 1e-14, 2.0])
    body, _ = flown(system, body_of(omega=(0, 0, 1.5)), U)
    return np.allclose(body.omega[:, 2], 1.5 * np.exp(-2.0 / system.I[2] * np.arange(1, 401) / 400), rtol=0, atol=1e-9)


def drift_law():
    """Wind and motion are relative: carried by a steady wind, a helicopter flies as in still air, and is blown along."""
    system, wind = dynamics.plant(DATA), np.array([4.0, -3.0, 0.5])
    still, _ = flown(system, body_of(v=(1, 0.5, -1), omega=(0.1, 0, -0.2)), U)
    blown, _ = flown(system, body_of(v=wind + np.array([1, 0.5, -1]), omega=(0.1, 0, -0.2)), U, air=STILL._replace(wind=wind))
    along = wind * np.arange(1, 401)[:, None] / 400
    return np.allclose(blown.p - along, still.p, rtol=0, atol=1e-9) and np.allclose(blown.q, still.q, rtol=0, atol=1e-10)


def climb_law():
    """Straight up at a constant speed the main rotor carries weight and drag: T of momentum theory."""
    system = dynamics.plant(DATA)
    speed, at = -2.0, np.array([0.6, 0.2, 0.5, 0.5])
    slope, force = dynamics.derivative(system, body_of(v=(0, 0, speed)), at, STILL)
    pitch = system.low[0] + (system.high[0] - system.low[0]) * at[0]
    T, _ = system.main.thrust_and_torque(pitch, -speed)
    return abs(force[2] + (T + system.drag[2] * speed) / system.m) < 1e-12 and abs(slope.v[2] - force[2] - G0) < 1e-12


def lag_law():
    """The actuators follow like a first-order lag, exactly; one Runge-Kutta step is of fourth order."""
    system, start = dynamics.plant(DATA), body_of(v=(2, 1, 0), omega=(0.3, -0.2, 0.4))
    ends = []
    for steps in (20, 40, 80):
        body, at = flown(system, start, U, steps, 0.5 / steps, at=U - 0.1)
        if not np.allclose(at[-1], U - 0.1 * np.exp(-0.5 / 0.03), rtol=0, atol=1e-12):
            return False
        ends.append(np.concatenate([body.p[-1], body.q[-1], body.omega[-1]]))
    coarse, fine = (np.abs(ends[k + 1] - ends[k]).max() for k in (0, 1))
    return 9.0 < coarse / fine < 30.0


LAWS = {f.__name__: f for f in (vacuum_law, damping_law, drift_law, climb_law, lag_law)}


@pytest.mark.parametrize("law", LAWS)
def test_law(law):
    assert LAWS[law]()


def _planted(name, monkeypatch):
    derivative, step = dynamics.derivative, dynamics.step
    if name == "vacuum_law":
        monkeypatch.setattr(dynamics.rotation, "cross", lambda a, b: 0.99 * jnp.cross(a, b))
    if name == "damping_law":
        monkeypatch.setattr(dynamics, "derivative", lambda s, b, at, air: derivative(s, b._replace(omega=1.01 * b.omega), at, air))
    if name == "drift_law":
        monkeypatch.setattr(dynamics, "derivative", lambda s, b, at, air: derivative(s, b, at, air._replace(wind=0.98 * air.wind)))
    if name == "climb_law":
        monkeypatch.setattr(dynamics, "derivative", lambda s, b, at, air: derivative(s, b, 0.999 * at, air))
    if name == "lag_law":
        monkeypatch.setattr(dynamics, "step", lambda *a: step(*a[:4], 1.02 * a[4], *a[5:]))


@pytest.mark.parametrize("law", LAWS)
def test_law_notices(law, monkeypatch):
    _planted(law, monkeypatch)
    assert not LAWS[law]()


def test_trim_holds():
    system = dynamics.plant(DATA)
    at, (roll, pitch) = dynamics.trim(system)
    assert np.allclose(at, DATA["trim"], atol=2e-4)  # the airframe's file says the same, rounded
    q = aircraft.plan(asked()).pilot.q
    slope, force = dynamics.derivative(system, body_of(q=q), at, STILL)
    assert np.abs(slope.v).max() < 1e-9 and np.abs(slope.omega).max() < 1e-9
    assert np.linalg.norm(force) == pytest.approx(G0, abs=1e-9) and roll > 0.05 > abs(pitch)
    calm = simulate(asked(sensors={"gyro_noise": 0.0})).record
    assert np.abs(calm.p - [0, 0, -10]).max() < 1e-6 and np.abs(calm.command - at).max() < 1e-6


# -- closed loop and faults ------------------------------------------------------------------------------------------


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("kind", scenario.HELICOPTER_WAYS)
def test_ways_are_followed(kind):
    made = simulate(asked(trajectory={"kind": kind, "speed_m_s": 2.0}, wind={"speed_m_s": 4.0, "from_deg": 70.0}))
    way = made.plan.way
    t = jnp.asarray(made.record.time)
    from rotorwatch_lab.simulation import trajectories

    wanted = np.asarray(jax.vmap(trajectories._path, in_axes=(None, 0))(way, t))
    off = np.linalg.norm(made.record.p + np.array([0, 0, 10]) - wanted[:, :3], axis=1)
    assert np.sqrt(np.mean(off[800:] ** 2)) < 1.6 and off.max() < 4.0 and made.record.flies.all()
    level = 1 - 2 * (made.record.q[:, 1] ** 2 + made.record.q[:, 2] ** 2)
    assert level.min() > np.cos(np.radians(30))
    if kind == "yaw":
        heading = np.unwrap(np.arctan2(2 * (made.record.q[:, 0] * made.record.q[:, 3]), 1 - 2 * made.record.q[:, 3] ** 2))
        assert np.abs(heading - wanted[:, 3])[1000:].max() < 0.35 and np.ptp(wanted[:, 3]) > 0.8


def test_a_payload_asks_for_collective():
    bare, loaded = (simulate(asked(airframe={"payload_kg": kg})).record for kg in (0.0, 4.0))
    change = loaded.command[-1, 0] - bare.command[-1, 0]
    wanted = dynamics.trim(dynamics.plant(DATA, 44.0))[0][0] - dynamics.trim(dynamics.plant(DATA))[0][0]
    assert wanted > 0.02 and change == pytest.approx(wanted, abs=2e-3)
    with pytest.raises(ConfigError, match=r"payload_kg: the helicopter cannot hover with a mass of 120 kg"):
        simulate(asked(airframe={"payload_kg": 80.0}))


def test_same_seed_same_flight():
    first, again, other = (simulate(asked(seed=s, wind={"speed_m_s": 3.0})).record for s in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert np.abs(first.p - other.p).max() > 1e-3


FAULTS = {
    "loss": ({"kind": "loss", "strength": 0.3}, (0.3, 0.0)),
    "complete loss": ({"kind": "complete loss"}, (1.0, 0.0)),
    "bias": ({"kind": "bias", "strength": -0.1}, (0.0, -0.1)),
    "stuck": ({"kind": "stuck", "level": 0.4}, (1.0, 0.4)),
    "saturated": ({"kind": "saturated"}, (1.0, 1.0)),
}


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("k", range(4))
def test_faults_are_the_plants(kind, k):
    """theta is what the plant's actuators make of it: U = (1 - loss) u + bias, from the onset on."""
    fields, (loss, bias) = FAULTS[kind]
    one = asked(faults=[{**fields, "actuator": scenario.ACTUATORS[k], "onset_s": 10.0}])
    broken, held = aircraft.plan(one).faults, np.full(4, 0.33)
    before, after = (aircraft.theta_of(broken, faults.strength(broken, t), held) for t in (9.99, 10.0))
    assert not np.asarray(before).any()
    wanted = np.zeros(8)
    wanted[k], wanted[4 + k] = loss, bias
    assert np.allclose(after, wanted, rtol=0, atol=1e-15)


def test_a_jammed_actuator_stays_where_it_was():
    stuck = {"kind": "stuck", "actuator": "lateral", "onset_s": 12.0, "end_s": 12.6}
    r = simulate(asked(trajectory={"kind": "figure-eight"}, faults=[stuck])).record
    jammed = (r.time > 12.0) & (r.time <= 12.6)
    assert np.ptp(r.actuators[jammed, 3]) < 1e-12 and np.ptp(r.command[jammed, 3]) > 1e-3
    assert np.allclose(r.theta[jammed, 7], r.actuators[jammed, 3], atol=1e-12)
    assert np.ptp(r.actuators[r.time > 12.7, 3]) > 1e-3 and not r.theta[r.time > 12.7].any()


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize(("fault", "axis"), [("collective", 2), ("tail", 5), ("longitudinal", 4), ("lateral", 3)])
def test_a_fault_shows_in_its_own_motion(fault, axis):
    """In the 0.3 s after a displacement the motion differs first along the actuator's own axis (v down; p, q, r)."""
    hurt = [{"kind": "bias", "actuator": fault, "onset_s": 10.0, "strength": 0.1}]
    sound, broken = (simulate(asked(faults=rows)).record for rows in ([], hurt))
    early, then = sound.time <= 10.0, np.searchsorted(sound.time, 10.15)
    assert np.array_equal(sound.p[early], broken.p[early])
    change = np.abs(np.concatenate([broken.v - sound.v, broken.omega - sound.omega], axis=1))[then]
    assert change[axis] > 0.03
    assert change[axis] == change[3:].max() if axis > 2 else change[2] == change[:3].max()


def test_two_faults_and_the_ground():
    hurt = [{"kind": k, "actuator": a, "onset_s": 10.0} for k, a in (("saturated", "longitudinal"), ("complete loss", "collective"))]
    made = simulate(asked(faults=hurt))
    down = np.flatnonzero(made.record.flies < 0.5)
    assert down.size and np.isfinite(made.record.p).all()
    assert np.ptp(made.record.p[down], axis=0).max() == 0.0 and abs(made.record.p[-1, 2]) < 1.0


# -- the log and the scenario ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_the_table_comes_back(tmp_path, ending):
    if ending == ".parquet":
        pytest.importorskip("pyarrow")
    made = calm()
    paths = made.write(tmp_path / f"flight{ending}")
    assert [p.name for p in paths] == [f"flight{ending}", "flight.truth.json", "flight.truth.csv"]
    back, here = rotorwatch.read(paths[0]), made.flight
    assert set(back.signals) == {"motors", "rates", "gyro", "accel", "attitude", "velocity", "position"}
    for name, signal in back.signals.items():
        assert np.allclose(signal.values, here.signals[name].values, rtol=1e-6, atol=1e-7)
        assert np.median(np.diff(signal.time)) == pytest.approx(0.02, abs=1e-6)
    about = json.loads(paths[1].read_text())
    assert about["faults"][0]["actuator"] == "tail" and about["last_theta"]["loss_tail"] == 1.0
    assert about["last_theta"]["bias_tail"] == pytest.approx(0.22)
    truth = np.genfromtxt(paths[2], delimiter=",", names=True)
    assert truth["loss_tail"][-1] == 1.0 and truth["loss_tail"][0] == 0.0 and truth["actuator_tail"][-1] == pytest.approx(0.22)


def test_the_log_holds_no_truth():
    """Commands, not where the actuators are: of a jam only the motion tells."""
    made = calm()
    motors = made.flight.signals["motors"]
    late = motors.time > 16.0
    assert np.ptp(motors.values[late, 1]) > 0.05
    assert all(log_memory.known_column(name) for name in loop_columns(made))


def loop_columns(made):
    from rotorwatch_lab.simulation.helicopter import table

    return table.columns(made.scenario, made.plan, made.record)


def test_sensors_err_as_asked():
    quiet = {"gyro_noise": 0.0, "gyro_bias": 0.0, "accel_noise": 0.0, "accel_bias": 0.0, "vibration": 0.0}
    made = simulate(asked(sensors=quiet, logging={"profile": "fast"}))
    table, r = loop_columns(made), made.record
    assert np.diff(table["time_s"]) == pytest.approx(0.01)
    assert np.array_equal(table["gyro_x_rad_s"], r.rates[:, 0]) and np.array_equal(table["accel_z_m_s2"], r.accel[:, 2])
    assert np.std(table["velocity_n_m_s"] - r.v[:, 0]) == pytest.approx(0.03, rel=0.1)
    shaken = loop_columns(simulate(asked(sensors={**quiet, "vibration": 2.0}, logging={"profile": "fast"})))
    assert np.std(shaken["accel_x_m_s2"] - table["accel_x_m_s2"]) == pytest.approx(2.0 / np.sqrt(2), rel=0.05)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"airframe": {"mass_kg": 3.0}}, "airframe.mass_kg is no field of a helicopter; it has frame, lag_s, payload_kg"),
        ({"battery": {"cells": 3}}, "battery.cells is no field of a helicopter; it has none"),
        ({"autopilot": "px4"}, "autopilot is no field of a helicopter"),
        ({"trajectory": {"land": True}}, "trajectory.land is no field of a helicopter"),
        ({"trajectory": {"kind": "aggressive"}}, "trajectory.kind: a helicopter flies hover, square"),
        ({"trajectory": {"take_off_s": 30.0}}, "trajectory.take_off_s is 30, not before the end of the flight at 24"),
        ({"logging": {"profile": "full"}, "rate_hz": 300.0}, "rate_hz must be a multiple of 200, the rate of the record, not 300"),
        ({"logging": {"esc": True}}, "logging.esc is no field"),
        ({"faults": [{"kind": "loss", "rotor": 2, "onset_s": 9.0, "strength": 0.1}]}, r"faults\[1\].rotor: .* named by actuator"),
        ({"faults": [{"kind": "loss", "onset_s": 9.0, "strength": 0.1}]}, r"faults\[1\].actuator is missing"),
        ({"faults": [{"kind": "loss", "actuator": "rudder", "onset_s": 9.0}]}, r"faults\[1\].actuator must be one of collective"),
        ({"faults": [{"kind": "float", "actuator": "tail", "onset_s": 9.0}]}, r"faults\[1\].kind: a helicopter's actuators suffer"),
        ({"faults": [{"kind": "loss", "actuator": "tail", "onset_s": 9.0}]}, r"faults\[1\].strength is missing"),
    ],
)  # fmt: skip
def test_one_sentence_names_the_field(changes, says):
    with pytest.raises(ConfigError, match=says) as why:
        asked(**changes)
    assert "\n" not in str(why.value)


def test_a_multirotor_has_no_actuators():
    fault = {"kind": "loss", "actuator": "tail", "onset_s": 20.0, "strength": 0.1}
    with pytest.raises(ConfigError, match=r"faults\[1\].actuator: what breaks on a multirotor is named by rotor"):
        scenario.from_table({"airframe": {"frame": "quad-x"}, "faults": [fault]})
    with pytest.raises(ConfigError, match="is a helicopter; here only multirotors fly"):
        simulate_batch([asked()])


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"flight.bin: a helicopter's flight is a .csv or .parquet table"):
        calm().write(tmp_path / "flight.bin")


# -- who finds it ----------------------------------------------------------------------------------------------------


def test_every_method_for_two_unknowns_an_actuator_can_be_named():
    for name in ("ekf", "ukf", "adaptive_ekf", "aekf", "aukf", "esmf", "aesmf"):
        assert helicopter_log.method(name, "ruav-40kg", 0.02).system.n_theta == 8
    for name, says in (("nonsense", "no estimator called"), ("default", "made for multirotors; name a published one")):
        with pytest.raises(ConfigError, match=says):
            helicopter_log.method(name, "ruav-40kg", 0.02)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", ["ekf", "adaptive_ekf", "aukf", "aesmf"])
def test_estimators_find_the_jam(name):
    """Nothing before the onset, the jammed tail soon after it and nothing else, its displacement at the end."""
    found = helicopter_log.estimate(calm().flight, "ruav-40kg", name)
    said = helicopter_log.summary(found)
    assert 15.0 < said["tail"]["found_s"] < 18.0
    assert all(said[other]["found_s"] is None for other in ("collective", "longitudinal", "lateral"))
    truth = 0.22 - calm().record.command[-1, 1]
    assert said["tail"]["deviation"] == pytest.approx(truth, abs=0.05)
    before = found.table.time < 14.9
    assert np.abs(found.deviation[before & (found.table.time > 3.0)]).max() < 0.05


def test_steady_wind_is_no_fault():
    """3 m/s and its gusts move the estimates, but what was there from the start does not count; a log too short to tell is refused."""
    made = simulate(asked(trajectory={"kind": "figure-eight"}, wind={"speed_m_s": 3.0, "from_deg": 40.0}))
    found = helicopter_log.estimate(made.flight, "ruav-40kg", "ekf")
    assert np.isnan(found.found).all()
    early = {k: v[:90] for k, v in loop_columns(made).items()}
    with pytest.raises(LogError, match="shorter than the 6 s"):
        helicopter_log.estimate(log_memory.from_arrays(early), "ruav-40kg", "ekf")


def test_the_table_of_the_plant():
    made = calm()
    table = helicopter_log.rows(made.flight)
    r = made.record
    k = np.searchsorted(r.time, table.time[400] + r.time[1])
    q = r.q[k]
    assert np.allclose(table.y[400, :3], rotation.to_body(rotation.axes(q), r.v[k]), atol=0.15)
    assert np.allclose(table.u[400, :4], r.command[k - 2], atol=0.05) and table.valid.all()
    with pytest.raises(LogError, match="lacks velocity"):
        helicopter_log.rows(log_memory.from_arrays({"time_s": [0, 1, 2], **{f"motor_{k}": [0.5] * 3 for k in (1, 2, 3, 4)}}))
    with pytest.raises(ConfigError, match="no helicopter called 'f450'; known are ruav-40kg"):
        helicopter_log.estimate(made.flight, "f450", "ekf")


def test_missing_samples_do_no_harm():
    made = calm()
    columns = {k: v.copy() for k, v in loop_columns(made).items()}
    for axis in "ned":
        columns[f"velocity_{axis}_m_s"][100:400:3] = np.nan
    columns["motor_2"][200:205] = np.nan
    found = helicopter_log.estimate(log_memory.from_arrays(columns), "ruav-40kg", "ekf")
    assert np.isfinite(found.theta).all() and 15.0 < found.found[1] < 18.0


def test_the_commands(tmp_path):
    file = tmp_path / "jam.toml"
    file.write_text(
        'duration_s = 20.0\n[airframe]\nframe = "ruav-40kg"\n[trajectory]\nkind = "figure-eight"\n'
        '[[faults]]\nkind = "bias"\nactuator = "lateral"\nonset_s = 12.0\nstrength = 0.1\n'
    )
    done = CliRunner().invoke(cli.cli, ["simulate", str(file), "-o", str(tmp_path / "out")], catch_exceptions=False)
    assert done.exit_code == 0 and (tmp_path / "out.csv").exists() and (tmp_path / "out.truth.csv").exists()
    command = ["estimate", str(tmp_path / "out.csv"), "--airframe", "ruav-40kg", "--estimator", "ekf"]
    done = CliRunner().invoke(cli.cli, command, catch_exceptions=False)
    assert "lateral       FAULTY" in done.output and "tail          sound" in done.output
    said = json.loads(CliRunner().invoke(cli.cli, [*command, "--json"], catch_exceptions=False).output)
    assert said["methods"][0]["actuators"]["lateral"]["deviation"] == pytest.approx(0.1, abs=0.02)
    refused = CliRunner().invoke(cli.cli, ["simulate", str(file), "-o", str(tmp_path / "out.ulg")])
    assert "ends in .csv or .parquet" in str(refused.exception)
