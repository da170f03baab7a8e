"""A loss that begins and is announced near the height of take-off may be the ground's."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch.flight import Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses import near_ground


class Flown:
    """A flight whose position alone is known: from 100 m below the origin it climbs at 10 s to so many metres for 40 s."""

    def __init__(self, height, until=60.0):
        time = np.arange(0.0, until, 0.1)
        down = 100.0 - np.where((time > 10.0) & (time < 50.0), height, 0.0)
        self.position = Signal(time, np.stack([0.0 * time, 0.0 * time, down], axis=1), ("n", "e", "d"), "m", "NED")

    def has(self, name):
        return name == "position"

    def __getitem__(self, name):
        return self.position


def loss(onset_s, detected_s, end_s=None):
    return Event(LOSS, (2,), onset_s, detected_s, end_s, (0.4,), ((0.3, 0.5),), 0.99)


AIR = [(5.0, 52.0)]


@pytest.mark.parametrize("onset, detected, low", [(20, 21, False), (49, 51, False), (8, 12, False), (51, 51.5, True)])
def test_only_what_begins_and_is_announced_low(onset, detected, low):
    assert near_ground.explains(Flown(6.0), AIR, onset, detected) is low


@pytest.mark.parametrize("height, low", [(0.3, True), (0.7, False)])
def test_how_low(height, low):
    assert near_ground.explains(Flown(height), AIR, 20, 21) is low


def test_a_log_that_begins_in_the_air_does_not_show_the_ground():
    assert not near_ground.explains(Flown(0.3), [(0.5, 52.0)], 20, 21)


def test_a_height_of_zeros_is_not_measured():
    assert not near_ground.explains(Flown(0.0), AIR, 20, 21)


def test_a_height_that_is_not_known_explains_nothing():
    flown = Flown(0.3, until=19.0)
    assert not near_ground.explains(flown, AIR, 22, 23)  # the last position is older than 2 s
    assert not near_ground.explains(flown, [(30.0, 40.0)], 12, 13)  # not in the air
    flown.has = lambda name: False
    assert not near_ground.explains(flown, AIR, 12, 13)


def test_the_warning_names_rotor_and_time():
    text = near_ground.warning(loss(51.0, 51.5), "near the ground")
    assert "51.0 s" in text and "rotor 2" in text and "not counted" in text


@pytest.mark.parametrize("ends, carried, kept", [(40.0, False, 40.0), (51.0, False, None), (40.0, True, None), (None, True, None)])
def test_a_loss_does_not_end_on_the_ground_or_near_it(ends, carried, kept):
    view = SimpleNamespace(
        hovers=True, flight=Flown(6.0), air=AIR, warnings=[], spins_from=lambda onset: False, stands=lambda time: carried and time > 30.0
    )
    (event,) = near_ground.WITNESSES[0].hear(view, (loss(20.0, 21.0, ends),))
    assert event.end_s == kept and not view.warnings
