"""Which rotors make up a missing wrench: exactness, ambiguity, bounds and memory of the three rules."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths.faulty_allocation import LeastSquares, Sparse, Temporal

jax = load_jax()


def ring(n):
    """Phi (4, n) of a flat multirotor: what a full loss of each rotor takes from roll, pitch, yaw and thrust."""
    azimuth = np.pi * (2 * np.arange(n) + 1) / n
    return -np.stack([-np.sin(azimuth), np.cos(azimuth), 0.1 * (-1.0) ** np.arange(n), np.ones(n)])


def losses(n, **rotors):
    theta = np.zeros(n)
    for name, loss in rotors.items():
        theta[int(name[1:]) - 1] = loss
    return theta


def answer(rule, theta, Phi=None, W=1e6, noise=0.0):
    Phi = ring(rule.n) if Phi is None else Phi
    return jax.tree.map(np.asarray, rule(rule.init(), Phi, Phi @ theta + noise, np.full(4, W), 0.01)[1])


sparse = {n: Sparse(n, n) for n in (6, 8)}


def scored(rule, f, W=1e6):
    """The answer, and the least score of all sets."""
    Psi = ring(rule.n) @ rule.atoms
    _, score = rule._candidates(W * Psi.T @ Psi, W * Psi.T @ f, W * f @ f)
    return rule((), ring(rule.n), f, np.full(4, W), 0.01)[1].theta, score.min()


solve = {n: jax.jit(lambda f, rule=rule: scored(rule, f)) for n, rule in sparse.items()}


def dense(n, f, price=9.0, W=1e6):
    """The sparse rule, read off its definition: every set solved by a library, least score first."""
    from itertools import combinations

    Phi, found = ring(n), []
    atoms = np.column_stack([np.eye(n), np.ones(n)])
    for k in range(4):
        for rotors in combinations(range(n), k):
            for common in ((), (n,)):
                T = atoms[:, [*rotors, *common]]
                a = np.linalg.lstsq(Phi @ T, f, rcond=None)[0] if T.size else np.zeros(0)
                if T.size and (np.linalg.matrix_rank(Phi @ T) < T.shape[1] or a.min() < 1e-6 or (T @ a).max() > 1):
                    continue  # on a bound: a set of its own
                theta = T @ a
                found.append((W * np.sum((f - Phi @ theta) ** 2) + price * T.shape[1], theta))
    return min(found, key=lambda pair: pair[0])


@pytest.mark.parametrize("n", [6, 8])
@settings(max_examples=trials(25), deadline=None)
@given(data=st.data())
def test_sparse_is_the_best_of_all_sets(n, data):
    """One or two rotors, or all alike and one more: what it answers scores as well as an enumeration with a library."""
    chosen = data.draw(st.lists(st.integers(0, n - 1), min_size=0, max_size=2, unique=True))
    theta = np.zeros(n)
    theta[chosen] = data.draw(st.floats(0.05, 0.6))
    theta += data.draw(st.sampled_from([0.0, 0.2])) if len(chosen) < 2 else 0.0
    f = ring(n) @ theta
    got, score = (np.asarray(part) for part in solve[n](f))
    assert np.abs(ring(n) @ got - f).max() < 1e-6 and got.min() >= 0 and got.max() <= 1
    assert score == pytest.approx(dense(n, f)[0], abs=1e-3)


@pytest.mark.parametrize("n", [6, 8])
def test_one_rotor_is_found_and_the_pseudo_inverse_spreads_it(n):
    theta = losses(n, r3=0.3)
    got = answer(sparse[n], theta)
    np.testing.assert_allclose(got.theta, theta, atol=1e-8)
    assert got.count == 1
    spread = answer(LeastSquares(n, 0.3), theta).theta
    np.testing.assert_allclose(spread, np.linalg.pinv(ring(n)) @ ring(n) @ theta, atol=1e-9)
    assert np.abs(spread - theta).max() > 0.05


def test_loss_of_all_rotors_is_one_cause():
    got = answer(sparse[6], np.full(6, 0.3))
    np.testing.assert_allclose(got.theta, 0.3, atol=1e-8)
    assert got.count == 1
    assert np.abs(answer(Sparse(6, 1), np.full(6, 0.3)).theta - 0.3).max() > 0.1  # not without a common cause
    np.testing.assert_allclose(answer(sparse[8], np.full(8, 0.2) + losses(8, r5=0.3)).theta[4], 0.5, atol=1e-7)


def test_opposite_pairs_of_a_hexarotor_are_ambiguous():
    """An equal loss of an opposite pair is a third of that loss on all rotors; an unequal one is that and a single loss: both
    are counted, and the stated spread covers the truth whichever is named."""
    np.testing.assert_allclose(answer(sparse[6], losses(6, r2=0.24, r5=0.24)).theta, 0.08, atol=1e-8)
    theta = losses(6, r2=0.3, r5=0.2)
    got = answer(sparse[6], theta)
    assert got.count == 2
    sd = np.sqrt(np.diag(got.spread))
    assert (np.abs(got.theta - theta) <= 3.0 * sd).all() and sd.max() > 0.05
    assert answer(sparse[6], losses(6, r1=0.2, r2=0.3)).count == 1


def test_nothing_is_called_nothing():
    noise = 2e-4 * np.array([1.0, -1.0, 0.5, 0.3])
    assert (answer(sparse[6], np.zeros(6), noise=noise).theta == 0).all()
    assert (answer(Sparse(6, 6, price=1e-3), np.zeros(6), noise=noise).theta != 0).any()


def test_bounds():
    """A dead rotor with noise stays at 1, and a rotor that pushes more than asked is none that lost."""
    assert answer(sparse[6], losses(6, r1=1.02)).theta[0] == pytest.approx(1.0, abs=0.02)
    assert answer(sparse[6], losses(6, r1=1.02)).theta.max() <= 1.0
    assert answer(sparse[8], losses(8, r1=-0.2)).theta.min() >= 0.0


def test_least_squares_inverts_four_rotors_whatever_the_magnitudes():
    """Rows of very different magnitude and weight; the refinement takes the ridge's bias out."""
    Phi = ring(4) * np.array([[200.0], [200.0], [5.0], [2.5]])
    W = np.array([1e4, 1e4, 1e4, 4e2])
    theta = np.array([0.1, 0.0, 0.22, -0.05])
    got = LeastSquares(4, 0.3)((), Phi, Phi @ theta, W, 0.01)[1]
    np.testing.assert_allclose(got.theta, theta, atol=1e-12)
    np.testing.assert_allclose(got.M @ Phi, np.eye(4), atol=1e-11)


