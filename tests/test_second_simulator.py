"""The bridge from our closed loop to RotorPy's equations of motion (benchmarks/second_simulator.py)."""

from pathlib import Path

import numpy as np
import pytest

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.control.allocation import rows
from rotorwatch_lab.simulation import dynamics, plan, prepare, rigid, scenario
from script_files import loaded

pytest.importorskip("rotorpy")
HERE = Path(__file__).resolve().parents[1] / "benchmarks" / "second_simulator.py"


@pytest.fixture(scope="module")
def second():
    return loaded(HERE)


@pytest.mark.parametrize("frame, lower", [("hexa-x", 1.0), ("y6", 1.0), ("y6", 0.85)])
def test_one_step_is_ours_where_the_models_agree(second, frame, lower, monkeypatch):
    """A leaning, turning vehicle in wind, rotors of different strength speeding up; without what RotorPy does not know."""
    monkeypatch.setattr(dynamics, "G0", 9.81)  # as they round it
    airframe = {"frame": frame, "lower_rotor": lower, "hub_height_m": 0.05, "ground_effect": False}
    craft = plan(scenario.from_table({"airframe": airframe})).craft._replace(rotor_momentum=np.array(0.0))
    if lower < 1.0:  # a weaker rotor is a slower one there, which other air damps less
        craft = craft._replace(k_d=np.array(0.0), k_z=np.array(0.0))
    rng = np.random.default_rng(1)
    n, dt = len(craft.x), 0.005
    q = np.array([0.9, 0.2, -0.15, 0.3])
    body = rigid.Body(np.array([1.0, 2.0, -9.0]), rng.normal(size=3), q / np.linalg.norm(q), rng.normal(size=3))
    w, reported, wind = rng.uniform(0.4, 0.9, n), rng.uniform(0.4, 0.9, n), np.array([3.0, -1.0, 0.5])
    air = rigid.Air(wind, np.zeros(3), np.zeros(()))
    ours, _, force = dynamics.step(craft, body, w, reported, np.full(n, craft.lag), air, np.zeros(n), dt)
    vehicle = second.Vehicle(*[np.asarray(getattr(craft, name), float) for name in second.NUMBERS])
    theirs = vehicle.step(*body, w, reported, wind, np.zeros(n), dt)
    np.testing.assert_allclose(theirs[:13], np.concatenate([np.asarray(a) for a in ours]), rtol=0, atol=2e-5)
    np.testing.assert_allclose(theirs[13:], force, rtol=0, atol=0.02)
    assert np.abs(np.asarray(force)[2]) > 1.0


def test_flights_side_by_side_are_moved_by_theirs_above_the_ground(second):
    """Two flights with the batch as the last axis: one stands on the ground, where ours is taken, one hovers."""
    jax = load_jax()
    asked = scenario.from_table({"airframe": {"frame": "hexa-x"}})
    numbers, n, dt = plan(asked), 6, 0.005
    level = np.array([1.0, 0.0, 0.0, 0.0])
    bodies = [rigid.Body(np.array([0.0, 0.0, z]), np.zeros(3), level, np.zeros(3)) for z in (0.0, -5.0)]
    air = rigid.Air(np.zeros(3), np.zeros(3), np.ones(()))
    w, theta = np.full(n, 0.7), np.array([0.0, 0.4, 0, 0, 0, 0])
    each = [(numbers, body, w, w, np.full(n, 0.03), air, theta) for body in bodies]
    aircraft = second.Elsewhere(rows(prepare.vehicle(asked)))
    move = jax.vmap(lambda given: aircraft.moved(*given, dt), in_axes=-1, out_axes=-1)
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(a) for a in leaves], axis=-1), *each)
    body, _, force = jax.tree.map(np.asarray, move(stacked))
    low, _, low_force = dynamics.step(numbers.craft, *each[0][1:], dt)
    np.testing.assert_allclose(body.p[:, 0], low.p, atol=1e-12)
    np.testing.assert_allclose(force[:, 0], low_force, atol=1e-12)
    vehicle = second.Vehicle(*[np.asarray(getattr(numbers.craft, name), float) for name in second.NUMBERS])
    high = vehicle.step(*bodies[1], w, w, np.zeros(3), theta, dt)
    np.testing.assert_allclose(np.concatenate([body.v[:, 1], body.omega[:, 1], force[:, 1]]), high[[3, 4, 5, 10, 11, 12, 13, 14, 15]])
    # A rotor with a loss of 40 %: the vehicle begins to roll and pitch to its side.
    assert np.abs(high[10:12]).max() > 1e-3
    assert second.STEPS.made == 1
