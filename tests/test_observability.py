"""Observability: exact derivatives, known ranks, known twins, and what the command prints."""

import json

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.engine.motion.allocation import ambiguous_sets
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch_lab.published import observability as module
from rotorwatch_lab.published.observability import observability
from rotorwatch_lab.systems.rate_dynamics import RateDynamics


@pytest.fixture(scope="module")
def hexa():
    return observability("niermeyer-hexa")


def test_ranks_of_the_hexarotor(hexa):
    hover, eight = hexa.cases
    assert (hover.rank, eight.rank, hexa.unknowns) == (7, 9, 9)
    assert (eight.along[:, 6] / eight.along[:, 7]).min() > 5  # two singular values stand apart
    assert hover.singular_values[7] < 1e-15


def test_what_hover_hides_is_the_kernel(hexa):
    system = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    B = np.concatenate([system.B_tau, system.B_T[None]])
    assert hexa.hidden.shape == (2, 6)
    np.testing.assert_allclose(B @ hexa.hidden.T, 0.0, atol=1e-9)
    assert np.abs(B @ (hexa.hidden.T + 0.01 * np.eye(6)[:, :2])).max() > 1e-3


def test_twins_are_those_of_the_geometry(hexa):
    system = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    B = np.concatenate([system.B_tau, system.B_T[None]])
    assert {(p.one, p.other) for p in hexa.alike} == set(ambiguous_sets(B / np.abs(B).max(axis=1, keepdims=True)))
    assert all(p.separation > 1 for p in hexa.alike)


def test_the_manoeuvre_tells_more_than_hover(hexa):
    hover, eight = hexa.cases
    assert eight.worst_sd < 0.3 * hover.worst_sd


def test_taylor_mode_is_the_definition():
    """Two ways to the same derivatives; a wrong derivative of the input is noticed."""
    load_jax()
    system = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    rng = np.random.default_rng(0)
    x, u, theta = rng.standard_normal(3), rng.uniform(0.2, 0.6, (4, 6)), rng.uniform(0, 0.5, 6)
    taylor, lie = (np.asarray(f(system, x, u, theta, 3)) for f in (module.taylor_outputs, module.lie_outputs))
    np.testing.assert_allclose(taylor, lie, rtol=1e-9, atol=1e-9)
    u[2] *= 1.001
    assert np.abs(np.asarray(module.taylor_outputs(system, x, u, theta, 3)) - lie).max() > 1e-6


def test_derivatives_of_a_periodic_signal_are_exact():
    w = 2 * np.pi * 3 / module.PERIOD_S
    t = module.DT * np.arange(round(module.PERIOD_S / module.DT))
    found = module.derivatives(np.sin(w * t)[:, None], 4)[..., 0]
    expected = np.stack([w**k * np.sin(w * t + k * np.pi / 2) for k in range(5)], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-9 * w**4)


def test_sensitivity_is_the_difference_of_two_runs():
    jax = load_jax()
    system = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    u = 0.36 + 0.01 * np.random.default_rng(1).standard_normal((40, 6))

    def outputs(theta):
        def step(x, u):
            return system.f(x, u, theta, 0.01), (x, system.h(x, u, theta))

        return jax.lax.scan(step, np.zeros(3), u)[1]

    x, _ = outputs(np.zeros(6))
    S = module.sensitivity(system, x, u, 0.01)
    exact = np.asarray(jax.jacfwd(lambda theta: outputs(theta)[1])(np.zeros(6)))
    np.testing.assert_allclose(S, exact, atol=1e-9)
    assert np.abs(module.sensitivity(system, x, 1.01 * u, 0.01) - exact).max() > 1e-3


class Pendulum:
    """A plant that is no multirotor, and whose division Taylor mode has to know: two states, one motor."""

    name, n_x, n_u, n_theta, n_y = "pendulum", 2, 1, 1, 1
    x0, P0, theta_names = np.array([0.3, 0.0]), np.eye(2), ("loss_1",)

    def f(self, x, u, theta, dt):
        jnp = load_jax().numpy
        return x + dt * jnp.stack([x[1], -9.8 * jnp.sin(x[0]) + u[0] * (1 - theta[0])])

    def h(self, x, u, theta):
        return x[:1]

    def Q(self, dt):
        return 1e-4 * dt * np.eye(2)

    def R(self, u):
        return np.array([1e-4])


def test_any_plant_will_do():
    result = observability(Pendulum())
    assert result.name == "pendulum" and [case.rank for case in result.cases] == [3, 3]
    assert result.alike == () and "Hover alone" in result.summary


def test_json_and_figure(hexa, tmp_path):
    reported = json.loads(hexa.to_json())
    assert reported["cases"][0]["rank"] == 7 and reported["alike"][0]["one"] == [1, 4]
    hexa.figure(tmp_path / "hexa.svg")
    assert (tmp_path / "hexa.svg").stat().st_size > 5_000


def test_what_cannot_be_asked_is_one_sentence():
    with pytest.raises(VehicleError, match="no airframe called"):
        observability("nonsense")

    class Sound(Pendulum):
        n_theta = 0

    with pytest.raises(ConfigError, match="no losses"):
        observability(Sound())
