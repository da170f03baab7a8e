"""Distribution functions of the normal, of Student's t and of F, in NumPy and Python's own mathematics.

t and F follow from the regularised incomplete beta function,

    P(t < x) = 1 - I_{nu / (nu + x^2)}(nu / 2, 1 / 2) / 2,   x > 0        P(F > x) = I_{d2 / (d2 + d1 x)}(d2 / 2, d1 / 2)

(Abramowitz & Stegun, Handbook of mathematical functions, 26.5.27 and 26.6.2), which is a continued fraction (26.5.8), evaluated by the
modified Lentz method.
"""

from __future__ import annotations

import functools
import math

import numpy as np

MOST_TERMS, ENOUGH, TINY = 10_000, 1e-15, 1e-300
FAR = 30.0


def normal_cdf(x):
    """P(z < x) of standard normal z, for each x."""
    return 0.5 * np.vectorize(math.erfc, otypes=[float])(-np.asarray(x, float) / math.sqrt(2.0))


def log_normal_cdf(x):
    """Its logarithm, also where it is too small for a number: there by the asymptotic series (Abramowitz & Stegun, 26.2.12)."""
    x = np.asarray(x, float)
    far = np.minimum(x, -FAR)
    w = far**-2
    series = np.log1p(-w * (1.0 - 3.0 * w * (1.0 - 5.0 * w * (1.0 - 7.0 * w))))
    below = -0.5 * far**2 - np.log(-far) - 0.5 * math.log(2.0 * math.pi) + series
    near = np.where(x > 0.0, np.log1p(-normal_cdf(-np.abs(x))), np.log(np.maximum(normal_cdf(x), TINY)))
    return np.where(x < -FAR, below, near)


def normal_quantile(share: float, low: float) -> float:
    """z that this share of standard normal numbers above `low` is below."""
    wanted = math.log1p(-share) + float(log_normal_cdf(-low))
    left, right = low, max(low, 0.0) + 40.0
    while right - left > 1e-13 * max(1.0, abs(left)):
        middle = 0.5 * (left + right)
        left, right = (middle, right) if float(log_normal_cdf(-middle)) > wanted else (left, middle)
    return 0.5 * (left + right)


def beta_share(a: float, b: float, x: float) -> float:
    """I_x(a, b), the regularised incomplete beta function, for a, b > 0 and x in 0..1."""
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0)
    if x > (a + 1.0) / (a + b + 2.0):  # where the fraction converges slowly, the other tail's converges fast
        return 1.0 - beta_share(b, a, 1.0 - x)
    front = a * math.log(x) + b * math.log1p(-x) + math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    C, D = 1.0, 1.0 - (a + b) * x / (a + 1.0)
    D = 1.0 / (D if abs(D) > TINY else TINY)
    fraction = D
    for m in range(1, MOST_TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0))
        for term in (even, odd):
            D, C = 1.0 + term * D, 1.0 + term / C
            D, C = 1.0 / (D if abs(D) > TINY else TINY), C if abs(C) > TINY else TINY
            fraction *= C * D
        if abs(C * D - 1.0) < ENOUGH:
            break
    return math.exp(front) * fraction / a


def student_cdf(x: float, dof: float) -> float:
    """P(t < x) of Student's t with dof degrees of freedom."""
    square = x * x
    if square < min(dof, 1.0):  # near 0 the other end of the same function keeps all digits
        tail = 0.5 - 0.5 * beta_share(0.5, 0.5 * dof, square / (dof + square))
    else:
        tail = 0.5 * beta_share(0.5 * dof, 0.5, dof / (dof + square))
    return tail if x < 0.0 else 1.0 - tail


def student_shares(x: np.ndarray, dof: int) -> np.ndarray:
    """P(t < x) for each x (m,), of a whole number of degrees of freedom, all at once: the finite sums of Abramowitz & Stegun, 26.7.3 and
    26.7.4. Exact to 1e-15, not in relation to a small tail."""
    square = 1.0 / (1.0 + np.square(x) / dof)  # of the cosine of the angle whose tangent is x / sqrt(dof)
    sine, odd = x / math.sqrt(dof) * np.sqrt(square), dof % 2
    factors = [(2.0 * k + odd - 1.0) / (2.0 * k + odd) for k in range(1, (dof - odd) // 2)]
    terms = 1.0 + np.cumprod(np.multiply.outer(square, factors), axis=1).sum(axis=1)
    if not odd:
        return 0.5 + 0.5 * sine * terms
    angle = np.arctan(x / math.sqrt(dof))
    return 0.5 + (angle + (sine * np.sqrt(square) * terms if dof > 1 else 0.0)) / math.pi


@functools.lru_cache
def student_quantile(share: float, dof: float) -> float:
    """x with student_cdf(x, dof) = share; 0 < share < 1."""
    low, high = -1.0, 1.0
    while student_cdf(low, dof) > share:
        low *= 2.0
    while student_cdf(high, dof) < share:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if student_cdf(middle, dof) < share else (low, middle)
    return 0.5 * (low + high)


def student_density(x, dof: float):
    """Density of Student's t with dof degrees of freedom, at each x."""
    size = math.lgamma(0.5 * (dof + 1.0)) - math.lgamma(0.5 * dof) - 0.5 * math.log(dof * math.pi)
    return np.exp(size - 0.5 * (dof + 1.0) * np.log1p(np.square(x) / dof))


def f_tail(x: float, above: float, below: float) -> float:
    """P(F > x) of F with `above` and `below` degrees of freedom, x >= 0."""
    return beta_share(0.5 * below, 0.5 * above, below / (below + above * x))
