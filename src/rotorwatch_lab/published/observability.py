"""Observability of states and losses: which losses can be distinguished at all, and how precisely a flight of some seconds shows them.

Locally observable is what the output's time derivatives determine (Birk and Zeitz 1992; Niermeyer, Pak and Lohmann 2017, eq. 4):

    Q_obs = d/d(x, theta) of (y, dy/dt, d2y/dt2, ...)        with the input's derivatives given

Row k is scaled by T0^k / k!: it is then what the k-th derivative does to y within T0, and small singular values mean something.
How well: the covariance that an optimal filter reaches over SPAN_S. Both in hover and along a figure-eight at 4 m/s with the nose
on a fixed point; for plants that are no multirotor, about their x0 with every input swinging by a tenth.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import checks, files, optional
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import ambiguous_sets, usual_gains
from rotorwatch_lab.maths import bounded
from rotorwatch_lab.maths import plant as plants
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

T0 = 0.05  # s
HIGHEST = 4  # order of derivatives: scaled like this, those above do next to nothing
RANK = 1e-10  # relative to the largest singular value
SPAN_S = 10.0
DT = 0.01
LOSS = 0.3  # of the pair whose separation is stated
THETA_SD = 1.0  # what is known of a loss beforehand: nothing
PERIOD_S, EIGHT, LOOKED_AT = 8.0, (4.0, 2.0, 0.7), (0.0, 9.0)  # of the figure-eight: s, half lengths [m], point [m]
POINTS = 48  # along it


@dataclass(frozen=True)
class Case:
    """Observability in one flight condition. rank: of Q_obs, the least along the path. singular_values (n,): relative to the largest, at
    that point. sd (n_theta,): of each loss after SPAN_S, from nothing known. along (T, n): singular values over time."""

    name: str
    rank: int
    singular_values: np.ndarray
    sd: np.ndarray
    along: np.ndarray = field(repr=False)

    @property
    def worst_sd(self) -> float:
        """Standard deviation of the least known loss."""
        return float(self.sd.max())


@dataclass(frozen=True)
class Alike:
    """Two sets of rotors (1-based) that nothing distinguishes in hover. separation: how many standard deviations apart they are
    after SPAN_S of the manoeuvre, for losses of up to LOSS."""

    one: tuple[int, ...]
    other: tuple[int, ...]
    separation: float


@dataclass(frozen=True)
class Observability:
    """name: of airframe or plant. unknowns: states and losses together. cases: hover, manoeuvre. alike: rotor sets that cannot be
    distinguished in hover. hidden (k, n_theta): orthonormal combinations of losses that hover does not show."""

    name: str
    unknowns: int
    theta_names: tuple[str, ...]
    cases: tuple[Case, Case]
    alike: tuple[Alike, ...]
    hidden: np.ndarray

    @property
    def summary(self) -> str:
        """The result in a sentence or two."""
        hover, moving = self.cases
        if hover.rank == self.unknowns:
            return "Hover alone shows every loss."
        lost = self.unknowns - hover.rank
        text = f"Hover leaves {lost} combination{'s' if lost > 1 else ''} of losses unseen"
        if moving.rank == self.unknowns:
            return f"{text}; the manoeuvre shows all of them, the faintest {moving.singular_values[-1]:.0e} as clearly as the best."
        return f"{text}, and the manoeuvre still {self.unknowns - moving.rank}."

    def to_dict(self) -> dict:
        """Plain lists, numbers and strings."""
        return {
            "name": self.name,
            "unknowns": self.unknowns,
            "losses": list(self.theta_names),
            "cases": [
                {"name": case.name, "rank": case.rank, "singular_values": case.singular_values.tolist(), "loss_sd": case.sd.tolist()}
                for case in self.cases
            ],
            "alike": [{"one": list(p.one), "other": list(p.other), "separation": p.separation} for p in self.alike],
            "hidden_in_hover": self.hidden.tolist(),
            "summary": self.summary,
        }

    def to_json(self) -> str:
        """JSON text of `to_dict`."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)

    def figure(self, path: str | os.PathLike | None = None):
        """Singular values along the manoeuvre, and how well each loss is known; written to `path` (SVG, PNG) when given.

        Raises ConfigError without matplotlib."""
        Figure = optional.library("matplotlib.figure", "A figure").Figure
        picture = Figure(figsize=(9, 3.6), layout="constrained")
        left, right = picture.subplots(1, 2)
        hover, moving = self.cases
        time = np.linspace(0.0, PERIOD_S, len(moving.along), endpoint=False)
        left.semilogy(time, np.maximum(moving.along, 1e-18), color="tab:blue", lw=1)
        left.axhline(RANK, color="0.6", ls=":", lw=1)
        left.set(title=f"Singular values: {moving.name}", xlabel="time [s]", ylabel="relative to the largest", ylim=(1e-12, 2))
        place = np.arange(len(hover.sd))
        for case, shift, colour in ((hover, -0.2, "0.6"), (moving, 0.2, "tab:blue")):
            right.bar(place + shift, 100 * case.sd, 0.4, label=case.name, color=colour)
        right.set_yscale("log")
        right.set_xticks(place, [n.removeprefix("loss_") for n in self.theta_names])
        right.set(title=f"Loss known after {SPAN_S:.0f} s (1 sd)", xlabel="rotor", ylabel="%")
        right.legend(frameon=False)
        if path is not None:
            with files.replacing(path) as unfinished:
                picture.savefig(unfinished)
        return picture


