"""Adaptive extended set-membership filter (GD-ESMF): the bound of the process noise shrinks or grows by gradient descent.

    J = ln det W - mu ln delta,   dJ/dq_i = tr(W^-1 W_i) - (mu / delta) e' W^-1 W_i W^-1 e
    W = H P- H' / (1 - rho) + R / rho,   W_i = H (E_ii + Phi E_ii Phi') H' / ((1 - rho) b (1 - b_Q))

The first part wants predictions sharp, the second keeps the set away from empty: delta = 1 - e' W^-1 e is the health index.
Source: Qi, Song, Dai, Han and Wang 2015, rule (39), whose formula is lost in print; reconstructed. docs/methods/aesmf.md.
"""

from __future__ import annotations

from rotorwatch import checks
from rotorwatch.errors import ConfigError
from rotorwatch.maths import ellipsoid
from rotorwatch.maths.set_membership import Cutting, SetMembership

LARGEST_STEP, LEAST_HEALTH = 0.5, 1e-3


class AESMF(SetMembership):
    """The set-membership filter (`set_membership`) with an adaptive Q."""

    name = "aesmf"
    not_kalman = "its sets hold all states that bounded noise allows, and the bound of the noise adapts"

    def __init__(
        self,
        system,
        dt,
        *,
        eta=1.0,
        mu=300.0,
        floor=1e-3,
        ceiling=4.0,
        additive=False,
        bound=3.0,
        process=None,
        measurement=None,
        theta_centre=None,
        theta_reach=1.0,
        theta_drift=1e-3,
        theta_range=None,
        form="joint",
        cut=None,
        remainder="taylor",
        remainder_box="trace",
        weights=None,
        restart=True,
    ):
        """eta: rate [1/s]; mu: weight of the health index; floor, ceiling: least and largest factor on Q's diagonal (squared
        semi-axes). The set is only guaranteed when floor keeps Q above the true bound. additive: q_i - eta dt dJ/dq_i as
        printed, in units of q_i, instead of logarithms; stable only for eta dt below about 0.27. The rest as
        for `SetMembership`. Raises ConfigError."""
        super().__init__(
            system,
            dt,
            bound=bound,
            process=process,
            measurement=measurement,
            theta_centre=theta_centre,
            theta_reach=theta_reach,
            theta_drift=theta_drift,
            theta_range=theta_range,
            form=form,
            cut=cut,
            remainder=remainder,
            remainder_box=remainder_box,
            weights=weights,
            restart=restart,
        )
        self.eta, self.mu = checks.positive("eta", eta), checks.positive("mu", mu)
        self.floor, self.ceiling = checks.between("floor", floor, 0.0, 1.0), checks.positive("ceiling", ceiling)
        if floor == 0 or ceiling < 1:
            raise ConfigError("floor must be above zero, and ceiling at least 1.")
        self.additive = bool(additive)

    def adapt(self, q, cutting: Cutting, health, dt):
        """q after one step of the rule, kept within floor and ceiling; unchanged when nothing was measured."""
        from jax import numpy as jnp

        slope, delta = gradient(cutting, self.mu)
        slope = slope * jnp.diagonal(self.Q0(dt)) * q  # d/d ln q_i
        if self.additive:
            new = q - self.eta * dt * slope / jnp.maximum(q, self.floor)
        else:
            new = q * jnp.exp(-jnp.clip(self.eta * dt * slope, -LARGEST_STEP, LARGEST_STEP))
        measured = (cutting.H != 0).any() & (delta > 0)
        return jnp.where(measured, jnp.clip(new, self.floor, self.ceiling), q)


def gradient(cutting: Cutting, mu: float):
    """(dJ/dq_i (n,), delta): q_i the i-th diagonal element of Q."""
    from jax import numpy as jnp
    from jax.scipy.linalg import cho_solve

    Phi, H, e, P, R, amplify = cutting
    S = H @ P @ H.T
    rho = ellipsoid.batch_share(S, R)
    W = jnp.linalg.cholesky(ellipsoid.symmetric(S / (1 - rho) + R / rho))
    s = cho_solve((W, True), e)
    delta = 1.0 - e @ s
    total, pull = 0.0, 0.0
    for columns in (H, H @ Phi):  # noise of this step, and of the one before as the source counts it
        total = total + (columns * cho_solve((W, True), columns)).sum(0)
        pull = pull + (s @ columns) ** 2
    return (total - mu / jnp.maximum(delta, LEAST_HEALTH) * pull) * amplify / (1 - rho), delta
