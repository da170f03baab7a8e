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
from rotorwatch.engine.default import hypotheses

LEVEL_S, SCATTER_S, WARM_UP_S = (
    20.0,
    30.0,
    4.0,
)  # s: forgetting of level and scatter; no decision so long after the start
FLOOR = 0.01  # hover thrusts: no method is steadier than that
COMMON_SD = 0.02  # per rotor: battery and air move all of them
CLIP = 9.0  # a square counts at most this many times its mean: a fault must not look like scatter
SIGMAS = 5.0
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
    Decision.log_odds and best count the hypotheses of `hypotheses.make(n)`.
    """

    name = "threshold"

    def __init__(self, B, *, least: float = LEAST, sigmas: float = SIGMAS, persist_s: float = 0.3):
        """Raises ConfigError for numbers out of range."""
        self.B = checks.shape("B", B, 4, np.shape(B)[1])
        self.least = checks.between("least", least, 0.0, 1.0)
        self.sigmas, self.persist_s = checks.positive("sigmas", sigmas), checks.positive("persist_s", persist_s)
        self.hyp = hypotheses.make(np.shape(B)[1])

    def init(self) -> Carry:
        """Nothing seen yet."""
        return Carry(
            np.zeros(4), np.full(4, 0.1**2), np.float64(0.0), np.float64(0.0), np.int32(0), np.int32(-1), np.int32(0)
        )

    def step(self, carry: Carry, estimate, dt) -> tuple[Carry, Decision]:
        """One time step of dt s."""
        import jax.numpy as jnp

        hyp, B = self.hyp, jnp.asarray(self.B)
        seen = estimate.status == 0
        v = B @ estimate.theta[: hyp.n]
        away = v - carry.level
        logbf, jump = self.evidence(away, carry.scatter)
        fault, weight = jnp.asarray(hyp.fault & ~hyp.well & ~hyp.stuck), jnp.log(jnp.asarray(hyp.weight))
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
        """Log Bayes factor (n_h,) of each hypothesis for the missing wrench `away` (4,), and its loss (n_fault, 2)."""
        import jax.numpy as jnp

        n = self.hyp.n
        common = jnp.array([0.0, 0.0, 0.0, (n * COMMON_SD) ** 2])
        w = 1.0 / (scatter + common + TURNED**2 * (away @ away) / 4.0)
        Phi = jnp.concatenate([jnp.asarray(self.B), jnp.eye(4)], axis=1)
        C, z = Phi.T @ (w[:, None] * Phi), Phi.T @ (w * away)
        logbf, jump, _, _ = hypotheses.log_bayes_factors(
            self.hyp,
            C[None],
            z[None],
            jnp.zeros(n),
            jnp.ones(n),
            jnp.ones(4),
            jnp.zeros((1, n)),
            jnp.full((1, 4), 1e-12),
            0.0,
            jnp.asarray(self.B),
            2.0,  # hover thrusts: what gives one thrust is not asked for here
        )
        return logbf[0], jump[0]
