"""Events of a link are reconsidered as motion follows them: when, and what becomes of them in between."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from rotorwatch.case.in_flight import LOOKS_S, InFlight
from rotorwatch.flight import kinds
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.witness import Stage

FLIES = ((2.0, np.inf),)
LOST = Event(LOSS, (1,), 10.0, 10.6, None, (0.3,), ((0.2, 0.4),), 1.0, (), "", {}, None)


@dataclass
class At:
    """A view at a time."""

    now: float
    open: tuple = ()


@pytest.fixture
def asked(monkeypatch):
    """Times at which the comparison was asked, and what it answers."""
    calls = []

    def ask(stage, view, events):
        if stage is not Stage.COMPARISON:
            return events
        calls.append(view)
        return tuple(calls.answer(e) for e in events if calls.answer(e) is not None)

    class Calls(list):
        answer = staticmethod(lambda event: event)

    calls = Calls()
    monkeypatch.setattr(witness, "ask", ask)
    return calls


def test_a_loss_is_compared_when_its_motion_has_grown(asked):
    one = InFlight()
    for now in np.arange(10.6, 45.0, 0.5):
        assert one.reconsidered((LOST,), now, FLIES, lambda now=now: At(now)) == ((LOST,), ())
    assert [view.now for view in asked] == pytest.approx([10.0 + s for s in LOOKS_S], abs=0.5)


def test_a_withdrawn_loss_stays_withdrawn(asked):
    one = InFlight()
    asked.answer = lambda event: None
    assert one.reconsidered((LOST,), 12.0, FLIES, lambda: At(12.0)) == ((LOST,), ())
    assert all(one.reconsidered((LOST,), now, FLIES, lambda: At(0.0)) == ((), ()) for now in (16.5, 17.0, 25.0, 31.0, 60.0))


def test_a_loss_that_is_left_open_is_an_open_claim(asked):
    one, view = InFlight(), At(17.0)

    def opened(event):
        view.open = (event,)

    asked.answer = opened
    assert one.reconsidered((LOST,), 17.0, FLIES, lambda: view) == ((), (LOST,))
    assert one.reconsidered((LOST,), 18.0, FLIES, lambda: view) == ((), (LOST,))


def test_the_newest_size_stands_with_the_alternatives_of_the_comparison(asked):
    one = InFlight()
    asked.answer = lambda event: replace(event, alternatives=((3,),), probability=0.6)
    one.reconsidered((LOST,), 17.0, FLIES, lambda: At(17.0))
    (event,), _ = one.reconsidered((replace(LOST, loss=(0.35,)),), 18.0, FLIES, lambda: At(18.0))
    assert event.loss == (0.35,) and event.alternatives == ((3,),) and event.probability == 0.6
    assert len(asked) == 1


def test_a_loss_and_the_loss_of_control_that_it_caused_both_stand(asked):
    both = LOST, replace(LOST, kind=kinds.LOST)
    assert InFlight().reconsidered(both, 17.0, FLIES, lambda: At(17.0)) == (both, ())


def test_a_loss_that_turns_out_to_be_another_fault_is_that(asked):
    asked.answer = lambda event: replace(event, kind=kinds.SLOW_RESPONSE)
    (event,), _ = InFlight().reconsidered((LOST,), 17.0, FLIES, lambda: At(17.0))
    assert event.kind == kinds.SLOW_RESPONSE


@pytest.mark.parametrize("then", [(replace(LOST, end_s=24.0),), (LOST, replace(LOST, rotors=(2,), onset_s=12.0))])
def test_an_end_and_another_loss_are_reasons_to_look_again(asked, then):
    one = InFlight()
    one.reconsidered((LOST,), 19.0, FLIES, lambda: At(19.0))
    one.reconsidered(then, 25.0, FLIES, lambda: At(25.0))
    assert [view.now for view in asked] == [19.0, 25.0]


def test_the_end_of_a_flight_is_a_reason_to_look_at_once(asked):
    one = InFlight()
    one.reconsidered((LOST,), 12.0, FLIES, lambda: At(12.0))
    one.reconsidered((LOST,), 13.0, ((2.0, 12.9),), lambda: At(13.0))
    assert [view.now for view in asked] == [13.0]
