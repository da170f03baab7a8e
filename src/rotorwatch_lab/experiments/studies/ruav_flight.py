"""The simulated helicopter flights of the set-membership study: closed loop, bounded coloured noise, two actuators that fail.

Truth follows the paper's discrete model (8), z+ = (x + dt f, gamma, delta) + w. Velocities and rates get a w within an ellipsoid
E(0, Q): a constant part of 0.7 semi-axes in a direction of the seed's choice plus random parts, smoothed with a factor of 0.98
from step to step. The coefficients stay where the fault puts them; filters allow for drift. Measurement errors lie within an
ellipsoid. A linear quadratic controller with integrators flies, and every command is dithered.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.systems.helicopter import Helicopter

DT, SECONDS, FAULT_S = 0.02, 20.0, 8.0
FAULT = np.array([0.0, 1.0, 0.0, 0.6, 0.0, 0.15, 0.0, 0.15])  # gamma = (1, 0, 1, .4), delta = (0, .15, 0, .15)
PROCESS = np.repeat([2e-3, 4e-3, 1e-5], [3, 3, 8])  # semi-axes of what one step adds
MEASUREMENT = np.repeat([0.01, 0.002], 3)
MEAN_SHARE, SMOOTH = 0.7, 0.98
DITHER, DITHER_HZ = 0.08, np.array([0.55, 0.8, 1.1, 1.45])
ATTITUDE = np.array([0.0635, -0.003])  # roll and pitch in hover
ACCURACY = np.repeat([np.radians(0.1), 0.1], 3)  # of attitude [rad] and place [m], as the paper prints it


class Flights(NamedTuple):
    """u, y, x, theta: (seeds, steps, ...)."""

    u: np.ndarray
    y: np.ndarray
    x: np.ndarray
    theta: np.ndarray


def plant(stops=True) -> Helicopter:
    """The 40 kg helicopter. In these flights its actuators stay clear of their stops, which a filter may know (stops False)."""
    return Helicopter(airframes.paper("ruav-40kg"), stops=stops)


def in_ball(rng, *shape) -> np.ndarray:
    """Uniform in the unit ball of the last axis' dimension."""
    d = rng.standard_normal(shape)
    return d / np.linalg.norm(d, axis=-1, keepdims=True) * rng.uniform(size=(*shape[:-1], 1)) ** (1 / shape[-1])


