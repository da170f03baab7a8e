"""Results of the trim analysis: a loss that grew, or was reported as over and persists, and a mount that turned.

The estimator reports steps of one rotor. Where it reported that a step is over, the trim after it tests that: a loss that is over leaves
no trace.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, SMALL, TIME, Real, Small, Struct, Time, array, copy, exp, local, log, real, sqrt
from rotorwatch.base.medians import median
from rotorwatch.engine.drift.drift_sizes import AMOUNTS_EACH, AMOUNTS_TURNED, BLOCKS, LOSSES_EACH
from rotorwatch.engine.drift.stretch import Stretch
from rotorwatch.engine.drift.weighing import AMOUNTS, GROWS_S, NEVER, RATIO, SIZES, Sum, Weighing
from rotorwatch.engine.estimator.plant import USUAL_S
from rotorwatch.engine.events.decisions import CLEAR, CREDIBLE, WORN
from rotorwatch.engine.events.events import GREW, LOSS, STAYS, TURNED_MOUNT, Event, put
from rotorwatch.engine.events.losses import CURVE_SHARE, WITHIN_95, sd_of
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS

LATER = 3  # blocks after a loss, at least, needed to test whether it is over
LASTING = 0.5  # remaining share of a loss that is not over
BEGUN = 0.95  # probability of having begun by the reported time
CURVE_SD = 0.12  # standard deviation of expo that makes a curve steeper by CURVE_SHARE
LEAST_SHARE = 0.1  # of the mean thrust: a rotor commanded less carries no information
MOST_NATS = 27.0  # limit of odds


class Growth(Struct):
    """A loss that has grown, or a step; count 0: none. It lasts to the end of the flight and is more probable than everything else.

    rotors: candidates, the most probable first; start: since when it has exceeded WORN, s; end: when it ceased to grow, or was last seen;
    loss, lower, upper: of each, at the end; odds: of the most probable rotor, to everything else; looked: time of the last look; grew: it
    is not a step. time, lost: of each block, of the most probable rotor.
    """

    rotors = array(SMALL, ROTORS)
    loss = array(REAL, ROTORS)
    lower = array(REAL, ROTORS)
    upper = array(REAL, ROTORS)
    time = array(TIME, BLOCKS)
    lost = array(REAL, BLOCKS)
    start: Time = 0.0
    end: Time = 0.0
    looked: Time = 0.0
    odds: Real = 0.0
    count: Small = 0
    blocks: Small = 0
    grew: bool = False

    def find(self, v: Vehicle, stretch: Stretch, w: Weighing, turned: Real) -> None:
        """Find it in the weighed trim. turned: log-odds of a turned mount."""
        self.count = 0
        best = 0
        for i in range(v.rotors):
            if w.rotor[i] > w.rotor[best]:
                best = i
        others = Sum()
        others.add(turned, 1.0)
        others.add(w.other(), 1.0)
        for i in range(v.rotors):
            if i != best:
                others.add(w.rotor[i], 1.0)
        self.odds = exp(min(w.rotor[best] - others.log(), MOST_NATS))
        if self.odds < 1.0:
            return
        self.grew = w.either_way(best, 1) > w.either_way(best, 0)
        grows = 1 if self.grew else 0
        for i in range(v.rotors):
            if w.rotor[i] > w.rotor[best] + log(real(CREDIBLE)):
                place = int(self.count)
                while place > 0 and w.rotor[self.rotors[place - 1]] < w.rotor[i]:
                    self.rotors[place] = self.rotors[place - 1]
                    place -= 1
                self.rotors[place] = i
                self.count += 1
        for k in range(self.count):
            self._size(v, w, k, grows)
        if self.loss[0] < WORN:
            self.count = 0
            return
        start = stretch.time(_quantile(stretch, w, best, grows, False))
        end = stretch.time(_quantile(stretch, w, best, grows, True))
        self.looked = stretch.last
        self.start = start + (end - start) * min(WORN / self.loss[0], 1.0)
        self.end = min(end, self.looked)
        self._follow(v, stretch, best, start)

    def left(self, after: Time) -> Real:
        """Loss shown by the trim after a time, s; 0 with too few blocks after it."""
        later = local(REAL, BLOCKS)
        count = 0
        for i in range(self.blocks):
            if self.time[i] > after:
                later[count] = self.lost[i]
                count += 1
        return 0.0 if count < LATER else median(later, count)

    def certain(self) -> bool:
        """Return whether it is certainly of one single rotor."""
        return self.count == 1 and self.odds > CLEAR

    def join(self, losses: list[Event], count: int, room: int) -> int:
        """Merge this loss, if certain, into the losses of a flight, in the order in which they were detected; return their number.
        losses: with a `source` each, changed in place; room: their capacity.

        A loss that grew is an event; losses announced within it are its beginning. Losses of its rotor reported as over, though the trim
        still shows them, become one that lasts. Beside certain losses of other rotors, of which the trim is not corrected, nothing is
        reported. The `source` of the new loss is that of the first loss merged into it, -1 without.
        """
        if not self.certain():
            return count
        one = Event()
        mask = 1 << self.rotors[0]
        own = 0
        over = 0
        last: Time = -LASTS
        first: Time = LASTS
        detected: Time = LASTS
        step = False
        one.source = -1
        for i in range(count):
            e = losses[i]
            if e.accuses() and not e.may_be(mask):
                return count
            if e.accuses():
                own += 1
                if one.source < 0:
                    one.source = e.source
                first = min(first, e.onset)
                detected = min(detected, e.detected)
                if e.end < LASTS:
                    over += 1
                    last = max(last, e.end)
                step = step or (e.alternative_count == 0 and self.lower[0] <= e.loss[0])
        stays = over == own and own > 0 and self.left(last + USUAL_S) > LASTING * self.loss[0]
        if not (stays or (self.grew and over == 0 and not step)):
            return count
        left = 0
        for i in range(count):
            if not (losses[i].accuses() or losses[i].rotors == mask):
                if left < i:
                    copy(losses[left], losses[i])
                left += 1
        one.kind = LOSS
        one.detail = STAYS if stays else GREW
        one.rotors = mask
        one.onset = first if stays else min(self.start, first)
        one.detected = detected if own > 0 else self.looked
        one.loss[0] = self.loss[0]
        one.lower[0] = self.lower[0]
        one.upper[0] = self.upper[0]
        one.probability = self.odds / (1.0 + self.odds)
        return put(losses, left, room, one)

    def _size(self, v: Vehicle, w: Weighing, k: int, grows: int) -> None:
        """Compute the loss and interval of one of `rotors`."""
        first = (2 * self.rotors[k] + grows) * LOSSES_EACH
        top: Real = NEVER
        for s in range(LOSSES_EACH):
            top = max(top, w.sizes[first + s].log())
        total: Real = 0.0
        mean: Real = 0.0
        square: Real = 0.0
        for s in range(LOSSES_EACH):
            weight = exp(w.sizes[first + s].log() - top)
            total += weight
            mean += weight * SIZES[s]
        mean /= total
        for s in range(LOSSES_EACH):
            weight = exp(w.sizes[first + s].log() - top)
            square += weight / total * (SIZES[s] - mean) * (SIZES[s] - mean)
        half = 0.5 * (SIZES[1] - SIZES[0])
        sd = sd_of(v, mean, sqrt(square + half * half))
        steeper = CURVE_SHARE * v.expo_sd / CURVE_SD * mean  # as in `sd_of`, of a curve that has not been learned
        if steeper > 0.0:
            steeper = steeper * (1.0 - mean) / (1.0 - mean + steeper)
        half = WITHIN_95 * sqrt(sd * sd + steeper * steeper)
        self.loss[k] = mean
        self.lower[k] = max(mean - half, 0.0)
        self.upper[k] = min(mean + half, 1.0)

    def _follow(self, v: Vehicle, stretch: Stretch, best: int, start: Time) -> None:
        """Compute the loss of the most probable rotor in each block, relative to that before `start`."""
        self.blocks = stretch.count
        before = 0
        for j in range(stretch.count):
            self.time[j] = stretch.time(real(stretch.at[j]))
            if self.time[j] < start:
                before += 1
            self.lost[j] = 0.0
        before = max(before, 1)
        square: Real = 0.0
        for a in range(3):
            square += v.effectiveness[a][best] * v.effectiveness[a][best]
        for a in range(3):
            level: Real = 0.0
            for j in range(before):
                level += stretch.z[a][j] / real(before)
            for j in range(stretch.count):
                share = max(stretch.share[best][j], LEAST_SHARE)
                self.lost[j] += (stretch.z[a][j] - level) * v.effectiveness[a][best] / (square * share)


class Mount(Struct):
    """A mount or an arm that turned: it takes no thrust, and no rotor is accused. odds: to everything else; below CLEAR it is not
    reported. yaw: in hover thrusts of one rotor, positive to the right, give or take `half`."""

    onset: Time = 0.0
    detected: Time = 0.0
    odds: Real = 0.0
    yaw: Real = 0.0
    half: Real = 0.0

    def find(self, v: Vehicle, stretch: Stretch, w: Weighing) -> Real:
        """Find it in the weighed trim; return its log-odds."""
        alone = w.alone()
        weight = local(REAL, AMOUNTS_TURNED)
        top: Real = NEVER
        every = Sum()
        for k in range(AMOUNTS_TURNED):
            both = Sum()
            both.add(alone + w.sole[k].log(), 1.0)
            both.add(w.beside[k].log(), 1.0)
            weight[k] = both.log()
            top = max(top, weight[k])
            every.add(weight[k], 1.0)
        turned = every.log() - log(real(w.courses)) - log(real(3.0))
        others = Sum()
        others.add(w.other(), 1.0)
        for i in range(v.rotors):
            others.add(w.rotor[i], 1.0)
        self.odds = exp(min(turned - others.log(), MOST_NATS))
        total: Real = 0.0
        mean: Real = 0.0
        square: Real = 0.0
        for k in range(AMOUNTS_TURNED):
            weight[k] = exp(weight[k] - top)
            total += weight[k]
            mean += weight[k] * _turn(k)
        mean /= total
        for k in range(AMOUNTS_TURNED):
            square += weight[k] / total * (_turn(k) - mean) * (_turn(k) - mean)
        step = 0.25 * abs(mean) * (RATIO - 1.0 / RATIO)
        self.yaw = mean
        self.half = WITHIN_95 * sqrt(square + step * step)
        sole = alone + w.turns[1].log()
        beside = Sum()
        for k in range(AMOUNTS_TURNED):
            beside.add(w.beside[k].log(), 1.0)
        most = max(sole, beside.log())
        sole = exp(sole - most)
        near = exp(beside.log() - most)
        when = (sole * _mean(w.onset_sole, w.turns[1]) + near * _mean(w.onset_beside, beside)) / (sole + near)
        self.onset = stretch.time(when)
        self.detected = stretch.last
        return turned

    def put(self, events: list[Event], count: int, room: int) -> int:
        """Add it to the events where it is clear and none of them accuses a rotor; return their number."""
        if self.odds < CLEAR:
            return count
        for i in range(count):
            if events[i].accuses():
                return count
        one = Event()
        one.kind = TURNED_MOUNT
        one.onset = self.onset
        one.detected = self.detected
        one.size = self.yaw
        one.probability = self.odds / (1.0 + self.odds)
        return put(events, count, room, one)


def _mean(weighted: Sum, weights: Sum) -> Real:
    """Mean with logarithmic weights."""
    return weighted.total / weights.total * exp(min(weighted.top - weights.top, MOST_NATS)) if weights.total > 0.0 else 0.0


def _turn(k: int) -> Real:
    """Yaw of one of the amounts of a turned mount."""
    each = AMOUNTS_TURNED // 2
    return -AMOUNTS[AMOUNTS_EACH - each + k] if k < each else AMOUNTS[AMOUNTS_EACH - 2 * each + k]


def _quantile(stretch: Stretch, w: Weighing, rotor: int, grows: int, ends: bool) -> Real:
    """Block by which a loss of a rotor had begun, with probability BEGUN, or ended, in the median."""
    top: Real = NEVER
    total: Real = 0.0
    below: Real = 0.0
    for c in range(w.courses):
        if _is_growth(stretch, w, c) == grows:
            top = max(top, w.lost[c][rotor])
    for c in range(w.courses):
        if _is_growth(stretch, w, c) == grows:
            total += exp(w.lost[c][rotor] - top)
    share = 0.5 if ends else BEGUN
    for block in range(2 * BLOCKS):
        w.x[block] = 0.0
    for c in range(w.courses):
        place = w.start[c] + (w.rise[c] if ends else 0)
        if place < 2 * BLOCKS and _is_growth(stretch, w, c) == grows:
            w.x[place] += exp(w.lost[c][rotor] - top)
    for block in range(2 * BLOCKS):
        below += w.x[block]
        if below >= share * total:
            return real(block)
    return real(stretch.at[stretch.count - 1])


def _is_growth(stretch: Stretch, w: Weighing, course: int) -> int:
    """1 where a course is too long for a step, else 0."""
    return 1 if real(w.rise[course]) * stretch.length >= GROWS_S else 0
