"""What a loss of one rotor may be before anything is seen of it, and after it: by quadrature."""

import numpy as np
from scipy.integrate import trapezoid

from rotorwatch.default.hypotheses import LOSS_WIDTH, NONE, SMALL_WIDTH, TOTAL_SHARE

# Share, mean and width of the parts of the prior; small, large, total.
KINDS = [(0.5 - TOTAL_SHARE / 2, 0.0, SMALL_WIDTH), (0.5 - TOTAL_SHARE / 2, 0.0, LOSS_WIDTH), (TOTAL_SHARE, 1.0, NONE)]


def moments(c, z, left=1.0):
    """Log of the mass of prior times likelihood ratio exp(z nu - c nu^2 / 2), mean and variance of nu; left: of the rotor's thrust."""
    nu = np.linspace(-2.0, 3.0, 400_001)
    prior = sum(
        share * np.exp(-0.5 * ((nu - mean * left) / sd) ** 2) / (sd * np.sqrt(2 * np.pi)) for share, mean, sd in KINDS
    )
    fit = z * nu - 0.5 * c * nu**2
    density = prior * np.exp(fit - fit.max())
    mass = trapezoid(density, nu)
    mean = trapezoid(nu * density, nu) / mass
    return fit.max() + np.log(mass), mean, trapezoid((nu - mean) ** 2 * density, nu) / mass