def weather(seed: int, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disturbances of the helicopter (steps, 6) and measurement errors (steps, 6), within their ellipsoids, and the dither's waves (steps,
    4) of size 1."""
    rng = np.random.default_rng(seed)
    mean = rng.standard_normal(6)
    mean *= MEAN_SHARE / np.linalg.norm(mean)
    push = (mean + (1 - MEAN_SHARE) * in_ball(rng, steps, 6)) * PROCESS[:6]
    phase = rng.uniform(0, 2 * np.pi, 4)
    wave = np.sin(2 * np.pi * DITHER_HZ * np.arange(steps)[:, None] * DT + phase)
    return push, in_ball(rng, steps, 6) * MEASUREMENT, wave


def sensed(seed: int, steps: int) -> np.ndarray:
    """(steps, 6) errors of measured attitude [rad] and position [m]: each within its ACCURACY, independent from step to step. A separate
    random stream: the draws of `weather` are unaffected."""
    return np.random.default_rng([seed, 1]).uniform(-1, 1, (steps, 6)) * ACCURACY


def fly(system: Helicopter, seeds: int, steps: int | None = None) -> Flights:
    """Flights of seeds 0, 1, ...; all at once."""
    steps = int(SECONDS / DT) if steps is None else steps
    push, error, wave = (np.stack(column) for column in zip(*(weather(seed, steps) for seed in range(seeds))))
    return closed_loop(system, push, error, DITHER * wave, round(FAULT_S / DT))


def closed_loop(system: Helicopter, push, error, extra, fault_step: int = -1) -> Flights:
    """Flights of the linear quadratic controller, side by side: push, error (N, T, 6) as of `weather`, extra (N, T, 4) commands; FAULT
    comes at a step, if it is one of them."""
    jax = load_jax()
    jnp, lax = jax.numpy, jax.lax
    K = _controller(system)

    def one(push, error, extra):
        def step(state, row):
            truth, integral = state
            k, push, error, extra = row
            seen = jnp.concatenate([truth.x, truth.attitude[:2] - ATTITUDE, integral])
            integral = integral + DT * truth.x[np.array([0, 1, 2, 5])] * np.array([1, 1, 1, 0.2])
            u, truth = truth.moved(system, jnp.clip(system.trim - K @ seen + extra, 0.0, 1.0), push, k == fault_step, FAULT)
            return (truth, integral), (u, truth.x + error, truth.x, truth.theta)

        return lax.scan(step, (Truth.hover(), jnp.zeros(4)), (jnp.arange(len(push)), push, error, extra))[1]

    return Flights(*(np.asarray(table) for table in jax.jit(jax.vmap(one))(push, error, extra)))


class Truth(namedtuple("Truth", "x attitude place theta w")):
    """State of a helicopter that also moves in space: x (6,) velocities and rates, attitude (3,) roll, pitch, heading, place (3,) north,
    east, down [m], theta (8,), w (6,): disturbance."""

    @classmethod
    def hover(cls) -> Truth:
        """At rest and healthy."""
        zero = load_jax().numpy.zeros
        return cls(zero(6), load_jax().numpy.asarray([*ATTITUDE, 0.0]), zero(3), zero(8), zero(6))

    def moved(self, system: Helicopter, U, push, now, fault) -> tuple[Any, Truth]:
        """(u (6,) of the plant, the truth a step later) under commands U (4,); now: whether the fault (8,) comes."""
        jnp = load_jax().numpy
        x, attitude, place, theta, w = self
        theta = theta + jnp.where(now, fault, 0.0)
        u, w = jnp.concatenate([U, attitude[:2]]), SMOOTH * w + (1 - SMOOTH) * push
        new = jnp.clip(x + DT * system.derivative(x, u, theta) + w, -1e3, 1e3)
        # Small angles.
        turned = jnp.stack([x[3] + attitude[1] * x[5], x[4] - attitude[0] * x[5], x[5] + attitude[0] * x[4]])
        c, s = jnp.cos(attitude[2]), jnp.sin(attitude[2])
        place = place + DT * jnp.stack([c * x[0] - s * x[1], s * x[0] + c * x[1], x[2]])
        return u, Truth(new, attitude + DT * turned, place, theta, w)


def hover(system: Helicopter) -> tuple[np.ndarray, np.ndarray]:
    """(by_x (6, 6), by_u (6, 6)): derivatives of the plant in hover, healthy."""
    at = np.zeros(6), np.concatenate([system.trim, ATTITUDE]), np.zeros(8)
    by_x, by_u = (np.asarray(part) for part in load_jax().jacfwd(system.derivative, (0, 1))(*at))
    return by_x, by_u


def _controller(system) -> np.ndarray:
    """(4, 12) feedback from velocities, rates, attitude and the integrals of u, v, w, r."""
    from scipy.linalg import solve_discrete_are

    by_x, by_u = hover(system)
    A, B = np.zeros((12, 12)), np.zeros((12, 4))
    A[:6, :6], A[:6, 6:8], B[:6] = by_x, by_u[:, 4:], by_u[:, :4]
    A[6, 3] = A[7, 4] = A[8, 0] = A[9, 1] = A[10, 2] = A[11, 5] = 1.0
    A, B = np.eye(12) + DT * A, DT * B
    Q = np.diag([0.1, 0.1, 0.3, 0.1, 0.1, 0.1, 1.0, 1.0, 0.02, 0.02, 0.1, 0.05])
    R = np.diag([3.0, 1.0, 3.0, 3.0])
    X = solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A)
