"""Ellipsoids as sets: E(a, P) = {x : (x - a)' P^-1 (x - a) <= 1}; sums, boxes around and inside, cuts by measurements.

Every function here returns a set that holds the exact one. Sources: Schweppe 1968; Fogel and Huang, Automatica 18(2), 1982;
Scholte and Campbell, Int. J. Robust Nonlinear Control 13, 2003 (extended set-membership filter); Zhou, Han and Liu, J.
Process Control 18, 2008 (the same on factors U D U').
"""

from __future__ import annotations

from collections import namedtuple

from rotorwatch.base.backend import jax, jnp, lax
from rotorwatch.core import Array
from rotorwatch_lab.maths.small import blocks, product, solve, symmetric

TINY = 1e-300


class Cut(namedtuple("Cut", "a P health")):
    """An ellipsoid after a measurement. health: how far from empty, 1 where the innovation is 0, 0 or less when empty."""


def around_box(half, rule: str = "trace"):
    """(n,) squared semi-axes of an axis-parallel ellipsoid around the box |x_i| <= half_i.

    trace: half_i times the sum of all, of least trace. volume: p half_i^2, p the number of sides that are not 0, of least
    volume. paper: 2 half_i^2 as Scholte and Campbell print; for more than two sides it does NOT hold the box.
    """
    if rule == "trace":
        return half * half.sum()
    if rule == "volume":
        return (half > 0).sum() * half**2
    return 2.0 * half**2 if rule == "paper" else jnp.full_like(half, jnp.nan)


def share(p, q):
    """b in [0, 1] of `minkowski` from the two weighted traces."""
    p, q = jnp.sqrt(jnp.maximum(p, 0.0)), jnp.sqrt(jnp.maximum(q, 0.0))
    return q / jnp.maximum(p + q, TINY)


def parts(b):
    """(1 / (1 - b), 1 / b), 0 for a part without extent."""
    left = jnp.where(b < 1, 1.0 / jnp.where(b < 1, 1.0 - b, 1.0), 0.0)
    return left, jnp.where(b > 0, 1.0 / jnp.where(b > 0, b, 1.0), 0.0)


def minkowski(P, Q, weights: Array = 1.0):
    """(P / (1 - b) + Q / b, b): the ellipsoid of least trace of that form around E(0, P) + E(0, Q), both (n, n).

        b = sqrt tr Q / (sqrt tr P + sqrt tr Q)

    weights (n,) of the diagonal in that trace, for states of unlike units; any b between 0 and 1 gives an outer bound.
    """
    b = share((weights * P.diagonal()).sum(), (weights * Q.diagonal()).sum())
    left, right = parts(b)
    return left * P + right * Q, b


def largest_eigenvalue(A, squarings: int = 7):
    """Largest eigenvalue of a symmetric positive semidefinite matrix, from below: Rayleigh's quotient after 2^squarings power steps.

    Only products, so it can stand in a compiled step; good to 1 % when the second largest is 0.97 of it or less, and
    never below the mean eigenvalue by more than rounding.
    """
    power = A / jnp.maximum(jnp.trace(A), TINY)  # the largest eigenvalue is 1/n or more: its power is far from TINY
    for _ in range(squarings):
        power = power @ power
    return (A * power).sum() / jnp.maximum(jnp.trace(power), TINY)


def strip_cut(a, P, h, e, r, rule: str = "source", weights: Array = 1.0):
    """`Cut` of E(a, P) by the strip |e - h'(x - a)| <= sqrt(r): one scalar measurement with bounded error.

    h (n,) row of H; e: measured minus predicted; r: squared bound of the error. With g = h'Ph, lambda >= 0 the weight of the
    strip and rho = lambda / (1 + lambda), the source's

        K = P h / (1 - rho) / W,   W = g / (1 - rho) + r / rho,   P <- delta (P - K h'P) / (1 - rho),   delta = 1 - e^2 / W

    source: rho = sqrt r / (sqrt g + sqrt r), as Scholte and Campbell; skipped where g <= r, where it would widen the set
    along h. volume: the weight of least volume (Fogel and Huang 1982), after the strip has been narrowed to what the
    ellipsoid reaches (Belforte, Bona and Cerone 1990); volume never grows. trace: the weight of least trace, each diagonal
    element times its weight (n,), after the same narrowing; that trace never grows.
    """
    Ph = P @ h
    g = jnp.maximum(h @ Ph, 0.0)
    root_g, root_r = jnp.sqrt(g), jnp.sqrt(r)
    empty = jnp.abs(e) > root_g + root_r
    if rule == "source":
        total = jnp.maximum(root_g + root_r, TINY)
        stretch = total / jnp.maximum(root_g, TINY)  # 1 / (1 - rho)
        health = 1.0 - e**2 / total**2
        use = (g > r) & (health > 0)
        gain = Ph / jnp.maximum(root_g * total, TINY)  # K
        cut = health * stretch * (P - jnp.outer(gain, Ph))
        shift = gain * e
    else:
        lo, hi = jnp.maximum(e - root_r, -root_g), jnp.minimum(e + root_r, root_g)
        e, r = 0.5 * (lo + hi), jnp.maximum(0.25 * (hi - lo) ** 2, 1e-12 * r)
        if rule == "volume":
            weight = _volume_weight(a.shape[0], g, r, e)
        else:
            weight = _trace_weight((weights * P.diagonal()).sum(), (weights * Ph**2).sum(), g, r, e)
        D = r + weight * g
        health = 1.0 + weight - weight * e**2 / jnp.maximum(D, TINY)
        use = (weight > 0) & ~empty & (health > 0)
        k = Ph * (weight / jnp.maximum(D, TINY))
        less = P - jnp.outer(k, Ph)
        # Joseph's form of P - k Ph': no digits lost where the strip is much thinner than the set.
        cut = health * (less - jnp.outer(less @ h, k) + jnp.outer(k, k) * (r / jnp.maximum(weight, TINY)))
        shift = k * e
    keep = jnp.where(use, 1.0, 0.0)
    return Cut(a + keep * shift, jnp.where(use, symmetric(cut), P), jnp.where(empty, -1.0, jnp.where(use, health, 1.0)))


