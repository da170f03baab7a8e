"""Small plants with worst-case bounded noise: does a set-membership filter's set ever lose the truth?

At each step the noise lies on the bound's surface and pushes the truth away from the set's centre as the ellipsoid measures it,
w = Q p / sqrt(p'Qp) with p = P^-1 (z - a); measurement errors lie on their bound, away from the truth or at random. theta stays,
or moves away from the set's centre as fast as the filter's bound allows.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.compiling.run import stepper
from rotorwatch_lab.estimators.esmf import ESMF
from rotorwatch_lab.maths import small

DT, STEPS = 0.05, 150
DRIFT = 0.1  # loss per second


class VanDerPol:
    """x = (position, speed) with an unknown damping: theta (1,) is its loss. The position is measured."""

    name, n_x, n_u, n_theta, n_y = "van_der_pol", 2, 1, 1, 1
    x_names, u_names, y_names, theta_names = ("position", "speed"), ("force",), ("position",), ("loss",)
    x0, P0 = np.array([1.0, 0.0]), np.diag([0.1, 0.1]) ** 2
    process, measurement = np.array([2e-3, 4e-3]), np.array([0.02])

    def f(self, x, u, theta, dt):
        """Euler's step of the oscillator."""
        from jax import numpy as jnp

        return x + dt * jnp.stack([x[1], (1.0 - theta[0]) * (1.0 - x[0] ** 2) * x[1] - x[0] + u[0]])

    def h(self, x, u, theta):
        """Position."""
        return x[:1]

    def Q(self, dt):
        """(2, 2) shape of the bound over 9."""
        return np.diag(self.process**2) / 9

    def R(self, u):
        """(1,) bound squared over 9."""
        return self.measurement**2 / 9


class Pendulum(VanDerPol):
    """x = (angle, rate), driven through an unknown gain: theta (1,) is its loss. The angle is measured."""

    name = "pendulum"

    def f(self, x, u, theta, dt):
        """Euler's step of a damped pendulum."""
        from jax import numpy as jnp

        return x + dt * jnp.stack([x[1], -4.0 * jnp.sin(x[0]) - 0.3 * x[1] + 4.0 * (1.0 - theta[0]) * u[0]])


def options(system, **changes) -> dict:
    """Keywords of a filter that knows the plant's true bounds."""
    known = {"process": system.process, "measurement": system.measurement, "theta_reach": 0.3, "theta_drift": 0.0}
    return known | {"theta_range": (-1.0, 1.0), "restart": False} | changes


RIGOROUS: tuple[dict[str, Any], ...] = (
    {},
    {"remainder": "interval"},
    {"form": "scalar"},
    {"form": "scalar", "cut": "source"},
    {"form": "scalar", "cut": "volume", "remainder": "interval"},
    {"form": "batch", "remainder": "interval", "remainder_box": "volume"},
    {"form": "ud"},
)
MUTATIONS: dict[str, dict[str, Any]] = {
    "no_remainder": {"remainder": "none"},
    "quarter_Q": {"process": 0.25},
    "no_drift": {"drift": (DRIFT, 0.0)},
}


def escapes(system, seeds: int, process=1.0, drift=(0.0, 0.0), **changes) -> int:
    """Number of steps in which the truth lies outside the set, or outside one of the small sets of x and of theta, over all seeds.

    process: the filter's bound of the noise in true ones; drift: of theta, and the filter's bound of it [1/s]; changes: its
    other keywords.
    """
    rng = np.random.default_rng(0)
    first = rng.standard_normal((seeds, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True) * 1.0001
    noise = rng.uniform(-1, 1, (seeds, STEPS, 4))
    noise[..., 1] = rng.uniform(size=(seeds, STEPS))
    drive = np.sin(0.17 * np.arange(STEPS))[None, :, None] * rng.uniform(0.5, 1.0, (seeds, 1, 1))
    over, start = _program(type(system), tuple(changes.items()))
    bounds = _Bounds(process, *drift)
    starts = [(start, start.z + np.sqrt(np.diagonal(start.near_shape)) * one) for one in first]
    return sum(int(np.sum(over(bounds, one, *rows)[1])) for one, *rows in zip(starts, drive, noise, strict=True))


class _Bounds(NamedTuple):
    """As of `escapes`: the filter's bound of the noise in true ones, the drift of theta, and the filter's bound of it."""

    process: Any
    drift: Any
    allowed: Any


class _Attacked(NamedTuple):
    """A filter and its plant in steps, u (1,) the drive, y (4,) the noise's draws: the output is whether the truth is outside."""

    system: Any
    changes: dict
    bounds: _Bounds

    def filter(self) -> ESMF:
        process, _, allowed = self.bounds
        return ESMF(self.system, DT, **options(self.system, process=process * self.system.process, theta_drift=allowed, **self.changes))

    def init(self):
        carry = self.filter().init()
        return carry, carry.z

    def step(self, state, u, y, valid):
        jnp, (carry, z), system, noise, tight = load_jax().numpy, state, self.system, y, self.filter()
        moved = system.f(z[:2], u, z[2:], DT)
        p = _outward(tight.unfactored(carry.shape), z - carry.z)[:2]
        p = jnp.where(noise[1] > 0.3, p, noise[2:])  # mostly adversarial, sometimes anywhere on the bound
        Q = np.diag(system.process**2)
        w = Q @ p / jnp.maximum(jnp.sqrt(p @ Q @ p), 1e-12)
        theta = jnp.clip(z[2:] + self.bounds.drift * DT * jnp.where(z[2:] < carry.near[2:], -1.0, 1.0), -1.0, 1.0)
        z = jnp.concatenate([moved + w, theta])
        away = jnp.where(noise[1] > 0.6, jnp.sign(z[0] - carry.z[0]), jnp.sign(noise[0]))
        measured = system.h(z[:2], u, z[2:]) + away * jnp.asarray(system.measurement)
        carry, _ = tight.step(carry, u, measured, jnp.ones(1, bool))
        near, P = z - carry.near, carry.near_shape
        out = _escaped(z - carry.z, tight.unfactored(carry.shape))
        return (carry, z), out | _escaped(near[:2], P[:2, :2]) | _escaped(near[2:], P[2:, 2:])


def _outward(P, d):
    jnp = load_jax().numpy
    scale = 1.0 / jnp.sqrt(jnp.diagonal(P))
    return scale * small.solve(P * scale * scale[:, None], (scale * d)[:, None])[:, 0]


def _escaped(d, P):
    return ~((d @ _outward(P, d)) <= 1 + 1e-6)


@functools.cache
def _program(kind, changes):
    """(compiled (bounds, state, drive (T, 1), noise (T, 4)) -> (state, (T,) True where the truth is outside), the filter's start); one per
    plant and mode."""
    system, changed = kind(), dict(changes)

    def build(bounds):
        return _Attacked(system, changed, bounds)

    return stepper(build), build(_Bounds(1.0, 0.0, 0.0)).init()[0]


def adversarial_escapes(seeds: int) -> int:
    """Escapes of all rigorous modes together, on both plants: 0 is guaranteed."""
    return sum(
        escapes(system, seeds, drift=drift, **mode)
        for system in (VanDerPol(), Pendulum())
        for mode in RIGOROUS
        for drift in ((0.0, 0.0), (DRIFT, DRIFT))
    )


def mutation_escapes(seeds: int) -> dict[str, int]:
    """Escapes of deliberately wrong filters: each must lose the truth, or the check proves nothing."""
    return {name: sum(escapes(system, seeds, **change) for system in (VanDerPol(), Pendulum())) for name, change in MUTATIONS.items()}
