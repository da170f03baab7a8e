"""Rotor positions in words."""

import pytest

from rotorwatch import airframes
from rotorwatch.answer import places
from rotorwatch.flight.vehicle import Rotor


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ("ardupilot-quad-x", ["front right", "rear left", "front left", "rear right"]),
        ("ardupilot-quad-plus", ["right", "left", "front", "rear"]),
        ("ardupilot-hexa-x", ["right", "left", "front left", "rear right", "front right", "rear left"]),
    ],
)
def test_frames(frame, words):
    assert list(places.names(airframes.named(frame).rotors)) == words


@pytest.mark.parametrize("frame", airframes.names())
def test_all_rotors_of_every_frame_have_places_of_their_own(frame):
    rotors = airframes.named(frame).rotors
    words = places.names(rotors)
    assert len(set(words)) == len(rotors) and all(words), words
    for rotor, word in zip(rotors, words, strict=True):
        assert ("front" in word) <= (rotor.x > 0) or "nearer the front" in word
        assert ("rear" in word) <= (rotor.x < 0) and ("left" in word) <= (rotor.y < 0) and ("right" in word) <= (rotor.y > 0)


def test_octa_x_has_two_rotors_in_each_corner():
    words = places.names(airframes.named("ardupilot-octa-x").rotors)
    assert "front right, nearer the front" in words and "front right, nearer the side" in words


def test_coaxial_pairs_have_an_upper_and_a_lower_rotor():
    rotors = [Rotor(1, 1, 1), Rotor(1, 1, -1, 0.85), Rotor(-1, -1, 1, 0.85), Rotor(-1, -1, -1), Rotor(1, -1, 1), Rotor(1, -1, -1)]
    assert places.names(rotors) == (
        "front right, upper", "front right, lower", "rear left, lower", "rear left, upper", "front left, upper",
        "front left, lower",
    )  # fmt: skip


def test_rotors_without_places_have_no_names():
    assert places.names([Rotor(0, 0, 1), Rotor(0, 0, -1)]) == ("", "")
