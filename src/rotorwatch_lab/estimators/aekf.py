"""Adaptive extended Kalman filter with adaptive process noise (AEKF): the augmented EKF whose Q follows its innovations by the MIT rule.

    P- = A P A' + q^1/2 blkdiag(Q, theta_walk dt) q^1/2,   q adapted after each step: `mit_rule`

Not `adaptive_ekf`, which is Zhang's filter: there the losses are forgotten at a fixed rate, and the process noise stays. Source: the
baseline of the flight test of Qi, Song, Dai, Han and Wang 2015; the rule's form is reconstructed. docs/methods/aekf.md.
"""

from __future__ import annotations

from rotorwatch_lab.maths.augmented_ekf import AugmentedEKF
from rotorwatch_lab.maths.mit_rule import adaptation


class AEKF(AugmentedEKF):
    """Augmented EKF with adaptive process noise, on any plant that can be differentiated."""

    name = "aekf"
    not_kalman = "it adapts the process noise to its innovations"

    def __init__(self, system, dt: float, *, theta_walk=1e-3, theta_var=0.01, eta=0.5, window_s=1.0):
        """dt: s. theta_walk: variance that a loss gains per second [1/s] before adaptation; theta_var: variance of the losses at
        the start; both a number or one per theta. eta: rate of adaptation [1/s]; window_s: measured time over which
        innovations are averaged [s]. Raises ConfigError for wrong values."""
        super().__init__(system, dt, theta_walk=theta_walk, theta_var=theta_var, adaptation=adaptation(eta, window_s, dt))