def observability(subject: Vehicle | str | Any, x=None, u=None, progress=None) -> Observability:
    """Which losses can be distinguished on an airframe or a plant.

    subject: a `Vehicle`, the name of an airframe or of a paper's airframe, or any `core.System`. x (n_x,), u (n_u,): the point
    of rest (default: x0 and hover). progress: called with the finished share. Raises VehicleError for an unknown name and
    ConfigError for a plant without losses.
    """
    name, system = plant(subject)
    if not getattr(system, "n_theta", 0):
        raise ConfigError(f"{name} has no losses to observe.")
    x0 = np.asarray(system.x0 if x is None else x, float)
    u0 = np.asarray(bounded.nominal_input(system, u), float)
    orders = min(system.n_x + system.n_theta - 1, HIGHEST)
    if isinstance(system, RateDynamics):
        names, u0 = ("hover", "figure-eight"), hover_thrusts(system) if u is None else u0
        path_x, path_u = figure_eight(system)
    else:
        names, (path_x, path_u) = ("rest", "inputs swinging"), shake(x0, u0)
    stride = len(path_x) // POINTS
    still = np.concatenate([u0[None], np.zeros((orders, u0.size))])
    xs = np.concatenate([x0[None], path_x[::stride]])
    us = np.concatenate([still[None], derivatives(path_u, orders)[::stride]])
    matrices = lie_matrices(system, xs, us, np.zeros(system.n_theta), orders)
    if progress:
        progress(0.7)
    values = np.linalg.svd(matrices, compute_uv=False)
    along = values / values[:, :1]
    rest = np.broadcast_to(x0, path_x.shape), np.broadcast_to(u0, path_u.shape)
    covariances = reachable(system, np.stack([rest[0], path_x]), np.stack([rest[1], path_u]))
    cases = []
    for label, part, P in zip(names, (along[:1], along[1:]), covariances, strict=True):
        ranks = (part > RANK).sum(axis=1)
        least = int(np.lexsort((part[:, -1], ranks))[0])
        cases.append(Case(label, int(ranks[least]), part[least], np.sqrt(np.diagonal(P)[system.n_x :]), part))
    if progress:
        progress(1.0)
    hover = matrices[0]
    seen = signature(hover, system.n_x)
    hidden = np.linalg.svd(seen)[2][np.linalg.matrix_rank(seen, tol=1e-8) :] if len(seen) else np.eye(system.n_theta)
    rotors = min(system.n_u, system.n_theta)
    information = np.linalg.inv(covariances[1][system.n_x :, system.n_x :]) - np.eye(system.n_theta) / THETA_SD**2
    alike = tuple(Alike(one, other, _separation(seen, one, other, information)) for one, other in ambiguous_sets(seen[:, :rotors]))
    return Observability(name, system.n_x + system.n_theta, plants.theta_names(system), (cases[0], cases[1]), alike, hidden)


