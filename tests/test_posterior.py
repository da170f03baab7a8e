"""Explanations side by side: their weights by independent sums, who leads, and what is dropped."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.plain import array, copied, filled, plant, room

from conftest import trials
from rotorwatch import airframes
from rotorwatch.engine.bindings.program import square
from rotorwatch.engine.estimator.estimator_sizes import PLACES
from rotorwatch.engine.estimator.hypotheses import CLEAR
from rotorwatch.engine.estimator.plant import BURST_S, THETA
from rotorwatch.engine.estimator.posterior import NEVER, OUT, TEMPER, Branches
from rotorwatch.engine.events.losses import YOUNG_S

DT, N = 0.05, 6
STATES = THETA + N
P = plant(airframes.named("ardupilot-hexa-x").effectiveness(), DT)
FIELDS = ("s", "P", "active", "learning", "variance", "mean", "onset")


def some(weights, seed=0, age=0.0):
    """Branches with these weights whose every other number is different."""
    rng, found = np.random.default_rng(seed), Branches()
    for one, weight in zip(found.all, weights):
        filled(
            one, s=rng.standard_normal(STATES), P=rng.standard_normal(STATES * (STATES + 1) // 2), weight=float(weight),
            active=rng.random(N) < 0.4, learning=rng.uniform(0, 6, N), variance=rng.random(N), mean=rng.random(N), gives=rng.random(N),
            onset=float(rng.integers(1, 80)),
        )  # fmt: skip
    found.age = float(age)
    return found


def stretch(seed, ticks):
    """(innovations, variances, valid, calm) of so many ticks."""
    rng = np.random.default_rng(seed)
    variance = rng.uniform(0.5, 2.0, (ticks, PLACES, 4))
    size = np.array([1.0, 1.05, 0.95, 1.0])[:, None] * np.sqrt(variance)
    return (size * rng.standard_normal((ticks, PLACES, 4)), variance, rng.random((ticks, 4)) < 0.8, rng.uniform(0.2, 1.0, (ticks, 4)))


def weigh(b, e, variance, valid, calm, counts=True):
    """One tick more, of other branches."""
    b = copied(b)
    for one, nu, S in zip(b.all, e, variance):
        one.innovation, one.S = nu.tolist(), S.tolist()
    b.weigh(P, list(calm), list(valid), counts)
    return b


def weighed(start, e, variance, valid, calm, counts=True):
    for k in range(len(e)):
        start = weigh(start, e[k], variance[k], valid[k], calm[k], counts)
    return start


def weights_of(b):
    return np.array([one.weight for one in b.all])


def shares(b):
    out = room(PLACES)
    b.shares(out)
    return np.array(out)


def test_at_first_nothing_has_happened():
    b = Branches()
    b.begin(P)
    assert shares(b) == pytest.approx([1.0, 0.0, 0.0, 0.0])
    leader, covariance = b.all[0], square(np.array(b.all[0].P), STATES)
    assert not any(leader.active) and leader.s[:THETA] == P.mean and not any(leader.s[THETA:])
    assert (covariance[:THETA, :THETA] == array(P.variance)).all()
    built = covariance[THETA:, THETA:]  # rotors differ as they are built, about the mean of all
    assert built.sum(axis=0) == pytest.approx(np.zeros(N), abs=1e-15) and built[0, 0] > 0.0


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
        reported = sum(calm[k, a] * density[k, :, a] for a in range(4) if valid[k, a])
        expected += TEMPER * np.exp(-(first_age + k * DT) / BURST_S) * reported
    expected -= expected[0]
    assert weights_of(b)[:3] == pytest.approx(expected[:3], rel=1e-9, abs=1e-9)
    assert b.all[3].weight == NEVER and b.age == pytest.approx(first_age + ticks * DT)
    assert [one.onset for one in b.all] == [one.onset + ticks for one in some(w0).all]


def test_what_does_not_count_changes_no_weight():
    """Ticks that are not assessed; axes that were not measured, whatever their numbers are."""
    e, variance, valid, calm = stretch(1, 10)
    start = some([0.0, -1.0, 2.0, NEVER])
    assert weights_of(weighed(start, e, variance, valid, calm, counts=False)) == pytest.approx(weights_of(start))
    assert weights_of(weighed(start, 1e3 * e, variance, 0 * valid > 0, calm)) == pytest.approx(weights_of(start))


def test_what_has_become_too_unlikely_is_dropped_for_good():
    one, valid = np.ones((PLACES, 4)), np.ones(4, bool)
    poor = np.array([0.0, 6.0, 0.0, 0.0])[:, None] * one
    start = some([0.0, OUT + 1.0, OUT + 1.0, NEVER], age=YOUNG_S)
    b = weigh(start, poor, one, valid, np.ones(4))
    assert b.all[1].weight == NEVER and b.all[2].weight == pytest.approx(OUT + 1.0)
    back = weigh(b, poor[[1, 0, 2, 3]], one, valid, np.ones(4))
    assert back.all[1].weight == NEVER and shares(back)[1] == 0.0


def test_a_young_explanation_has_a_second_to_recover():
    """What tells a pair from the rotor between them, yaw and thrust, is slower than what announces it."""
    start, even, one = some([0.0, 2.0 * OUT, OUT - 1.0, NEVER]), np.zeros((PLACES, 4)), np.ones((PLACES, 4))
    ticks = round(YOUNG_S / DT)
    for _ in range(ticks):
        start = weigh(start, even, one, np.ones(4, bool), np.ones(4))
    assert weights_of(start) == pytest.approx([0.0, 2.0 * OUT, OUT - 1.0, NEVER])
    start = weigh(start, even, one, np.ones(4, bool), np.ones(4))
    assert weights_of(start).tolist() == [0.0, NEVER, NEVER, NEVER]


@given(st.lists(st.floats(-6.0, 6.0), min_size=3, max_size=3), st.integers(0, 5), st.integers(0, 7))
@settings(max_examples=trials(40), deadline=None)
def test_the_best_leads_once_it_is_far_enough_ahead_and_nothing_is_lost(others, seed, absent):
    """Every part moves with its explanation, the former leader takes the place of the new one, and the leader weighs 0."""
    weights = np.array([0.0, *[NEVER if absent >> i & 1 else w for i, w in enumerate(others)]])
    before = some(weights, seed)
    after = copied(before)
    changed = after.lead()
    best = int(np.argmax(weights))
    order = list(range(PLACES))
    if weights[best] > CLEAR:
        order[0], order[best] = order[best], order[0]
    assert changed == (order != list(range(PLACES)))
    for name in FIELDS:
        assert [getattr(one, name) for one in after.all] == [getattr(before.all[k], name) for k in order]
    real = weights[order] > NEVER / 2
    np.testing.assert_allclose(weights_of(after)[real], (weights[order] - weights[order[0]])[real], atol=1e-9)
    assert (weights_of(after)[~real] == NEVER).all() and after.all[0].weight == 0.0
    assert after.age == before.age


@given(st.lists(st.floats(OUT, CLEAR), min_size=3, max_size=3), st.integers(0, 7))
@settings(max_examples=trials(40), deadline=None)
def test_shares_are_probabilities_of_what_is_left(others, absent):
    weights = np.array([0.0, *[NEVER if absent >> i & 1 else w for i, w in enumerate(others)]])
    p = shares(some(weights))
    assert p.sum() == pytest.approx(1.0)
    assert (p[weights == NEVER] == 0.0).all()
    real = weights > NEVER
    assert np.log(p[real] / p[0]) == pytest.approx(weights[real], abs=1e-9)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("leads", [0, 1])
def test_a_branch_that_has_come_apart_spoils_no_other(bad, leads):
    """Numbers of one that overflowed: nobody else's change, also where places are exchanged, and it never leads."""
    weights = np.array([0.0, 2.0 * CLEAR * (1 if leads else -1), 1.0, -2.0])
    b = filled(some(weights))
    filled(b.all[2], s=np.full(STATES, bad), P=np.full(STATES * (STATES + 1) // 2, bad))
    new = copied(b)
    assert new.lead() == bool(leads)
    order = [1, 0, 3] if leads else [0, 1, 3]
    for name in ("s", "P", "learning", "active"):
        assert [getattr(new.all[k], name) for k in (0, 1, 3)] == [getattr(b.all[k], name) for k in order]
    e, variance, valid, calm = (part[0] for part in stretch(0, 1))
    usual = weights_of(weigh(b, e, variance, valid, calm))
    e[2], variance[2] = bad, abs(bad)
    after = weigh(b, e, variance, valid, calm)
    spoilt = weights_of(after)
    assert (spoilt[[0, 1, 3]] == usual[[0, 1, 3]]).all() and spoilt[2] == NEVER
    assert np.isfinite(shares(after)).all()
    # An axis that was not measured says nothing, whatever its numbers are.
    e, variance, valid, calm = (part[0] for part in stretch(0, 1))
    valid[3], usual = False, weigh(b, e, variance, np.array([*valid[:3], False]), calm)
    e[:, 3] = bad
    assert (weights_of(weigh(b, e, variance, valid, calm)) == weights_of(usual)).all()


@pytest.mark.parametrize("alike, stays", [(True, True), (False, False)])
def test_pairs_that_look_alike_stay_possible(alike, stays):
    """How rotors differ in hover is not known well enough to drop one of them."""
    start = some([0.0, OUT - 1.0, NEVER, NEVER], age=2.0 * YOUNG_S)
    for one in start.all[:2]:
        one.alike[1] = alike
    reported = weigh(start, np.zeros((PLACES, 4)), np.ones((PLACES, 4)), np.ones(4, bool), np.ones(4))
    assert reported.all[1].weight == (-CLEAR if stays else NEVER)