def _volume_weight(n: int, g, r, e):
    """lambda of least volume for the strip of bound sqrt(r): the root of a quadratic, 0 where no cut makes it smaller."""
    # d ln(volume) / d lambda = 0 with sigma = 1 + lambda - lambda e^2 / (r + lambda g):  A lambda^2 + B lambda + C = 0
    A = (n - 1) * g**2
    B = g * ((2 * n - 1) * r - g + e**2)
    C = r * (n * (r - e**2) - g)
    weight = (-B + jnp.sqrt(jnp.maximum(B**2 - 4 * A * C, 0.0))) / jnp.maximum(2 * A, TINY)
    return jnp.where(C < 0, weight, 0.0)


def _trace_weight(tau, kappa, g, r, e):
    """lambda of least weighted trace, tau = tr WP, kappa = h'PWPh: the positive root of a cubic, 0 where no cut makes it smaller.

    tr(lambda) = sigma (tau - lambda kappa / (r + lambda g)); its derivative's numerator, with lambda = (nu - 1) r / g, is
    nu^3 + p nu + q times a positive number, and has one root above 1 exactly when the trace falls at lambda = 0.
    """
    rest = jnp.maximum(tau * g - kappa, 1e-12 * tau * g) + TINY
    beta = r + g - e**2
    c1 = (2 * r * (g * tau * r + beta * rest) - g * (beta * tau * r + r * rest)) / (r**2 * rest)
    c0 = (r * (beta * tau * r + r * rest) - 2 * g * r**2 * tau) * g / (r**3 * rest)
    p, q = c1 - 3.0, c0 - c1 + 2.0
    third, half = p / 3.0, 0.5 * q
    inside = half**2 + third**3
    root = jnp.sqrt(jnp.maximum(inside, 0.0))
    one = jnp.cbrt(-half + root) + jnp.cbrt(-half - root)
    size = jnp.sqrt(jnp.maximum(-third, 0.0))
    three = 2 * size * jnp.cos(jnp.arccos(jnp.clip(-half / jnp.maximum(size**3, TINY), -1.0, 1.0)) / 3.0)
    nu = jnp.maximum(jnp.where(inside > 0, one, three), 1.0)
    for _ in range(6):  # Newton, from Cardano's root: that one loses its digits where the cut is nearly the whole set
        nu = jnp.maximum(nu - (nu * (nu**2 + p) + q) / jnp.maximum(3 * nu**2 + p, TINY), 1.0)
    return jnp.where((c0 < 0) & (g > 0), jnp.maximum(nu - 1.0, 0.0) * r / jnp.maximum(g, TINY), 0.0)


def batch_cut(a, P, H, e, R):
    """`Cut` of E(a, P) by an error ellipsoid E(0, R): all rows of H (m, n) at once, e (m,), R (m, m).

        rho = sqrt rm / (sqrt pm + sqrt rm),  W = H P H' / (1 - rho) + R / rho,  K = P H' W^-1 / (1 - rho)
        delta = 1 - e' W^-1 e,  P <- delta (P - K H P) / (1 - rho),  a <- a + K e

    rm, pm: largest eigenvalues of R and H P H' (Scholte and Campbell 2003). Also returns W's Cholesky factor and rho.
    """
    HP = H @ P
    S = symmetric(HP @ H.T)
    rho = batch_share(S, R)
    root = jnp.linalg.cholesky(symmetric(S / (1 - rho) + R / rho))
    K = jax.scipy.linalg.cho_solve((root, True), HP).T / (1 - rho)
    health = 1.0 - e @ jax.scipy.linalg.cho_solve((root, True), e)
    return Cut(a + K @ e, symmetric(health * (P - K @ HP) / (1 - rho)), health), root, rho


