"""The noise model finds what a signal was made of, on every time scale, and is not fooled by a step."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.plain import made

from rotorwatch.engine.bindings import program
from rotorwatch.engine.estimator import noise
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import TAU, Plant

DT = 0.05
KEPT = "v", "safety", "weight", "total"


def signal(variances, count, seed=0):
    """(count, 4) white noise, two coloured disturbances and a random walk; variances (4 components, 4 axes)."""
    rng = np.random.default_rng(seed)
    white, fast, slow, walk = np.sqrt(np.asarray(variances, float))
    out = white * rng.standard_normal((count, 4))
    for sd, tau in ((fast, TAU[0]), (slow, TAU[1])):
        keep = np.exp(-DT / tau)
        b = sd * rng.standard_normal(4)
        for k in range(count):
            out[k] += b
            b = keep * b + sd * np.sqrt(1 - keep**2) * rng.standard_normal(4)
    return out + np.cumsum(walk * np.sqrt(DT) * rng.standard_normal((count, 4)), axis=0)


def begun(prior=None, weight=noise.GENERIC_WEIGHT):
    """(plant, noise model) before the first residual."""
    known = np.tile(np.array(noise.GENERIC)[:, None], (1, 4)) if prior is None else prior
    p, one = made(Plant, rotors=4, dt=DT, noise=known, noise_weight=weight), Noise()
    one.begin(p)
    return p, one


def learn(e, ok=None, **prior):
    """What the noise model holds after each residual, stacked."""
    p, one = begun(**prior)
    kept = {name: [] for name in KEPT}
    for row, counts in zip(e, np.ones(e.shape, bool) if ok is None else ok, strict=True):
        one.step(p, row.tolist(), counts.tolist(), [1.0] * 4)
        for name, column in kept.items():
            column.append(np.array(getattr(one, name)))
    return SimpleNamespace(**{name: np.array(column) for name, column in kept.items()})


def structure(variances):
    """Model variance of differences at each lag (7, 4): what a detector of jumps lives on."""
    lag = np.array(noise.LAGS) * DT
    basis = np.stack([np.ones(len(lag)), *(1.0 - np.exp(-lag / t) for t in TAU), lag / 2.0], axis=1)
    return basis @ variances


@pytest.mark.parametrize(
    "made_of",
    [
        (0.05**2, 1e-10, 1e-10, 1e-10),
        (0.01**2, 0.05**2, 1e-10, 1e-10),
        (0.01**2, 1e-10, 0.06**2, 1e-10),
        (0.02**2, 1e-10, 1e-10, 0.05**2),
        (0.03**2, 0.03**2, 0.05**2, 0.01**2),
    ],
    ids=["white", "fast", "slow", "walk", "mixed"],
)
def test_the_noise_of_a_flight_is_found_on_every_scale(made_of):
    made = np.tile(np.array(made_of)[:, None], (1, 4))
    found = learn(signal(made, 2400)).v[-1]
    ratio = structure(found) / structure(made)
    assert np.all(ratio > 0.5) and np.all(ratio < 2.5), ratio
    assert np.all(ratio[:4] > 0.7) and np.all(ratio[:4] < 1.8), ratio  # up to half a second: many samples


def test_axes_are_learned_apart():
    made = np.full((4, 4), 1e-10)
    made[0] = np.array([0.005, 0.02, 0.08, 0.3]) ** 2
    found = learn(signal(made, 1200)).v[-1, 0]
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(made[0]), rtol=0.25)


@pytest.mark.parametrize("step", [0.3, 3.0])
def test_a_step_does_not_poison_it(step):
    """A fault that nobody announced: afterwards the noise is hardly larger than before, even for a very large step."""
    made = np.full((4, 4), 1e-10)
    made[0] = 0.01**2
    e = signal(made, 1200)
    e[900:] += step
    states = learn(e)
    before, after = structure(states.v[899])[0], structure(states.v[-1])[0]
    assert np.all(after < 2.0 * before)  # what tick-to-tick noise is thought to be
    assert np.all(np.sqrt(structure(states.v[-1])) < 0.3 * step)  # a step of this size still stands out


def test_it_learns_within_seconds():
    made = np.full((4, 4), 1e-10)
    made[0] = 0.004**2
    start = structure(np.array(noise.GENERIC)[:, None])[0, 0]
    found = structure(learn(signal(made, 100)).v[-1])[0]
    assert start > 100 * made[0, 0]
    assert np.all(found < 4 * made[0]) and np.all(found > 0.3 * made[0])


def test_gaps_and_masked_axes_teach_nothing():
    made = np.full((4, 4), 1e-10)
    made[0] = 0.02**2
    e = signal(made, 400)
    ok = np.ones(e.shape, bool)
    ok[200:260] = False
    ok[:, 3] = False
    spoilt = np.where(ok, e, 1e3)
    one, two = learn(e, ok), learn(spoilt, ok)
    np.testing.assert_array_equal(one.v, two.v)
    np.testing.assert_array_equal(one.total[:, :, 3], np.broadcast_to(one.total[0, :, 3], one.total[:, :, 3].shape))
    assert np.all(np.isfinite(two.v)) and np.all(two.v > 0)


def test_healthy_flights_known_before_are_believed_at_first():
    """A prior with the weight of a flight hardly moves within a second, a generic one does."""
    known = np.tile(np.array([[0.05**2], [1e-6], [1e-6], [1e-6]]), (1, 4))
    made = np.full((4, 4), 1e-10)
    made[0] = 0.005**2
    e = signal(made, 20)
    firm = learn(e, prior=known, weight=500.0).v[-1, 0]
    weak = learn(e, prior=known, weight=0.02).v[-1, 0]
    assert np.all(firm > 0.8 * known[0]) and np.all(weak < 0.1 * known[0])


def test_sums_of_squared_differences_forget_over_a_minute():
    """Against the sums written out, lag by lag: what counts fades with MEMORY_S, is clipped, and long lags count for less."""
    e = signal(np.full((4, 4), 1e-4), 300)
    e[250:] += 0.5
    ok = np.ones(e.shape, bool)
    ok[100:120, 1] = False
    states = learn(e, ok, weight=3.0)
    _, start = begun(weight=3.0)
    weight, total, fade = np.array(start.weight), np.array(start.total), np.exp(-DT / noise.MEMORY_S)
    for k in range(300):
        for row, lag in enumerate(noise.LAGS):
            if k < lag:
                continue
            both = ok[k] & ok[k - lag]
            square = np.minimum(0.5 * (e[k] - e[k - lag]) ** 2, noise.CLIP * total[row] / weight[row])
            weight[row] = np.where(both, weight[row] * fade + 1.0 / lag, weight[row])
            total[row] = np.where(both, total[row] * fade + square / lag, total[row])
    np.testing.assert_allclose(states.weight[-1], weight, rtol=1e-9)
    np.testing.assert_allclose(states.total[-1], total, rtol=1e-9)
    assert noise.MEMORY_S == 60.0 and 1.0 / (1.0 - fade) == pytest.approx(noise.MEMORY_S / DT, rel=1e-3)


def test_how_large_disturbances_are_is_said_alike_tick_by_tick_and_afterwards():
    v = np.random.default_rng(0).uniform(0.0, 1.0, (4, 4))
    assert program.Learned(None, None, v).spread == pytest.approx([made(Noise, v=v).spread(a) for a in range(4)])
