"""Super-twisting observer: a second-order sliding mode holds the model on the measured state; what holds it there are the losses.

    x- = f(x, u, 0) + dt v,    e = x_m - x-                                           x_m: the state as measured, v: the injection
    e = q + dt k1 |q|^1/2 sgn q + dt^2 k2 s,   s in sgn q:    x = x_m - q,   v = v + dt k2 s
    v -> G(u) theta: the equivalent injection;    theta = (G' W G + I / theta_var)^-1 G' W v

for each state that losses drive, k1 = 1.5 sqrt(B), k2 = 1.1 B where |dv/dt| < B. The equation is implicit in q, the error that
remains, and solved exactly: |e| <= dt^2 k2 gives q = 0 and s = e / (dt^2 k2), which is the sliding phase without chatter; else
|q|^1/2 = (-dt k1 + sqrt(dt^2 k1^2 + 4 (|e| - dt^2 k2))) / 2. Without noise q becomes 0 in finite time. Other measured states are
corrected at a plain rate, and outputs that only theta moves (the accelerometer) are filtered at the same rate, beside their D.
Source: Levant, Robust exact differentiation via sliding mode technique, Automatica 34 (1998) 379-384 (gains); Moreno and Osorio, A
Lyapunov approach to second-order sliding mode controllers and observers, IEEE CDC 2008, 2856-2861 (convergence); Brogliato, Polyakov
and Efimov, The implicit discretization of the supertwisting sliding-mode control algorithm, IEEE Trans. Automatic Control 65 (2020)
3707-3713.
"""

from __future__ import annotations

from collections import namedtuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Estimate
from rotorwatch_lab.maths import bounded, linearise, measured_regression
from rotorwatch_lab.maths.small import symmetric

ACTS = 1e-9  # of the largest effect: what is smaller is none
TINY = 1e-12


class Carry(namedtuple("Carry", "x v P w var G")):
    """x, v (n_x,): state and injection; P (2 n_x, 2 n_x): covariance of their errors. w (n_y,), var (n_y,): what the direct outputs
    lack, filtered, and its variance. G (n_x + n_y, n_theta): what losses do to v and w, as last measured."""


