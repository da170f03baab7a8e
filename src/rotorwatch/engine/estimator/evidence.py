"""Evidence for each kind of jump: the sum over all onset times of the bank, and the most probable onset.

With prior weights p_h, and onsets equally likely at any tick, the evidence of a hypothesis h is the sum over the slots w of the bank,

    log sum_w BF_wh p_h stride_w

and that of a fault is the sum over all fault hypotheses: the Shiryaev-Roberts statistic (Pollak, Ann. Statist. 13, 1985). For the most
probable onset and size of a hypothesis, `shift` gives the jump with which the state of a filter augmented by it is computed.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (
    EACH,
    LANES,
    REAL,
    SMALL,
    Each,
    Real,
    Reals,
    Struct,
    array,
    each,
    embedded,
    exp,
    local,
    log,
    one,
    real,
    reset,
    sqrt,
)
from rotorwatch.engine.estimator import hypotheses
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Bank, Slots, Window
from rotorwatch.engine.estimator.estimator_sizes import DIRECTIONS, HYPOTHESES, ROTORS, SLOTS
from rotorwatch.engine.estimator.hypotheses import (
    ALL_TORQUES,
    CLEAR,
    DISTURBANCE,
    DISTURBANCE_COUNT,
    DISTURBANCE_WEIGHT,
    DISTURBANCES,
    FAR,
    FAR_SHARE,
    LOSS_WIDTH,
    NONE,
    NOTHING,
    ONE_THRUST,
    PAIR,
    RECOVERY,
    SINGLE,
    Asked,
    Freed,
    Jump,
    hypothesis_count,
    kind_of,
    other_rotor_of,
    recovery_variance,
    rotor_of,
    vanishing,
    weight_of,
)
from rotorwatch.engine.estimator.kalman import Branch
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import ANSWER_S, THETA, THRUST, Plant
from rotorwatch.engine.events.decisions import TOTAL_LOSS

DISTURBANCE_SCALE, DISTURBANCE_LEAST, DISTURBANCE_MOST = 3.0, 0.03, 1.0


class Best(Struct):
    """A hypothesis at its most probable onset."""

    hypothesis: int = 0
    slot: int = 0
    since: Real = 0.0  # ticks since the onset
    kind: int = 0
    rotor: int = -1
    other: int = -1
    size: Real = 0.0  # jump of the loss of `rotor`
    other_size: Real = 0.0  # jump of the loss of `other`
    variance: Real = 0.0  # of a single rotor's size, or of `gives`
    gives: Real = 0.0  # hover thrusts that its rotor gives whatever it is commanded, 0 if it follows

    def size_of(self, rotor: int) -> Real:
        """Size of the jump of a rotor."""
        return self.size if rotor == self.rotor else self.other_size if rotor == self.other else 0.0


class Shift(Struct):
    """A jump in all directions of the bank: most probable size and its covariance. A: workspace."""

    size = array(REAL, DIRECTIONS)
    cov = array(REAL, DIRECTIONS, DIRECTIONS)
    A = array(REAL, 6, 6)


class Evidence(Struct):
    """Evidence of all onsets for all hypotheses."""

    asked = embedded(Asked)
    yaw_error: Real = 0.0  # variance of the yaw gain
    damping_error: Real = 0.0  # variance of the roll and pitch damping
    nats = array(EACH, HYPOTHESES)  # Bayes factors of the pack in process: weight e^nats
    weight = array(EACH, HYPOTHESES)
    top = array(REAL, HYPOTHESES)  # largest nats of all slots
    total = array(REAL, HYPOTHESES)  # sum of weight e^nats over all slots, relative to e^top
    peak = array(REAL, HYPOTHESES)  # largest term of that sum, relative to e^top
    place = array(SMALL, HYPOTHESES)  # the first slot with that term
    # The largest Bayes factor of each disturbance at sudden and at gradual onsets, relative to e^top.
    loud = array(REAL, 2, DISTURBANCE_COUNT)
    odds = array(REAL, HYPOTHESES)  # log evidence over all onsets
    probability = array(REAL, HYPOTHESES)  # among faults
    known = array(REAL, ROTORS)  # largest information on each rotor's jump alone
    fault: Real = 0.0  # log of the sum over all faults
    other: Real = 0.0  # log of the sum over all disturbances
    far: Real = 0.0  # log of the sum over disturbances much larger than is usual in this flight
    far_sum: Real = 0.0  # that sum relative to exp(far) while it accumulates
    far_nats = array(EACH, DISTURBANCE_COUNT)  # nats and weight of these large disturbances
    far_weight = array(EACH, DISTURBANCE_COUNT)
    first: int = 0  # hypothesis of the likeliest fault
    live: int = 0  # the first slot in use, else 0
    window = embedded(Window)
    freed = embedded(Freed)
    jump = embedded(Jump)

    def ask(self, p: Plant, leader: Branch, noise: Noise, thrust: Reals, drag: Reals, air: Real, outside: Real, full: Real) -> None:
        """Set bounds and prior widths of this tick's hypotheses, and clear the sums. thrust, drag: of each rotor; air: thrust that air from
        below adds; outside: wrench that an external side force may cause; full: full thrust of a rotor. In hover thrusts of one rotor."""
        a = self.asked
        a.weak = False
        a.dead = False
        for i in range(p.rotors):
            theta = leader.s[THETA + i]
            a.active[i] = leader.active[i]
            a.theta[i] = theta
            # A known loss may be reversed; the jump includes the part of this that the filter has absorbed already.
            a.lo[i] = -1.0 if leader.active[i] else 0.0
            a.hi[i] = max(1.0 - theta, 0.0)
            a.weak = a.weak or leader.active[i]
            a.dead = a.dead or (leader.active[i] and theta > TOTAL_LOSS)
            most = 0.0
            for axis in range(4):
                most = max(most, abs(p.effect[axis][i]))
            a.reach[i] = most * thrust[i]
            a.drag[i] = drag[i]
        a.air = air * air
        a.full = full
        for axis in range(4):
            width = min(max(DISTURBANCE_SCALE * sqrt(noise.spread(axis)), DISTURBANCE_LEAST), DISTURBANCE_MOST)
            # Moving air changes thrust, and a side force turns the vehicle at a lever arm as long as the vehicle's own, without any fault
            # of a rotor.
            moved = air * air if axis == THRUST else 0.0
            a.width[axis] = sqrt(width * width + outside * outside + moved)

        self.live = -1
        self.far = NOTHING
        self.far_sum = 1.0
        for i in range(p.rotors):
            self.known[i] = 0.0
        for b in range(DISTURBANCE_COUNT):
            self.loud[0][b] = 0.0
            self.loud[1][b] = 0.0
        for h in range(hypothesis_count(p.rotors)):
            self.top[h] = NOTHING
            self.total[h] = 1.0
            self.peak[h] = 0.0
            self.place[h] = 0

    def look(self, p: Plant, bank: Bank, first: int, last: int) -> None:
        """Add the evidence of packs `first` to `last` - 1."""
        for k in range(first, last):
            pack = bank.packs[k]
            if not pack.used():
                continue
            self._weigh(p, pack)
            self._add(p, k * LANES, pack)

    def gather(self, p: Plant) -> None:
        """Log evidence of all hypotheses, after all packs have been added."""
        for h in range(hypothesis_count(p.rotors)):
            self.odds[h] = self.top[h] + log(self.total[h] * weight_of(kind_of(p.rotors, h)))
        self.live = max(self.live, 0)
        self.far += log(self.far_sum * FAR_SHARE * DISTURBANCE_WEIGHT)
        self._prior(p)
        self._sum(p)

    def _weigh(self, p: Plant, slots: Slots) -> None:
        """Bayes factors of all hypotheses at the onsets of one pack."""
        n = p.rotors
        self.window.reduce(p, slots, self.yaw_error, self.damping_error)
        self.freed.free(p, self.window, self.asked)
        for i in range(n):
            self.freed.weigh(self.asked, i, self.jump)
            self._put(i, self.jump)
        h = n
        for i in range(n):
            for j in range(i + 1, n):
                hypotheses.pair(self.window, self.asked, i, j, self.jump)
                self._put(h, self.jump)
                h += 1
        for i in range(n):
            self.weight[h] = each(0.0)
            if self.asked.active[i]:
                self.freed.recovery(i, self._target(p, slots, i), self.jump)
                self._put(h, self.jump)
            self.weight[h + n] = each(0.0)
            if self.asked.active[i] or not self.asked.weak:
                hypotheses.one_thrust(p, self.window, self.asked, i, self.jump)
                self._put(h + n, self.jump)
            h += 1
        nats = local(EACH, DISTURBANCE_COUNT)
        weight = local(EACH, DISTURBANCE_COUNT)
        hypotheses.steps(self.window, self.asked.width, 1.0, 0, nats, weight)
        for b in range(DISTURBANCE_COUNT):
            self.nats[h + n + b] = nats[b]
            self.weight[h + n + b] = weight[b]
        hypotheses.steps(self.window, self.asked.width, FAR, self._first_far(), self.far_nats, self.far_weight)

    def _add(self, p: Plant, first: int, slots: Slots) -> None:
        """Add the Bayes factors of a pack, whose first slot is `first`, to the sums."""
        faults = hypothesis_count(p.rotors) - DISTURBANCE_COUNT
        loud = self.loud[1 if slots.gradual else 0]
        for lane in range(LANES):
            if one(slots.age, lane) >= 0.0:
                self.live = first + lane if self.live < 0 else self.live
                for i in range(p.rotors):
                    self.known[i] = max(self.known[i], one(self.window.C[FIRST_LOSS + i][FIRST_LOSS + i], lane))
        for h in range(faults + DISTURBANCE_COUNT):
            weight = self.weight[h] if slots.age >= 0.0 else each(0.0)
            share = vanishing(self.nats[h] - self.top[h])
            for lane in range(LANES):
                if one(weight, lane) <= 0.0:
                    continue
                if one(self.nats[h], lane) > self.top[h]:
                    self._rise(h, faults, one(self.nats[h], lane))
                    share = vanishing(self.nats[h] - self.top[h])
                factor = one(weight, lane) * one(share, lane)
                reported = slots.stride * factor
                self.total[h] += reported
                if reported > self.peak[h]:
                    self.peak[h] = reported
                    self.place[h] = first + lane
                if h >= faults:
                    loud[h - faults] = max(loud[h - faults], factor)
        for b in range(self._first_far(), DISTURBANCE_COUNT):
            weight = self.far_weight[b] if slots.age >= 0.0 else each(0.0)
            share = vanishing(self.far_nats[b] - self.far)
            for lane in range(LANES):
                if one(weight, lane) <= 0.0:
                    continue
                if one(self.far_nats[b], lane) > self.far:
                    self.far_sum *= exp(self.far - one(self.far_nats[b], lane))
                    self.far = one(self.far_nats[b], lane)
                    share = vanishing(self.far_nats[b] - self.far)
                self.far_sum += slots.stride * one(weight, lane) * one(share, lane)

    def _rise(self, h: int, faults: int, nats: Real) -> None:
        """Rescale the sums of a hypothesis to a new largest value of nats."""
        less = exp(self.top[h] - nats)
        self.top[h] = nats
        self.total[h] *= less
        self.peak[h] *= less
        if h >= faults:
            self.loud[0][h - faults] *= less
            self.loud[1][h - faults] *= less

    def _first_far(self) -> int:
        """First disturbance that may be unusually large. Without a weak rotor these are only the ones that touch all torques, as a large
        step of one axis has no rotor's direction."""
        return 0 if self.asked.weak else ALL_TORQUES

    def disturbed(self, p: Plant, gradual: bool) -> Real:
        """Largest log Bayes factor of a disturbance at any sudden, or any gradual onset."""
        faults = hypothesis_count(p.rotors) - DISTURBANCE_COUNT
        loud = self.loud[1 if gradual else 0]
        most = NOTHING
        for b in range(DISTURBANCE_COUNT):
            if loud[b] > 0.0:
                most = max(most, self.top[faults + b] + log(loud[b]))
        return most

    def _put(self, h: int, jump: Jump) -> None:
        self.nats[h] = jump.nats
        self.weight[h] = jump.weight

    def _target(self, p: Plant, slots: Slots, i: int) -> Each:
        """Size of the jump that ends the known loss of rotor i: -theta over the share of a unit jump that the filter has not absorbed,
        including the part of a gradual jump still to come."""
        to_come = each(0.0)
        if slots.gradual:
            to_come = exp(-p.dt / ANSWER_S * (slots.age + 1.0))
        return -self.asked.theta[i] / max(slots.M[THETA + i][FIRST_LOSS + i] + to_come, 0.3)

    def barred(self, n: int, h: int) -> bool:
        """Whether a fault hypothesis is excluded, given the rotors known to be weak. With a rotor totally lost the vehicle flies at its
        limits and the others look weak: two further losses at once are excluded. Beside a weak rotor, another rotor stuck at one thrust is
        excluded. Recovery is excluded for rotors that are not weak."""
        kind = kind_of(n, h)
        fresh = self._fresh(n, h)
        if self.asked.dead and fresh > 1:
            return True
        return fresh > 0 and (kind == RECOVERY or (kind == ONE_THRUST and self.asked.weak))

    def _fresh(self, n: int, h: int) -> int:
        """Number of rotors in a hypothesis that are not known to be weak."""
        rotor = rotor_of(n, h)
        other = other_rotor_of(n, h)
        count = 0
        if rotor >= 0 and not self.asked.active[rotor]:
            count += 1
        if other >= 0 and not self.asked.active[other]:
            count += 1
        return count

    def _prior(self, p: Plant) -> None:
        """Add log priors: a rotor that has failed is likely to change again, another rotor is less likely to fail, and far less so when one
        is totally lost."""
        n = p.rotors
        another = -3.0 * CLEAR if self.asked.dead else -CLEAR if self.asked.weak else 0.0
        for h in range(hypothesis_count(n) - DISTURBANCE_COUNT):
            if self.barred(n, h):
                self.odds[h] = 2.0 * NOTHING + log(real(SLOTS))
            else:
                self.odds[h] += CLEAR if self._fresh(n, h) == 0 else another

    def _sum(self, p: Plant) -> None:
        count = hypothesis_count(p.rotors)
        faults = count - DISTURBANCE_COUNT
        self.first = 0
        best = self.odds[0]
        least = self.odds[faults]
        for h in range(faults):
            if self.odds[h] > best:
                best = self.odds[h]
                self.first = h
        for h in range(faults, count):
            least = max(least, self.odds[h])
        total = 0.0
        for h in range(count):
            self.probability[h] = exp(self.odds[h] - best) if h < faults else 0.0
            total += self.probability[h]
        for h in range(faults):
            self.probability[h] /= total
        self.fault = best + log(total)
        total = 0.0
        for h in range(faults, count):
            total += exp(self.odds[h] - least)
        self.other = least + log(total)

    def pick(self, p: Plant, bank: Bank, h: int, out: Best) -> None:
        """Fill `out` with hypothesis h at its most probable onset."""
        n = p.rotors
        out.hypothesis = h
        out.kind = kind_of(n, h)
        out.rotor = rotor_of(n, h)
        out.other = other_rotor_of(n, h)
        out.slot = self.live
        if bank.age(self.live) >= 0.0 and (out.kind == DISTURBANCE or not self.barred(n, h)):
            out.slot = self.place[h]
        slots = bank.packs[out.slot // LANES]
        lane = out.slot % LANES
        out.since = bank.age(out.slot) + 1.0
        jump = self.jump
        reset(jump)
        if out.since > 0.0:
            self.window.reduce(p, slots, self.yaw_error, self.damping_error)
            self.freed.free(p, self.window, self.asked)
            if out.kind == SINGLE:
                self.freed.loss(self.asked, out.rotor, jump)
            elif out.kind == PAIR:
                hypotheses.pair(self.window, self.asked, out.rotor, out.other, jump)
            elif out.kind == RECOVERY:
                target = self._target(p, slots, out.rotor) if self.asked.active[out.rotor] else each(0.0)
                self.freed.recovery(out.rotor, target, jump)
            elif out.kind == ONE_THRUST:
                hypotheses.one_thrust(p, self.window, self.asked, out.rotor, jump)
        out.size = one(jump.size, lane)
        out.other_size = one(jump.other_size, lane)
        out.variance = one(jump.variance, lane)
        out.gives = one(jump.gives, lane)

    def detectable(self, i: int) -> Real:
        """Standard deviation with which a loss of rotor i would be measured now."""
        return 1.0 / sqrt(self.known[i] + 1.0 / (LOSS_WIDTH * LOSS_WIDTH))

    def shift(self, p: Plant, bank: Bank, best: Best, out: Shift) -> None:
        """Size and covariance of a jump in all directions; call `pick` for the same `best` first. The error of the geometry (slop) widens
        the covariance of a loss but is not attributed to a disturbance."""
        w = self.window
        lane = best.slot % LANES
        reset(out)
        if best.kind == DISTURBANCE:
            steps = int(DISTURBANCES[best.hypothesis - hypothesis_count(p.rotors) + DISTURBANCE_COUNT])
            for a in range(4):
                wide = FAR * self.asked.width[a] if (steps >> a) & 1 == 1 else 0.0
                for b in range(4):
                    out.A[a][b] = one(w.C[a][b], lane)
                out.A[a][a] += 1.0 / (wide * wide + 1e-12)
            invert(out, 4)
            for a in range(4):
                if (steps >> a) & 1 == 1:
                    for b in range(4):
                        out.size[a] += out.A[a][b] * one(w.z[b], lane)
                        out.cov[a][b] = out.A[a][b] if (steps >> b) & 1 == 1 else 0.0
            return
        rotor = FIRST_LOSS + best.rotor
        other = FIRST_LOSS + best.other
        out.size[rotor] = best.size
        if best.kind == SINGLE:
            out.cov[rotor][rotor] = best.variance
        elif best.kind == ONE_THRUST:
            out.cov[rotor][rotor] = NONE * NONE
            for a in range(4):  # thrust that it gives instead of its command
                out.size[a] = -p.effect[a][best.rotor] * best.gives
                for b in range(4):
                    out.cov[a][b] = best.variance * p.effect[a][best.rotor] * p.effect[b][best.rotor]
        else:
            variance = LOSS_WIDTH * LOSS_WIDTH
            if best.kind == RECOVERY:
                active = self.asked.active[best.rotor]
                target = self._target(p, bank.packs[best.slot // LANES], best.rotor) if active else each(0.0)
                variance = one(recovery_variance(target), lane)
            for a in range(4):
                for b in range(4):
                    out.A[a][b] = one(w.C[a][b], lane)
                out.A[a][a] += 1.0 / (one(self.freed.slop[a], lane) + 1e-12)
                out.A[a][4] = one(w.C[a][rotor], lane)
                out.A[4][a] = one(w.C[a][rotor], lane)
            out.A[4][4] = one(w.C[rotor][rotor], lane) + 1.0 / variance
            if best.kind == PAIR:
                for a in range(4):
                    out.A[a][5] = one(w.C[a][other], lane)
                    out.A[5][a] = one(w.C[a][other], lane)
                out.A[4][5] = one(w.C[rotor][other], lane)
                out.A[5][4] = one(w.C[rotor][other], lane)
                out.A[5][5] = one(w.C[other][other], lane) + 1.0 / variance
                invert(out, 6)
                out.size[other] = best.other_size
                out.cov[rotor][other] = out.A[4][5]
                out.cov[other][rotor] = out.A[4][5]
                out.cov[other][other] = out.A[5][5]
            else:
                invert(out, 5)
            out.cov[rotor][rotor] = out.A[4][4]


def invert(it: Shift, k: int) -> None:
    """Invert the first k rows and columns of A, symmetric and positive definite, in place."""
    for d in range(k):
        row = it.A[d]
        pivot = 1.0 / row[d]
        row[d] = 1.0
        for c in range(k):
            row[c] *= pivot
        for r in range(k):
            if r != d:
                to = it.A[r]
                share = to[d]
                to[d] = 0.0
                for c in range(k):
                    to[c] -= share * row[c]
