"""Merges losses, overrides and contacts into one list of events.

A loss that begins while an output is overridden is attributed to the override or its effect on the other rotors. An override that begins in
the fall that ends a flight, and a contact within a second of its end, are attributed to the fall and the landing. A loss of a single set of
rotors whose interval includes 0 is not reported.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, MASK, REAL, TIME, Mask, Real, Small, Struct, Time, array, copy, reset
from rotorwatch.engine.intake.craft import PITCH, ROLL, THRUST, Vehicle
from rotorwatch.engine.intake.deviations import Override
from rotorwatch.engine.intake.sizes import ALTERNATIVES, CONTACTS, EVENTS, FALLS, TOGETHER

# Kinds of events, numbered as in the table of kinds: a rotor gives less thrust than commanded; an output does not follow the mixer although
# the rotor is healthy; an external force pushed the vehicle; a motor mount or an arm turned.
LOSS, OUTPUT_OVERRIDE, CONTACT, TURNED_MOUNT = 0, 1, 2, 9
# Current state: not in the air for long enough yet, or a rotor's commands are unknown; healthy so far; a fault of known rotors or outputs;
# a fault that several sets of rotors explain.
NOT_ASSESSED, HEALTHY, FAULT, AMBIGUOUS = 0, 1, 2, 3
# Details of a loss: opposite rotors, or else the battery, may explain it; two rotors of one arm together lack about one rotor; it grew
# gradually; its apparent end left the trim unchanged.
PLAIN, SHARED, ONE_ARM, GREW, STAYS = 0, 1, 2, 3, 4

TOUCH_DOWN_S = 1.0  # a contact this close to the end of a flight is the landing or the crash
EXPLAINED_S = 1.0  # a loss this close to an override is attributed to it
TOGETHER_S = 1.0  # losses with onsets this close began together
LARGE = 0.5  # share of the largest loss from which a loss counts as large
SAME_ARM = 0.05  # largest distance between two rotors of one arm, as a share of the largest lever arm


class Event(Struct):
    """An event. loss, lower and upper hold the rotors of the set in ascending order."""

    onset: Time = 0.0  # s, when it began
    detected: Time = 0.0  # s, when it was detected
    end: Time = LASTS  # s, LASTS while it lasts
    loss = array(REAL, TOGETHER)  # of effectiveness, 0 to 1
    lower = array(REAL, TOGETHER)  # 95 % interval
    upper = array(REAL, TOGETHER)
    probability: Real = 0.0  # of this set of rotors
    # Contact: g, or hover thrusts of one rotor if it turned the vehicle. Loss: hover thrusts that a stuck rotor gives whatever it is
    # commanded, 0 if it follows its command. Mount: yaw torque in hover thrusts of one rotor, positive to the right.
    size: Real = 0.0
    rotors: Mask = 0  # bit k: rotor k, from 0; 0 for a contact or a mount
    alternatives = array(MASK, ALTERNATIVES)  # sets that would look the same, the likeliest first
    alternative_count: Small = 0
    kind: Small = LOSS  # LOSS, OUTPUT_OVERRIDE, CONTACT, TURNED_MOUNT
    detail: Small = PLAIN  # loss: PLAIN, SHARED and so on; override: STUCK, OFF, OVERRIDDEN; contact: TURNED and so on
    source: Small = 0  # index of the loss or override that it came from

    def accuses(self) -> bool:
        """Whether the event indicates a fault of a rotor or its output: not a contact, a mount, or a loss of a single set of rotors whose
        intervals all include 0."""
        if self.kind == LOSS and self.alternative_count == 0:
            for i in range(TOGETHER):
                if self.lower[i] > 0.0:
                    return True
            return False
        return self.is_fault()

    def is_fault(self) -> bool:
        """Whether its kind indicates a fault of a rotor or its output."""
        return self.kind != CONTACT and self.kind != TURNED_MOUNT

    def may_be(self, rotors: int) -> bool:
        """Whether this set of rotors is the event's own or one of its alternatives."""
        for i in range(self.alternative_count):
            if self.alternatives[i] == rotors:
                return True
        return self.rotors == rotors

    def largest(self) -> Real:
        """Largest loss of its rotors."""
        most: Real = 0.0
        for i in range(TOGETHER):
            most = max(most, self.loss[i])
        return most

    def share_arm(self, v: Vehicle) -> None:
        """If its two rotors are on one coaxial arm and together lack about one rotor, name each of them alone as an alternative. In all
        axes but yaw the total loss of one rotor looks like partial losses of both, and the remaining rotor gives a thrust and yaw that
        differ from geometry because the flow between the two has changed."""
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
    """A contact: time in s, size in the unit of Event.size."""

    time: Time = 0.0
    size: Real = 0.0
    push: Small = 0  # TURNED and so on


class Report(Struct):
    """Tracks falls and contacts of one vehicle and merges all events."""

    fall_start = array(TIME, FALLS)
    fall_end = array(TIME, FALLS)
    knocks = array(Knock, CONTACTS)
    start: Time = LASTS  # of the current flight, LASTS on the ground
    falling: Time = LASTS  # since when the vehicle has been upset, LASTS if it is not
    end: Time = -LASTS  # of the last flight, -LASTS before any
    now: Time = -LASTS  # time of the last tick
    falls: Small = 0
    count: Small = 0  # of knocks

    def tick(self, time: Time, start: Time, upset: bool) -> None:
        """Process the next tick. start: start of its flight, up to one tick after the flight's end; LASTS on the ground. upset: the vehicle
        tumbles, or has tumbled in this flight."""
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
        """End the flight at `end` s: store its fall, and drop contacts that are the landing."""
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
        """Add a contact at `time` s of kind `push` (TURNED and so on) and size; a repeated time replaces the last one with its larger
        size."""
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
        """Write all events into out [EVENTS], in the order of detection; return their number."""
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
        """Whether an onset lies within a fall."""
        for i in range(self.falls):
            if self.fall_start[i] < onset <= self.fall_end[i]:
                return True
        return self.falling < onset <= self.now


def explains(start: Time, end: Time, onset: Time) -> bool:
    """Whether a loss that began at `onset` s is explained by an override from `start` to `end` s."""
    return start - EXPLAINED_S <= onset <= end + EXPLAINED_S


def put(out: list[Event], count: int, room: int, one: Event) -> int:
    """Insert an event, sorted by time of detection; if there is no room, drop the first. Return the number of events."""
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


def verdict(events: list[Event], count: int, assessed: bool) -> int:
    """State of the vehicle (NOT_ASSESSED to AMBIGUOUS) from its events; assessed: at least one tick has been assessed."""
    unsure = False
    for i in range(count):
        if events[i].is_fault() and events[i].alternative_count == 0:
            return FAULT
        unsure = unsure or events[i].is_fault()
    if unsure:
        return AMBIGUOUS
    return HEALTHY if assessed else NOT_ASSESSED


def main_event(events: list[Event], count: int) -> int:
    """Index of the most important event, -1 if there is none. Unambiguous events precede ambiguous ones; then the first large loss, or an
    override before it (a later one is caused by the controller of a falling vehicle); the largest of losses that began together."""
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
    """Whether the event has this kind and, if `sure` is set, no alternatives."""
    return e.kind == kind and not (sure and e.alternative_count > 0)
