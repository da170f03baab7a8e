"""Losses of effectiveness from the estimator's ticks: rotors, onset, end, size and uncertainty of each announced loss.

The estimator decides on faults and their explanations; this module only records them. It needs no history of the flight: it keeps the ticks
within the estimator's reach, and at most ESTIMATES estimates of a weak rotor. A loss may change until its flight is over, because another
explanation may take the lead: one of other rotors, or one without a fault, which removes the loss from the list.

Rotors count from 0; a set of rotors has bit k for rotor k.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (
    FLAG,
    INT,
    LASTS,
    REAL,
    TIME,
    Mask,
    Real,
    Reals,
    Small,
    Struct,
    Time,
    array,
    copy,
    embedded,
    local,
    real,
    reset,
    sqrt,
)
from rotorwatch.engine.events.decisions import CLEAR, CREDIBLE
from rotorwatch.engine.events.events import LOSS, PLAIN, SHARED, Event
from rotorwatch.engine.events.records import Course, ExplanationState, Found, Onset, Record, Records
from rotorwatch.engine.intake.craft import PITCH, ROLL, Vehicle
from rotorwatch.engine.intake.sizes import ALTERNATIVES, PAIRS, PLACES, REACH, RECORDS, ROTORS, TOGETHER
from rotorwatch.engine.intake.ticks import ASSESS

# Share by which the slope of the thrust curve in hover may differ from the logged one: an error of 0.18 in an expo of 0.65, as a setting
# that was never measured has.
CURVE_SHARE = 0.12
COAXIAL_SHARE = 0.135  # the same with the division of thrust in a coaxial arm: half of the error of the lower rotors' share
PAIR_WEIGHT = 1e-4  # prior weight of a pair relative to a single rotor
YOUNG_S = 1.0  # time after an announcement within which a pair mistaken for one rotor becomes distinguishable from it
WITHIN_95 = 1.96  # standard deviations of a 95 % interval
CANCELS = 0.05  # share of the largest lever arm below which the sum of two torques counts as 0


class Losses(Struct):
    """Tracks the losses of one vehicle tick by tick."""

    records = embedded(Records)  # final records: all before the last announcement
    latest = embedded(ExplanationState)  # after the last tick
    assessed = embedded(ExplanationState)  # after the last assessed tick
    courses = array(Course, ROTORS)  # estimates of each weak rotor
    before_courses = array(Course, ROTORS)  # the same before the last announcement
    onsets = array(Onset, PLACES)  # of the explanations of the last announcement
    time = array(TIME, REACH)  # s, ring buffer by tick
    age = array(REAL, REACH)  # s by which commands are older than their tick, ring buffer
    first_onset: Time = 0.0
    assessed_time: Time = 0.0
    theta = array(REAL, ROTORS)  # losses at the last assessed tick
    sd = array(REAL, ROTORS)  # their standard deviations
    tick: int = -1  # number of the last tick, -1 before any
    first: int = 0  # number of the first tick of this flight
    before: Mask = 0  # weak rotors before the last announcement
    hiding: Mask = 0  # as in Record, of the last announcement
    hider: Small = 0
    hidden = array(FLAG, PAIRS)
    announced: bool = False  # there was an announcement in this flight
    flown: bool = False  # a tick of this flight was assessed
    announcements: int = 0  # number so far

    def write(self, v: Vehicle, time: Time, when: Time, mode: int, restart: bool, found: Found) -> None:
        """Add the next tick; call it for every tick in order, on the ground as well. time: of the tick, s; when: mean time of its commands,
        s; restart: first tick of a flight."""
        if restart and self.tick >= 0:
            self._landed(v)
        self.tick += 1
        if restart or self.tick == 0:
            self.first = self.tick
            self.first_onset = when
        self.time[self.tick % REACH] = time
        self.age[self.tick % REACH] = real(time - when)
        if found.announced:
            self._conclude(v, self.records, self.latest)
            if self.announced:
                self.before = self.latest.active[0]
            self._begin(found, time)
            for k in range(v.rotors):
                copy(self.before_courses[k], self.courses[k])
            self._hide(v, found)
            self.announced = True
            self.announcements += 1
        if self.announced:
            led = int(self.latest.active[0])
            for p in range(PLACES):
                self.latest.active[p] = 0
                self.latest.share[p] = found.share[p]
                for k in range(v.rotors):
                    if found.active[p][k]:
                        self.latest.active[p] |= 1 << k
            self.latest.onset = self._jumped(found.onsets[0])
            self.latest.gives = 0.0
            for k in range(v.rotors):
                self.latest.gives = max(self.latest.gives, found.gives[k])
            if found.announced or self.latest.active[0] != led:
                self.latest.found = time
                for k in range(v.rotors):  # restart the estimates of rotors without a final record
                    if (self.before & (1 << k)) == 0:
                        reset(self.courses[k])
        if mode != ASSESS:
            return
        copy(self.assessed, self.latest)
        self.assessed_time = time
        self.flown = True
        for k in range(v.rotors):
            self.theta[k] = found.theta[k]
            self.sd[k] = found.theta_sd[k]
            if self.announced and ((self.before | self.latest.active[0]) & (1 << k)) != 0:
                self.courses[k].add(self.tick, self.theta[k], self.sd[k])

    def losses(self, v: Vehicle, flies: bool, records: Records, out: list[Event]) -> int:
        """Write the losses so far, in the order of detection, into out [RECORDS]; return their number. flies: the flight continues, so a
        recent announcement may still turn out to be a pair. records: workspace."""
        reset(records)
        order = local(INT, RECORDS)
        records.count = self.records.count
        for k in range(v.rotors):
            records.of[k] = self.records.of[k]
        for i in range(records.count):
            copy(records.all[i], self.records.all[i])
        if self.flown:
            self._conclude(v, records, self.assessed)
        for i in range(records.count):
            place = i
            while place > 0 and records.all[order[place - 1]].detected > records.all[i].detected:
                order[place] = order[place - 1]
                place -= 1
            order[place] = i
        count = 0
        for i in range(records.count):
            reset(out[count])
            self._event(v, records.all[order[i]], flies, out[count])
            if not _momentary(records.all[order[i]], out[count], records):
                count += 1
        return count

    # Times

    def _earliest(self) -> int:
        """Earliest stored tick of this flight."""
        return max(self.tick - REACH + 1, self.first)

    def _command_time(self, tick: int) -> Time:
        if tick <= self.first:
            return self.first_onset
        return self.time[tick % REACH] - float(self.age[tick % REACH])

    def _jumped(self, since: Real) -> int:
        """Tick of a jump `since` ticks ago, not before this flight."""
        if since >= 0.0 and since < 1e9:
            return max(self.tick - int(since + 0.5), self.first)
        return self.first

    def _nearest(self, tick: int) -> int:
        """Index of the onset in the last announcement nearest to a tick."""
        best = 0
        for p in range(1, PLACES):
            if abs(self.onsets[p].tick - tick) < abs(self.onsets[best].tick - tick):
                best = p
        return best

    def _begin(self, found: Found, now: Time) -> None:
        """Set the onset of each explanation of this tick. One that began before the stored ticks is taken from the last announcement."""
        made = local(Onset, PLACES)
        reach = self._earliest()
        for p in range(PLACES):
            tick = self._jumped(found.onsets[p])
            if tick == self.first and tick < reach:  # no jump in this flight
                made[p].time = self.first_onset
                made[p].tick = tick
                made[p].before = tick - 1
            elif tick < reach and self.announced:
                copy(made[p], self.onsets[self._nearest(tick)])
            else:
                tick = max(tick, reach)
                made[p].tick = tick
                made[p].time = min(self._command_time(tick), now)
                before = tick
                while before >= reach and self.time[before % REACH] >= made[p].time:
                    before -= 1
                while before < self.tick and self.time[(before + 1) % REACH] < made[p].time:
                    before += 1
                made[p].before = before
        for p in range(PLACES):
            copy(self.onsets[p], made[p])

    # Conclusion of an announcement

    def _conclude(self, v: Vehicle, to: Records, at: ExplanationState) -> None:
        """Record the losses and recoveries of the last announcement, given the explanations `at`."""
        if not self.announced:
            return
        now = int(at.active[0])
        recovered = self.before & ~now
        fresh = now & ~self.before
        began = self.onsets[self._nearest(at.onset)]
        for k in range(v.rotors):
            if (recovered & (1 << k)) != 0 and to.of[k] >= 0:
                place = int(to.of[k])
                ended = to.all[place].rotors & recovered
                if ended != to.all[place].rotors:  # the others are still weak: separate record for the recovered rotors
                    whole = Record()
                    copy(whole, to.all[place])
                    to.all[place].only(whole.rotors & ~ended)
                    place = to.add()
                    copy(to.all[place], whole)
                    to.all[place].only(ended)
                to.all[place].end = began.time
                to.all[place].recovered = True
                _usual(v, to.all[place], self.before_courses, began.before)
                for j in range(v.rotors):
                    if (ended & (1 << j)) != 0:
                        to.of[j] = -1
        if fresh == 0:
            return
        place = to.add()
        to.all[place].onset = began.time
        to.all[place].detected = at.found
        to.all[place].rotors = fresh
        to.all[place].hiding = self.hiding
        to.all[place].hider = self.hider
        for k in range(PAIRS):
            to.all[place].hidden[k] = self.hidden[k]
        _weigh(to.all[place], at, self.before)
        if count_of(fresh) == 1:
            to.all[place].gives = at.gives
        for k in range(v.rotors):
            if (fresh & (1 << k)) != 0:
                to.of[k] = place

    def _landed(self, v: Vehicle) -> None:
        """End the flight: losses that lasted until the landing end at the last assessed tick."""
        if self.flown:
            self._conclude(v, self.records, self.assessed)
            for k in range(v.rotors):
                place = int(self.records.of[k])
                if place >= 0 and self.records.all[place].end >= LASTS:
                    self.records.all[place].end = self.assessed_time
                    _usual(v, self.records.all[place], self.courses, self.tick)
        for k in range(v.rotors):
            self.records.of[k] = -1
        self.announced = False
        self.flown = False
        self.before = 0

    # Data recorded at an announcement

    def _hide(self, v: Vehicle, found: Found) -> None:
        """Find pairs that only their low prior, not the data, rules out against the likeliest rotor. Losses of opposite rotors cancel in
        roll and pitch, and gusts mask the rest in yaw and thrust. When the data favour such a pair by more than CLEAR without the prior
        weights, a small loss of one rotor must not be claimed alone. For a loss that has just been announced the same holds for any pair;
        and a pair without the likeliest rotor is named unless the data contradict it by CLEAR, because equal losses of two rotors look like
        one of the rotor between them until their yaw and thrust are visible."""
        n = v.rotors
        best = -1.0
        likeliest = 0
        for k in range(n):
            p = found.probability[k] + found.probability[n + pairs(v) + k] + found.probability[2 * n + pairs(v) + k]
            if p > best:
                best = p
                likeliest = k
        self.hiding = 0
        self.hider = likeliest
        rare = False
        for k in range(pairs(v)):
            rare = rare or found.probability[n + k] > best
        opposite = opposite_of(v, likeliest)
        pair = 0
        for i in range(n):
            for j in range(i + 1, n):
                favoured = found.probability[n + pair] / (best * PAIR_WEIGHT)
                hides = not rare and favoured > CLEAR
                self.hidden[pair] = hides or (not rare and i != likeliest and j != likeliest and favoured > 1.0 / CLEAR)
                if hides and i == likeliest and (opposite & (1 << j)) != 0:
                    self.hiding |= 1 << j
                if hides and j == likeliest and (opposite & (1 << i)) != 0:
                    self.hiding |= 1 << i
                pair += 1

    # Conversion of records to events

    def _event(self, v: Vehicle, r: Record, flies: bool, e: Event) -> None:
        n = v.rotors
        first = 0
        while first < n - 1 and (r.rotors & (1 << first)) == 0:
            first += 1
        partners = opposite_of(v, first)
        rest = r.rotors & ~(1 << first)
        paired = n > 4 and count_of(r.rotors) == 2 and (rest & ~partners) == 0
        e.kind = LOSS
        e.onset = r.onset
        e.detected = r.detected
        e.end = r.end
        e.rotors = r.rotors
        e.size = r.gives
        place = 0
        for k in range(n):
            if (r.rotors & (1 << k)) != 0 and place < TOGETHER:
                loss = r.loss[place] if r.end < LASTS else self.theta[k]
                sd = r.sd[place] if r.end < LASTS else self.sd[k]
                sd = sd_of(v, loss, sd)
                e.loss[place] = loss
                e.lower[place] = max(loss - WITHIN_95 * sd, 0.0)
                e.upper[place] = min(loss + WITHIN_95 * sd, 1.0)
                place += 1
        own = False
        most: Real = 0.0
        for i in range(r.count):
            if r.sets[i] == r.rotors:
                e.probability = r.share[i]
                own = True
            most = max(most, r.share[i])
        if not own:
            e.probability = most
        young = flies and self.assessed_time - r.detected < YOUNG_S - 1e-6
        hidden = False
        pair = 0
        for i in range(n):
            for j in range(i + 1, n):
                hides = r.hidden[pair] if young else _hides(r, i, j)
                hidden = hidden or (hides and ((1 << i) | (1 << j)) != r.rotors)
                pair += 1
        # Only manoeuvres distinguish a pair of opposite rotors from the other such pairs: require CLEAR squared.
        odds = CLEAR * CLEAR if paired else CLEAR
        if not hidden and e.probability >= odds / (1.0 + odds):
            return
        e.detail = SHARED if paired else PLAIN
        pair = 0
        for i in range(n):
            for j in range(i + 1, n):
                if r.hidden[pair] if young else _hides(r, i, j):
                    _name(e, (1 << i) | (1 << j))
                pair += 1
        for i in range(r.count):
            if r.share[i] >= CREDIBLE:
                _name(e, r.sets[i])
        for i in range(n):  # all pairs that only a manoeuvre could distinguish
            for j in range(i + 1, n):
                if paired and (opposite_of(v, i) & (1 << j)) != 0:
                    _name(e, (1 << i) | (1 << j))


def _momentary(r: Record, e: Event, records: Records) -> bool:
    """Whether a loss ended within YOUNG_S, was certainly not total, and is the only one of its rotors. Gusts, manoeuvres and wrong samples
    cause such losses, rotors do not: motors that cut out do so completely or repeatedly."""
    if not r.recovered or r.end - r.onset >= YOUNG_S:
        return False
    for k in range(TOGETHER):
        if e.upper[k] >= 1.0:
            return False
    same = 0
    for i in range(records.count):
        if (records.all[i].rotors & r.rotors) != 0:
            same += 1
    return same < 2


def count_of(rotors: int) -> int:
    """Number of rotors in a set."""
    count = 0
    for k in range(ROTORS):
        if (rotors & (1 << k)) != 0:
            count += 1
    return count


def pairs(v: Vehicle) -> int:
    """Number of pairs of rotors."""
    return v.rotors * (v.rotors - 1) // 2


def opposite_of(v: Vehicle, i: int) -> int:
    """Set of rotors that cancel the roll and pitch torque of rotor i: a loss shared with one of them is almost unobservable."""
    found = 0
    for j in range(v.rotors):
        roll = abs(v.effectiveness[ROLL][i] + v.effectiveness[ROLL][j]) < CANCELS
        pitch = abs(v.effectiveness[PITCH][i] + v.effectiveness[PITCH][j]) < CANCELS
        if j != i and roll and pitch:
            found |= 1 << j
    return found


def sd_of(v: Vehicle, loss: Real, sd: Real) -> Real:
    """Standard deviation of a loss including the uncertainty of the vehicle model. A rotor that compensates for theta is commanded
    T = 1 / (1 - theta), and gives T (1 + k (T - 1)) if the curve's slope is wrong by a share k; the loss is then larger by
    k theta (1 - theta) / (1 - theta + k theta)."""
    share = COAXIAL_SHARE if v.coaxial else CURVE_SHARE
    left = min(max(1.0 - loss, 1e-9), 1.0)
    curve = share * loss * left / (left + share * loss)
    return sqrt(sd * sd + curve * curve)


def spread(v: Vehicle, n: int, loss: Reals, sd: Reals, out: Reals) -> None:
    """Apply `sd_of` to n losses."""
    for i in range(n):
        out[i] = sd_of(v, loss[i], sd[i])


def _usual(v: Vehicle, r: Record, courses: list[Course], last: int) -> None:
    """Set the size of a loss that is over: the estimates at the tick where the first of its rotors was at its median, up to the tick
    `last`."""
    first = 0
    while first < v.rotors - 1 and (r.rotors & (1 << first)) == 0:
        first += 1
    best = courses[first].middle(last)
    if best < 0:
        return
    place = 0
    for k in range(v.rotors):
        if (r.rotors & (1 << k)) != 0 and place < TOGETHER:
            r.loss[place] = courses[k].theta[best]
            r.sd[place] = courses[k].sd[best]
            place += 1


def _weigh(r: Record, at: ExplanationState, before: int) -> None:
    """Set the sets of rotors that may have failed, without those that were weak before, and their probabilities."""
    total: Real = 0.0
    r.count = 0
    for p in range(PLACES):
        other = at.active[p] & ~before
        if other != 0:  # the probability of no fault was tested before the announcement
            place = 0
            while place < r.count and r.sets[place] != other:
                place += 1
            if place == r.count:
                r.sets[place] = other
                r.share[place] = 0.0
                r.count += 1
            r.share[place] += at.share[p]
            total += at.share[p]
    for i in range(r.count):
        if total > 0.0:
            r.share[i] = r.share[i] / total


def _hides(r: Record, i: int, j: int) -> bool:
    """Whether rotors i and j are `hider` and one of the rotors in `hiding`."""
    return (i == r.hider and (r.hiding & (1 << j)) != 0) or (j == r.hider and (r.hiding & (1 << i)) != 0)


def _name(e: Event, rotors: int) -> None:
    """Add a set to the event's alternatives, unless it is its own set or already named."""
    if rotors == e.rotors or e.alternative_count >= ALTERNATIVES:
        return
    for i in range(e.alternative_count):
        if e.alternatives[i] == rotors:
            return
    e.alternatives[e.alternative_count] = rotors
    e.alternative_count += 1
