"""The Lyapunov effectiveness estimator: an observer that adapts the losses so that a Lyapunov function falls.

Niermeyer, Pak and Lohmann 2017, section 3; the law is in `maths/lyapunov_law.py`, its derivation in docs/methods/lyapunov.md.
"""

from __future__ import annotations

from rotorwatch.core import Estimate
from rotorwatch_lab.maths.lyapunov_law import Adaptation, State, advance, estimate, start


class Lyapunov(Adaptation):
    """dtheta/dt = Proj{-Gamma (G' M w + k_f D' f~)}: the cheapest of the paper's estimators. x, theta as in the plant."""

    name = "lyapunov"
    not_kalman = "Its gains are fixed by a Lyapunov function and do not follow the covariance."

    def init(self) -> State:
        """Nothing lost, the state at the plant's x0."""
        return start(self.system, self.theta_sd)

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """Advance by dt seconds (None: the constructor's dt) with input u held over the step and y at its end."""
        state, e, S, _ = advance(self.law, carry, u, y, valid, self.dt if dt is None else dt, self.walk)
        return state, estimate(state, e, S, valid)
