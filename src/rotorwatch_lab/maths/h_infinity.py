"""H-infinity norm of a linear system, and state feedback that keeps it small over a whole interval of actuator gains.

    dx/dt = A x + B u + E w,   z = C x + D u,   u = K x,   |T_zw| = sup over omega of the largest singular value of T_zw(j omega)

Synthesis: with V = x' X^-1 x and Y = K X, the bounded real lemma is linear in X, Y and the level g,

    [A_i X + B_i Y + (A_i X + B_i Y)', E, (C X + D Y)'; E', -g I, 0; C X + D Y, 0, -g I] < 0   at every vertex i

and, for a controller that is sampled each dt seconds (forward differences),

    [s^2 X, (X + dt (A_i X + B_i Y))'; X + dt (A_i X + B_i Y), X] > 0,   s just below 1   at every vertex i.

Both are convex in (A_i, B_i): one X for all vertices proves stability and the level g at every point of their convex hull, also while
the point moves. Sources: Boyd, El Ghaoui, Feron and Balakrishnan, Linear Matrix Inequalities in System and Control Theory, SIAM 1994,
2.7.3 and 7.5; Gahinet and Apkarian, Int. J. Robust Nonlinear Control 4 (1994) 421.

Norm: `sweep` looks at frequencies; `bisection` asks whether the Hamiltonian matrix

    M(g) = [A + E R^-1 F'C, E R^-1 E'; -C'(I + F R^-1 F') C, -(A + E R^-1 F'C)'],   R = g^2 I - F'F,   z = C x + F w

has eigenvalues on the imaginary axis, which it has just when g is at most the norm: Boyd, Balakrishnan and Kabamba, Mathematics of
Control, Signals, and Systems 2 (1989) 207; `bounded_real` solves the lemma's inequality. None of the three knows of the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.base import checks
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import matrix_inequality

ON_AXIS = 1e-8  # a real part below this share of the largest eigenvalue counts as none
SAMPLED = 1.0 - 1e-4  # sqrt(V) falls to this share a sample, or lower: the solver has to leave room for rounding


@dataclass(frozen=True)
class Synthesis:
    """A controller u = K x (m, n) and its proof. X (n, n): V = x' X^-1 x falls at every vertex. level: bound of the norm over the whole
    hull; norm: largest closed-loop norm of a vertex, `worst` which; decay: 1/s by which every vertex's V falls, or more."""

    K: np.ndarray
    X: np.ndarray
    level: float
    norm: float
    worst: int
    decay: float


def sweep(A, E, C, F=None, points: int = 400) -> float:
    """The norm by a frequency sweep: singular values at 0, on a grid around all poles, and by golden section about the largest three.

    A (n, n), E (n, n_w), C (n_z, n), F (n_z, n_w; default 0). Infinite for a system that is not stable.
    """
    A, E, C, F = _system(A, E, C, F)
    poles = np.linalg.eigvals(A)
    if poles.real.max(initial=-1.0) >= 0:
        return float("inf")
    size = np.abs(poles)
    grid = np.geomspace(1e-3 * size.min(), 1e3 * size.max(), points)
    grid = np.unique(np.concatenate([[0.0], grid, np.abs(poles.imag), size]))
    values = _gains(grid, A, E, C, F)
    best = max(float(values.max()), float(np.linalg.norm(F, 2)))
    for k in np.argsort(values)[-3:]:
        best = max(best, _peak(A, E, C, F, grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]))
    return best


def bisection(A, E, C, F=None, tolerance: float = 1e-9) -> float:
    """The norm by bisection on the Hamiltonian matrix, to this relative tolerance; infinite for a system that is not stable."""
    A, E, C, F = _system(A, E, C, F)
    if np.linalg.eigvals(A).real.max(initial=-1.0) >= 0:
        return float("inf")
    static = float(np.linalg.norm(F, 2))
    low = max(static, float(np.linalg.norm(F - C @ np.linalg.solve(A, E), 2)))
    if not low:
        low = float(_gains(np.abs(np.linalg.eigvals(A)), A, E, C, F).max())
        if not low:
            return 0.0
    high = 2.0 * low
    while _crosses(A, E, C, F, high):
        low, high = high, 2.0 * high
    while high - low > tolerance * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _crosses(A, E, C, F, middle) else (low, middle)
    return 0.5 * (low + high)


def bounded_real(A, E, C, F=None) -> float:
    """The norm as the least level of the bounded real lemma, a linear matrix inequality. Raises ConfigError when the solver finds none."""
    cp = matrix_inequality.library()
    A, E, C, F = _system(A, E, C, F)
    n, n_w, n_z = len(A), E.shape[1], len(C)
    P, g = cp.Variable((n, n), symmetric=True), cp.Variable()
    lemma = cp.bmat([[A.T @ P + P @ A, P @ E, C.T], [E.T @ P, -g * np.eye(n_w), F.T], [C, F, -g * np.eye(n_z)]])
    if not matrix_inequality.solved(cp.Problem(cp.Minimize(g), [lemma << 0, P >> 0])) or g.value is None:
        raise ConfigError("The solver finds no level of the bounded real lemma; is the system stable, and are its states well scaled?")
    return float(g.value)