def joint_gains(PH, S, e, R, weight):
    """(K, health) of `joint_cut`: PH (n, m) = P H', S (m, m) = H P H'."""
    solved = solve(S + R / weight, jnp.concatenate([PH.T, e[:, None]], axis=1))
    return solved[:, :-1].T, 1.0 + weight - e @ solved[:, -1]


def joint_cut(a, P, H, e, R, weight, K, health, part=slice(None)):
    """`Cut` of E(a, P) by a measurement whose errors all together lie in E(0, R), with the given weight lambda > 0.

        K = P H' (H P H' + R / lambda)^-1,   a <- a + K e,   P <- health (P - K H P)
        health = 1 + lambda - e' (H P H' + R / lambda)^-1 e

    H (m, n), rows 0 where nothing was measured; e (m,) measured minus predicted at a; R (m, m); K (n, m), health of
    `joint_gains`; part: the components wanted. One ellipsoid bounds all errors, so it costs one lambda, where m strips of the
    same size would cost m. In Joseph's form: no digits are lost where the set is much larger than the errors.
    """
    K = K[part]
    both = jnp.concatenate([jnp.eye(a.shape[0])[part] - product(K, H), K], axis=1)
    shape = product(product(both, blocks(P, R / weight, jnp)), both.T)
    return Cut(a[part] + K @ e, symmetric(health * shape), health)


def batch_share(S, R):
    """rho of `batch_cut`, R being diagonal; kept off its ends, where a part would weigh nothing. Any value in between gives an
    outer bound."""
    p, r = jnp.sqrt(largest_eigenvalue(S)), jnp.sqrt(R.diagonal().max())
    return jnp.clip(r / jnp.maximum(p + r, TINY), 1e-6, 1 - 1e-6)


def factored(P):
    """P = U D U' (definite) as one matrix: unit upper triangular U above the diagonal, D on it."""
    root = jnp.linalg.cholesky(P[::-1, ::-1])[::-1, ::-1]
    d = root.diagonal()
    return root / d + jnp.diag(d**2 - 1.0)


def unfactored(UD):
    """P of its factors."""
    U, D = factors(UD)
    return symmetric((U * D) @ U.T)


def factors(UD):
    """(U, D) of the one matrix they are kept in."""
    D = UD.diagonal()
    return UD + jnp.diag(1.0 - D), D


def ud_sum(rows, D):
    """Factors of rows diag(D) rows' (n, N), N >= n: modified weighted Gram-Schmidt (Thornton and Bierman 1977)."""
    n = rows.shape[0]
    index = jnp.arange(n)

    def column(k, state):
        rows, UD = state
        j = n - 1 - k
        row = lax.dynamic_index_in_dim(rows, j, keepdims=False)
        products = rows @ (D * row)
        d = lax.dynamic_index_in_dim(products, j, keepdims=False)
        u = jnp.where((index < j) & (d > 0), products / jnp.where(d > 0, d, 1.0), 0.0)
        column = jnp.where(index == j, d, u)
        return rows - jnp.outer(u, row), UD + jnp.outer(column, jnp.where(index == j, 1.0, 0.0))

    return lax.fori_loop(0, n, column, (rows, jnp.zeros((n, n))))[1]


def ud_strip_cut(a, UD, h, e, r):
    """`strip_cut` with the source's rule on factors: Bierman's update with D / (1 - rho) and r / rho, then D delta.

    Bierman's recursion over columns needs only sums of earlier columns, so it is written as running sums.
    """
    U, D = factors(UD)
    f = U.T @ h
    g = (f**2 * D).sum()
    root_g, root_r = jnp.sqrt(g), jnp.sqrt(r)
    total = jnp.maximum(root_g + root_r, TINY)
    health = 1.0 - e**2 / total**2
    empty = jnp.abs(e) > total
    use = (g > r) & (health > 0)
    v = D * f * total / jnp.maximum(root_g, TINY)
    noise = root_r * total  # r / rho
    alpha = noise + jnp.cumsum(f * v)
    before = alpha - f * v
    gain = jnp.cumsum(U * v, axis=1)
    U_new = U - (gain - U * v) * (f / before)
    D_new = health * D * total / jnp.maximum(root_g, TINY) * before / alpha
    UD_new = U_new + jnp.diag(D_new - 1.0)
    keep = jnp.where(use, e / alpha[-1], 0.0)
    return Cut(a + keep * gain[:, -1], jnp.where(use, UD_new, UD), jnp.where(empty, -1.0, jnp.where(use, health, 1.0)))
