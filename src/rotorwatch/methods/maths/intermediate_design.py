"""Design of the intermediate observer: poles, gains, and the matrix inequality that guarantees bounded errors.

    dx/dt = A x + B u + E f + G + N xi,  y = C x,  tau = f - S x,  S = alpha E'
    dxhat/dt   = A xhat + B u + E fhat + G + L (y - C xhat)
    dtauhat/dt = -S (A xhat + B u + E tauhat + E S xhat + G),        fhat = tauhat + S xhat

Differentiating fhat gives dfhat/dt = alpha E' L (y - C xhat): a proportional-integral observer, whatever u, G and A are.
With L = diag(lp I, lv I) on double integrators each channel is  fhat / f = alpha lv / (s^2 + lv s + alpha lv).

Source: Nguyen, Huynh, Do, Mung and Hong, Robust fault estimation using the intermediate observer, Sensors 20 (2020) 4917,
eqs. (7)-(29), after Zhu, Yang, Wang and Wang, IEEE TAC 61 (2016) 2518. In (28) I_n is of the size of f, in (29) Sigma < 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks, optional
from rotorwatch.base.backend import jnp
from rotorwatch.errors import ConfigError

MARGIN = 1e-7  # eigenvalues above minus this much, relative to the largest, do not count as negative


class Synthesis(NamedTuple):
    """A solution of the inequality: L (n_x, n_y), mu, and the largest eigenvalue of Sigma, which is negative."""

    L: np.ndarray
    mu: float
    largest: float


class Bound(NamedTuple):
    """dV/dt <= -sigma |e|^2 + eta, and the radius within which the errors e = (e_x, e_tau) end, NaN where sigma is not positive."""

    sigma: float
    eta: float
    radius: float


def double_integrators(channels: int = 4):
    """A, C, E of n double integrators with all states measured: the quadrotor's near hover."""
    eye, zero = np.eye(channels), np.zeros((channels, channels))
    return np.block([[zero, eye], [zero, zero]]), np.eye(2 * channels), np.vstack([zero, eye])


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


def synthesize(A, C, E, N, alpha, epsilon, solver: str = "CLARABEL") -> Synthesis:
    """The smallest L, and a mu, that satisfy the inequality: linear in both once alpha and epsilon are fixed.

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
    L, mu = cp.Variable((n_x, C.shape[0])), cp.Variable()
    one_one = A - L @ C + (A - L @ C).T + 2 * alpha * E @ E.T + N @ N.T / epsilon
    one_two = E - mu * (alpha * A.T @ E + alpha**2 * E @ E.T @ E)
    whole = cp.bmat([[one_one, one_two], [one_two.T, mu * _free_of_gain(E, N, alpha, epsilon)]])
    inside = 1e-3 * np.eye(n_x + n_f)
    problem = cp.Problem(cp.Minimize(cp.norm(L, "fro") + 1e-6 * mu), [0.5 * (whole + whole.T) << -inside, mu >= 1e-6])
    try:
        problem.solve(solver=solver)
    except cp.error.SolverError as error:
        raise ConfigError(f"The solver {solver} failed on the matrix inequality; try CLARABEL or SCS.") from error
    if L.value is None or mu.value is None:
        raise ConfigError(f"The matrix inequality has no solution: {solver} says {problem.status}.")
    return checked(A, C, E, N, alpha, epsilon, np.asarray(L.value), float(mu.value))


def checked(A, C, E, N, alpha, epsilon, L, mu) -> Synthesis:
    """L and mu as a `Synthesis` when Sigma's eigenvalues confirm them; raises ConfigError when not."""
    values = np.linalg.eigvalsh(sigma(A, C, E, N, L, alpha, epsilon, mu))
    if mu <= 0 or values.max() >= -MARGIN * np.abs(values).max():
        raise ConfigError(
            f"The gains do not satisfy the matrix inequality: mu = {mu:.3g}, largest eigenvalue of Sigma {values.max():.3g}."
        )
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
