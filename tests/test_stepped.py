"""Losses that grew in a step, and cut-outs that repeat, as they are reported."""

import pytest

from rotorwatch.diagnose import diagnose
from test_diagnose import HEALTHY, flight, losses, sample, weakened


def test_a_loss_that_grew_in_a_step_is_reported_with_both_sizes():
    grew = weakened(weakened(flight(sample(HEALTHY)), 2, 0.25, ((45.0, 1e9),)), 2, 0.55, ((75.0, 1e9),))
    answer = diagnose(grew)
    (event,) = losses(answer)
    assert event.extra["first_loss"] == pytest.approx(0.25, abs=0.06) and event.extra["stepped_s"] == pytest.approx(75.0, abs=1.0)
    assert event.loss[0] == pytest.approx(1.0 - 0.75 * 0.45, abs=0.08) and event.onset_s == pytest.approx(45.0, abs=0.5)
    first, later = (f"{100 * value:.0f} %" for value in (event.extra["first_loss"], event.loss[0]))
    assert answer.headline.startswith(f"Rotor 2 (rear left) lost {first} of thrust at {event.onset_s:.2f} s, and {later}")
    assert f"from {event.extra['stepped_s']:.2f} s on" in answer.headline and "until 7" in event.reason


def test_a_loss_of_one_size_has_no_step():
    (event,) = losses(diagnose(weakened(flight(sample(HEALTHY)), 2, 0.5, ((45.0, 1e9),))))
    assert "first_loss" not in event.extra and "stepped_s" not in event.extra


def test_cut_outs_that_repeat_are_reported_with_their_number_and_period():
    spans = tuple((36.0 + 28.0 * k, 46.0 + 28.0 * k) for k in range(3))
    answer = diagnose(weakened(flight(sample(HEALTHY)), 2, 0.25, spans))
    assert len(losses(answer)) == 3 and "(the first of 3 events, one every 28." in answer.headline


def test_cut_outs_at_any_time_are_reported_with_the_time_they_took():
    spans = ((36.0, 46.0), (58.0, 68.0), (100.0, 110.0))
    answer = diagnose(weakened(flight(sample(HEALTHY)), 2, 0.25, spans))
    assert len(losses(answer)) == 3 and "(the first of 3 events in 64 s)" in answer.headline
