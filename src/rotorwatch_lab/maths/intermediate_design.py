"""Design of the intermediate observer: poles, gains, and the matrix inequality that guarantees bounded errors.

    dx/dt = A x + B u + E f + G + N xi,  y = C x,  tau = f - S x,  S = alpha E'
    dxhat/dt   = A xhat + B u + E fhat + G + L (y - C xhat)
    dtauhat/dt = -S (A xhat + B u + E tauhat + E S xhat + G),        fhat = tauhat + S xhat

Differentiating fhat gives dfhat/dt = alpha E' L (y - C xhat): a proportional-integral observer, whatever u, G and A are.
With L = diag(lp I, lv I) on double integrators each channel is  fhat / f = alpha lv / (s^2 + lv s + alpha lv).

Source: Nguyen, Huynh, Do, Mung and Hong, Robust fault estimation using the intermediate observer, Sensors 20 (2020) 4917,
eqs. (7)-(29) and table 1, after Zhu, Yang, Wang and Wang, IEEE TAC 61 (2016) 2518. In (28) I_n is of the size of f, in (29) Sigma < 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks, optional
from rotorwatch.base.backend import jnp
from rotorwatch.errors import ConfigError

RANK = 1e-8  # singular values, angles and real parts below that count as zero
MARGIN = 1e-7  # eigenvalues above minus this much, relative to the largest, do not count as negative


class Synthesis(NamedTuple):
    """A solution of the inequality: L (n_x, n_y), mu, and the largest eigenvalue of Sigma, which is negative."""

    L: np.ndarray
    mu: float
    largest: float


class RankTest(NamedTuple):
    """holds; zeros: the numbers with a real part of at least zero where the rank of eq. (8) falls; everywhere: it is short at any."""

    holds: bool
    zeros: np.ndarray
    everywhere: bool


class Bound(NamedTuple):
    """dV/dt <= -sigma |e|^2 + eta, and the radius within which the errors e = (e_x, e_tau) end, NaN where sigma is not positive."""

    sigma: float
    eta: float
    radius: float


def double_integrators(channels: int = 4):
    """A, C, E of n double integrators with all states measured: the quadrotor's near hover."""
    eye, zero = np.eye(channels), np.zeros((channels, channels))
    return np.block([[zero, eye], [zero, zero]]), np.eye(2 * channels), np.vstack([zero, eye])


def rank_test(A, C, E) -> RankTest:
    """Assumption 4, eq. (8): rank [A - lambda I, E; C, 0] = n + rank(E) for every lambda whose real part is not negative.

    A (n, n), C (p, n), E (n, q). Faults whose effect is hidden from y, once or as long as they grow by exp(lambda t), fail it. The rank
    falls at the eigenvalues of A + E F on the largest subspace that y does not see and that E F keeps the state in.
    Raises ConfigError for matrices that do not fit together.
    """
    A = checks.finite("A", A)
    n = len(A)
    A, C = checks.shape("A", A, n, n), checks.finite("C", C)
    E = checks.finite("E", E)
    C, E = checks.shape("C", C, len(C), n), checks.shape("E", E, n, E.shape[-1])
    E = _range(E)
    hidden = _kernel(C)
    while True:
        reached = _range(np.hstack([hidden, E]))
        smaller = _kernel(np.vstack([C, A - reached @ (reached.T @ A)]))
        if smaller.shape[1] == hidden.shape[1]:
            break
        hidden = smaller
    both = np.hstack([hidden, E])
    if np.linalg.matrix_rank(both, tol=RANK) < both.shape[1]:
        return RankTest(False, np.zeros(0, complex), True)
    moves = np.linalg.lstsq(both, A @ hidden, rcond=None)[0][: hidden.shape[1]]
    zeros = np.asarray(np.linalg.eigvals(moves) if hidden.shape[1] else np.zeros(0), complex)
    zeros = zeros[np.real(zeros) >= -RANK * (1.0 + np.linalg.norm(A))]
    return RankTest(zeros.size == 0, zeros, False)


def sigma(A, C, E, N, L, alpha, epsilon, mu) -> np.ndarray:
    """Sigma_1 of eqs. (25)-(28): the errors are bounded when it is negative definite."""
    one_one = A - L @ C + (A - L @ C).T + 2 * alpha * E @ E.T + N @ N.T / epsilon
    one_two = E - mu * alpha * A.T @ E - mu * alpha**2 * E @ E.T @ E
    return np.block([[one_one, one_two], [one_two.T, mu * _free_of_gain(E, N, alpha, epsilon)]])


