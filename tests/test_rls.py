"""Recursive least squares: against a second implementation, and what its three ways of forgetting do without excitation."""

import numpy as np
import pytest

from measured import PLANT, Regression, run
from rotorwatch.errors import ConfigError
from rotorwatch.estimators.rls import RLS
from rotorwatch.maths.systems.rigid_body import RigidBody
from test_laws import DT, LOSS, flown, linear_table, rates_quad

MEMORY, VAR = 0.2, 0.3


def second(table, forgetting, trace_max):
    """Covariance form: what is forgotten widens P, then one Kalman update for each row. Yields x, theta, P."""
    regression, theta, P = Regression(), np.zeros(2), VAR * np.eye(2)
    for u, y, valid, dt in zip(*table, strict=True):
        lam = np.exp(-dt / MEMORY)
        z, Omega = regression.rows(u, y, valid, theta, dt)
        before = theta
        if valid.any():
            if forgetting == "exponential":
                P = P / lam
            elif forgetting == "trace":
                P = P * min(1.0 / lam, max(1.0, trace_max / np.trace(P)))
            else:
                for r in Omega:  # by the matrix inversion lemma: P + (1 - lambda) / lambda r r' / (r' P^-1 r)
                    P = P + (1.0 - lam) / lam * np.outer(r, r) / (r @ np.linalg.solve(P, r))
        for r, value in zip(Omega, z, strict=True):
            K = P @ r / (1.0 + r @ P @ r)
            theta = theta + K * (value - r @ theta)
            P = P - np.outer(K, r @ P)
        regression.measured(valid, theta - before, PLANT.R(u))
        yield regression.x.copy(), theta, P


@pytest.mark.parametrize("forgetting", ["directional", "trace", "exponential"])
def test_it_is_what_a_second_implementation_says(forgetting):
    """Gaps, steps of different length and feedthrough included."""
    table = linear_table(40)
    got = run(RLS(PLANT, DT, memory_s=MEMORY, theta_var=VAR, forgetting=forgetting, trace_max=0.7), *table)
    wanted = [np.array(column) for column in zip(*second(table, forgetting, 0.7), strict=True)]
    for a, b in zip((got.x, got.theta, got.theta_cov), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


def test_it_finds_a_loss():
    """Most of the old regime is forgotten two seconds after the onset; the covariance knows how well yaw tells rotors apart."""
    u, y, valid, _ = flown(rates_quad, 0, LOSS)
    out = run(RLS(rates_quad(), DT, memory_s=0.2), u, y, valid)
    np.testing.assert_allclose(out.theta[-1], [0.0, LOSS, 0.0, 0.0], atol=0.06)


def still(T):
    """A long flight in which rotor 1 alone turns: nothing says anything of the others."""
    u = np.zeros((T, 4))
    u[:, 0] = 1.0
    return u, np.zeros((T, 4)), np.ones((T, 4), bool)


def test_without_excitation_directional_forgetting_and_a_bounded_trace_stay_where_exponential_winds_up():
    T = 600  # twelve seconds, at a memory of half a second
    variance = {
        name: np.einsum("tii->ti", run(RLS(rates_quad(), DT, forgetting=name, trace_max=1.0), *still(T)).theta_cov)
        for name in ("directional", "trace", "exponential")
    }
    # Exponential: e^(12 / 0.5) times the variance at the start. Trace: its bound. Directional: what was never seen stays as it was.
    np.testing.assert_allclose(variance["exponential"][-1, 1:], 0.1 * np.exp(T * DT / 0.5), rtol=1e-6)
    assert variance["trace"].sum(axis=1).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(variance["directional"][:, 1:], 0.1, rtol=1e-9)
    assert variance["directional"][-1, 0] < 0.01


def test_bounds_hold_in_every_flight():
    u, y, valid, _ = flown(rates_quad, 1, LOSS)
    for name in ("directional", "trace"):
        out = run(RLS(rates_quad(), DT, memory_s=0.1, forgetting=name, trace_max=0.5), u, y, valid)
        assert np.einsum("tii->t", out.theta_cov).max() <= 0.5


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"memory_s": 0.0}, "memory_s"),
        ({"forgetting": "often"}, "directional, trace"),
        ({"trace_max": -1.0}, "trace_max"),
    ],
)
def test_wrong_values_are_named(wrong, says):
    with pytest.raises(ConfigError, match=says):
        RLS(rates_quad(), DT, **wrong)


def test_a_plant_with_unmeasured_states_is_refused():
    plant = RigidBody(np.eye(3), np.ones((3, 4)), np.ones(4), 1.0)
    with pytest.raises(ConfigError, match="needs every state measured"):
        RLS(plant, DT)
    RLS(RigidBody(np.eye(3), np.ones((3, 4)), np.ones(4), 1.0, measured=RigidBody.x_names), DT)