def test_what_says_nothing_leaves_everything_open():
    for rule in (LeastSquares(6, 0.3), Sparse(6, 6)):
        got = rule(rule.init(), ring(6), np.ones(4), np.zeros(4), 0.01)[1]
        assert (np.asarray(got.theta) == 0).all()
    np.testing.assert_allclose(LeastSquares(6, 0.3)((), ring(6), np.ones(4), np.zeros(4), 0.0)[1].spread, 0.09 * np.eye(6))


def remembered(rule, theta, T=400, seed=0, move=0.3):
    """Answers over T steps of commands that move: theta (T, n)."""
    rng = np.random.default_rng(seed)
    u = 1.0 + move * np.sin(np.arange(T)[:, None] * rng.uniform(0.02, 0.1, rule.n) + rng.uniform(0, 6, rule.n))
    Phi = ring(rule.n) * u[:, None, :]
    f = np.einsum("tcn,tn->tc", Phi, np.broadcast_to(theta, (T, rule.n)))

    def step(state, row):
        state, got = rule(state, *row, np.full(4, 1e6), 0.01)
        return state, got.theta

    return np.asarray(jax.jit(lambda Phi, f: jax.lax.scan(step, rule.init(), (Phi, f))[1])(Phi, f))


@pytest.mark.parametrize("n", [6, 8])
def test_memory_tells_rotors_apart_when_commands_move(n):
    theta = losses(n, r1=0.2, r2=0.35, r4=0.15)
    assert np.abs(remembered(Temporal(n, n, 0.3), theta)[-1] - theta).max() < 1e-3
    assert np.abs(remembered(Temporal(n, n, 0.3), theta, move=0.0)[-1] - theta).max() > 0.02  # and not when they do not


def test_memory_forgets_when_a_loss_changes():
    theta = np.zeros((600, 6))
    theta[300:, 2] = 0.3
    quick = np.abs(remembered(Temporal(6, 6, 0.3), theta, 600)[400:] - theta[400:]).max()
    stubborn = np.abs(remembered(Temporal(6, 6, 0.3, limit=1e12), theta, 600)[400:] - theta[400:]).max()
    assert quick < 0.01 < stubborn


@pytest.mark.parametrize("seed", range(3))
def test_memory_stays_within_bounds_and_solves_the_bounded_problem(seed):
    """Against a library's bounded least squares."""
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(seed)
    A, theta = rng.standard_normal((12, 6)), rng.uniform(-0.3, 1.2, 6)
    G, z = A.T @ A, A.T @ (A @ theta)
    got = np.asarray(Temporal(6, 6, 0.3)._bounded(G, z))
    wanted = lsq_linear(A, A @ theta, (0, 1)).x
    np.testing.assert_allclose(got, wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Sparse(6, 6, price=0.0), "price must be above zero"),
        (lambda: Temporal(6, 6, 0.3, memory_s=-1.0), "memory_s must be above zero"),
        (lambda: Temporal(6, 6, 0.3, limit=0.0), "limit must be above zero"),
    ],
)
def test_wrong_configuration(make, said):
    with pytest.raises(ConfigError, match=said):
        make()
