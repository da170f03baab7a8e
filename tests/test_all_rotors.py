"""The section on the thrust command that all rotors share."""

from dataclasses import replace

import pytest

from rotorwatch.report import html
from rotorwatch.report.sections import all_rotors
from test_report import text_of


@pytest.mark.parametrize(
    ("shift", "half", "words"),
    [
        (0.01, 0.02, "thrust was the same at the end as at the beginning, within 2 %"),
        (0.3, 0.6, "thrust was the same at the end as at the beginning, within 15 %"),
        (0.3, 3.0, "varied too much"),
        (0.6, 0.06, "10 % more total thrust was commanded at the end than at the beginning (95 % interval 9 % to 11 %)"),
        (-0.6, 0.06, "10 % less total thrust was commanded at the end than at the beginning (95 % interval 9 % to 11 %)"),
    ],
)
def test_common_mode_in_words(fault, shift, half, words):
    there = {"thrust_shift": shift, "interval": [shift - half, shift + half], "unit": "hover thrusts of one rotor"}
    assert words in all_rotors.sentence(replace(fault, common_mode=there))


def test_it_is_in_every_view_where_it_was_assessed(fault):
    fault = replace(fault, trace=None)  # pages without plots are made faster
    there, absent = ((html.page(d), d.to_markdown(), text_of(d)) for d in (fault, replace(fault, common_mode={})))
    assert all("All rotors together" in text and "total commanded thrust was the same" in text for text in there)
    assert not any("All rotors together" in text for text in absent)
