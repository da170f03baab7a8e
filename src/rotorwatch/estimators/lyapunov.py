"""The Lyapunov effectiveness estimator: an observer that adapts the losses so that a Lyapunov function falls.

Niermeyer, Pak and Lohmann 2017, section 3; the law is in `maths/lyapunov_law.py`, its derivation in docs/methods/lyapunov.md.
"""

from __future__ import annotations

from rotorwatch import checks
from rotorwatch.core import Estimate
from rotorwatch.maths.lyapunov_law import Law, State, advance, estimate, start


class Lyapunov:
    """dtheta/dt = Proj{-Gamma (G' M w + k_f D' f~)}: the cheapest of the paper's estimators. x, theta as in the plant."""

    name = "lyapunov"
    not_kalman = "Its gains are fixed by a Lyapunov function and do not follow the covariance."

    def __init__(
        self,
        system,
        dt,
        *,
        rate=12.0,
        bandwidth=4.0,
        direct_rate=1.5,
        bounds=(-0.02, 1.0),
        hold=0.22,
        u_nominal=None,
        theta_sd=0.3,
        walk=0.05,
    ):
        """rate: state correction k_w [1/s]. bandwidth: of the adaptation [rad/s]. direct_rate: speed at which outputs that only
        theta moves (the accelerometer) adapt it [1/s]. bounds: least and largest loss. hold: share of u_nominal below which a
        rotor's loss rests. u_nominal (n_u,): input the gains are evened out for (default: hover). theta_sd: of a loss at the
        start; walk: of a loss in a second; both for the covariance only. Raises ConfigError for plants with unmeasured states.
        """
        self.system, self.dt = system, dt
        self.law = Law("lyapunov", system, dt, rate, bandwidth, direct_rate, bounds, hold, u_nominal)
        self.theta_sd, self.walk = checks.positive("theta_sd", theta_sd), checks.positive("walk", walk)

    def init(self) -> State:
        """Nothing lost, the state at the plant's x0."""
        return start(self.system, self.theta_sd)

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """One step of dt seconds (None: the constructor's) with input u over it and y at its end."""
        state, e, S, _ = advance(self.law, carry, u, y, valid, self.dt if dt is None else dt, self.walk)
        return state, estimate(state, e, S, valid)
