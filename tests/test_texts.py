"""What the pilot is shown: once, again when it has become something else, and when it is over; few texts, the gravest first."""

import numpy as np
import pytest

from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.events.changes import Known
from rotorwatch.engine.events.decisions import GRAVE, MATTERS, WORN
from rotorwatch.engine.events.events import CONTACT, LOSS, OUTPUT_OVERRIDE, TURNED_MOUNT
from rotorwatch.engine.events.texts import EVERY_S, OVER_S, Texts
from rotorwatch.engine.events.words import CRITICAL, INFO, NOTICE, WARNING, severity
from rotorwatch.engine.intake.deviations import OVERRIDDEN, STUCK


def loss(number=1, rotors=0b1, lost=0.3, width=0.05, end=LASTS, others=0, kind=LOSS, detail=0):
    """An event as `Changes` knows it. others: how many other sets explain it."""
    known = Known()
    known.number = number
    e = known.event
    e.kind, e.rotors, e.end, e.detail, e.alternative_count = kind, rotors, end, detail, others
    for k in range(bin(rotors).count("1")):
        e.loss[k], e.lower[k], e.upper[k] = lost, lost - width, lost + width
    return known


class Pilot:
    """Reads what is reported of the events that are there, ten times a second. heard: (time, severity, number of the event)."""

    def __init__(self, most=NOTICE):
        self.texts, self.most, self.now, self.heard = Texts(), most, 0.0, []

    def flies(self, seconds, *events):
        for _ in range(round(10 * seconds)):
            self.now += 0.1
            self.texts.look(list(events), len(events))
            place = self.texts.due(self.now, self.most)
            if place >= 0:
                number = self.texts.reported[place].number
                self.heard.append((self.now, self.texts.tell(place, self.now), number))
        return self

    @property
    def said(self):
        return [severity for _, severity, _ in self.heard]


def test_a_steady_loss_is_reported_once_at_once():
    pilot = Pilot().flies(1.0).flies(60.0, loss())
    assert pilot.said == [WARNING] and pilot.heard[0][0] < 1.2


def test_a_loss_that_wanders_within_its_interval_is_reported_once():
    rng, pilot = np.random.default_rng(1), Pilot()
    for _ in range(300):
        pilot.flies(0.2, loss(lost=0.3 + 0.04 * (2.0 * rng.random() - 1.0)))
    assert pilot.said == [WARNING]


def test_what_a_stuck_rotor_gives_is_reported_again_when_it_is_another_thrust():
    def stuck(gives):
        known = loss(lost=0.98, width=0.02)
        known.event.size = gives
        return known

    assert Pilot().flies(10.0, stuck(1.94)).flies(30.0, stuck(2.1)).said == [CRITICAL]
    assert Pilot().flies(10.0, stuck(1.94)).flies(30.0, stuck(3.3)).said == [CRITICAL, CRITICAL]


def test_a_loss_that_moves_within_a_wide_interval_is_reported_once():
    assert Pilot().flies(10.0, loss(lost=0.3)).flies(60.0, loss(lost=0.38, width=0.1)).said == [WARNING]


def test_a_loss_that_passes_a_line_of_severity_within_its_interval_is_reported_once():
    assert Pilot().flies(10.0, loss(lost=MATTERS - 0.01)).flies(60.0, loss(lost=MATTERS + 0.01)).said == [NOTICE]


def test_a_loss_that_leaves_what_was_reported_is_reported_again():
    pilot = Pilot().flies(10.0, loss(lost=0.3)).flies(10.0, loss(lost=0.42))
    assert pilot.said == [WARNING, WARNING]
    assert pilot.flies(10.0, loss(lost=0.3, rotors=0b10)).said == [WARNING] * 3, "another rotor is accused"


