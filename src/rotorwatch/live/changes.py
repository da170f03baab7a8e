"""What is new about a list of events that is made again and again: announced, changed, or taken back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rotorwatch.diagnosis import Event

LOSS_STEP = 0.02  # by which a loss or a bound of it must move to be told again
SAME_S = 1.0  # two onsets so close are of one event
REFINED = ("loss_of_effectiveness", "loss_of_control")  # events whose rotors may turn out to be others
ANNOUNCED, CHANGED, WITHDRAWN, FINAL = "announced", "changed", "withdrawn", "final"


@dataclass(frozen=True)
class Change:
    """number: of the event, from 1, for as long as the vehicle is watched. what: announced, changed, withdrawn or final."""

    number: int
    what: str
    event: Event


class Changes:
    """Remembers what has been told."""

    def __init__(self):
        self._told: dict[int, Event] = {}
        self._count = 0

    @property
    def now(self) -> dict[int, Event]:
        """The events that hold, by number, as they were last told."""
        return self._told

    def of(self, events: Sequence[Event], final: bool = False) -> list[Change]:
        """What is worth telling of the events as they are now. final: nothing will come after, so that any difference is told."""
        found: list[Change] = []
        left, numbers = dict(self._told), {}
        for same in (_equal, _alike):
            for index, event in enumerate(events):
                number = (
                    next((n for n, old in left.items() if same(old, event)), None) if index not in numbers else None
                )
                if number is not None:
                    numbers[index] = number
                    del left[number]
        for number, old in left.items():
            found.append(Change(number, WITHDRAWN, old))
            del self._told[number]
        for index, event in enumerate(events):
            if index not in numbers:
                self._count += 1
                numbers[index] = self._count
                found.append(Change(self._count, ANNOUNCED, event))
            elif self._told[numbers[index]] == event or not (final or _differs(self._told[numbers[index]], event)):
                continue
            else:
                found.append(Change(numbers[index], FINAL if final else CHANGED, event))
            self._told[numbers[index]] = event
        return found


def _equal(old: Event, new: Event) -> bool:
    return (old.kind, old.rotors, old.detected_s) == (new.kind, new.rotors, new.detected_s)


def _alike(old: Event, new: Event) -> bool:
    """One event of which more is known now: what began together, was announced together, or has the same rotors at the same time."""
    if old.kind != new.kind or (old.kind not in REFINED and old.rotors != new.rotors):
        return False
    return abs(old.onset_s - new.onset_s) < SAME_S or old.detected_s == new.detected_s


def _differs(old: Event, new: Event) -> bool:
    if (old.rotors, old.alternatives, old.end_s is None) != (new.rotors, new.alternatives, new.end_s is None):
        return True
    if len(old.loss) != len(new.loss) or any(old.extra.get(k) != new.extra.get(k) for k in ("override", "cause")):
        return True
    numbers = zip(
        (*old.loss, *(x for pair in old.interval for x in pair)),
        (*new.loss, *(x for pair in new.interval for x in pair)),
    )
    return any(abs(a - b) >= LOSS_STEP for a, b in numbers)
