"""What changed in an aircraft over its flights: steps, wear, services and shifted weights, distinguished and not made up."""

import numpy as np
import pytest

from fleet_history import SD, series
from rotorwatch.fleet import attribution, false_discovery, prognosis, scatter
from rotorwatch.fleet.attribution import CENTRE, STEP, WORN


def losses(K, n, **rotors):
    """theta (K, n): r3=array sets rotor 3's."""
    theta = np.zeros((K, n))
    for name, values in rotors.items():
        theta[:, int(name[1:]) - 1] = values
    return theta


def after(K, k, size):
    return np.where(np.arange(K) >= k, size, 0.0)


@pytest.mark.parametrize("n", [4, 6])
@pytest.mark.parametrize("at", [10, 30, 50])
def test_damage_is_found_where_it_happened(n, at):
    found = attribution.explain(series(losses(60, n, r3=after(60, at, 0.10)), seed=at))
    atom = next(a for a in found.atoms if a.kind == STEP)
    assert atom.rotor == 2 and abs(atom.start - at) <= 2
    assert found.evidence[2] > np.log(1000.0) and np.delete(found.evidence, 2).max() < 0.0
    assert abs(found.now[2] - 0.111) < 3 * found.now_sd[2] + 0.01
    k = found.atoms.index(atom)
    assert found.candidates[k][2] > 0.95
    assert found.when[k][0] - 1 <= at <= found.when[k][1] + 1


@pytest.mark.parametrize("n", [4, 6])
def test_slow_wear_is_found(n):
    found = attribution.explain(series(losses(100, n, r2=np.linspace(0.0, 0.10, 100)), seed=4))
    assert [a.kind for a in found.atoms] == [WORN] and found.atoms[0].rotor == 1
    assert found.now[1] == pytest.approx(0.11, abs=0.03)


def test_a_service_cuts_the_history():
    theta = losses(100, 4, r2=np.where(np.arange(100) < 60, np.linspace(0.0, 0.166, 100), 0.0))
    found = attribution.explain(series(theta, services=((60, 1),)))
    assert any(a.rotor == 1 and a.start < 60 for a in found.atoms)
    assert found.now[1] == 0.0 and found.e[59, 1] > 0.07
    # Not noted, the same exchange is a gain.
    unnoted = attribution.explain(series(theta))
    gain = [float(c[0]) for a, c in zip(unnoted.atoms, unnoted.coefficients) if a.kind == STEP and a.rotor == 1]
    assert gain and min(gain) < -0.05
    assert unnoted.now[1] < 0.03


def test_a_shifted_weight_is_no_rotor():
    one = series(losses(60, 4), seed=2)
    one.y[35:, :2] += [0.04, -0.03]
    found = attribution.explain(one)
    assert [a.kind for a in found.atoms] == [CENTRE] and abs(found.atoms[0].start - 35) <= 1
    assert found.evidence.max() < 0.0


def test_two_things_at_once():
    theta = losses(100, 4, r1=np.linspace(0.0, 0.1, 100), r4=after(100, 70, 0.15))
    found = attribution.explain(series(theta, seed=3))
    assert {a.rotor for a in found.atoms} == {0, 3}
    assert found.evidence[0] > 5.0 and found.evidence[3] > 5.0 and found.evidence[1:3].max() < 1.0


def test_single_odd_flights_are_not_damage():
    one = series(losses(60, 4), seed=5)
    one.y[[12, 30, 41, 59]] += [0.06, 0.05, 0.03]
    found = attribution.explain(one)
    assert found.evidence.max() < 0.0 and not found.atoms
    assert found.weight[[12, 30, 41, 59]].max() < 0.5


def test_flights_that_do_not_count_teach_nothing():
    one = series(losses(60, 4), seed=6)
    use = np.ones(60, bool)
    use[20:40] = False
    base = attribution.explain(attribution.Series(one.y, one.noise, one.hours, one.G, use))
    other = one.y.copy()
    other[20:40] += [0.1, 0.2, -0.1]
    changed = attribution.explain(attribution.Series(other, one.noise, one.hours, one.G, use))
    assert changed.atoms == base.atoms
    np.testing.assert_allclose(changed.evidence, base.evidence)
    np.testing.assert_allclose(changed.level, base.level)


