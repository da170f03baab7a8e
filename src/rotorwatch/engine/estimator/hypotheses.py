"""The explicit hypotheses of the default diagnoser, and the Bayes factor of each in a window of data.

For a jump nu in directions d (rotor losses and axis biases) at a given time, the filter's innovations give the information
matrix C and vector z of nu (Willsky & Jones 1976). A hypothesis allows a subset of directions; the log
Bayes factor against "no jump", with a Gaussian prior of width w on each direction and rotor losses confined to [lo, hi], is

    log BF = z.nu - nu.C.nu / 2  -  1/2 sum log(1 + C_dd|rest w^2)        at the most probable admissible nu

It is stored as BF = weight e^nats, nats = z.nu - nu.C.nu / 2, so that sums need no logarithm.

Order of the hypotheses: each rotor, each pair of rotors, recovery of each rotor, each rotor stuck at one thrust, disturbances.
"""

from __future__ import annotations

import math

from rotorwatch.base.compiling.structs import EACH, FLAG, REAL, Each, Eaches, Real, Reals, Struct, array, each, local, log, sqrt
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Window
from rotorwatch.engine.estimator.estimator_sizes import ROTORS
from rotorwatch.engine.estimator.plant import THRUST, YAW, Plant
from rotorwatch.engine.events import decisions
from rotorwatch.engine.events.losses import PAIR_WEIGHT

# Nats by which an explanation must exceed another to count as better.
CLEAR = log(decisions.CLEAR)
NONE = 0.015  # losses this small count as none
LOSS_WIDTH, SMALL_WIDTH = 0.3, 0.06
# Motors stop and propellers come off: this share of losses takes all the remaining thrust of a rotor.
TOTAL_SHARE = 0.1
# In this share of losses moving air changes thrust as well, because the vehicle has begun to climb or sink.
AIR_SHARE = 0.05
# Share by which the effect of a loss on roll, pitch, yaw and thrust may differ from geometry: inflow and battery change thrust, and
# in moving air the drag of rotors of unequal speed yaws the vehicle.
SLOP = (0.1, 0.1, 0.4, 0.3)
# FAR_SHARE of disturbances are FAR times their usual size. A flight does not show every possible external force in advance, nor how the
# vehicle will behave with a weak rotor.
FAR_SHARE, FAR = 0.2, 4.0
# Prior weights: frequency of each kind of jump relative to the failure, or recovery, of one particular rotor. Disturbances are common.
# A rotor stuck at one thrust, which ignores its command, is rarer than one that gives less thrust.
STUCK_WEIGHT, DISTURBANCE_WEIGHT = 0.1, 3.0
# Share by which the jump that ends a loss may differ from the estimated loss.
RECOVERY_SHARE = 0.3
# Least thrust of a stuck rotor, in hover thrusts; nats of an impossible hypothesis.
MORE, NOTHING = 1.25, -50.0
SERIES = tuple(1.0 / math.factorial(k) for k in range(11, -1, -1))  # Taylor series of exp, the highest power first
LEFT = -60.0  # nats below which exp is negligible
# Disturbances as bit masks of the axes that they touch: roll 1, pitch 2, yaw 4, thrust 8.
DISTURBANCES = (1, 2, 4, 8, 9, 10, 12, 7, 15)
DISTURBANCE_COUNT = 9
ALL_TORQUES = 7  # index of the first one that touches all three torques

SINGLE, PAIR, RECOVERY, ONE_THRUST, DISTURBANCE = 0, 1, 2, 3, 4  # kinds


