"""Adaptive two-stage unscented Kalman filter: the losses' random walk widens when innovations are larger than predicted.

When e'e > threshold tr S and the window of the last M innovations, window_s / dt of them, is full, P_theta- = P_theta + delta Q_theta with

    delta = max(1, [tr sum e e' / (M - 1) - tr P_yy - tr H P_theta H'] / tr H Q_theta H')

while beta-, H and P_free keep their nominal values (recomputing them with delta diverges). Source: Zhang et al., Drones 7
(2023) 12, section 3.2, eqs. (45)-(52). Options beyond the paper: a whiteness gate, because only innovations that point the same
way twice speak of a loss that moves, not of noise; and losses kept in [0, 1]. docs/methods/atsukf.md.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp, lax
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import two_stage, unscented


class Window(namedtuple("Window", "rows leaving total lap next full")):
    """Sums over the last M rows, kept by adding what comes and taking away what leaves. rows (M, 2 n_y + 1): squared
    innovations, whether valid, and product with the innovations before. leaving: the row that is overwritten next, read in
    advance, so that compiled code need not copy the rows. total: sum of all rows. lap: of those since row 0 was
    last written; it becomes the total once a lap, so that rounding does not pile up. next: row to write. full: bool."""


class Carry(NamedTuple):
    """state: the filter's. window: of innovations. e (n_y,): the last innovation. delta: the last factor on Q_theta."""

    state: two_stage.State
    window: Window
    e: Array
    delta: Array


class ATSUKF(unscented.Unscented):
    """Adaptive two-stage UKF on any plant with f, h, Q and R."""

    name, joint = "atsukf", False
    not_kalman = "it widens the losses' random walk when innovations exceed their predicted size, so its gains depend on the data"

    def __init__(
        self, system, dt, *, theta_walk=1e-3, theta_var=1e-2, window_s=1.5, threshold=1.0, whiteness=None, clip=False,
        alpha=0.1, beta=2.0, kappa=0.0,
    ):  # fmt: skip
        """Arguments of `unscented.Unscented`, and: window_s: length of the window [s], the paper's M = 150 steps of 10 ms; two steps of dt
        at least. threshold: ratio to the predicted size that counts as too large (the paper's K). whiteness: widen only when the
        innovations' lag-1 correlation in the window exceeds this (0.2 is a good value; None: no gate, as in the paper). Raises ConfigError.
        """
        shared = {"theta_walk": theta_walk, "theta_var": theta_var, "clip": clip}
        super().__init__(system, dt, alpha=alpha, beta=beta, kappa=kappa, **shared)
        self.M = max(2, round(checks.positive("window_s", window_s) / dt))
        self.threshold = checks.positive("threshold", threshold)
        self.whiteness = None if whiteness is None else checks.between("whiteness", whiteness, -1.0, 1.0)

    def init(self) -> Carry:
        """The plant's x0 and P0, no loss, an empty window."""
        n_y = self.system.n_y
        row = jnp.zeros(2 * n_y + 1)
        rows = jnp.zeros((self.M, row.size))
        window = Window(rows, row, row, row, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
        return Carry(two_stage.initial(self.system, self.theta_var), window, jnp.zeros(n_y), jnp.ones(()))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        dt = self.dt if dt is None else dt
        Q_theta = dt * self.theta_walk
        p = two_stage.predict(self.system, self.weights, carry.state, Q_theta, u, y, valid, dt)
        row = jnp.concatenate([p.e * p.e, valid.astype(float), (p.e @ carry.e)[None]])
        window = self._push(carry.window, row, valid.any())
        delta = self._factor(p, window, Q_theta, valid)
        state, estimate = two_stage.update(p, carry.state.P_theta + delta * Q_theta, valid, self.limit)
        return Carry(state, window, p.e, delta), estimate

    def _push(self, window: Window, row: Array, measured: Array) -> Window:
        """The window one row on; unchanged where nothing was measured."""
        entry = jnp.where(measured, row, window.leaving)
        total, lap = window.total + entry - window.leaving, window.lap + jnp.where(measured, row, 0.0)
        rows = lax.dynamic_update_index_in_dim(window.rows, entry, window.next, 0)
        step = window.next + measured.astype(jnp.int32)
        round_done = step == self.M
        step = jnp.where(round_done, 0, step).astype(jnp.int32)
        return Window(
            rows,
            lax.dynamic_index_in_dim(rows, step, keepdims=False),
            jnp.where(round_done, lap, total),
            jnp.where(round_done, 0.0, lap),
            step,
            window.full | round_done,
        )

    def _factor(self, p: two_stage.Prediction, window: Window, Q_theta: Array, valid: Array) -> Array:
        """The factor delta on Q_theta; 1 when the innovations do not call for more."""
        n_y = self.system.n_y
        squares, count = window.total[:n_y], window.total[n_y : 2 * n_y]
        seen = jnp.where(valid, squares / jnp.maximum(count - 1.0, 1.0), 0.0).sum()

        def trace(diagonal):
            return jnp.where(valid, diagonal, 0.0).sum()

        noise, known = trace(jnp.diagonal(p.P_yy)), trace(((p.H @ p.P_theta_before) * p.H).sum(axis=1))
        walk = trace(((p.H @ Q_theta) * p.H).sum(axis=1))
        expected = noise + known + walk
        # Else no loss shows in the innovations: before the first coupling, or with motors off.
        observable = walk > 1e-15 * expected
        wide = (p.e @ p.e > self.threshold * expected) & window.full & observable
        if self.whiteness is not None:
            wide = wide & (window.total[-1] > self.whiteness * squares.sum())
        delta = (seen - noise - known) / jnp.where(observable, walk, 1.0)
        return jnp.where(wide, jnp.maximum(delta, 1.0), 1.0)
