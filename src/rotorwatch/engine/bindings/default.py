"""The default diagnoser: a Kalman filter, a bank of jump detectors on its innovations, and explanations side by side.

Its definition, engine/estimator/, as one estimator among others; `program` runs it faster over many ticks.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.core import Estimate
from rotorwatch.engine.bindings import program
from rotorwatch.engine.estimator.plant import THETA
from rotorwatch.engine.motion.tick_table import GROUND


class Default:
    """The default estimator as a `core.Estimator`, one tick at a time: for callers that select methods by name.

    B (4, n): geometry; dt: length of a tick, s. u (n + 15,), y (4,), valid (4,): a row of `program.inputs`.
    """

    name = "default"
    not_kalman = "a loss enters its state only once it is announced, and its noise is learned on the way"

    def __init__(self, B, dt: float = 0.05, dynamics=None):
        """dynamics: result of `learn`. Raises ConfigError for ticks of another length."""
        self.B, self.dt, self.dynamics = np.asarray(B, float), dt, dynamics
        self._steps = program.steps(dt, self.B, dynamics)
        self._first = self._steps.state.copy()

    def init(self) -> Rows:
        """Before the first tick."""
        return self._first

    def step(self, carry: Rows, u, y, valid, dt=None) -> tuple[Rows, Estimate]:
        """Process a tick; `carry` is not changed."""
        made, n = self._steps, self._steps.rotors
        made.state = carry.copy()
        out = made.run(np.asarray(u)[None], np.asarray(y)[None], np.asarray(valid)[None])
        s, P, _ = made.learned
        status = 1 if u[n + 13] <= GROUND else 0 if np.any(valid) else 2
        return made.state, Estimate(
            s[:THETA], P[:THETA, :THETA], out.theta[0], P[THETA:, THETA:], out.innovation[0], np.diag(out.innovation_var[0]),
            np.int32(status),
        )  # fmt: skip