class Asked(Struct):
    """Bounds and prior widths of one tick's hypotheses. In hover thrusts of one rotor."""

    weak: bool = False  # a rotor is known to be weak
    dead: bool = False  # a rotor is known to be totally lost
    active = array(FLAG, ROTORS)
    theta = array(REAL, ROTORS)  # known losses
    lo = array(REAL, ROTORS)  # bounds of a rotor's jump
    hi = array(REAL, ROTORS)
    width = array(REAL, 4)  # standard deviation of this aircraft's disturbances
    reach = array(REAL, ROTORS)  # largest effect of a total loss on any axis by geometry
    drag = array(REAL, ROTORS)  # effect of a total loss on yaw by the rotor's drag
    air: Real = 0.0  # variance of the thrust that vertical air motion may cause
    full: Real = 0.0  # full thrust of a rotor


class Jump(Struct):
    """Most probable jump of a hypothesis at each onset."""

    nats: Each = 0.0  # Bayes factor: weight e^nats
    weight: Each = 0.0
    size: Each = 0.0  # jump of its rotor's loss
    other_size: Each = 0.0  # jump of its other rotor's loss
    variance: Each = 0.0  # of a single rotor's size, or of `gives`
    gives: Each = 0.0  # hover thrusts that its rotor gives whatever it is commanded


