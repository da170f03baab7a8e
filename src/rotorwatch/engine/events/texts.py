"""Selects the texts for the pilot and their timing: few texts, each with new information.

An event is reported once, again when it has changed significantly, and once more when it is withdrawn or has been over for OVER_S: a loss
that seems to end in a manoeuvre shows again in the next one. Texts are at least EVERY_S
apart; an event that changes in the meantime is reported in its latest state, and the most severe event is reported first. Events that are
over or withdrawn before they were reported are skipped. Repeated reports of an intermittent rotor or a changing loss come at increasing
intervals, unless it has become more severe.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, TIME, Real, Small, Struct, Time, array, copy, embedded, reset
from rotorwatch.engine.events.changes import Known
from rotorwatch.engine.events.events import CONTACT, LOSS, Event
from rotorwatch.engine.events.words import INFO, severity
from rotorwatch.engine.intake.sizes import REPORTED_EVENTS, ROTORS, TOGETHER

EVERY_S = 5.0  # least time between two texts
OVER_S = 20.0  # since the end of an event, until it is reported as over
MOVED = 0.05  # least change of a loss of effectiveness for a new report
GIVES = 0.2  # least relative change of a stuck rotor's thrust for a new report
AGAIN_S = 10.0  # time between two reports on one rotor; it doubles each time, up to AGAIN_MOST_S
AGAIN_MOST_S = 160.0
CALM_S = 300.0  # time without a report on a rotor after which AGAIN_S applies again


class Reported(Struct):
    """An event and its last report."""

    event = embedded(Event)  # current or last state
    number: int = 0  # as in `Changes`; 0: this place is free
    severity: Small = 0  # reported severity; 0: not reported yet
    present: bool = False  # still in the list of events
    over: bool = False  # its end was reported
    certain: bool = False  # it was reported without alternatives
    rotors: int = 0  # reported set of rotors
    loss = array(REAL, TOGETHER)  # reported losses
    gives: Real = 0.0  # reported thrust of a stuck rotor, hover thrusts


class Texts(Struct):
    """Tracks the reports of all events."""

    reported = array(Reported, REPORTED_EVENTS)
    last: Time = -LASTS  # s, when the last text was sent
    # For each rotor, and for events without a rotor: time of the last report, waiting time after it, and its severity.
    since = array(TIME, ROTORS + 1)
    wait = array(TIME, ROTORS + 1)
    grave = array(REAL, ROTORS + 1)

    def look(self, known: list[Known], count: int) -> None:
        """Take over the current events."""
        for i in range(REPORTED_EVENTS):
            self.reported[i].present = False
        for k in range(count):
            place = -1
            for i in range(REPORTED_EVENTS):
                if self.reported[i].number == known[k].number:
                    place = i
            if place < 0:
                place = self._free()
                reset(self.reported[place])
                self.reported[place].number = known[k].number
            copy(self.reported[place].event, known[k].event)
            self.reported[place].present = True
            if self.reported[place].over and not _over(known[k].event):  # its end was reported, yet it continues: treat it as a new event
                self.reported[place].over = False
                self.reported[place].severity = 0
        for i in range(REPORTED_EVENTS):
            gone = not self.reported[i].present
            if gone and (self.reported[i].severity == 0 or self.reported[i].over or self.reported[i].event.end < LASTS):
                self.reported[i].number = 0  # no report needs to be withdrawn

    def due(self, now: Time, most: int) -> int:
        """Index of the event to report now, -1 if there is none. most: MAV_SEVERITY of the least severe events to report."""
        if now - self.last < EVERY_S:
            return -1
        best = -1
        least = 0
        for i in range(REPORTED_EVENTS):
            if self.reported[i].number != 0:
                grave = self._new(self.reported[i], now, most)
                if grave > 0 and (best < 0 or grave < least):
                    best = i
                    least = grave
        return best

    def tell(self, place: int, now: Time) -> int:
        """Mark the event at this index as reported at `now` s; return its severity."""
        grave = _severity(self.reported[place])
        self.last = now
        if not self.reported[place].present:
            self.reported[place].number = 0
            return grave
        fresh = self.reported[place].severity == 0
        self.reported[place].severity = grave if grave < INFO or fresh else self.reported[place].severity
        self.reported[place].over = _over(self.reported[place].event)
        self.reported[place].certain = self.reported[place].event.alternative_count == 0
        self.reported[place].rotors = self.reported[place].event.rotors
        for k in range(TOGETHER):
            self.reported[place].loss[k] = self.reported[place].event.loss[k]
        self.reported[place].gives = _gives(self.reported[place].event)
        for r in range(ROTORS + 1):
            if _of(self.reported[place].event, r):
                if not self.reported[place].over:
                    calm = now - self.since[r] > CALM_S or self.wait[r] <= 0.0
                    self.wait[r] = AGAIN_S if calm else min(2.0 * self.wait[r], AGAIN_MOST_S)
                    self.grave[r] = 1.0 * grave
                self.since[r] = now
        return grave

    def _new(self, t: Reported, now: Time, most: int) -> int:
        """Severity of a report that is due for t; 0 if there is nothing new or it has to wait."""
        grave = _severity(t)
        over = _over(t.event) and not t.over and now - t.event.end >= OVER_S and not self._again(t)
        if t.severity > 0 and (not t.present or over):
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

    def _again(self, t: Reported) -> bool:
        """Whether a rotor of this event is weak again."""
        for i in range(REPORTED_EVENTS):
            later = self.reported[i].number > t.number and self.reported[i].present and not _over(self.reported[i].event)
            if later and (self.reported[i].event.rotors & t.event.rotors) != 0:
                return True
        return False

    def _free(self) -> int:
        """Index of a free place, else that of the oldest event."""
        place = 0
        for i in range(REPORTED_EVENTS):
            if self.reported[i].number == 0:
                return i
            if self.reported[i].number < self.reported[place].number:
                place = i
        return place


def _severity(t: Reported) -> int:
    """Severity of the event's next report."""
    return severity(t.event, not t.present)


def _over(e: Event) -> bool:
    return e.kind != CONTACT and e.end < LASTS


def _of(e: Event, r: int) -> bool:
    """Whether the event concerns rotor r, or no rotor if r is ROTORS."""
    if r == ROTORS:
        return e.rotors == 0
    return (e.rotors & (1 << r)) != 0


def _gives(e: Event) -> Real:
    """Hover thrusts that a stuck rotor gives whatever it is commanded; 0 for one that follows."""
    return e.size if e.kind == LOSS else 0.0


def _changed(t: Reported) -> bool:
    """Whether the event differs from its report: other rotors, alternatives added or removed, a stuck rotor's thrust changed by GIVES, or
    the reported loss outside the present interval and changed by MOVED."""
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
