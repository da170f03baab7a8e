"""Attainable thrusts and moments: planes and margins against a linear programme."""

import numpy as np
import pytest
from scipy.optimize import linprog

from rotorwatch import airframes
from rotorwatch.errors import ConfigError
from rotorwatch.witnesses import attainable
from rotorwatch_lab.control import allocation

FRAMES = ("quad-x", "hexa-plus", "octa-x", "octaquad-x", "y6-b", "dodecahexa-x", "tri")


def furthest(B, start, direction):
    """The largest t with start + t direction = B u, by a linear programme; -inf where start is no B u."""
    n = B.shape[1]
    if linprog(np.zeros(n), A_eq=B, b_eq=start, bounds=(0, 1)).status != 0:
        return -np.inf
    lp = linprog(
        np.append(np.zeros(n), -1.0), A_eq=np.column_stack([B, -np.asarray(direction)]), b_eq=start,
        bounds=[(0, 1)] * n + [(0, None)],
    )  # fmt: skip
    return lp.x[-1] if lp.status == 0 else -np.inf


@pytest.mark.parametrize("frame", FRAMES)
def test_reach_is_what_a_linear_programme_finds(frame):
    """With up to two rotors weak or dead, from corners, from inside and from outside, also where the set is flat."""
    rng = np.random.default_rng(sum(frame.encode()))
    B = allocation.rows(airframes.named(f"ardupilot-{frame}"))
    for losses in ((), (1.0,), (0.5,), (1.0, 1.0)):
        e = np.ones(B.shape[1])
        e[rng.choice(len(e), len(losses), replace=False)] = 1.0 - np.array(losses)
        Z = attainable.planes(B * e)
        for start in (np.zeros(4), B * e @ rng.random(len(e)), np.array([0.5 * e.sum(), 0, 0, 0])):
            for direction in (np.eye(4)[0], -np.eye(4)[1], np.eye(4)[3], rng.standard_normal(4)):
                expected = furthest(B * e, start, direction)
                assert Z.reach(start, direction) == pytest.approx(expected, abs=1e-8)


def test_depth_is_the_distance_to_the_nearest_limit():
    """A square in two dimensions, and points on every side of it; a line has no inside."""
    Z = attainable.planes(np.array([[2.0, 0.0], [0.0, 1.0]]))
    for point, depth in (([1.0, 0.5], 0.5), ([1.9, 0.5], 0.1), ([2.5, 0.5], -0.5)):
        assert Z.depth(point) == pytest.approx(depth)
    line = attainable.planes(np.array([[1.0, 1.0], [1.0, 1.0]]))
    assert line.depth([0.5, 0.5]) == pytest.approx(0.0) and line.depth([0.5, 0.8]) < -0.1
    assert attainable.planes(np.zeros((2, 3))).reach([0, 0], [1, 0]) == 0.0


def test_margins_of_a_quadrotor_are_those_of_the_textbook():
    """Roll at hover with T/W 2: half of each side may move by half of full thrust."""
    B = allocation.effectiveness([1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1], [5.0] * 4, 0.1)
    found = attainable.margins(B, 10.0)
    assert found.lift == pytest.approx(2.0)
    assert found.roll == pytest.approx(10.0) and found.pitch == pytest.approx(10.0) and found.yaw == pytest.approx(1.0)
    one_gone = attainable.margins(B * [0, 1, 1, 1], 10.0, np.abs(B).sum(axis=1) / 2)
    assert one_gone.lift == pytest.approx(0.0) and one_gone.depth < -0.1 and one_gone.roll == -np.inf


def test_a_hexarotor_that_gives_up_yaw_keeps_the_rest():
    B = allocation.rows(airframes.named("ardupilot-hexa-x"))
    size = np.abs(B).sum(axis=1) / 2
    gone = B * [0, 1, 1, 1, 1, 1]
    assert attainable.margins(gone, 2.7, size).depth == pytest.approx(0.0, abs=1e-9)
    free = attainable.margins(gone, 2.7, size, free_yaw=True)
    assert free.depth > 0.1 and np.isnan(free.yaw) and free.roll > 0.5


def test_what_cannot_be_computed_is_one_sentence():
    with pytest.raises(ConfigError, match="NaN"):
        attainable.planes(np.full((4, 4), np.nan))
    with pytest.raises(ConfigError, match="too many"):
        attainable.planes(np.random.default_rng(0).random((4, 150)))
