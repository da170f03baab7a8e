"""Flights of any plant, simulated with its own f, h, Q and R, for trying a plant or a method without a log.

    x(k+1) = f(x(k), u(k), theta(k), dt) + w,   y(k) = h(x(k+1), u(k), theta(k)) + v,   w ~ N(0, Q(dt)),   v ~ N(0, diag R(u(k)))

Truth and model are the same here; campaigns test methods on vehicles that no plant describes exactly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError


class Simulation(NamedTuple):
    """Result of `simulate_system`, a row per step: t (T,) s at the end of the step; u (T, n_u); y (T, n_y), measured at the end of the
    step; x (T, n_x), the state then; theta (T, n_theta); dt (T,) s."""

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    x: np.ndarray
    theta: np.ndarray
    dt: np.ndarray


def simulate_system(
    system: Any,
    u: Any,
    theta: Any = 0.0,
    dt: Any = 0.01,
    *,
    steps: int | None = None,
    x0: Any = None,
    seed: int | None = 0,
    noise: bool = True,
) -> Simulation:
    """Let a plant move for T steps.

    system: the plant (`core.System`). u (T, n_u): inputs, each held over its step, in the plant's units; or a controller u(t, y) ->
    (n_u,), written with jax.numpy, that is given the time and what was measured last, for as many steps as are asked for. steps: how
    many, where u is a controller. theta: losses of effectiveness, 0 healthy to 1 dead: one number, (n_theta,) or (T, n_theta). dt: s,
    one number or (T,). x0 (n_x,): the true start (default: the plant's x0). seed: of the noise, with the plant's own Q and R. noise:
    False for none. Raises ConfigError for wrong shapes, for a plant whose parts do not fit, and for a motion that ends in infinity.
    """
    jax = load_jax()
    jnp = jax.numpy
    checks.plant(system)
    closed = callable(u)
    if closed:
        if steps is None or steps < 1:
            raise ConfigError("steps is missing: say for how many steps the controller u(t, y) is to run.")
        T, inputs = int(steps), np.zeros((int(steps), system.n_u))
    else:
        inputs = np.asarray(u, float)
        if inputs.ndim != 2 or inputs.shape[1] != system.n_u or not len(inputs):
            raise ConfigError(f"u must have the shape (T, {system.n_u}), a row per time step, not {inputs.shape}.")
        T = len(checks.finite("u", inputs))
    losses = _rows("theta", theta, T, system.n_theta)
    seconds = np.asarray(dt, float)
    if seconds.shape not in ((), (T,)):
        raise ConfigError(f"dt must be one number or have the shape ({T},), not {seconds.shape}.")
    seconds = np.broadcast_to(checks.positive("dt", seconds), (T,)).copy()
    start = np.asarray(system.x0 if x0 is None else checks.finite("x0", checks.shape("x0", x0, system.n_x)), float)
    rng = np.random.default_rng(seed)
    w, v = rng.standard_normal((T, system.n_x)), rng.standard_normal((T, system.n_y))
    if not noise:
        w, v = 0.0 * w, 0.0 * v
    end = np.cumsum(seconds)
    if closed:
        checks.controller(u, system)

    def step(state, row):
        x, y = state
        t, u_, theta, dt, w, v = row
        u_ = u(t, y) if closed else u_
        x = system.f(x, u_, theta, dt) + _root(system.Q(dt)) @ w
        y = system.h(x, u_, theta) + jnp.sqrt(system.R(u_)) * v
        return (x, y), (u_, x, y)

    def whole(start, rows):
        first = system.h(start, jnp.zeros(system.n_u), rows[2][0])
        return jax.lax.scan(step, (start, first), rows)[1]

    results = jax.jit(whole)(start, (end - seconds, inputs, losses, seconds, w, v))
    inputs, x, y = (np.asarray(a) for a in results)
    if not np.isfinite(x).all():
        when = end[np.argmin(np.isfinite(x).all(axis=1))]
        raise ConfigError(
            f"the plant {system.name} runs off to infinity {when:.2f} s after the start: a vehicle has to be controlled; "
            "give u as a function u(t, y)."
        )
    return Simulation(end, inputs, y, x, losses, seconds)


def _rows(name: str, value: Any, T: int, n: int) -> np.ndarray:
    """(T, n) of one number, (n,) or (T, n)."""
    array = np.asarray(value, float)
    if array.shape not in ((), (n,), (T, n)):
        raise ConfigError(f"{name} must be one number or have the shape ({n},) or ({T}, {n}), not {array.shape}.")
    return np.broadcast_to(checks.finite(name, array), (T, n)).copy()


def _root(Q):
    """A with A A' = Q, for a Q that may be singular."""
    import jax.numpy as jnp

    values, vectors = jnp.linalg.eigh(Q)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))
