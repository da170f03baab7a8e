"""Gains L of observers z+ = f(z, u) + L (y - h(z, u)): printed, placed, stationary, and by linear matrix inequalities.

Everything here is design: it runs once, with any linear algebra, and what a solver returns is checked again by eigenvalues.

    common_lyapunov   one quadratic Lyapunov function for Jacobians sampled from a box: contraction wherever the Jacobians
                      between true and estimated state lie in the convex hull of the samples
    theorem_1         the matrix inequality of Rot, Hasan and Manoonpong (2020), eq. (7)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import linearise, matrix_inequality
from rotorwatch_lab.maths.small import symmetric

DOUBLINGS = 30  # of the Riccati recursion: 2^30 steps are forever


@dataclass(frozen=True)
class Contraction:
    """gain (n, m) and the Lyapunov matrix G (n, n) that proves it: V = e' G e falls by decay^2 or more in every step."""

    gain: np.ndarray
    G: np.ndarray
    decay: float


def printed(n: int = 6, m: int = 3, g: float = 9.0, y: float = 3.0) -> np.ndarray:
    """(n, m) L = G^-1 Y with G = g I and Y = [y I; 0], as Rot, Hasan and Manoonpong print it: a third of each measured state's
    error, nothing for the momenta."""
    return y / g * np.eye(n, m)


def jacobians(system, dt: float, half_width, *, centre=None, u=None, count: int = 48, seed: int = 0) -> np.ndarray:
    """(count, n, n) F of the plant's step at points of a box: half of them corners, half of them inside, the first the centre.

    half_width (n_x,), centre (n_x,; default x0): of the box. u (n_u,): input, default 0. Raises ConfigError.
    """
    n = system.n_x
    checks.between("half_width", checks.shape("half_width", half_width, n), 0.0, np.inf)
    centre = np.asarray(system.x0 if centre is None else checks.shape("centre", centre, n), float)
    rng = np.random.default_rng(seed)
    offsets = rng.uniform(-1.0, 1.0, (max(int(count), 1), n))
    offsets[1::2] = np.sign(offsets[1::2])
    offsets[0] = 0.0
    return np.asarray(_F(system, centre + offsets * np.asarray(half_width, float), u, dt))


def place(system, dt: float, poles, *, x=None, u=None) -> np.ndarray:
    """(n_x, n_y) L that gives F - L C these poles (n_x,), at x (default x0) and u (default 0); inside the unit circle.

    Raises ConfigError for poles outside, or that cannot be placed because the plant is not observable there.
    """
    from scipy.signal import place_poles

    poles = np.asarray(checks.shape("poles", poles, system.n_x))
    if not (np.abs(poles) < 1.0).all():
        raise ConfigError(f"poles must lie inside the unit circle; the largest is {np.abs(poles).max():.4g}.")
    F, C = (np.asarray(a) for a in _local(system, dt, x, u))
    try:
        placed: Any = place_poles(F.T, C.T, poles)
    except ValueError as why:
        raise ConfigError(f"These poles cannot be placed ({str(why).rstrip('.')}).") from why
    L = placed.gain_matrix.T
    found = np.linalg.eigvals(F - L @ C)
    if not np.allclose(np.sort_complex(found), np.sort_complex(poles), atol=1e-6):
        raise ConfigError("These poles cannot be placed: what is measured does not observe the whole state.")
    return L


