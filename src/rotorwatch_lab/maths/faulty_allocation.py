"""Allocates a missing wrench to rotor losses: f = Phi theta with more rotors than channels.

f (c,): what the actuators did not deliver, channel by channel; Phi (c, n): what a full loss of each rotor does; W (c,):
weight of each channel, 1 / noise variance, 0 where it is not measured. Up to four rotors Phi can be inverted, and weighting the
rows balances their magnitudes. Beyond, infinitely many theta explain f, and three readings are offered:

    least squares    the smallest theta: spreads one rotor's loss over all of them
    sparse           the fewest faulty rotors, by enumeration, a loss common to all counting as one
    temporal         one constant theta in [0, 1] for all recent data: commands that move distinguish rotors

Each is a pure rule: init() -> state, and rule(state, Phi, f, W, dt) -> (state, Answer). dt is 0 where nothing was measured.
"""

from __future__ import annotations

from collections import namedtuple
from itertools import combinations
from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp, lax
from rotorwatch_lab.maths.small import definite_solve

CHANNELS = 4  # roll, pitch, yaw, thrust: the axes on which rotors differ
RIDGE = 1e-12  # of the largest information: directions with less count as unobservable


class Answer(namedtuple("Answer", "theta M spread count")):
    """theta (n,); M (n, c): how noise in f gets into it; spread (n, n): covariance of what f leaves open, PSD; count
    (int32): how many explanations are as good, 1 when there is no other."""


class Window(namedtuple("Window", "G z")):
    """Accumulated data of the temporal rule: information G (n, n) and vector z (n,), with forgetting."""


class LeastSquares:
    """theta = (Phi' W Phi)^+ Phi' W f: exact for up to as many rotors as channels, the smallest theta beyond."""

    def __init__(self, n: int, loss_sd: float):
        """n: size of theta; loss_sd: standard deviation of a loss that f does not determine."""
        self.n, self.loss_sd = n, loss_sd

    def init(self) -> tuple:
        """An empty state: each answer depends on its inputs alone."""
        return ()

    def __call__(self, state, Phi, f, W, dt) -> tuple[Any, Answer]:
        """See the module."""
        # Psi^+ of the weighted rows, from the smaller of its two products; one refinement takes the ridge's bias out.
        root = jnp.sqrt(W)
        Psi = root[:, None] * Phi
        if self.n <= CHANNELS:
            G = Psi.T @ Psi
            inverse = definite_solve(G + _ridge(G) * np.eye(self.n), Psi.T)
        else:
            G = Psi @ Psi.T
            inverse = definite_solve(G + _ridge(G) * np.eye(len(W)), Psi).T
        M = (2.0 * inverse - inverse @ (Psi @ inverse)) * root
        open_ = (np.eye(self.n) - M @ Phi) * self.loss_sd
        return state, Answer(M @ f, M, open_ @ open_.T, jnp.int32(1))


class Sparse:
    """The fewest rotors that explain f: every set of up to `largest` losses, with and without a loss common to all rotors.

    A set's score is its weighted squared residual plus `price` for each loss it needs; the lowest wins. Sets that score less
    than `price` worse with as few losses are other explanations: they are counted, and spread the answer. Exact but for
    bounds: a solution outside [0, 1] is clipped before it is scored, as its neighbours on the bound are sets of their own.
    """

    def __init__(self, n: int, losses: int, *, largest: int = 3, price: float = 9.0, rest_sd: float = 0.02):
        """n: size of theta, whose first `losses` are rotors; the others (biases) have no bounds. price: chi-squared that one more
        faulty rotor must earn; rest_sd: how far the rotors called healthy may be from it."""
        checks.positive("price", price)
        self.n, self.price, self.rest_sd = n, price, rest_sd
        alone = [s for k in range(min(largest, n) + 1) for s in combinations(range(n), k)]
        common = [(*s, n) for s in alone if len(s) < n] if losses > 1 else []
        sets = alone + common
        width = max(len(s) for s in sets)
        self.size = np.array([len(s) for s in sets], float)
        # Tables with a column for each set: contiguous, so that a step is a few vector operations.
        self.filled = np.array([[k < len(s) for s in sets] for k in range(width)])
        self.index = np.array([[s[k] if k < len(s) else 0 for s in sets] for k in range(width)])
        rotor = np.arange(n) < losses
        self.atoms = np.column_stack([np.eye(n), rotor.astype(float)])  # theta = atoms a
        # (width, n, sets): theta = sum of places a
        self.places = np.swapaxes(self.atoms.T[self.index] * self.filled[:, :, None], 1, 2)
        self.low = np.append(np.where(rotor, 0.0, -np.inf), 0.0)
        self.high = np.append(np.where(rotor, 1.0, np.inf), 1.0)

    def init(self) -> tuple:
        """An empty state: each answer depends on its inputs alone."""
        return ()

    def __call__(self, state, Phi, f, W, dt) -> tuple[Any, Answer]:
        """See the module."""
        Psi = Phi @ self.atoms
        weighted = Psi.T * W
        G, z = weighted @ Psi, weighted @ f
        theta, score = self._candidates(G, z, f @ (W * f))
        best = jnp.argmin(score)
        away = score - score[best]
        count = ((self.size <= jnp.asarray(self.size)[best]) & (away < self.price)).sum().astype(jnp.int32)
        chosen = lax.dynamic_index_in_dim(theta, best, axis=1, keepdims=False)
        T = lax.dynamic_index_in_dim(jnp.asarray(self.places), best, axis=2, keepdims=False)  # (width, n)
        only = T @ Phi.T
        empty = jnp.where(jnp.abs(T).sum(axis=1) == 0.0, 1.0, _ridge(G))
        M = T.T @ jax.scipy.linalg.cho_solve((jnp.linalg.cholesky((only * W) @ only.T + jnp.diag(empty)), True), only * W)
        odds = jnp.exp(-0.5 * away)
        scatter = (theta - chosen[:, None]) * jnp.sqrt(odds / odds.sum())
        return state, Answer(chosen, M, scatter @ scatter.T + self.rest_sd**2 * np.eye(self.n), count)

    def _candidates(self, G, z, power):
        """theta (n, sets) of every set within bounds, and its score (sets,). G, z: information about the atoms."""
        i, filled = self.index, self.filled
        width = len(i)
        ridge = 1e-10 * jnp.diagonal(G) + _ridge(G)
        A = {(j, k): jnp.where(filled[j] & filled[k], G[i[j], i[k]], 0.0) for j in range(width) for k in range(j)}
        A |= {(k, k): jnp.where(filled[k], (jnp.diagonal(G) + ridge)[i[k]], 1.0) for k in range(width)}  # empty places: 1
        a = _solve(A, [jnp.where(filled[k], z[i[k]], 0.0) for k in range(width)])
        theta = sum(jnp.clip(a[k], self.low[i[k]], self.high[i[k]]) * self.places[k] for k in range(width))
        # Clipped before the score, so that the score is that of the answer.
        theta = jnp.clip(theta, self.low[: self.n, None], self.high[: self.n, None])
        residual = power + (theta * (G[: self.n, : self.n] @ theta - 2.0 * z[: self.n, None])).sum(axis=0)
        return theta, residual + self.price * self.size


