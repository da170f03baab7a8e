"""The extended set-membership filter on the augmented state z = (x, theta): what ESMF and AESMF are made of.

Noise is unknown but bounded: w in E(0, Q) each step, each measurement error within sqrt(R_ii). The filter keeps an ellipsoid
E(z, P) that holds the true state as long as these bounds are true:

    predict   z- = F(z) + mid,   P- = Phi P Phi' (+) Q (+) box(remainder)        (+): ellipsoid around the Minkowski sum
    cut       by every valid measurement                                           (`ellipsoid.strip_cut`, `batch_cut`)

The remainder of the linearisation is bounded, so nothing is neglected: by Taylor models over the ellipsoid (`taylor`), or
as the source does, 1/2 d' Hess F_i(xi) d over the box around it (`interval`). When no state of the set explains a measurement
the bounds were broken - a fault that jumped - and the set starts again from the prior of theta. Scholte and Campbell 2003;
Zhou, Han and Liu 2008.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch import checks
from rotorwatch.backend import jax as load_jax
from rotorwatch.core import Array, Estimate
from rotorwatch.errors import ConfigError
from rotorwatch.maths import ellipsoid, interval, taylor

UNBOUNDED = 1e6  # half-width taken for a remainder that interval arithmetic cannot bound: in effect "anything"


RESTART_ROUNDS, RESTART_SLACK = 5, 1.5
SHARES = (0.001, 0.03, 1.0, 30.0)  # tried, as factors on the odds of the share of least trace


class Carry(NamedTuple):
    """z (n,) centre; shape (n, n): P, or its factors U and D in one matrix; q (n,): factors on Q's diagonal; restarts: how
    often the set was empty; health: distance from empty of the last step, 1 at best, 0 or less when it was."""

    z: Array
    shape: Array
    q: Array
    restarts: Array
    health: Array


class Cutting(NamedTuple):
    """What a rule that adapts Q looks at. Phi (n, n); H (n_y, n), rows 0 where not valid; e (n_y,); P (n, n) before the cut;
    R (n_y, n_y); amplify: how much of one unit on Q's diagonal arrives in P."""

    Phi: Array
    H: Array
    e: Array
    P: Array
    R: Array
    amplify: Array


