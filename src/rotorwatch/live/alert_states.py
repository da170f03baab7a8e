"""Changes of a list of events that is computed repeatedly (engine/events/changes.py), in words: announced, changed, withdrawn or final."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rotorwatch.engine.bindings.event_rows import packed
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.events import calls, changes
from rotorwatch.engine.events import events as listed
from rotorwatch.engine.intake.sizes import EVENTS
from rotorwatch.flight import kinds
from rotorwatch.flight.diagnosis import Event

ANNOUNCED, CHANGED, WITHDRAWN, FINAL = "announced", "changed", "withdrawn", "final"
NAMES = {changes.ANNOUNCED: ANNOUNCED, changes.CHANGED: CHANGED, changes.WITHDRAWN: WITHDRAWN}


@dataclass(frozen=True)
class Change:
    """number: of the event, from 1, unique while the vehicle is watched. what: announced, changed, withdrawn or final."""

    number: int
    what: str
    event: Event


class Changes:
    """Keeps the announced events. now: the valid events, by number, as last announced."""

    def __init__(self):
        self.now: dict[int, Event] = {}
        self._known = ENGINE.new(changes.Changes)
        self._room = ENGINE.array(listed.Event, EVENTS), ENGINE.array(changes.Change, 2 * EVENTS)

    def since_last(self, events: Sequence[Event], final: bool = False) -> list[Change]:
        """Changes of the events since the last call. final: nothing will follow, so that any difference is announced."""
        withdrawn, out = self._room
        refined, never = kinds.number(kinds.LOST), -listed.LASTS
        arguments = packed(events), min(len(events), EVENTS), never, refined, final, withdrawn, out
        count = ENGINE.call(calls.changes, self._known, *arguments)
        changed = []
        for number, place, what in zip(*(out[name][:count].tolist() for name in ("number", "place", "what"))):
            if what == changes.WITHDRAWN:
                changed.append(Change(number, WITHDRAWN, self.now.pop(number)))
            elif self.now.get(number) != events[place]:
                self.now[number] = events[place]
                changed.append(Change(number, FINAL if final and what == changes.CHANGED else NAMES[what], events[place]))
        return changed
