"""Mounts that turned: what the trim of a whole flight says of them, and of what looks like it."""

import numpy as np
import pytest

from conftest import hexa_event
from rotorwatch.answer import drift, ledger
from rotorwatch.answer.conclusion import Evidence, conclude
from rotorwatch.engine.bindings.event_rows import Report
from rotorwatch.flight.kinds import TURNED
from test_slow import HEXA, QUAD, flight


def claimed(B=QUAD, **how):
    out, ticks = flight(B, **how)
    return drift.mounts(drift.look(out, ticks, B))


@pytest.mark.parametrize("B", [QUAD, HEXA])
@pytest.mark.parametrize("yaw", [-0.8, 1.0])
def test_yaw_alone_that_has_stepped_is_a_mount_that_turned(B, yaw):
    (event,) = claimed(B, rise=0.0, drift=(0.0, 0.0, yaw))
    assert event.kind == TURNED and not event.rotors and abs(event.onset_s - 30.0) < 4.0
    low, high = event.extra["yaw_interval"]
    assert low < yaw < high and high - low < 0.4
    assert ("right" if yaw > 0 else "left") in event.reason


@pytest.mark.parametrize(
    "how", [{}, {"drift": (0.0, 0.0, 0.15), "rise": 0.0}, {"turns": 0.3}, {"drift": (0.5, 0.0, 0.0)}, {"loss": 0.3}], ids=str
)
def test_what_wind_turns_and_losses_do_is_no_mount(how):
    for seed in range(3):
        assert claimed(seed=seed, **how) == ()


def test_beside_a_fault_what_its_rotor_does_to_yaw_is_no_mount():
    (event,) = claimed(rise=0.0, drift=(0.0, 0.0, 0.8))
    fault = hexa_event(rotors=(1,))
    assert ledger.explained(event, (fault,)) and not ledger.explained(event, (event,))
    merged = ledger.merge((event,), Report(QUAD), (), 4)
    assert merged.events == (event,)


def test_a_mount_that_turned_is_said_and_leaves_the_flight_healthy():
    (event,) = claimed(rise=0.0, drift=(0.0, 0.0, 0.8))
    end = conclude(Evidence((event,), 4, hidden=np.full(4, 0.02), assessed_s=80.0))
    assert end.verdict == "healthy" and "mount or an arm" in end.headline and "yaws" in end.headline and len(end.headline) <= 200
    assert "0.8 times" in end.events[0].reason
    assert any("mount" in line for line in end.advice)
