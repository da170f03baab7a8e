"""What healthy flights teach: weighted means, spreads and the loudest noise, of made-up flights whose answer is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.bindings import learning
from rotorwatch.engine.bindings.plant_rows import AXIS_STATES, any_air, any_multirotor
from rotorwatch.engine.estimator.plant import DAMPING, GAIN, PER_AXIS, SHARE_SD
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN

DT = 0.05
QUAD = airframes.named("ardupilot-quad-x").effectiveness()
Y6 = airframes.named("ardupilot-y6").effectiveness()
KNOWN = np.array([a * PER_AXIS + k for a in range(4) for k in (GAIN, DAMPING)])


def flight(gain=1.0, sd=0.1, noise=1.0, assessed_s=20.0, dt=DT, share=0.0, share_sd=0.05, bias=0.0, air=(0.05, 0.05)):
    """What the estimator would end with: gains and dampings `gain` times 1, 2 .. 8, known to `sd`; biases, which are not to be learned."""
    s, P = np.full(AXIS_STATES + 2, bias), np.eye(AXIS_STATES + 2)
    s[KNOWN], P[KNOWN, KNOWN] = gain * np.arange(1.0, 9.0), sd**2
    s[-1], P[-1, -1] = share, share_sd**2
    s[-2], P[-2, -2] = air[0], air[1] ** 2
    ticks = round(assessed_s / dt)
    mode = np.concatenate([np.full(100, LEARN), np.full(ticks, ASSESS)])
    carry = SimpleNamespace(s=s, P=P, variances=np.broadcast_to(noise, (4, 4)))
    return SimpleNamespace(mode=mode, dt=dt, carry=carry)


@pytest.fixture
def learn(monkeypatch):
    """learning.learn with an estimator that answers at once."""
    monkeypatch.setattr(learning, "estimate", lambda table, B: (table.carry, None))
    return learning.learn


def test_noise_is_that_of_the_loudest_flight_on_every_axis_and_time_scale(learn):
    """A limit that a calm flight has set would call every windy one a fault."""
    rng = np.random.default_rng(0)
    calm, rough = rng.uniform(1.0, 2.0, (4, 4)), rng.uniform(1.0, 2.0, (4, 4))
    calm[0, 0], rough[1, 2] = 5.0, 7.0
    expected = np.where(calm > rough, calm, rough)
    assert 0 < (calm > rough).sum() < 16
    assert np.array(learn([flight(noise=calm), flight(noise=rough)], QUAD)["noise"]) == pytest.approx(expected)


def test_no_time_scale_of_the_noise_is_silent(learn):
    """Against the loudest component of the same axis: variances grow by factors, and nothing times a factor is nothing."""
    silent = np.zeros((4, 4))
    silent[2] = [1.0, 2.0, 3.0, 4.0]
    found = np.array(learn([flight(noise=silent)], QUAD)["noise"])
    assert found == pytest.approx(np.where(silent > 0, silent, learning.LEAST_SHARE * np.array([1.0, 2.0, 3.0, 4.0])))
    assert 0.0 < learning.LEAST_SHARE < 0.5 and learning.LEARNED_WEIGHT > 0.0


def test_gains_and_damping_are_the_precision_weighted_mean_with_its_spread(learn):
    """By hand: weights 1 / variance; variance of that mean, scatter of the flights, and what few flights do not show of it."""
    found = learn([flight(0.01, 0.001), flight(0.013, 0.002)], QUAD)
    x0, P0 = np.array(found["x0"]), np.array(found["P0"])
    one, two = 0.01 * np.arange(1.0, 9.0), 0.013 * np.arange(1.0, 9.0)
    w = np.array([1.0 / 0.001**2, 1.0 / 0.002**2])
    mean = (w[0] * one + w[1] * two) / w.sum()
    scatter = (w[0] * (one - mean) ** 2 + w[1] * (two - mean) ** 2) / w.sum()
    usual_mean, usual = any_multirotor(4)
    usual_var = np.diag(usual)[KNOWN]
    expected = np.minimum(usual_var, 1.0 / w.sum() + scatter + learning.FLIGHTS_DIFFER * usual_var / 2)
    assert x0[KNOWN] == pytest.approx(mean)
    assert np.diag(P0)[KNOWN] == pytest.approx(expected) and (expected < usual_var).any()
    assert np.count_nonzero(P0[np.ix_(KNOWN, KNOWN)] - np.diag(np.diag(P0)[KNOWN])) == 0
    rest = np.setdiff1d(np.arange(AXIS_STATES), KNOWN)
    assert x0[rest] == pytest.approx(usual_mean[rest])
    assert P0[np.ix_(rest, rest)] == pytest.approx(usual[np.ix_(rest, rest)])
    assert found["dt"] == DT and found["noise_weight"] == learning.LEARNED_WEIGHT and "share" not in found


def test_more_flights_leave_less_open_and_nothing_becomes_less_known_than_for_any_vehicle(learn):
    one, four = (np.diag(learn([flight(0.01, 1e-4)] * k, QUAD)["P0"])[KNOWN] for k in (1, 4))
    usual = np.diag(any_multirotor(4)[1])[KNOWN]
    assert one - 1e-8 == pytest.approx(learning.FLIGHTS_DIFFER * usual, rel=1e-6)
    assert four - 1e-8 / 4 == pytest.approx(learning.FLIGHTS_DIFFER * usual / 4, rel=1e-6)
    assert np.diag(learn([flight(1.0, 100.0)], QUAD)["P0"])[KNOWN] == pytest.approx(usual)


def test_biases_are_each_flights_own(learn):
    assert learn([flight(bias=0.0)], QUAD) == learn([flight(bias=9.0)], QUAD)


@pytest.mark.parametrize("dt", [0.05, 0.5])
def test_what_is_assessed_for_less_than_ten_seconds_teaches_nothing(learn, dt):
    """Seconds, whatever the length of a tick."""
    short = flight(9.0, noise=9.0, assessed_s=9.5, dt=dt)
    assert learn([short], QUAD) is None and learn([], QUAD) is None
    long = flight(assessed_s=10.0, dt=dt)
    assert learn([long], QUAD) is not None and learn([short, long], QUAD)["x0"] == learn([long], QUAD)["x0"]


def test_ticks_of_a_length_that_the_estimator_does_not_have_are_left_out(learn):
    assert learn([flight(dt=0.07)], QUAD) is None


def test_what_air_takes_is_learned(learn):
    """As the share is; a flight that showed nothing of it leaves it open."""
    found = learn([flight(air=(0.08, 0.01)), flight(air=(0.1, 0.02))], QUAD)
    assert found["air"] == pytest.approx([0.09, (0.01**2 + 0.02**2) / 2 + 0.01**2])
    assert learn([flight()], QUAD)["air"] == pytest.approx(any_air())


def test_the_lower_rotors_share_is_learned_on_coaxial_frames_alone(learn):
    """Mean of the flights; their mean variance and their scatter."""
    found = learn([flight(share=0.1, share_sd=0.03), flight(share=0.2, share_sd=0.05)], Y6)
    assert found["share"] == pytest.approx([0.15, (0.03**2 + 0.05**2) / 2 + 0.05**2])
    assert found["share"][1] < SHARE_SD**2
    assert len(found["x0"]) == AXIS_STATES
