"""The filter of one explanation: updates against dense algebra, what a loss's refinement does to it, restarts."""

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.default import kalman, noise, plant, posterior
from rotorwatch.engine.default.plant import B1, B2, B3, PER_AXIS, WrenchBalance
from rotorwatch.engine.default.posterior import NEVER, PLACES

N, N_X, DT = 4, 22, 0.05
SYSTEM = WrenchBalance(airframes.named("ardupilot-quad-x").effectiveness())
QUIET = np.tile(np.array([[0.01**2], [0.02**2], [0.03**2], [0.01**2]]), (1, 4))
RNG = np.random.default_rng(8)


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def covariance(size, seed=0):
    A = np.random.default_rng(seed).standard_normal((size, size + 4))
    return 0.01 * A @ A.T


def branches(**more):
    """Explanations of which no two are the same."""
    P = np.stack([covariance(N_X + N, k) for k in range(PLACES)])
    one = posterior.init(np.zeros(N_X + N), P[0], N)
    return one._replace(
        s=RNG.uniform(0.1, 0.5, (PLACES, N_X + N)), P=P, active=np.ones((PLACES, N), bool), weight=np.array([0.0, -1.0, -2.0, NEVER]),
        learning=np.full((PLACES, N), 3.0), theta_mean=np.full((PLACES, N), 0.2), theta_var=np.full((PLACES, N), 1e-4),
    )._replace(**more)  # fmt: skip


def test_an_update_is_kalmans_of_all_axes_at_once():
    """One axis after the other is the joint update; what is not measured counts for nothing, whatever stands there."""
    s, P, rows = RNG.standard_normal(N_X + N), covariance(N_X + N), RNG.standard_normal((4, N_X + N))
    R, y = RNG.uniform(0.1, 1.0, 4), rows @ s + 0.3 * RNG.standard_normal(4)
    for measured in ([0, 1, 2, 3], [1, 3], []):
        valid = np.isin(np.arange(4), measured)
        new, cov, gains, innovation, variance = map(
            np.asarray, kalman.update(s, P, rows, np.where(valid, y, 1e6), valid, R, np.ones(N_X + N))
        )
        H = rows[measured]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(R[measured]))
        assert new == pytest.approx(s + K @ (y[measured] - H @ s)) and cov == pytest.approx(P - K @ H @ P)
        assert not innovation[~valid].any() and not gains[~valid].any() and (cov == cov.T).all()
    first = rows[0] @ P @ rows[0] + R[0]
    _, _, gains, innovation, variance = map(
        np.asarray, kalman.update(s, P, rows, y, np.ones(4, bool), R, np.ones(N_X + N))
    )
    assert variance[0] == pytest.approx(first) and innovation[0] == pytest.approx(y[0] - rows[0] @ s)
    assert gains[0] == pytest.approx(P @ rows[0] / first)


def test_a_smaller_gain_has_the_covariance_of_that_gain():
    """Joseph's form, with the share of the gain that each state may learn."""
    s, P, h = RNG.standard_normal(N_X + N), covariance(N_X + N), RNG.standard_normal(N_X + N)
    rows, teach = np.stack([h, *np.zeros((3, N_X + N))]), RNG.uniform(0.0, 1.0, N_X + N)
    only = np.array([True, False, False, False])
    new, cov, _, _, _ = map(
        np.asarray, kalman.update(s, P, rows, np.full(4, h @ s + 0.1), only, np.full(4, 0.5), teach)
    )
    K = teach * (P @ h) / (h @ P @ h + 0.5)
    left = np.eye(N_X + N) - np.outer(K, h)
    assert new == pytest.approx(s + 0.1 * K) and cov == pytest.approx(left @ P @ left.T + 0.5 * np.outer(K, K))


def test_an_innovation_counts_as_six_standard_deviations_at_most():
    """A larger one widens its own variance: the further off, the less it moves the state."""
    s, P, h = np.zeros(N_X + N), covariance(N_X + N), RNG.standard_normal(N_X + N)
    rows, only = np.stack([h, *np.zeros((3, N_X + N))]), np.array([True, False, False, False])
    S = h @ P @ h + 0.2
    for times, variance in ((5.9, S), (6.1, S * (6.1 / 6.0) ** 2), (60.0, S * 100.0)):
        y = times * np.sqrt(S)
        new, _, _, _, found = map(
            np.asarray, kalman.update(s, P, rows, np.full(4, y), only, np.full(4, 0.2), np.ones(N_X + N))
        )
        assert found[0] == pytest.approx(variance) and new == pytest.approx(P @ h * y / variance)


def predict(b, flying=True, burst_factor=1.0):
    return kalman.predict(b, SYSTEM.decay(DT), QUIET, burst_factor, flying, DT)


