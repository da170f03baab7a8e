"""A rotor that is commanded all it has while the vehicle turns against it: found without any learning, and in nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from rotorwatch import airframes, diagnose
from rotorwatch.logs.log_memory import from_arrays
from rotorwatch.witnesses.upset import pegged

QUAD = airframes.named("px4-quad-x")
B = QUAD.effectiveness()


def flown(rotor=2, against=8.0, high=1.0, others=0.3, seconds=1.5, rises=0.0, seed=0):
    """2 s of calm flight; then one output stands high, and the vehicle turns along its torque, against it where `against` is above 0."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 3.0 + seconds, 0.01)
    then = (t > 2.0) & (t < 2.0 + seconds)
    share = 0.45 + 0.01 * rng.standard_normal((t.size, 4))
    share[then] = others + 0.03 * rng.standard_normal((int(then.sum()), 4))
    share[then, rotor - 1] = high
    turn = -against * np.clip((t - 2.0) / 0.3, 0.0, 1.0) * np.where(then, 1.0, 0.0) * (1.0 - rises * (t - 2.0) / seconds)
    rates = turn[:, None] * np.sign(B[:3, rotor - 1]) / 3.0 + 0.02 * rng.standard_normal((t.size, 3))
    columns = {"time_s": t, **{f"motor_{k + 1}": x for k, x in enumerate(share.T)}}
    columns |= {f"gyro_{a}_rad_s": x for a, x in zip("xyz", rates.T)}
    return from_arrays(columns)


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_a_dead_rotor_needs_no_learning(rotor):
    (found,) = pegged.find(flown(rotor), QUAD, ((0.5, 4.5),))
    assert found.rotors == (rotor,) and found.onset_s == pytest.approx(2.2, abs=0.2) and not found.alternatives
    answer = diagnose(flown(rotor), vehicle=QUAD)
    assert answer.verdict == "fault" and rotor in answer.events[answer.main].rotors


@pytest.mark.parametrize(
    "changes",
    [
        {"against": -8.0},  # it turns as it is commanded
        {"rises": 0.9},  # it answers
        {"seconds": 0.5},  # too short
        {"high": 0.6},  # there is more that it could be commanded
        {"others": 0.95},  # all are commanded as much
        {"against": 2.0},  # hardly a turn
    ],
)
def test_what_is_no_dead_rotor(changes):
    assert pegged.find(flown(**changes), QUAD, ((0.5, 4.5),)) == ()


def test_what_follows_a_blow_is_its_doing():
    assert pegged.find(flown(), QUAD, ((0.5, 4.5),), struck=(1.9,)) == ()


def test_yaw_alone_accuses_nobody():
    """A vehicle that spins about its axis, with an output at its end, does not turn against that rotor's roll and pitch."""
    flight = flown()
    rates = flight["gyro"].values * [0.0, 0.0, 5.0]
    gyro = replace(flight["gyro"], values=rates)
    assert pegged.find(replace(flight, signals={**flight.signals, "gyro": gyro}), QUAD, ((0.5, 4.5),)) == ()
