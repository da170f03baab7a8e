"""Adaptive extended set-membership filter (GD-ESMF): the bound of the process noise shrinks or grows by gradient descent.

    J = ln det W - mu ln delta,   dJ/dq_i = tr(W^-1 W_i) - (mu / delta) e' W^-1 W_i W^-1 e
    W = H P- H' / (1 - rho) + R / rho,   W_i = H (E_ii + Phi E_ii Phi') H' / ((1 - rho) b (1 - b_Q))

The first part wants predictions sharp, the second keeps the set away from empty: delta = 1 - e' W^-1 e is the health index.
Source: Qi, Song, Dai, Han and Wang 2015 (doi:10.5772/60854), rule (39), whose formula is lost in print; reconstructed. Bounds of
the process noise that adapt by the MIT rule has doi:10.5772/51904, too. docs/methods/aesmf.md.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import ellipsoid
from rotorwatch_lab.maths.set_membership import Cutting, SetMembership
from rotorwatch_lab.maths.small import product, solve, symmetric

LARGEST_STEP, LEAST_HEALTH = 0.5, 1e-3


@dataclass(eq=False, repr=False)
class AESMF(SetMembership):
    """The set-membership filter (`set_membership`, with all its keywords) with an adaptive Q.

    eta: rate [1/s]; mu: weight of the health index; floor, ceiling: least and largest factor on Q's diagonal (squared
    semi-axes). The set is only guaranteed when floor keeps Q above the true bound. additive: q_i - eta dt dJ/dq_i as printed,
    in units of q_i, instead of logarithms; stable only for eta dt below about 0.27. Raises ConfigError."""

    _: KW_ONLY
    eta: float = 1.0
    mu: float = 300.0
    floor: float = 1e-3
    ceiling: float = 4.0
    additive: bool = False

    name = "aesmf"
    not_kalman = "its sets hold all states that bounded noise allows, and the bound of the noise adapts"

    def __post_init__(self):
        super().__post_init__()
        checks.positive("eta", self.eta)
        checks.positive("mu", self.mu)
        checks.positive("ceiling", self.ceiling)
        if checks.between("floor", self.floor, 0.0, 1.0) == 0 or self.ceiling < 1:
            raise ConfigError("floor must be above zero, and ceiling at least 1.")

    def adapt(self, q, cutting: Cutting, health, dt):
        """q after one step of the rule, kept within floor and ceiling; unchanged when nothing was measured."""
        slope, delta = gradient(cutting, self.mu)
        slope = slope * jnp.diagonal(self.noise(dt, q))  # d/d ln q_i
        if self.additive:
            new = q - self.eta * dt * slope / jnp.maximum(q, self.floor)
        else:
            new = q * jnp.exp(-jnp.clip(self.eta * dt * slope, -LARGEST_STEP, LARGEST_STEP))
        measured = (cutting.H != 0).any() & (delta > 0)
        return jnp.where(measured, jnp.clip(new, self.floor, self.ceiling), q)


def gradient(cutting: Cutting, mu: float):
    """(dJ/dq_i (n,), delta): q_i the i-th diagonal element of Q."""
    Phi, H, e, P, R, amplify = cutting
    S = product(product(H, P), H.T)
    rho = ellipsoid.batch_share(S, R)
    # Noise of this step, and of the one before as the source counts it.
    columns = jnp.concatenate([H, product(H, Phi)], axis=1)
    W = S / (1 - rho) + R / rho
    solved = solve(symmetric(W), jnp.concatenate([columns, e[:, None]], axis=1))
    delta = 1.0 - e @ solved[:, -1]
    total, pull = (columns * solved[:, :-1]).sum(0), (solved[:, -1] @ columns) ** 2
    slope = (total - mu / jnp.maximum(delta, LEAST_HEALTH) * pull) * amplify / (1 - rho)
    return slope.reshape(2, -1).sum(0), delta
