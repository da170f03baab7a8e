"""What the pilot is told of the events, and when: few texts, each of which says something new.

An event is told once, again when it has become another one, and once more when it is over or taken back. Between two texts pass
EVERY_S; what changes in the meantime is told as it is then, and the gravest comes first. What is over, or taken back, before it was told
is not told. Of a rotor that comes and goes, and of a loss that changes, is told after a longer and longer time, unless it has become
graver.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, TIME, Real, Small, Struct, Time, array, copy, embedded, reset
from rotorwatch.engine.events.changes import Known
from rotorwatch.engine.events.events import CONTACT, LOSS, Event
from rotorwatch.engine.events.words import INFO, severity
from rotorwatch.engine.intake.sizes import EVENTS, ROTORS, TOGETHER

EVERY_S = 5.0  # between two texts
MOVED = 0.05  # of effectiveness, by which a loss must have changed at least to be told again
GIVES = 0.2  # share by which what a rotor gives that follows no command must have changed to be told again
AGAIN_S = 10.0  # between what was told of a rotor and what is new of it; twice as long each time, up to
AGAIN_MOST_S = 160.0
CALM_S = 300.0  # without an event of its own, after which a rotor is as if nothing had been told of it


class Told(Struct):
    """An event, and what was told of it."""

    event = embedded(Event)  # as it is now, or was
    number: int = 0  # of `Changes`; 0: this place is free
    severity: Small = 0  # that was told; 0: nothing yet
    present: bool = False  # among the events
    over: bool = False  # its end was told
    certain: bool = False  # it was told without other explanations
    rotors: int = 0  # that were told
    loss = array(REAL, TOGETHER)
    gives: Real = 0.0  # that was told of a rotor that follows no command


class Texts(Struct):
    """Remembers what was told."""

    told = array(Told, EVENTS + 4)
    last: Time = -LASTS  # when a text was sent
    # Of each rotor, and of what has no rotor: when it was told of last, how gravely, and how long it then waits.
    since = array(TIME, ROTORS + 1)
    wait = array(TIME, ROTORS + 1)
    grave = array(REAL, ROTORS + 1)

    def look(self, known: list[Known], count: int) -> None:
        """The events as they are known now."""
        for i in range(EVENTS + 4):
            self.told[i].present = False
        for k in range(count):
            place = -1
            for i in range(EVENTS + 4):
                if self.told[i].number == known[k].number:
                    place = i
            if place < 0:
                place = self._free()
                reset(self.told[place])
                self.told[place].number = known[k].number
            copy(self.told[place].event, known[k].event)
            self.told[place].present = True
            if self.told[place].over and not _over(known[k].event):  # it was said to be over, and is not: as if it were another one
                self.told[place].over = False
                self.told[place].severity = 0
        for i in range(EVENTS + 4):
            gone = not self.told[i].present
            if gone and (self.told[i].severity == 0 or self.told[i].over or self.told[i].event.end < LASTS):
                self.told[i].number = 0  # nothing is to be taken back

    def due(self, now: Time, most: int) -> int:
        """Place of the event to tell of now; -1 without one. most: severity of the least grave events that are told at all."""
        if now - self.last < EVERY_S:
            return -1
        best = -1
        least = 0
        for i in range(EVENTS + 4):
            if self.told[i].number != 0:
                grave = self._new(self.told[i], now, most)
                if grave > 0 and (best < 0 or grave < least):
                    best = i
                    least = grave
        return best

    def tell(self, place: int, now: Time) -> int:
        """The event at this place is told of: its severity."""
        grave = _severity(self.told[place])
        self.last = now
        if not self.told[place].present:
            self.told[place].number = 0
            return grave
        fresh = self.told[place].severity == 0
        self.told[place].severity = grave if grave < INFO or fresh else self.told[place].severity
        self.told[place].over = _over(self.told[place].event)
        self.told[place].certain = self.told[place].event.alternative_count == 0
        self.told[place].rotors = self.told[place].event.rotors
        for k in range(TOGETHER):
            self.told[place].loss[k] = self.told[place].event.loss[k]
        self.told[place].gives = _gives(self.told[place].event)
        for r in range(ROTORS + 1):
            if _of(self.told[place].event, r):
                if not self.told[place].over:
                    calm = now - self.since[r] > CALM_S or self.wait[r] <= 0.0
                    self.wait[r] = AGAIN_S if calm else min(2.0 * self.wait[r], AGAIN_MOST_S)
                    self.grave[r] = 1.0 * grave
                self.since[r] = now
        return grave

    def _new(self, t: Told, now: Time, most: int) -> int:
        """Severity of what is new about it; 0: nothing, or nothing that is told yet."""
        grave = _severity(t)
        if t.severity > 0 and (not t.present or (_over(t.event) and not t.over)):
            return grave
        if grave > most or not t.present or _over(t.event):
            return 0
        if t.severity > 0 and not _changed(t):
            return 0
        for r in range(ROTORS + 1):
            if _of(t.event, r) and self.wait[r] > 0.0:
                graver = 1.0 * grave < self.grave[r]
                if not graver and now - self.since[r] < self.wait[r]:
                    return 0
        return grave

    def _free(self) -> int:
        """A place for one more: a free one, else that of the event that was told of first."""
        place = 0
        for i in range(EVENTS + 4):
            if self.told[i].number == 0:
                return i
            if self.told[i].number < self.told[place].number:
                place = i
        return place


def _severity(t: Told) -> int:
    """Of what is to be told of it."""
    return severity(t.event, not t.present)


def _over(e: Event) -> bool:
    return e.kind != CONTACT and e.end < LASTS


def _of(e: Event, r: int) -> bool:
    """Whether it is of rotor r, or of none where r is ROTORS."""
    if r == ROTORS:
        return e.rotors == 0
    return (e.rotors & (1 << r)) != 0


def _gives(e: Event) -> Real:
    """Hover thrusts that its rotor gives, whatever it is commanded; 0 of one that follows."""
    return e.size if e.kind == LOSS else 0.0


def _changed(t: Told) -> bool:
    """Whether it is another event than the one that was told: of other rotors, certain or no longer so, or of a loss whose interval has
    left what was told."""
    gives = _gives(t.event)
    if (t.gives > 0.0) != (gives > 0.0) or abs(gives - t.gives) > GIVES * t.gives:
        return True
    if gives > 0.0:
        return t.rotors != t.event.rotors or t.certain != (t.event.alternative_count == 0)
    if t.rotors != t.event.rotors or t.certain != (t.event.alternative_count == 0):
        return True
    for k in range(TOGETHER):
        left = t.loss[k] < t.event.lower[k] or t.loss[k] > t.event.upper[k]
        if left and abs(t.loss[k] - t.event.loss[k]) >= MOVED:
            return True
    return False