def stationary(system, dt: float, *, x=None, u=None):
    """(n_x, n_y) gain of the stationary Kalman predictor at x (default x0), u (default 0): L = F P C' (C P C' + R)^-1.

    P solves the Riccati equation, by doubling (Anderson, Int. J. Control 28, 1978). Inside a compiled program too.
    """
    F, C = _local(system, dt, x, u)
    R = system.R(np.zeros(system.n_u) if u is None else u)
    F, C, R, P = (a if not checks.concrete((F, C, R)) else np.asarray(a) for a in (F, C, R, system.Q(dt)))
    xp: Any = np if checks.concrete((F, C, R, P)) else jnp
    A, G, eye = F.T, C.T @ (C / R[:, None]), np.eye(system.n_x)
    for _ in range(DOUBLINGS):
        AW = xp.linalg.solve((eye + G @ P).T, A.T).T  # A (I + G P)^-1
        A, G, P = AW @ A, G + AW @ G @ A.T, P + A.T @ P @ xp.linalg.solve(eye + G @ P, A)
        G, P = 0.5 * (G + G.T), 0.5 * (P + P.T)
    L = F @ xp.linalg.solve(C @ P @ C.T + xp.diag(R), C @ P).T
    if xp is np and not np.isfinite(L).all():
        raise ConfigError("There is no stationary gain: what is measured does not observe the whole state at this point.")
    return L


def common_lyapunov(F, C, decay: float, *, scale=None) -> Contraction:
    """The smallest gain with which V = e' G e falls by decay^2 a step under every F (k, n, n): G and Y = G L with

        [decay^2 G, (G F - Y C)'; G F - Y C, G] >= 0 for every F,   [t, Y'; Y, G] >= 0,   G >= I,   t least.

    C (m, n). scale (n,): size of each state, for conditioning and for what "small gain" means. Raises ConfigError when no gain
    reaches the decay, or when the eigenvalues of what the solver returns do not confirm it.
    """
    cp = matrix_inequality.library()
    F, C = np.atleast_3d(np.asarray(F, float)), np.asarray(C, float)
    n, m = C.shape[1], C.shape[0]
    checks.shape("F", F, len(F), n, n)
    checks.between("decay", decay, 0.0, 1.0)
    T = np.ones(n) if scale is None else checks.positive("scale", checks.shape("scale", scale, n)) * np.ones(n)
    scaled, seen = F * T / T[:, None], C * T
    G, Y, t = cp.Variable((n, n), symmetric=True), cp.Variable((n, m)), cp.Variable()
    limits: list = [G >> np.eye(n), cp.bmat([[t * np.eye(m), Y.T], [Y, G]]) >> 0]
    for one in scaled:
        X = G @ one - Y @ seen
        limits.append(cp.bmat([[decay**2 * G, X.T], [X, G]]) >> 0)
    problem = cp.Problem(cp.Minimize(t), limits)
    if not matrix_inequality.solved(problem):
        raise ConfigError(f"No observer gain makes all {len(F)} Jacobians contract by {decay:g} a step; ask for less.")
    G_ = symmetric(_value(G))
    L = np.linalg.solve(G_, _value(Y))
    reached = contraction(scaled, seen, L, G_)
    if not reached < 1.0 or reached > decay + 1e-4:
        raise ConfigError(f"The solver's gain contracts by {reached:.6g} a step, not by {decay:g}; scale the states better.")
    return Contraction(T[:, None] * L, G_ / T / T[:, None], reached)


def contraction(F, C, L, G) -> float:
    """Largest factor by which sqrt(e' G e) can change in a step, over all F (k, n, n): 2-norms of G^1/2 (F - L C) G^-1/2."""
    root = np.linalg.cholesky(np.asarray(G, float)).T
    error = np.asarray(F, float) - np.asarray(L) @ np.asarray(C)
    return float(np.linalg.norm(root @ error @ np.linalg.inv(root), 2, axis=(1, 2)).max())


@dataclass(frozen=True)
class Lipschitz:
    """Constants of a function df = f(x1) - f(x2), dx = x1 - x2: df'dx <= rho |dx|^2, df'df <= beta |dx|^2 + eta dx'df."""

    rho: float
    beta: float
    eta: float


def lipschitz(D, eta: float = 0.0) -> Lipschitz:
    """The least rho and, for this eta, beta of a function whose Jacobians are D (k, n, n), by their eigenvalues."""
    D = np.asarray(D, float)
    half = 0.5 * (D + np.swapaxes(D, 1, 2))
    inner = np.swapaxes(D, 1, 2) @ D - eta * half
    return Lipschitz(float(np.linalg.eigvalsh(half).max()), float(np.linalg.eigvalsh(inner).max()), float(eta))