def bound(A, C, E, N, L, alpha, epsilon, mu, disturbance: float, fault_rate: float) -> Bound:
    """The ultimate bound of Theorem 1, for |xi| <= disturbance and |df/dt| <= fault_rate.

    V = e_x' e_x + mu e_tau' e_tau falls wherever |e|^2 > eta / sigma, so that |e| ends within sqrt(eta / sigma) times the root of the
    ratio of V's largest and smallest weight.
    """
    sigma_min = float(-np.linalg.eigvalsh(sigma(A, C, E, N, L, alpha, epsilon, mu)).max())
    eta = epsilon * (1.0 + mu * alpha) * disturbance**2 + mu * epsilon * fault_rate**2
    if sigma_min <= 0.0:
        return Bound(sigma_min, eta, float("nan"))
    return Bound(sigma_min, eta, float(np.sqrt(eta / sigma_min * max(1.0, mu) / min(1.0, mu))))


def table_1(A, C, E, N, mu, epsilon, solver: str = "CLARABEL") -> tuple[float, Synthesis]:
    """Steps 1 and 2 of the paper's procedure: with mu chosen, (alpha, solution) that satisfy the inequality.

    It is linear in L, but not in alpha: alpha is searched for, and that is taken which needs the smallest L. Raises ConfigError as
    `synthesize` does.
    """
    from scipy.optimize import minimize_scalar

    checks.positive("mu", mu)
    least = _least_alpha(E, N, epsilon)

    def solved(log):
        return synthesize(A, C, E, N, least + np.exp(log), epsilon, solver, mu)

    def size(log):
        try:
            return float(np.linalg.norm(solved(log).L))
        except ConfigError:
            return 1e6  # so near the limit that no gain is large enough

    grid = np.linspace(np.log(0.1), np.log(10.0 + 3.0 / np.sqrt(mu)), 12)
    k = int(np.clip(np.argmin([size(log) for log in grid]), 1, len(grid) - 2))
    within = (grid[k - 1], grid[k + 1])
    optimum: Any = minimize_scalar(size, bounds=within, method="bounded", options={"xatol": 1e-3})
    best = float(optimum.x)
    return float(least + np.exp(best)), solved(best)


def _least_alpha(E, N, epsilon) -> float:
    """alpha above which Sigma_22 is negative definite; raises ConfigError where it is for none."""
    checks.positive("epsilon", epsilon)
    from scipy.linalg import eigh

    EN = E.T @ N
    slope = 2 * E.T @ E - EN @ EN.T / epsilon  # Sigma_22 / mu = I / epsilon - alpha slope
    smallest = eigh(slope, eigvals_only=True)[0]
    if smallest <= 0:
        raise ConfigError(
            f"The matrix inequality has no solution for epsilon = {epsilon:g}, whatever alpha, L and mu are; choose a larger epsilon "
            "(above one half where E and N are the same unit columns)."
        )
    return float(1.0 / (epsilon * smallest))


def synthesize(A, C, E, N, alpha, epsilon, solver: str = "CLARABEL", mu: float | None = None) -> Synthesis:
    """The smallest L, and a mu (or with the given one), that satisfy the inequality: linear in both once alpha and epsilon are fixed.

    The solver's word is not taken for it: Sigma is built again from its answer, and its eigenvalues decide. Raises
    ConfigError when there is no solution, when the solver has none, and when CVXPY is not there.
    """
    checks.positive("alpha", alpha)
    checks.positive("epsilon", epsilon)
    n_x, n_f = E.shape
    worst = np.linalg.eigvalsh(_free_of_gain(E, N, alpha, epsilon)).max()
    if worst >= 0:
        raise ConfigError(
            f"The matrix inequality has no solution for alpha = {alpha:g}, epsilon = {epsilon:g}: Sigma_22 has the eigenvalue "
            f"{worst:.3g} mu whatever L is; choose epsilon above (1 + alpha) / (2 alpha)."
        )
    cp = optional.library("cvxpy", "Solving the matrix inequality")
    L, share = cp.Variable((n_x, C.shape[0])), cp.Variable() if mu is None else cp.Constant(checks.positive("mu", mu))
    one_one = A - L @ C + (A - L @ C).T + 2 * alpha * E @ E.T + N @ N.T / epsilon
    one_two = E - share * (alpha * A.T @ E + alpha**2 * E @ E.T @ E)
    whole = cp.bmat([[one_one, one_two], [one_two.T, share * _free_of_gain(E, N, alpha, epsilon)]])
    inside = np.eye(n_x + n_f) * (1e-3 if mu is None else 0.01 * min(1.0, mu))
    limits = [share >= 1e-6] if mu is None else []
    problem = cp.Problem(cp.Minimize(cp.norm(L, "fro") + 1e-6 * share), [0.5 * (whole + whole.T) << -inside, *limits])
    try:
        problem.solve(solver=solver)
    except cp.error.SolverError as error:
        raise ConfigError(f"The solver {solver} failed on the matrix inequality; try CLARABEL or SCS.") from error
    if L.value is None or share.value is None:
        raise ConfigError(f"The matrix inequality has no solution: {solver} says {problem.status}.")
    return checked(A, C, E, N, alpha, epsilon, np.asarray(L.value), float(share.value))