class Freed(Struct):
    """Each rotor's jump alone, where its effect on the axes may differ by `slop` from geometry: Gaussian steps, integrated out. In moving
    air the thrust axis may differ by more."""

    slop = array(EACH, 4)  # variances
    own = array(EACH, 2, ROTORS)  # information on each rotor's loss, in still and in moving air
    score = array(EACH, 2, ROTORS)  # information vector (z)
    nats = array(EACH, 2)  # Bayes factor of the slop alone: weight e^nats
    weight = array(EACH, 2)
    size = array(EACH, 6)  # most probable loss of a rotor for each kind (small, large, total; in still, then in moving air)
    spread = array(EACH, 6)  # its variance
    likely = array(EACH, 6)  # weight of the kind

    def free(self, p: Plant, w: Window, a: Asked) -> None:
        """Compute it from a window. SLOP is a share of the effect that the likeliest rotor's loss would have; in yaw all of the rotor's
        drag is uncertain as well."""
        n = p.rotors
        best = each(-1e30)
        lacks = each(0.0)
        dragged = each(0.0)
        for i in range(n):
            c = w.C[FIRST_LOSS + i][FIRST_LOSS + i] + 1.0 / (LOSS_WIDTH * LOSS_WIDTH)
            z = w.z[FIRST_LOSS + i]
            nu = min(max(z / c, a.lo[i]), a.hi[i])
            fit = z * nu - 0.5 * c * nu * nu
            lacks = abs(nu * a.reach[i]) if fit > best else lacks
            dragged = abs(nu * a.drag[i]) if fit > best else dragged
            best = max(best, fit)
        for axis in range(4):
            self.slop[axis] = SLOP[axis] * lacks * (SLOP[axis] * lacks) + 1e-12
        self.slop[YAW] += dragged * dragged
        among = local(EACH, 4, 4)
        cross = local(EACH, 4, ROTORS)
        step = local(EACH, 4)
        for axis in range(4):
            step[axis] = w.z[axis]
            for other in range(4):
                among[axis][other] = w.C[axis][other]
            for i in range(n):
                cross[axis][i] = w.C[axis][FIRST_LOSS + i]
        own = local(EACH, ROTORS)
        score = local(EACH, ROTORS)
        for i in range(n):
            own[i] = w.C[FIRST_LOSS + i][FIRST_LOSS + i]
            score[i] = w.z[FIRST_LOSS + i]
        gain = each(0.0)
        grown = each(1.0)
        for axis in range(THRUST):
            more = among[axis][axis] * self.slop[axis] + 1.0
            inverse = self.slop[axis] / more
            gain += 0.5 * step[axis] * step[axis] * inverse
            grown *= more
            for i in range(n):
                share = cross[axis][i] * inverse
                own[i] -= cross[axis][i] * share
                score[i] -= share * step[axis]
                for other in range(axis + 1, 4):
                    cross[other][i] -= share * among[axis][other]
            for other in range(axis + 1, 4):
                share = among[axis][other] * inverse
                step[other] -= share * step[axis]
                for last in range(axis + 1, 4):
                    among[other][last] -= share * among[axis][last]
        for moving in range(2):
            prior = self.slop[THRUST] + (a.air if moving == 1 else 0.0)
            more = among[THRUST][THRUST] * prior + 1.0
            inverse = prior / more
            self.nats[moving] = gain + 0.5 * step[THRUST] * step[THRUST] * inverse
            self.weight[moving] = 1.0 / sqrt(grown * more)
            for i in range(n):
                share = cross[THRUST][i] * inverse
                self.own[moving][i] = own[i] - cross[THRUST][i] * share
                self.score[moving][i] = score[i] - share * step[THRUST]

    def weigh(self, a: Asked, i: int, out: Jump) -> None:
        """Bayes factor of a loss of rotor i alone. Losses are small as often as large, and occasionally total; each kind may come in moving
        air."""
        fit = local(EACH, 6)
        most = each(-1e30)
        for k in range(6):
            kind = k % 3
            moving = k // 3
            mean = a.hi[i] if kind == 2 else 0.0
            width = SMALL_WIDTH if kind == 0 else LOSS_WIDTH if kind == 1 else NONE
            share = TOTAL_SHARE if kind == 2 else 0.5 * (1.0 - TOTAL_SHARE)
            c = self.own[moving][i]
            z = self.score[moving][i]
            shrinks = 1.0 / (c * (width * width) + 1.0)
            self.spread[k] = width * width * shrinks
            size = min(max((z * (width * width) + mean) * shrinks, a.lo[i]), a.hi[i])
            away = size - mean
            self.size[k] = size
            fit[k] = z * size - 0.5 * c * size * size - 0.5 * away * away / (width * width) + self.nats[moving]
            share *= AIR_SHARE if moving == 1 else 1.0 - AIR_SHARE
            self.likely[k] = share * self.weight[moving] * sqrt(shrinks)
            most = max(most, fit[k])
        out.nats = most
        out.weight = each(0.0)
        for k in range(6):
            self.likely[k] *= vanishing(fit[k] - most)
            out.weight += self.likely[k]

    def loss(self, a: Asked, i: int, out: Jump) -> None:
        """Bayes factor of a loss of rotor i alone, with mean and variance of the loss over all its kinds."""
        self.weigh(a, i, out)
        out.size = each(0.0)
        out.other_size = each(0.0)
        out.gives = each(0.0)
        out.variance = each(0.0)
        for k in range(6):
            out.size += self.likely[k] * self.size[k] / out.weight
        for k in range(6):
            away = self.size[k] - out.size
            out.variance += self.likely[k] / out.weight * (self.spread[k] + away * away)

    def recovery(self, i: int, target: Each, out: Jump) -> None:
        """Recovery of rotor i: the jump `target` that ends its loss, within RECOVERY_SHARE of it, and never a further loss."""
        variance = recovery_variance(target)
        c = self.own[0][i]
        z = self.score[0][i]
        left = c + 1.0 / variance
        size = min((z + target / variance) / left, 0.0)
        out.size = size
        out.other_size = each(0.0)
        out.gives = each(0.0)
        out.variance = 1.0 / left
        away = size - target
        out.nats = z * size - 0.5 * c * size * size - 0.5 * away * away / variance + self.nats[0]
        out.weight = self.weight[0] / sqrt(left * variance)


def vanishing(nats: Each) -> Each:
    """exp(nats) for nats <= 0 to a relative error of 1e-13, by products that vectorise: the Taylor series of exp(nats / 256), squared eight
    times."""
    root = max(nats, LEFT) * (1.0 / 256.0)
    square = root * root
    odd = each(SERIES[0])  # odd and even powers in two parallel Horner schemes
    even = each(SERIES[1])
    for k in range(1, 6):
        odd = odd * square + SERIES[2 * k]
        even = even * square + SERIES[2 * k + 1]
    share = odd * root + even
    for _ in range(8):
        share *= share
    return share


