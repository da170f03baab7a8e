"""The bridge from our closed loop to RotorPy's equations of motion (benchmarks/second_simulator.py)."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from rotorwatch.simulation import dynamics, plan, rigid, scenario

pytest.importorskip("rotorpy")
HERE = Path(__file__).resolve().parents[1] / "benchmarks" / "second_simulator.py"


@pytest.fixture(scope="module")
def second():
    spec = importlib.util.spec_from_file_location("second_simulator", HERE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("frame", ["hexa-x", "y6"])
def test_one_step_is_ours_where_the_models_agree(second, frame, monkeypatch):
    """A leaning, turning vehicle in wind, rotors of different strength speeding up; without what RotorPy does not know."""
    monkeypatch.setattr(dynamics, "G0", 9.81)  # as they round it
    asked = scenario.from_table({"airframe": {"frame": frame, "hub_height_m": 0.05, "ground_effect": False}})
    craft = plan(asked).craft._replace(rotor_momentum=np.array(0.0))
    rng = np.random.default_rng(1)
    n, dt = len(craft.x), 0.005
    q = np.array([0.9, 0.2, -0.15, 0.3])
    body = rigid.Body(np.array([1.0, 2.0, -9.0]), rng.normal(size=3), q / np.linalg.norm(q), rng.normal(size=3))
    w, told, wind = rng.uniform(0.4, 0.9, n), rng.uniform(0.4, 0.9, n), np.array([3.0, -1.0, 0.5])
    air = rigid.Air(wind, np.zeros(3), np.zeros(()))
    ours, _, force = dynamics.step(craft, body, w, told, np.full(n, craft.lag), air, np.zeros(n), dt)
    vehicle = second.Vehicle(*[np.asarray(getattr(craft, name), float) for name in second.NUMBERS])
    theirs = vehicle.step(*body, w, told, wind, np.zeros(n), dt)
    np.testing.assert_allclose(theirs[:13], np.concatenate([np.asarray(a) for a in ours]), rtol=0, atol=1e-4)
    np.testing.assert_allclose(theirs[13:], force, rtol=0, atol=0.02)
    assert np.abs(np.asarray(force)[2]) > 1.0
