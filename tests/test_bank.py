"""The bank of onsets against the filter run twice, with and without the jump."""

import numpy as np
import pytest

from rotorwatch.engine.default import bank
from rotorwatch.engine.default.bank import SLOTS, STRIDES
from rotorwatch.engine.default.plant import ANSWER_S

DT, N_S, Q, TICKS = 0.05, 5, 3, 70


@pytest.fixture(scope="module")
def run():
    """A table of transitions, rows, gains, variances and innovations, and the bank after every tick of it."""
    from rotorwatch.base.backend import jax as load

    jax = load()
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((N_S, Q))
    jumps = bank.Jumps(directions, DT)
    A, h = rng.uniform(0.7, 1.0, N_S), rng.standard_normal((TICKS, N_S))
    K, S, nu = 0.2 * rng.standard_normal((TICKS, N_S)), rng.uniform(0.5, 2.0, TICKS), rng.standard_normal(TICKS)
    start, keep = np.arange(TICKS) >= 6, np.arange(TICKS) >= 6

    def tick(state, row):
        h, K, w, nu, start, keep, noted = row
        state = jumps.observe(jumps.advance(state, A, start, keep, noted), h, K, w, nu)
        return state, state

    w = np.where(np.arange(TICKS) % 7 == 3, 0.0, 1.0 / S)  # now and then nothing is measured
    K = np.where((w > 0)[:, None], K, 0.0)
    noted = np.stack([np.arange(TICKS), np.arange(TICKS) ** 2.0], axis=1)
    rows = (h, K, w, nu, start, keep, noted)
    states = jax.jit(lambda first, *rows: jax.lax.scan(tick, first, rows)[1])(jumps.init(2), *rows)
    return jumps, directions, (A, h, K, w, nu), jax.tree.map(np.asarray, states)


def test_a_slot_holds_what_a_jump_at_its_onset_has_done_since(run):
    """Two filters of the same gains, one of which is given the jump: the difference of their innovations is phi, of their states M."""
    jumps, directions, (A, h, K, w, nu), states = run
    last = TICKS - 1
    seen = set()
    for slot in range(0, jumps.stride.size, 5):
        age = int(states.age[last, slot])
        if age < 0:
            continue
        seen.add(bool(jumps.slow[slot]))
        M, C, z = np.zeros((N_S, Q)), np.zeros((Q, Q)), np.zeros(Q)
        for k in range(last - age, last + 1):
            since = k - (last - age)
            share = (1 - jumps.decay) * jumps.decay**since if jumps.slow[slot] else float(since == 0)
            M = (0.0 if since == 0 else A[:, None] * M) + share * directions
            phi = h[k] @ M
            C, z, M = C + w[k] * np.outer(phi, phi), z + w[k] * nu[k] * phi, M - np.outer(K[k], phi)
        np.testing.assert_allclose(states.C[last, slot], C, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(states.z[last, slot], z, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(states.M[last, slot], M, rtol=1e-9, atol=1e-12)
    assert seen == {True, False}


def test_recent_onsets_are_dense_and_older_ones_sparse(run):
    """Of each group the last SLOTS onsets, its stride apart; none from before it was started."""
    jumps, _, _, states = run
    for group, stride in enumerate(STRIDES[0.05]):
        part = slice(group * SLOTS, (group + 1) * SLOTS)
        assert (jumps.stride[part] == stride).all() and jumps.slow[part].all() == (group == 2) == jumps.slow[part].any()
        for k in (5, 6, 20, TICKS - 1):
            onsets = [t for t in range(6, k + 1) if t % stride == 0][-SLOTS:]
            assert sorted(k - states.age[k, part][states.age[k, part] >= 0]) == onsets
    assert jumps.reach == SLOTS * max(STRIDES[0.05]) and jumps.decay == pytest.approx(np.exp(-DT / ANSWER_S))
    assert bank.Jumps(np.eye(3), 0.2).stride.tolist() == np.repeat(STRIDES[0.1], SLOTS).tolist()


def test_of_each_onset_is_kept_what_was_noted_then(run):
    states = run[3]
    used = states.age >= 0
    onset = np.arange(TICKS)[:, None] - states.age
    assert used.any() and (states.before[used] == np.stack([onset[used], onset[used] ** 2.0], axis=1)).all()


def test_losses_that_build_up_are_there_after_a_while(run):
    """All shares of a gradual jump add up to one, 63 % of them within its time constant."""
    jumps = run[0]
    shares = (1 - jumps.decay) * jumps.decay ** np.arange(400)
    assert shares.sum() == pytest.approx(1.0) and shares[: round(ANSWER_S / DT)].sum() == pytest.approx(
        1 - np.exp(-1.0)
    )


def test_the_last_direction_integrated_out_leaves_the_marginal():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((3, 20, 6))
    C, z = np.einsum("wki,wkj->wij", A, A), rng.standard_normal((3, 6))
    told = bank.without_last(
        bank.Bank(np.zeros((3, 9, 6)), C, z, np.zeros(3, np.int32), np.int32(0), np.zeros((3, 1))), 0.3
    )
    for w in range(3):
        full = np.linalg.inv(C[w] + np.diag([0.0] * 5 + [1 / 0.3]))
        assert np.asarray(told.C)[w] == pytest.approx(np.linalg.inv(full[:5, :5]), rel=1e-9)
        assert np.linalg.solve(np.asarray(told.C)[w], np.asarray(told.z)[w]) == pytest.approx(
            (full @ z[w])[:5], rel=1e-9
        )
    assert told.M.shape == (3, 9, 5)


def test_one_slot_is_picked_and_all_are_forgotten(run):
    state = run[3]
    one = bank.Bank(*(a[-1] for a in state))
    M, C, z = bank.pick(one, (np.arange(one.age.size) == 7).astype(float))
    assert (
        np.asarray(M) == pytest.approx(one.M[7])
        and np.asarray(C) == pytest.approx(one.C[7])
        and np.asarray(z) == pytest.approx(one.z[7])
    )
    assert (np.asarray(bank.forget(one, True).age) == -1).all() and (
        np.asarray(bank.forget(one, False).age) == one.age
    ).all()