def recovery_variance(target: Each) -> Each:
    """Variance of the jump `target` that ends a loss."""
    return NONE * NONE + RECOVERY_SHARE * RECOVERY_SHARE * target * target


def pair(w: Window, a: Asked, i: int, j: int, out: Jump) -> None:
    """Bayes factor of losses of rotors i and j. Two rotors fit chance better than one, so their effect must follow geometry exactly (no
    slop). Most probable sizes inside the box: the interior solution, else the best point on an edge that it lies beyond."""
    precision = 1.0 / (LOSS_WIDTH * LOSS_WIDTH)
    c11 = w.C[FIRST_LOSS + i][FIRST_LOSS + i] + precision
    c22 = w.C[FIRST_LOSS + j][FIRST_LOSS + j] + precision
    c12 = w.C[FIRST_LOSS + i][FIRST_LOSS + j]
    z1 = w.z[FIRST_LOSS + i]
    z2 = w.z[FIRST_LOSS + j]
    det = c11 * c22 - c12 * c12
    least = 1e-12 * c11 * c22
    det = det if det > least else least + 1e-30
    first = (c22 * z1 - c12 * z2) / det
    second = (c11 * z2 - c12 * z1) / det
    nearest = min(max(first, a.lo[i]), a.hi[i])
    other = min(max(second, a.lo[j]), a.hi[j])
    two = min(max((z2 - c12 * nearest) / c22, a.lo[j]), a.hi[j]) if nearest < first or nearest > first else other
    score = z1 * nearest + z2 * two - 0.5 * (c11 * nearest * nearest + 2.0 * c12 * nearest * two + c22 * two * two)
    edge = min(max((z1 - c12 * other) / c11, a.lo[i]), a.hi[i])
    beyond = z1 * edge + z2 * other - 0.5 * (c11 * edge * edge + 2.0 * c12 * edge * other + c22 * other * other)
    beyond = beyond if other < second or other > second else each(-1e30)
    out.size = edge if beyond > score else nearest
    out.other_size = other if beyond > score else two
    out.variance = each(0.0)
    out.gives = each(0.0)
    out.nats = max(score, beyond)
    out.weight = precision / sqrt(max(c11 * c22 - c12 * c12, 1e-9))


def one_thrust(p: Plant, w: Window, a: Asked, i: int, out: Jump) -> None:
    """Bayes factor of rotor i stuck at one thrust between MORE and full, whatever it is commanded: a jump of hi removes the command's
    effect and a step of the axes along the rotor's column of -B replaces it."""
    c = each(0.0)
    cross = each(0.0)
    left = each(0.0)
    for axis in range(4):
        effect = -p.effect[axis][i]
        row = w.C[axis]
        for other in range(4):
            c -= effect * row[other] * p.effect[other][i]
        cross += effect * row[FIRST_LOSS + i]
        left += effect * w.z[axis]
    z = w.z[FIRST_LOSS + i]
    hi = a.hi[i]
    left -= cross * hi
    mean = 0.5 * (1.0 + a.full)
    variance = 0.25 * (a.full - 1.0) * (a.full - 1.0) + 1e-6
    total = c + 1.0 / variance
    thrust = min(max((left + mean / variance) / total, 0.0), a.full)
    out.size = each(hi)
    out.other_size = each(0.0)
    out.gives = thrust
    out.variance = 1.0 / total
    away = thrust - mean
    out.nats = left * thrust - 0.5 * c * thrust * thrust - 0.5 * away * away / variance
    out.nats += z * hi - 0.5 * w.C[FIRST_LOSS + i][FIRST_LOSS + i] * hi * hi
    out.weight = 1.0 / sqrt(total * variance) if thrust > MORE else 0.0