def test_e_values_of_healthy_rotors_are_seldom_large():
    e = np.concatenate([attribution.explain(series(losses(40, 4), seed=100 + k)).evidence for k in range(60)])
    # Of an e-value, at most one in x may be above x.
    assert np.mean(e > np.log(20.0)) < 0.05 and np.mean(np.exp(e)) < 1.5


def test_sisters_show_damage_from_the_first_flight():
    theta = losses(40, 4, r3=np.full(40, 0.25))
    alone = attribution.explain(series(theta, seed=7))
    assert alone.evidence.max() < 1.0
    beside = attribution.explain(series(theta, seed=7, level=np.zeros(3), level_covariance=np.diag([0.02, 0.02, 0.012]) ** 2))
    assert beside.evidence[2] > 5.0 and beside.atoms[0].start == 0


def test_scatter_is_learned_in_spite_of_steps():
    rng = np.random.default_rng(1)
    y = rng.standard_normal((300, 3)) * SD
    for k in range(0, 300, 8):
        y[k:] += rng.standard_normal(3) * 0.1
    found = scatter.scale(scatter.differences(y), np.zeros((298, 3, 3)), np.diag([0.014, 0.014, 0.01]) ** 2)
    assert np.sqrt(np.diag(found)) == pytest.approx(SD, rel=0.4)


def test_neighbours_of_a_step_agree_and_a_lone_flight_does_not():
    y = np.zeros((20, 3))
    y[10:] += 0.1
    y[4] += 0.1
    weight = scatter.alone(y, np.tile(np.diag(SD**2), (20, 1, 1)))
    assert weight[4] < 0.2 and np.delete(weight, 4).min() == 1.0


def test_rotors_are_named_by_the_e_bh_procedure():
    log_e = np.log([500.0, 90.0, 30.0, 1.0])
    assert false_discovery.named(log_e, 0.05).tolist() == [True, True, True, False]  # 4 / (0.05 * 3) = 26.7
    assert false_discovery.named(log_e, 0.01).tolist() == [True, False, False, False]
    assert not false_discovery.named(np.zeros(5)).any() and false_discovery.named(np.zeros(0)).size == 0


def lines(now, growth, sd_now, sd_growth):
    return prognosis.Lines(np.ones(1), np.array([now]), np.array([growth]), np.diag([sd_now**2, sd_growth**2])[None])


def test_the_prognosis_of_one_line_is_fiellers():
    said = prognosis.foresee(lines(0.05, 0.01, 0.002, 0.001), 10.0)
    assert said.word == "growing" and said.hours == pytest.approx(5.0, rel=0.02)
    assert said.interval is not None and said.interval[1] is not None
    for t, z in zip(said.interval, (-1.6449, 1.6449)):
        assert (0.05 + 0.01 * t - 0.10) / np.hypot(0.002, 0.001 * t) == pytest.approx(z, abs=0.05)


@pytest.mark.parametrize(
    ("given", "word"), [(lines(0.05, 0.001, 0.002, 0.001), "no trend"), (lines(0.12, 0.01, 0.01, 0.001), "reached"), (None, "no trend")]
)
def test_no_prognosis_without_a_trend(given, word):
    said = prognosis.foresee(given, 10.0)
    assert said.word == word and (said.hours is None or said.hours == 0.0)


def test_what_lies_too_far_ahead_has_no_end():
    said = prognosis.foresee(lines(0.01, 0.0005, 0.001, 0.00025), 10.0)
    assert said.word == "growing" and said.interval is not None and said.interval[1] is None


@pytest.mark.thorough
def test_prognosis_intervals_hold():
    held = []
    for k in range(40):
        theta = losses(80, 4, r2=0.001 * np.maximum(np.arange(80) - 9, 0))
        one = series(theta, seed=200 + k)
        found = attribution.explain(one)
        said = prognosis.foresee(attribution.lines(one, found, 1), 80 / 60.0)
        if said.word == "growing" and said.interval is not None:
            low, high = said.interval
            held.append(low <= 30 / 60.0 and (high is None or 30 / 60.0 <= high))
    assert len(held) > 20 and np.mean(held) >= 0.8  # 0.9, with some 30 of them
