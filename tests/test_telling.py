"""What a pilot is told: seldom, the gravest first, and nothing twice that still holds."""

import pytest
from tests.plain import copied, filled

from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.front.changes import Change, Changes
from rotorwatch.engine.front.events import CONTACT, LOSS, OUTPUT_OVERRIDE, TURNED_MOUNT, Event
from rotorwatch.engine.front.sizes import EVENTS
from rotorwatch.engine.front.telling import EVERY_S, Telling
from rotorwatch.engine.front.words import CRITICAL, NOTICE, WARNING, severity


def one(kind, **fields):
    return filled(Event(), **{"kind": kind, "rotors": 1, "onset": 10.0, "detected": 10.3} | fields)


def loss(rotor=3, size=0.32, half=0.04, **more):
    bounds = {"rotors": 1 << (rotor - 1), "loss": [size], "lower": [size - half], "upper": [size + half]}
    return one(LOSS, **bounds | more)


class Pilot:
    """Who is told of a list of events that is made again and again."""

    def __init__(self):
        self.changes, self.telling, self.now = Changes(), Telling(), 0.0

    def hears(self, *events, after=EVERY_S):
        """(severity, rotors, what) of the text that is due so much later, or None."""
        self.now += after
        room, out = [Event() for _ in range(EVENTS)], [Change() for _ in range(2 * EVENTS)]
        self.changes.look([copied(e) for e in events], len(events), -LASTS, -1, False, room, out)
        found, e = self.telling.next(self.changes, self.now), self.telling.event
        what = "taken back" if self.telling.withdrawn else "over" if e.end < LASTS else "holds"
        return None if found < 0 else (found, e.rotors, what)


def test_a_loss_is_told_once_and_again_where_it_left_the_interval():
    pilot = Pilot()
    assert pilot.hears() is None
    assert pilot.hears(loss()) == (CRITICAL, 4, "holds")
    for size in (0.30, 0.34, 0.29, 0.35):
        assert pilot.hears(loss(size=size)) is None, "what was told still holds"
    assert pilot.hears(loss(size=0.42)) == (CRITICAL, 4, "holds")
    assert pilot.hears(loss(size=0.42, alternatives=[1], alternative_count=1)) == (WARNING, 4, "holds")
    assert pilot.hears(loss(size=0.42, end=40.0)) == (NOTICE, 4, "over")
    assert pilot.hears(loss(size=0.42, end=40.0)) is None


def test_what_is_taken_back_was_told():
    pilot = Pilot()
    assert pilot.hears(loss()) == (CRITICAL, 4, "holds")
    assert pilot.hears(loss(), loss(1, detected=99.0), after=0.1) is None
    assert pilot.hears() == (NOTICE, 4, "taken back"), "the other one came and went untold"
    assert pilot.hears() is None


def test_the_gravest_comes_first_and_one_text_at_a_time():
    pilot, three = Pilot(), (loss(1, 0.1), loss(2, 0.5, detected=11.0), loss(3, 0.03, 0.01, detected=12.0))
    assert pilot.hears(*three) == (CRITICAL, 2, "holds")
    assert pilot.hears(*three, after=EVERY_S - 0.1) is None
    assert pilot.hears(*three, after=0.2) == (WARNING, 1, "holds")
    assert pilot.hears(*three) == (NOTICE, 4, "holds")
    assert pilot.hears(*three) is None


@pytest.mark.parametrize(
    ("event", "grave"),
    [
        (loss(size=0.2), CRITICAL),
        (loss(size=0.19), WARNING),
        (loss(size=0.03, half=0.01), NOTICE),
        (one(LOSS, size=1.4), CRITICAL),
        (one(OUTPUT_OVERRIDE), CRITICAL),
        (one(TURNED_MOUNT, rotors=0), WARNING),
        (one(CONTACT, rotors=0), NOTICE),
        (loss(size=0.5, end=40.0), NOTICE),
    ],
)
def test_how_grave_is_what_it_means_for_the_flight(event, grave):
    assert severity(event, False) == grave and severity(event, True) == NOTICE