def plant(subject) -> tuple[str, Any]:
    """(name, system) of a subject. A `Vehicle` without masses becomes rate dynamics in hover thrusts of one rotor,
    with the inertia that multirotors of its size usually have."""
    if isinstance(subject, str):
        if subject in airframes.papers():
            table = airframes.paper(subject)
            if {"mass", "inertia", "thrust_max", "drag_ratio"} <= table.keys() and "rotors" in table:
                return subject, RateDynamics.of(table)
            raise ConfigError(f"The airframe {subject} is no multirotor; give its plant to rotorwatch.observability instead.")
        subject = airframes.named(subject)
    if isinstance(subject, Vehicle):
        B = subject.effectiveness()
        n = B.shape[1]
        return subject.name, RateDynamics(np.diag(usual_gains(n)[:3]), B[:3], B[3], n / G0)
    return checks.plant_name(subject), subject


# Exact observability


def lie_matrices(system, x, u, theta, orders: int, scaled: bool = True) -> np.ndarray:
    """Q_obs at T points: (T, (orders + 1) n_y, n_x + n_theta), row block k scaled by T0^k / k! (not with scaled=False).

    x (T, n_x); u (T, orders + 1, n_u): the input and its time derivatives; theta (n_theta,).
    """
    jax = load_jax()
    jnp = jax.numpy
    scale = np.cumprod(np.concatenate([[1.0], T0 / np.arange(1, orders + 1)])) if scaled else np.ones(orders + 1)

    def outputs(s, u, tower):
        y = tower(system, s[: system.n_x], u, s[system.n_x :], orders)
        return (scale[:, None] * y).reshape(-1)

    both = jnp.concatenate([jnp.asarray(x, float), jnp.broadcast_to(theta, (len(x), len(theta)))], axis=1)
    for tower in (taylor_outputs, lie_outputs):
        try:
            matrix = jax.jacfwd(lambda s, u, tower=tower: outputs(s, u, tower))
            return np.asarray(jax.jit(jax.vmap(matrix))(both, jnp.asarray(u, float)))
        except NotImplementedError:  # Taylor mode does not know one of the plant's operations
            continue
    raise ConfigError(f"The plant {checks.plant_name(system)} cannot be differentiated.")


def vector_field(system, x, u, theta):
    """dx/dt: the plant's own, else d f / d dt at 0."""
    jax = load_jax()
    if hasattr(system, "derivative"):
        return system.derivative(x, u, theta)
    return jax.jvp(lambda dt: system.f(x, u, theta, dt), (0.0,), (1.0,))[1]


def taylor_outputs(system, x, u, theta, orders: int):
    """(orders + 1, n_y): y and its time derivatives, by Taylor mode: x's derivatives one order after the other."""
    jax = load_jax()
    from jax.experimental.jet import jet

    def field_of(x, u):
        return vector_field(system, x, u, theta)

    rows = [u[k] for k in range(orders + 1)]
    moved = [field_of(x, rows[0])]
    for k in range(1, orders):
        _, series = jet(field_of, (x, rows[0]), (moved, rows[1 : k + 1]))
        moved.append(series[-1])
    if not orders:
        return system.h(x, rows[0], theta)[None]
    y, series = jet(lambda x, u: system.h(x, u, theta), (x, rows[0]), (moved, rows[1:]))
    return jax.numpy.stack([y, *series])


