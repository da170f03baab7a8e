"""When an estimate means that a rotor has lost effectiveness: a threshold that knows the geometry and the flight's own scatter.

A published method gives losses theta_hat (n,) and leaves the decision to its reader. Thresholds on each theta_hat are not enough:
with more than four rotors the method spreads one loss over several, wind and drift move all of them, and one aircraft is a
hundred times noisier than another. So the losses are turned into the missing wrench,

    v = B theta_hat - level,        level: where B theta_hat was before, forgotten over LEVEL_S

and the explicit hypotheses of the default diagnoser - one rotor, two, common mode, any disturbance - compete for v, which
counts as one sample with the variance that v has had in this flight, and with what the direction of v may be wrong by.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.core import Decision
from rotorwatch.toolkit import LOSS_WIDTH, NOTHING, SMALL_WIDTH, TOTAL_SHARE, list_hypotheses
from rotorwatch.toolkit import NO_LOSS as NONE

LEVEL_S, SCATTER_S = 20.0, 30.0  # s: memory of level and scatter
WARM_UP_S = 4.0  # no decision for so long after the start
FLOOR = 0.01  # hover thrusts: no method is steadier than that
COMMON_SD = 0.02  # per rotor: battery and air move all of them
CLIP = 9.0  # a square counts at most this many times its mean: a fault must not look like scatter
SIGMAS = 5.0
LIMIT = 0.5 * SIGMAS**2  # of the statistic, from which on a loss is announced
LEAST = 0.08
TURNED = 0.2  # share by which v may point elsewhere than the loss does
FADE = 0.25  # below this share of the threshold nothing has begun, or all is over
OVER_S = 2.0  # for so long, before what was announced counts as over


class Carry(namedtuple("Carry", "level scatter seconds held run best since")):
    """level, scatter (4,): mean and variance of the missing wrench; seconds of estimates; held: s for which an announcement
    still counts; run: steps in a row over the threshold, for `best`; since: steps since anything began."""


class Threshold:
    """Announces the best hypothesis once its loss is at least `least`, for `persist_s`, and far out of the scatter.

    B (4, n) in hover thrusts. least: smallest loss worth an event, 0..1. sigmas: how far out. persist_s [s].
    Decision.log_odds and best count the hypotheses of `list_hypotheses(n)`.
    """

    name = "threshold"

    def __init__(self, B, *, least: float = LEAST, sigmas: float = SIGMAS, persist_s: float = 0.3):
        """Raises ConfigError for numbers out of range."""
        self.B = checks.shape("B", B, 4, np.shape(B)[1])
        self.least = checks.between("least", least, 0.0, 1.0)
        self.sigmas, self.persist_s = checks.positive("sigmas", sigmas), checks.positive("persist_s", persist_s)
        self.hyp = list_hypotheses(np.shape(B)[1])

    def init(self) -> Carry:
        """The state before any estimate."""
        return Carry(np.zeros(4), np.full(4, 0.1**2), np.float64(0.0), np.float64(0.0), np.int32(0), np.int32(-1), np.int32(0))

    def step(self, carry: Carry, estimate, dt) -> tuple[Carry, Decision]:
        """Advance by dt seconds."""
        import jax.numpy as jnp

        hyp, B = self.hyp, jnp.asarray(self.B)
        seen = estimate.status == 0
        v = B @ estimate.theta[: hyp.n]
        away = v - carry.level
        logbf, jump = self.evidence(away, carry.scatter)
        asked = [kind in ("single", "pair") for kind in hyp.kinds]
        fault, weight = jnp.asarray(asked), jnp.log(jnp.asarray(hyp.weight))
        log_odds = logbf + weight
        best = jnp.argmax(jnp.where(fault, log_odds, -jnp.inf)).astype(jnp.int32)
        pick = (jnp.arange(jump.shape[0]) == best).astype(float)
        size = jnp.einsum("h,hk->k", pick, jump)
        double = jnp.asarray([float(kind == "pair") for kind, fault in zip(hyp.kinds, hyp.fault) if fault])
        enough = (size[0] > self.least) & ((size[1] > self.least) | (pick @ double < 0.5))
        log_fault = jnp.max(jnp.where(fault, log_odds, -jnp.inf))
        log_other = jnp.maximum(jnp.max(jnp.where(jnp.asarray(hyp.fault), -jnp.inf, log_odds)), 0.0)
        over = 0.5 * self.sigmas**2
        statistic = jnp.minimum(log_fault - over, log_fault - log_other)
        ready = carry.seconds > WARM_UP_S
        wrong = ready & seen & enough & (statistic > 0.0)
        run = jnp.where(wrong & (carry.best == best), carry.run + 1, jnp.where(wrong, 1, 0)).astype(jnp.int32)
        alarm = run * dt >= self.persist_s
        calm = log_fault < FADE * over
        since = jnp.where(calm, 0, carry.since + 1).astype(jnp.int32)

        # Level and scatter learn while nothing is suspected; at first they are plain means.
        held = jnp.where(alarm, OVER_S, jnp.maximum(carry.held - jnp.where(calm, dt, 0.0), 0.0))
        learns = seen & (~ready | ((calm | (log_other > log_fault)) & (held <= 0.0)))
        seconds = carry.seconds + jnp.where(seen, dt, 0.0)
        first = dt / jnp.maximum(seconds, dt)
        slow = jnp.where(learns, jnp.maximum(dt / LEVEL_S, first), 0.0)
        wide = jnp.where(learns, jnp.maximum(dt / SCATTER_S, first), 0.0)
        square = jnp.minimum(away**2, CLIP * carry.scatter)
        level = carry.level + slow * away
        scatter = jnp.maximum(carry.scatter + wide * (square - carry.scatter), FLOOR**2)
        out = Decision(log_odds, statistic, alarm, since.astype(float), best)
        return Carry(level, scatter, seconds, held, run, best, since), out

    def evidence(self, away, scatter):
        """Log Bayes factor (n_h,) of each hypothesis for the missing wrench `away` (4,), and its loss (n_fault, 2). Whether a rotor is well
        again, or gives one thrust, is not asked."""
        import jax.numpy as jnp

        n, hyp = self.hyp.n, self.hyp
        common = jnp.array([0.0, 0.0, 0.0, (n * COMMON_SD) ** 2])
        w = 1.0 / (scatter + common + TURNED**2 * (away @ away) / 4.0)
        B = jnp.asarray(self.B)
        C, z = (B * w[:, None]).T @ B, B.T @ (w * away)
        single, size = one_loss(jnp.diagonal(C), z)
        both, sizes = two_losses(C, z, hyp.pairs)
        moved = jnp.asarray([[float(a in block) for a in range(4)] for block in hyp.blocks])
        steps = moved @ (0.5 * (w * away) ** 2 / (w + 1.0) - 0.5 * jnp.log(w + 1.0))  # of any sign, about 1 large
        others = jnp.full(2 * n, NOTHING)
        alone = jnp.stack([size, jnp.zeros(n)], axis=-1)
        return jnp.concatenate([single, both, others, steps]), jnp.concatenate([alone, sizes, jnp.zeros((2 * n, 2))])


def one_loss(c, z):
    """Log Bayes factor (n,) and most probable size (n,) of a loss of one rotor, for information c (n,) and vector z (n,): small as often as
    large, and now and then total (`engine.estimator.hypotheses.Freed.loss`)."""
    import jax.numpy as jnp

    partly = 0.5 * (1.0 - TOTAL_SHARE)
    kinds = ((0.0, SMALL_WIDTH, partly), (0.0, LOSS_WIDTH, partly), (1.0, NONE, TOTAL_SHARE))
    fits, sizes = [], []
    for mean, width, share in kinds:
        left = c + width**-2
        size = jnp.clip((z + mean * width**-2) / left, 0.0, 1.0)
        fit = z * size - 0.5 * c * size**2 - 0.5 * ((size - mean) / width) ** 2
        fits.append(fit - 0.5 * jnp.log(left * width**2) + np.log(share))
        sizes.append(size)
    most = jnp.stack(fits).max(axis=0)
    likely = jnp.exp(jnp.stack(fits) - most)
    total = likely.sum(axis=0)
    return most + jnp.log(total), (likely * jnp.stack(sizes)).sum(axis=0) / total


def two_losses(C, z, pairs):
    """Log Bayes factors (n_pairs,) and most probable sizes (n_pairs, 2), between 0 and 1, of losses of two rotors, for information C (n, n)
    and vector z (n,) (`engine.estimator.hypotheses.pair`)."""
    import jax.numpy as jnp

    a, b = pairs.T
    c11, c12, c22 = C[a, a] + LOSS_WIDTH**-2, C[a, b], C[b, b] + LOSS_WIDTH**-2
    z1, z2 = z[a], z[b]
    det = jnp.maximum(c11 * c22 - c12 * c12, 1e-12 * c11 * c22 + 1e-30)
    first, second = (c22 * z1 - c12 * z2) / det, (c11 * z2 - c12 * z1) / det
    one, two = jnp.clip(first, 0.0, 1.0), jnp.clip(second, 0.0, 1.0)

    def score(x, y):
        return z1 * x + z2 * y - 0.5 * (c11 * x * x + 2.0 * c12 * x * y + c22 * y * y)

    # Inside the box, else on an edge that the best point lies beyond.
    best_two = jnp.where(one != first, jnp.clip((z2 - c12 * one) / c22, 0.0, 1.0), two)
    best = jnp.where((one != first) | (two == second), score(one, best_two), -jnp.inf)
    edge = jnp.clip((z1 - c12 * two) / c11, 0.0, 1.0)
    other = jnp.where(two != second, score(edge, two), -jnp.inf)
    sizes = jnp.stack([jnp.where(other > best, edge, one), jnp.where(other > best, two, best_two)], axis=-1)
    volume = jnp.maximum(c11 * c22 - c12 * c12, 1e-9) * LOSS_WIDTH**4
    return jnp.maximum(best, other) - 0.5 * jnp.log(volume), sizes
