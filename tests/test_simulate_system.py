"""Any plant can be simulated, and a plant or a table that does not fit is named in one sentence."""

import math

import numpy as np
import pytest

import rotorwatch as rw
from rotorwatch.base import checks
from rotorwatch.errors import ConfigError


class Slider:
    """A mass on a track, pushed by two actuators; position and speed are measured."""

    name, n_x, n_u, n_theta, n_y = "slider", 2, 2, 2, 2
    x0, P0 = np.zeros(2), np.eye(2)

    def f(self, x, u, theta, dt):
        import jax.numpy as jnp

        force = (u * (1.0 - theta)).sum() - 0.1 * x[1]
        return jnp.stack([x[0] + dt * x[1] + 0.5 * dt**2 * force, x[1] + dt * force])

    def h(self, x, u, theta):
        return x

    def Q(self, dt):
        return 1e-4 * dt * np.eye(2)

    def R(self, u):
        return np.array([1e-4, 1e-4])


def inputs(T=300):
    t = 0.01 * np.arange(T)
    return np.column_stack([1.0 + np.sin(3.0 * t), 1.0 + np.cos(5.0 * t)])


def test_without_noise_it_is_the_plant_step_by_step():
    plant, u, dt = Slider(), inputs(50), np.linspace(0.005, 0.02, 50)
    made = rw.simulate_system(plant, u, [0.2, 0.0], dt, x0=[1.0, -1.0], noise=False)
    x = np.array([1.0, -1.0])
    for k in range(50):
        x = np.asarray(plant.f(x, u[k], np.array([0.2, 0.0]), dt[k]))
        np.testing.assert_allclose(made.x[k], x, atol=1e-12)
        np.testing.assert_allclose(made.y[k], x, atol=1e-12)  # measured at the end of the step
    np.testing.assert_allclose(made.t, np.cumsum(dt))


