"""A small part of what `python -m tests.link_faults` runs: bad links over flights that are known."""

import numpy as np
import pytest
from tests import link_faults
from tests.link_faults import Faults, flown

HEALTHY, FAULTY = 0, 4
CUT = Faults(cuts=((24.0, 3.0),))
BAD = Faults(0.3, 0.1, 0.2, 0.05, 0.03, 0.05, holds=((15.0, 0.8), (30.0, 0.5)))


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize(
    "number, faults, wanted",
    [
        (HEALTHY, CUT, "quiet"),
        (FAULTY, CUT, "found"),
        (HEALTHY, BAD, "quiet"),
        (FAULTY, BAD, "found"),
        (FAULTY, Faults(second="elsewhere"), "found"),
        (HEALTHY, Faults(second="here"), "not assessed"),
    ],
)
def test_a_bad_link_raises_no_false_alarm_and_names_no_wrong_rotor(number, faults, wanted):
    result = flown(1, number, faults)
    assert result["outcome"] == wanted, result


def test_a_loss_that_begins_within_cuts_is_named():
    """A cut every few seconds, and the loss in one of them: the rotor alone, not the pair that only misses thrust."""
    number = 654
    assert any(start < link_faults.ONSET_S < start + length for start, length in drawn_of(number).cuts)
    assert flown(0, number)["outcome"] == "found"


def test_nothing_is_reported_of_a_second_vehicle_with_the_same_id():
    """It comes in at 28.8 s with a loss of rotor 2, which is no loss of this vehicle's."""
    assert drawn_of(997).second == "here"
    assert flown(0, 997)["outcome"] == "found"


def drawn_of(number):
    return link_faults.drawn(np.random.default_rng((0, number)))


def test_random_and_mutated_datagrams_are_counted_and_the_flight_is_assessed():
    link = link_faults.datagrams(3000)
    (vehicle,) = link.vehicles
    assert link.damaged > 2000 and vehicle.trouble == ""
    assert vehicle.session is not None and vehicle.session.now > 40.0 and vehicle.session.assessed
    assert vehicle.changes.now == {}


def test_what_a_link_does_is_what_was_asked_for():
    rng, frames = np.random.default_rng(0), tuple((k / 100.0, bytes((k % 256,) * 20)) for k in range(4000))
    came = link_faults.arriving(frames, Faults(lost=0.2, cuts=((10.0, 3.0),), holds=((20.0, 1.0),)), rng)
    times = np.array([at for at, _, _ in came])
    assert len(came) == pytest.approx(0.8 * 3700, rel=0.05)
    assert not ((times >= 10.0) & (times < 13.0)).any() and not ((times >= 20.0) & (times < 21.0)).any()
