"""What a pilot is told of the events, and when: announced, over, taken back; changed only where what was said is wrong by now; one text in
EVERY_S at most, the gravest first. What has not been told is neither over nor taken back."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Mask, Real, Small, Struct, Time, array, copy, embedded, reset
from rotorwatch.engine.front.changes import Changes
from rotorwatch.engine.front.events import CONTACT, LOSS, Event
from rotorwatch.engine.front.sizes import EVENTS, TOGETHER
from rotorwatch.engine.front.words import NOTICE, severity

EVERY_S = 5.0  # between two texts


class Told(Struct):
    """An event as it was told last. number: of the event, 0: nothing was told."""

    loss = array(REAL, TOGETHER)
    lower = array(REAL, TOGETHER)
    upper = array(REAL, TOGETHER)
    size: Real = 0.0
    number: int = 0
    rotors: Mask = 0
    others: Small = 0  # sets that would look the same
    kind: Small = LOSS
    over: bool = False

    def take(self, e: Event, number: int) -> None:
        """It is told."""
        for i in range(TOGETHER):
            self.loss[i] = e.loss[i]
            self.lower[i] = e.lower[i]
            self.upper[i] = e.upper[i]
        self.size = e.size
        self.number = number
        self.rotors = e.rotors
        self.others = e.alternative_count
        self.kind = e.kind
        self.over = e.end < LASTS

    def give(self, e: Event) -> None:
        """The event, as far as a text needs it."""
        reset(e)
        for i in range(TOGETHER):
            e.loss[i] = self.loss[i]
            e.lower[i] = self.lower[i]
            e.upper[i] = self.upper[i]
        e.size = self.size
        e.rotors = self.rotors
        e.kind = self.kind

    def wrong(self, e: Event) -> bool:
        """Whether what was told holds no longer: other rotors, over or not, or a loss that lies outside of the interval."""
        if self.rotors != e.rotors or (self.others > 0) != (e.alternative_count > 0):
            return True
        if self.kind != CONTACT and self.over != (e.end < LASTS):
            return True
        for i in range(TOGETHER):
            if e.loss[i] < self.lower[i] or e.loss[i] > self.upper[i]:
                return True
        return False


class Telling(Struct):
    """What was told. event, withdrawn: the last text."""

    told = array(Told, EVENTS)
    event = embedded(Event)
    withdrawn: bool = False
    last: Time = -LASTS  # s, when

    def next(self, changes: Changes, now: Time) -> int:
        """The severity of the text that is due, -1: none. changes: all events as they are; now: s."""
        if now - self.last < EVERY_S:
            return -1
        gravest = NOTICE + 1
        known = -1
        place = -1
        for i in range(changes.count):
            e = changes.known[i].event
            mine = self._of(changes.known[i].number)
            grave = severity(e, False)
            if (mine < 0 or self.told[mine].wrong(e)) and grave < gravest:
                gravest = grave
                known = i
                place = mine
        self.withdrawn = False
        for i in range(EVENTS):
            # What was over is forgotten one day; that is nothing new.
            if self.told[i].number > 0 and not _is_known(changes, self.told[i].number):
                if self.told[i].over or self.told[i].kind == CONTACT:
                    self.told[i].number = 0
                elif NOTICE < gravest:
                    gravest = NOTICE
                    place = i
                    self.withdrawn = True
        if gravest > NOTICE:
            return -1
        self.last = now
        if self.withdrawn:
            self.told[place].give(self.event)
            self.told[place].number = 0
            return gravest
        copy(self.event, changes.known[known].event)
        if place < 0:
            place = self._of(0)
        if place >= 0:
            self.told[place].take(self.event, changes.known[known].number)
        return gravest

    def _of(self, number: int) -> int:
        """Place of what was told of an event, or of the first that is free; -1 without one."""
        for i in range(EVENTS):
            if self.told[i].number == number:
                return i
        return -1


def _is_known(changes: Changes, number: int) -> bool:
    for i in range(changes.count):
        if changes.known[i].number == number:
            return True
    return False
