"""The ledger: which claim explains which, whoever testified first."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import hexa_event, trials
from rotorwatch import airframes
from rotorwatch.answer import from_takeoff, ledger, unseen
from rotorwatch.engine.bindings import event_rows, unexplained_evidence
from rotorwatch.engine.bindings.event_rows import Report
from rotorwatch.engine.motion.overrides import Override
from rotorwatch.flight.diagnosis import NO_SOURCE
from rotorwatch.flight.kinds import CONTACT, DESYNC, FROM_TAKEOFF, LOSS, LOST, OVERRIDE, SLOW
from rotorwatch.witnesses import excitation_response, hindsight
from rotorwatch.witnesses.aerobatic import desync
from rotorwatch.witnesses.esc.causes import STANDS as STANDING
from rotorwatch.witnesses.esc.changed import CHANGED as CHANGING

B = airframes.named("ardupilot-hexa-x").effectiveness()


def loss(onset, rotor=3, detected=None, source=event_rows.ESTIMATOR, size=0.37, end=None):
    interval = ((max(size - 0.04, 0.0), size + 0.04),)
    return hexa_event(
        rotors=(rotor,), onset_s=onset, detected_s=onset + 1.0 if detected is None else detected, source=source, loss=(size,),
        interval=interval, end_s=end,
    )  # fmt: skip


def other(kind, onset, end=None, rotors=(2,), source=NO_SOURCE):
    extra = {"override": "off"} if kind == OVERRIDE else {}
    return hexa_event(
        kind=kind, rotors=rotors, onset_s=onset, detected_s=onset + 0.3, end_s=end, loss=(), interval=(), source=source, extra=extra,
    )  # fmt: skip


def merged(*claims):
    return ledger.merge(claims, Report(B), (), B.shape[1])


def test_what_was_reported_in_flight_gives_way_to_what_is_known_afterwards():
    early = loss(3.0, detected=15.0, source=hindsight.SOURCE)
    rest, later, another = loss(12.0, detected=14.0), loss(31.0), loss(12.0, rotor=5, detected=32.5)
    assert merged(rest).events == (rest,)
    assert merged(rest, later, another, early).events == (early, later, another)
    asked = replace(rest, source=excitation_response.SOURCE)
    assert merged(asked, early).events == (early,)


def test_a_loss_that_may_be_nothing_or_that_an_output_explains_is_not_reported():
    output = other(OVERRIDE, 9.5, 12.0)
    assert merged(loss(10.0, size=0.03)).events == ()
    assert merged(loss(10.0), output).events == (output,)


STANDS, CHANGED = loss(20.0, source=STANDING), loss(20.0, source=CHANGING)
STEP = other(DESYNC, 20.0, 20.1, rotors=(3,), source=desync.SOURCE)


@pytest.mark.parametrize(
    "claim, known, reported",
    [
        (STANDS, loss(22.9), False),  # the motion shows a moment later that it stands
        (STANDS, loss(23.1), True),
        (STANDS, replace(loss(22.0, rotor=5), alternatives=((3,), (1,))), False),  # one of several explanations
        (STANDS, other(OVERRIDE, 19.0, rotors=(3,)), False),  # it was commanded to
        (STANDS, other(CONTACT, 19.0, rotors=()), True),
        (CHANGED, loss(40.0), False),  # whenever: an ESC's law changes slowly
        (CHANGED, loss(20.0, rotor=5), True),
        (CHANGED, other(OVERRIDE, 19.0, rotors=(3,)), True),
        (other(SLOW, 20.0, rotors=(3,), source=CHANGING), loss(20.0), True),  # it takes no thrust
        (STEP, other(LOST, 20.5, rotors=()), False),  # it fell
        (STEP, other(LOST, 21.0, rotors=()), True),
        (STEP, loss(19.0, size=0.9), False),  # it was gone
        (STEP, loss(19.0, size=0.9, end=19.5), True),
        (STEP, loss(19.0, size=0.4), True),
    ],
)
def test_what_is_known_is_not_said_again(claim, known, reported):
    assert ledger.explained(claim, (known,)) is not reported
    assert not ledger.explained(claim, ())


def test_claims_of_any_kind_are_events():
    """A kind that is new has a row and somebody who finds it, no more."""
    turned, gust, faint = other("mount_turned", 5.0), other("gust", 30.0, rotors=()), loss(10.0)
    assert merged(gust, faint, turned).events == (turned, faint, gust)


CLAIMS = st.lists(
    st.one_of(
        st.builds(loss, st.integers(0, 60), st.integers(1, 6), source=st.sampled_from([event_rows.ESTIMATOR, hindsight.SOURCE]),
                  size=st.sampled_from([0.02, 0.3, 0.9]), end=st.none()),
        st.builds(lambda onset, rotor: other(OVERRIDE, onset + 0.1, onset + 2.0, (rotor,)), st.integers(0, 60), st.integers(1, 6)),
    ),
    max_size=6, unique_by=lambda claim: claim.detected_s,
)  # fmt: skip


@settings(max_examples=trials(60), deadline=None)
@given(CLAIMS, st.randoms())
def test_who_testifies_first_does_not_matter_and_nothing_is_said_twice(claims, random):
    found = merged(*claims)
    shuffled = random.sample(claims, len(claims))
    assert merged(*shuffled) == found
    assert merged(*found.events) == ledger.Merged(found.events)
    assert [e.detected_s for e in found.events] == sorted(e.detected_s for e in found.events)
    said = set(map(id, found.events))
    for claim in claims:  # each is said, or may be nothing, or an output explains it, or hindsight tells of its rotor since before
        outputs = (o for o in claims if o.kind == OVERRIDE and o.onset_s - 1.0 <= claim.onset_s <= (o.end_s or 0.0) + 1.0)
        early = (h for h in claims if h.source is hindsight.SOURCE and h.rotors == claim.rotors)
        nothing = claim.kind == LOSS and claim.interval[0][0] == 0.0
        assert id(claim) in said or nothing or (claim.kind == LOSS and (any(outputs) or any(early)))


def test_outputs_that_left_together_are_the_logs_and_explain_losses():
    together = [Override(r, "overridden", 20.0, 20.3, 40.0, "it left the mixer", shared=True) for r in (2, 5)]
    claims = tuple(map(event_rows.overridden, together))
    assert [c.rotors for c in claims] == [(2,), (5,)] and all(map(event_rows.shared, claims))
    assert merged(*claims, loss(20.5)).events == () and merged(loss(20.5)).events == (loss(20.5),)


EVIDENCE = [unexplained_evidence.claim((5,), 40.0, 44.0, source=s) for s in (event_rows.TRIM, unseen.STEPS, unexplained_evidence.OPENED)]
COMPARED = [hexa_event(kind=FROM_TAKEOFF, source=source) for source in (from_takeoff.FLIGHTS, from_takeoff.VEHICLES)]


@pytest.mark.parametrize("order", [1, -1])
def test_claims_that_are_no_events_are_reported_where_nothing_explains_them(order):
    """The trim of a whole flight says more than its steps, and these more than what the estimator leaves."""
    unsure, knock = loss(20.0, rotor=1), other(CONTACT, 20.0, rotors=())
    unsure = replace(unsure, alternatives=((2,),))
    trim, steps, residual = EVIDENCE
    for harmless in ((), (knock,)):
        assert ledger.open_claims(EVIDENCE[::order], harmless) == (trim,)
    for wrong in (loss(20.0), unsure, other(LOST, 20.0, rotors=())):
        assert ledger.open_claims(EVIDENCE[::order], (wrong,)) == (residual,)
    assert ledger.open_claims((residual, steps), ()) == (steps,)
    flights, vehicles = COMPARED
    assert ledger.open_claims(COMPARED[::order], (unsure, knock)) == (flights,)
    assert ledger.open_claims((vehicles,), ()) == (vehicles,)
    assert ledger.open_claims(COMPARED, (loss(20.0),)) == ()