def test_noise_is_the_plants_own_and_follows_from_the_seed():
    made, again, other = (rw.simulate_system(Slider(), inputs(4000), seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(made.y, again.y)
    assert (made.y != other.y).any()
    assert np.std(made.y - made.x, axis=0) == pytest.approx([0.01, 0.01], rel=0.1)
    pushed = made.x[1:] - np.array([np.asarray(Slider().f(x, u, 0.0 * u, 0.01)) for x, u in zip(made.x, made.u[1:])])
    assert np.std(pushed, axis=0) == pytest.approx([1e-3, 1e-3], rel=0.1)


def test_a_method_finds_the_loss_in_steps_of_any_length():
    """Every row has a length of its own; a method that is given it finds the loss, one that is not does not."""
    rng, T = np.random.default_rng(0), 3000
    theta = np.zeros((T, 2))
    theta[T // 3 :, 1] = 0.4
    made = rw.simulate_system(Slider(), inputs(T), theta, rng.uniform(0.002, 0.05, T))
    method = rw.estimators.EKF(Slider(), 0.01, theta_walk=1e-3)
    reported = rw.run(method, made.u, made.y, dt=made.dt)[1].theta[-500:].mean(axis=0)
    assert reported == pytest.approx([0.0, 0.4], abs=0.05)
    unreported = rw.run(method, made.u, made.y)[1].theta[-500:].mean(axis=0)
    assert np.abs(unreported - [0.0, 0.4]).max() > 0.1
    same = rw.run(method, made.u, made.y, dt=0.01)[1].theta[-500:].mean(axis=0)
    np.testing.assert_allclose(same, unreported, atol=1e-9)


def test_a_controller_sees_what_was_measured_last_and_when():
    def control(t, y):
        import jax.numpy as jnp

        return jnp.stack([-2.0 * y[0] - 2.0 * y[1], t])

    made = rw.simulate_system(Slider(), control, 0.0, 0.02, steps=100, x0=[1.0, 0.0])
    np.testing.assert_allclose(made.u[1:, 0], -2.0 * made.y[:-1].sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(made.u[:, 1], made.t - 0.02, atol=1e-12)
    assert made.u[0, 0] == -2.0  # at first: the start, without noise
    for asked, says in (
        ({}, "steps is missing"),
        ({"u": lambda t, y: y[:1], "steps": 5}, r"u\(t, y\) must return an array of the shape \(2,\), not \(1,\)"),
        ({"u": lambda t, y: y * math.sin(t), "steps": 5}, r"u\(t, y\) asks for the number .*use jax.numpy"),
        ({"u": lambda t, y: 1e9 * y, "steps": 500, "x0": [1.0, 1.0]}, "runs off to infinity .* give u as a function"),
    ):
        with pytest.raises(ConfigError, match=says):
            rw.simulate_system(Slider(), **{"u": control, **asked})


def changed(**parts):
    return type("Changed", (Slider,), parts)()


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ({"x0": np.zeros(3)}, r"x0 of the plant slider must have the shape \(2,\), not \(3,\)"),
        ({"P0": np.eye(3)}, r"P0 of the plant slider must have the shape \(2, 2\)"),
        ({"n_u": 2.5}, "n_u of the plant slider must be a whole number, not 2.5"),
        ({"h": lambda self, x, u, theta: x[:1]}, r"h of the plant slider must return an array of the shape \(2,\), not \(1,\)"),
        ({"f": lambda self, x, u, theta, dt: x + np.asarray(u)}, r"f of the plant slider asks .*test_simulate_system.py, line"),
        ({"f": lambda self, x, u, theta, dt: x * math.sin(x[0])}, "use jax.numpy instead of numpy or math"),
        ({"h": lambda self, x, u, theta: x if x[0] > 0 else -x}, "h of the plant slider asks for .* jnp.where instead of `if`"),
        ({"f": lambda self, x, u, theta: x}, "f of the plant slider fails for arguments"),
        ({"R": lambda self, u: np.ones(3)}, "R of the plant slider must return"),
        ({"Q": None}, "Q of the plant slider fails"),
    ],
)  # fmt: skip
def test_a_plant_that_does_not_fit_is_one_sentence(parts, says):
    for call in (checks.plant, lambda plant: rw.simulate_system(plant, inputs(5))):
        with pytest.raises(ConfigError, match=says) as why:
            call(changed(**parts))
        assert "\n" not in str(why.value)


@pytest.mark.parametrize("kind", ["AXKF", "AdaptiveEKF", "UKF", "ATSUKF", "MHE"])
def test_methods_that_look_at_the_plant_when_they_are_made_say_the_same(kind):
    def tried(plant):
        return rw.run(getattr(rw.estimators, kind)(plant, 0.01), inputs(5), np.zeros((5, 2)))

    with pytest.raises(ConfigError, match="f of the plant slider asks for the number"):
        tried(changed(f=lambda self, x, u, theta, dt: x + np.asarray(u) * math.sin(x[0])))
    with pytest.raises(ConfigError, match=r"x0 of the plant slider must have the shape \(2,\), not \(3,\)"):
        tried(changed(x0=np.zeros(3)))


def test_an_estimator_over_such_a_plant_says_the_same():
    bad = changed(f=lambda self, x, u, theta, dt: x + np.asarray(u))
    with pytest.raises(ConfigError, match="f of the plant slider asks for the number"):
        rw.run(rw.estimators.EKF(bad, 0.01), inputs(5), np.zeros((5, 2)))
    with pytest.raises(ConfigError, match="x0 of the plant slider must have the shape"):
        rw.run(rw.estimators.EKF(changed(x0=np.zeros(3)), 0.01), inputs(5), np.zeros((5, 2)))


class Own:
    """A method whose step calls NumPy."""

    name, not_kalman = "own", "x"

    def __init__(self, system):
        self.system = system

    def init(self):
        return np.zeros(2)

    def step(self, carry, u, y, valid):
        return carry, np.sum(np.asarray(y))


def test_numpy_inside_a_method_is_one_sentence():
    with pytest.raises(ConfigError, match=r"step of own asks for the number .*test_simulate_system.py, line \d+"):
        rw.run(Own(Slider()), inputs(5), np.zeros((5, 2)))
    with pytest.raises(ConfigError, match="own takes no dt"):
        rw.run(Own(Slider()), inputs(5), np.zeros((5, 2)), dt=0.01)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda m: rw.run(m, inputs(5)[:, :1], np.zeros((5, 2))), r"u must have the shape \(5, 2\), a row per time step"),
        (lambda m: rw.run(m, inputs(5), np.zeros((4, 2))), r"y must have the shape \(5, 2\)"),
        (lambda m: rw.run(m, inputs(5), np.zeros((5, 2)), np.ones(5, bool)), "valid must have the shape of y"),
        (lambda m: rw.run(m, [[1.0], [1.0, 2.0]], np.zeros((2, 2))), "u must be a table of numbers"),
        (lambda m: rw.run(m, 3.0, np.zeros((5, 2))), "u must have the shape"),
        (lambda m: rw.run(m, inputs(5), np.zeros((5, 2)), dt=np.ones(4)), r"dt must be one number or have the shape \(5,\)"),
        (lambda m: rw.run(m, inputs(5), np.zeros((5, 2)), dt=-0.01), "dt must be above zero"),
        (lambda m: rw.simulate_system(m.system, inputs(5), np.zeros(3)), r"theta must be one number or have the shape \(2,\) or \(5, 2\)"),
        (lambda m: rw.simulate_system(m.system, inputs(5), x0=np.zeros(3)), r"x0 must have the shape \(2,\)"),
        (lambda m: rw.simulate_system(m.system, inputs(5).T), r"u must have the shape \(T, 2\)"),
        (lambda m: rw.simulate_system(m.system, inputs(5), dt=0.0), "dt must be above zero"),
    ],
)  # fmt: skip
def test_tables_of_the_wrong_shape_are_named(call, says):
    with pytest.raises(ConfigError, match=says):
        call(rw.estimators.EKF(Slider(), 0.01))
