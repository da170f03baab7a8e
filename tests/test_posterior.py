"""Explanations side by side: their weights by independent sums, who leads, and what is dropped."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotorwatch.engine.default import posterior
from rotorwatch.engine.default.hypotheses import CLEAR
from rotorwatch.engine.default.plant import BURST_S
from rotorwatch.engine.default.posterior import NEVER, OUT, PLACES, TEMPER
from rotorwatch.engine.front.losses import YOUNG_S

DT, N, STATES = 0.05, 6, 9


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def some(weights, seed=0, age=0.0):
    """Branches with these weights whose every other number is different."""
    rng = np.random.default_rng(seed)
    shape = (PLACES, N)
    return posterior.Branches(
        rng.standard_normal((PLACES, STATES)), rng.standard_normal((PLACES, STATES, STATES)), np.array(weights, float),
        rng.random(shape) < 0.4, rng.uniform(0, 6, shape), rng.random(shape), rng.random(shape), rng.random(shape),
        np.zeros(shape, bool),
        rng.integers(1, 80, PLACES).astype(float), np.float64(age),
    )  # fmt: skip


def stretch(seed, ticks):
    """(innovations, variances, valid, calm) of so many ticks."""
    rng = np.random.default_rng(seed)
    variance = rng.uniform(0.5, 2.0, (ticks, PLACES, 4))
    size = np.array([1.0, 1.05, 0.95, 1.0])[:, None] * np.sqrt(variance)
    return (
        size * rng.standard_normal((ticks, PLACES, 4)),
        variance,
        rng.random((ticks, 4)) < 0.8,
        rng.uniform(0.2, 1.0, (ticks, 4)),
    )


def weighed(start, e, variance, valid, calm, counts=True):
    for k in range(len(e)):
        start = posterior.weigh(start, e[k], variance[k], valid[k], calm[k], counts, DT)
    return start


def test_at_first_nothing_has_happened():
    s, P = np.arange(float(STATES)), np.eye(STATES)
    b = posterior.init(s, P, N)
    assert np.asarray(posterior.shares(b)) == pytest.approx([1.0, 0.0, 0.0, 0.0])
    assert not b.active.any() and (b.s == s).all() and (b.P == P).all()


@pytest.mark.parametrize("seed", range(3))
def test_weights_are_log_likelihoods_that_count_for_less_with_age(seed):
    """Against the normal log-density, tick by tick and axis by axis; a place without an explanation stays without one."""
    ticks, first_age = 30, 0.4
    e, variance, valid, calm = stretch(seed, ticks)
    w0 = np.array([0.0, -0.5, 1.0, NEVER])
    b = weighed(some(w0, age=first_age), e, variance, valid, calm)
    density = -0.5 * np.log(2 * np.pi * variance) - 0.5 * e**2 / variance
    expected = w0.copy()
    for k in range(ticks):
        told = sum(calm[k, a] * density[k, :, a] for a in range(4) if valid[k, a])
        expected += TEMPER * np.exp(-(first_age + k * DT) / BURST_S) * told
    expected -= expected[0]
    assert np.asarray(b.weight)[:3] == pytest.approx(expected[:3], rel=1e-9, abs=1e-9)
    assert b.weight[3] == NEVER and b.age == pytest.approx(first_age + ticks * DT)
    assert np.asarray(b.onset) == pytest.approx(some(w0).onset + ticks)


def test_what_does_not_count_changes_no_weight():
    """Ticks that are not judged; axes that were not measured, whatever their numbers are."""
    e, variance, valid, calm = stretch(1, 10)
    start = some([0.0, -1.0, 2.0, NEVER])
    assert np.asarray(weighed(start, e, variance, valid, calm, counts=False).weight) == pytest.approx(start.weight)
    assert np.asarray(weighed(start, 1e3 * e, variance, 0 * valid > 0, calm).weight) == pytest.approx(start.weight)


def test_what_has_become_too_unlikely_is_dropped_for_good():
    one, valid = np.ones((PLACES, 4)), np.ones(4, bool)
    poor = np.array([0.0, 6.0, 0.0, 0.0])[:, None] * one
    start = some([0.0, OUT + 1.0, OUT + 1.0, NEVER], age=YOUNG_S)
    b = posterior.weigh(start, poor, one, valid, np.ones(4), True, DT)
    assert b.weight[1] == NEVER and b.weight[2] == pytest.approx(OUT + 1.0)
    back = posterior.weigh(b, poor[[1, 0, 2, 3]], one, valid, np.ones(4), True, DT)
    assert back.weight[1] == NEVER and np.asarray(posterior.shares(back))[1] == 0.0


def test_a_young_explanation_has_a_second_to_recover():
    """What tells a pair from the rotor between them, yaw and thrust, is slower than what announces it."""
    start, even, one = some([0.0, 2.0 * OUT, OUT - 1.0, NEVER]), np.zeros((PLACES, 4)), np.ones((PLACES, 4))
    ticks = round(YOUNG_S / DT)
    for _ in range(ticks):
        start = posterior.weigh(start, even, one, np.ones(4, bool), np.ones(4), True, DT)
    assert np.asarray(start.weight) == pytest.approx([0.0, 2.0 * OUT, OUT - 1.0, NEVER])
    start = posterior.weigh(start, even, one, np.ones(4, bool), np.ones(4), True, DT)
    assert np.asarray(start.weight).tolist() == [0.0, NEVER, NEVER, NEVER]


@given(st.lists(st.floats(-6.0, 6.0), min_size=3, max_size=3), st.integers(0, 5), st.integers(0, 7))
@settings(max_examples=40, deadline=None)
def test_the_best_leads_once_it_is_far_enough_ahead_and_nothing_is_lost(others, seed, absent):
    """Every part moves with its explanation, the former leader takes the place of the new one, and the leader weighs 0."""
    weights = np.array([0.0, *[NEVER if absent >> i & 1 else w for i, w in enumerate(others)]])
    before = some(weights, seed)
    after, changed = posterior.lead(before)
    best = int(np.argmax(weights))
    order = list(range(PLACES))
    if weights[best] > CLEAR:
        order[0], order[best] = order[best], order[0]
    assert bool(changed) == (order != list(range(PLACES)))
    for name in ("s", "P", "active", "learning", "theta_var", "theta_mean", "onset"):
        new, old = np.asarray(getattr(after, name)), getattr(before, name)
        assert new.dtype == old.dtype
        np.testing.assert_allclose(new, old[order], rtol=1e-12)
    real = weights[order] > NEVER / 2
    np.testing.assert_allclose(np.asarray(after.weight)[real], (weights[order] - weights[order[0]])[real], atol=1e-9)
    assert (np.asarray(after.weight)[~real] == NEVER).all() and after.weight[0] == 0.0
    assert after.age == before.age


@given(st.lists(st.floats(OUT, CLEAR), min_size=3, max_size=3), st.integers(0, 7))
@settings(max_examples=40, deadline=None)
def test_shares_are_probabilities_of_what_is_left(others, absent):
    weights = np.array([0.0, *[NEVER if absent >> i & 1 else w for i, w in enumerate(others)]])
    p = np.asarray(posterior.shares(some(weights)))
    assert p.sum() == pytest.approx(1.0)
    assert (p[weights == NEVER] == 0.0).all()
    real = weights > NEVER
    assert np.log(p[real] / p[0]) == pytest.approx(weights[real], abs=1e-9)


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("leads", [0, 1])
def test_a_branch_that_has_come_apart_spoils_no_other(bad, leads):
    """Numbers of one that overflowed: nobody else's change, also where places are exchanged, and it never leads."""
    weights = np.array([0.0, 2.0 * CLEAR * (1 if leads else -1), 1.0, -2.0])
    b = some(weights)
    b.s[2], b.P[2] = bad, bad
    new, changed = posterior.lead(b)
    assert bool(changed) == bool(leads)
    order = [1, 0, 3] if leads else [0, 1, 3]
    for name in ("s", "P", "learning", "active"):
        assert (np.asarray(getattr(new, name))[[0, 1, 3]] == np.asarray(getattr(b, name))[order]).all()
    e, variance, valid, calm = (part[0] for part in stretch(0, 1))
    usual = np.asarray(posterior.weigh(b, e, variance, valid, calm, True, DT).weight)
    e[2], variance[2] = bad, abs(bad)
    after = posterior.weigh(b, e, variance, valid, calm, True, DT)
    spoilt = np.asarray(after.weight)
    assert (spoilt[[0, 1, 3]] == usual[[0, 1, 3]]).all() and spoilt[2] == NEVER
    assert np.isfinite(np.asarray(posterior.shares(after))).all()
    # An axis that was not measured says nothing, whatever its numbers are.
    e, variance, valid, calm = (part[0] for part in stretch(0, 1))
    valid[3], usual = False, posterior.weigh(b, e, variance, np.array([*valid[:3], False]), calm, True, DT)
    e[:, 3] = bad
    assert (posterior.weigh(b, e, variance, valid, calm, True, DT).weight == usual.weight).all()
