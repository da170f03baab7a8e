"""The same methods as others would have them: plain NumPy, NumPy compiled by Numba, and filterpy.

Each function steps over a table whose measurements are all valid, and returns (T, 20): states, losses, variances of the losses.
NumPy's code is written so that Numba can compile it as it stands.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable

import numpy as np
from contenders import DT, estimator, plant

N_X, N_T, N = 12, 4, 16


@functools.cache
def functions(compiled: bool) -> dict:
    """The plant and the steps of the filters, compiled by Numba or not."""
    if compiled:
        import numba  # pyright: ignore[reportMissingImports]

        jit: Callable = numba.njit
    else:
        jit: Callable = lambda function: function  # noqa: E731

    p = plant()
    J, J_inverse, B_tau, B_T = (np.ascontiguousarray(a, float) for a in (p.J, p.J_inverse, p.B_tau, p.B_T))
    mass, gravity = float(p.m), float(p.gravity)
    Q, R = DT * np.diag(p.walk), np.diag(np.asarray(p.R(None)))
    Q_theta = DT * np.asarray(estimator("ukf").theta_walk)
    size = 0.1**2

    @jit
    def f(X, u):
        """Columns of X (16, k) after a step."""
        s, c = np.sin(X[3:6]), np.cos(X[3:6])
        thrust = u.reshape(-1, 1) * (1.0 - X[12:])
        push = B_T @ thrust / mass
        p, q, r = X[9], X[10], X[11]
        turning, rate = q * s[0] + r * c[0], (q * s[0] + r * c[0]) / c[1]
        torque = B_tau @ thrust
        H = J @ X[9:12].copy()
        torque[0] -= q * H[2] - r * H[1]
        torque[1] -= r * H[0] - p * H[2]
        torque[2] -= p * H[1] - q * H[0]
        d = np.zeros(X.shape)
        d[:3] = X[6:9]
        d[3], d[4], d[5] = p + rate * s[1], q * c[0] - r * s[0], turning / c[1]
        d[6] = -(c[0] * s[1] * c[2] + s[0] * s[2]) * push
        d[7] = -(c[0] * s[1] * s[2] - s[0] * c[2]) * push
        d[8] = gravity - c[0] * c[1] * push
        d[9:12] = J_inverse @ torque
        return X + DT * d

    @jit
    def slope(x, u):
        """(16, 16) derivative of f at x, by hand."""
        s, c = np.sin(x[3:6]), np.cos(x[3:6])
        thrust = u * (1.0 - x[12:])
        push = B_T @ thrust / mass
        w = x[9:12].copy()
        H = J @ w
        turning, across, rate = w[1] * s[0] + w[2] * c[0], w[1] * c[0] - w[2] * s[0], (w[1] * s[0] + w[2] * c[0]) / c[1]
        D = np.zeros((N, N))
        D[0, 6] = D[1, 7] = D[2, 8] = 1.0
        D[3, 3], D[3, 4], D[4, 3], D[5, 3], D[5, 4] = (across * s[1] / c[1], rate / c[1], -turning, across / c[1], rate * s[1] / c[1])
        D[3, 9], D[3, 10], D[3, 11] = 1.0, s[0] * s[1] / c[1], c[0] * s[1] / c[1]
        D[4, 10], D[4, 11], D[5, 10], D[5, 11] = c[0], -s[0], s[0] / c[1], c[0] / c[1]
        D[6, 3], D[7, 3] = -push * (-s[0] * s[1] * c[2] + c[0] * s[2]), -push * (-s[0] * s[1] * s[2] - c[0] * c[2])
        D[8, 3], D[8, 4] = push * s[0] * c[1], push * c[0] * s[1]
        D[6, 4], D[7, 4] = -push * c[0] * c[1] * c[2], -push * c[0] * c[1] * s[2]
        D[6, 5], D[7, 5] = -push * (-c[0] * s[1] * s[2] + s[0] * c[2]), -push * (c[0] * s[1] * c[2] + s[0] * s[2])
        W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        V = np.array([[0.0, -H[2], H[1]], [H[2], 0.0, -H[0]], [-H[1], H[0], 0.0]])
        D[9:12, 9:12] = -J_inverse @ (W @ J - V)
        down = np.array([c[0] * s[1] * c[2] + s[0] * s[2], c[0] * s[1] * s[2] - s[0] * c[2], c[0] * c[1]])
        for i in range(4):
            D[6:9, 12 + i] = B_T[i] * u[i] / mass * down
            D[9:12, 12 + i] = -u[i] * (J_inverse @ B_tau[:, i].copy())
        return np.eye(N) + DT * D

    @jit
    def root(P):
        return np.linalg.cholesky(P + np.diag(1e-14 * np.diag(P) + 1e-20))

    @jit
    def transformed(values, n, spread):
        """Mean, slope and curvature of a function of the points, its values in columns."""
        centre = values[:, 0].copy()
        plus, minus = values[:, 1 : n + 1] - centre.reshape(-1, 1), values[:, n + 1 :] - centre.reshape(-1, 1)
        E = 0.5 * (plus + minus)
        m = E.sum(axis=1) / (size * n)
        return centre + m, (plus - minus) / (2.0 * spread), E @ E.T / (size * n) + (2.0 - size) * np.outer(m, m)

    @jit
    def points(x, L, spread):
        x = x.reshape(-1, 1)
        return np.concatenate((x, x + spread * L, x - spread * L), axis=1)

    @jit
    def ekf(x, P, u, y):
        A = slope(x, u)
        x = f(x.reshape(-1, 1), u)[:, 0].copy()
        P = A @ P @ A.T
        P[:N_X, :N_X] += Q
        P[N_X:, N_X:] += Q_theta
        K = np.linalg.solve(P[:6, :6] + R, P[:6].copy()).T
        x = x + K @ (y - x[:6])
        P = P - K @ P[:6]
        return x, 0.5 * (P + P.T)

    @jit
    def ukf(x, P, u, y):
        spread = np.sqrt(size * N)
        x, D, C = transformed(f(points(x, root(P), spread), u), N, spread)
        P = D @ D.T + C
        P[:N_X, :N_X] += Q
        P[N_X:, N_X:] += Q_theta
        L = root(0.5 * (P + P.T))
        seen, D, C = transformed(points(x, L, spread)[:6], N, spread)
        K = np.linalg.solve(D @ D.T + C + R, D @ L.T).T
        x = x + K @ (y - seen)
        rest = L - K @ D
        P = rest @ rest.T + K @ (C + R) @ K.T
        return x, 0.5 * (P + P.T)

    @jit
    def tsukf(x, P, beta, theta, P_theta, u, y):
        spread = np.sqrt(size * N_X)
        L = root(P)
        X = points(x, L, spread)
        full = np.empty((N, X.shape[1]))
        full[:N_X] = X
        full[N_X:] = theta.reshape(-1, 1)
        before = np.concatenate((x, theta))
        x, D, C = transformed(f(full, u)[:N_X], N_X, spread)
        r = D @ np.linalg.solve(L, beta) + slope(before, u)[:N_X, N_X:]
        r_P, P_next = r @ P_theta, P_theta + Q_theta
        beta = np.linalg.solve(P_next, r_P.T).T
        P = D @ D.T + C + r_P @ (r - beta).T + Q
        L = root(0.5 * (P + P.T))
        seen, D, C = transformed(points(x, L, spread)[:6], N_X, spread)
        H = D @ np.linalg.solve(L, beta)
        P_yy = D @ D.T + C + R
        S = P_yy + H @ P_next @ H.T
        K, K_theta = np.linalg.solve(P_yy, D @ L.T).T, np.linalg.solve(S, H @ P_next).T
        e = y - seen
        change = K_theta @ e
        beta = beta - K @ H
        rest = np.eye(N_T) - K_theta @ H
        P_theta = rest @ P_next @ rest.T + K_theta @ P_yy @ K_theta.T
        rest = L - K @ D
        P = rest @ rest.T + K @ (C + R) @ K.T
        return x + K @ e + beta @ change, 0.5 * (P + P.T), beta, theta + change, 0.5 * (P_theta + P_theta.T)

    @jit
    def run_full(step, u, y, P):
        x, out = np.zeros(N), np.empty((len(u), 20))
        for k in range(len(u)):
            x, P = step(x, P, u[k], y[k])
            out[k, :N] = x
            out[k, N:] = np.diag(P)[N_X:]
        return out

    @jit
    def run_two_stage(step, u, y, P, P_theta):
        x, beta, theta, out = np.zeros(N_X), np.zeros((N_X, N_T)), np.zeros(N_T), np.empty((len(u), 20))
        for k in range(len(u)):
            x, P, beta, theta, P_theta = step(x, P, beta, theta, P_theta, u[k], y[k])
            out[k, :N_X] = x
            out[k, N_X:N] = theta
            out[k, N:] = np.diag(P_theta)
        return out

    return {"f": f, "slope": slope, "ekf": ekf, "ukf": ukf, "tsukf": tsukf, "full": run_full, "two stage": run_two_stage}


def start() -> np.ndarray:
    """(16, 16) covariance before the first step."""
    P = np.eye(N)
    P[N_X:, N_X:] = np.asarray(estimator("ukf").theta_var)
    return P


def _filter(name: str, compiled: bool):
    own = functions(compiled)

    def run(u, y, valid):
        if name == "tsukf":
            return own["two stage"](own[name], u, y, start()[:N_X, :N_X].copy(), start()[N_X:, N_X:].copy())
        return own["full"](own[name], u, y, start())

    return run


def _filterpy(name: str):
    from filterpy import kalman  # pyright: ignore[reportMissingImports]

    own, p = functions(False), plant()

    def store(k, out, method):
        out[k, :N] = method.x.reshape(-1)
        out[k, N:] = np.diag(method.P)[N_X:]

    Q = np.zeros((N, N))
    Q[:N_X, :N_X], Q[N_X:, N_X:] = DT * np.diag(p.walk), DT * np.asarray(estimator("ukf").theta_walk)
    R = np.diag(np.asarray(p.R(None)))

    def unscented(u, y, valid):
        sigma = kalman.MerweScaledSigmaPoints(N, 0.1, 2.0, 0.0)
        method = kalman.UnscentedKalmanFilter(N, 6, DT, lambda x: x[:6], lambda x, dt, u: own["f"](x[:, None], u)[:, 0], sigma)
        method.P, method.Q, method.R = start(), Q, R
        out = np.empty((len(u), 20))
        for k in range(len(u)):
            method.predict(u=u[k])
            method.update(y[k])
            store(k, out, method)
        return out

    class Extended(kalman.ExtendedKalmanFilter):
        def predict_x(self, u=0):
            self.F = own["slope"](self.x, u)
            self.x = own["f"](self.x[:, None], u)[:, 0]

    def extended(u, y, valid):
        method = Extended(N, 6)
        method.x, method.P, method.Q, method.R = np.zeros(N), start(), Q, R
        H, out = np.eye(N)[:6], np.empty((len(u), 20))
        for k in range(len(u)):
            method.predict(u[k])
            method.update(y[k], lambda x: H, lambda x: x[:6])
            store(k, out, method)
        return out

    return {"ukf": unscented, "ekf": extended}[name]


def peers(method: str) -> dict:
    """Name -> function(u, y, valid) of what else is installed and has the method."""
    found: dict = {}
    if method in ("ukf", "ekf", "tsukf"):
        found["numpy"] = _filter(method, False)
        if importlib.util.find_spec("numba"):
            found["numba"] = _filter(method, True)
    if method in ("ukf", "ekf") and importlib.util.find_spec("filterpy"):
        found["filterpy"] = _filterpy(method)
    return found
