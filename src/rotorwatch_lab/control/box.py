"""The least squares problem of allocation, exactly, in a fixed number of turns: few equations, many bounded unknowns.

    argmin over 0 <= u <= 1 of |A u - b|^2 + sum_i d_i (u_i - c_i)^2          A (m, n), d > 0: one solution

Its dual has only m unknowns: with r = b - A u a solution is u = clip(c + D^-1 A' r, 0, 1), so that

    F(r) = r + A clip(c + D^-1 A' r, 0, 1) - b = 0

F is the gradient of a strongly convex function, piecewise quadratic. Newton's method with an exact search along each step
arrives after finitely many turns (Qi and Sun, A nonsmooth version of Newton's method, Mathematical Programming 58, 1993; for bounded
least squares Li and Swetits, SIAM Journal on Optimization 7, 1997); a turn costs a 4 x 4 system, whatever the number of rotors. What
the turns end with says which rotors are at a bound; the others are solved for once more and refined, so that no rounding adds up.
"""

from __future__ import annotations

from rotorwatch.base.backend import jax, jnp

# Of 200,000 demands on vehicles of up to twelve rotors none took more than 16 (docs/control.md).
TURNS = 24
CLOSE = 1e-9  # a whole step; no step


def solve(A, b, c, d, turns: int = TURNS):
    """(u (n,), turns taken, int32) for A (m, n), b (m,), c (n,) and d (n,) > 0: see the module. Turns after the last that is needed do
    nothing; `turns` + 1 are taken when they were not enough."""
    over_d = A / d

    def side(t):
        return jnp.where(t <= 0.0, -1, jnp.where(t >= 1.0, 1, 0))

    def curvature(free):
        """I + A_f D_f^-1 A_f' of the free columns."""
        return (over_d * free) @ A.T

    def turn(now):
        r, t, taken, _ = now
        F = r + A @ jnp.clip(t, 0.0, 1.0) - b
        step = -_solve_small(_factor(curvature((side(t) == 0).astype(t.dtype))), F)
        rate = step @ over_d
        length = _search(t, rate, d, step @ (r - b), step @ step)
        r = r + length * step
        new = c + r @ over_d
        # A whole step that ends on the piece it was worked out on is the end; so is one that moves nothing (an element just at a bound).
        same = (side(new) == side(t)).all() & (jnp.abs(length - 1.0) < CLOSE)
        return r, new, taken + 1, same | (jnp.abs(rate) <= CLOSE * jnp.maximum(jnp.abs(t), 1.0)).all()

    def body(_, now):
        return jax.lax.cond(now[3], lambda now: now, turn, now)

    start = (jnp.zeros_like(b), c, jnp.int32(0), jnp.zeros((), bool))
    _, t, taken, done = jax.lax.fori_loop(0, turns, body, start)

    u = jnp.where(side(t) == 0, c, jnp.where(t <= 0.0, 0.0, 1.0))
    u = _among(A, b, c, d, (side(t) == 0).astype(t.dtype), u)
    return jnp.clip(u, 0.0, 1.0), jnp.where(done, taken, taken + 1)


def unbounded(A, b, c, d):
    """The same without the box."""
    return _among(A, b, c, d, jnp.ones_like(c), c)


def _among(A, b, c, d, free, u):
    """The best u (n,) that keeps the elements where free (n,) is 0: solved once, then refined twice."""
    over_d = A / d
    factor = _factor((over_d * free) @ A.T)
    for _ in range(3):
        du = free * ((b - A @ u) @ A - d * (u - c)) / d
        u = u + du - free * (_solve_small(factor, A @ du) @ over_d)
    return u


def _search(t, rate, d, base, square):
    """How far to go: where the slope base + x square + sum d rate clip(t + x rate) along the step, which only grows, is zero."""
    moves = rate != 0.0
    safe = jnp.where(moves, rate, 1.0)
    corners = jnp.concatenate([-t / safe, (1.0 - t) / safe])
    ahead = jnp.concatenate([moves, moves]) & (corners > 0.0)
    corners = jnp.where(ahead, corners, 0.0)
    weight = d * rate

    slope = base + corners * square + jnp.clip(t + corners[:, None] * rate, 0.0, 1.0) @ weight
    slope = jnp.where(ahead, slope, 0.0)
    start = base + jnp.clip(t, 0.0, 1.0) @ weight
    below, above = ahead & (slope <= 0.0), ahead & (slope > 0.0)
    low = jnp.where(below, corners, 0.0).max()
    low_slope = jnp.where(below, slope, start).max()
    high = jnp.where(above, corners, jnp.inf).min()
    high_slope = jnp.where(above, slope, jnp.inf).min()
    last = ~above.any()  # beyond the last corner everything is at a bound
    gap = jnp.where(last, 1.0, high - low)
    rise = jnp.where(last, square, high_slope - low_slope)
    return low - low_slope * gap / jnp.where(rise > 0.0, rise, 1.0)


def _factor(G):
    """L and scale of I + G = L scale L' for a positive semidefinite G (m, m), unrolled."""
    m = G.shape[0]
    L, scale = {}, []
    for i in range(m):
        for j in range(i):
            L[i, j] = (G[i, j] - sum(L[i, k] * L[j, k] * scale[k] for k in range(j))) / scale[j]
        scale.append(1.0 + G[i, i] - sum(L[i, k] ** 2 * scale[k] for k in range(i)))
    return L, scale


def _solve_small(factor, right):
    """(I + G)^-1 right, from the factor of `_factor`."""
    L, scale = factor
    m, x = len(scale), []
    for i in range(m):
        x.append(right[i] - sum(L[i, k] * x[k] for k in range(i)))
    x = [x[i] / scale[i] for i in range(m)]
    for i in reversed(range(m)):
        x[i] = x[i] - sum(L[k, i] * x[k] for k in range(i + 1, m))
    return jnp.stack(x)
