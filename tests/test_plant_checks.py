"""What every published method refuses in a plant, in one sentence; and plants without names."""

import numpy as np
import pytest

from rotorwatch.base import discovery
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.lyapunov import Lyapunov
from rotorwatch_lab.maths import plant
from rotorwatch_lab.published.observability import observability

METHODS = {name: kind for name, kind in discovery.estimators().items() if name != "default"}


class Nameless:
    """Two rates turned by two inputs, whose losses are felt in a third measurement as well."""

    n_x, n_u, n_theta, n_y = 2, 2, 2, 3
    x0, P0 = np.zeros(2), np.eye(2)
    variances = np.array([1e-4, 1e-4, 1e-2])

    def f(self, x, u, theta, dt):
        return x + dt * (np.array([[3.0, 1.0], [-1.0, 2.0]]) @ (u * (1 - theta)) - x)

    def h(self, x, u, theta):
        from jax import numpy as jnp

        return jnp.concatenate([x, (u @ (1 - theta))[None]])

    def Q(self, dt):
        return 0.01 * dt * np.eye(2)

    def R(self, u):
        return self.variances


def changed(**parts):
    return type("Changed", (Nameless,), parts)()


BAD = [
    ({"variances": np.diag([1e-4, 1e-4, 1e-2])}, r"R of the plant Changed is a matrix.*variances \(3,\).*Cholesky"),
    ({"variances": np.array([1e-4, -1e-4, 1e-2])}, "R of the plant Changed holds -0.0001"),
    ({"variances": np.array([1e-4, np.nan, 1e-2])}, "R of the plant Changed holds NaN"),
    ({"variances": np.array([1e-4, 1e-4])}, r"R of the plant Changed must have the shape \(3,\)"),
    ({"variances": 1e-4}, r"R of the plant Changed must have the shape \(3,\)"),
    ({"Q": lambda self, dt: 0.01 * np.ones(2)}, r"Q of the plant Changed must have the shape \(2, 2\)"),
    ({"P0": np.ones(2)}, r"P0 of the plant Changed must have the shape \(2, 2\)"),
    ({"P0": -np.eye(2)}, "P0 of the plant Changed is not positive"),
    ({"x0": np.zeros(3)}, r"x0 of the plant Changed must have the shape \(2,\)"),
]


@pytest.mark.parametrize(("parts", "words"), BAD, ids=lambda v: str(v)[:40] if isinstance(v, str) else "")
@pytest.mark.parametrize("name", METHODS)
def test_a_wrong_plant_is_refused_by_every_method(name, parts, words):
    with pytest.raises(ConfigError, match=words) as said:
        METHODS[name](changed(**parts), 0.05)
    assert str(said.value).endswith(".")


@pytest.mark.parametrize("name", METHODS)
def test_a_missing_part_is_named(name):
    class Bare:
        n_x = n_u = n_theta = n_y = 1

    with pytest.raises(ConfigError, match="not defined for the plant Bare: it needs f, h, Q, R, x0, P0"):
        METHODS[name](Bare(), 0.05)


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("name", METHODS)
def test_a_plant_needs_no_name(name):
    METHODS[name](Nameless(), 0.05)


def test_whitened_measurements_have_unit_variances():
    """What the message on a full R says."""
    L = np.linalg.cholesky(np.array([[2e-4, 1e-4, 0], [1e-4, 2e-4, 0], [0, 0, 1e-2]]))
    h = Nameless.h
    whitened = changed(h=lambda self, x, u, theta: np.linalg.inv(L) @ h(self, x, u, theta), variances=np.ones(3))
    assert plant.checked("any", whitened, 0.05) is whitened


def test_observability_of_a_plant_without_names():
    found = observability(Nameless())
    assert found.name == "Nameless" and found.theta_names == ("loss_1", "loss_2")


def test_names_beyond_the_inputs():
    assert plant.theta_names(changed(n_theta=3)) == ("loss_1", "loss_2", "theta_3")
    assert plant.theta_names(changed(theta_names=("a", "b"))) == ("a", "b")


def test_messages_need_no_name():
    blind = changed(h=lambda self, x, u, theta: 0.0 * Nameless.h(self, x, u, theta))
    with pytest.raises(ConfigError, match="not defined for the plant Changed: it needs every state measured"):
        Lyapunov(blind, 0.05)