class Temporal:
    """A single constant theta for all recent data: least squares over filtered regressors, rotors bounded to [0, 1].

    G <- l G + (dt / correlation_s) Phi' W Phi,  z <- l z + (dt / correlation_s) Phi' W f,  l = exp(-dt / memory_s). Where f departs
    from Phi theta by more than `limit` (chi-squared), theta has changed: what was seen is forgotten.
    """

    def __init__(self, n: int, losses: int, loss_sd: float, *, memory_s=10.0, correlation_s=0.5, limit=50.0):
        """loss_sd: prior of each theta about 0; memory_s: how long it remembers; correlation_s: f's noise is white beyond that."""
        for name, value in (("memory_s", memory_s), ("correlation_s", correlation_s), ("limit", limit)):
            checks.positive(name, value)
        self.n, self.prior = n, np.eye(n) / loss_sd**2
        self.memory_s, self.correlation_s, self.limit = memory_s, correlation_s, limit
        rotor = np.arange(n) < losses
        self.low, self.high = np.where(rotor, 0.0, -np.inf), np.where(rotor, 1.0, np.inf)

    def init(self) -> Window:
        """No information yet."""
        return Window(jnp.zeros((self.n, self.n)), jnp.zeros(self.n))

    def __call__(self, state, Phi, f, W, dt) -> tuple[Any, Answer]:
        """See the module."""
        weighted = Phi.T * W
        share, keep = dt / self.correlation_s, jnp.exp(-dt / self.memory_s)
        G_now, z_now = share * weighted @ Phi, share * weighted @ f
        G, z = keep * state.G + G_now, keep * state.z + z_now
        theta = self._bounded(G + self.prior, z)
        rest = f - Phi @ theta
        changed = rest @ (W * rest) > self.limit
        G, z = jnp.where(changed, G_now, G), jnp.where(changed, z_now, z)
        theta = jnp.where(changed, self._bounded(G + self.prior, z), theta)
        spread = definite_solve(G + self.prior, jnp.eye(self.n))
        return Window(G, z), Answer(theta, jnp.zeros_like(Phi.T), spread, jnp.int32(1))

    def _bounded(self, G, z):
        """argmin theta' G theta / 2 - z' theta within bounds: what leaves them is held there, and the rest solved again."""
        held, theta = jnp.zeros(self.n, bool), jnp.zeros(self.n)
        for _ in range(3):
            at = jnp.where(held, theta, 0.0)
            both = ~held[:, None] & ~held[None, :]
            A = jnp.where(both, G, jnp.eye(self.n))
            b = jnp.where(held, theta, z - G @ at)
            theta = definite_solve(A, b)
            inside = jnp.clip(theta, self.low, self.high)
            held, theta = held | (inside != theta), inside
        return theta


def _ridge(G):
    """The smallest diagonal that makes G invertible."""
    return RIDGE * jnp.max(jnp.diagonal(G)) + 1e-30


def _solve(A, b):
    """A^-1 b for many small positive definite A at once: A[j, k], j >= k, and b[k] are vectors with an entry for each; L D L'
    unrolled."""
    L, d, y = {}, [], []
    for i in range(len(b)):
        for j in range(i):
            L[i, j] = (A[i, j] - sum(L[i, m] * L[j, m] * d[m] for m in range(j))) / d[j]
        d.append(A[i, i] - sum(L[i, m] ** 2 * d[m] for m in range(i)))
        y.append(b[i] - sum(L[i, m] * y[m] for m in range(i)))
    x = [y[i] / d[i] for i in range(len(b))]
    for i in reversed(range(len(b))):
        x[i] = x[i] - sum(L[m, i] * x[m] for m in range(i + 1, len(b)))
    return x
