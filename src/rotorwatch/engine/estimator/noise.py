"""Noise of this aircraft on every time scale: variances of a four-component noise model, learned causally.

The residual's structure function at lag L,  D(L) = E[(e(t) - e(t - L))^2] / 2,  of white noise, two coloured disturbances (time
constants TAU) and a random walk is

    D(L) = s_w^2 + sum_j s_j^2 (1 - exp(-L / tau_j)) + q L / 2

Each squared difference is a chi-square sample of D(L), so the variances (s_w^2, s_1^2, s_2^2, q) >= 0 have a gamma likelihood; its
multiplicative (expectation-maximisation) update keeps them positive and needs no solver: a few warm-started iterations per tick.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, REAL, Flags, Real, Reals, Struct, array, exp, local, sqrt
from rotorwatch.engine.estimator.estimator_sizes import RING
from rotorwatch.engine.estimator.plant import ANSWER_S, TAU, Plant

LAGS = (1, 2, 4, 8, 16, 32, 64)  # ticks
LAG_COUNT = 7
MEMORY_S = 60.0  # time constant with which squared differences are forgotten
CLIP = 6.0  # squares are clipped at this many times their expectation: a fault must not be learned as noise
GROWTH_WEIGHT = 0.05
CERTAIN = 5.0  # samples at which the weight of a lag saturates
ITERATIONS = 3
# Floor of the white variance, in hover thrusts: one PWM step of a few rotors.
FLOOR = 0.0008 * 0.0008
WHITE, FAST, SLOW, DRIFT = 0, 1, 2, 3
# Prior variances of these components, and the number of samples per lag that the prior is worth.
GENERIC, GENERIC_WEIGHT = (0.05 * 0.05, 0.05 * 0.05, 0.05 * 0.05, 0.02 * 0.02), 0.02


class Noise(Struct):
    """Noise model of all axes. v[component][axis]: variances."""

    v = array(REAL, 4, 4)
    safety = array(REAL, 4)  # factor by which the variances exceed the likelihood's
    weight = array(REAL, LAG_COUNT, 4)  # samples per lag; D = total / weight
    total = array(REAL, LAG_COUNT, 4)  # sum of half squared differences
    basis = array(REAL, LAG_COUNT, 4)  # D at each lag for a unit of each variance
    ring = array(REAL, RING, 4)  # last residuals
    known = array(FLAG, RING, 4)  # they are valid
    newest: int = 0  # ring index of the last one

    def begin(self, p: Plant) -> None:
        """Initialise before the first tick with the plant's variances: those of healthy flights, or generic ones."""
        for lag in range(LAG_COUNT):
            seconds = LAGS[lag] * p.dt
            self.basis[lag][WHITE] = 1.0
            self.basis[lag][FAST] = 1.0 - exp(-seconds / TAU[0])
            self.basis[lag][SLOW] = 1.0 - exp(-seconds / TAU[1])
            self.basis[lag][DRIFT] = seconds / 2.0
        for a in range(4):
            self.safety[a] = 1.0
            for c in range(4):
                self.v[c][a] = p.noise[c][a]
            for lag in range(LAG_COUNT):
                self.weight[lag][a] = p.noise_weight
                self.total[lag][a] = p.noise_weight * self._model(lag, p.noise[0][a], p.noise[1][a], p.noise[2][a], p.noise[3][a])

    def _model(self, lag: int, white: Real, fast: Real, slow: Real, drift: Real) -> Real:
        b = self.basis[lag]
        return b[WHITE] * white + b[FAST] * fast + b[SLOW] * slow + b[DRIFT] * drift

    def spread(self, axis: int) -> Real:
        """Variance of this aircraft's disturbances: all components but white noise, over ten seconds."""
        return self.v[FAST][axis] + self.v[SLOW][axis] + self.v[DRIFT][axis] * 5.0

    def step(self, p: Plant, e: Reals, ok: Flags, trust: Reals) -> None:
        """Add one residual of each axis where ok; trust in 0..1 discounts manoeuvring ticks."""
        self.newest = (self.newest + 1) % RING
        for a in range(4):
            self._learn(p, a, e[a], ok[a], trust[a])
        for a in range(4):
            self.ring[self.newest][a] = e[a] if ok[a] else 0.0
            self.known[self.newest][a] = ok[a]

    def _learn(self, p: Plant, a: int, e: Real, ok: bool, trust: Real) -> None:
        D = local(REAL, LAG_COUNT)
        certain = local(REAL, LAG_COUNT)
        for lag in range(LAG_COUNT):
            back = (self.newest + RING - int(LAGS[lag])) % RING
            if ok and self.known[back][a]:
                away = e - self.ring[back][a]
                square = min(0.5 * away * away, CLIP * (self.total[lag][a] / self.weight[lag][a]))
                # Differences a long lag apart overlap: L of them carry about as much as one independent sample.
                share = trust / LAGS[lag]
                forget = exp(-p.dt / MEMORY_S * trust)
                self.weight[lag][a] = self.weight[lag][a] * forget + share
                self.total[lag][a] = self.total[lag][a] * forget + share * square
        # Long lags have few samples at first: until they have more, assume that variance grows with the lag, as for disturbances.
        first = self.total[0][a] / self.weight[0][a]
        for lag in range(LAG_COUNT):
            grown = first * (1.0 + LAGS[lag] * p.dt / ANSWER_S)
            D[lag] = (self.total[lag][a] + GROWTH_WEIGHT * grown) / (self.weight[lag][a] + GROWTH_WEIGHT)
            certain[lag] = min(self.weight[lag][a], CERTAIN)
        v = local(REAL, 4)
        up = local(REAL, 4)
        down = local(REAL, 4)
        for c in range(4):
            v[c] = self.v[c][a] / self.safety[a]
        for _ in range(ITERATIONS):
            for c in range(4):
                up[c] = 0.0
                down[c] = 0.0
            for lag in range(LAG_COUNT):
                inverse = 1.0 / self._model(lag, v[0], v[1], v[2], v[3])
                share = certain[lag] * inverse
                fit = share * D[lag] * inverse
                for c in range(4):
                    up[c] += self.basis[lag][c] * fit
                    down[c] += self.basis[lag][c] * share
            for c in range(4):
                v[c] *= sqrt(min(max(up[c] / down[c], 0.05), 20.0))
        v[WHITE] = max(v[WHITE], FLOOR)
        worst = 0.0
        for c in range(4):
            v[c] = max(v[c], 1e-12)
        for lag in range(LAG_COUNT):
            worst = max(worst, D[lag] / self._model(lag, v[0], v[1], v[2], v[3]))
        # The model must not be quieter than the aircraft on any scale.
        self.safety[a] = min(max(worst / 1.1, 1.0), 4.0)
        for c in range(4):
            self.v[c][a] = v[c] * self.safety[a]
