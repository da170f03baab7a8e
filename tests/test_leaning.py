"""A lasting push from the side at rest, with a torque that no rotor makes, is contact however slowly it began."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch.flight import Signal
from rotorwatch.witnesses import leaning

DT = 0.1


def flown(push=4.0, torque=2.6, speed=0.1, begins=40.0, grows_s=6.0, duration=60.0, up=True):
    """(a flight with a velocity, its ticks): from `begins` s on something pushes the vehicle with so much, m/s^2, and hover thrusts."""
    time = np.arange(0.0, duration, DT)
    grown = np.clip((time - begins) / grows_s, 0.0, 1.0)
    rng = np.random.default_rng(1)
    table = SimpleNamespace(
        time=time, dt=DT, mode=np.full(time.size, 2 if up else 0), upset=np.zeros(time.size, bool),
        side=np.stack([push * grown, 0.0 * time], axis=1) + 0.05 * rng.standard_normal((time.size, 2)),
        wrench=np.stack([0.0 * time, 0.0 * time, torque * grown, 4.0 + 0.0 * time], axis=1) + 0.02 * rng.standard_normal((time.size, 4)),
    )  # fmt: skip
    velocity = Signal(time, np.stack([np.full(time.size, speed), 0.0 * time, 0.0 * time], axis=1), ("n", "e", "d"), "m/s", "NED")
    return type("Flown", (), {"has": lambda self, name: name == "velocity", "__getitem__": lambda self, name: velocity})(), table


@pytest.mark.parametrize("grows_s", [0.5, 3.0, 6.0])
def test_a_push_that_grows_is_contact(grows_s):
    found = leaning.find(*flown(grows_s=grows_s))
    assert found is not None and found.kind == "contact" and found.end_s is None
    assert 38.5 <= found.onset_s <= 40.5 + grows_s and "sideways" in found.reason


@pytest.mark.parametrize(
    "changes",
    [
        {"push": 2.0},  # as wind pushes
        {"torque": 1.2},  # as a rotor that is lost turns it
        {"speed": 6.0},  # air takes that at such a speed
        {"begins": 2.0},  # nothing before it to compare with
        {"begins": 59.0},  # too short
        {"up": False},
    ],
)
def test_what_is_no_contact(changes):
    assert leaning.find(*flown(**changes)) is None
