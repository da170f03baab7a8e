"""Interacting multiple models, against a second implementation; and which mode wins."""

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.imm import IMM, Bank, moments
from rotorwatch_lab.systems.rate_dynamics import RateDynamics
from test_laws import DT, LOSS, ONSET, Linear, flown, linear_table, rates_hexa, rates_quad

jax = load_jax()
MODES = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)  # of Linear: healthy, each loss, both alike


def run(estimator, *table):
    """Stacked outputs."""
    step = jax.jit(lambda table: jax.lax.scan(lambda c, row: estimator.step(c, *row), estimator.init(), table)[1])
    return jax.tree.map(np.asarray, step(table))


def one_filter(plant, d, s, P, walk, u, y, valid, dt):
    """Textbook Kalman filter of [x; l] and the density of its innovation: dense."""
    A = np.eye(4)
    A[:3, :3], A[:3, 3] = plant.A(dt), -dt * plant.B @ (u * d)
    H = np.column_stack([plant.C, -plant.D @ (u * d)])
    s = A @ s + np.append(dt * plant.B @ u, 0.0)
    P = A @ P @ A.T
    P[:3, :3] += plant.Q(dt)
    P[3, 3] += dt * walk * d.any()
    H, e = H[valid], (y - H @ s - plant.D @ u)[valid]
    S = H @ P @ H.T + np.diag(plant.R(u)[valid])
    density = np.exp(-0.5 * e @ np.linalg.inv(S) @ e) / np.sqrt(np.linalg.det(2 * np.pi * S))
    K = P @ H.T @ np.linalg.inv(S)
    return s + K @ e, P - K @ H @ P, density if valid.any() else 1.0


def mixture(weights, means, covariances):
    mean = sum(w * m for w, m in zip(weights, means, strict=True))
    return mean, sum(w * (P + np.outer(m - mean, m - mean)) for w, m, P in zip(weights, means, covariances, strict=True))


def second(plant, table, walk, var, stay_s):
    """In loops: yields x, x_cov, theta, theta_cov and probabilities. stay_s (4,)."""
    mu = np.eye(4)[0]
    s = [np.append(plant.x0, 0.0) for _ in MODES]
    P = [np.block([[plant.P0, np.zeros((3, 1))], [np.zeros((1, 3)), var * d.any() * np.eye(1)]]) for d in MODES]
    for u, y, valid, dt in zip(*table, strict=True):
        p = np.zeros((4, 4))
        for j in range(4):
            p[j] = (1.0 - np.exp(-dt / stay_s[j])) / 3.0
            p[j, j] = np.exp(-dt / stay_s[j])
        c = p.T @ mu
        mixed = []
        for i in range(4):
            means, covariances = [], []
            for j in range(4):
                m, V = s[j].copy(), P[j].copy()
                if i != j:
                    m[3], V[3], V[:, 3] = 0.0, 0.0, 0.0
                    V[3, 3] = var * MODES[i].any()
                means.append(m)
                covariances.append(V)
            mixed.append(mixture(p[:, i] * mu / c[i], means, covariances))
        s, P = (list(column) for column in zip(*mixed, strict=True))
        found = [one_filter(plant, d, s[m], P[m], walk, u, y, valid, dt) for m, d in enumerate(MODES)]
        s, P, density = (list(column) for column in zip(*found, strict=True))
        mu = c * np.array(density) / (c @ np.array(density))
        x, x_cov = mixture(mu, [v[:3] for v in s], [V[:3, :3] for V in P])
        theta, theta_cov = mixture(mu, [v[3] * d for v, d in zip(s, MODES)], [V[3, 3] * np.outer(d, d) for V, d in zip(P, MODES)])
        yield x, x_cov, theta, theta_cov, mu


