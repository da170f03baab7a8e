"""Moving-horizon estimation of states and losses: constrained least squares over the last half second, at every node.

Nodes s_k = (x_k, theta_k), node_s apart; within an interval the plant is integrated sample by sample with the inputs as given:

    min  |s_0 - s_bar|^2_{P_bar^-1} + sum_k |s_k - F_k(s_{k-1})|^2_{Q^-1} + sum_k sum_j |y_kj - h_kj|^2_{R^-1},   theta_k in a box

Samples inside an interval are predicted from its first node, the last one from its last node. The prior (s_bar, P_bar) comes
from an extended Kalman filter that follows half a second behind (arrival cost). Gauss-Newton steps from the last solution;
each is a quadratic program with box bounds, solved by a primal-dual active-set method whose linear systems are block
tridiagonal. Between nodes, and for the covariance, an extended Kalman filter runs along.
Source: the estimator that Niermeyer, Pak and Lohmann 2017 compare with; Rao, Rawlings and Mayne, IEEE TAC 48(2), 2003.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Estimate
from rotorwatch_lab.maths import bounded, linearise, plant
from rotorwatch_lab.maths.small import definite_solve, symmetric

FLOOR = 1e-9  # process noise of states that have none, as a share of P0 in a second: keeps Q invertible
REST = 1e-4  # share of the walk's variance that a rotor at rest keeps, for the same reason


class Samples(namedtuple("Samples", "u y valid dt")):
    """Rows of one interval, (m, ...), or of all of them, (M, m, ...): input, measurement (0 where invalid), validity, dt."""


class Carry(NamedTuple):
    """s, P: the filter that runs along. open: samples of the interval that is not complete, `count` of them. window: the complete
    intervals, `filled` of them. nodes (M + 1, n_s), force (M + 1, n_s): last solution and what its bounds exert.
    prior, prior_P: arrival cost."""

    s: Any
    P: Any
    open: Samples
    count: Any
    window: Samples
    filled: Any
    nodes: Any
    force: Any
    prior: Any
    prior_P: Any


class Interval(namedtuple("Interval", "F A e E e_weight r C r_weight Q_inverse")):
    """Linearisation of an interval: F(s_{k-1}) and A; residuals e, Jacobian E and 1/R of the inner samples; r, C, and 1/R of the last;
    Q^-1."""


class MHE:
    """A window of nodes solved anew at each of them: the most costly method here, and the only one with hard bounds on every loss."""

    name = "mhe"
    not_kalman = "Losses are kept in their box, and the estimate is smoothed only where a node is complete."

    def __init__(
        self,
        system,
        dt,
        *,
        nodes=25,
        node_s=0.02,
        iterations=2,
        active_set=2,
        bounds=(-0.02, 1.0),
        theta_sd=0.1,
        walk=0.07,
        hold=0.22,
        u_nominal=None,
    ):
        """nodes: in the window. node_s: between them [s]; at least one step of dt. iterations: Gauss-Newton steps a solve.
        active_set: passes of the active-set method a step; it starts from the last one's set. bounds: least and largest loss.
        theta_sd: of a loss at the start. walk: of a loss in a second, for rotors commanded
        at least `hold` times u_nominal (n_u,) (default: hover); others rest. Raises ConfigError for values that cannot be.
        """
        self.system, self.dt = plant.checked("The moving-horizon estimator", system, dt), dt
        self.intervals, self.m = (checks.whole("nodes", nodes, 2) - 1, max(1, round(checks.positive("node_s", node_s) / dt)))
        self.iterations, self.passes = (checks.whole("iterations", iterations, 1), checks.whole("active_set", active_set, 1))
        self.theta_sd, self.walk = checks.positive("theta_sd", theta_sd), checks.positive("walk", walk)
        self.least = checks.between("hold", hold, 0.0, 1.0) * bounded.nominal_input(system, u_nominal)
        low, high = bounded.of_losses(system, bounds)
        free = jnp.full(system.n_x, jnp.inf)
        self.low, self.high = jnp.concatenate([-free, low]), jnp.concatenate([free, high])
        self.n = system.n_x + system.n_theta

    def init(self) -> Carry:
        """Nothing lost, the plant's x0 and P0, an empty window."""
        system, n, M, m = self.system, self.n, self.intervals, self.m
        s, P = plant.start(system, self.theta_sd**2 * jnp.eye(system.n_theta))
        zero = jnp.zeros((), jnp.int32)

        def samples(*size):
            y = jnp.zeros((*size, system.n_y))
            return Samples(jnp.zeros((*size, system.n_u)), y, jnp.zeros(y.shape, bool), jnp.full(size, 1.0 * self.dt))

        nodes = jnp.broadcast_to(s, (M + 1, n))
        return Carry(s, P, samples(m), zero, samples(M, m), zero, nodes, jnp.zeros((M + 1, n)), s, P)

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Advance by dt seconds (None: the constructor's dt) with input u held over the step and y at its end."""
        dt = jnp.asarray(self.dt if dt is None else dt, float)
        y = jnp.where(valid, y, 0.0)
        s, A = linearise.once(lambda s: self.move(s, u, dt), carry.s)
        P = symmetric(A @ carry.P @ A.T + self.Q(u, dt))
        y_minus, H = linearise.once(lambda s: self.predict(s, u), s)
        e, R = jnp.where(valid, y - y_minus, 0.0), self.system.R(u)
        S = symmetric(H @ P @ H.T + jnp.diag(R))
        s, P = absorb(s, P, H, e, R, valid)

        here = jnp.arange(self.m) == carry.count
        row = Samples(u, y, valid, dt)
        opened = jax.tree.map(lambda a, b: jnp.where(here.reshape(-1, *[1] * b.ndim), b, a), carry.open, row)
        carry = carry._replace(s=s, P=P, open=opened, count=carry.count + 1)
        carry = jax.lax.cond(carry.count == self.m, self.node, lambda c: c, carry)
        k = self.system.n_x
        theta = jnp.clip(carry.s[k:], self.low[k:], self.high[k:])
        return carry, Estimate(carry.s[:k], P[:k, :k], theta, P[k:, k:], e, S, linearise.status(valid))

    # The window

    def node(self, carry: Carry) -> Carry:
        """An interval is complete: it joins the window, the oldest leaves it into the prior when full, and the window is solved."""
        full = carry.filled == self.intervals
        prior, prior_P = self.leave(carry)
        shift = lambda a: jnp.where(full, jnp.concatenate([a[1:], a[-1:]]), a)  # noqa: E731
        window, nodes, force = jax.tree.map(shift, (carry.window, carry.nodes, carry.force))
        filled = jnp.minimum(carry.filled + 1, self.intervals)
        place = jnp.arange(self.intervals) == filled - 1
        window = jax.tree.map(lambda a, b: jnp.where(place.reshape(-1, *[1] * b.ndim), b, a), window, carry.open)
        newest = jnp.arange(self.intervals + 1) == filled
        last = jnp.sum(jnp.where((jnp.arange(self.intervals + 1) == filled - 1)[:, None], nodes, 0.0), axis=0)
        nodes = jnp.where(newest[:, None], self.through(last, carry.open)[0], nodes)
        prior, prior_P = jnp.where(full, prior, carry.prior), jnp.where(full, prior_P, carry.prior_P)
        nodes, force = self.solve(window, filled, nodes, force, prior, prior_P)
        s = jnp.sum(jnp.where(newest[:, None], nodes, 0.0), axis=0)
        zero = jnp.zeros((), jnp.int32)
        return Carry(s, carry.P, carry.open, zero, window, filled, nodes, force, prior, prior_P)

    def solve(self, window: Samples, filled, nodes, force, prior, prior_P):
        """(nodes, force) after the Gauss-Newton steps: the least squares over the `filled` first intervals of the window."""
        one = jnp.eye(self.n)
        arrival = symmetric(definite_solve(prior_P, one))
        live = (jnp.arange(self.intervals) < filled).astype(float)

        def gauss_newton(_, now):
            nodes, force = now
            part = jax.vmap(self.interval)(nodes[:-1], nodes[1:], window)
            D, below, g = self.normal_equations(part, live, nodes, prior, arrival)
            return self.quadratic_program(D, below, g, nodes, force)

        return jax.lax.fori_loop(0, self.iterations, gauss_newton, (nodes, force))

    def normal_equations(self, part: Interval, live, nodes, prior, arrival):
        """Block tridiagonal Hessian, D (M + 1, n, n) and `below` (M, n, n) it, and minus the gradient g (M + 1, n)."""
        one = jnp.eye(self.n)
        QA = part.Q_inverse @ part.A
        EW, CW = (jnp.swapaxes(J, 1, 2) * w[:, None, :] for J, w in ((part.E, part.e_weight), (part.C, part.r_weight)))
        before = live[:, None, None] * (jnp.swapaxes(part.A, 1, 2) @ QA + EW @ part.E)
        after = live[:, None, None] * (part.Q_inverse + CW @ part.C) + (1.0 - live)[:, None, None] * one
        none = jnp.zeros((1, self.n, self.n))
        D = jnp.concatenate([before, none]) + jnp.concatenate([arrival[None], after])
        below = -live[:, None, None] * QA
        defect = jnp.einsum("kij,kj->ki", part.Q_inverse, part.F - nodes[1:])
        g_before = jnp.einsum("kij,kj->ki", EW, part.e) - jnp.einsum("kji,kj->ki", part.A, defect)
        g_after = defect + jnp.einsum("kij,kj->ki", CW, part.r)
        g = jnp.concatenate([live[:, None] * g_before, none[0, :1]]) + jnp.concatenate(
            [(arrival @ (prior - nodes[0]))[None], live[:, None] * g_after]
        )
        return D, below, g

    def quadratic_program(self, D, below, g, nodes, force):
        """The nodes moved to the minimum of the quadratic model in the box, and the force of the bounds there."""
        scale = jnp.diagonal(D, axis1=1, axis2=2)

        def bound(free, fixed):
            held = (1.0 - free)[:, :, None] * scale[:, :, None] * jnp.eye(self.n)
            masked = free[:, :, None] * D * free[:, None, :] + held
            right = free * (g - banded(D, below, fixed)) + scale * fixed
            return masked, free[1:, :, None] * below * free[:-1, None, :], right

        def active_set_pass(_, now):
            move, force = now
            free, fixed = bounded.active(nodes + move + force / scale, self.low, self.high)
            fixed, none = (1.0 - free) * (fixed - nodes), jnp.all(free > 0)
            move = tridiagonal(*jax.lax.cond(none, lambda *_: (D, below, g), bound, free, fixed))
            force = jax.lax.cond(none, jnp.zeros_like, lambda v: (1.0 - free) * (g - banded(D, below, v)), move)
            return move, force

        move, force = jax.lax.fori_loop(0, self.passes, active_set_pass, (jnp.zeros_like(nodes), force))
        return jnp.clip(nodes + move, self.low, self.high), force

    def leave(self, carry: Carry):
        """Arrival cost one node later: an extended Kalman filter step through the oldest interval, linearised at the smoothed nodes."""
        window = jax.tree.map(lambda a: a[0], carry.window)
        part = self.interval(carry.nodes[0], carry.nodes[1], window)
        inner = part.e_weight > 0
        s, P = absorb(
            carry.prior,
            carry.prior_P,
            part.E,
            jnp.where(inner, part.e + part.E @ (carry.nodes[0] - carry.prior), 0.0),
            1.0 / jnp.where(inner, part.e_weight, 1.0),
            inner,
        )
        s = part.F + part.A @ (s - carry.nodes[0])
        P = symmetric(part.A @ P @ part.A.T + self.Q(window.u[-1], window.dt.sum()))
        last = part.r_weight > 0
        e = jnp.where(last, part.r + part.C @ (carry.nodes[1] - s), 0.0)
        return absorb(s, P, part.C, e, 1.0 / jnp.where(last, part.r_weight, 1.0), last)

    # The plant, with s = (x, theta)

    def interval(self, before, after, samples: Samples) -> Interval:
        """An interval, linearised at both of its nodes."""
        (F, inner), (A, E) = linearise.once(lambda s: self.through(s, samples), before)
        u = samples.u[-1]
        y_last, C = linearise.once(lambda s: self.predict(s, u), after)
        weight = samples.valid / jax.vmap(self.system.R)(samples.u)
        e = jnp.where(samples.valid[:-1], samples.y[:-1] - inner, 0.0).reshape(-1)
        r = jnp.where(samples.valid[-1], samples.y[-1] - y_last, 0.0)
        factor = (jnp.linalg.cholesky(self.Q(u, samples.dt.sum())), True)
        Q_inverse = symmetric(jax.scipy.linalg.cho_solve(factor, jnp.eye(self.n)))
        E = E.reshape(len(e), self.n)
        return Interval(F, A, e, E, weight[:-1].reshape(-1), r, C, weight[-1], Q_inverse)

    def through(self, s, samples: Samples):
        """(s at the interval's end, predicted inner measurements (m - 1, n_y)), from its first node."""
        seen = []
        for j in range(self.m):
            s = self.move(s, samples.u[j], samples.dt[j])
            seen += [self.predict(s, samples.u[j])] if j < self.m - 1 else []
        return s, jnp.stack(seen) if seen else jnp.zeros((0, self.system.n_y))

    def move(self, s, u, dt):
        """s after dt: the plant's f, and losses that stay."""
        k = self.system.n_x
        return jnp.concatenate([self.system.f(s[:k], u, s[k:], dt), s[k:]])

    def predict(self, s, u):
        """Measurement at s."""
        return self.system.h(s[: self.system.n_x], u, s[self.system.n_x :])

    def Q(self, u, dt):
        """(n_s, n_s) process noise over dt, invertible."""
        k = self.system.n_x
        rate = self.walk**2 * jnp.maximum(bounded.moving(self.system, u, self.least), REST)
        Q = jnp.diag(jnp.concatenate([jnp.zeros(k), rate * dt]))
        return Q.at[:k, :k].set(self.system.Q(dt) + FLOOR * dt * jnp.diag(jnp.diagonal(jnp.asarray(self.system.P0))))


def absorb(s, P, H, e, R, valid):
    """Mean and covariance after independent measurements of variances R with innovations e; `valid` False: no effect."""
    if not len(e):
        return s, P
    H = H * valid[:, None]
    L = jnp.linalg.cholesky(H @ P @ H.T + jnp.diag(R))
    V = jax.scipy.linalg.solve_triangular(L, H @ P, lower=True)
    return s + V.T @ jax.scipy.linalg.solve_triangular(L, jnp.where(valid, e, 0.0), lower=True), symmetric(P - V.T @ V)


def tridiagonal(D, below, b):
    """x (K, n) of the symmetric block tridiagonal system with D (K, n, n) on and below (K - 1, n, n) below the diagonal: block Cholesky."""
    below = jnp.concatenate([below, jnp.zeros_like(D[:1])])  # block k + 1 below block k; none below the last
    n = b.shape[1]

    def forward(carry, row):
        W, z_in = carry  # W = L_{k-1}^-1 below_k', z_in = W' z_{k-1}
        D_k, below_next, b_k = row
        L = jnp.linalg.cholesky(D_k - W.T @ W, symmetrize_input=False)
        W = jax.scipy.linalg.solve_triangular(L, below_next.T, lower=True)
        z = jax.scipy.linalg.solve_triangular(L, b_k - z_in, lower=True)
        return (W, W.T @ z), (L, W, z)

    _, factors = jax.lax.scan(forward, (jnp.zeros_like(D[0]), jnp.zeros(n)), (D, below, b))

    def backward(x, row):
        L, W, z = row
        x = jax.scipy.linalg.solve_triangular(L, z - W @ x, lower=True, trans=1)
        return x, x

    return jax.lax.scan(backward, jnp.zeros(n), factors, reverse=True)[1]


def banded(D, below, v):
    """The block tridiagonal matrix times v (K, n)."""
    up, down = jnp.einsum("kji,kj->ki", below, v[1:]), jnp.einsum("kij,kj->ki", below, v[:-1])
    none = jnp.zeros_like(v[:1])
    return jnp.einsum("kij,kj->ki", D, v) + jnp.concatenate([up, none]) + jnp.concatenate([none, down])
