"""Evidence and prior of each explanation of a trim.

The estimator announces steps. It absorbs as a disturbance any change over seconds or minutes, and any torque without a loss of thrust.
Over the whole flight both show in

    z = (b + B T theta) / mean T

b, theta: biases and losses as estimated, T: thrusts commanded. With r: 0 until t0, 1 from t1 on, linear between, the explanations of z on
roll, pitch and yaw are

    nothing         a level, and the effect of manoeuvres
    a rotor         r L B_i T_i / mean T, L: the loss of rotor i at the end; uniform prior of the size
    other           any drift: of each axis by an amount of its own, of a Cauchy distribution of scale DRIFT - wind that turns, a load that
                    shifts, a mount that gives -, of all axes at the same time or of each at its own
    a turned mount  of those, yaw by TURNED and more with less on the others: neither wind nor load does that

The noise of each axis is a random walk and white noise of any size and ratio (`fit.py`), because air wanders; white noise is larger where
z scatters more within a block of time. Manoeuvres show in z where gains are wrong: in proportion to torque commands that come and go
within SMOOTH blocks. Thrust, which battery and air change for all rotors alike, is left out. So a drift is attributed to a rotor where it
has that rotor's direction, and exceeds usual drifts.

A slice of the work is half of the work for one course, a pair of t0 and t1. All evidence is log-odds to `nothing`.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, SMALL, Real, Small, Struct, array, embedded, exp, local, log, real, reset
from rotorwatch.engine.drift.drift_sizes import (
    AMOUNTS_EACH,
    AMOUNTS_TURNED,
    BLOCKS,
    COLUMNS,
    COURSES,
    LOSSES_EACH,
    ONSETS,
    RATIOS,
    RISE_KINDS,
)
from rotorwatch.engine.drift.fit import DOUBT, WHITE, Fit
from rotorwatch.engine.drift.stretch import Stretch
from rotorwatch.engine.intake.craft import PITCH, ROLL, YAW, Vehicle
from rotorwatch.engine.intake.sizes import ROTORS

RISES = (0.0, 3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0)  # blocks from t0 to t1
GROWS_S = 8.0  # a shorter rise is a step, after which the biases take a while to settle
DRIFT = (0.1, 0.1, 0.2)  # hover thrusts of one rotor, per mean thrust: roll, pitch, yaw
TURNED = 0.3  # the same: a mount that turns by a degree or two; wind and load cause half of it
RARE = 0.01  # prior odds of a slow loss of a rotor to any other drift
RATIO = 150.0 ** (1.0 / (AMOUNTS_EACH - 1))
AMOUNTS = tuple(0.01 * RATIO**k for k in range(AMOUNTS_EACH))  # hover thrusts, of a drift
SIZES = tuple(0.03 + 0.03 * k for k in range(LOSSES_EACH))
PI = 3.141592653589793
NEVER = -1e9  # log-odds of the impossible
FAINT = 30.0  # nats below the largest term of a sum; smaller terms are negligible
MOST = 60.0  # of an exponent


IDLE, GOES_ON, ENDS = 0, 1, 2  # state after a piece of a slice
THIRDS = 3  # pieces into which the sizes of a loss are divided


class Sum(Struct):
    """A sum of terms, each given by its logarithm and a weight."""

    top: Real = NEVER
    total: Real = 0.0

    def add(self, x: Real, weight: Real) -> None:
        """Add a term."""
        if x > self.top:
            self.total = self.total * exp(self.top - x) + weight
            self.top = x
        elif x > self.top - FAINT:
            self.total += weight * exp(x - self.top)

    def log(self) -> Real:
        """Its logarithm."""
        return self.top + log(self.total) if self.total > 0.0 else NEVER


class Weighing(Struct):
    """Evidence of each explanation of a trim. Sums over the courses so far; those of a turned mount are in two parts, one of them without
    the factor `alone`."""

    fit = embedded(Fit)
    base = array(REAL, RATIOS, 3)  # odds of each ratio to all without explanation, to the power of -1 / freedom
    xy = array(REAL, RATIOS, COLUMNS, 3)  # of the columns of this course
    xx = array(REAL, RATIOS, COLUMNS, 3)
    x = array(REAL, 2 * BLOCKS)  # room: a course; what ends in each block
    lost = array(REAL, COURSES, ROTORS)  # log-odds of any loss of each rotor, by course
    start = array(SMALL, COURSES)  # t0, block
    rise = array(SMALL, COURSES)  # blocks from t0 to t1
    sizes = array(Sum, ROTORS * 2 * LOSSES_EACH)  # of each rotor, in a step or by growth, of each size
    drifts = array(Sum, 2)  # roll, pitch: any drift of the axis
    turns = array(Sum, 2)  # yaw: drifts below TURNED, and from it on
    together = embedded(Sum)  # all axes drift at the same time
    sole = array(Sum, AMOUNTS_TURNED)  # yaw by each amount of a turned mount, alone
    beside = array(Sum, AMOUNTS_TURNED)  # the same with small drifts of the other axes at the same time
    onset_sole = embedded(Sum)  # t0 of these
    onset_beside = embedded(Sum)
    freedom: Real = 1.0  # half of the degrees of freedom
    near: Real = 1.0  # factor by which a residual may exceed the smallest one and still count
    small = array(REAL, 3)  # of this course: drifts of each axis by less than TURNED, and by any amount
    whole = array(REAL, 3)
    large = array(REAL, AMOUNTS_TURNED)  # yaw by each amount of a turned mount
    less = embedded(Sum)  # drifts of the last axis by less than TURNED; then any loss of the last rotor
    more = embedded(Sum)  # drifts of the last axis by TURNED and more
    count: Small = 0  # of `large`
    rotor = array(REAL, ROTORS)  # log-odds of each rotor, any size, when all courses are weighed
    kind: Small = -1  # index in RISES; -1: the ratios are still to be prepared
    place: Small = 0  # index of the next onset in ONSETS
    courses: Small = 0  # so far
    measured: bool = False  # the next course has been measured
    piece: Small = 0  # next piece of this slice

    def begin(self, stretch: Stretch) -> None:
        """Begin with a trim."""
        reset(self.together)
        reset(self.onset_sole)
        reset(self.onset_beside)
        for k in range(ROTORS * 2 * LOSSES_EACH):
            reset(self.sizes[k])
        for k in range(2):
            reset(self.drifts[k])
            reset(self.turns[k])
        for k in range(AMOUNTS_TURNED):
            reset(self.sole[k])
            reset(self.beside[k])
        self.kind = -1
        self.place = 0
        self.courses = 0
        self.measured = False
        self.piece = 0
        self.freedom = 0.5 * (real(stretch.count) - 1.0)

    def part(self, v: Vehicle, stretch: Stretch) -> int:
        """Compute a piece of a slice, which is half of a course: its fit, or the evidence from it. GOES_ON: the slice has more pieces;
        ENDS: it was the last piece; IDLE: nothing was left to do."""
        if self.kind < 0:
            self._prepare(stretch)
            return GOES_ON
        if self.kind >= RISE_KINDS:
            return IDLE
        start = self._onset(stretch, self.place)
        rise = RISES[self.kind]
        at = int(self.piece)
        self.piece += 1
        if not self.measured and (self.place == 0 or start > self._onset(stretch, self.place - 1)):
            if at % 2 == 0:
                self.fit.begin(stretch, WHITE[at // 2], 0.0)
            else:
                self._measure(v, stretch, start, rise, at // 2)
            if at < 2 * RATIOS - 1:
                return GOES_ON
            self.piece = 0
            self.measured = True
            return ENDS
        if self.measured:
            if at < 6:
                self._drifts(at // 2, at % 2)
                return GOES_ON
            if at == 6:
                self._together(real(start))
                return GOES_ON
            self._losses(v, (at - 7) // THIRDS, (at - 7) % THIRDS, 1 if rise * stretch.length >= GROWS_S else 0)
            if at - 7 < THIRDS * v.rotors - 1:
                return GOES_ON
            self.start[self.courses] = start
            self.rise[self.courses] = int(rise)
            self.courses += 1
            self.measured = False
        self.piece = 0
        self.place += 1
        if self.place == ONSETS:
            self.place = 0
            self.kind += 1
        return ENDS

    def _prepare(self, stretch: Stretch) -> None:
        """Compute the likelihood of each ratio without explanation, one after the other."""
        at = int(self.piece)
        self.piece += 1
        if at < RATIOS:
            self.fit.begin(stretch, WHITE[at], real(at) * log(real(DOUBT)))
            for a in range(3):
                self.base[at][a] = self.fit.fit[a] - self.freedom * real(log(self.fit.rest[a]))
            return
        self.piece = 0
        self.kind = 0
        for a in range(3):
            every = Sum()
            for q in range(RATIOS):
                every.add(self.base[q][a], 1.0)
            none = every.log()
            for q in range(RATIOS):
                self.base[q][a] = exp(min((none - self.base[q][a]) / self.freedom, MOST))
        self.near = exp(FAINT / self.freedom)

    def prior(self, v: Vehicle) -> Real:
        """Logarithm of the prior of one course, rotor and size."""
        return log(real(RARE) / (real(self.courses) * real(v.rotors) * real(LOSSES_EACH)))

    def alone(self) -> Real:
        """Log-evidence that roll and pitch drift each at its own time, or not at all; less the cost of a choice among three."""
        found: Real = 0.0
        for a in range(2):
            found += _either(0.0, self.drifts[a].log() - log(real(self.courses)))
        return found - 3.0 * log(real(2.0))

    def other(self) -> Real:
        """Log-evidence of everything but a rotor and a turned mount."""
        several = log(real(self.courses))
        every = Sum()
        every.add(0.0, 1.0)
        every.add(self.together.log() - several, 1.0)
        every.add(self.alone() + _either(0.0, self.turns[0].log() - several), 1.0)
        return every.log() - log(real(3.0))

    def _onset(self, stretch: Stretch, place: int) -> int:
        """t0 of this onset, block."""
        first = real(stretch.at[0]) + 1.0
        last = max(first, real(stretch.at[stretch.count - 1]) - 1.0 - 0.5 * RISES[self.kind])
        return int(first + (last - first) * real(place) / real(ONSETS - 1) + 0.5)

    def _measure(self, v: Vehicle, stretch: Stretch, start: int, rise: Real, q: int) -> None:
        """Fit z by a drift and by the loss of each rotor along this course, with the ratio begun in `fit`."""
        first = 0
        while first < stretch.count and real(stretch.at[first] - start) < (1.0 if rise > 0.0 else 0.0):
            first += 1
        for i in range(v.rotors + 1):
            for k in range(first, stretch.count):
                grown: Real = 1.0
                if rise > 0.0:
                    grown = min(real(stretch.at[k] - start) / rise, 1.0)
                self.x[k] = grown if i == 0 else grown * stretch.share[i - 1][k]
            self.fit.project(self.x, first, stretch.count, self.xy[q][i], self.xx[q][i])

    def _drifts(self, a: int, side: int) -> None:
        """Add the evidence of a drift of an axis to one side, over all amounts."""
        if side == 0:
            reset(self.less)
            reset(self.more)
            self.count = 0
        for k in range(AMOUNTS_EACH):
            amount = AMOUNTS[k] if side == 1 else -AMOUNTS[k]
            found = self._odds(0, a, amount)
            relative = AMOUNTS[k] / DRIFT[a]
            density = _gap(k) / (PI * DRIFT[a] * (1.0 + relative * relative))
            if AMOUNTS[k] < TURNED:
                self.less.add(found, density)
            else:
                self.more.add(found, density)
                if a == YAW:
                    self.large[self.count] = found + log(density)
                    self.count += 1
        self.small[a] = self.less.log()
        self.whole[a] = _either(self.small[a], self.more.log())

    def _together(self, start: Real) -> None:
        """Add the evidence of drifts of all axes, once each is known; `more` is that of yaw, the last one."""
        still = self.small[ROLL] + self.small[PITCH]
        calm = self.whole[ROLL] + self.whole[PITCH]
        more = self.more.log()
        self.together.add(calm + self.small[YAW], 1.0)
        self.together.add(calm + self.whole[YAW], 1.0 - exp(min(still - calm, -1e-6)))
        for a in range(2):
            self.drifts[a].add(self.whole[a], 1.0)
        self.turns[0].add(self.small[YAW], 1.0)
        self.turns[1].add(more, 1.0)
        for k in range(AMOUNTS_TURNED):
            self.sole[k].add(self.large[k], 1.0)
            self.beside[k].add(self.large[k] + still, 1.0)
        self.onset_sole.add(more, start)
        self.onset_beside.add(more + still, start)

    def _losses(self, v: Vehicle, i: int, third: int, grows: int) -> None:
        """Add the evidence of a loss of a rotor, over a third of the sizes."""
        if third == 0:
            reset(self.less)
        for k in range(third * LOSSES_EACH // THIRDS, (third + 1) * LOSSES_EACH // THIRDS):
            found: Real = 0.0
            for a in range(3):
                found += self._odds(i + 1, a, SIZES[k] * v.effectiveness[a][i])
            self.sizes[(2 * i + grows) * LOSSES_EACH + k].add(found, 1.0)
            self.less.add(found, 1.0)
        self.lost[self.courses][i] = self.less.log()

    def sum(self, v: Vehicle, i: int) -> None:
        """Compute the log-odds of any loss of a rotor, when all courses are weighed."""
        self.rotor[i] = self.prior(v) + self.either_way(i, 2)

    def either_way(self, rotor: int, grows: int) -> Real:
        """Logarithm of the evidence of a loss: by a step (0), by growth (1), by either (2); without the prior."""
        every = Sum()
        for way in range(2):
            if grows == 2 or grows == way:
                for s in range(LOSSES_EACH):
                    every.add(self.sizes[(2 * rotor + way) * LOSSES_EACH + s].log(), 1.0)
        return every.log()

    def _odds(self, column: int, axis: int, amount: Real) -> Real:
        """Log-evidence of an amount of a column of this course on one axis."""
        rest = local(REAL, RATIOS)
        least: Real = MOST
        for q in range(RATIOS):
            left = 1.0 + amount * (amount * self.xx[q][column][axis] - 2.0 * self.xy[q][column][axis])
            rest[q] = self.base[q][axis] * max(left, 1e-12)
            if q == 0 or rest[q] < least:
                least = rest[q]
        every: Real = 0.0
        for q in range(RATIOS):
            if rest[q] <= least:
                every += 1.0
            elif rest[q] < least * self.near:
                every += exp(-self.freedom * log(rest[q] / least))
        return log(every) - self.freedom * log(least)


def _gap(k: int) -> Real:
    """Width of the interval of one of AMOUNTS: the mean distance to its neighbours."""
    if k == 0:
        return 0.5 * (AMOUNTS[1] + AMOUNTS[0])
    if k == AMOUNTS_EACH - 1:
        return AMOUNTS[k] - AMOUNTS[k - 1]
    return 0.5 * (AMOUNTS[k + 1] - AMOUNTS[k - 1])


def _either(a: Real, b: Real) -> Real:
    """Log-odds of two exclusive explanations together."""
    return max(a, b) + log(1.0 + exp(-abs(a - b)))
