"""One list of all that happened, out of losses, overrides and contacts.

A loss that begins while an output is overridden is the override, or what that does to the others. An override that begins in the fall that
ends a flight, and a contact within a second of its end, are the fall and the landing. A loss that may be nothing, and is of one set of
rotors alone, accuses nobody.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, MASK, REAL, TIME, Mask, Real, Small, Struct, Time, array, copy, reset
from rotorwatch.engine.intake.craft import PITCH, ROLL, THRUST, Vehicle
from rotorwatch.engine.intake.deviations import Override
from rotorwatch.engine.intake.sizes import ALTERNATIVES, CONTACTS, EVENTS, FALLS, TOGETHER

# What happened, by its number in the table of kinds: a rotor makes less thrust than its command asks for; an output does not follow the
# mixer, and nothing is wrong with the rotor; something outside the vehicle pushed it; a motor mount or an arm turned.
LOSS, OUTPUT_OVERRIDE, CONTACT, TURNED_MOUNT = 0, 1, 2, 9
# The state at this moment: not in the air for long enough yet, or a rotor's commands are not known; healthy so far; something happened, and
# to which rotor or output; something happened, and several sets of rotors explain it.
NOT_JUDGED, HEALTHY, FAULT, AMBIGUOUS = 0, 1, 2, 3
# Of a loss: opposite rotors may share it, and then so may the battery; two rotors of one arm lack about one whole rotor; it grew little by
# little; what looked like its end left the trim as it was.
PLAIN, SHARED, ONE_ARM, GREW, STAYS = 0, 1, 2, 3, 4

TOUCH_DOWN_S = 1.0  # a contact so near the end of a flight is the landing, or the crash
EXPLAINED_S = 1.0  # so near an override a loss is the override
TOGETHER_S = 1.0  # losses that begin so close began together
LARGE = 0.5  # share of the largest loss from which one is large
SAME_ARM = 0.05  # of the largest lever, by which two rotors of one arm may be apart


class Event(Struct):
    """One event. loss, lower, upper are of the rotors of the set, in their order."""

    onset: Time = 0.0  # s, when it began
    detected: Time = 0.0  # s, when that was known
    end: Time = LASTS  # s, LASTS while it lasts
    loss = array(REAL, TOGETHER)  # of effectiveness, 0 to 1
    lower = array(REAL, TOGETHER)  # 95 % interval
    upper = array(REAL, TOGETHER)
    probability: Real = 0.0  # of this set of rotors
    # Of a contact: g, or hover thrusts of one rotor where it turned the vehicle. Of a loss: hover thrusts that the rotor gives whatever it
    # is commanded, 0 where it follows its command. Of a mount: hover thrusts of one rotor that it yaws, to the right above 0.
    size: Real = 0.0
    rotors: Mask = 0  # bit k: rotor k, from 0; of a contact and a mount 0
    alternatives = array(MASK, ALTERNATIVES)  # sets that would look the same, the likeliest first
    alternative_count: Small = 0
    kind: Small = LOSS  # LOSS, OUTPUT_OVERRIDE, CONTACT, TURNED_MOUNT
    detail: Small = PLAIN  # of a loss PLAIN, SHARED and so on; of an override STUCK, OFF, OVERRIDDEN; of a contact TURNED and so on
    source: Small = 0  # place among the losses or overrides that it came from

    def accuses(self) -> bool:
        """Whether it says that a rotor or its output is not well: no contact, no mount, and no loss that may be nothing and is said of one
        set of rotors alone."""
        if self.kind == LOSS and self.alternative_count == 0:
            for i in range(TOGETHER):
                if self.lower[i] > 0.0:
                    return True
            return False
        return self.is_fault()

    def is_fault(self) -> bool:
        """Whether it is of a kind that says that a rotor or its output is not well."""
        return self.kind != CONTACT and self.kind != TURNED_MOUNT

    def may_be(self, rotors: int) -> bool:
        """Whether it is of this set of rotors, or may be."""
        for i in range(self.alternative_count):
            if self.alternatives[i] == rotors:
                return True
        return self.rotors == rotors

    def largest(self) -> Real:
        """The largest loss of its rotors."""
        most: Real = 0.0
        for i in range(TOGETHER):
            most = max(most, self.loss[i])
        return most

    def share_arm(self, v: Vehicle) -> None:
        """Where its two rotors stand on one coaxial arm and together lack about one rotor, each of them alone is named as well. In all but
        yaw one rotor that is lost looks like parts of both, and what is left of the arm then gives another thrust and yaw than geometry
        says, because the air between the two has changed."""
        if not v.coaxial or self.alternative_count > 0 or self.kind != LOSS:
            return
        low: Real = 0.0
        high: Real = 0.0
        i = -1
        j = -1
        for k in range(v.rotors):
            if (self.rotors & (1 << k)) != 0:
                if j >= 0:
                    return
                j = i
                i = k
        if j < 0:
            return
        for k in range(2):
            low += self.lower[k]
            high += self.upper[k]
        one = v.effectiveness[THRUST][i]
        other = v.effectiveness[THRUST][j]
        roll = abs(v.effectiveness[ROLL][i] / one - v.effectiveness[ROLL][j] / other)
        pitch = abs(v.effectiveness[PITCH][i] / one - v.effectiveness[PITCH][j] / other)
        if roll > SAME_ARM or pitch > SAME_ARM or not low < 1.0 < high:
            return
        self.detail = ONE_ARM
        self.alternatives[0] = 1 << j
        self.alternatives[1] = 1 << i
        self.alternative_count = 2


class Knock(Struct):
    """A contact."""

    time: Time = 0.0
    size: Real = 0.0
    push: Small = 0  # TURNED and so on


class Report(Struct):
    """Falls and contacts of one vehicle, and all events together."""

    fall_start = array(TIME, FALLS)
    fall_end = array(TIME, FALLS)
    knocks = array(Knock, CONTACTS)
    start: Time = LASTS  # of the flight that goes on, LASTS on the ground
    falling: Time = LASTS  # since when it tumbles, LASTS where it does not
    end: Time = -LASTS  # of the last flight, -LASTS before
    now: Time = -LASTS  # time of the last tick
    falls: Small = 0
    count: Small = 0  # of knocks

    def tick(self, time: Time, start: Time, upset: bool) -> None:
        """The next tick. start: of the flight that it belongs to, up to one tick after its end; LASTS on the ground."""
        self.now = time
        if start >= LASTS:
            return
        if start < self.start or start > self.start:
            self.start = start
            self.falling = LASTS
        if not upset:
            self.falling = LASTS
        elif self.falling >= LASTS:
            self.falling = time

    def landed(self, end: Time) -> None:
        """The flight ended at `end` s."""
        if self.falling < LASTS:
            if self.falls == FALLS:
                for i in range(FALLS - 1):
                    self.fall_start[i] = self.fall_start[i + 1]
                    self.fall_end[i] = self.fall_end[i + 1]
                self.falls -= 1
            self.fall_start[self.falls] = self.falling
            self.fall_end[self.falls] = end
            self.falls += 1
        left = 0
        for i in range(self.count):
            if abs(self.knocks[i].time - end) >= TOUCH_DOWN_S:
                copy(self.knocks[left], self.knocks[i])
                left += 1
        self.count = left
        self.start = LASTS
        self.falling = LASTS
        self.end = end

    def contact(self, time: Time, push: int, size: Real) -> None:
        """Something pushed the vehicle at `time` s (TURNED and so on), so much; the same time again: it was more."""
        if abs(time - self.end) < TOUCH_DOWN_S:
            return
        at = int(self.count)
        if at > 0 and not self.knocks[at - 1].time < time:
            at -= 1
        elif at == CONTACTS:
            for i in range(CONTACTS - 1):
                copy(self.knocks[i], self.knocks[i + 1])
            at -= 1
        self.knocks[at].time = time
        self.knocks[at].push = push
        self.knocks[at].size = size
        self.count = at + 1

    def events(
        self, v: Vehicle, losses: list[Event], loss_count: int, overrides: list[Override], override_count: int, out: list[Event]
    ) -> int:
        """All events into out [EVENTS], in the order in which they were detected; how many."""
        count = 0
        one = Event()
        for i in range(loss_count):
            explained = False
            for j in range(override_count):
                o = overrides[j]
                explained = explained or (not self._falls(o.onset) and explains(o.onset, o.end, losses[i].onset))
            if not explained and losses[i].accuses():
                copy(one, losses[i])
                one.source = i
                one.share_arm(v)
                count = put(out, count, EVENTS, one)
        for j in range(override_count):
            o = overrides[j]
            if not self._falls(o.onset) and not o.shared:
                reset(one)
                one.onset = o.onset
                one.detected = o.detected
                one.end = o.end
                one.probability = 1.0
                one.rotors = 1 << o.rotor
                one.kind = OUTPUT_OVERRIDE
                one.detail = o.kind
                one.source = j
                count = put(out, count, EVENTS, one)
        for i in range(self.count):
            if self.start >= LASTS or abs(self.knocks[i].time - self.now) >= TOUCH_DOWN_S:  # else it may be the landing
                reset(one)
                one.onset = self.knocks[i].time
                one.detected = self.knocks[i].time
                one.end = self.knocks[i].time
                one.probability = 1.0
                one.size = self.knocks[i].size
                one.kind = CONTACT
                one.detail = self.knocks[i].push
                count = put(out, count, EVENTS, one)
        return count

    def _falls(self, onset: Time) -> bool:
        """Whether something that begins then begins in a fall."""
        for i in range(self.falls):
            if self.fall_start[i] < onset <= self.fall_end[i]:
                return True
        return self.falling < onset <= self.now


def explains(start: Time, end: Time, onset: Time) -> bool:
    """Whether a loss that began at `onset` s began while an output was overridden, from start to end."""
    return start - EXPLAINED_S <= onset <= end + EXPLAINED_S


def put(out: list[Event], count: int, room: int, one: Event) -> int:
    """One event more, sorted by when it was detected; of more than there is room for the first goes. How many there are."""
    n = count
    if n == room:
        if one.detected < out[0].detected:
            return n
        for i in range(room - 1):
            copy(out[i], out[i + 1])
        n -= 1
    at = n
    while at > 0 and out[at - 1].detected > one.detected:
        copy(out[at], out[at - 1])
        at -= 1
    copy(out[at], one)
    return n + 1


def verdict(events: list[Event], count: int, judged: bool) -> int:
    """The state by the events alone; judged: at least one tick has been judged."""
    unsure = False
    for i in range(count):
        if events[i].is_fault() and events[i].alternative_count == 0:
            return FAULT
        unsure = unsure or events[i].is_fault()
    if unsure:
        return AMBIGUOUS
    return HEALTHY if judged else NOT_JUDGED


def main_event(events: list[Event], count: int) -> int:
    """Place of the event that matters, -1 without one: sure ones before ambiguous ones; the first that is large, or an override that came
    before it (one that comes after is what a falling vehicle's controller does); of losses that began together the largest."""
    sure = False
    most: Real = 0.0
    size: Real = -1.0
    first: Time = LASTS
    loss = -1
    override = -1
    for i in range(count):
        sure = sure or (events[i].is_fault() and events[i].alternative_count == 0)
    for i in range(count):
        if _counts(events[i], LOSS, sure):
            most = max(most, events[i].largest())
    for i in range(count):
        if _counts(events[i], LOSS, sure) and events[i].largest() >= LARGE * most:
            first = min(first, events[i].onset)
    for i in range(count):
        e = events[i]
        if _counts(e, OUTPUT_OVERRIDE, sure) and e.onset < first:
            if override < 0 or e.onset < events[override].onset:
                override = i
        if _counts(e, LOSS, sure) and e.largest() >= LARGE * most and e.onset <= first + TOGETHER_S:
            if e.largest() > size:
                loss = i
                size = e.largest()
    return override if override >= 0 else loss


def _counts(e: Event, kind: int, sure: bool) -> bool:
    """Whether it is of this kind and, where there are sure ones, sure."""
    return e.kind == kind and not (sure and e.alternative_count > 0)
