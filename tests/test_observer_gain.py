"""Observer gains: each does what it says, checked by eigenvalues, and refuses what cannot be."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import observer_gain
from rotorwatch_lab.maths.observer_gain import Lipschitz
from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

DT = 1e-3
C, EYE = np.eye(3, 6), np.eye(6)


@pytest.fixture(scope="module")
def plant():
    return PortHamiltonianAttitude.of(airframes.paper("rot-hexa"))


@pytest.fixture(scope="module")
def box(plant):
    return np.concatenate([[0.6, 0.4, 0.0], 0.5 * np.diag(plant.J)])


@pytest.fixture(scope="module")
def F(plant, box):
    return observer_gain.jacobians(plant, DT, box)


@pytest.fixture(scope="module")
def contracting(plant, F):
    scale = np.concatenate([np.ones(3), 20 * np.diag(plant.J)])
    return observer_gain.common_lyapunov(F, C, 0.95, scale=scale)


def test_printed_gain_leaves_the_momenta_alone():
    L = observer_gain.printed()
    np.testing.assert_allclose(L[:3], np.eye(3) / 3)
    assert (L[3:] == 0).all()
    assert np.abs(np.linalg.eigvals(EYE - L @ C)).max() == 1.0


def test_jacobians_are_those_of_the_step(plant, F):
    assert F.shape == (48, 6, 6)
    np.testing.assert_allclose(F[0][:3, 3:], DT * np.linalg.inv(plant.J), rtol=1e-12)
    h, x = 1e-6, np.array([0.3, 0.2, 0.0, 1e-3, 2e-3, 3e-3])
    (at,) = observer_gain.jacobians(plant, DT, np.zeros(6), centre=x, count=1)
    step = [plant.f(x + s * h * e, np.zeros(6), np.zeros(6), DT) for e in EYE for s in (1, -1)]
    np.testing.assert_allclose(at, (np.array(step[::2]) - np.array(step[1::2])).T / (2 * h), atol=1e-9)


def test_poles_are_where_they_were_wanted(plant):
    poles = np.array([0.9, 0.91, 0.92, 0.93, 0.94, 0.95])
    L = observer_gain.place(plant, DT, poles)
    F = observer_gain.jacobians(plant, DT, np.zeros(6), count=1)[0]
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(F - L @ C).real), poles, atol=1e-8)


def test_stationary_gain_solves_the_riccati_equation(plant):
    F = observer_gain.jacobians(plant, DT, np.zeros(6), count=1)[0]
    Q, R = np.asarray(plant.Q(DT)), np.diag(plant.measurement_var)
    P = solve_discrete_are(F.T, C.T, Q, R)
    expected = F @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    np.testing.assert_allclose(observer_gain.stationary(plant, DT), expected, atol=1e-9)
    assert np.abs(np.linalg.eigvals(F - expected @ C)).max() < 1
    rates = RateDynamics.of(airframes.paper("rot-hexa"))
    traced = load_jax().jit(lambda J: observer_gain.stationary(RateDynamics(J, rates.B_tau, rates.B_T, rates.m), DT))
    np.testing.assert_allclose(traced(rates.J), observer_gain.stationary(rates, DT), atol=1e-9)


def test_common_lyapunov_function_contracts_everywhere_between(contracting, F):
    """Under mixtures of the samples too, which were not asked for; the printed gain contracts under none."""
    assert contracting.decay < 0.9501
    mix = np.random.default_rng(0).dirichlet(np.ones(len(F)), 200)
    between = np.einsum("ks,sij->kij", mix, F)
    assert observer_gain.contraction(between, C, contracting.gain, contracting.G) < 0.9501
    assert observer_gain.contraction(F, C, observer_gain.printed(), contracting.G) > 1
    assert np.abs(np.linalg.eigvals(F - contracting.gain @ C)).max() < 0.9501


def test_an_observer_with_that_gain_converges(plant, contracting):
    x, z = np.array([0.3, -0.2, 0.1, 2e-3, -1e-3, 2e-3]), np.zeros(6)
    none = np.zeros(6)
    for _ in range(200):
        x, z = plant.f(x, none, none, DT), plant.f(z, none, none, DT) + contracting.gain @ (x - z)[:3]
    assert np.abs(x - z).max() < 1e-4
    assert np.abs(x).max() > 0.1


def test_theorem_1_of_the_paper_does_not_hold():
    G, Y = 9 * EYE, 3 * np.eye(6, 3)
    constants = Lipschitz(rho=1.0, beta=-4.0, eta=1.0)
    assert observer_gain.theorem_1(EYE, C, G, Y, constants, 10.0, 10.0) == pytest.approx(1.474, abs=1e-3)
    assert observer_gain.is_vacuous(constants) and not observer_gain.is_vacuous(Lipschitz(1.0, -0.2, 1.0))


def test_theorem_1_needs_the_kinematics_in_A(plant):
    T = np.concatenate([np.ones(3), 30 * np.diag(plant.J)])
    half = np.concatenate([[0.4, 0.2, 0.0], 0.2 * np.diag(plant.J)])
    F = observer_gain.jacobians(plant, DT, half) * T / T[:, None]
    A = EYE.copy()
    A[:3, 3:] = 30 * DT * np.eye(3)
    assert observer_gain.theorem_1_best(EYE, C, observer_gain.lipschitz(F - EYE))[0] > 1e-6
    k = observer_gain.lipschitz(F - A)
    best, G, Y, eps_1, eps_2 = observer_gain.theorem_1_best(A, C, k)
    assert best < -0.005 and best == observer_gain.theorem_1(A, C, G, Y, k, eps_1, eps_2)
    # What a negative eigenvalue promises: V = e' G e falls for every increment that the constants allow.
    L = np.linalg.solve(G, Y)
    for one in F:
        error = one - L @ C
        assert np.linalg.eigvalsh(error.T @ G @ error - G).max() < 0


def test_lipschitz_constants_bound_increments(plant, box, F):
    k = observer_gain.lipschitz(F - EYE, eta=0.1)
    rng = np.random.default_rng(1)
    for _ in range(100):
        one, other = rng.uniform(-0.9, 0.9, (2, 6)) * box
        none = np.zeros(6)
        dx = one - other
        df = np.asarray(plant.f(one, none, none, DT) - plant.f(other, none, none, DT)) - dx
        assert df @ dx <= k.rho * dx @ dx * (1 + 1e-3)
        assert df @ df <= k.beta * dx @ dx + k.eta * dx @ df + 1e-3 * k.beta * dx @ dx


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda s: observer_gain.place(s, DT, [0.9] * 5), r"poles must have the shape \(6,\)"),
        (lambda s: observer_gain.place(s, DT, [1.1] + [0.9] * 5), "inside the unit circle; the largest is 1.1"),
        (lambda s: observer_gain.place(s, DT, [0.9] * 6), "cannot be placed"),
        (lambda s: observer_gain.jacobians(s, DT, np.ones(3)), r"half_width must have the shape \(6,\)"),
        (lambda s: observer_gain.common_lyapunov(EYE[None], C, 0.9), "No observer gain makes all 1 Jacobians contract"),
        (lambda s: observer_gain.common_lyapunov(EYE[None], C, 1.5), "decay must lie between 0 and 1"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(plant, call, sentence):
    with pytest.raises(ConfigError, match=sentence):
        call(plant)


def test_without_a_solver_it_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cvxpy", None)
    with pytest.raises(ConfigError, match="needs cvxpy, which is not installed: pip install cvxpy"):
        observer_gain.common_lyapunov(EYE[None], C, 0.9)
