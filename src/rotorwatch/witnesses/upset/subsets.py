"""Which rotors are off in a vehicle that spins and flies on: a hidden Markov chain over sets of rotors, causal, tick by tick.

With the set S off, the thrusts T (n,) of the other rotors balance the motion of a rigid body (Newton and Euler) at any attitude and rate,

    sum_S B_a T = J_a (dr_a/dt + g_a) + D_a r_a + b_a          roll, pitch; g: gyroscopic terms of a flat body, as in `balance`
    sum_S B_z T = J_z dr_z/dt + D_z r_z + E_z r_z |r_z|        yaw, which drag balances at 20 to 45 rad/s
    sum_S T     = n load

load is the specific force up at the centre of mass: a spin of 40 rad/s adds 16 m/s^2 for each centimetre that the accelerometer is off
the axis, so its lever arm l is estimated from the lateral forces, f = dr/dt x l + r x (r x l). All terms are averaged over AVERAGE_S,
longer than the lag of motors and controllers: between two commands as slow as 10 Hz a nutating vehicle turns by a radian, and the phase of
single samples would look like a missing rotor. Each set has a Kalman filter of its own for (J, D, b); filters are mixed as in the
interacting multiple model filter (Blom and Bar-Shalom, IEEE Transactions on Automatic Control 33, 1988). Thrust is the demand to a power
that is constant in a flight, since the curve may be unknown: one chain for each of POWERS. Units as in `balance`.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.witnesses.upset.balance import FLAT, INERTIA, OUTLIER_SD, OUTLIERS

MOST = 3  # rotors off at once
AVERAGE_S = 0.4
POWERS = (1.0, 1.5, 2.0)
STRONGEST = 5.0  # hover thrusts: hardly any rotor gives more, whatever its curve says
# Rates [1/s]: one more rotor goes off; two at once; three at once; one comes back, each further one ten times more rarely.
FAILS, TOGETHER, ALL_THREE, RETURNS = 0.01, 0.001, 0.00005, 0.0003
# Standard deviations, in hover thrusts. Of inertia as a share; of the offset; of damping per rad/s; of yaw drag, its mean as well.
INERTIA_SHARE, OFFSET, DAMPING, YAW_DAMPING, YAW_DRAG = 0.5, 0.15, 0.05, 0.05, 0.003
LEAST_SHARE = 0.2  # of the usual inertia
FLOOR = np.array([0.15, 0.15, 0.3, 0.25])  # of roll, pitch, yaw, thrust
THRUST_SHARE, STEP_SHARE, STRONG_SHARE, STRONG = 0.12, 0.5, 0.3, 2.0  # of a rotor's thrust; of its changes; of thrust beyond STRONG
LOAD_SHARE = 0.1  # of the load that the vehicle carries: inflow
MOTION_SHARE = 0.2  # of inertial torques, and of yaw drag
YAW_WEIGHT = 0.5  # drag at these rates is no model, but a fit
LEVER_M, SIDE_FLOOR, SIDE_SHARE = 0.03, 1.5, 0.1  # m; m/s^2 of drag on the body, and a share of the lateral force
TINY = 1e-300


class Motion(NamedTuple):
    """A tick. thrust (n,): demanded, hover thrusts; rate, rate_dot (3,) rad/s, rad/s^2; force (3,): specific force at the accelerometer
    [m/s^2], body."""

    thrust: np.ndarray
    rate: np.ndarray
    rate_dot: np.ndarray
    force: np.ndarray


class _Terms(NamedTuple):
    """thrust (P, n) by POWERS; rows (3, 3): what multiplies (J, b or D, D or E) of each axis; up (3,): what multiplies the lever arm in the
    specific force along z; force: that force [m/s^2]."""

    thrust: np.ndarray
    rows: np.ndarray
    up: np.ndarray
    force: float


def sets_of(n: int) -> list[tuple[int, ...]]:
    """Sets of rotors, from 0, that may be off: none first; pairs at most where there are more than eight rotors."""
    return [who for k in range((MOST if n <= 8 else 2) + 1) for who in combinations(range(n), k)]


class Subsets:
    """The chain. sets: (H) sets of rotors; probability (H,): of each, given all ticks so far; misfit: root mean square of the residual of
    the likeliest set over the last average, in standard deviations, or NaN before there is any."""

    def __init__(self, B: np.ndarray, dt: float):
        """B (4, n): effectiveness; dt: length of a tick [s]."""
        n = B.shape[1]
        self.B, self.n = B, n
        self.sets = sets_of(n)
        H, P = len(self.sets), len(POWERS)
        self.off = np.array([[i in who for i in range(n)] for who in self.sets])
        self._gives = 1.0 - self.off
        self._keep = max(1, round(AVERAGE_S / dt))
        self._weight = min(1.0, dt / AVERAGE_S)  # averages overlap
        self._change = self._rates() * dt
        np.fill_diagonal(self._change, 1.0 - self._change.sum(axis=1))
        self._p = np.zeros((P, H))
        self._p[:, 0] = 1.0
        self._log = np.zeros(P)
        usual = n * INERTIA
        mean = np.array([[usual[0], 0.0, 0.0], [usual[1], 0.0, 0.0], [usual[2], 0.0, YAW_DRAG]])
        sd = np.array([[usual[0], OFFSET, DAMPING], [usual[1], OFFSET, DAMPING], [usual[2], YAW_DAMPING, YAW_DRAG]])
        sd[:, 0] *= INERTIA_SHARE
        self._least = LEAST_SHARE * usual
        self._m = np.tile(mean, (P, H, 1, 1))  # (P, H, axis, parameter)
        self._P = np.tile(np.stack([np.diag(row**2) for row in sd]), (P, H, 1, 1, 1))
        self.lever, self._lever_P = np.zeros(3), np.eye(3) * LEVER_M**2
        self._recent: list[_Terms] = []
        self.probability = self._p.mean(axis=0)
        self.log_likelihood = np.zeros((P, H))  # of the last tick
        self.misfit = np.nan

    def _rates(self) -> np.ndarray:
        """(H, H) rates from set to set [1/s], the diagonal 0."""
        more = {1: FAILS, 2: TOGETHER, 3: ALL_THREE}
        rates = np.zeros((len(self.sets), len(self.sets)))
        for i, a in enumerate(map(set, self.sets)):
            for j, b in enumerate(map(set, self.sets)):
                rates[i, j] = more[len(b - a)] if a < b else RETURNS * 0.1 ** (len(a - b) - 1) if b < a else 0.0
        return rates

    @property
    def power(self) -> np.ndarray:
        """(P,) probabilities of POWERS."""
        share = np.exp(self._log - self._log.max())
        return share / share.sum()

    def step(self, now: Motion) -> None:
        """Take in a tick."""
        self._recent.append(self._terms(now))
        del self._recent[: -self._keep]
        if len(self._recent) < self._keep:
            return
        prior, m, P = self._mixed()
        thrust = np.stack([t.thrust for t in self._recent])  # (K, P, n)
        T = thrust.mean(axis=0)
        changes = np.abs(np.diff(thrust, axis=0)).sum(axis=0) / len(thrust)
        each = (THRUST_SHARE * T) ** 2 + (STEP_SHARE * changes) ** 2 + (STRONG_SHARE * np.maximum(T - STRONG, 0.0)) ** 2
        wrench = np.einsum("ai,hi,pi->pha", self.B, self._gives, T)
        # A rotor that may be off makes the balance uncertain even where it is: half of its share counts for every set.
        variance = FLOOR**2 + 0.5 * np.einsum("ai,hi,pi->pha", self.B**2, 1.0 + self._gives, each)
        rows, up = np.mean([t.rows for t in self._recent], axis=0), np.mean([t.up for t in self._recent], axis=0)
        load = (float(up @ self.lever) - float(np.mean([t.force for t in self._recent]))) / G0
        variance[:, :, 3] += (LOAD_SHARE * self.n * max(load, 0.5)) ** 2 + (self.n / G0) ** 2 * float(up @ self._lever_P @ up)
        e = wrench.copy()
        e[:, :, :3] -= np.einsum("phak,ak->pha", m, rows)
        e[:, :, 3] -= self.n * load
        R = variance[:, :, :3] + (MOTION_SHARE * m[:, :, :, 0] * rows[:, 0]) ** 2
        R[:, :, 2] += (MOTION_SHARE * m[:, :, 2, 2] * rows[2, 2]) ** 2
        variance[:, :, :3] = R + np.einsum("ak,phakl,al->pha", rows, P, rows)
        inside = -0.5 * (e**2 / variance + np.log(variance))
        wide = variance + OUTLIER_SD**2
        outside = -0.5 * (e**2 / wide + np.log(wide))
        axes = np.logaddexp(np.log(1.0 - OUTLIERS) + inside, np.log(OUTLIERS) + outside)
        self.log_likelihood = self._weight * (axes @ np.array([1.0, 1.0, YAW_WEIGHT, 1.0]))
        log = np.log(prior + TINY) + self.log_likelihood
        most = log.max(axis=1, keepdims=True)
        total = most[:, 0] + np.log(np.exp(log - most).sum(axis=1))
        self._p = np.exp(log - total[:, None])
        self._log += total
        self._learn(m, P, rows, e[:, :, :3], R, variance[:, :, :3])
        self.probability = self.power @ self._p
        best = int(np.argmax(self.probability)), int(np.argmax(self.power))
        self.misfit = float(np.sqrt((e[best[1], best[0]] ** 2 / variance[best[1], best[0]]).mean()))

    def _terms(self, now: Motion) -> _Terms:
        """The terms of a tick, after the lever arm has been learned from its lateral forces."""
        r, d, f = now.rate, now.rate_dot, now.force
        turn, speeds = (np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]]) for v in (r, d))
        lever = speeds + turn @ turn
        for a in range(2):
            h = lever[a]
            K = self._lever_P @ h / (h @ self._lever_P @ h + (SIDE_FLOOR + SIDE_SHARE * abs(f[a])) ** 2)
            self.lever = self.lever + K * (f[a] - h @ self.lever)
            self._lever_P = self._lever_P - np.outer(K, h @ self._lever_P)
        thrust = np.stack([np.minimum(np.maximum(now.thrust, 0.0) ** power, STRONGEST) for power in POWERS])
        spin = FLAT * np.array([r[1] * r[2], -r[0] * r[2]])
        rows = np.array([[d[0] + spin[0], 1.0, r[0]], [d[1] + spin[1], 1.0, r[1]], [d[2], r[2], r[2] * abs(r[2])]])
        return _Terms(thrust, rows, lever[2], float(f[2]))

    def _mixed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Prior (P, H) of the sets at this tick, and mean and covariance of the parameters of each."""
        joint = self._p[:, :, None] * self._change
        prior = joint.sum(axis=1)
        share = joint / np.maximum(prior, TINY)[:, None]
        m = np.einsum("pij,piak->pjak", share, self._m)
        second = self._P + self._m[..., :, None] * self._m[..., None, :]
        P = np.einsum("pij,piakl->pjakl", share, second) - m[..., :, None] * m[..., None, :]
        return prior, m, P

    def _learn(self, m: np.ndarray, P: np.ndarray, rows: np.ndarray, e: np.ndarray, R: np.ndarray, S: np.ndarray) -> None:
        """Update the parameters of every set, less for a residual that does not fit."""
        loose = R / self._weight * np.maximum(1.0, e**2 / S / 4.0)
        h = np.einsum("phakl,al->phak", P, rows)
        total = np.einsum("phak,ak->pha", h, rows) + loose
        K = h / total[..., None]
        self._m = m + K * e[..., None]
        self._m[:, :, :, 0] = np.maximum(self._m[:, :, :, 0], self._least)
        self._P = P - K[..., :, None] * h[..., None, :]