def state_feedback(A, B, E, C, D, *, dt: float | None = None, scale=None, slack: float = 0.0) -> Synthesis:
    """The feedback u = K x with the least level over the convex hull of the vertices (A_i, B_i).

    A (k, n, n) or (n, n), B (k, n, m) or (n, m): vertices. E (n, n_w), C (n_z, n), D (n_z, m): disturbance and what shall stay small. dt
    [s]: the controller is sampled, and must be stable so, by forward differences; None: it is not. scale (n,): size of each state, for
    conditioning. slack: how much above the least level, as a share, may be given away for the least level in the vertices' middle: else
    a vertex that no controller can help leaves everything else undecided.
    Raises ConfigError when no controller stabilises all vertices with one quadratic Lyapunov function, and when the eigenvalues of what
    the solver returned do not confirm it.
    """
    cp = matrix_inequality.library()
    A, B = (np.asarray(part, float) for part in (A, B))
    A, B = A if A.ndim == 3 else A[None], B if B.ndim == 3 else B[None]
    count, n, m = max(len(A), len(B)), A.shape[-1], B.shape[-1]
    A, B = np.broadcast_to(A, (count, n, n)), np.broadcast_to(B, (count, n, m))
    E, C, D = (np.asarray(part, float) for part in (E, C, D))
    for label, value, *shape in (("E", E, n, E.shape[-1]), ("C", C, len(C), n), ("D", D, len(C), m)):
        checks.finite(label, checks.shape(label, value, *shape))
    checks.finite("A", A)
    checks.finite("B", B)
    for i, (one_a, one_b) in enumerate(zip(A, B, strict=True)):
        if (stuck := _not_stabilisable(one_a, one_b)) is not None:
            raise ConfigError(
                f"These are bounds that exclude every controller: at vertex {i + 1} of {count} no feedback can move the eigenvalue "
                f"{stuck:.3g} of A; narrower bounds are needed, above all where an actuator's gain may be zero."
            )
    T = np.ones(n) if scale is None else checks.positive("scale", checks.shape("scale", scale, n)) * np.ones(n)
    a, b, e, c = A * T / T[:, None], B / T[:, None], E / T[:, None], C * T
    X, Y, g = cp.Variable((n, n), symmetric=True), cp.Variable((m, n)), cp.Variable()
    n_w, n_z = E.shape[1], len(C)
    out, none = c @ X + D @ Y, np.zeros((n_w, n_z))

    def lemma(moved, g):
        blocks = [[moved + moved.T, e, out.T], [e.T, -g * np.eye(n_w), none], [out, none.T, -g * np.eye(n_z)]]
        return cp.bmat(blocks) << 0

    limits: list = [X >> 1e-6 * np.eye(n)]
    for one_a, one_b in zip(a, b, strict=True):
        moved = one_a @ X + one_b @ Y
        limits.append(lemma(moved, g))
        if dt is not None:
            stepped = X + dt * moved
            limits.append(cp.bmat([[SAMPLED**2 * X, stepped.T], [stepped, X]]) >> 0)
    if not matrix_inequality.solved(cp.Problem(cp.Minimize(g), limits)) or X.value is None:
        raise ConfigError(
            "These are bounds that exclude every controller: no state feedback makes one quadratic Lyapunov function fall at all "
            f"{count} vertices; narrower bounds are needed, above all where an actuator's gain may be zero."
        )
    if slack > 0 and count > 1:
        first_solution, middle = (np.asarray(X.value), np.asarray(Y.value)), cp.Variable()
        in_middle = lemma(a.mean(axis=0) @ X + b.mean(axis=0) @ Y, middle)
        second = cp.Problem(cp.Minimize(middle), [*limits, in_middle, g <= (1.0 + slack) * float(g.value)])
        if not matrix_inequality.solved(second) or X.value is None:
            X.value, Y.value = first_solution
    X_ = 0.5 * (np.asarray(X.value) + np.asarray(X.value).T)
    K = np.linalg.solve(X_, np.asarray(Y.value).T).T / T
    return checked(A, B, E, C, D, K, T[:, None] * X_ * T, dt)


