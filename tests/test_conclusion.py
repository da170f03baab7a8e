"""The one place where events become verdict, headline, main event, rotor states and advice."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import hexa_diagnosis, hexa_event
from rotorwatch.answer import from_takeoff
from rotorwatch.answer.conclusion import Evidence, conclude, main_event
from rotorwatch.answer.wording import up_to
from rotorwatch.engine.bindings import unexplained_evidence
from rotorwatch.engine.motion import trust
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.witnesses.healthy.baselines import Candidate


def whole(verdict, rotors=(), loss=0.0, causes=()):
    """What comparing with healthy flights says of a hexa."""
    shares = [loss if k in rotors else 0.01 for k in range(1, 7)]
    return {
        "verdict": verdict, "reason": f"the comparison says {verdict}.", "rotors": list(rotors), "loss": shares,
        "interval": [[max(0.0, v - 0.05), v + 0.05] for v in shares],
        "causes": [{"kind": "rotors" if c else "centre_of_mass", "rotors": list(c), "probability": 0.4} for c in causes],
    }  # fmt: skip


def statuses(diagnosis):
    return {r.rotor: r.status for r in diagnosis.rotors}


OVERRIDE = dict(kind="output_override", loss=(), interval=(), reason="output 3 was off.")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "Rotor 3 (front left) lost 37 % (33–41 %) of thrust at 31.20 s."),
        ({"events": (hexa_event(end_s=40.0), hexa_event(loss=(0.1,)))}, "31.20 s until 40.00 s (the first of 2 events)."),
        ({"events": (hexa_event(**OVERRIDE),)}, "output of rotor 3 (front left) did not follow the mixer from 31.20 s on"),
        ({"events": (), "whole_flight": whole("fault", (3,), 0.3)}, "Rotor 3 (front left) gave less thrust than on healthy"),
        ({"events": (), "whole_flight": whole("healthy")}, "All rotors perform as on healthy flights."),
        ({"events": ()}, "No rotor lost thrust after take-off. Damage present at take-off was not assessed."),
        ({"events": (), "assessed_s": 1.0}, "Not assessed: hardly any of the log is flight."),
        ({"events": (hexa_event(alternatives=((1, 4),)),)}, "rotor 3 (front left), or rotors 1 (right) and 4 (rear right)"),
        (
            {"events": (), "whole_flight": whole("ambiguous", (3,), 0.3, ((3,), (1,), ()))},
            "Rotor 3 (front left) was 30 % weak from take-off on, or rotor 1 (right) was 1 % weak, or the centre of mass has moved.",
        ),
    ],
)
def test_headline(changes, words):
    assert words in hexa_diagnosis(**changes).headline


def population(verdict, rotors=(), loss=0.0):
    """What healthy vehicles of any build say of a hexa."""
    facts = whole(verdict, rotors, loss)
    causes = [{"kind": "rotors", "rotors": [r], "probability": 0.8} for r in rotors]
    return {**facts, "reason": "unlike healthy vehicles.", "causes": causes, "interval": [(0.0, 0.3)] * 6}


@pytest.mark.parametrize(
    ("changes", "verdict", "headline", "states"),
    [
        (
            {"population": population("healthy")},
            "healthy",
            "No rotor lost thrust after take-off. Any loss already present at take-off is at most 33 % per rotor.",
            {"bounded"},
        ),
        (
            {"population": population("ambiguous", (3,), 0.3)},
            "ambiguous",
            "Rotor 3 (front left) was 30 % weak from take-off on, or the centre of mass is offset.",
            {"bounded", "suspect"},
        ),
        (
            {"population": population("fault", (3,), 0.6)},
            "fault",
            "Rotor 3 (front left) gave less thrust than a rotor of any healthy vehicle, from take-off on: loss 60 %",
            {"bounded", "damaged"},
        ),
        # healthy flights of the build know better, and a certain loss in flight is in the mean of the whole of it
        (
            {"population": population("fault", (3,), 0.6), "whole_flight": whole("healthy")},
            "healthy",
            "All rotors perform as on healthy flights.",
            {"healthy"},
        ),
        (
            {"population": population("fault", (3,), 0.6), "events": (hexa_event(),)},
            "fault",
            "Rotor 3 (front left) lost 37 % (33–41 %) of thrust at 31.20 s.",
            {"not assessed"},
        ),
    ],
)
def test_without_healthy_flights_damage_from_take_off_is_assessed_by_healthy_vehicles_of_any_build(changes, verdict, headline, states):
    diagnosis = hexa_diagnosis(**{"events": (), **changes})
    assert diagnosis.verdict == verdict
    assert headline in diagnosis.headline
    assert "not assessed" not in diagnosis.headline
    assert {r.from_takeoff for r in diagnosis.rotors} == states
    healthy = [r for r in diagnosis.rotors if r.from_takeoff == "bounded"]
    assert all(0.3 <= r.interval[1] < 0.4 and r.since_takeoff == (0.0, 0.04) for r in healthy)


@pytest.mark.parametrize(
    ("changes", "taken"),
    [
        ({"population": population("healthy")}, True),
        ({"population": population("ambiguous", (3,), 0.3)}, True),
        ({"population": population("fault", (3,), 0.7)}, False),
        ({"population": population("ambiguous", (3,), 0.3), "evidence": (unexplained_evidence.claim((3,), 20.0, 25.0),)}, False),
        ({"events": (hexa_event(alternatives=((4,),)),)}, False),
    ],
)
def test_a_healthy_flight_may_be_unlike_those_of_other_builds(monkeypatch, changes, taken):
    """A vehicle with a camera out in front needs its own healthy flights more than others do."""
    answer = hexa_diagnosis(**{"events": (), **changes})
    monkeypatch.setattr(trust, "contradictions", lambda *_: ())
    one = Candidate(Flight("none", "", {}, 0.0))
    one.__dict__.update(table=True, vehicle=None, air=())
    assert (one.flaw(lambda *_: answer) == "") is taken


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, True),
        ({"events": ()}, True),
        ({"events": (hexa_event(alternatives=((4,),)),)}, True),
        ({"events": (), "whole_flight": whole("healthy")}, False),
        ({"events": (), "whole_flight": whole("fault", (3,), 0.3)}, False),
        ({"whole_flight": whole("healthy")}, True),  # the comparison includes the time after the loss
        ({"events": (), "whole_flight": whole("inconclusive")}, True),
        ({"events": (), "doubts": ("Nothing moved.",)}, False),
    ],
)
def test_damage_from_take_off_is_not_assessed_without_healthy_flights_and_that_is_said(changes, said):
    diagnosis = hexa_diagnosis(**changes)
    unassessed = said and diagnosis.verdict == "healthy"  # beside a loss that is sure it is no news
    assert ("Damage present at take-off was not assessed." in diagnosis.headline) is unassessed
    assert ({r.from_takeoff for r in diagnosis.rotors} == {"not assessed"}) is (said or "doubts" in changes)
    healthy = [r for r in diagnosis.rotors if r.status == "healthy"]
    assert all((r.interval == r.since_takeoff) is said for r in healthy), "the interval is of what was assessed"
    assert all(r.since_takeoff == (0.0, 0.04) for r in healthy)


def test_every_rotor_of_any_explanation_is_suspect_and_its_interval_covers_all_of_them():
    event = hexa_event(rotors=(1, 2), loss=(0.2, 0.3), interval=((0.1, 0.3), (0.2, 0.4)), alternatives=((3,), (4, 5)), probability=0.5)
    diagnosis = hexa_diagnosis(events=(event,))
    assert diagnosis.verdict == "ambiguous" and diagnosis.main == 0
    assert statuses(diagnosis) == dict.fromkeys(range(1, 6), "suspect") | {6: "healthy"}
    intervals = {r.rotor: r.interval for r in diagnosis.rotors}
    assert intervals[1] == pytest.approx((0.0, 0.3)) and intervals[2] == pytest.approx((0.0, 0.4))
    assert intervals[3] == pytest.approx((0.0, 0.7))  # alone it makes what both lack together
    assert all(low == 0.0 and high >= 0.3 for low, high in list(intervals.values())[:5])


def test_an_event_that_ended_is_over():
    diagnosis = hexa_diagnosis(events=(hexa_event(end_s=40.0),))
    third = diagnosis.rotors[2]
    assert diagnosis.verdict == "fault" and third.status == "healthy" and third.loss == 0.0
    assert third.note == "was weak from 31.20 s to 40.00 s"
    assert "until 40.00 s" in diagnosis.headline and "until 40.00 s" in diagnosis.reason


def test_what_became_of_a_loss_after_landing_is_not_known():
    end = conclude(Evidence((hexa_event(end_s=49.9),), 6, hidden=[0.04] * 6, assessed_s=60, hops=((4, 50), (60, 90))))
    assert end.rotors[2].status == "suspect" and end.rotors[2].interval == pytest.approx((0.0, 0.41))
    assert "not assessed again after landing" in end.rotors[2].note
    assert "until the landing at 49.90 s" in end.headline and not any("came back" in step for step in end.advice)


@pytest.mark.parametrize(
    ("hidden", "matters", "verdict"), [(0.0, 0.2, "healthy"), (0.194, 0.2, "healthy"), (0.21, 0.2, "inconclusive"),
                                       (0.21, 0.3, "healthy"), (1.0, 0.3, "inconclusive"), (1.0, 1.0, "healthy")],
)  # fmt: skip
def test_healthy_is_a_claim_up_to_a_loss_that_matters(hidden, matters, verdict):
    end = conclude(Evidence((), 6, hidden=[0.01] * 5 + [hidden], assessed_s=60.0, matters=matters))
    bound = up_to(max(hidden, 0.01))
    assert end.verdict == verdict and f"a loss of up to {bound} of one rotor could have gone undetected" in end.reason
    assert "0 % of one" not in end.reason.replace(bound, "")
    assert (bound in end.headline) == (hidden > 0.2)
    known = ["healthy"] * 5  # of the others the flight shows enough
    assert [r.status for r in end.rotors] == [*known, "healthy" if verdict == "healthy" else "unobservable"]
    assert end.rotors[5].since_takeoff == (0.0, hidden)
    if verdict == "inconclusive":
        assert end.headline.endswith(f": {end_why(end)}.") and end.advice[0] == Evidence((), 6).unassessed.advice


def end_why(end):
    """The clause that ends its reason."""
    return end.reason.rpartition(": ")[2].rstrip(".")


@pytest.mark.parametrize(
    ("extra", "end_s", "verdict"),
    [({"cause": "disarmed", "impact_s": 37.0}, 37.0, "crashed"), ({"cause": "knock"}, None, "crashed"),
     ({"cause": "knock"}, 40.0, "inconclusive"), ({"cause": "unknown", "impact_s": 37.0}, 37.0, "inconclusive")],
)  # fmt: skip
def test_a_crash_whose_cause_is_known_and_is_no_rotor_has_its_own_verdict(extra, end_s, verdict):
    """A vehicle whose control came back did not crash."""
    lost = hexa_event(kind="loss_of_control", rotors=(), loss=(), interval=(), end_s=end_s, extra={"how": "", **extra})
    found = hexa_diagnosis(events=(lost,))
    assert found.verdict == verdict and found.exit_code == (1 if verdict == "crashed" else 3)
    assert {r.status for r in found.rotors} == {"unobservable"}
    assert "healthy" not in found.headline and found.headline.startswith("The vehicle departed controlled flight")


@pytest.mark.parametrize(("pair", "reported"), [(0.03, False), (0.15, False), (0.25, True)])
def test_the_bound_speaks_of_pairs_where_more_of_them_hides(pair, reported):
    end = conclude(Evidence((), 6, hidden=[0.04] * 6, hidden_pair=pair, assessed_s=60.0))
    said = f"oss of up to 4 % of one rotor, or {100 * pair:.0f} % of each of two opposite rotors, could have gone undetected"
    assert (said in end.reason) == (pair > 0.04) and (said in end.headline) == reported


def test_a_step_that_stayed_names_its_rotors_with_what_they_may_have_lost():
    spell = unexplained_evidence.claim((5, 2), 40.0, 60.0, ((0.18, 0.26), (0.17, 0.25)))
    end = conclude(Evidence((), 6, hidden=[0.16] * 6, assessed_s=60.0, claims=(spell,)))
    lost = "rotor 5 had lost 18–26 % or rotor 2 had lost 17–25 % of thrust"
    assert end.verdict == "ambiguous" and f"since 40.00 s the vehicle has flown as if {lost}" in end.reason
    assert end.headline.startswith("Since 40.00 s") and lost in end.headline and "wind" in end.headline
    assert [r.status for r in end.rotors] == ["healthy", "suspect", "healthy", "healthy", "suspect", "healthy"]
    assert end.rotors[4].interval == (0.0, 0.26) and end.rotors[1].interval == (0.0, 0.25)
    assert any("rotors 2 and 5" in step for step in end.advice)


def test_evidence_that_no_event_explains_makes_its_rotors_suspect_and_is_said():
    diagnosis = hexa_diagnosis(evidence=(unexplained_evidence.claim((5,), 40.0, 44.0),))
    assert statuses(diagnosis)[5] == "suspect" and diagnosis.rotors[4].interval == (0.0, 1.0)
    assert "rotor 5" in diagnosis.reason and any("rotor 5" in a for a in diagnosis.advice)


def test_with_doubts_nothing_is_concluded_from_the_outputs():
    contact = hexa_event(kind="contact", rotors=(), loss=(), interval=(), extra={"size": 3.0, "unit": "g"})
    diagnosis = hexa_diagnosis(events=(hexa_event(), contact), doubts=("The outputs stand still.", "Two vehicles."))
    assert diagnosis.verdict == "inconclusive" and diagnosis.reason == "The outputs stand still."
    assert diagnosis.events == (contact,) and diagnosis.main is None
    assert set(statuses(diagnosis).values()) == {"unobservable"}
    assert "Two vehicles." in diagnosis.advice


def test_a_contact_makes_no_verdict():
    contact = hexa_event(kind="contact", rotors=(), loss=(), interval=(), reason="The vehicle was knocked.")
    diagnosis = hexa_diagnosis(events=(contact,))
    assert diagnosis.verdict == "healthy" and diagnosis.main is None and diagnosis.events == (contact,)
    assert any("31.20 s" in a for a in diagnosis.advice)
    assert "Damage from the contact at 31.20 s was not assessed." in diagnosis.headline
    assert "after take-off" not in diagnosis.headline  # the trim was learned afresh


@pytest.mark.parametrize(
    ("events", "main"),
    [
        ([], None),
        ([hexa_event(loss=(0.3,)), hexa_event(onset_s=50.0, loss=(0.5,))], 0),  # the first that is large
        ([hexa_event(loss=(0.1,)), hexa_event(onset_s=50.0, loss=(0.9,))], 1),
        ([hexa_event(loss=(0.5,)), hexa_event(onset_s=31.9, loss=(0.9,))], 1),  # one happening: the largest
        ([hexa_event(alternatives=((4,),)), hexa_event(onset_s=50.0, loss=(0.1,))], 1),  # surest
        ([hexa_event(loss=(1.0,)), hexa_event(**OVERRIDE | {"onset_s": 31.5})], 0),  # an output of the fall
        ([hexa_event(loss=(1.0,)), hexa_event(**OVERRIDE | {"onset_s": 31.0})], 1),  # an output that caused it
        ([hexa_event(kind="contact"), hexa_event(onset_s=40.0)], 1),
    ],
)
def test_main_event(events, main):
    assert main_event(events) == main


def test_whole_flight_fault_names_its_rotors():
    diagnosis = hexa_diagnosis(events=(), whole_flight=whole("fault", (3,), 0.3, causes=((3,),)))
    assert diagnosis.verdict == "fault" and diagnosis.main is None
    third = diagnosis.rotors[2]
    assert (third.status, third.from_takeoff, third.loss) == ("degraded", "damaged", 0.3)


def test_whole_flight_that_cannot_tell_suspects_all_its_causes():
    diagnosis = hexa_diagnosis(events=(), whole_flight=whole("ambiguous", (3,), 0.3, causes=((3,), (2, 4), ())))
    assert diagnosis.verdict == "ambiguous"
    assert {k for k, s in statuses(diagnosis).items() if s == "suspect"} == {2, 3, 4}
    assert {r.rotor for r in diagnosis.rotors if r.from_takeoff == "suspect"} == {2, 3, 4}


@pytest.mark.parametrize(("until", "verdict"), [(45.0, "healthy"), (28.0, "inconclusive")])
def test_what_a_knock_broke_is_known_only_where_something_was_assessed_after_it(until, verdict):
    knock = hexa_event(
        kind="contact", rotors=(), loss=(), interval=(), onset_s=28.5, detected_s=28.5, end_s=28.5, extra={"size": 2.0, "unit": "g"}
    )
    end = conclude(Evidence((knock,), 6, hidden=[0.04] * 6, assessed_s=20.0, assessed_until=until))
    assert end.verdict == verdict and "contact at 28.50 s" in end.headline
    assert {r.status for r in end.rotors} == {"healthy" if verdict == "healthy" else "unobservable"}


# What was not assessed


def assessed_of(assessed_s, flown=29.0, **more):
    return conclude(Evidence((), 4, hidden=np.full(4, 0.02), assessed_s=assessed_s, hops=((3.0, 3.0 + flown),), blind_s=8.0, **more))


@pytest.mark.parametrize("assessed_s, verdict", [(21.0, "healthy"), (15.0, "healthy"), (12.0, "inconclusive"), (4.0, "inconclusive")])
def test_what_was_not_assessed_is_not_healthy(assessed_s, verdict):
    """Beyond the blind time after a take-off, at least two thirds of a flight have to be assessed."""
    end = assessed_of(assessed_s)
    assert end.verdict == verdict
    assert verdict == "healthy" or f"{assessed_s:.0f} s assessed of 29 s in the air" in end.headline


@pytest.mark.parametrize("begins_s, start", [(0.3, "the start of the log"), (3.0, "take-off")])
def test_a_log_that_begins_in_the_air_holds_no_take_off(begins_s, start):
    end = conclude(Evidence((), 4, hidden=np.full(4, 0.02), assessed_s=25.0, hops=((begins_s, begins_s + 30.0),), blind_s=8.0))
    assert f"No rotor lost thrust after {start}." in end.headline and f"after {start};" in end.reason


def test_an_event_that_any_rotor_explains_names_none():
    event = Event("loss_of_effectiveness", (1,), 20.0, 20.5, None, (0.2,), ((0.1, 0.3),), 0.4, ((2,), (3,), (4,)), "thrust is missing")
    end = conclude(Evidence((event,), 4, hidden=np.full(4, 0.02), assessed_s=30.0))
    assert end.verdict == "inconclusive" and "any of the rotors" in end.headline
    end = conclude(Evidence((replace(event, alternatives=((2,), (3,))),), 4, hidden=np.full(4, 0.02), assessed_s=30.0))
    assert end.verdict == "ambiguous"


def test_a_headline_bounds_what_the_table_shows():
    """Damage from take-off and what may have been lost unseen since, together: the interval of the worst rotor, and no less."""
    compared = {"verdict": "healthy", "interval": [(0.0, 0.3)] * 4, "rotors": [], "loss": [0.0] * 4, "causes": []}
    claim = Event("damage_from_takeoff", (), 0.0, 0.0, None, (), (), 1.0, (), "", compared, from_takeoff.VEHICLES)
    end = conclude(Evidence((), 4, hidden=np.array([0.02, 0.16, 0.02, 0.02]), assessed_s=60.0, claims=(claim,)))
    assert max(state.interval[1] for state in end.rotors) <= 0.42 and "is at most 42 % in rotor" in end.headline


@pytest.mark.parametrize(
    ("matters", "verdict", "first", "status"),
    [
        (
            0.2,
            "ambiguous",
            "Rotor 3 may have lacked up to 38 % of its thrust from take-off on, or rotor 4, or the centre of mass",
            "suspect",
        ),
        (0.4, "healthy", "No rotor lost thrust after take-off.", "healthy"),
    ],
)
def test_a_flight_that_leans_to_a_rotor_whose_loss_matters_is_not_healthy(matters, verdict, first, status):
    """The bound is larger than what matters, and the balance fits a weak rotor better than none: it is named first, all others after it."""
    causes = [{"kind": "rotors", "rotors": [3], "probability": 0.04}, {"kind": "rotors", "rotors": [4], "probability": 0.004}]
    leaning = {"verdict": "ambiguous", "reason": "rotor 3 may be weak.", "rotors": [3], "causes": causes, "trim": True}
    compared = {"verdict": "healthy", "interval": [(0.0, 0.2), (0.0, 0.2), (0.0, 0.38), (0.0, 0.25)], "rotors": [], "loss": [0.0] * 4,
                "causes": [], "reason": "", "leaning": leaning}  # fmt: skip
    (claim,) = from_takeoff.claims(compared, from_takeoff.VEHICLES, ((5.0, 65.0),))
    end = conclude(Evidence((), 4, hidden=np.full(4, 0.02), assessed_s=60.0, claims=(claim,), hops=((5.0, 65.0),), matters=matters))
    assert end.verdict == verdict and end.headline.startswith(first)
    assert {r.rotor for r in end.rotors if r.status == "suspect"} == ({3, 4} if status == "suspect" else set())
    assert end.rotors[2].status == status and end.rotors[2].interval[1] >= 0.38
