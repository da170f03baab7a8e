"""The words of the report: frame, rotors, the comparison with healthy flights."""

from dataclasses import replace

import pytest

from conftest import against_healthy, hexa_diagnosis
from rotorwatch import report
from rotorwatch.flight.diagnosis import RotorState
from rotorwatch.report.sections import event_list, healthy_flights
from test_report import text_of


def event(**changes):
    return replace(hexa_diagnosis().events[0], **changes)


def test_the_main_event_is_pointed_out_among_several_only(fault):
    two = hexa_diagnosis(events=(event(), event(rotors=(5,), onset_s=40.0, detected_s=40.5)))
    assert "main event" not in event_list.page(fault, {}) and event_list.page(two, {}).count("main event") == 1
    assert "(main)" not in text_of(fault) and text_of(two).count("(main)") == 1


def test_what_is_known_of_the_frame(fault):
    assert report.frame(fault) == "ardupilot-hexa-x, 6 rotors"
    assert report.frame(replace(fault, flight={"rotors": 4})) == "4 rotors"
    assert report.frame(replace(fault, flight={"frame": "hexa"})) == "hexa"
    assert report.frame(replace(fault, flight={})) == "unknown frame"


@pytest.mark.parametrize(
    "state, loss, interval",
    [
        (RotorState(1, 0.374, (0.33, 0.41), "degraded"), "37.4 %", "33–41 %"),
        (RotorState(1, 0.0, (0.0, 1.0), "unobservable"), "?", ""),
        (RotorState(1, 0.0, (0.0, 0.5), "suspect"), "?", "0–50 %"),
        (RotorState(1, 0.2, (0.0, 0.5), "suspect"), "20.0 %", "0–50 %"),
        (RotorState(1, 0.0, (0.0, 1.0), "healthy", "", (-0.01, 0.04)), "none seen", "at most 4 % in flight"),
        (RotorState(1, 0.01, (0.0, 0.03), "healthy", "", (-0.01, 0.04), "healthy"), "1.0 %", "0–3 %"),
    ],
)
def test_a_rotor_in_words(state, loss, interval):
    assert (report.rotor_loss(state), report.rotor_interval(state)) == (loss, interval)


def test_the_comparison_with_healthy_flights_in_words():
    rows = dict(healthy_flights.rows(against_healthy()))
    assert rows["answer"] == "fault found: rotor 3 lost thrust" and rows["compared with"] == "3 healthy flights of this build"
    assert rows["what explains the difference"] == "rotor 3 (front left) 90 %; a shifted centre of mass 6 %"
    assert rows["all rotors together"].startswith("11 % more command")
    assert dict(healthy_flights.rows(against_healthy(common=-0.1)))["all rotors together"].startswith("10 % less command")
    assert dict(healthy_flights.rows(against_healthy(common=0.0)))["all rotors together"].startswith("0 % less command")
    assert dict(healthy_flights.rows(against_healthy(flights=1)))["compared with"] == "1 healthy flight of this build"
    assert "all rotors together" not in dict(healthy_flights.rows(against_healthy(verdict="inconclusive")))
    assert healthy_flights.rows(hexa_diagnosis()) == []


def test_a_headline_is_short_and_says_how_much_it_leaves_out():
    from rotorwatch.answer.wording import LONGEST, headline

    lost = "Rotor 1 (right) lost 99 % (88–100 %) of thrust from 30.45 s until the landing at 85.77 s (the first of 2 events)."
    sank = "Without it the vehicle sank by 6 m in 2.7 s: the others gave 86 % of its weight, and could carry 170 %; and so on."
    said = 'At 27.58 s the autopilot reported an estimator fault ("EKF3: lane", and 2 more).'
    caveat = "A loss of up to 2 % of one rotor, or 35 % of each of two opposite rotors, could have gone undetected."
    assert headline([lost, sank[:60]]) == f"{lost} {sank[:60]}", "what fits stays as it is"
    assert headline([lost, said]) == f"{lost} {said}"
    assert headline([lost, sank]) == f"{lost} Without it the vehicle sank by 6 m in 2.7 s."
    assert headline([lost, caveat, said], caveats=[caveat]) == f"{lost} At 27.58 s the autopilot reported an estimator fault."
    assert headline([said, said, lost], 2).endswith(f"fault. {lost} And 1 more finding."), "the main one stays"
    many = headline([lost, *[sank.replace("it", f"rotor {k}") for k in range(9)]])
    assert many.startswith(lost) and many.endswith(" more findings.") and len(many) <= LONGEST
    either = "Loss of thrust at 30.00 s: " + ", or ".join(f"rotors {k} (front left) and {k + 4}" for k in range(9)) + "."
    assert len(headline([either])) <= LONGEST and headline([either]).endswith(", or others.")
