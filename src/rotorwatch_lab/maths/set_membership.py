"""Extended set-membership filter on the augmented state z = (x, theta): base of ESMF and AESMF.

Noise is unknown but bounded: w in E(0, Q) and v in E(0, R) at each step. The filter keeps an ellipsoid E(z, P) that holds the
true state as long as these bounds are true:

    predict   z- = F(z) + mid,   P- = Phi P Phi' (+) Q (+) box(remainder)        (+): ellipsoid around the Minkowski sum
    cut       by the valid measurements             (`ellipsoid.joint_cut`, or row by row `strip_cut`, or `batch_cut`)

The remainder of the linearisation is bounded, so nothing is neglected: by Taylor models over an ellipsoid (`taylor`), or
as the source does, 1/2 d' Hess F_i(xi) d over the box around it (`interval`). The sums of sets that lose least about theta
leave x wide for many steps, and a wide set has a large remainder. So form joint keeps a second set that the last two
measurements alone keep small; the truth is in both, and the remainder need only be bounded over the small one.

When no state of the set explains a measurement the bounds were broken - a fault that jumped - and the set starts again from
the prior of theta. Scholte and Campbell 2003; Zhou, Han and Liu 2008.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp, lax
from rotorwatch.core import Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import ellipsoid, interval, linearise, plant, taylor
from rotorwatch_lab.maths.small import blocks, product, symmetric

UNBOUNDED = 1e6  # half-width taken for a remainder that interval arithmetic cannot bound: in effect "anything"
OUTGROWN = 1e3  # half-width beyond which a set that nothing cut holds no information, and costs digits
RESTART_ROUNDS = 8
RESTART_WEIGHTS = (0.03, 0.3, 2.0)  # of the measurement; the last makes the set that the remainder is bounded over
ALLOWED, MARGIN = 0.5, 1.2  # a remainder's allowance: in noise bounds at most, and in remainders of the round before
PRODUCT_SCALE = 3.0, 1.5  # E(0, P) x E(0, T) lies within the ellipsoid of 3 P and 3/2 T
SHARP = 1.0  # weight of each of the two measurements that keep the small set small
# In every step: factor on the odds of the sum's share of least trace, and weight of the measurement. The last is for x.
TRIED = (1.0, 0.003), (10.0, 0.003), (10.0, SHARP)


class Carry(namedtuple("Carry", "z shape q restarts health near near_shape")):
    """z (n,) centre; shape (n, n): P, or its factors U and D in one matrix; q (n,): factors on Q's diagonal; restarts: how
    often the set was empty; health: distance from empty of the last step, 1 at best, 0 or less when it was. near (n,),
    near_shape (n, n): a set of x and a set of theta, both small, that hold the truth too: where remainders are bounded."""


class Cutting(namedtuple("Cutting", "Phi H e P R amplify")):
    """Inputs of a rule that adapts Q. Phi (n, n); H (n_y, n), rows 0 where not valid; e (n_y,); P (n, n) before the cut; R (n_y, n_y);
    amplify: gain from one unit on Q's diagonal to P."""


class Ahead(namedtuple("Ahead", "z G moved noise half b Phi amplify")):
    """A predicted set before its sum: centre z; moved = G G', what the step makes of the last set; noise (+) remainder; half
    (n_x,): the remainder's; b: the sum's share of least trace. Phi, amplify: as in `Cutting`."""


