"""Rao-Blackwellised particle filter: against a second implementation with the same random numbers; it repeats itself, and finds losses."""

import numpy as np
import pytest

from measured import PLANT, run
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch.estimators.imm import IMM
from rotorwatch.estimators.rbpf import RBPF
from rotorwatch.maths import counter_random
from test_laws import DT, LOSS, ONSET, flown, linear_table, rates_hexa, rates_quad
from test_multiple_model import MODES, mixture, one_filter

jax = load_jax()
N, JUMP, WALK, VAR, HEALTHY, WEAK, SEED = 8, 0.3, 0.02, 0.2, 0.5, 2.0, 3


def mixed(x):
    """The generator's mix in whole numbers."""
    for _ in range(2):
        x = ((x ^ x >> 16) * 0x45D9F3B) & 0x7FFFFFFF
    return x ^ x >> 16


def uniform(counter, count):
    return [(mixed(mixed(counter) + k * 0x3504F333 & 0x7FFFFFFF) + 0.5) / 2**31 for k in range(1, count + 1)]


def second(table):
    """Particles as lists. Yields x, theta, theta_cov, probabilities, effective number."""
    particles = [(0, np.append(PLANT.x0, 0.0), np.pad(PLANT.P0, (0, 1)), 1.0 / N)] * N
    counter = SEED * 65537 % 2**30
    for u, y, valid, dt in zip(*table, strict=True):
        random, measured = uniform(counter, N + 1), valid.any()
        moved = []
        for (mode, s, P, w), r in zip(particles, random, strict=False):
            share, leave = 1.0, 1.0 - np.exp(-dt / (WEAK if mode else HEALTHY))
            if measured and r < JUMP:
                mode, share = (mode + 1 + int(r / JUMP * 3)) % 4, leave / JUMP
                s, P = np.append(s[:3], 0.0), np.pad(P[:3, :3], (0, 1))
                P[3, 3] = VAR * (mode > 0)
            elif measured:
                share = (1.0 - leave) / (1.0 - JUMP)
            s, P, density = one_filter(PLANT, MODES[mode], s, P, WALK, u, y, valid, dt)
            moved.append((mode, s, P, w * share * density))
        total = sum(p[3] for p in moved)
        particles = [(mode, s, P, w / total) for mode, s, P, w in moved]
        weights = [p[3] for p in particles]
        x, _ = mixture(weights, [s[:3] for _, s, _, _ in particles], [P[:3, :3] for _, _, P, _ in particles])
        theta, cov = mixture(
            weights,
            [s[3] * MODES[mode] for mode, s, _, _ in particles],
            [P[3, 3] * np.outer(MODES[mode], MODES[mode]) for mode, _, P, _ in particles],
        )
        effective = 1.0 / sum(w * w for w in weights)
        probability = [sum(w for (mode, *_), w in zip(particles, weights, strict=True) if mode == m) for m in range(4)]
        yield x, theta, cov, np.array(probability), effective
        if measured:
            counter = (counter + 1) % 2**30
            if effective < N / 2:
                sums = np.cumsum(weights)
                chosen = [min(int((sums < (k + random[N]) / N).sum()), N - 1) for k in range(N)]
                particles = [(*particles[k][:3], 1.0 / N) for k in chosen]


def test_it_is_what_a_second_implementation_says():
    """Gaps, steps of different length, feedthrough, jumps and resampling."""
    method = RBPF(
        PLANT, DT, particles=N, jump=JUMP, theta_walk=WALK, theta_var=VAR, healthy_s=HEALTHY, weak_s=WEAK, seed=SEED
    )
    table = linear_table(40)
    got = run(method, *table)
    wanted = [np.array(column) for column in zip(*second(table), strict=True)]
    e = got.estimate
    for a, b in zip((e.x, e.theta, e.theta_cov, got.probability, got.effective), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    assert got.effective.min() < N / 2 and (got.probability > 0).sum(axis=1).max() > 2  # all of it was needed


def test_random_numbers_are_those_of_whole_numbers_and_even():
    drawn = np.array([np.asarray(counter_random.uniform(np.int32(c), 50)) for c in (0, 1, 2, 7, 2**30 - 1)])
    np.testing.assert_array_equal(drawn, [uniform(c, 50) for c in (0, 1, 2, 7, 2**30 - 1)])
    many = np.asarray(jax.vmap(lambda c: counter_random.uniform(c, 200))(np.arange(500, dtype=np.int32)))
    assert 0.0 < many.min() and many.max() < 1.0
    # 100,000 numbers: five standard deviations of each figure.
    size = np.sqrt(many.size)
    assert abs(many.mean() - 0.5) < 5 / np.sqrt(12) / size and abs(many.var() - 1 / 12) < 5 * 0.075 / size
    for one, other in ((many[1:], many[:-1]), (many[:, 1:], many[:, :-1])):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 5 / size
    counts = np.histogram(many, 20, (0, 1))[0]
    assert ((counts - many.size / 20) ** 2 / (many.size / 20)).sum() < 19 + 5 * np.sqrt(38)


def test_a_run_repeats_itself_and_another_seed_is_another_run():
    table = flown(rates_quad, 0, LOSS)[:3]
    one, same, other = (run(RBPF(rates_quad(), DT, particles=20, seed=s), *table).estimate.theta for s in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-6
    np.testing.assert_allclose(one[-1], other[-1], atol=0.03)


@pytest.mark.parametrize("make", [rates_quad, rates_hexa], ids=lambda m: m.__name__)
def test_the_right_mode_wins_and_finds_the_loss(make):
    u, y, valid, _ = flown(make, 0, LOSS)
    out = run(RBPF(make(), DT), u, y, valid)
    np.testing.assert_allclose(out.probability.sum(axis=1), 1.0, atol=1e-12)
    assert (out.probability[50:ONSET, 0] > 0.5).all()
    late = slice(ONSET + 50, None)
    assert (out.probability[late, 2] > 0.9).all()
    np.testing.assert_allclose(out.estimate.theta[late, 1], LOSS, atol=0.08)
    assert np.abs(np.delete(out.estimate.theta[late], 1, axis=1)).max() < 0.03


@pytest.mark.thorough
def test_many_particles_say_what_interacting_models_say():
    """Of one Markov chain: exact but for the draws here, and for the mixing there."""
    u, y, valid, _ = flown(rates_quad, 5, LOSS)
    out, imm = run(RBPF(rates_quad(), DT, particles=400), u, y, valid), run(IMM(rates_quad(), DT), u, y, valid)
    late = slice(ONSET + 20, None)
    np.testing.assert_allclose(out.estimate.theta[late], imm.estimate.theta[late], atol=0.02)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"particles": 1}, "particles"),
        ({"particles": 2**30}, "particles"),
        ({"jump": 0.0}, "jump"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**30}, "seed"),
        ({"weak_s": 0.0}, "weak_s"),
    ],
)
def test_wrong_values_are_named(wrong, says):
    with pytest.raises(ConfigError, match=says):
        RBPF(rates_quad(), DT, **wrong)


def test_every_seed_below_the_counters_range_starts_at_a_place_of_its_own():
    """The counter has 30 bits and 65537 is odd: no two seeds share a start."""
    starts = {int(RBPF(rates_quad(), DT, particles=2, seed=s).init().counter) for s in (0, 1, 2**29, 2**30 - 1)}
    assert starts == {0, 65537, 2**29, 2**30 - 65537}
