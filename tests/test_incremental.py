"""INDI: flights as good as with gains and integrators, losses and displaced payloads answered without knowing of them."""

import numpy as np
import pytest

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.control.allocation import rows
from rotorwatch_lab.simulation import incremental, loop, prepare, reconfigured, record_of, scenario, trajectories

jax = load_jax()
jnp = jax.numpy
ONSET_S = 14.0
GONE = {"faults": [{"kind": "complete loss", "rotor": 2, "onset_s": ONSET_S}]}
WAYS = {
    "hover": {},
    "square": {"trajectory": {"kind": "square", "speed_m_s": 3.0}},
    "wind": {"wind": {"speed_m_s": 8.0}},
    "payload": {"airframe": {"payload_kg": 0.5, "payload_at_m": [0.1, 0.08, 0.1]}},
    "loss": {"faults": [{"kind": "loss", "rotor": 2, "onset_s": ONSET_S, "strength": 0.6}]},
    "total": GONE,
    "reported": GONE,
}
USUAL = ("hover", "loss", "total", "reported")  # the others run with --thorough alone


def asked(way, control):
    table = {"seed": 3, "duration_s": 22.0, "rate_hz": 200, "control": control, **WAYS[way]}
    table["airframe"] = {"frame": "hexa-x", "thrust_to_weight": 2.5, **table.get("airframe", {})}
    table["trajectory"] = {"land": False, "altitude_m": 4.0, **table.get("trajectory", {})}
    return scenario.from_table({"wind": {"speed_m_s": 2.0}, **table})


@pytest.fixture(scope="module")
def flown(amount):
    """For each flight: error of position [m], tilt [deg] and error of the body rates [rad/s], from 11 s on."""
    made = [(way, control) for way in amount(USUAL, WAYS) for control in ("pid", "indi")]
    scenarios = [asked(*flight) for flight in made]
    e = np.array([1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    entries = [[reconfigured.entry(6, ONSET_S + 0.1, e)] if way == "reported" else [] for way, _ in made]
    plans = [prepare.plan(s)._replace(schedule=reconfigured.schedule(6, m, 1)) for s, m in zip(scenarios, entries, strict=True)]
    craft, first = reconfigured.Reconfigured(rows(prepare.vehicle(scenarios[0]))), scenarios[0]
    records = loop.fly_many(craft, loop.stack(plans), first.duration_s, first.rate_hz, first.record_hz)
    found = {}
    for k, flight in enumerate(made):
        r = record_of(records, k)
        ask = np.asarray(trajectories.table(plans[k].way, len(r.time), r.time[1] - r.time[0]).p)
        late = r.time > 11.0
        tilt = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (r.q[:, 1] ** 2 + r.q[:, 2] ** 2), -1.0, 1.0)))
        found[flight] = np.linalg.norm(r.p - ask, axis=1)[late], tilt[late], (r.omega - r.rates_setpoint)[late]
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("way", ["hover", "square", "wind", "payload"])
def test_it_flies_as_well_as_gains_and_integrators(flown, way):
    (off, tilt, rates), (off_pid, tilt_pid, rates_pid) = flown[way, "indi"], flown[way, "pid"]
    assert np.sqrt((off**2).mean()) < 1.05 * np.sqrt((off_pid**2).mean()) + 0.01
    assert tilt.max() < 1.05 * tilt_pid.max() + 0.5
    assert (rates**2).mean() < 1.1 * (rates_pid**2).mean() + 1e-4


def test_a_loss_is_answered_before_anybody_knows_of_it(flown):
    """60 % of a rotor: what the gyro shows is made up for, so that the vehicle leans and turns less than with gains and integrators."""
    (_, tilt, rates), (_, tilt_pid, rates_pid) = flown["loss", "indi"], flown["loss", "pid"]
    assert tilt.max() < 0.6 * tilt_pid.max() and np.abs(rates).max() < 0.6 * np.abs(rates_pid).max()


def test_without_a_rotor_it_stays_where_somebody_says_so(flown):
    off, tilt, _ = flown["reported", "indi"]
    assert off[-1] < 1.0 and tilt.max() < 40.0
    off, _, _ = flown["total", "indi"]
    assert off.max() > 3.0  # yaw and height cannot both be had with a rotor that gives nothing and is reckoned with


def test_what_the_rotors_do_is_no_disturbance():
    """Rotors that do what they are commanded, with their lag and their momentum, and nothing else: nothing is made up for."""
    s = asked("hover", "indi")
    plan = prepare.plan(s)
    known, dt, cut = plan.pilot.inversion, 1e-4, float(plan.pilot.gyro_cut)
    n = known.turns.shape[1]

    def step(carry, k):
        memory, f, gyro = carry
        demand = 0.4 + 0.1 * jnp.sin(2 * np.pi * (2.0 + jnp.arange(n)) * k * dt)
        _, memory = incremental.control(known, memory, jnp.zeros(3), gyro, f, jnp.ones(n), 1.0, cut, dt)
        slope = (demand - f) / known.lag
        yaw = jnp.array([0.0, 0.0, 1.0]) * known.lead * (known.turns[2] @ slope)
        seen = cut * (memory.fast - memory.slow), memory.second
        return (memory._replace(demand=demand), f + dt * slope, gyro + dt * (known.turns @ f + yaw)), seen

    start = (incremental.rest(n, float), jnp.full(n, 0.4), jnp.zeros(3))
    seen, reported = (np.asarray(a)[1000:] for a in jax.lax.scan(step, start, jnp.arange(4000))[1])
    assert np.abs(seen).max(axis=0).min() > 0.05
    assert np.abs(seen - reported).max() < 0.02 * np.abs(seen).max()


def test_the_numbers_are_those_of_the_vehicle():
    """Full control in one channel turns as fast as thrusts, arms and inertia say; rotors' momentum and drag give the lead."""
    s = asked("hover", "indi")
    plan, known = prepare.plan(s), prepare.plan(s).pilot.inversion
    craft, mixer = plan.craft, plan.pilot.mixer
    turns = np.stack([-craft.y, craft.x, craft.drag_ratio * craft.spin]) * craft.thrust_max / np.diag(craft.J)[:, None]
    np.testing.assert_allclose(turns @ mixer[:, :3] @ known.steer, np.eye(3), atol=1e-9)
    w = np.sqrt(craft.mass * G0 / craft.thrust_max.sum())
    momentum = craft.rotor_momentum / (2.0 * w * craft.thrust_max[0] * craft.drag_ratio)
    assert known.lead == pytest.approx(momentum) and known.used == 1.0
    assert prepare.plan(asked("hover", "pid")).pilot.inversion.used == 0.0
