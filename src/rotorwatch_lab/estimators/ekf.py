"""Augmented extended Kalman filter: losses as states that walk at random.

    s = [x; theta],   theta(k+1) = theta(k) + walk,   s- = [f(x, u, theta); theta],   A = [F Phi; 0 I],   H = [C D]
    P- = A P A' + blkdiag(Q, theta_walk dt),   K = P- H' (H P- H' + R)^-1,   s = s- + K (y - h(s-)),   P = (I - K H) P-

Source: the textbook filter (Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 8) on the augmented state. On a
linear plant with Gaussian noise it is the optimal estimator; every other method here is compared with it.
"""

from __future__ import annotations

from rotorwatch_lab.maths.augmented_ekf import AugmentedEKF


class EKF(AugmentedEKF):
    """Augmented extended Kalman filter on any plant that can be differentiated."""

    name = "ekf"
    not_kalman = ""

    def __init__(self, system, dt: float, *, theta_walk=1e-3, theta_var=0.01):
        """dt: s. theta_walk: variance that a loss gains per second [1/s]; theta_var: variance of the losses at the start;
        both a number or one per theta. Raises ConfigError for wrong values."""
        super().__init__(system, dt, theta_walk=theta_walk, theta_var=theta_var)
