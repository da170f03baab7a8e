"""A helicopter as a rigid body in moving air: the forces of `systems.Helicopter` with a quaternion, wind and Runge-Kutta steps.

    dv/dt = g e_z + R f(a, omega, U)      domega/dt = alpha(a, omega - gust rates, U)      dq/dt = q omega / 2

NED world, FRD body, SI. f and alpha: specific force and angular acceleration of the plant at the airspeed a = R'(v - wind)
and at actuators U (4,) in [0, 1]; the plant's weight and turning frame are taken out of them, because here they belong to
the world. U follows what it is driven to like a first-order lag, solved exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch_lab.simulation import rotation
from rotorwatch_lab.simulation.rigid import Air, Body, runge_kutta
from rotorwatch_lab.systems.helicopter import Helicopter

Array = Any
SOUND = np.zeros(8)  # theta of the plant: faults are in U already
NEWTON_STEPS = 12


def plant(data: dict[str, Any], mass: Any = None) -> Helicopter:
    """The plant of an airframe's table. mass [kg]: another one than the table's, which may be traced."""
    return Helicopter(data if mass is None else {**data, "mass": mass})


def trim(system: Helicopter) -> tuple[np.ndarray, np.ndarray]:
    """(U (4,), (roll, pitch) [rad]) of hover in still air. Raises ConfigError where the actuators do not reach that far."""
    jax = load_jax()

    @jax.jit
    def rest(z):
        return system.derivative(np.zeros(6), z, SOUND)

    slope, z = jax.jit(jax.jacfwd(rest)), np.array([0.5, 0.2, 0.5, 0.5, 0.05, 0.0])
    for _ in range(NEWTON_STEPS):
        z = z - np.linalg.solve(np.asarray(slope(z)), np.asarray(rest(z)))
    left = np.abs(np.asarray(rest(z))).max()
    if not left < 1e-9 or (z[:4] < 0.05).any() or (z[:4] > 0.95).any():
        raise ConfigError(f"airframe.payload_kg: the helicopter cannot hover with a mass of {float(system.m):.3g} kg.")
    return z[:4], z[4:]


def derivative(system: Helicopter, body: Body, U, air: Air) -> tuple[Body, Array]:
    """(d body / dt, specific force (3,) in body axes [m/s^2]). U (4,): where the actuators are."""
    jnp = load_jax().numpy
    R = rotation.axes(body.q)
    a = rotation.to_body(R, body.v - air.wind)
    level = jnp.zeros(2, U.dtype)
    d = system.derivative(jnp.concatenate([a, body.omega]), jnp.concatenate([U, level]), SOUND)
    down = jnp.stack([0.0 * d[0], 0.0 * d[0], 0.0 * d[0] + G0])
    force = d[:3] - down + rotation.cross(body.omega, a)
    turn = d[3:] + system.damping / system.I * air.turning
    return Body(body.v, rotation.to_world(R, force) + down, rotation.rate(body.q, body.omega), turn), force


def step(system: Helicopter, body: Body, U, driven, lag, air: Air, dt) -> tuple[Body, Array, Array]:
    """Body, actuators (4,) and mean specific force (3,) after dt: classical Runge-Kutta, actuators exact at its nodes.

    driven (4,): where the actuators are driven to; lag [s].
    """
    jnp = load_jax().numpy
    gap, fade = U - driven, jnp.exp(-0.5 * dt / lag)
    nodes = [driven + gap * f for f in (1.0, fade, fade, fade * fade)]
    body, force = runge_kutta(lambda at, U: derivative(system, at, U, air), body, jnp.stack(nodes), dt)
    return body, nodes[3], force
