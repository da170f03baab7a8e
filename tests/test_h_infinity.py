"""The H-infinity norm in three ways that know nothing of each other, and state feedback with its proof over an interval of gains."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import h_infinity

NORMS = (h_infinity.sweep, h_infinity.bisection)


def oscillator(wn, damping):
    return np.array([[0.0, 1.0], [-(wn**2), -2 * damping * wn]]), np.array([[0.0], [wn**2]]), np.array([[1.0, 0.0]])


def random_system(seed, n=5, inputs=2, outputs=3):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.05) * np.eye(n)
    return A, *(rng.standard_normal(shape) for shape in ((n, inputs), (outputs, n), (outputs, inputs)))


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("damping", [0.01, 0.1, 0.5, 0.9])
def test_the_resonance_of_an_oscillator_in_closed_form(norm, damping):
    peak = 1.0 / (2 * damping * math.sqrt(1 - damping**2)) if damping < math.sqrt(0.5) else 1.0
    assert norm(*oscillator(3.0, damping)) == pytest.approx(peak, rel=1e-7)


@pytest.mark.parametrize("norm", NORMS)
def test_simple_systems_in_closed_form(norm):
    assert norm([[-4.0]], [[2.0]], [[3.0]]) == pytest.approx(1.5, rel=1e-8)
    assert norm([[-1.0]], [[1.0]], [[-2.0]], [[1.0]]) == pytest.approx(1.0, rel=1e-8)  # all-pass (s - 1) / (s + 1)
    assert norm([[-1.0]], [[1.0]], [[1.0]], [[2.0]]) == pytest.approx(3.0, rel=1e-8)
    assert norm([[-1.0]], [[1.0]], [[0.0]]) == 0.0
    assert norm([[0.1]], [[1.0]], [[1.0]]) == math.inf
    # s / (s^2 + s + 1): nothing at 0 nor at infinity, 1 in between
    assert norm([[0.0, 1.0], [-1.0, -1.0]], [[0.0], [1.0]], [[0.0, 1.0]]) == pytest.approx(1.0, rel=1e-7)


@pytest.mark.parametrize("seed", range(6))
def test_sweep_and_bisection_agree_with_a_dense_grid(seed):
    from scipy.signal import StateSpace, freqresp

    A, E, C, F = random_system(seed)
    omega = np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 20_000)])
    largest = np.linalg.norm(C @ np.linalg.solve(1j * omega[:, None, None] * np.eye(5) - A, E[None] + 0j) + F, 2, axis=(1, 2)).max()
    for norm in NORMS:
        value = norm(A, E, C, F)
        assert largest * (1 - 1e-9) <= value <= largest * (1 + 1e-3)
    assert h_infinity.sweep(A, E, C, F) == pytest.approx(h_infinity.bisection(A, E, C, F), rel=1e-6)
    one = StateSpace(A, E[:, :1], C[:1], F[:1, :1])
    by_scipy = np.abs(freqresp(one, omega[1:])[1]).max()
    assert h_infinity.bisection(A, E[:, :1], C[:1], F[:1, :1]) == pytest.approx(
        max(by_scipy, abs((F[:1, :1] - C[:1] @ np.linalg.solve(A, E[:, :1])).item())), rel=1e-3
    )


def test_the_bounded_real_lemma_gives_the_same_number():
    pytest.importorskip("cvxpy")
    for system in (oscillator(3.0, 0.1), random_system(1), random_system(2)[:3]):
        assert h_infinity.bounded_real(*system) == pytest.approx(h_infinity.bisection(*system), rel=1e-5)


@pytest.mark.parametrize(("a", "rho"), [(-1.0, 1.0), (-0.5, 2.0), (-3.0, 0.3)])
def test_one_state_has_a_best_controller_in_closed_form(a, rho):
    """z = (x, rho u): the least level is 1 / sqrt(a^2 + 1 / rho^2), with u = -x / (rho^2 |a|)."""
    pytest.importorskip("cvxpy")
    found = h_infinity.state_feedback([[a]], [[1.0]], [[1.0]], [[1.0], [0.0]], [[0.0], [rho]])
    best = 1.0 / math.sqrt(a**2 + rho**-2)
    assert found.level == pytest.approx(best, rel=1e-4) and found.norm == pytest.approx(best, rel=1e-4)
    assert found.K.item() == pytest.approx(1.0 / (rho**2 * a), rel=0.05)


def cart(low, high):
    """A double integrator whose gain lies in an interval, disturbed by acceleration; position and command shall stay small."""
    A, E = np.array([[0.0, 1.0], [0.0, -0.1]]), np.array([[0.0], [1.0]])
    B = np.array([[[0.0], [low]], [[0.0], [high]]])
    return A, B, E, np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])


def test_the_proof_holds_at_the_vertices_and_between():
    pytest.importorskip("cvxpy")
    A, B, E, C, D = cart(0.3, 1.0)
    found = h_infinity.state_feedback(A, B, E, C, D, dt=0.02, slack=0.05)
    for share in np.linspace(0, 1, 11):
        closed = A + ((1 - share) * B[0] + share * B[1]) @ found.K
        assert h_infinity.quadratic_decay(closed[None], found.X) >= found.decay * (1 - 1e-9) > 0
        assert h_infinity.contraction((np.eye(2) + 0.02 * closed)[None], found.X) < 1.0
        z = C + D @ found.K
        norms = [norm(closed, E, z) for norm in (*NORMS, h_infinity.bounded_real)]
        assert max(norms) - min(norms) < 1e-4 * max(norms) and max(norms) <= found.level * (1 + 1e-6)
    assert found.worst == 0 and found.norm == pytest.approx(h_infinity.sweep(A + B[0] @ found.K, E, C + D @ found.K), rel=1e-4)
    narrow = h_infinity.state_feedback(*cart(0.9, 1.0))
    assert narrow.level < found.level


def test_bounds_that_exclude_every_controller_are_said_to_be_so():
    pytest.importorskip("cvxpy")
    for low, high in ((0.0, 1.0), (-0.2, 0.5)):
        with pytest.raises(ConfigError, match="bounds that exclude every controller"):
            h_infinity.state_feedback(*cart(low, high))


def test_a_wrong_answer_of_the_solver_is_not_believed():
    A, B, E, C, D = cart(0.3, 1.0)
    with pytest.raises(ConfigError, match="does not make the Lyapunov function fall"):
        h_infinity.checked(A, B, E, C, D, np.array([[1.0, 0.0]]), np.eye(2))
    fast = np.array([[-4.0e4, -4.0e2]])  # stable, but not when it acts each 0.02 s only
    X = solve_continuous_lyapunov(A + B[1] @ fast, -np.diag([1.0, 1e4]))
    assert h_infinity.quadratic_decay((A + B[1] @ fast)[None], X) > 0
    with pytest.raises(ConfigError, match="sampled"):
        h_infinity.checked(A, B[1], E, C, D, fast, X, dt=0.02)
