"""float64 from the first plant or estimator on, whoever imported JAX before, and whatever was traced before that."""

import subprocess
import sys

import pytest

from rotorwatch.base import discovery

PLANT = """
import sys
import numpy as np
from rotorwatch import airframes
from rotorwatch_lab.systems.rate_dynamics import RateDynamics
assert "jax" not in sys.modules  # as for those who only diagnose
plant = RateDynamics.of(airframes.paper("niermeyer-hexa"))
x, u, theta, y = np.full(3, 0.1), np.full(6, 0.36), np.zeros(6), np.zeros(4)
"""
OWN = """
import numpy as np

class Own:
    name, n_x, n_u, n_theta, n_y, x0, P0 = "own", 1, 1, 1, 1, np.zeros(1), np.eye(1)
    def f(self, x, u, theta, dt): return x + dt * (u * (1 - theta) - x)
    def h(self, x, u, theta): return 1.0 * x
    def Q(self, dt): return 0.01 * dt * np.eye(1)
    def R(self, u): return np.array([1e-4])
"""


def last_line(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_a_plant_computes_in_float64_before_there_is_an_estimator_and_can_be_run_by_one_then():
    code = """
before = plant.f(x, u, theta, 0.01).dtype
import jax
f, h = jax.jit(plant.f), jax.jit(plant.h)
before = before, f(x, u, theta, 0.01).dtype, h(x, u, theta).dtype
from rotorwatch_lab.estimators.ekf import EKF
import rotorwatch
_, out = rotorwatch.run(EKF(plant, 0.01), u[None], y[None])
print(*before, out.x.dtype)
"""
    assert last_line(PLANT + code) == "float64 float64 float64 float64"


def test_ones_own_plant_traced_in_float32_before_does_not_spoil_what_comes_after():
    code = """
import jax
plant = Own()
f = jax.jit(plant.f)
arguments = np.zeros(1), np.ones(1), np.zeros(1), 0.01
before = f(*arguments).dtype, jax.jit(jax.numpy.cumsum)(np.ones(3)).dtype
from rotorwatch_lab.estimators.ekf import EKF
method = EKF(plant, 0.01)
_, out = jax.jit(method.step)(method.init(), np.ones(1), np.zeros(1), np.ones(1, bool))
print(*before, out.x.dtype, f(*arguments).dtype)
"""
    assert last_line(OWN + code) == "float32 float32 float64 float64"


@pytest.mark.parametrize("room", ["estimators", "systems"])
def test_whatever_is_made_makes_jax_compute_in_float64(room):
    """Every estimator of one's own plant, and every plant, as the first thing that a process makes of rotorwatch."""
    made = {
        "estimators": "[(lambda kind=kind: kind(Own(), 0.01)) for n, kind in discovery.estimators().items() if n != 'default']",
        "systems": """[
    lambda: systems.RateDynamics.of(airframes.paper("niermeyer-hexa")),
    lambda: systems.RigidBody.of(airframes.paper("uaf-02e")),
    lambda: systems.PortHamiltonianAttitude.of(airframes.paper("rot-hexa")),
    lambda: systems.LinearHover.of(airframes.paper("f450")),
    lambda: systems.Helicopter(airframes.paper("ruav-40kg")),
]""",
    }
    code = f"""
import jax
from rotorwatch import airframes
from rotorwatch.base import backend, discovery
from rotorwatch_lab import systems
from rotorwatch.errors import ConfigError
wide = []
for make in {made[room]}:
    jax.config.update("jax_enable_x64", False)
    backend.set_up.cache_clear()
    try:
        make()
    except ConfigError:  # not defined for such a plant
        continue
    wide.append(bool(jax.config.jax_enable_x64))
print(len(wide), all(wide))
"""
    count, every = last_line(OWN + code).split()
    assert every == "True"
    assert int(count) >= (len(discovery.estimators()) - 4 if room == "estimators" else len(discovery.systems()) - 1)