class SlidingMode:
    """Super-twisting observer with equivalent injection on any plant whose states are all measured."""

    name = "sliding_mode"
    not_kalman = "its gains are those of a sliding mode: a bound of how fast a loss may grow, not a noise, decides"

    def __init__(self, system, dt: float, *, loss_rate=0.5, rate=5.0, theta_var=0.1, walk=0.05, u_nominal=None):
        """dt: s. loss_rate: how fast a loss may grow [1/s], which bounds dv/dt. rate: of the plain corrections and filters [1/s].
        theta_var: variance of losses at first, a number or one per theta. walk: of a loss in a second, for the covariance only.
        u_nominal (n_u,): input of the design (default: hover). Raises ConfigError for wrong values and unmeasured states."""
        self.system, self.dt = system, measured_regression.check("The sliding-mode observer", system, dt)
        checks.positive("loss_rate", loss_rate)
        self.rate, self.walk = checks.positive("rate", rate), checks.positive("walk", walk)
        self.theta_var = checks.positive("theta_var", linearise.variances("theta_var", theta_var, system.n_theta))
        self._look(bounded.nominal_input(system, u_nominal))
        bound = loss_rate * self.g
        self.k1, self.k2 = 1.5 * bound**0.5, 1.1 * bound

    def init(self) -> Carry:
        """The plant's start, no loss."""
        n, n_y, k = self.system.n_x, self.system.n_y, self.system.n_theta
        P = jnp.zeros((2 * n, 2 * n)).at[:n, :n].set(jnp.asarray(self.system.P0, float))
        P = P.at[n:, n:].set(jnp.diag((self.G0**2 * self.theta_var).sum(axis=1)))
        G, D = jnp.asarray(self.G0, float), jnp.asarray(self.D0, float)
        return Carry(
            x=jnp.asarray(self.system.x0, float),
            v=jnp.zeros(n),
            P=P,
            w=jnp.zeros(n_y),
            var=(self.D0**2 * self.theta_var).sum(axis=1) + jnp.zeros(n_y),
            G=jnp.concatenate([G, D]) + jnp.zeros((n + n_y, k)),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then correct with y (n_y,) where valid."""
        system, n, none = self.system, self.system.n_x, jnp.zeros(self.system.n_theta)
        dt = self.dt if dt is None else dt
        x, F, Phi = linearise.transition(system, carry.x, u, none, dt)
        x = x + dt * self.driven * carry.v
        y_, C, D = linearise.measurement(system, x, u, none)
        D = D * self.direct[:, None]
        R, left = system.R(u), measured_regression.left_inverse(C)
        A = jnp.block([[F, dt * jnp.diag(self.driven)], [jnp.zeros((n, n)), jnp.eye(n)]])
        P = A @ carry.P @ A.T
        P = P.at[:n, :n].add(system.Q(dt)).at[n:, n:].add(jnp.diag(self.walk**2 * dt * self.g**2))
        S = C @ P[:n, :n] @ C.T + jnp.diag(R)

        # Only states all of whose measurements are there.
        needed = jnp.abs(left) > ACTS * jnp.abs(left).max()
        measured = (valid | ~needed).all(axis=1) & needed.any(axis=1)
        left = jnp.where(measured[:, None] & needed, left, 0.0)
        e = left @ jnp.where(valid, y - y_, 0.0)
        remains, ds = self._twisted(e, dt)
        x, v = x + e - remains, carry.v + ds

        # For the covariance: the same law, linear in e, with the gains that it has at one standard deviation of e.
        sd = jnp.sqrt(jnp.maximum(jnp.diagonal(left @ S @ left.T), TINY))
        remains, ds = self._twisted(sd, dt)
        K = jnp.concatenate([(1.0 - remains / sd)[:, None] * left, (ds / sd)[:, None] * left])
        P = linearise.joseph(P, K, jnp.concatenate([C, jnp.zeros_like(C)], axis=1), R)

        gain = jnp.where(valid & (self.direct > 0), -jnp.expm1(-self.rate * dt), 0.0)
        w = carry.w + gain * jnp.where(valid, y - y_ - carry.w, 0.0)
        var = (1.0 - gain) ** 2 * (carry.var + self.walk**2 * dt * (self.D0**2).sum(axis=1)) + gain**2 * R
        G = jnp.where(measured[:, None], Phi / dt * self.driven[:, None], carry.G[:n])
        G = jnp.concatenate([G, carry.G[n:] + gain[:, None] * (D - carry.G[n:])])

        noise = jnp.concatenate([jnp.diagonal(P)[n:], var])
        used = jnp.concatenate([self.driven, self.direct])
        weighted = G * (used / jnp.where(used > 0, noise, 1.0))[:, None]
        information = weighted.T @ G + jnp.diag(1.0 / self.theta_var)
        theta, theta_cov = linearise.posterior(information, weighted.T @ jnp.concatenate([v, w]))

        innovation = jnp.where(valid, y - y_ - self.direct * carry.w, 0.0)
        S = S + jnp.diag(self.direct * carry.var)
        estimate = Estimate(x, P[:n, :n], theta, theta_cov, innovation, symmetric(S), linearise.status(valid))
        return Carry(x, v, P, w, var, G), estimate

    def _twisted(self, e, dt):
        """Errors (n_x,) that remain after a step from e (n_x,), and the increment of v: implicit super-twisting law, or plain rates."""
        hold = dt * dt * self.k2
        inside = jnp.where(hold > 0, e / jnp.where(hold > 0, hold, 1.0), 0.0)
        root = 0.5 * (jnp.sqrt((dt * self.k1) ** 2 + 4.0 * jnp.maximum(jnp.abs(e) - hold, 0.0)) - dt * self.k1)
        plain = jnp.exp(-self.rate * dt) * e
        twisted = jnp.where(self.driven > 0, jnp.sign(e) * root * root, plain)
        return twisted, dt * self.k2 * jnp.clip(inside, -1.0, 1.0)

    def _look(self, u) -> None:
        """G0 (n_x, n_theta), D0 (n_y, n_theta): what losses do at x0 and u; g (n_x,): at most; driven (n_x,), direct (n_y,): where."""
        system = self.system
        x0, u, none = jnp.asarray(system.x0, float), jnp.asarray(u, float), jnp.zeros(system.n_theta)

        G = jax.jacfwd(lambda theta: linearise.rate(system, x0, u, theta))(none)
        C, D = linearise.measurement(system, x0, u, none)[1:]
        size = jnp.abs(G).max(axis=1)
        self.driven = jnp.where(size > ACTS * size.max(), 1.0, 0.0)
        self.direct = jnp.where((C * C).sum(axis=1) < TINY, 1.0, 0.0)
        self.g, self.G0, self.D0 = size * self.driven, G * self.driven[:, None], D * self.direct[:, None]