def test_what_is_taken_back_or_over_is_reported_when_it_had_been_reported():
    assert Pilot().flies(10.0, loss()).flies(10.0).said == [WARNING, INFO]
    assert Pilot().flies(10.0, loss()).flies(OVER_S, loss(end=9.0)).flies(10.0).said == [WARNING, INFO]
    assert Pilot().flies(10.0, loss()).flies(0.8 * OVER_S, loss(end=9.0)).said == [WARNING], "it may begin again"
    assert Pilot().flies(10.0, loss()).flies(5.0, loss(end=9.0)).flies(OVER_S, loss(end=9.0), loss(2)).said == [WARNING, WARNING]
    assert Pilot().flies(10.0, loss(lost=0.01)).flies(10.0).said == []
    pilot = Pilot().flies(1.0, loss()).flies(2.0, loss(), loss(2, 0b100)).flies(20.0, loss())
    assert pilot.said == [WARNING], "it came and went between two texts"


def test_what_was_said_to_be_over_and_is_not_is_reported_again():
    pilot = Pilot().flies(10.0, loss()).flies(OVER_S, loss(end=9.0)).flies(20.0, loss())
    assert pilot.said == [WARNING, INFO, WARNING]


def test_the_gravest_comes_first_and_never_two_within_the_time_between():
    events = [loss(1, 0b1, 0.1), loss(2, 0b10, 0.8), loss(3, 0b100, 0.3)]
    pilot = Pilot().flies(30.0, *events)
    assert pilot.said == [CRITICAL, WARNING, NOTICE] and [number for *_, number in pilot.heard] == [2, 3, 1]
    assert np.diff([time for time, *_ in pilot.heard]).min() >= EVERY_S - 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_a_flood_of_events_is_a_trickle_of_texts(seed):
    """A rotor that is lost and back every second for ten minutes: fewer and fewer texts."""
    rng, pilot, number = np.random.default_rng(seed), Pilot(), 0
    for _ in range(300):
        number += 1
        lost = 0.2 + 0.2 * rng.random()
        pilot.flies(1.0, loss(number, lost=lost)).flies(1.0, loss(number, lost=lost, end=pilot.now))
    times = [time for time, *_ in pilot.heard]
    assert len(times) <= 24 and np.diff(times).min() >= EVERY_S - 1e-6
    assert sum(time > 300.0 for time in times) < sum(time <= 300.0 for time in times)


def test_a_graver_loss_of_a_rotor_that_came_and_went_is_not_kept_waiting():
    pilot = Pilot().flies(6.0, loss(1, lost=0.3)).flies(OVER_S + 1.0, loss(1, lost=0.3, end=6.0))
    began = pilot.flies(6.0).now
    pilot.flies(6.0, loss(2, lost=0.9))
    assert pilot.said == [WARNING, INFO, CRITICAL] and pilot.heard[-1][0] < began + 0.2


def test_what_is_not_asked_for_is_not_reported():
    assert Pilot(most=0).flies(30.0, loss(lost=0.9)).said == []
    assert Pilot(most=WARNING).flies(30.0, loss(lost=0.1)).flies(10.0).said == []
    assert Pilot(most=WARNING).flies(30.0, loss(lost=0.3)).flies(10.0).said == [WARNING, INFO], "its end is reported, too"
    assert Pilot(most=INFO).flies(10.0, loss(lost=0.02)).said == [INFO]


@pytest.mark.parametrize(
    ("event", "wanted"),
    [
        (loss(lost=GRAVE), CRITICAL),
        (loss(lost=GRAVE, others=2), WARNING),
        (loss(lost=MATTERS), WARNING),
        (loss(lost=WORN), NOTICE),
        (loss(lost=WORN - 0.01), INFO),
        (loss(kind=OUTPUT_OVERRIDE, detail=STUCK), CRITICAL),
        (loss(kind=OUTPUT_OVERRIDE, detail=OVERRIDDEN), WARNING),
        (loss(kind=TURNED_MOUNT, rotors=0), WARNING),
        (loss(kind=CONTACT, rotors=0), NOTICE),
    ],
)
def test_severity_says_what_it_means_for_the_flight(event, wanted):
    assert severity(event.event, False) == wanted
    assert severity(event.event, True) == INFO