def checked(A, C, E, N, alpha, epsilon, L, mu) -> Synthesis:
    """L and mu as a `Synthesis` when Sigma's eigenvalues confirm them; raises ConfigError when not."""
    values = np.linalg.eigvalsh(sigma(A, C, E, N, L, alpha, epsilon, mu))
    if mu <= 0 or values.max() >= -MARGIN * np.abs(values).max():
        raise ConfigError(f"The gains do not satisfy the matrix inequality: mu = {mu:.3g}, largest eigenvalue of Sigma {values.max():.3g}.")
    return Synthesis(L, mu, float(values.max()))


def rates(settling_time_s: float, within: float = 0.1) -> tuple[float, float]:
    """(alpha, lv) of a channel with a double pole that forgets a step to the share `within` in settling_time_s.

    A double pole at -a means lv = 2 a, alpha = a / 2, and a share (1 + a t) exp(-a t) is left after t.
    """
    from scipy.special import lambertw

    checks.positive("settling_time_s", settling_time_s)
    checks.between("within", within, 1e-12, 1 - 1e-12)
    at = -1.0 - float(np.real(lambertw(-within / np.e, -1)))  # (1 + z) exp(-z) = within
    return 0.5 * at / settling_time_s, 2.0 * at / settling_time_s


def exact_gains(lp, lv, alpha, dt):
    """(kp, k1, k2): gains of the sampled observer that has the continuous one's poles exactly, at any dt.

    On x(k+1) = x + f dt with e = y - xpred, x = xpred + k1 e, f += k2 e, the poles z have the sum 2 - k1 - k2 dt and the product
    1 - k1. Poles exp(s dt) of s^2 + lv s + alpha lv therefore need k1 = 1 - z1 z2 and k2 = (1 - z1)(1 - z2) / dt. kp, of a
    measured state that no loss drives, keeps the pole -lp.
    """
    square = 0.25 * lv**2 - alpha * lv
    root = jnp.sqrt(jnp.abs(square))
    fast, slow = jnp.exp((root - 0.5 * lv) * dt), jnp.exp((-root - 0.5 * lv) * dt)  # both real
    half = jnp.exp(-0.5 * lv * dt)
    total = jnp.where(square >= 0, fast + slow, 2.0 * half * jnp.cos(root * dt))
    product = half * half
    real = (1.0 - fast) * (1.0 - slow)  # 1 + product - total without its cancellation
    return 1.0 - jnp.exp(-lp * dt), 1.0 - product, jnp.where(square >= 0, real, 1.0 + product - total) / dt


def euler_gains(lp, lv, alpha, dt):
    """(kp, k1, k2) of Euler's method on dx/dt = ... + l e, df/dt = alpha lv e; unstable from lv dt (1 + alpha dt / 2) = 2 on."""
    return lp * dt, lv * dt, alpha * lv * dt


def riccati_gains(F, G, E, H, Q, R) -> tuple[np.ndarray, np.ndarray]:
    """(K_x, K_f), (n_x, n_y) each: steady gains where a state that losses drive is not measured itself.

    x(k+1) = F x + G f with process noise Q, y = H x with variances R; f = E w, and w (r,) walks by unit variance a step. The
    Riccati equation of [x; w]; raises ConfigError when w is not observable from y (Assumption 4 fails).
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    n, r = E.shape
    used = np.flatnonzero(np.abs(H).sum(axis=1) > 0)
    A = np.block([[F, G @ E], [np.zeros((r, n)), np.eye(r)]])
    C = np.hstack([H[used], np.zeros((used.size, r))])
    noise = np.block([[Q, np.zeros((n, r))], [np.zeros((r, n)), np.eye(r)]])
    K = np.zeros((n + r, len(H)))
    try:
        P = solve_discrete_are(A.T, C.T, noise, np.diag(R[used]))
        K[:, used] = np.linalg.solve(C @ P @ C.T + np.diag(R[used]), C @ P).T
        stable = np.abs(np.linalg.eigvals((np.eye(n + r) - K[:, used] @ C) @ A)).max() < 1.0 - 1e-9
    except (LinAlgError, ValueError):
        stable = False
    if not stable:
        raise ConfigError(
            "The intermediate observer is not defined for these measurements: the effect of the losses on the state is not "
            "observable from them; measure the states that rotors drive, or their integrals."
        )
    return K[:n], E @ K[n:]


def _free_of_gain(E, N, alpha, epsilon) -> np.ndarray:
    """Sigma_22 / mu, which holds no L: eq. (28)."""
    EN = E.T @ N
    return np.eye(E.shape[1]) / epsilon - 2 * alpha * E.T @ E + alpha / epsilon * EN @ EN.T


def _range(M) -> np.ndarray:
    """Orthonormal columns that span those of M."""
    U, s, _ = np.linalg.svd(M, full_matrices=False)
    return U[:, s > RANK * max(1.0, s.max(initial=0.0))]


def _kernel(M) -> np.ndarray:
    """Orthonormal columns that span what M maps to zero."""
    _, s, V = np.linalg.svd(M)
    return V[(s > RANK * max(1.0, s.max(initial=0.0))).sum() :].T