class SetMembership:
    """See the module. Not a method by itself: a method sets `name` and `not_kalman`, and `adapt` if Q learns."""

    system: Any
    dt: float

    def __init__(
        self,
        system,
        dt,
        *,
        bound=3.0,
        process=None,
        measurement=None,
        theta_centre=None,
        theta_reach=1.0,
        theta_drift=1e-3,
        theta_range=None,
        form="scalar",
        cut=None,
        remainder="taylor",
        remainder_box="trace",
        weights=None,
        restart=True,
    ):
        """dt: s. bound: noise bounds and the start's half-widths in standard deviations of the plant's Q, R and P0, or given
        directly: process (n_x,) semi-axes of one step, measurement (n_y,). theta_centre, theta_reach: centre and semi-axes of
        the losses at the start and after a restart; theta_drift: loss per second that a loss may change by; theta_range: (low, high)
        known limits (default 0 and 1 when each theta belongs to an input). form: scalar, batch or ud (factors); cut: how much a
        measurement weighs (`ellipsoid.strip_cut`; default trace, source for batch and ud). remainder: taylor, interval, or none,
        which neglects it and guarantees nothing; remainder_box: `ellipsoid.around_box`. weights (n_x + n_theta,): in traces.
        restart: start again when the set is empty. Raises ConfigError."""
        self.system, self.dt = system, float(checks.positive("dt", dt))
        n_x, n_theta = system.n_x, system.n_theta
        self.n = n_x + n_theta
        checks.positive("bound", bound)
        for label, value, known in (
            ("form", form, ("scalar", "batch", "ud")),
            ("cut", cut or "trace", ("source", "volume", "trace")),
            ("remainder", remainder, ("taylor", "interval", "none")),
            ("remainder_box", remainder_box, ("trace", "volume", "paper")),
        ):
            if value not in known:
                raise ConfigError(f"{label} must be one of {', '.join(known)}, not {value!r}.")
        if cut is None:
            cut = "trace" if form == "scalar" else "source"
        if cut != "source" and form != "scalar":
            raise ConfigError(f"cut {cut!r} is defined for form 'scalar' only: it weighs one measurement at a time.")
        self.form, self.cut, self.remainder, self.remainder_box = form, cut, remainder, remainder_box
        self.bound, self.restart = bound, bool(restart)
        self.process = None if process is None else checks.positive("process", checks.shape("process", process, n_x))
        self.measurement = None
        if measurement is not None:
            self.measurement = checks.positive("measurement", checks.shape("measurement", measurement, system.n_y))
        self.drift = checks.shape(
            "theta_drift", np.broadcast_to(checks.finite("theta_drift", theta_drift), (n_theta,)), n_theta
        )
        checks.between("theta_drift", self.drift, 0.0, np.inf)
        centre = np.zeros(n_theta) if theta_centre is None else checks.shape("theta_centre", theta_centre, n_theta)
        self.theta_centre = checks.finite("theta_centre", np.asarray(centre, float))
        reach = np.broadcast_to(checks.positive("theta_reach", theta_reach), (n_theta,))
        if theta_range is None:
            theta_range = (0.0, 1.0) if n_theta == system.n_u else (-np.inf, np.inf)
        low, high = theta_range
        self.low = np.concatenate([np.full(n_x, -np.inf), np.broadcast_to(low, (n_theta,))])
        self.high = np.concatenate([np.full(n_x, np.inf), np.broadcast_to(high, (n_theta,))])
        if (self.low > self.high).any():
            raise ConfigError("theta_range must be (low, high) with low not above high.")
        if weights is not None:
            checks.positive("weights", checks.shape("weights", weights, self.n))
        self.weights = np.repeat([1e-3, 1.0], [n_x, n_theta]) if weights is None else weights
        if cut != "trace" and weights is None:
            self.weights = np.ones(self.n)
        checks.covariance("P0", system.P0, n_x)
        self.theta_prior = np.diag(reach**2)
        self.prior = _blocks(np.asarray(bound**2 * np.asarray(system.P0)), self.theta_prior)
        load_jax()
        if form == "ud":
            self.prior = ellipsoid.factored(self.prior)

    def init(self) -> Carry:
        """The set before the first measurement: the plant's x0 and P0, and the prior of theta."""
        z = np.concatenate([np.asarray(self.system.x0, float), self.theta_centre])
        return Carry(z, self.prior, np.ones(self.n), np.zeros((), np.int32), np.ones(()))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """One step. Estimate.x_cov and theta_cov are blocks of the ellipsoid's shape P: the bound of a component is its
        estimate plus and minus the square root of its diagonal element. innovation_cov: shape of an ellipsoid around all
        innovations the bounds allow."""
        from jax import lax
        from jax import numpy as jnp

        n_x, system, step = self.n_x, self.system, self.dt if dt is None else dt
        z, moved, noise, Phi, b_Q, b = self._predict(carry, u, step)
        shape, amplify = self._sum(moved, noise, b), ellipsoid.parts(b_Q)[0] * ellipsoid.parts(b)[1]
        valid = jnp.asarray(valid, bool)

        def h(point):
            return system.h(point[:n_x], u, point[n_x:])

        def compare(point, shape):
            y_hat, H, half = self._measured(h, point, self.unfactored(shape))
            e = jnp.where(valid, jnp.where(valid, y, 0.0) - y_hat, 0.0)
            return H, e, (self._error_bound(u) + half) ** 2

        H, e, limit = compare(z, shape)
        if self.cut == "trace":
            cut = self._best(z, moved, noise, b, H, e, limit, valid)
        else:
            cut = self._cut(z, shape, H, e, limit, valid)
        empty = ~(cut.health > 0)
        cut = self._within_range(cut, valid)
        if self.restart:
            z_new, shape_new = lax.cond(empty, lambda: self._again(carry, u, y, valid, step), lambda: (cut.a, cut.P))
        else:
            z_new, shape_new = jnp.where(empty, z, cut.a), jnp.where(empty, shape, cut.P)
        # In a long gap a set may outgrow every number: it is held as it was, and starts again once something is measured.
        known = jnp.isfinite(z_new).all() & jnp.isfinite(shape_new).all() & (jnp.abs(shape_new).max() < UNBOUNDED**2)
        first = self.init()
        z_held, shape_held = (jnp.where(valid.any(), a, b) for a, b in ((first.z, carry.z), (first.shape, carry.shape)))
        z_new, shape_new = jnp.where(known, z_new, z_held), jnp.where(known, shape_new, shape_held)
        empty = empty | (~known & valid.any())
        P_prior = self.unfactored(shape)
        S = ellipsoid.symmetric(H @ P_prior @ H.T)
        S = jnp.where(jnp.isfinite(S).all(), S, jnp.eye(len(e)) * UNBOUNDED**2)
        R = jnp.diag(limit)
        q = self.adapt(
            carry.q, Cutting(Phi, jnp.where(valid[:, None], H, 0.0), e, P_prior, R, amplify), cut.health, step
        )
        P = ellipsoid.symmetric(self.unfactored(shape_new))
        status = jnp.where(valid.any(), 0, 2).astype(jnp.int32)
        new = Carry(z_new, shape_new, q, carry.restarts + empty.astype(jnp.int32), cut.health)
        return new, Estimate(
            z_new[:n_x],
            P[:n_x, :n_x],
            z_new[n_x:],
            P[n_x:, n_x:],
            e,
            ellipsoid.symmetric(ellipsoid.minkowski(S, R)[0]),
            status,
        )

    def _again(self, carry, u, y, valid, dt):
        """(z, shape) after a measurement that no state of the set explains: a fault jumped.

        The last x, twice as wide, and the prior of theta are predicted and cut again. That prior is too wide for one
        linearisation, so it is repeated about its own result (as the iterated extended Kalman filter does); what is left of the
        remainder is not bounded in this one step, but given for by RESTART_SLACK times wider strips.
        """
        from jax import lax
        from jax import numpy as jnp

        n_x, n, system = self.n_x, self.n, self.system
        x, P_x = carry.z[:n_x], self.unfactored(carry.shape)[:n_x, :n_x]
        start = jnp.concatenate([x, jnp.asarray(self.theta_centre)])
        Q, limit = self.Q0(dt), self._error_bound(u)
        P = _blocks(4.0 * P_x, jnp.asarray(self.theta_prior), jnp)

        def about(state, _):
            theta = state[0][n_x:]
            point = jnp.concatenate([x, theta])
            x_next, F = _linear(lambda s: system.f(s[:n_x], u, s[n_x:], dt), point)
            Phi = jnp.concatenate([F, jnp.eye(n)[n_x:]])
            z = jnp.concatenate([x_next, theta]) + Phi @ (start - point)
            moved = ellipsoid.symmetric(Phi @ P @ Phi.T)
            middle = jnp.concatenate([x_next, theta])
            y_hat, H = _linear(lambda s: system.h(s[:n_x], u, s[n_x:]), middle)
            e = jnp.where(valid, jnp.where(valid, y, 0.0) - y_hat - H @ (z - middle), 0.0)
            noise = jnp.sqrt(
                (H * (Q @ H.T).T).sum(1)
            )  # counted with the measurement's: the sum of sets would blur theta
            cut = self._rows(ellipsoid.strip_cut, z, moved, H, e, (RESTART_SLACK * (limit + noise)) ** 2, valid)
            fine = (cut.health > 0) & jnp.isfinite(cut.a).all()
            a, shape = jnp.where(fine, cut.a, z), jnp.where(fine, cut.P, moved)
            return (a, ellipsoid.minkowski(shape, Q, self.weights)[0]), None

        z, P = lax.scan(about, (start, P), None, length=RESTART_ROUNDS)[0]
        return z, ellipsoid.factored(P) if self.form == "ud" else P

    def adapt(self, q, cutting: Cutting, health, dt):
        """New factors on Q's diagonal: the same. Methods that learn Q say more."""
        return q

    @property
    def n_x(self) -> int:
        return self.system.n_x

    def unfactored(self, shape):
        """P (n, n) of the carried shape."""
        return ellipsoid.unfactored(shape) if self.form == "ud" else shape

    def Q0(self, dt):
        """(n, n) shape that bounds one step's noise before it is adapted. theta moves by theta_drift dt at most."""
        from jax import numpy as jnp

        Q = self.bound**2 * self.system.Q(dt) if self.process is None else jnp.diag(jnp.asarray(self.process) ** 2)
        return _blocks(Q, jnp.diag((self.drift * dt) ** 2), jnp)

    def _error_bound(self, u):
        from jax import numpy as jnp

        if self.measurement is not None:
            return jnp.asarray(self.measurement)
        return self.bound * jnp.sqrt(self.system.R(u))

    def _predict(self, carry, u, dt):
        """z-; the shape that Phi makes of P (form ud: a root of it) and that of the noise, their shares bQ and b; Phi."""
        from jax import numpy as jnp

        n_x, system = self.n_x, self.system

        def f(point):
            return system.f(point[:n_x], u, point[n_x:], dt)

        if self.form == "ud":
            U, D = ellipsoid.factors(carry.shape)
            L = U * jnp.sqrt(jnp.maximum(D, 0.0))
        else:
            P = carry.shape
            L = jnp.linalg.cholesky(P + jnp.diag(1e-13 * P.diagonal() + 1e-300))
        x, G, half = self._moved(f, carry.z, L)
        z = jnp.concatenate([x, carry.z[n_x:]])
        root = jnp.sqrt(carry.q)
        Q = self.Q0(dt) * root * root[:, None]
        pad = jnp.zeros(system.n_theta)
        rest = jnp.diag(jnp.concatenate([ellipsoid.around_box(half, self.remainder_box), pad]))
        noise, b_Q = ellipsoid.minkowski(Q, rest, self.weights)
        G = jnp.concatenate([G, L[n_x:]])
        moved = ellipsoid.symmetric(G @ G.T)
        b = ellipsoid.minkowski(moved, noise, self.weights)[1]
        Phi = jnp.concatenate([_linear(f, carry.z)[1], jnp.eye(self.n)[n_x:]])
        return z, G if self.form == "ud" else moved, noise, Phi, b_Q, b

    def _sum(self, moved, noise, b):
        """The predicted shape: the Minkowski sum with share b."""
        from jax import numpy as jnp

        left, right = ellipsoid.parts(b)
        if self.form != "ud":
            return left * moved + right * noise
        rows = jnp.concatenate([moved, jnp.linalg.cholesky(noise + 1e-30 * jnp.eye(self.n))], axis=1)
        return ellipsoid.ud_sum(rows, jnp.repeat(jnp.stack([left, right]), self.n))

    def _best(self, z, moved, noise, b, H, e, limit, valid):
        """The smallest of the cuts after sums with several shares: each holds all that is possible, so any may be taken.

        A small share leaves theta as it was and trusts the measurement of x, which is right when nothing was learned; a large
        one keeps the prediction of x sharp, which is right while excitation tells the losses apart.
        """
        import jax
        from jax import numpy as jnp

        odds = b / jnp.maximum(1.0 - b, 1e-12) * jnp.asarray(SHARES)
        cuts = jax.vmap(lambda share: self._cut(z, self._sum(moved, noise, share), H, e, limit, valid))(
            odds / (1 + odds)
        )
        size = (jnp.diagonal(cuts.P, axis1=1, axis2=2) * self.weights).sum(1)
        pick = (jnp.arange(len(SHARES)) == jnp.argmin(size)).astype(float)
        return ellipsoid.Cut(pick @ cuts.a, jnp.tensordot(pick, cuts.P, 1), cuts.health.min())

    def _moved(self, f, z, L):
        """(x-, G, half): f(z + L xi) lies within half of x- + G xi for all xi in the unit ball."""
        from jax import numpy as jnp

        if self.remainder == "taylor":
            x, G, half = taylor.expand(f, z, L.T, None, self.low, self.high)
            return x, G, _capped(half)
        x, F = _linear(f, z)
        if self.remainder == "none":
            return x, F @ L, jnp.zeros_like(x)
        mid, half = self._box_remainder(f, z, jnp.sqrt((L**2).sum(1)))
        return x + mid, F @ L, half

    def _measured(self, h, z, P):
        """(y-, H, half): h(z + d) lies within half of y- + H d for all d in E(0, P)."""
        from jax import numpy as jnp

        if self.remainder == "taylor":
            y, H, half = taylor.expand(h, z, jnp.eye(self.n), P, self.low, self.high)
            return y, H, _capped(half)
        y, H = _linear(h, z)
        if self.remainder == "none":
            return y, H, jnp.zeros_like(y)
        mid, half = self._box_remainder(h, z, jnp.sqrt(jnp.maximum(P.diagonal(), 0.0)))
        return y + mid, H, half

    def _box_remainder(self, function, z, reach):
        """(mid, half) of the linearisation's remainder over the box around the ellipsoid, as the source bounds it."""
        from jax import numpy as jnp

        low, high = jnp.maximum(z - reach, self.low), jnp.minimum(z + reach, self.high)
        found = interval.second_order_remainder(function, z, low, high)
        half = _capped(0.5 * (found.hi - found.lo))
        return jnp.where(half < UNBOUNDED, 0.5 * (found.lo + found.hi), 0.0), half

    def _cut(self, z, shape, H, e, limit, valid):
        """The predicted set cut by all valid measurements."""
        from jax import numpy as jnp

        if self.form == "batch":
            cut, _, _ = ellipsoid.batch_cut(z, shape, jnp.where(valid[:, None], H, 0.0), e, jnp.diag(limit))
            some = valid.any() & (cut.health > 0)
            return ellipsoid.Cut(
                jnp.where(some, cut.a, z), jnp.where(some, cut.P, shape), jnp.where(valid.any(), cut.health, 1.0)
            )

        if self.form == "ud":
            return self._rows(ellipsoid.ud_strip_cut, z, shape, H, e, limit, valid)

        def by(a, P, h, e, r):
            return ellipsoid.strip_cut(a, P, h, e, r, self.cut, self.weights)

        return self._rows(by, z, shape, H, e, limit, valid)

    def _within_range(self, cut: ellipsoid.Cut, valid) -> ellipsoid.Cut:
        """The set cut by what is known about theta, as by measurements of it; but a gap teaches nothing."""
        from jax import lax
        from jax import numpy as jnp

        bounded = np.flatnonzero(np.isfinite(self.high) & np.isfinite(self.low))
        if not bounded.size:
            return cut
        rows, middle = np.eye(self.n)[bounded], 0.5 * (self.low[bounded] + self.high[bounded])
        limit = (0.5 * (self.high[bounded] - self.low[bounded])) ** 2

        def one(a, P, h, e, r):
            return ellipsoid.strip_cut(a, P, h, e, r, "trace", self.weights)

        by = ellipsoid.ud_strip_cut if self.form == "ud" else one
        e = middle - cut.a[bounded]
        # No strip that the set does not leave makes it smaller: usually there is nothing to do.
        leaves = (self.unfactored(cut.P).diagonal()[bounded] + e**2 > limit).any()
        always = np.ones(bounded.size, bool)

        def narrowed():
            inside = self._rows(by, cut.a, cut.P, jnp.asarray(rows), e, jnp.asarray(limit), always)
            return ellipsoid.Cut(inside.a, inside.P, jnp.minimum(cut.health, inside.health))

        return lax.cond(valid.any() & leaves, narrowed, lambda: cut)

    def _rows(self, cut, z, shape, H, e, limit, valid):
        """One valid measurement after the other; e: measured minus predicted at z."""
        from jax import lax
        from jax import numpy as jnp

        def row(state, given):
            a, P, health = state
            h, left, r, valid = given
            new = cut(a, P, h, left - h @ (a - z), r)
            health = jnp.where(valid, jnp.minimum(health, new.health), health)
            return (jnp.where(valid, new.a, a), jnp.where(valid, new.P, P), health), None

        return ellipsoid.Cut(*lax.scan(row, (z, shape, jnp.ones(())), (H, e, limit, valid))[0])


def _capped(half):
    from jax import numpy as jnp

    return jnp.where(half < UNBOUNDED, half, UNBOUNDED)


def _linear(function, z):
    """(function(z), its Jacobian there)."""
    from jax import jacfwd

    return function(z), jacfwd(function)(z)


def _blocks(A, B, numpy=np):
    """Block-diagonal matrix of two."""
    corner = numpy.zeros((A.shape[0], B.shape[0]))
    return numpy.block([[A, corner], [corner.T, B]])
