"""Base of all simulated vehicles: a rigid body in moving air, integrated by one Runge-Kutta rule.

NED world, FRD body, SI; positions are the centre of mass.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import Any

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.simulation import rotation

Array = Any


class Body(namedtuple("Body", "p v q omega")):
    """p [m], v [m/s] (3,) NED; q (4,) body to world; omega (3,) body [rad/s]."""


class Air(namedtuple("Air", "wind turning ground")):
    """The air around the vehicle in one step: wind (3,) NED [m/s], turning (3,) gust rates in body axes [rad/s]; ground 0 or 1."""


def runge_kutta(derivative: Callable, body: Body, nodes: Any, dt: float) -> tuple[Body, Array]:
    """(body, mean specific force (3,) in body axes [m/s^2]) after dt [s]: the classical fourth-order rule.

    derivative(body, node): (d body / dt, specific force). nodes: what drives the body at the beginning, twice in the middle and
    at the end of the step, stacked along a first axis of four. The quaternion comes back with length 1.
    """
    jax = load_jax()
    jnp = jax.numpy
    # Four stages, one program: where each one looks from the last slope, and what it counts.
    ahead, weight = (jnp.asarray(c, body.p.dtype) for c in ([0.0, 0.5 * dt, 0.5 * dt, dt], [dt / 6, dt / 3, dt / 3, dt / 6]))

    def stage(carry, row):
        slope, total, mean = carry
        ahead, weight, node = row
        at = jax.tree.map(lambda s, ds: s + ahead * ds, body, slope)
        slope, force = derivative(at, node)
        return (slope, jax.tree.map(lambda s, ds: s + weight * ds, total, slope), mean + weight / dt * force), None

    rest = jax.tree.map(lambda s: 0.0 * s, body)
    (_, new, mean), _ = jax.lax.scan(stage, (rest, body, 0.0 * body.p), (ahead, weight, nodes))
    return new._replace(q=rotation.unit(new.q)), mean
