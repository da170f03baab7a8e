"""The estimator's definition as a whole: machine code and Python give the same bits, whatever the frame, the tick and the pieces."""

import itertools

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.bindings import program
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.motion.tick_table import AGAIN, ASSESS, GROUND, LEARN

SETTLES, FAILS, WELL, PUSHED, LANDED, AGAIN_UP = 60, 130, 260, 330, 380, 390
SHORT = 160  # ticks that Python runs in a second or two


def flight(B: np.ndarray, ticks: int, dt: float, seed: int = 0, share: float = 0.4):
    """u, y, valid of a flight in which a rotor loses a share, is well again, something pushes the vehicle, and it lands and takes off
    again; the controller makes up for the loss. Motion is not measured now and then, nor is the speed."""
    rng, n = np.random.default_rng(seed), B.shape[1]
    when = np.arange(ticks)
    loss = share * np.eye(n)[1] * ((when >= FAILS) & (when < WELL))[:, None]
    thrust = 1.0 + 0.03 * rng.normal(size=(ticks, n))
    late = np.minimum(np.maximum(when - FAILS, 0) * dt / 0.2, 1.0) * (when < WELL + 4)
    lost = (share * B[:, 1])[:, None] * late
    thrust = np.maximum(thrust + (np.linalg.pinv(B) @ lost).T, 0.05)
    turn = np.where((when % 90 < 30)[:, None], 0.5, 0.05) * rng.normal(size=(ticks, 3))
    mode = np.where(when < 5, GROUND, np.where(when < SETTLES, LEARN, ASSESS))
    mode = np.where((when >= PUSHED) & (when < PUSHED + 20), LEARN, mode)
    mode = np.where((when >= LANDED) & (when < AGAIN_UP), GROUND, mode)
    mode = np.where((when >= AGAIN_UP) & (when < AGAIN_UP + 40), LEARN, mode)
    restart = np.where(np.isin(when, (5, AGAIN_UP)), 1.0, np.where(when == PUSHED, AGAIN, 0.0))
    load = n * (1.0 + 0.02 * rng.normal(size=ticks) - (thrust * loss).mean(axis=1))
    axial = np.where(when % 50 < 20, np.nan, rng.normal(size=ticks))
    u = np.column_stack([
        thrust, turn, load, 0.1 * rng.normal(size=(ticks, 3)), 0.4 * rng.normal(size=(ticks, 2)), np.full(ticks, 2.2), np.full(ticks, 0.65),
        np.full(ticks, 0.35), axial, mode, restart,
    ])  # fmt: skip
    gains = np.array([0.005 * n, 0.005 * n, 0.13 * n])
    y = thrust @ B.T - np.column_stack([np.zeros((ticks, 3)), thrust.sum(axis=1) - load])
    y = y + (thrust * loss) @ B.T + np.column_stack([turn * gains, np.zeros(ticks)]) + 0.02 * rng.normal(size=(ticks, 4))
    y[when >= PUSHED] += [0.2, 0.0, 0.0, 0.1]
    return u, y, rng.random((ticks, 4)) > 0.02


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize(
    "frame, dt, share",
    [
        ("ardupilot-quad-x", 0.05, 0.4),
        ("ardupilot-y6", 0.1, 0.4),
        ("ardupilot-hexa-x", 0.05, 0.4),
        ("ardupilot-tri", 0.2, 0.4),
        ("ardupilot-octaquad-x", 0.05, 0.9),
    ],
)
def test_python_and_machine_code_give_the_same_bits(frame, dt, share):
    """Every output, and what has been learned, through an announcement."""
    if ENGINE.library is None:
        pytest.skip("no C compiler")
    B = airframes.named(frame).effectiveness()
    table, library = flight(B, SHORT, dt, share=share), ENGINE.library
    compiled = program.steps(dt, B)
    reported = compiled.run(*table)
    ENGINE.__dict__["library"] = None
    try:
        python = program.steps(dt, B)
        plain = python.run(*table)
    finally:
        ENGINE.__dict__["library"] = library
    assert reported.announced.any()
    for name, one, other in zip(reported._fields, reported, plain, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)
    for name, one, other in zip(program.Learned._fields, compiled.learned, python.learned, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


def test_ticks_may_come_piece_by_piece():
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    table = flight(B, 300, 0.05)
    whole, steps = program.steps(0.05, B).run(*table), program.steps(0.05, B)
    cuts = [0, 1, 7, 150, 151, 300]
    parts = [steps.run(*(column[a:b] for column in table)) for a, b in itertools.pairwise(cuts)]
    for name in whole._fields:
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name), err_msg=name)


def test_a_raised_threshold_announces_no_more():
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    table, counts = flight(B, 250, 0.05), []
    for nats in (0.0, 30.0, 1e6):
        steps = program.steps(0.05, B)
        steps.raise_threshold(nats)
        counts.append(int(steps.run(*table).announced.sum()))
    assert counts[0] >= counts[1] >= counts[2] == 0 < counts[0]
