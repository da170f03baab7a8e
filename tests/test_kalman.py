"""The filter of one explanation: updates against dense algebra, what a loss's refinement does to it, restarts."""

import numpy as np
import pytest
from tests.plain import array, copied, lower, made, plant

from rotorwatch import airframes
from rotorwatch.engine.bindings.program import square
from rotorwatch.engine.estimator import kalman
from rotorwatch.engine.estimator.kalman import Branch, Measured
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import AIR, B1, B2, B3, BUILT_SD, PER_AXIS, SIDEWAYS, THETA, Rows, entry

N, DT = 4, 0.05
SIZE = THETA + N
P = plant(airframes.named("ardupilot-quad-x").effectiveness(), DT)
QUIET = np.tile(np.array([[0.01**2], [0.02**2], [0.03**2], [0.01**2]]), (1, 4))
RNG = np.random.default_rng(8)
STATES = np.arange(SIZE)
OWN = ((STATES // PER_AXIS == np.arange(4)[:, None]) & (STATES < SIDEWAYS)) | (STATES >= SIDEWAYS)  # of an axis' row


def covariance(seed=0, scale=1.0):
    A = np.random.default_rng(seed).standard_normal((SIZE, SIZE + 4))
    return 0.01 * scale * A @ A.T


def branch(**more):
    """An explanation of which no two numbers are the same."""
    usual = dict(
        s=RNG.uniform(0.1, 0.5, SIZE), P=lower(covariance()), active=np.ones(N, bool), alike=np.ones(N, bool), learning=np.full(N, 3.0),
        mean=np.full(N, 0.2), variance=np.full(N, 1e-4),
    )  # fmt: skip
    return made(Branch, **(usual | more))


def updated(one, rows, y, counts, R, share=1.0):
    """(state, covariance) after one tick's wrench, where no state has bounds."""
    after = copied(one)
    after.s[AIR] += 100.0  # far from its bound
    y = np.asarray(y) + 100.0 * rows[:, AIR]
    m = made(Measured, y=y, R=np.broadcast_to(R, 4), counts=np.asarray(counts), least=-1e9, most=1e9)
    after.update(P, made(Rows, h=rows), m, np.broadcast_to(np.asarray(share, float), SIZE).tolist())
    after.s[AIR] -= 100.0
    return array(after.s, SIZE), square(np.array(after.P), SIZE), after


def test_an_update_is_kalmans_of_all_axes_at_once():
    """One axis after the other is the joint update; what is not measured counts for nothing, whatever stands there."""
    one, rows, R = branch(), RNG.standard_normal((4, SIZE)) * OWN, RNG.uniform(0.1, 1.0, 4)
    s, cov = array(one.s, SIZE), square(np.array(one.P), SIZE)
    y = rows @ s + 0.3 * RNG.standard_normal(4)
    for measured in ([0, 1, 2, 3], [1, 3], []):
        valid = np.isin(np.arange(4), measured)
        new, after, out = updated(one, rows, np.where(valid, y, 1e6), valid, R)
        H = rows[measured]
        K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.diag(R[measured]))
        assert new == pytest.approx(s + K @ (y[measured] - H @ s)) and after == pytest.approx(cov - K @ H @ cov)
        assert not np.array(out.innovation)[~valid].any() and not np.array(out.gain)[~valid].any()
        assert after == pytest.approx(after.T, abs=1e-13)
    _, _, out = updated(one, rows, y, [True] * 4, R)
    assert out.S[0] == pytest.approx(rows[0] @ cov @ rows[0] + R[0]) and out.innovation[0] == pytest.approx(y[0] - rows[0] @ s)
    assert array(out.gain[0], SIZE) == pytest.approx(cov @ rows[0] / out.S[0])


def test_a_smaller_gain_has_the_covariance_of_that_gain():
    """Joseph's form, with the share of the gain that each state may learn."""
    one, rows, share = branch(), RNG.standard_normal((4, SIZE)) * OWN, RNG.uniform(0.0, 1.0, SIZE)
    s, cov, h, only = array(one.s, SIZE), square(np.array(one.P), SIZE), rows[0], [True, False, False, False]
    new, after, _ = updated(one, rows, np.full(4, h @ s + 0.1), only, 0.5, share)
    K = share * (cov @ h) / (h @ cov @ h + 0.5)
    left = np.eye(SIZE) - np.outer(K, h)
    assert new == pytest.approx(s + 0.1 * K) and after == pytest.approx(left @ cov @ left.T + 0.5 * np.outer(K, K))


def test_an_innovation_counts_as_six_standard_deviations_at_most():
    """A larger one widens its own variance: the further off, the less it moves the state."""
    one, rows, only = branch(s=np.zeros(SIZE)), RNG.standard_normal((4, SIZE)) * OWN, [True, False, False, False]
    h, cov = rows[0], covariance()
    S = h @ cov @ h + 0.2
    for times, variance in ((5.9, S), (6.1, S * (6.1 / 6.0) ** 2), (60.0, S * 100.0)):
        y = times * np.sqrt(S)
        new, _, out = updated(one, rows, np.full(4, y), only, 0.2)
        assert out.S[0] == pytest.approx(variance) and new == pytest.approx(cov @ h * y / variance)


def predicted(one, flying=True, unsure=1.0):
    after = copied(one)
    after.predict(P, made(Noise, v=QUIET), unsure, flying)
    return after


def test_disturbances_fade_and_walk_while_a_loss_is_refined_it_walks_too():
    one = branch(learning=np.array([3.0, 0.0, 3.0, 0.0]))
    after, A = predicted(one), array(P.decay, SIZE)
    left, walks = np.exp(-DT / np.array([0.25, 1.0])), np.zeros(SIZE)
    for a in range(4):
        walks[a * PER_AXIS : a * PER_AXIS + 3] = QUIET[1:, a] * [*(1.0 - left**2), DT]
    still = A[:, None] * square(np.array(one.P), SIZE) * A
    assert array(after.s, SIZE) == pytest.approx(A * array(one.s, SIZE))
    refined = np.where(np.isin(STATES, (THETA, THETA + 2)), kalman.THETA_WALK * DT, 0.0)
    assert square(np.array(after.P), SIZE) == pytest.approx(still + np.diag(walks + refined))
    assert after.learning[:N] == pytest.approx([3.0 - DT, 0.0, 3.0 - DT, 0.0])
    theta = array(one.s, SIZE)[THETA:]
    assert after.mean[:N] == pytest.approx(0.2 + (theta - 0.2) * DT / kalman.MOVING_S)
    ground = square(np.array(predicted(one, flying=False).P), SIZE)
    assert ground[:THETA, :THETA] == pytest.approx(still[:THETA, :THETA])
    assert {A[a * PER_AXIS + k] for a in range(4) for k in (B1, B2)} == set(left) and (A == 1.0).sum() == SIZE - 8


def test_a_loss_that_has_been_refined_is_known_its_variance_remembered():
    """At the end of its time: no more cross terms, no walk, the variance as it was, times the doubt. Others go on."""
    one = branch(learning=np.array([DT, 3.0, 0.0, DT]), P=lower(covariance(scale=1e-6)))
    before = square(np.array(one.P), SIZE)
    losses = np.array([0.2, 0.2, 0.2, BUILT_SD - 0.001])
    one.s[THETA:SIZE] = losses.tolist()
    one.mean[3] = losses[3]
    after = predicted(one, unsure=2.0)
    cov = square(np.array(after.P), SIZE)
    assert not cov[THETA].any() and not cov[:, THETA].any() and cov[THETA + 1, THETA + 1] and cov[THETA + 1, 0]
    assert after.variance[0] == pytest.approx(2.0 * before[THETA, THETA]) and after.variance[1] == pytest.approx(1e-4)
    # One that turned out to be no more than how rotors differ is over, and stays known as that.
    assert after.active[:N] == [True, True, True, False] and after.s[THETA:SIZE] == pytest.approx(losses)
    assert after.variance[3] == 0.0 and after.learning[0] == after.learning[3] == 0.0


@pytest.mark.parametrize("away, sd, moving", [(0.02, 1e-3, True), (0.0005, 1e-3, False), (0.02, 0.05, False), (-0.02, 1e-3, True)])
def test_a_loss_that_still_moves_is_refined_further(away, sd, moving):
    """It has left its mean of two seconds by its own uncertainty."""
    one = branch(learning=np.full(N, DT), P=lower(sd**2 * np.eye(SIZE)))
    one.s[THETA:SIZE] = [0.2 + away / (1.0 - DT / kalman.MOVING_S)] * N
    after = predicted(one)
    assert after.learning[:N] == pytest.approx([kalman.MOVING_S if moving else 0.0] * N)
    assert (after.P[entry(THETA, THETA)] > 0.0) == moving and all(after.active[:N])


@pytest.mark.parametrize("contact, hop", [(False, False), (True, False), (True, True)])
def test_what_a_new_hop_and_a_contact_leave(contact, hop):
    """Biases open again; gains stay; losses stay unless it is a new hop."""
    one = branch()
    after = copied(one)
    if hop:
        after.hop(P)
    if contact:
        after.open(P)
    bias = np.isin(STATES, [a * PER_AXIS + k for a in range(4) for k in (B1, B2, B3)])
    loss = STATES >= THETA
    gone = (bias | loss) & hop
    assert array(after.s, SIZE) == pytest.approx(np.where(gone, 0.0, array(one.s, SIZE)))
    opened = np.zeros((SIZE, SIZE))
    opened[np.ix_(bias, bias)] = array(P.variance)[np.ix_(bias[:THETA], bias[:THETA])]
    built = np.diag(loss * BUILT_SD**2) if hop else 0.0  # all rotors were weak
    kept = np.where(gone[:, None] | gone, 0.0, square(np.array(one.P), SIZE))
    assert square(np.array(after.P), SIZE) == pytest.approx(kept + contact * opened + built)
    for field in (after.active, after.alike, after.learning, after.variance):
        assert any(field[:N]) == (not hop)


def test_states_with_bounds_are_not_learned_beyond_them():
    """Air takes no less than nothing, a thrust curve lies between straight and square; the rest learns as it would."""
    rows = RNG.standard_normal((4, SIZE)) * OWN
    rows[0, AIR], only = 5.0, [True, False, False, False]
    one = branch(P=lower(0.1 * np.eye(SIZE)))
    one.s[AIR] = 0.01
    free = rows[0] @ array(one.s, SIZE)
    for away, least in ((-3.0, 0.0), (3.0, 0.01)):
        after = copied(one)
        m = made(Measured, y=np.full(4, free + away), R=np.ones(4), counts=np.array(only), least=-1e9, most=1e9)
        after.update(P, made(Rows, h=rows), m, [1.0] * SIZE)
        assert (after.s[AIR] == pytest.approx(0.0, abs=1e-12)) == (away < 0.0) and after.s[AIR] >= least - 1e-12
        assert np.linalg.eigvalsh(square(np.array(after.P), SIZE)).min() > 0.0
