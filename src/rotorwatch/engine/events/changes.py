"""Changes of the list of events from one evaluation to the next: events announced, changed or withdrawn."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import INT, LASTS, Real, Small, Struct, Time, array, copy, embedded, local
from rotorwatch.engine.events.decisions import SAME_S
from rotorwatch.engine.events.events import LOSS, TURNED_MOUNT, Event
from rotorwatch.engine.intake.sizes import EVENTS, TOGETHER

ANNOUNCED, CHANGED, WITHDRAWN = 0, 1, 2

LOSS_STEP = 0.02  # least change of a loss or of its bounds that is reported
GIVES_STEP = 0.1  # hover thrusts, least change of a stuck rotor's thrust that is reported
HOLD_S = 5.0  # for which an event must be missing to be withdrawn: its interval may include 0, and not a second later


class Known(Struct):
    """An event as it was last reported. number: identifies the event, from 1, for as long as it is remembered."""

    event = embedded(Event)
    missing: Time = LASTS  # s, since when it has not been in the list; LASTS: it is
    number: int = 0


class Change(Struct):
    """A change of an event. what: ANNOUNCED, CHANGED, WITHDRAWN; place: index of the event in the list or, if withdrawn, in the list of
    withdrawn events."""

    number: int = 0
    place: Small = 0
    what: Small = ANNOUNCED


class Changes(Struct):
    """Tracks the reported events."""

    known = array(Known, EVENTS)
    numbers: int = 0
    count: Small = 0

    def look(
        self, events: list[Event], count: int, now: Time, final: Time, refined: int, every: bool, withdrawn: list[Event], out: list[Change]
    ) -> int:
        """Compare the current events with the reported ones; write the changes into out [2 EVENTS] and return their number.

        now: time in s, by which an event must have been missing for HOLD_S to be withdrawn; LASTS: at once. final: time in s before which
        nothing is withdrawn: a missing event that ended earlier was only forgotten. refined: kind of events whose rotors, like those of
        losses, may be revised. every: list every known event, even without a significant change. withdrawn [EVENTS]: filled with the
        withdrawn events.
        """
        known_of = local(INT, EVENTS)  # index of the reported event, -1 if new
        event_of = local(INT, EVENTS)
        found = 0
        left = 0
        fresh = False
        withdrawn_count = 0
        for i in range(EVENTS):
            known_of[i] = -1
            event_of[i] = -1
        for way in range(3):
            for i in range(count):
                for j in range(self.count):
                    if known_of[i] < 0 and event_of[j] < 0:
                        old = self.known[j].event
                        if way == 0:
                            same = _equal(old, events[i])
                        elif way == 1:
                            same = _alike(old, events[i], refined)
                        else:
                            same = _goes_on(old, events[i])
                        if same:
                            known_of[i] = j
                            event_of[j] = i
        for i in range(count):
            fresh = fresh or known_of[i] < 0
        for j in range(self.count):
            if event_of[j] >= 0:
                known_of[event_of[j]] = left
                if left != j:
                    copy(self.known[left], self.known[j])
                self.known[left].missing = LASTS
                left += 1
            elif not fresh and now < LASTS and now - min(self.known[j].missing, now) < HOLD_S:  # a new event would be what it was
                self.known[j].missing = min(self.known[j].missing, now)
                if left != j:
                    copy(self.known[left], self.known[j])
                left += 1
            elif not self.known[j].event.end < final:
                copy(withdrawn[withdrawn_count], self.known[j].event)
                out[found].number = self.known[j].number
                out[found].place = withdrawn_count
                out[found].what = WITHDRAWN
                found += 1
                withdrawn_count += 1
        self.count = left
        for i in range(count):
            fresh = known_of[i] < 0
            if fresh:
                known_of[i] = self.count
                self.count += 1
                self.numbers += 1
                self.known[known_of[i]].number = self.numbers
                self.known[known_of[i]].missing = LASTS
            place = known_of[i]
            if fresh or every or _differs(self.known[place].event, events[i]):
                copy(self.known[place].event, events[i])
                out[found].number = self.known[place].number
                out[found].place = i
                out[found].what = ANNOUNCED if fresh else CHANGED
                found += 1
        return found


def _same_time(a: Time, b: Time) -> bool:
    return not (a < b or b < a)


def _equal(old: Event, new: Event) -> bool:
    return old.kind == new.kind and old.rotors == new.rotors and _same_time(old.detected, new.detected)


def _alike(old: Event, new: Event, refined: int) -> bool:
    """Whether both are one event with refined data: the same kind, and the same onset within SAME_S or time of detection; other rotors are
    accepted for losses and the refined kind only."""
    if old.kind != new.kind or (old.kind != LOSS and old.kind != refined and old.rotors != new.rotors):
        return False
    return abs(old.onset - new.onset) < SAME_S or _same_time(old.detected, new.detected)


def _goes_on(old: Event, new: Event) -> bool:
    """Whether both are the same continuing loss or turned mount, of which there can be only one: the onset of one found in the trim moves
    when it is evaluated again."""
    lasts = old.end >= LASTS and new.end >= LASTS
    return lasts and old.kind == new.kind and old.rotors == new.rotors and (old.kind == LOSS or old.kind == TURNED_MOUNT)


def _moved(old: Real, new: Real) -> bool:
    return abs(new - old) >= LOSS_STEP


def _differs(old: Event, new: Event) -> bool:
    if old.rotors != new.rotors or old.alternative_count != new.alternative_count or old.detail != new.detail:
        return True
    if new.kind == LOSS and (abs(old.size - new.size) >= GIVES_STEP or (old.size > 0.0) != (new.size > 0.0)):
        return True
    if (old.end < LASTS) != (new.end < LASTS) or abs(old.onset - new.onset) >= SAME_S:
        return True
    for i in range(new.alternative_count):
        if old.alternatives[i] != new.alternatives[i]:
            return True
    for i in range(TOGETHER):
        if _moved(old.loss[i], new.loss[i]) or _moved(old.lower[i], new.lower[i]) or _moved(old.upper[i], new.upper[i]):
            return True
    return False
