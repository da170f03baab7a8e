"""Which rotors are off in a vehicle that spins and flies on: a hidden Markov chain over sets of rotors, causal, tick by tick.

With the set S off, the thrusts T (n,) of the other rotors balance the motion of a rigid body (Newton and Euler) at any attitude and rate,

    sum_S B_a T = J_a (dr_a/dt + g_a) + D_a r_a + b_a          roll, pitch; g: gyroscopic terms of a flat body
    sum_S B_z T = J_z dr_z/dt + D_z r_z + E_z r_z |r_z|        yaw, which drag balances at 20 to 45 rad/s
    sum_S T     = n load

load is the specific force up at the centre of mass: a spin of 40 rad/s adds 16 m/s^2 for each centimetre that the accelerometer is off
the axis, so its lever arm l is estimated from the lateral forces, f = dr/dt x l + r x (r x l). All terms are averaged over AVERAGE_S,
longer than the lag of motors and controllers: between two commands as slow as 10 Hz a nutating vehicle turns by a radian, and the phase of
single samples would look like a missing rotor. Each set has a Kalman filter of its own for (J, D, b); filters are mixed as in the
interacting multiple model filter (Blom and Bar-Shalom, IEEE Transactions on Automatic Control 33, 1988). Thrust is the demand to a power
that is constant in a flight, since the curve may be unknown: one chain for each of CURVES powers, 1, 1.5 and 2. Units: hover thrusts of
one rotor, rad/s, m/s^2; body FRD.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (
    MASK,
    REAL,
    SMALL,
    Real,
    Reals,
    Small,
    Struct,
    Time,
    array,
    embedded,
    exp,
    local,
    log,
    real,
    reset,
    sqrt,
)
from rotorwatch.base.physics import G0
from rotorwatch.engine.events.losses import count_of
from rotorwatch.engine.intake.craft import THRUST, YAW, Vehicle
from rotorwatch.engine.intake.sense import Sensed
from rotorwatch.engine.intake.sizes import AVERAGED, ROTORS, SETS

MOST, MOST_OF_MANY, MANY = 3, 2, 4  # rotors off at once; of more than MANY rotors
AVERAGE_S = 0.4
CURVES = 3
PARTS = 4  # of the work for each: mixing three axes, and the rest
UNITS = 10  # of filters: one for each power and axis, and a free one
STRONGEST = 5.0  # hover thrusts: hardly any rotor gives more, whatever its curve says
# Rates [1/s]: one more rotor goes off; two at once; three at once; one comes back, each further one ten times more rarely.
FAILS = (0.01, 0.001, 0.00005)
RETURNS = (0.0003, 0.00003, 0.000003)
INERTIA = (0.006, 0.006, 0.13)  # of any multirotor, per rotor: hover thrusts per rad/s^2
FLAT = 0.8  # (Jz - Jy) / Jx of a vehicle that is nearly flat; 1 for a plate
OUTLIERS, OUTLIER_SD = 0.05, 4.0  # share of ticks that carry no information: a blow, a damaged sample
# Standard deviations, in hover thrusts. Of inertia as a share; of the offset; of damping per rad/s; of yaw drag, its mean as well.
INERTIA_SHARE, OFFSET, DAMPING, YAW_DAMPING, YAW_DRAG = 0.5, 0.15, 0.05, 0.05, 0.003
LEAST_SHARE = 0.2  # of the usual inertia
FLOOR = (0.15, 0.15, 0.3, 0.25)  # of roll, pitch, yaw, thrust
THRUST_SHARE, STEP_SHARE, STRONG_SHARE, STRONG = 0.12, 0.5, 0.3, 2.0  # of a rotor's thrust; of its changes; of thrust beyond STRONG
LOAD_SHARE = 0.1  # of the load that the vehicle carries: inflow
MOTION_SHARE = 0.2  # of inertial torques, and of yaw drag
YAW_WEIGHT = 0.5  # drag at these rates is no model, but a fit
LEVER_M, SIDE_FLOOR, SIDE_SHARE = 0.03, 1.5, 0.1  # m; m/s^2 of drag on the body, and a share of the lateral force
TINY = 1e-30


class Terms(Struct):
    """A tick. thrust: demanded; rows: what multiplies (J, b, D), in yaw (J, D, E); up: what multiplies the lever arm in the specific force
    along z; force: that force."""

    thrust = array(REAL, ROTORS)
    rows = array(REAL, 3, 3)
    up = array(REAL, 3)
    force: Real = 0.0


class Parameters(Struct):
    """Three parameters of an axis: mean and covariance, the upper triangle row by row."""

    mean = array(REAL, 3)
    P = array(REAL, 6)


class Unit(Struct):
    """The parameters of an axis for every set, by one power."""

    of = array(Parameters, SETS)


class Subsets(Struct):
    """The chain. off: the sets as bits, none first, `count` of them; probability: of each, given all ticks so far; likelihood: log, of the
    last tick, by the likeliest power; misfit: root mean square of the residual of the likeliest set over the last average, in standard
    deviations; known: there has been an average."""

    recent = array(Terms, AVERAGED)  # ring
    now = embedded(Terms)  # their mean
    units = array(Unit, UNITS)
    place = array(SMALL, UNITS)  # of each power's axis, then the free one
    lever = array(REAL, 3)
    lever_P = array(REAL, 3, 3)
    off = array(MASK, SETS)
    size = array(SMALL, SETS)
    stays = array(REAL, SETS)  # probability that a set stays as it is for a tick
    p = array(REAL, CURVES, SETS)
    evidence = array(REAL, CURVES)  # log
    prior = array(REAL, SETS)
    likelihood = array(REAL, SETS)
    square = array(REAL, SETS)  # mean square of the residual of each
    probability = array(REAL, SETS)
    load: Real = 0.0
    load_variance: Real = 0.0
    misfit: Real = 0.0
    weight: Real = 1.0  # of a tick: averages overlap
    dt: Real = 0.05
    count: Small = 0
    keep: Small = 1  # ticks in an average
    seen: int = 0
    best: Small = 0  # power
    known: bool = False

    def begin(self, v: Vehicle, dt: Time) -> None:
        """Start with all rotors on, for ticks of dt s."""
        reset(self)
        self.dt = real(dt)
        self.keep = min(max(int(AVERAGE_S / dt + 0.5), 1), AVERAGED)
        self.weight = real(min(1.0, dt / AVERAGE_S))
        self._list(v.rotors, _most_of(v.rotors))
        for k in range(UNITS):
            self.place[k] = k
        for i in range(self.count):
            leaves: Real = 0.0
            for j in range(self.count):
                leaves += self._rate(i, j)
            self.stays[i] = 1.0 - leaves * self.dt
        for c in range(CURVES):
            self.p[c][0] = 1.0
            for axis in range(3):
                for i in range(self.count):
                    _usual(v.rotors, axis, self.units[3 * c + axis].of[i])
        self.probability[0] = 1.0
        for a in range(3):
            self.lever_P[a][a] = LEVER_M * LEVER_M

    def take(self, v: Vehicle, row: Sensed, hover: Real) -> bool:
        """Take in a tick; return whether there is an average, to be evaluated by all parts of each power, then by `conclude`. hover: mean
        share of full thrust that carries the vehicle."""
        self._terms(v, row, hover, self.recent[self.seen % self.keep])
        self.seen += 1
        if self.seen < self.keep:
            return False
        reset(self.now)
        for k in range(self.keep):
            one = self.recent[k]
            for a in range(3):
                self.now.up[a] += one.up[a] / real(self.keep)
                for b in range(3):
                    self.now.rows[a][b] += one.rows[a][b] / real(self.keep)
            self.now.force += one.force / real(self.keep)
        up: Real = 0.0
        spread: Real = 0.0
        for a in range(3):
            up += self.now.up[a] * self.lever[a]
            for b in range(3):
                spread += self.now.up[a] * self.lever_P[a][b] * self.now.up[b]
        n = real(v.rotors)
        self.load = (up - self.now.force) / G0
        carries = LOAD_SHARE * n * max(self.load, 0.5)
        self.load_variance = carries * carries + n * n / G0 / G0 * spread
        return True

    def part(self, v: Vehicle, c: int, part: int) -> None:
        """Evaluate the average by a power: one of PARTS parts, in order."""
        if part < 3:
            self._mix(c, part)
        else:
            self._curve(v, c)

    def _curve(self, v: Vehicle, c: int) -> None:
        """The last part."""
        thrust = local(REAL, ROTORS)
        spread = local(REAL, ROTORS)
        first = (self.seen - self.keep) % self.keep
        for i in range(v.rotors):
            mean: Real = 0.0
            change: Real = 0.0
            last: Real = 0.0
            for k in range(self.keep):
                x = _thrust(self.recent[(first + k) % self.keep].thrust[i], c)
                mean += x / real(self.keep)
                change += abs(x - last) / real(self.keep) if k > 0 else 0.0
                last = x
            share = THRUST_SHARE * mean
            step = STEP_SHARE * change
            strong = STRONG_SHARE * max(mean - STRONG, 0.0)
            thrust[i] = mean
            spread[i] = share * share + step * step + strong * strong
        most: Real = -1.0 / TINY
        for h in range(self.count):
            value = self._fit(v, c, h, thrust, spread)
            if c == self.best:
                self.likelihood[h] = value
            self.p[c][h] = log(self.prior[h] + TINY) + value
            most = max(most, self.p[c][h])
        total: Real = 0.0
        for h in range(self.count):
            total += exp(self.p[c][h] - most)
        total = most + log(total)
        for h in range(self.count):
            self.p[c][h] = exp(self.p[c][h] - total)
        self.evidence[c] += total

    def conclude(self) -> None:
        """After all powers: the probability of each set."""
        self.known = True
        total: Real = 0.0
        most = self.evidence[0]
        for c in range(CURVES):
            most = max(most, self.evidence[c])
        for c in range(CURVES):
            self.evidence[c] -= most
            total += exp(self.evidence[c])
        likeliest = 0
        for h in range(self.count):
            self.probability[h] = 0.0
            for c in range(CURVES):
                self.probability[h] += exp(self.evidence[c]) / total * self.p[c][h]
            if self.probability[h] > self.probability[likeliest]:
                likeliest = h
        self.misfit = sqrt(self.square[likeliest])
        for c in range(CURVES):
            if self.evidence[c] > self.evidence[self.best]:
                self.best = c

    def is_off(self, rotor: int) -> Real:
        """Probability that a rotor is off."""
        total: Real = 0.0
        for h in range(self.count):
            if (self.off[h] & (1 << rotor)) != 0:
                total += self.probability[h]
        return total

    def index(self, rotors: int) -> int:
        """Index of a set, -1 if it is none of the chain's."""
        for h in range(self.count):
            if self.off[h] == rotors:
                return h
        return -1

    def _list(self, n: int, most: int) -> None:
        """List the sets of up to so many of n rotors, by their size."""
        for many in range(most + 1):
            for rotors in range(1 << n):
                if count_of(rotors) == many:
                    self.off[self.count] = rotors
                    self.size[self.count] = many
                    self.count += 1

    def _rate(self, i: int, j: int) -> Real:
        """Rate [1/s] from a set to another one."""
        more = self.size[j] - self.size[i]
        both = self.off[i] & self.off[j]
        if more > 0 and both == self.off[i]:
            return FAILS[more - 1]
        if more < 0 and both == self.off[j]:
            return RETURNS[-more - 1]
        return 0.0

    def _terms(self, v: Vehicle, row: Sensed, hover: Real, out: Terms) -> None:
        """Write the terms of a tick, after the lever arm has been learned from its lateral forces."""
        r = row.rate
        d = row.rate_dot
        across = local(REAL, 3, 3)  # dr/dt x . + r x (r x .)
        square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        for a in range(3):
            for b in range(3):
                across[a][b] = r[a] * r[b] - (square if a == b else 0.0)
        across[0][1] -= d[2]
        across[0][2] += d[1]
        across[1][0] += d[2]
        across[1][2] -= d[0]
        across[2][0] -= d[1]
        across[2][1] += d[0]
        for a in range(2):
            self._learn_lever(across[a], row.push[a])
        for i in range(v.rotors):
            out.thrust[i] = row.share[i] / hover
        out.rows[0][0] = d[0] + FLAT * r[1] * r[2]
        out.rows[0][1] = 1.0
        out.rows[0][2] = r[0]
        out.rows[1][0] = d[1] - FLAT * r[0] * r[2]
        out.rows[1][1] = 1.0
        out.rows[1][2] = r[1]
        out.rows[2][0] = d[2]
        out.rows[2][1] = r[2]
        out.rows[2][2] = r[2] * abs(r[2])
        for a in range(3):
            out.up[a] = across[2][a]
        out.force = -G0 * row.load

    def _learn_lever(self, h: Reals, force: Real) -> None:
        gain = local(REAL, 3)
        noise = SIDE_FLOOR + SIDE_SHARE * abs(force)
        total = noise * noise
        e = force
        for a in range(3):
            for b in range(3):
                gain[a] += self.lever_P[a][b] * h[b]
            total += h[a] * gain[a]
            e -= h[a] * self.lever[a]
        for a in range(3):
            self.lever[a] += gain[a] / total * e
            for b in range(3):
                self.lever_P[a][b] -= gain[a] * gain[b] / total

    def _mix(self, c: int, axis: int) -> None:
        """Mix an axis' parameters of all sets, as these change into each other, and write the prior of each set."""
        old = self.units[self.place[3 * c + axis]]
        new = self.units[self.place[UNITS - 1]]
        share = local(REAL, SETS)
        away = local(REAL, 3)
        for j in range(self.count):
            total: Real = 0.0
            for i in range(self.count):
                share[i] = self.p[c][i] * (self.stays[i] if i == j else self._rate(i, j) * self.dt)
                total += share[i]
            self.prior[j] = total
            to = new.of[j]
            reset(to)
            for i in range(self.count):
                share[i] = share[i] / max(total, TINY)
                if share[i] > 0.0:
                    for a in range(3):
                        to.mean[a] += share[i] * old.of[i].mean[a]
            for i in range(self.count):
                if share[i] > 0.0:
                    k = 0
                    for a in range(3):
                        away[a] = old.of[i].mean[a] - to.mean[a]
                    for a in range(3):
                        for b in range(a, 3):
                            to.P[k] += share[i] * (old.of[i].P[k] + away[a] * away[b])
                            k += 1
        free = self.place[UNITS - 1]
        self.place[UNITS - 1] = self.place[3 * c + axis]
        self.place[3 * c + axis] = free

    def _fit(self, v: Vehicle, c: int, h: int, thrust: Reals, spread: Reals) -> Real:
        """Log likelihood of a set; its parameters are updated, less by a residual that does not fit."""
        product: Real = 1.0
        nats: Real = 0.0
        square: Real = 0.0
        for axis in range(4):
            e: Real = 0.0
            # A rotor that may be off makes the balance uncertain even where it is: half of its share counts for every set.
            noise: Real = FLOOR[axis] * FLOOR[axis]
            for i in range(v.rotors):
                b = v.effectiveness[axis][i]
                works = (self.off[h] & (1 << i)) == 0
                e += b * thrust[i] if works else 0.0
                noise += (1.0 if works else 0.5) * b * b * spread[i]
            variance = noise
            if axis == THRUST:
                e -= real(v.rotors) * self.load
                variance += self.load_variance
            else:
                one = self.units[self.place[3 * c + axis]].of[h]
                row = self.now.rows[axis]
                turn = MOTION_SHARE * one.mean[0] * row[0]
                drag = MOTION_SHARE * one.mean[2] * row[2] if axis == YAW else 0.0
                noise += turn * turn + drag * drag
                for a in range(3):
                    e -= one.mean[a] * row[a]
                variance = _learn(one, row, e, noise, self.weight, LEAST_SHARE * real(v.rotors) * INERTIA[axis])
            wide = variance + OUTLIER_SD * OUTLIER_SD
            far = 0.5 * e * e
            # The mixture of both normal densities, with that of the outliers factored out.
            inside = (1.0 - OUTLIERS) / sqrt(variance) * exp(-far * (1.0 / variance - 1.0 / wide))
            both = OUTLIERS / sqrt(wide) + inside
            product *= sqrt(both) if axis == YAW else both
            nats -= (YAW_WEIGHT if axis == YAW else 1.0) * far / wide
            square += 0.25 * e * e / variance
        if c == self.best:
            self.square[h] = square
        return self.weight * (nats + log(product))


