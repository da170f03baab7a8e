"""Likelihood of the trim as random walk plus white noise with one ratio of the two, beside any explanation.

A Kalman filter of the walk whitens: its gain and variance are the same for every column. Levels and manoeuvres are integrated out as
columns with a flat prior, or with standard deviation GAIN. With G, the products of all whitened columns,

    <a, b> = a b - (a G) (G + 1 / known)^-1 (G b)
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, TIME, Real, Reals, Struct, Time, Times, array, local, log, real, sqrt
from rotorwatch.engine.drift.drift_sizes import BLOCKS, ROWS, STEADY
from rotorwatch.engine.drift.stretch import LEVEL, Stretch

# Variance of the white noise over that of a step of the walk, and its prior: wandering is assumed unless the data contradict it, because
# a walk taken for white noise makes false trends.
WHITE = (0.0, 0.25, 1.0, 4.0, 16.0, 64.0, 256.0, 1024.0)
DOUBT = 0.2  # prior of each relative to the one before it
GAIN = 0.2  # standard deviation of gain errors
# Sum of squares of a column not explained by the others, relative and absolute, below which it depends on them, or is zero.
SURELY, NOTHING = 1e-9, 1e-11


class Fit(Struct):
    """Fit for one noise ratio. rest: residual sum of squares of z of each axis after `steady`; fit: log-evidence without the power of
    `rest`."""

    gain = array(REAL, BLOCKS)  # Kalman gain
    root = array(REAL, BLOCKS)  # one over the standard deviation of each innovation
    rows = array(REAL, BLOCKS, ROWS)  # for each block: `steady`, and z of each axis, whitened
    products = array(TIME, ROWS, ROWS)  # of these columns
    scale = array(TIME, 3)  # prior standard deviation of manoeuvres in z, relative to the noise
    factor = array(TIME, 3, STEADY, STEADY)  # of each axis: Cholesky factor of the products of `steady`, with its prior
    own = array(TIME, 3, STEADY)  # components of z along `steady`
    rest = array(TIME, 3)
    fit = array(REAL, 3)

    def begin(self, stretch: Stretch, white: Real, doubt: Real) -> None:
        """Begin with a ratio of the noises; doubt: the logarithm of its prior."""
        variance: Real = 1.0
        noise: Real = doubt
        for k in range(stretch.count):
            total = variance + white * stretch.white[k]
            self.gain[k] = variance / total
            self.root[k] = 1.0 / sqrt(total)
            noise += log(self.root[k])
            variance -= self.gain[k] * variance
            if k + 1 < stretch.count:
                variance += real(stretch.at[k + 1] - stretch.at[k])
        for j in range(STEADY):
            self._whiten(stretch.steady[j], stretch.count, j)
        for a in range(3):
            self._whiten(stretch.z[a], stretch.count, STEADY + a)
        self._multiply(stretch.count)
        for a in range(3):
            self._weigh(a, stretch.count)
            self.fit[a] = noise - real(log(self.factor[a][LEVEL][LEVEL]))
            for j in range(LEVEL):
                self.fit[a] -= real(log(self.factor[a][j][j]))

    def project(self, x: Reals, first: int, count: int, xy: Reals, xx: Reals) -> None:
        """Project a column that is 0 before `first`: its residual products with z and with itself on each axis."""
        inside = local(TIME, ROWS)
        own = local(TIME, STEADY)
        whole: Time = 0.0
        mean: Real = 0.0
        for k in range(first, count):
            off = x[k] - mean
            mean += self.gain[k] * off
            off *= self.root[k]
            whole += off * off
            row = self.rows[k]
            for j in range(ROWS):
                inside[j] += off * row[j]
        for a in range(3):
            self._solve(a, inside, own)
            square = whole
            cross = inside[STEADY + a]
            for j in range(STEADY):
                square -= own[j] * own[j]
                cross -= own[j] * self.own[a][j]
            xx[a] = real(max(square, 0.0) / self.rest[a])
            xy[a] = real(cross / self.rest[a])

    def _whiten(self, x: Reals, count: int, column: int) -> None:
        mean: Real = 0.0
        for k in range(count):
            off = x[k] - mean
            self.rows[k][column] = off * self.root[k]
            mean += self.gain[k] * off

    def _multiply(self, count: int) -> None:
        """Compute all products of the whitened columns."""
        for j in range(ROWS):
            for i in range(ROWS):
                self.products[j][i] = 0.0
        for k in range(count):
            row = self.rows[k]
            for j in range(ROWS):
                to = self.products[j]
                for i in range(j + 1):
                    to[i] += row[j] * row[i]

    def _weigh(self, axis: int, count: int) -> None:
        """Fit `steady` to z: prior scale, Cholesky factor and residual of an axis."""
        squares = self.products[STEADY + axis][STEADY + axis]
        left = max(squares - self._explained(axis), 1e-12)
        self.scale[axis] = GAIN * sqrt(real(count) / left)
        for j in range(STEADY):
            for i in range(j + 1):
                entry = self.products[j][i] * self._scale(axis, j) * self._scale(axis, i)
                if i == j and j != LEVEL:
                    entry += 1.0
                for k in range(i):
                    entry -= self.factor[axis][j][k] * self.factor[axis][i][k]
                self.factor[axis][j][i] = sqrt(max(entry, 1e-12)) if i == j else entry / self.factor[axis][i][i]
        self._solve(axis, self.products[STEADY + axis], self.own[axis])
        self.rest[axis] = squares
        for j in range(STEADY):
            self.rest[axis] -= self.own[axis][j] * self.own[axis][j]
        self.rest[axis] = max(self.rest[axis], 1e-12 * squares + 1e-18)

    def _scale(self, axis: int, j: int) -> Time:
        return 1.0 if j == LEVEL else self.scale[axis]

    def _solve(self, axis: int, inside: Times, out: Times) -> None:
        """Components of a column along `steady`, by forward substitution of their products."""
        for j in range(STEADY):
            out[j] = inside[j] * self._scale(axis, j)
            for k in range(j):
                out[j] -= self.factor[axis][j][k] * out[k]
            out[j] /= self.factor[axis][j][j]

    def _explained(self, axis: int) -> Time:
        """Sum of squares of z explained by manoeuvres of any size."""
        factor = local(TIME, STEADY, STEADY)
        own = local(TIME, STEADY)
        found: Time = 0.0
        for j in range(LEVEL):
            for i in range(j):
                entry = self.products[j][i]
                for k in range(i):
                    entry -= factor[j][k] * factor[i][k]
                factor[j][i] = entry / factor[i][i] if factor[i][i] > 0.0 else 0.0
            entry = self.products[j][j]
            own[j] = self.products[STEADY + axis][j]
            for k in range(j):
                entry -= factor[j][k] * factor[j][k]
                own[j] -= factor[j][k] * own[k]
            if entry > SURELY * self.products[j][j] + NOTHING:
                factor[j][j] = sqrt(entry)
                own[j] /= factor[j][j]
            else:
                own[j] = 0.0
            found += own[j] * own[j]
        return found
