"""Quadratic programs over a box, as shipped, against trying every set of bounds; and which bounds a loss has."""

import itertools

import numpy as np
import pytest

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import bounded

LOOSE, TIGHT = (-0.2, 1.0), (-0.02, 1.0)


def by_enumeration(H, g, low, high):
    """argmin over the box of t' H t / 2 - g' t: the best feasible point of all 3^n sets of bounds, each solved exactly."""
    n = len(g)
    sides = np.array(list(itertools.product((-1, 0, 1), repeat=n)))
    fixed, free = np.where(sides < 0, low, np.where(sides > 0, high, 0.0)), sides == 0
    masked = np.where(free[:, :, None] & free[:, None, :], H, 0.0) + np.where(free, 0.0, np.diag(H))[:, :, None] * np.eye(n)
    t = np.where(free, np.linalg.solve(masked, np.where(free, g - fixed @ H, 0.0)[..., None])[..., 0], fixed)
    t = t + np.where(free, np.linalg.solve(masked, np.where(free, g - t @ H, 0.0)[..., None])[..., 0], 0.0)
    feasible = ((t >= low - 1e-11) & (t <= high + 1e-11)).all(axis=1)
    cost = 0.5 * np.einsum("si,ij,sj->s", t, H, t) - t @ g
    return np.clip(t[np.where(feasible, cost, np.inf).argmin()], low, high)


def windows(n, count, seed):
    """(H, g) as the moving horizon makes them: a few directions that a window shows, from hardly to very well, an anchor of 0.07
    where it shows nothing, and losses to be named of which some lie outside the box."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        directions = rng.standard_normal((rng.integers(1, n + 2), n))
        Phi = directions * 10 ** rng.uniform(-1, 3.5, (len(directions), 1))
        A, anchor = Phi.T @ Phi, 0.07**-2
        yield A + anchor * np.eye(n), A @ rng.uniform(-0.5, 1.3, n) + anchor * rng.uniform(-0.3, 1.1, n)


@pytest.mark.parametrize("n", [3, 4, 6])
def test_quadratic_programs_are_exact_as_shipped(n):
    H, g = (np.array(column) for column in zip(*windows(n, 150, n), strict=True))
    assert np.quantile(np.linalg.cond(H), 0.7) > 1e3
    jax, bound = load_jax(), 0
    for low, high in (LOOSE, TIGHT):
        found = np.asarray(jax.jit(jax.vmap(lambda H, g: bounded.quadratic(H, g, low, high)))(H, g))  # noqa: B023
        expected = np.array([by_enumeration(*both, low, high) for both in zip(H, g, strict=True)])
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        bound += ((expected == low) | (expected == high)).sum()
    assert bound > 0.2 * g.size  # many bounds were at work


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("n", [4, 6, 8, 12])
def test_two_turns_for_each_element_are_enough(n):
    """A third of the turns are in reserve, for hard problems of up to twelve rotors."""
    H, g = (np.array(column) for column in zip(*windows(n, 2000, 10 + n), strict=True))
    run = load_jax().jit(load_jax().vmap(lambda H, g, turns: bounded.quadratic(H, g, *TIGHT, turns), (0, 0, None)))
    found = {turns: np.asarray(run(H, g, turns)) for turns in (1, 2 * n, 3 * n, 20 * n)}
    np.testing.assert_allclose(found[2 * n], found[20 * n], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found[3 * n], found[2 * n])
    assert np.abs(found[1] - found[20 * n]).max() > 0.1


def test_elements_without_bounds_and_boxes_of_one_point():
    H, g = next(windows(4, 1, 0))
    low, high = np.array([-np.inf, -0.02, -np.inf, 0.1]), np.array([np.inf, 1.0, 0.0, 0.1])
    found = bounded.quadratic(H, g, low, high)
    np.testing.assert_allclose(found, by_enumeration(H, g, np.maximum(low, -1e6), np.minimum(high, 1e6)), atol=1e-9)
    assert found[3] == 0.1
    np.testing.assert_allclose(bounded.quadratic(H, g, -np.inf, np.inf), np.linalg.solve(H, g), rtol=1e-12)


@pytest.mark.parametrize("bounds", [(0.1, 1.0), (-0.1, 0.0), (-0.1,)])
def test_bounds_hold_no_loss_within_them(bounds):
    with pytest.raises(ConfigError, match="bounds must be"):
        bounded.of_losses(type("Plant", (), {"n_theta": 2, "n_u": 2}), bounds)