def test_it_is_what_a_second_implementation_says():
    """Gaps, steps of different length and feedthrough included."""
    plant, table = Linear(), linear_table(30)
    got = run(IMM(plant, DT, theta_walk=0.02, theta_var=0.2, healthy_s=0.5, weak_s=2.0), *table)
    wanted = second(plant, table, 0.02, 0.2, np.array([0.5, 2.0, 2.0, 2.0]))
    wanted = [np.array(column) for column in zip(*wanted, strict=True)]
    for a, b in zip((*got.estimate[:4], got.probability), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    assert wanted[4].max(axis=1).min() < 0.9  # the modes do compete in this flight


@pytest.mark.parametrize("make", [rates_quad, rates_hexa], ids=lambda m: m.__name__)
def test_the_right_mode_wins_and_finds_the_loss(make):
    u, y, valid, _ = flown(make, 0, LOSS)
    out = run(IMM(make(), DT), u, y, valid)
    np.testing.assert_allclose(out.probability.sum(axis=1), 1.0, atol=1e-12)
    assert (out.probability >= 0).all()
    # Healthy leads after a second; a second after the onset rotor 2 is weak (mode 2), and its loss is right.
    assert (out.probability[50:ONSET].argmax(axis=1) == 0).all()
    late = slice(ONSET + 50, None)
    assert (out.probability[late, 2] > 0.9).all()
    np.testing.assert_allclose(out.estimate.theta[late, 1], LOSS, atol=0.08)
    assert np.abs(np.delete(out.estimate.theta[late], 1, axis=1)).max() < 0.03


def test_all_rotors_alike_are_the_common_mode():
    """A loss that all share is no rotor's fault, where that mode exists."""
    u, y, valid, _ = flown(rates_quad, 3, 0.0)
    system = rates_quad()
    with_common, without = (IMM(system, DT, common=c) for c in (True, False))
    assert with_common.directions.shape == (6, 4) and without.directions.shape == (5, 4)
    weak = 0.85 * u  # what flew is the model with 0.85 u; the commands said u / 0.85
    out = run(with_common, u, np.asarray(jax.vmap(system.h, (0, 0, None))(y[:, :3], weak, np.zeros(4))), valid)
    assert out.probability[-1].argmax() == 5
    np.testing.assert_allclose(out.estimate.theta[-1], 0.15, atol=0.05)


def test_modes_are_left_at_the_rate_that_was_asked_for():
    imm = IMM(rates_quad(), DT, healthy_s=10.0, weak_s=50.0)
    p = np.asarray(imm.transition(0.5))
    np.testing.assert_allclose(p.sum(axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(np.diagonal(p), np.exp(-0.5 / np.array([10.0, *[50.0] * 5])), rtol=1e-12)


def test_mixing_keeps_the_state_and_forgets_the_loss_of_who_was_not_there():
    """Mean and covariance of x are the same before and after mixing; an improbable mode's loss is as wide as theta_var."""
    imm = IMM(rates_quad(), DT)
    rng = np.random.default_rng(4)
    modes = len(imm.directions)
    L = rng.normal(size=(modes, 4, 4))
    mu = rng.dirichlet(np.ones(modes))
    bank = Bank(rng.normal(size=(modes, 4)), L @ np.swapaxes(L, 1, 2), mu)
    s, P, c = imm._mixed(bank, imm.transition(1.0))
    before = moments(mu, bank.s[:, :3], bank.P[:, :3, :3])
    after = moments(c, s[:, :3], P[:, :3, :3])
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    certain = Bank(bank.s, bank.P, np.eye(modes)[0])
    s, P, _ = imm._mixed(certain, imm.transition(1.0))
    np.testing.assert_allclose(s[1:, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(P[1:, 3, 3], imm.theta_var, rtol=1e-12)
    np.testing.assert_allclose([s[0, 3], P[0, 3, 3]], [bank.s[0, 3], bank.P[0, 3, 3]], rtol=1e-12)  # it stays its own


def test_no_measurement_however_wrong_makes_probabilities_undefined():
    imm = IMM(rates_quad(), DT)
    u, y, valid, _ = flown(rates_quad, 0, 0.0)
    y = np.where(np.arange(len(y))[:, None] == 100, 1e6, y)
    out = run(imm, u, y, valid)
    assert np.isfinite(out.probability).all() and np.isfinite(out.estimate.theta).all()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"healthy_s": 0.0}, "healthy_s"),
        ({"weak_s": -1.0}, "weak_s"),
        ({"theta_walk": -1.0}, "theta_walk"),
        ({"theta_var": [0.1, 0.1]}, "theta_var"),
    ],
)
def test_wrong_values_are_named(wrong, says):
    with pytest.raises(ConfigError, match=says):
        IMM(RateDynamics.of(airframes.paper("niermeyer-hexa")), DT, **wrong)
