"""Evidence that no event explains."""

from conftest import hexa_event
from rotorwatch.engine.bindings import event_rows as events
from rotorwatch.engine.bindings import residual_evidence


def test_a_loss_that_may_be_nothing_accuses_nobody_and_is_said():
    some, none = (hexa_event(interval=((0.02, 0.1),)), hexa_event(rotors=(3,), onset_s=20.0, end_s=None, interval=((0.0, 0.1),)))
    assert events.accuses(some) and not events.accuses(none)
    assert events.accuses(hexa_event(interval=((0.0, 0.1),), alternatives=((4,),)))  # accuses nobody alone
    assert residual_evidence.faint((none,), (), 60.0) == (residual_evidence.claim((3,), 20.0, 60.0),)
    knock = hexa_event(kind="contact", rotors=(), onset_s=18.0, detected_s=18.0, end_s=18.0)
    assert residual_evidence.faint((none,), (knock,), 60.0) == ()  # what a knock leaves behind speaks of the knock
