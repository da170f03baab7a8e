"""What a loss of one rotor may be before anything is seen of it, and after it: by quadrature."""

import numpy as np
from scipy.integrate import trapezoid

from rotorwatch.engine.estimator.hypotheses import LOSS_WIDTH, NONE, SMALL_WIDTH, TOTAL_SHARE

# Share, mean and width of the parts of the prior; small, large, total.
KINDS = [(0.5 - TOTAL_SHARE / 2, 0.0, SMALL_WIDTH), (0.5 - TOTAL_SHARE / 2, 0.0, LOSS_WIDTH), (TOTAL_SHARE, 1.0, NONE)]


def moments(c, z, left=1.0):
    """Log of the mass of prior times likelihood ratio exp(z nu - c nu^2 / 2), mean and variance of nu; left: of the rotor's thrust."""
    nu = np.linspace(-2.0, 3.0, 400_001)
    prior = sum(share * np.exp(-0.5 * ((nu - mean * left) / sd) ** 2) / (sd * np.sqrt(2 * np.pi)) for share, mean, sd in KINDS)
    fit = z * nu - 0.5 * c * nu**2
    density = prior * np.exp(fit - fit.max())
    mass = trapezoid(density, nu)
    mean = trapezoid(nu * density, nu) / mass
    return fit.max() + np.log(mass), mean, trapezoid((nu - mean) ** 2 * density, nu) / mass


def one_of(kinds):
    """Log mass, mean and variance of what is of one of these kinds: of each its share, and the same three."""
    share, mass, mean, variance = np.transpose([[float(v) for v in kind] for kind in kinds])
    mass = mass + np.log(share)
    likely = np.exp(mass - np.logaddexp.reduce(mass))
    at = likely @ mean
    return np.logaddexp.reduce(mass), at, likely @ (variance + (mean - at) ** 2)


def beside_steps(C, z, prior, left=1.0):
    """`moments` of the first of the directions of C (k, k), z (k,), where the others step with variances `prior` (k - 1,)."""
    inner = C[1:, 1:] + np.diag(1.0 / prior)
    c, reported = C[0, 0] - C[0, 1:] @ np.linalg.solve(inner, C[1:, 0]), np.linalg.solve(inner, z[1:])
    gain = 0.5 * z[1:] @ reported - 0.5 * np.linalg.slogdet(np.eye(len(prior)) + C[1:, 1:] * prior)[1]
    mass, mean, variance = moments(c, z[0] - C[0, 1:] @ reported, left)
    return mass + gain, mean, variance