@dataclass(eq=False, repr=False)
class SetMembership:
    """Base class; see the module. A method sets `name` and `not_kalman`, and overrides `adapt` if Q learns.

    dt: s. bound: noise bounds and the start's half-widths in standard deviations of the plant's Q, R and P0, wider where
    several numbers share one bound, so that all are left as rarely; or given
    directly: process (n_x,) semi-axes of one step, measurement (n_y,). theta_centre, theta_reach: centre and semi-axes of
    the losses at the start and after a restart; theta_drift: semi-axes, loss per second that a loss may change by; theta_range: (low, high)
    known limits (default 0 and 1 when each theta belongs to an input). form: joint, where one ellipsoid bounds all
    errors; batch, the source's way of that; scalar, where each error is bounded alone; or ud, the same on factors. cut: how
    much a measurement weighs (`ellipsoid.strip_cut`; default trace, source for batch and ud). remainder: taylor, interval, or none,
    which neglects it and guarantees nothing; remainder_box: `ellipsoid.around_box`. weights (n_x + n_theta,): in traces.
    restart: start again when the set is empty. Raises ConfigError.
    """

    system: Any
    dt: float
    _: KW_ONLY
    bound: float = 3.0
    process: Any = None
    measurement: Any = None
    theta_centre: Any = None
    theta_reach: Any = 1.0
    theta_drift: Any = 1e-3
    theta_range: Any = None
    form: str = "joint"
    cut: Any = None
    remainder: str = "taylor"
    remainder_box: str = "trace"
    weights: Any = None
    restart: bool = True

    def __post_init__(self):
        system, form, bound = self.system, self.form, self.bound
        plant.checked(type(self).__name__, system, self.dt)
        self.dt = float(self.dt)
        n_x, n_theta = system.n_x, system.n_theta
        self.n = n_x + n_theta
        checks.positive("bound", bound)
        for label, known in (
            ("form", ("joint", "scalar", "batch", "ud")),
            ("cut", (None, "source", "volume", "trace")),
            ("remainder", ("taylor", "interval", "none")),
            ("remainder_box", ("trace", "volume", "paper")),
        ):
            checks.one_of(label, getattr(self, label), known)
        if self.cut is None:
            self.cut = "trace" if form in ("joint", "scalar") else "source"
        if (form == "joint" and self.cut != "trace") or (form in ("batch", "ud") and self.cut != "source"):
            raise ConfigError(f"cut {self.cut!r} is not defined for form {form!r}.")
        for label, m in (("process", n_x), ("measurement", system.n_y), ("weights", self.n)):
            if getattr(self, label) is not None:
                setattr(self, label, checks.positive(label, checks.shape(label, getattr(self, label), m)))
        drift = checks.finite("theta_drift", self.theta_drift) * np.ones(n_theta)
        self.theta_drift = checks.between("theta_drift", drift, 0.0, np.inf)
        centre = np.zeros(n_theta) if self.theta_centre is None else self.theta_centre
        centre = checks.shape("theta_centre", centre, n_theta)
        self.theta_centre = checks.finite("theta_centre", np.asarray(centre, float))
        reach = np.broadcast_to(checks.positive("theta_reach", self.theta_reach), (n_theta,))
        if self.theta_range is None:
            self.theta_range = (0.0, 1.0) if n_theta == system.n_u else (-np.inf, np.inf)
        low, high = self.theta_range
        self.low = np.concatenate([np.full(n_x, -np.inf), np.broadcast_to(low, (n_theta,))])
        self.high = np.concatenate([np.full(n_x, np.inf), np.broadcast_to(high, (n_theta,))])
        if (self.low > self.high).any():
            raise ConfigError("theta_range must be (low, high) with low not above high.")
        if self.weights is None:
            self.weights = np.repeat([1e-3, 1.0], [n_x, n_theta]) if self.cut == "trace" else np.ones(self.n)
        self.theta_prior = np.diag(reach**2)
        self.prior = self.near_prior = blocks(np.asarray(bound**2 * np.asarray(system.P0)), self.theta_prior)
        self.product_scale = blocks(np.full((n_x, n_x), PRODUCT_SCALE[0]), np.full((n_theta, n_theta), PRODUCT_SCALE[1]))
        if form == "ud":
            self.prior = ellipsoid.factored(self.prior)

    def init(self) -> Carry:
        """The set before the first measurement: the plant's x0 and P0, and the prior of theta."""
        z = np.concatenate([np.asarray(self.system.x0, float), self.theta_centre])
        none = np.zeros((), np.int32)
        return Carry(z, self.prior, np.ones(self.n), none, np.ones(()), z, self.near_prior)

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u, then cut by y where valid. Estimate.x_cov and theta_cov are blocks of the ellipsoid's shape P: the
        bound of a component is its estimate plus and minus the square root of its diagonal element. innovation_cov: shape of an ellipsoid
        around all innovations the bounds allow."""
        n_x, step = self.n_x, self.dt if dt is None else dt
        valid = jnp.asarray(valid, bool)
        ahead = self._predict(carry, u, step)
        z, shape, (H, e, limit) = ahead.z, self._sum(ahead), self._compare(ahead, u, y, valid, self.form)
        if self.form == "joint":
            cut, x = self._least(ahead, H, e, limit, valid)
            small = self._small(carry, ahead, H, e, limit, valid, step)
            cut = cut._replace(health=jnp.minimum(cut.health, small.health))
            near = jnp.concatenate([x.a[:n_x], small.a]), blocks(x.P[:n_x, :n_x], small.P, jnp)
        else:
            cut = self._cut(z, shape, H, e, limit, valid)
            near = cut.a, self.unfactored(cut.P)
        empty = ~(cut.health > 0)
        cut = self._within_range(cut, valid)
        if self.restart:
            sets = lax.cond(empty, lambda: self._again(carry, u, y, valid, step), lambda: (cut.a, cut.P, *near))
        else:
            sets = jnp.where(empty, z, cut.a), jnp.where(empty, shape, cut.P), *near
        # In a long gap a set may outgrow all sense: it is held as it was, and starts again once something is measured.
        known = jnp.stack([jnp.isfinite(part).all() for part in sets]).all() & (jnp.abs(sets[1]).max() < OUTGROWN**2)
        held, first = ((c.z, c.shape, c.near, c.near_shape) for c in (carry, self.init()))
        held = [jnp.where(valid.any(), a, b) for a, b in zip(first, held, strict=True)]
        z_new, shape_new, *near = [jnp.where(known, a, b) for a, b in zip(sets, held, strict=True)]
        empty = empty | (~known & valid.any())
        P_prior = self.unfactored(shape)
        S = symmetric(product(product(H, P_prior), H.T))
        S = jnp.where(jnp.isfinite(S).all(), S, jnp.eye(len(e)) * UNBOUNDED**2)
        R = jnp.diag(limit)
        q = self.adapt(carry.q, Cutting(ahead.Phi, jnp.where(valid[:, None], H, 0.0), e, P_prior, R, ahead.amplify), cut.health, step)
        P = symmetric(self.unfactored(shape_new))
        status = jnp.where(valid.any(), 0, 2).astype(jnp.int32)
        new = Carry(z_new, shape_new, q, carry.restarts + empty.astype(jnp.int32), cut.health, *near)
        return new, Estimate(z_new[:n_x], P[:n_x, :n_x], z_new[n_x:], P[n_x:, n_x:], e, symmetric(ellipsoid.minkowski(S, R)[0]), status)

    def _again(self, carry, u, y, valid, dt):
        """(z, shape, near, near_shape) after a measurement that no state of the set explains: a fault jumped.

        S, the last set of x with the prior of theta, is too wide for one linearisation. So what of S explains the measurement
        is sought by Gauss and Newton's method: in each round S is cut by the measurement linearised at the last result, errors
        being widened by an allowance for the remainder, and the remainder over what is left is bounded. When that is less than
        the allowance, no point on the edge of the cut explains the measurement: all that explains it is inside, if it hangs
        together. That is then predicted, and cut as ever; S is, if no round came so far.
        """
        n_x, n, system = self.n_x, self.n, self.system
        start = jnp.concatenate([carry.near[:n_x], jnp.asarray(self.theta_centre)])
        S = self.product_scale * blocks(carry.near_shape[:n_x, :n_x], jnp.asarray(self.theta_prior), jnp)
        Q, bound = self.noise(dt, jnp.ones(self.n)), self._error_bound(u, "joint")
        weights = jnp.asarray(RESTART_WEIGHTS)

        def both(point):
            x = system.f(point[:n_x], u, point[n_x:], dt)
            return jnp.concatenate([x, system.h(x, u, point[n_x:])])

        def about(state, first):
            """A Gauss-Newton round; the first round bounds the remainder over all of S."""
            point, allowed, best = state
            value, J = linearise.once(both, point)
            H = J[n_x:]
            C = linearise.once(lambda x: system.h(x, u, point[n_x:]), value[:n_x])[1]
            through = C @ Q[:n_x, :n_x] @ C.T
            noise = bound + jnp.sqrt(through.diagonal())
            allowed = jnp.minimum(allowed, ALLOWED * noise)
            errors = ellipsoid.minkowski(jnp.diag(bound**2), through, 1.0 / noise**2)[0]
            box = jnp.diag(ellipsoid.around_box(allowed / noise) * noise**2)
            errors = ellipsoid.minkowski(errors, box, 1.0 / noise**2)[0]
            e = jnp.where(valid, jnp.where(valid, y, 0.0) - value[n_x:] - H @ (start - point), 0.0)
            H = jnp.where(valid[:, None], H, 0.0)
            SH = S @ H.T

            def cut(weight):
                return ellipsoid.joint_cut(start, S, H, e, errors, weight, *ellipsoid.joint_gains(SH, H @ SH, e, errors, weight))

            cuts = jax.vmap(cut)(weights * jnp.where(first, 1e-9, 1.0))
            a, P = cuts.a[-1], cuts.P[-1]
            centre, slope, rest = taylor.expand(both, a, jnp.eye(n), P, self.low, self.high)
            turn = slope - J
            rest = rest + jnp.abs(centre - value - J @ (a - point)) + jnp.sqrt(((turn @ P) * turn).sum(1))
            fine = jnp.isfinite(rest).all() & (cuts.health > 0).all()
            proved = fine & (~valid | (rest[n_x:] < allowed)).all()
            size = (jnp.diagonal(cuts.P, axis1=1, axis2=2) * self.weights).sum(1)
            pick = (jnp.arange(len(weights)) == jnp.argmin(size)).astype(float)
            best_a, best_P = pick @ cuts.a, jnp.tensordot(pick, cuts.P, 1)
            Phi = jnp.concatenate([J[:n_x], jnp.eye(n)[n_x:]])
            ahead = (jnp.concatenate([value[:n_x] + J[:n_x] @ (best_a - point), best_a[n_x:]]), Phi @ best_P @ Phi.T, rest[:n_x])
            proved = proved | first
            best = [jnp.where(proved, new, old) for new, old in zip((*ahead, a, P), best, strict=True)]
            return (jnp.where(fine, a, point), jnp.where(fine, MARGIN * rest[n_x:], allowed), best), None

        blank = jnp.zeros(n), jnp.zeros((n, n)), jnp.zeros(n_x), start, S
        begin = start, jnp.full(len(bound), jnp.inf), list(blank)
        first = jnp.arange(RESTART_ROUNDS) == 0
        z, moved, half, point, around = lax.scan(about, begin, first)[0][2]
        ahead = self._summed(z, jnp.eye(n), moved, half, Q, jnp.eye(n))
        cut, x = self._least(ahead, *self._compare(ahead, u, y, valid, "joint"), valid)
        fine = (cut.health > 0) & jnp.isfinite(cut.a).all() & jnp.isfinite(cut.P).all()
        left, right = ellipsoid.parts(ahead.b)
        z, P = jnp.where(fine, cut.a, ahead.z), jnp.where(fine, cut.P, left * ahead.moved + right * ahead.noise)
        near = jnp.concatenate([jnp.where(fine, x.a, z)[:n_x], point[n_x:]])
        near_shape = blocks(jnp.where(fine, x.P, P)[:n_x, :n_x], ellipsoid.minkowski(around[n_x:, n_x:], self._walk(dt))[0], jnp)
        return z, ellipsoid.factored(P) if self.form == "ud" else P, near, near_shape

    def adapt(self, q, cutting: Cutting, health, dt):
        """New factors on Q's diagonal: unchanged here; methods that learn Q override this."""
        return q

    @property
    def n_x(self) -> int:
        return self.system.n_x

    def unfactored(self, shape):
        """P (n, n) of the carried shape."""
        return ellipsoid.unfactored(shape) if self.form == "ud" else shape

    def noise(self, dt, q):
        """(n, n) shape that bounds one step's noise, factors q (n,) on its diagonal. x's noise and theta's drift may be on their
        bounds at the same time, so it is a sum of two sets and not one ellipsoid with both as semi-axes."""
        Q = self._radius(self.n_x) ** 2 * self.system.Q(dt) if self.process is None else jnp.diag(jnp.asarray(self.process) ** 2)
        still, unmoved = jnp.zeros((self.n_x, self.n_x)), jnp.zeros((self.system.n_theta,) * 2)
        root = jnp.sqrt(q)
        noise, drift = (part * root * root[:, None] for part in (blocks(Q, unmoved, jnp), blocks(still, self._walk(dt), jnp)))
        return ellipsoid.minkowski(noise, drift, self.weights)[0]

    def _walk(self, dt):
        return jnp.diag((jnp.asarray(self.theta_drift) * dt) ** 2)

    def _radius(self, m: int) -> float:
        """Radius of an ellipsoid that m Gaussian numbers leave about as rarely as one number leaves `bound` standard deviations."""
        return self.bound + m**0.5 - 1.0

    def _error_bound(self, u, form):
        """(n_y,) bounds of the errors, each alone (forms that cut by strips) or as semi-axes of all together."""
        if self.measurement is not None:
            return jnp.asarray(self.measurement)
        size = self.bound if form in ("scalar", "ud") else self._radius(self.system.n_y)
        return size * jnp.sqrt(self.system.R(u))

    def _predict(self, carry: Carry, u, dt) -> Ahead:
        """The carried set one step on, not yet summed."""
        n_x, system = self.n_x, self.system

        def f(point):
            return system.f(point[:n_x], u, point[n_x:], dt)

        if self.form == "joint":
            point, around = carry.near, self.product_scale * carry.near_shape
        else:
            point, around = carry.z, self.unfactored(carry.shape)
        x, F, half = self._bounded(f, point, around)
        Phi = jnp.concatenate([F, jnp.eye(self.n)[n_x:]])
        z = jnp.concatenate([x + F @ (carry.z - point), carry.z[n_x:]])
        if self.form == "ud":
            U, D = ellipsoid.factors(carry.shape)
            G = Phi @ (U * jnp.sqrt(jnp.maximum(D, 0.0)))
            moved = product(G, G.T)
        else:
            G, moved = Phi, product(product(Phi, carry.shape), Phi.T)
        return self._summed(z, G, moved, half, self.noise(dt, carry.q), Phi)

    def _summed(self, z, G, moved, half, Q, Phi) -> Ahead:
        """The shares of noise and remainder."""
        pad = jnp.zeros(self.system.n_theta)
        rest = jnp.diag(jnp.concatenate([ellipsoid.around_box(half, self.remainder_box), pad]))
        noise, b_Q = ellipsoid.minkowski(Q, rest, self.weights)
        moved = symmetric(moved)
        b = ellipsoid.minkowski(moved, noise, self.weights)[1]
        amplify = ellipsoid.parts(b_Q)[0] * ellipsoid.parts(b)[1]
        return Ahead(z, G, moved, noise, half, b, Phi, amplify)

    def _sum(self, ahead: Ahead):
        """The predicted shape: the Minkowski sum of least trace."""
        left, right = ellipsoid.parts(ahead.b)
        if self.form != "ud":
            return left * ahead.moved + right * ahead.noise
        rows = jnp.concatenate([ahead.G, jnp.linalg.cholesky(ahead.noise + 1e-30 * jnp.eye(self.n))], axis=1)
        return ellipsoid.ud_sum(rows, jnp.repeat(jnp.stack([left, right]), self.n))

    def _compare(self, ahead: Ahead, u, y, valid, form):
        """(H, e, limit): slope of the measurement over the predicted set, innovation, and squared bounds of the errors, h's
        remainder included: of each alone (forms that cut by strips), or semi-axes of all together."""
        n_x, system = self.n_x, self.system
        left, right = ellipsoid.parts(ahead.b)
        P = left * ahead.moved + right * ahead.noise
        y_hat, H, half = self._bounded(lambda point: system.h(point[:n_x], u, point[n_x:]), ahead.z, P)
        e = jnp.where(valid, jnp.where(valid, y, 0.0) - y_hat, 0.0)
        bound = self._error_bound(u, form)
        if form in ("scalar", "ud"):
            return H, e, (bound + half) ** 2
        b = ellipsoid.share((bound**2).sum(), half.sum() ** 2)
        left, right = ellipsoid.parts(b)
        return H, e, left * bound**2 + right * ellipsoid.around_box(half)

    def _least(self, ahead: Ahead, H, e, limit, valid):
        """(cut, near): the smaller of two joint cuts, both of which hold every possible state; and x as a cut that trusts the measurement
        gives it. Small share and weight leave theta as it was while little is learned; large ones pay where much is. health: includes
        whether every row alone is possible, which no share enters."""
        H, R = jnp.where(valid[:, None], H, 0.0), jnp.diag(limit)
        share, weight = np.array(TRIED).T
        left, right = (part[:, None, None] for part in ellipsoid.parts(share * ahead.b / (1 + (share - 1) * ahead.b)))
        PH = product(jnp.stack([ahead.moved, ahead.noise]), H.T)
        S = product(H, PH)
        P, PH, S_all = (left * ahead.moved + right * ahead.noise, left * PH[0] + right * PH[1], left * S[0] + right * S[1])
        K, health = jax.vmap(ellipsoid.joint_gains, (0, 0, None, None, 0))(PH, S_all, e, R, weight)
        size = health * (self.weights * (P.diagonal(axis1=1, axis2=2) - (K * PH).sum(2))).sum(1)
        second = size[1] < size[0]
        P, K, health, weight = (jnp.stack([jnp.where(second, a[1], a[0]), a[2]]) for a in (P, K, health, jnp.asarray(weight)))
        reach = jnp.sqrt(limit) + jnp.sqrt(jnp.maximum(S.diagonal(axis1=1, axis2=2), 0.0)).sum(0)
        possible = jnp.minimum(health.min(), 1.0 - (jnp.abs(e) / reach).max())
        health = health - jnp.where(valid.any(), 0.0, weight)  # a gap costs nothing
        least, near = (ellipsoid.joint_cut(ahead.z, P[k], H, e, R, weight[k], K[k], health[k]) for k in (0, 1))
        return least._replace(health=possible), near

    def _small(self, carry: Carry, ahead: Ahead, H, e, limit, valid, dt):
        """`Cut`: what the last two measurements leave of theta. The carried set is cut, before the step, by the small set of its x
        and by the measurement after the step."""
        n_x, n = self.n_x, self.n
        H = jnp.where(valid[:, None], H, 0.0)
        through = symmetric(product(product(H, ahead.noise), H.T))
        errors = ellipsoid.minkowski(jnp.diag(limit), through, 1.0 / limit)[0]
        R = blocks(carry.near_shape[:n_x, :n_x], errors, jnp)
        rows = jnp.concatenate([jnp.eye(n)[:n_x], product(H, ahead.Phi)])
        e = jnp.concatenate([carry.near[:n_x] - carry.z[:n_x], e])
        PH = product(carry.shape, rows.T)
        K, health = ellipsoid.joint_gains(PH, product(rows, PH), e, R, SHARP)
        health = health + SHARP * valid.any()  # two ellipsoids
        cut = ellipsoid.joint_cut(carry.z, carry.shape, rows, e, R, SHARP, K, health, slice(n_x, n))
        return cut._replace(P=ellipsoid.minkowski(cut.P, self._walk(dt))[0])

    def _bounded(self, function, z, P):
        """(value (m,), J (m, n), half (m,)): function(z + d) lies within half of value + J d for all d in E(0, P)."""
        if self.remainder == "taylor":
            value, J, half = taylor.expand(function, z, jnp.eye(self.n), P, self.low, self.high)
            return value, J, _capped(half)
        value, J = linearise.once(function, z)
        if self.remainder == "none":
            return value, J, jnp.zeros_like(value)
        mid, half = self._box_remainder(function, z, jnp.sqrt(jnp.maximum(P.diagonal(), 0.0)))
        return value + mid, J, half

    def _box_remainder(self, function, z, reach):
        """(mid, half) of the linearisation's remainder over the box around the ellipsoid, as the source bounds it."""
        low, high = jnp.maximum(z - reach, self.low), jnp.minimum(z + reach, self.high)
        remainder = interval.second_order_remainder(function, z, low, high)
        half = _capped(0.5 * (remainder.hi - remainder.lo))
        return jnp.where(half < UNBOUNDED, 0.5 * (remainder.lo + remainder.hi), 0.0), half

    def _cut(self, z, shape, H, e, limit, valid):
        """The predicted set cut by all valid measurements."""
        if self.form == "batch":
            cut, _, _ = ellipsoid.batch_cut(z, shape, jnp.where(valid[:, None], H, 0.0), e, jnp.diag(limit))
            usable = valid.any() & (cut.health > 0)
            return ellipsoid.Cut(jnp.where(usable, cut.a, z), jnp.where(usable, cut.P, shape), jnp.where(valid.any(), cut.health, 1.0))

        if self.form == "ud":
            return self._rows(ellipsoid.ud_strip_cut, z, shape, H, e, limit, valid)

        def by(a, P, h, e, r):
            return ellipsoid.strip_cut(a, P, h, e, r, self.cut, self.weights)

        return self._rows(by, z, shape, H, e, limit, valid)

    def _within_range(self, cut: ellipsoid.Cut, valid) -> ellipsoid.Cut:
        """The set cut by what is known about theta, as by measurements of it; but a gap teaches nothing."""
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
        """Cut by one valid measurement after the other; e: measured minus predicted at z."""

        def row(state, measurement):
            a, P, health = state
            h, left, r, valid = measurement
            new = cut(a, P, h, left - h @ (a - z), r)
            health = jnp.where(valid, jnp.minimum(health, new.health), health)
            return (jnp.where(valid, new.a, a), jnp.where(valid, new.P, P), health), None

        return ellipsoid.Cut(*lax.scan(row, (z, shape, jnp.ones(())), (H, e, limit, valid))[0])


def _capped(half):
    return jnp.where(half < UNBOUNDED, half, UNBOUNDED)
