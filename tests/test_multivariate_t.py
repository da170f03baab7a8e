"""Statistics of flights compared with one another, against SciPy and dense matrices."""

import numpy as np
import pytest
from scipy import stats

from rotorwatch.stats import multivariate_t as student

RNG = np.random.default_rng(4)


def covariances(count, d):
    root = RNG.standard_normal((count, d, d))
    return root @ root.transpose(0, 2, 1) + 0.1 * np.eye(d)


@pytest.mark.parametrize("d", [1, 3, 4])
def test_distances_under_one_scale_and_under_many(d):
    rows, scales, more = RNG.standard_normal((20, d)), covariances(20, d), RNG.uniform(0.0, 2.0, (20, d))
    for scale in (scales, np.broadcast_to(scales[0], (20, d, d))):
        for added in (None, more):
            whole = scale + (0.0 if added is None else added[:, :, None] * np.eye(d))
            columns = None if added is None else list(added.T)
            far, determinant = student.squared_distance(rows, scale, columns)
            wanted = [x @ np.linalg.solve(S, x) for x, S in zip(rows, whole)]
            np.testing.assert_allclose(far, wanted, rtol=1e-9)
            np.testing.assert_allclose(determinant, np.linalg.det(whole), rtol=1e-9)


@pytest.mark.parametrize("dof", [2.0, 9.0])
def test_densities_and_tails_are_those_of_t_and_f(dof):
    rows, scale = RNG.standard_normal((15, 3)), covariances(1, 3)[0]
    exact = stats.multivariate_t(np.zeros(3), scale, dof).pdf(rows)
    ratio = student.density(rows, scale, dof) / exact
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    for x in rows:
        square = x @ np.linalg.solve(scale, x)
        assert student.tail(x, scale, dof) == pytest.approx(stats.f.sf(square / 3, 3, dof), rel=1e-9)


def test_weights_maximise_the_likelihood():
    """A location that is the mean weighed with them has no slope of the likelihood."""
    rows, scale, middle = (RNG.standard_t(3.0, (60, 2)) + np.array([1.0, -2.0]), np.array([[1.0, 0.3], [0.3, 0.5]]), np.zeros(2))
    for _ in range(200):
        weight = student.weights(rows - middle, scale, 5.0)
        middle = weight @ rows / weight.sum()

    def likelihood(at):
        return np.log(student.density(rows - at, scale, 5.0)).sum()

    for step in (np.array([1e-3, 0.0]), np.array([0.0, 1e-3])):
        assert likelihood(middle) > max(likelihood(middle + step), likelihood(middle - step))


def test_a_new_row_is_as_far_off_as_predicted():
    """Rows of covariances drawn from the prior: the p-values of new ones are uniform."""
    prior, worth, p = np.diag([1.0, 4.0]), 6.0, []
    for _ in range(600):
        drawn = stats.invwishart.rvs(worth + 3, worth * prior, random_state=RNG)
        rows = RNG.multivariate_normal([3.0, -1.0], drawn, 4)
        scale, dof = student.predictive(rows[1:], prior, worth)
        p.append(student.tail(rows[0] - rows[1:].mean(axis=0), scale, dof))
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_means_of_what_is_known_better_count_more():
    mean, variance = student.weighted_mean(np.array([[1.0, 0.0], [4.0, 1.0]]), np.array([[1.0, 1.0], [2.0, 1.0]]))
    np.testing.assert_allclose(mean, [2.0, 0.5])
    np.testing.assert_allclose(variance, [2.0 / 3.0, 0.5])


def test_intervals_of_masses_in_any_order():
    values, mass = np.linspace(-6.0, 6.0, 4001), np.exp(-0.5 * np.linspace(-6.0, 6.0, 4001) ** 2)
    order = RNG.permutation(4001)
    mean, (low, high) = student.mean_and_interval(values[order], 7.0 * mass[order])
    assert mean == pytest.approx(0.0, abs=1e-9)
    assert (low, high) == pytest.approx((-1.95996, 1.95996), abs=0.004)


def test_the_grid_is_a_normal_distribution():
    points, distance, mass = student.centred_grid(0.5, 4.0)
    assert mass.sum() == pytest.approx(1.0) and mass @ points == pytest.approx([0.0, 0.0], abs=1e-12)
    np.testing.assert_allclose(distance, np.hypot(*points.T))
    assert mass @ points**2 == pytest.approx([0.25, 0.25], rel=0.01)