def steps(w: Window, width: Reals, far: Real, first: int, nats: Eaches, weight: Eaches) -> None:
    """Bayes factors of the disturbances from `first` on (0 or ALL_TORQUES): steps of the axes' biases with a standard deviation of `far`
    times `width`."""
    prior = local(REAL, 4)
    for axis in range(4):
        prior[axis] = far * far * width[axis] * width[axis]
    if first == 0:  # one axis; one torque with thrust
        shrinks4 = 1.0 / (w.C[THRUST][THRUST] * prior[THRUST] + 1.0)
        inverse4 = prior[THRUST] * shrinks4
        fit4 = 0.5 * w.z[THRUST] * w.z[THRUST] * inverse4
        nats[THRUST] = fit4
        weight[THRUST] = sqrt(shrinks4)
        for axis in range(THRUST):
            c = w.C[axis][axis]
            z = w.z[axis]
            shrinks = 1.0 / (c * prior[axis] + 1.0)
            nats[axis] = 0.5 * z * z * prior[axis] * shrinks
            weight[axis] = sqrt(shrinks)
            share = w.C[axis][THRUST] * inverse4
            rest = z - share * w.z[THRUST]
            shrinks = 1.0 / ((c - share * w.C[axis][THRUST]) * prior[axis] + 1.0)
            nats[4 + axis] = fit4 + 0.5 * rest * rest * prior[axis] * shrinks
            weight[4 + axis] = sqrt(shrinks4 * shrinks)
    # All torques; all axes.
    among = local(EACH, 4, 4)
    step = local(EACH, 4)
    for axis in range(4):
        step[axis] = w.z[axis]
        for other in range(4):
            among[axis][other] = w.C[axis][other]
    fit = each(0.0)
    grown = each(1.0)
    for axis in range(4):
        more = among[axis][axis] * prior[axis] + 1.0
        inverse = prior[axis] / more
        fit += 0.5 * step[axis] * step[axis] * inverse
        grown *= more
        for other in range(axis + 1, 4):
            share = among[axis][other] * inverse
            step[other] -= share * step[axis]
            for last in range(axis + 1, 4):
                among[other][last] -= share * among[axis][last]
        if axis == YAW:
            nats[7] = fit
            weight[7] = 1.0 / sqrt(grown)
    nats[8] = fit
    weight[8] = 1.0 / sqrt(grown)


def pair_count(n: int) -> int:
    """Number of pairs of n rotors."""
    return n * (n - 1) // 2


def hypothesis_count(n: int) -> int:
    """Number of hypotheses for n rotors."""
    return 3 * n + pair_count(n) + DISTURBANCE_COUNT


def kind_of(n: int, h: int) -> int:
    """Kind of hypothesis h: SINGLE, PAIR, RECOVERY, ONE_THRUST or DISTURBANCE."""
    if h < n:
        return SINGLE
    if h < n + pair_count(n):
        return PAIR
    if h < 2 * n + pair_count(n):
        return RECOVERY
    return ONE_THRUST if h < 3 * n + pair_count(n) else DISTURBANCE


def rotor_of(n: int, h: int) -> int:
    """First or only rotor of a hypothesis, -1 for a disturbance."""
    kind = kind_of(n, h)
    if kind == SINGLE:
        return h
    if kind == PAIR:
        left = h - n
        i = 0
        while left >= n - 1 - i:
            left -= n - 1 - i
            i += 1
        return i
    return -1 if kind == DISTURBANCE else (h - pair_count(n)) % n


def other_rotor_of(n: int, h: int) -> int:
    """Second rotor of a pair, -1 for other kinds."""
    if kind_of(n, h) != PAIR:
        return -1
    left = h - n
    i = 0
    while left >= n - 1 - i:
        left -= n - 1 - i
        i += 1
    return i + 1 + left


def weight_of(kind: int) -> Real:
    """Prior weight of a hypothesis of this kind."""
    return PAIR_WEIGHT if kind == PAIR else STUCK_WEIGHT if kind == ONE_THRUST else DISTURBANCE_WEIGHT if kind == DISTURBANCE else 1.0