def is_vacuous(constants: Lipschitz) -> bool:
    """True if only constant functions have such constants: df'df - eta dx'df <= beta |dx|^2 with beta < -eta^2 / 4."""
    return constants.beta < -0.25 * constants.eta**2


def theorem_1(A, C, G, Y, constants: Lipschitz, eps_1: float, eps_2: float) -> float:
    """Largest eigenvalue of the matrix of Theorem 1, eq. (7): the theorem applies where it is below zero."""
    return float(theorem_1_eigenvalues(A, C, G, Y, constants, eps_1, eps_2).max())


def theorem_1_eigenvalues(A, C, G, Y, constants: Lipschitz, eps_1: float, eps_2: float) -> np.ndarray:
    """(3 n,) eigenvalues of the matrix of Theorem 1, eq. (7), ascending."""
    A, C, G = (np.asarray(a, float) for a in (A, C, G))
    GL, eye, none = G @ A - np.asarray(Y, float) @ C, np.eye(len(A)), np.zeros_like(A)
    return np.linalg.eigvalsh(np.block(_theorem_1(GL, G, eye, none, constants, eps_1, eps_2)))


def theorem_1_best(A, C, constants: Lipschitz) -> tuple[float, np.ndarray, np.ndarray, float, float]:
    """The G with trace n, Y and eps_1, eps_2 >= 0 that make the largest eigenvalue of (7) least: (it, G, Y, eps_1, eps_2).

    Below zero: feasible, and L = G^-1 Y is a gain. Not below zero (to about 1e-7): no gain satisfies the theorem.
    """
    cp = matrix_inequality.library()
    A, C = np.asarray(A, float), np.asarray(C, float)
    n, m = C.shape[1], C.shape[0]
    G, Y = cp.Variable((n, n), symmetric=True), cp.Variable((n, m))
    eps, t = cp.Variable(2, nonneg=True), cp.Variable()
    blocks = _theorem_1(G @ A - Y @ C, G, np.eye(n), np.zeros((n, n)), constants, eps[0], eps[1])
    limits: list = [cp.bmat(blocks) << t * np.eye(3 * n), G >> 1e-6 * np.eye(n), cp.trace(G) == n]
    if not matrix_inequality.solved(cp.Problem(cp.Minimize(t), limits)):
        raise ConfigError("The solver finds no answer to Theorem 1's inequality; scale the states better.")
    G_, Y_, (eps_1, eps_2) = symmetric(_value(G)), _value(Y), np.maximum(_value(eps), 0.0).tolist()
    return theorem_1(A, C, G_, Y_, constants, eps_1, eps_2), G_, Y_, eps_1, eps_2


def _theorem_1(GL, G, eye, none, k: Lipschitz, eps_1, eps_2):
    """Blocks of eq. (7)."""
    a_1, a_2 = eps_1 * k.rho + eps_2 * k.beta, 0.5 * (k.eta * eps_2 - eps_1)
    return [[-G + a_1 * eye, GL.T + a_2 * eye, GL.T], [GL + a_2 * eye, G - eps_2 * eye, none], [GL, none, -G]]


def _local(system, dt, x, u):
    """(F, C) of a plant at one point, no loss."""
    x = system.x0 if x is None else x
    u, theta = np.zeros(system.n_u) if u is None else u, np.zeros(system.n_theta)

    def both(x):
        return linearise.transition(system, x, u, theta, dt).by_x, linearise.measurement(system, x, u, theta).by_x

    return jax.jit(both)(jax.numpy.asarray(x, float))


def _F(system, points, u, dt):
    u, theta = np.zeros(system.n_u) if u is None else np.asarray(u, float), np.zeros(system.n_theta)
    return jax.jit(jax.vmap(lambda x: linearise.transition(system, x, u, theta, dt).by_x))(points)


def _value(variable) -> np.ndarray:
    return np.asarray(variable.value, float)
