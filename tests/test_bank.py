"""The bank of onsets against the filter run twice, with and without the jump."""

import numpy as np
import pytest
from tests.plain import array, copied, lower, made, plant

from rotorwatch import airframes
from rotorwatch.engine.bindings.program import square
from rotorwatch.engine.estimator.bank import DAMPING_ERROR, FIRST_LOSS, GROUP, LONG, SHORT, YAW_ERROR, Bank, Observed, Slots, Window
from rotorwatch.engine.estimator.kalman import Branch
from rotorwatch.engine.estimator.plant import ANSWER_S, B3, DAMPING, PER_AXIS, SIDEWAYS, THETA, YAW_GAIN, Rows

B = airframes.named("ardupilot-quad-x").effectiveness()
N, DT, TICKS, FIRST = 4, 0.05, 70, 6
STATES, DIRECTIONS = THETA + N, FIRST_LOSS + N
AGE = [np.exp(-DT / ANSWER_S) ** k for k in range(400)]


def directions():
    """(states, directions) what a unit jump does: a step of an axis' bias, two errors of the model, the loss of a rotor."""
    E = np.zeros((STATES, DIRECTIONS))
    E[[a * PER_AXIS + B3 for a in range(4)], range(4)] = 1.0
    E[YAW_GAIN, YAW_ERROR] = E[DAMPING, DAMPING_ERROR] = E[PER_AXIS + DAMPING, DAMPING_ERROR] = 1.0
    E[range(THETA, STATES), range(FIRST_LOSS, DIRECTIONS)] = 1.0
    return E


@pytest.fixture(scope="module")
def run():
    """Rows, gains, weights and innovations of each tick's axes, and the bank after some ticks."""
    rng, p, bank = np.random.default_rng(0), plant(B, DT), Bank()
    axis, states = np.arange(4), np.arange(STATES)
    h = rng.standard_normal((TICKS, 4, STATES)) * ((states // PER_AXIS == axis[:, None]) | (states >= SIDEWAYS))
    w = rng.uniform(0.5, 2.0, (TICKS, 4)) * (rng.random((TICKS, 4)) > 0.2)  # now and then an axis is not measured
    w[3] = 0.0
    K, nu = (0.2 * rng.standard_normal((TICKS, 4, STATES)) * (w > 0)[..., None], rng.standard_normal((TICKS, 4)) * (w > 0))
    bank.begin(p)
    kept = {}
    for k in range(TICKS):
        bank.advance(p, k >= FIRST, False, [float(k), float(k) ** 2, 0.0, 0.0], 0, len(bank.packs))
        rows, reported = made(Rows, h=h[k]), Observed()
        leader = made(Branch, gain=K[k], innovation=nu[k], S=[2.0] * 4)
        reported.by(p, rows, leader, (2.0 * w[k]).tolist(), (w[k] > 0.0).tolist())
        for slot in bank.packs:
            if slot.age >= 0:
                slot.observe(p, rows, leader, reported)
        if k in (5, 6, 20, TICKS - 1):
            kept[k] = copied(bank)
    return p, (h, K, w, nu), kept


def test_a_slot_holds_what_a_jump_at_its_onset_has_done_since(run):
    """Two filters of the same gains, one of which is given the jump: the difference of their innovations is phi, of their states M."""
    p, (h, K, w, nu), kept = run
    last, seen, A = TICKS - 1, set(), array(p.decay, STATES)
    for slot in kept[last].packs[::5]:
        if slot.age < 0:
            continue
        seen.add(slot.gradual)
        M, C, z = np.zeros((STATES, DIRECTIONS)), np.zeros((DIRECTIONS, DIRECTIONS)), np.zeros(DIRECTIONS)
        for since in range(int(slot.age) + 1):
            k = last - int(slot.age) + since
            share = (1 - AGE[1]) * AGE[since] if slot.gradual else float(since == 0)
            M = A[:, None] * M + share * directions()
            for a in range(4):
                phi = h[k, a] @ M
                C, z = C + w[k, a] * np.outer(phi, phi), z + w[k, a] * nu[k, a] * phi
                M = M - np.outer(K[k, a], phi)
        np.testing.assert_allclose(square(np.array(slot.C), DIRECTIONS), C, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(array(slot.z, DIRECTIONS), z, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(array(slot.M, STATES, DIRECTIONS), M, rtol=1e-9, atol=1e-12)
    assert seen == {True, False}


def test_recent_onsets_are_dense_and_older_ones_sparse(run):
    """Of each group the last GROUP onsets, its stride apart; none from before it was started."""
    kept = run[2]
    for k, bank in kept.items():
        for group, stride in enumerate(SHORT):
            part = bank.packs[group * GROUP : (group + 1) * GROUP]
            assert {slot.stride for slot in part} == {stride} and {s.gradual for s in part} == {group == 2}
            onsets = [t for t in range(FIRST, k + 1) if t % stride == 0][-GROUP:]
            assert sorted(k - slot.age for slot in part if slot.age >= 0) == onsets
    assert kept[5].reach == GROUP * max(SHORT)
    long = Bank()
    long.begin(plant(B, 0.2))
    assert [slot.stride for slot in long.packs] == np.repeat(LONG, GROUP).tolist()


def test_of_each_onset_is_kept_what_was_noted_then(run):
    used = [(TICKS - 1 - slot.age, slot.before[:2]) for slot in run[2][TICKS - 1].packs if slot.age >= 0]
    assert used and all(before == [float(k), float(k) ** 2] for k, before in used)


def test_losses_that_build_up_are_there_after_a_while(run):
    """All shares of a gradual jump add up to one, 63 % of them within its time constant."""
    p, slot = run[0], made(Slots, gradual=True)
    shares = []
    for k in range(400):
        before, slot.age = slot.M[THETA][FIRST_LOSS], float(k)
        slot.advance(p, float(AGE[1]))
        shares.append(slot.M[THETA][FIRST_LOSS] - before)
    assert sum(shares) == pytest.approx(1.0) and sum(shares[: round(ANSWER_S / DT)]) == pytest.approx(1 - np.exp(-1.0))


def test_errors_of_the_model_integrated_out_leave_the_marginal(run):
    """Of yaw's gain either way; of damping where there is more of it than is known."""
    rng, p = np.random.default_rng(0), run[0]
    for _ in range(6):
        A = rng.standard_normal((20, DIRECTIONS))
        C, z = A.T @ A, rng.standard_normal(DIRECTIONS)
        window = Window()
        window.reduce(p, made(Slots, C=lower(C), z=z), 0.3, 0.7)
        errors, rest = [YAW_ERROR, DAMPING_ERROR], [d for d in range(DIRECTIONS) if d not in (YAW_ERROR, DAMPING_ERROR)]
        more = 0.7 if z[DAMPING_ERROR] > 0.0 else 1e-12
        prior = np.zeros((DIRECTIONS, DIRECTIONS))
        prior[errors, errors] = 1.0 / 0.3, 1.0 / more
        full = np.linalg.inv(C + prior)
        reported = array(window.C, DIRECTIONS, DIRECTIONS)[np.ix_(rest, rest)]
        assert reported == pytest.approx(np.linalg.inv(full[np.ix_(rest, rest)]), rel=1e-7)
        score = np.linalg.solve(reported, array(window.z, DIRECTIONS)[rest])
        assert score == pytest.approx((full @ z)[rest], rel=1e-7)


def test_what_it_was_compared_with_has_changed_and_all_are_forgotten(run):
    bank = copied(run[2][TICKS - 1])
    assert any(slot.age >= 0 for slot in bank.packs)
    bank.forget()
    assert all(slot.age == -1 for slot in bank.packs)