def test_disturbances_fade_and_walk_while_a_loss_is_refined_it_walks_too():
    b = branches(learning=np.tile([3.0, 0.0, 3.0, 0.0], (PLACES, 1)))
    after, A = predict(b), np.append(SYSTEM.decay(DT), np.ones(N))
    walks = np.append(
        np.append(noise.process_variance(QUIET, DT), [0.0, 0.0]),
        kalman.THETA_WALK * DT * np.array([1.0, 0.0, 1.0, 0.0]),
    )
    for k in range(PLACES):
        assert np.asarray(after.s)[k] == pytest.approx(A * b.s[k])
        assert np.asarray(after.P)[k] == pytest.approx(A[:, None] * b.P[k] * A + np.diag(walks))
    assert np.asarray(after.learning)[0] == pytest.approx([3.0 - DT, 0.0, 3.0 - DT, 0.0])
    theta = b.s[:, N_X:]
    assert np.asarray(after.theta_mean) == pytest.approx(0.2 + (theta - 0.2) * DT / kalman.MOVING_S)
    ground = np.asarray(predict(b, flying=False).P)
    assert ground[0, :N_X, :N_X] == pytest.approx((A[:, None] * b.P[0] * A)[:N_X, :N_X])


def test_a_loss_that_has_been_refined_is_known_its_variance_remembered():
    """At the end of its time: no more cross terms, no walk, the variance as it was, times the doubt. Others go on."""
    learning = np.tile([DT, 3.0, 0.0, DT], (PLACES, 1))
    b = branches(learning=learning, P=1e-6 * branches().P)
    b.s[:, N_X:] = [0.2, 0.2, 0.2, plant.BUILT_SD - 0.001]
    b.theta_mean[:, 3] = plant.BUILT_SD - 0.001
    after = predict(b, burst_factor=2.0)
    P = np.asarray(after.P)
    assert not P[:, N_X, :].any() and not P[:, :, N_X].any() and P[:, N_X + 1, N_X + 1].all() and P[:, N_X + 1, 0].all()
    assert np.asarray(after.theta_var)[:, 0] == pytest.approx(2.0 * b.P[:, N_X, N_X]) and np.asarray(after.theta_var)[
        :, 1
    ] == pytest.approx(1e-4)
    # One that turned out to be no more than how rotors differ is over, and stays known as that.
    assert np.asarray(after.active).tolist() == [[True, True, True, False]] * PLACES
    assert np.asarray(after.s)[:, N_X:] == pytest.approx(np.tile([0.2, 0.2, 0.2, plant.BUILT_SD - 0.001], (PLACES, 1)))
    assert not np.asarray(after.theta_var)[:, 3].any() and not np.asarray(after.learning)[:, [0, 3]].any()


@pytest.mark.parametrize(
    "away, sd, moving", [(0.02, 1e-3, True), (0.0005, 1e-3, False), (0.02, 0.05, False), (-0.02, 1e-3, True)]
)
def test_a_loss_that_still_moves_is_refined_further(away, sd, moving):
    """It has left its mean of two seconds by its own uncertainty."""
    b = branches(learning=np.full((PLACES, N), DT), P=np.tile(sd**2 * np.eye(N_X + N), (PLACES, 1, 1)))
    b.s[:, N_X:] = 0.2 + away / (1.0 - DT / kalman.MOVING_S)
    after = predict(b)
    assert np.asarray(after.learning) == pytest.approx(np.full((PLACES, N), kalman.MOVING_S if moving else 0.0))
    assert (np.asarray(after.P)[0, N_X, N_X] > 0.0) == moving and np.asarray(after.active).all()


@pytest.mark.parametrize("begins, hop", [(False, False), (True, False), (True, True)])
def test_what_a_new_hop_and_a_contact_leave(begins, hop):
    """Biases open again; gains stay; losses stay unless it is a new hop; the leader is alone."""
    b = branches()
    after = kalman.restart(b, SYSTEM.P0, begins, hop)
    bias = np.zeros(N_X + N, bool)
    bias[[a * PER_AXIS + k for a in range(4) for k in (B1, B2, B3)]] = True
    loss = np.arange(N_X + N) >= N_X
    gone = (bias | loss) & hop
    assert np.asarray(after.s) == pytest.approx(np.where(gone, 0.0, b.s))
    kept = np.where(gone[:, None] | gone, 0.0, b.P)
    opened = np.zeros((N_X + N, N_X + N))
    opened[np.ix_(bias, bias)] = SYSTEM.P0[np.ix_(bias[:N_X], bias[:N_X])]
    built = np.diag(loss * plant.BUILT_SD**2) if hop else 0.0  # all rotors were weak
    assert np.asarray(after.P) == pytest.approx(kept + begins * opened + built)
    assert np.asarray(after.active).all() == (not hop) and np.asarray(after.learning).any() == np.asarray(
        after.theta_var
    ).any() == (not hop)
    assert np.asarray(after.weight).tolist() == ([0.0, NEVER, NEVER, NEVER] if begins else [0.0, -1.0, -2.0, NEVER])