def lie_outputs(system, x, u, theta, orders: int):
    """The derivatives of `taylor_outputs` by definition: L^{k+1} h = dL^k h / dx f + dL^k h / dt, forward derivatives nested. Slow beyond
    order five."""
    jax = load_jax()
    jnp = jax.numpy
    factorial = np.cumprod(np.concatenate([[1.0], np.arange(1.0, orders + 1)]))

    def now(t):
        power = jnp.stack([t**k if k else jnp.ones(()) for k in range(orders + 1)])
        return (power / factorial) @ u

    def level(k):
        if k == 0:
            return lambda x, t: system.h(x, now(t), theta)
        lower = level(k - 1)
        return lambda x, t: jax.jvp(lower, (x, t), (vector_field(system, x, now(t), theta), jnp.ones(())))[1]

    return jnp.stack([level(k)(x, jnp.zeros(())) for k in range(orders + 1)])


def signature(matrix: np.ndarray, n_x: int) -> np.ndarray:
    """(r, n_theta) what losses do to the output that no initial state could do; rows orthogonal, the largest of norm 1."""
    Q_x, Q_theta = matrix[:, :n_x], matrix[:, n_x:]
    left, values, _ = np.linalg.svd(Q_x, full_matrices=False)
    basis = left[:, values > 1e-12 * max(values.max(initial=0.0), 1e-300)]
    rest = Q_theta - basis @ (basis.T @ Q_theta)
    _, values, right = np.linalg.svd(rest, full_matrices=False)
    keep = values > 1e-8 * values[0]
    # Only the span counts for what looks alike; equal weights keep weak axes (yaw) well away from rounding.
    return right[keep]


def _separation(seen, one, other, information) -> float:
    """Standard deviations between losses of `one` and those of `other` that look like them in hover."""
    rotors = [k - 1 for k in (*one, *other)]
    direction = np.zeros(seen.shape[1])
    direction[rotors] = np.linalg.svd(seen[:, rotors])[2][-1]
    direction *= LOSS / np.abs(direction).max()
    return float(np.sqrt(max(direction @ information @ direction, 0.0)))


# How well


def reachable(system, x, u) -> np.ndarray:
    """(K, n, n) covariances of (x, theta) after SPAN_S: the optimal filter's, along K paths (K, T, ...), DT apart, that repeat."""
    jax = load_jax()
    jnp = jax.numpy
    n, k = system.n_x, system.n_theta
    rows = np.arange(round(SPAN_S / DT)) % x.shape[1]

    def step(P, row):
        x, u = row
        F_x, F_theta = jax.jacfwd(system.f, (0, 2))(x, u, jnp.zeros(k), DT)
        H = jnp.concatenate(jax.jacfwd(system.h, (0, 2))(x, u, jnp.zeros(k)), axis=1)
        F = jnp.block([[F_x, F_theta], [jnp.zeros((k, n)), jnp.eye(k)]])
        P = F @ P @ F.T + jnp.pad(system.Q(DT), (0, k))
        L = jnp.linalg.cholesky(H @ P @ H.T + jnp.diag(system.R(u)))
        V = jax.scipy.linalg.solve_triangular(L, H @ P, lower=True)
        P = P - V.T @ V
        return 0.5 * (P + P.T), None

    start = np.zeros((n + k, n + k))
    start[:n, :n], start[n:, n:] = np.asarray(system.P0), THETA_SD**2 * np.eye(k)
    paths = jax.vmap(lambda x, u: jax.lax.scan(step, jnp.asarray(start), (x, u))[0])
    return np.asarray(jax.jit(paths)(x[:, rows], u[:, rows]))