def checked(A, B, E, C, D, K, X, dt=None) -> Synthesis:
    """K and X as a `Synthesis` when eigenvalues confirm them: V falls at all vertices (sampled too, where dt is given), and the level is
    the least that X proves. Raises ConfigError when not."""
    A, B = (np.asarray(part, float) for part in (A, B))
    closed = A + B @ K
    closed = closed if closed.ndim == 3 else closed[None]
    decay = quadratic_decay(closed, X)
    if not decay > 0:
        raise ConfigError(f"The solver's controller does not make the Lyapunov function fall at all vertices (decay {decay:.3g}/s).")
    if dt is not None and not contraction(np.eye(len(X)) + dt * closed, X) < 1.0:
        raise ConfigError(f"The solver's controller is not stable when it is sampled each {dt:g} s.")
    z = C + D @ K
    norms = np.array([bisection(one, E, z) for one in closed])
    worst = int(norms.argmax())
    level = max(_level(one, E, z, X) for one in closed)
    if level < norms[worst] * (1 - 1e-6):
        raise ConfigError(
            f"The level {level:.6g} that the solver's X proves is below the norm {norms[worst]:.6g}: scale the states better."
        )
    return Synthesis(np.asarray(K), np.asarray(X), float(level), float(norms[worst]), worst, decay)


def quadratic_decay(closed, X) -> float:
    """Least d [1/s] with A X + X A' <= -2 d X for all A (k, n, n): above zero, V = x' X^-1 x proves the whole hull stable."""
    inverse = np.linalg.inv(np.linalg.cholesky(np.asarray(X, float)))
    turned = inverse @ np.asarray(closed, float) @ np.linalg.inv(inverse)
    return float(-0.5 * np.linalg.eigvalsh(turned + np.swapaxes(turned, 1, 2)).max())


def contraction(steps, X) -> float:
    """Largest factor on sqrt(V) in one step x+ = S x, over all S (k, n, n): below 1, the sampled hull is stable."""
    inverse = np.linalg.inv(np.linalg.cholesky(np.asarray(X, float)))
    return float(np.linalg.norm(inverse @ np.asarray(steps, float) @ np.linalg.inv(inverse), 2, axis=(1, 2)).max())


def _not_stabilisable(A, B) -> complex | None:
    """An eigenvalue not left of the imaginary axis that B does not reach (Popov, Belevitch, Hautus), or None."""
    size = np.linalg.norm(A, 2) + np.linalg.norm(B, 2)
    for value in np.linalg.eigvals(A):
        pencil = np.hstack([A - value * np.eye(len(A)), B])
        if value.real >= -1e-9 * size and np.linalg.svd(pencil, compute_uv=False)[-1] <= 1e-9 * size:
            return value
    return None


def _level(A, E, C, X) -> float:
    """The least g with which this X satisfies the bounded real lemma: AX + XA' + (E E' + X C'C X) / g <= 0."""
    root = np.linalg.cholesky(X)
    inverse = np.linalg.inv(root)
    falls = -(turned := inverse @ A @ root) - turned.T
    values, vectors = np.linalg.eigh(falls)
    if values.min() <= 0:
        return float("inf")
    half = vectors / np.sqrt(values)
    pushed = half.T @ np.hstack([inverse @ E, root.T @ C.T])
    return float(np.linalg.norm(pushed, 2) ** 2)


def _system(A, E, C, F):
    A, E, C = (np.atleast_2d(np.asarray(part, float)) for part in (A, E, C))
    F = np.zeros((len(C), E.shape[1])) if F is None else np.atleast_2d(np.asarray(F, float))
    for label, value, rows, columns in (
        ("A", A, len(A), len(A)),
        ("E", E, len(A), E.shape[1]),
        ("C", C, len(C), len(A)),
        ("F", F, len(C), E.shape[1]),
    ):
        checks.finite(label, checks.shape(label, value, rows, columns))
    return A, E, C, F


def _gains(omega, A, E, C, F) -> np.ndarray:
    """Largest singular value of T(j omega) at each frequency [rad/s]."""
    s = 1j * np.asarray(omega, float)[:, None, None] * np.eye(len(A))
    return np.linalg.norm(C @ np.linalg.solve(s - A, np.broadcast_to(E, (len(omega), *E.shape))) + F, 2, axis=(1, 2))


def _peak(A, E, C, F, low, high) -> float:
    from scipy.optimize import minimize_scalar

    peak = minimize_scalar(lambda w: -_gains([w], A, E, C, F)[0], bounds=(low, high), method="bounded", options={"xatol": 1e-9 * high})
    return float(-peak.fun)


def _crosses(A, E, C, F, g) -> bool:
    """True if the Hamiltonian matrix of the level g has an eigenvalue on the imaginary axis."""
    R = g**2 * np.eye(E.shape[1]) - F.T @ F
    inverse = np.linalg.inv(R)
    left = A + E @ inverse @ F.T @ C
    M = np.block([[left, E @ inverse @ E.T], [-C.T @ (np.eye(len(C)) + F @ inverse @ F.T) @ C, -left.T]])
    values = np.linalg.eigvals(M)
    return bool((np.abs(values.real) < ON_AXIS * np.abs(values).max()).any())
