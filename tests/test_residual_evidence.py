"""Evidence that no event explains, on made-up ticks of a quad X."""

from types import SimpleNamespace

import numpy as np
import pytest

from conftest import hexa_event
from rotorwatch import airframes
from rotorwatch.engine.bindings import event_rows as events
from rotorwatch.engine.bindings import residual_evidence
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.motion.tick_table import JUDGE, LEARN

HYP = list_hypotheses(4)
B = airframes.named("ardupilot-quad-x").effectiveness()
TIME = np.arange(0.0, 60.0, 0.1)
LIMIT = 12.0
EVENT = hexa_event(rotors=(1,), onset_s=20.0, detected_s=20.3)


def flight(odds=(), trim=(), mode=()):
    """(outputs, ticks). odds: (hypothesis, start, end, nats); trim: (wrench (4,), from s); mode: (mode, start, end)."""
    log_odds, biases = np.zeros((TIME.size, len(HYP.names))), np.zeros((TIME.size, 4))
    modes = np.full(TIME.size, JUDGE)
    for name, start, end, nats in odds:
        log_odds[(start <= TIME) & (end > TIME), HYP.names.index(name)] = nats
    for wrench, start in trim:
        biases[start <= TIME] += wrench
    for value, start, end in mode:
        modes[(start <= TIME) & (end > TIME)] = value
    none = np.zeros(TIME.size, bool)
    table = SimpleNamespace(time=TIME, mode=modes, upset=none, restart=none, dt=0.1)
    return SimpleNamespace(theta=np.zeros((TIME.size, 4)), log_odds=log_odds, biases=biases), table


def found(*events, **given):
    return [(s.rotors, round(s.onset_s), round(s.end_s)) for s in residual_evidence.find(*flight(**given), HYP, LIMIT, events, B)]


def test_a_second_rotor_over_the_threshold_beside_a_known_loss():
    assert found(EVENT, odds=[("rotor 4", 30.0, 35.0, 40.0)]) == [((4,), 30, 35)]


@pytest.mark.parametrize(
    "odds",
    [
        [("rotor 4", 30.0, 35.0, 9.0)],  # not over the threshold
        [("rotor 4", 30.0, 30.5, 40.0)],  # not for long
        [("rotor 4", 22.0, 25.0, 40.0)],  # what the known loss leaves over while it is refined
        [("rotor 1", 30.0, 35.0, 40.0)],  # the known one itself
        [("rotor 4", 30.0, 35.0, 40.0), ("any disturbance", 30.0, 35.0, 45.0)],  # a disturbance explains it better
    ],
)
def test_what_is_explained(odds):
    assert found(EVENT, odds=odds) == []


def test_a_flight_without_an_event_has_no_spells():
    """What such a flight hides is told by the step that stays (`answer.unseen`)."""
    assert found(odds=[("rotor 4", 30.0, 35.0, 40.0)]) == []


def test_rotors_that_fit_as_well_are_named_together():
    spells = found(EVENT, odds=[("rotor 4", 30.0, 35.0, 40.0), ("rotor 2", 30.0, 35.0, 39.0)])
    assert spells == [((2, 4), 30, 35)]


def test_what_follows_a_contact_speaks_of_the_contact():
    knock = hexa_event(kind="contact", rotors=(), onset_s=30.0, detected_s=30.0, end_s=30.0)
    assert found(EVENT, knock, odds=[("rotor 4", 30.2, 35.0, 40.0)]) == []


def test_a_trim_that_came_out_changed_as_by_a_rotors_loss():
    afresh = [(LEARN, 30.0, 38.0)]
    assert found(EVENT, trim=[(0.6 * B[:, 2], 33.0)], mode=afresh) == [((3,), 30, 38)]
    assert found(EVENT, trim=[(0.1 * B[:, 2], 33.0)], mode=afresh) == []  # too small
    assert found(EVENT, trim=[(-0.6 * B[:, 2], 33.0)], mode=afresh) == []  # it would have to give more
    assert found(EVENT, trim=[(np.array([0.6, 0.0, 0.0, 0.0]), 33.0)], mode=afresh) == []  # no rotor's direction
    assert found(trim=[(0.6 * B[:, 2], 33.0)], mode=afresh) == []


def test_a_loss_that_may_be_nothing_accuses_nobody_and_is_said():
    some, none = (hexa_event(interval=((0.02, 0.1),)), hexa_event(rotors=(3,), onset_s=20.0, end_s=None, interval=((0.0, 0.1),)))
    assert events.accuses(some) and not events.accuses(none)
    assert events.accuses(hexa_event(interval=((0.0, 0.1),), alternatives=((4,),)))  # accuses nobody alone
    assert residual_evidence.faint((none,), (), 60.0) == (residual_evidence.claim((3,), 20.0, 60.0),)
    knock = hexa_event(kind="contact", rotors=(), onset_s=18.0, detected_s=18.0, end_s=18.0)
    assert residual_evidence.faint((none,), (knock,), 60.0) == ()  # what a knock leaves behind speaks of the knock