def sensitivity(system, x, u, dt: float, theta=None) -> np.ndarray:
    """S = dy/dtheta (T, n_y, n_theta) along a path x (T, n_x), u (T, n_u) of steps dt: the sensitivity equation (5) of the paper,
    S_x' = (df/dx) S_x + df/dtheta from S_x = 0, in the plant's own discretisation."""
    jax = load_jax()
    jnp = jax.numpy
    theta = jnp.zeros(system.n_theta) if theta is None else jnp.asarray(theta, float)

    def step(S, row):
        x, u = row
        C, D = jax.jacfwd(system.h, (0, 2))(x, u, theta)
        F_x, F_theta = jax.jacfwd(system.f, (0, 2))(x, u, theta, dt)
        return F_x @ S + F_theta, C @ S + D

    start = jnp.zeros((system.n_x, system.n_theta))
    scan = jax.jit(lambda x, u: jax.lax.scan(step, start, (x, u))[1])
    return np.asarray(scan(jnp.asarray(x, float), jnp.asarray(u, float)))


# Ways to fly


def hover_thrusts(system: RateDynamics) -> np.ndarray:
    """u (n_u,) of least norm that carries the weight without torque."""
    return allocate(system, np.zeros((1, 3)), np.full(1, system.m * G0))[0]


def allocate(system: RateDynamics, torque, thrust) -> np.ndarray:
    """u (T, n_u): the pseudo-inverse of torque (T, 3) and thrust (T,)."""
    B = np.concatenate([np.asarray(system.B_tau), np.asarray(system.B_T)[None]])
    trim = np.concatenate([torque - system.tau_0, (thrust - system.F_0)[:, None]], axis=1)
    return trim @ np.linalg.pinv(B).T


def figure_eight(system: RateDynamics) -> tuple[np.ndarray, np.ndarray]:
    """omega (T, 3) and u (T, n_u) over one period of the figure-eight, DT apart, from the path by differential flatness."""
    t = DT * np.arange(round(PERIOD_S / DT))
    w, phase = 2 * np.pi / PERIOD_S * np.array([1.0, 2.0, 1.0]), np.array([0.0, 0.0, 0.7])
    angle = np.outer(t, w) + phase
    p, a = np.array(EIGHT) * np.sin(angle), -np.array(EIGHT) * w**2 * np.sin(angle)
    force = a - np.array([0.0, 0.0, G0])
    z = -force / np.linalg.norm(force, axis=1, keepdims=True)
    nose = np.concatenate([np.array(LOOKED_AT) - p[:, :2], np.zeros((len(t), 1))], axis=1)
    y = np.cross(z, nose)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R = np.stack([np.cross(y, z), y, z], axis=2)  # columns: body axes in the world
    spin = np.swapaxes(R, 1, 2) @ derivatives(R.reshape(len(t), 9), 1)[:, 1].reshape(-1, 3, 3)
    omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    J = np.asarray(system.J)
    torque = derivatives(omega, 1)[:, 1] @ J.T + np.cross(omega, omega @ J.T) + omega * system.damping
    return omega, allocate(system, torque, system.m * np.linalg.norm(force, axis=1))


def shake(x0, u0) -> tuple[np.ndarray, np.ndarray]:
    """x (T, n_x) at rest and u (T, n_u) with every input swinging by a tenth at a frequency of its own, over PERIOD_S."""
    t = DT * np.arange(round(PERIOD_S / DT))
    turns = 2 * np.pi / PERIOD_S * (3.0 + np.arange(u0.size))
    swing = 0.1 * np.where(u0 == 0.0, 1.0, np.abs(u0))
    return np.broadcast_to(x0, (t.size, x0.size)), u0 + swing * np.sin(np.outer(t, turns) + np.arange(u0.size))


def derivatives(signal: np.ndarray, orders: int) -> np.ndarray:
    """(T, orders + 1, n): a periodic signal (T, n) of period PERIOD_S and its time derivatives, exact to rounding: Fourier series."""
    rows = np.fft.rfft(signal, axis=0)
    rows[np.abs(rows) < 1e-13 * np.abs(rows).max(initial=1e-300)] = 0.0  # rounding, which high derivatives would blow up
    w = 2j * np.pi / PERIOD_S * np.arange(len(rows))
    return np.stack([np.fft.irfft(w[:, None] ** k * rows, len(signal), axis=0) for k in range(orders + 1)], axis=1)
