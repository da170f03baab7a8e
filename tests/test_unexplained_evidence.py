"""Evidence that no event explains."""

import numpy as np

from conftest import hexa_event
from rotorwatch.engine.bindings import unexplained_evidence


def test_what_a_knock_leaves_behind_speaks_of_the_knock():
    knock, loss = hexa_event(kind="contact", rotors=(), onset_s=18.0, detected_s=18.1, end_s=18.2), hexa_event(onset_s=30.0)
    times = np.array([17.0, 17.6, 18.0, 20.0, 25.0, 31.0])
    assert unexplained_evidence.knocked(times, (knock, loss)).tolist() == [False, True, True, True, False, False]


def test_evidence_accuses_nobody_and_stays_open():
    evidence = unexplained_evidence.claim((3,), 20.0, 60.0)
    assert (evidence.rotors, evidence.onset_s, evidence.end_s) == ((3,), 20.0, 60.0) and not evidence.means.accuses
