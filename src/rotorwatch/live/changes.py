"""What is new about a list of events that is made again and again (engine/front/changes.py), in words: announced, changed, withdrawn or
final."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.front import changes, whole
from rotorwatch.engine.front import events as listed
from rotorwatch.engine.front.sizes import EVENTS
from rotorwatch.engine.host.events import packed
from rotorwatch.flight import kinds
from rotorwatch.flight.diagnosis import Event

ANNOUNCED, CHANGED, WITHDRAWN, FINAL = "announced", "changed", "withdrawn", "final"
NAMES = {changes.ANNOUNCED: ANNOUNCED, changes.CHANGED: CHANGED, changes.WITHDRAWN: WITHDRAWN}


@dataclass(frozen=True)
class Change:
    """number: of the event, from 1, for as long as the vehicle is watched. what: announced, changed, withdrawn or final."""

    number: int
    what: str
    event: Event


class Changes:
    """Remembers what has been announced. now: the events that hold, by number, as they were last announced."""

    def __init__(self):
        self.now: dict[int, Event] = {}
        self._known = ENGINE.new(changes.Changes)
        self._room = ENGINE.array(listed.Event, EVENTS), ENGINE.array(changes.Change, 2 * EVENTS)

    def since_last(self, events: Sequence[Event], final: bool = False) -> list[Change]:
        """What is new about the events as they are now. final: nothing will come after, so that any difference is announced."""
        withdrawn, out = self._room
        refined, never = kinds.number(kinds.LOST), -listed.LASTS
        arguments = packed(events), min(len(events), EVENTS), never, refined, final, withdrawn, out
        count = ENGINE.call(whole.changes, self._known, *arguments)
        found = []
        for number, place, what in zip(*(out[name][:count].tolist() for name in ("number", "place", "what"))):
            if what == changes.WITHDRAWN:
                found.append(Change(number, WITHDRAWN, self.now.pop(number)))
            elif self.now.get(number) != events[place]:
                self.now[number] = events[place]
                found.append(Change(number, FINAL if final and what == changes.CHANGED else NAMES[what], events[place]))
        return found