def sets_of(n: int) -> int:
    """Number of sets of n rotors that may be off: none, one, and so on."""
    size = 1
    total = 1
    for many in range(_most_of(n)):
        size = size * (n - many) // (many + 1)
        total += size
    return total


def _most_of(n: int) -> int:
    """How many of n rotors may be off at once."""
    return MOST if n <= MANY else MOST_OF_MANY


def _usual(n: int, axis: int, out: Parameters) -> None:
    """Parameters of any multirotor of n rotors."""
    usual = real(n) * INERTIA[axis]
    out.mean[0] = usual
    out.mean[2] = YAW_DRAG if axis == YAW else 0.0
    out.P[0] = INERTIA_SHARE * usual * INERTIA_SHARE * usual
    out.P[3] = YAW_DAMPING * YAW_DAMPING if axis == YAW else OFFSET * OFFSET
    out.P[5] = YAW_DRAG * YAW_DRAG if axis == YAW else DAMPING * DAMPING


def _thrust(demand: Real, c: int) -> Real:
    """Hover thrusts of a rotor for a demand, by a power."""
    x = max(demand, 0.0)
    return min(x if c == 0 else x * sqrt(x) if c == 1 else x * x, STRONGEST)


def _learn(one: Parameters, row: Reals, e: Real, noise: Real, weight: Real, least: Real) -> Real:
    """Update parameters by a residual e; return its variance before that. noise: of the measurement; weight: of a tick; least: inertia."""
    gain = local(REAL, 3)
    gain[0] = one.P[0] * row[0] + one.P[1] * row[1] + one.P[2] * row[2]
    gain[1] = one.P[1] * row[0] + one.P[3] * row[1] + one.P[4] * row[2]
    gain[2] = one.P[2] * row[0] + one.P[4] * row[1] + one.P[5] * row[2]
    own = gain[0] * row[0] + gain[1] * row[1] + gain[2] * row[2]
    variance = noise + own
    total = own + noise / weight * max(1.0, 0.25 * e * e / variance)
    k = 0
    for a in range(3):
        one.mean[a] += gain[a] / total * e
        for b in range(a, 3):
            one.P[k] -= gain[a] * gain[b] / total
            k += 1
    one.mean[0] = max(one.mean[0], least)
    return variance
