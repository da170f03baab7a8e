"""What the answer of a vehicle to an excitation says: of Gaussian data whose truth is known, and of flights in the simulator."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes, diagnose
from rotorwatch.engine.estimator.plant import AIR, SHARE, TAU
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN
from rotorwatch.flight.diagnosis import Event
from rotorwatch.stats.tails import normal_cdf
from rotorwatch.witnesses import excitation_response
from rotorwatch_lab.campaign import excitation_flights
from rotorwatch_lab.control import excitation
from rotorwatch_lab.planning.question import suspects

B = airframes.named("px4-hexa-x").effectiveness()
N = excitation.null_space(B)
PAIRS = {(0, 1): (1, 2), (2, 3): (3, 4), (4, 5): (5, 6)}
NAMED = {who: np.where(np.isin(np.arange(6), who), 0.3, 0.0) for who in PAIRS}


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def reported(theta, seed=0, sd=0.015, trim=False):
    """Information of the size that three seconds give, along the null space (with trim: along all else), of losses theta (6,)."""
    rng = np.random.default_rng(seed)
    A = (B / np.linalg.norm(B, axis=1, keepdims=True)) if trim else N.T
    J, noise = A.T @ A / sd**2, A.T @ rng.standard_normal(len(A)) / sd
    D = len(excitation_response.DELAYS_S)
    return excitation_response.ExcitationEvidence(30.0, 32.0, np.tile(J, (D, 1, 1)), np.tile(J @ theta + noise, (D, 1)))


@pytest.mark.parametrize("who", [(), *PAIRS])
def test_the_true_pair_is_named_and_its_losses_are(who):
    theta = np.where(np.isin(np.arange(6), who), 0.25, 0.0)
    for seed in range(5):
        one = reported(theta, seed)
        found = excitation_response.shares([one], NAMED, 6)
        assert next(iter(found)) == who and found[who] > excitation_response.CERTAIN
        assert sum(found.values()) == pytest.approx(1.0)
        if who:
            _, mean, cov = excitation_response.evidence([one], who, excitation_response.prior(who, 6, NAMED[who]))
            apart = np.abs(mean - theta)[list(who)] / np.sqrt(np.diag(cov))[list(who)]
            assert apart.max() < 4.0


def test_probabilities_are_honest():
    """Of answers whose truth is drawn from what is supposed, those that are neither clear nor open are right as often as they say."""
    rng, right, said = np.random.default_rng(2), [], []
    sets = [(), *PAIRS]
    priors = {who: excitation_response.prior(who, 6, NAMED[who]) for who in PAIRS}
    for seed in range(300):
        who = sets[rng.integers(4)]
        mean, sd = priors.get(who, excitation_response.prior((), 6))
        theta = mean + sd * rng.standard_normal(6)
        one = reported(np.where(mean > 0.0, np.abs(theta), theta), seed, sd=0.15)
        one = one._replace(J=one.J[:1], z=one.z[:1])
        logs = np.array([0.0, *(excitation_response.evidence([one], k, priors[k])[0] for k in PAIRS)])
        share = np.exp(logs - np.logaddexp.reduce(logs))
        if 0.5 < share.max() < 0.95:
            right.append(sets[int(share.argmax())] == who)
            said.append(share.max())
    assert len(said) > 50
    assert np.mean(right) == pytest.approx(np.mean(said), abs=3.0 * 0.5 / np.sqrt(len(said)))


def test_negative_losses_are_none():
    """What would be explained by rotors that give more than before is no loss of theirs."""
    theta = np.where(np.isin(np.arange(6), (0, 1)), -0.2, 0.0)
    found = excitation_response.shares([reported(theta)], NAMED, 6)
    assert found[(0, 1)] < 1e-3


def test_a_loss_since_the_flight_began_changes_trim_and_an_older_one_does_not():
    theta = np.where(np.isin(np.arange(6), (2,)), 0.4, 0.0)
    nothing = reported(np.zeros(6), 1, 0.05, trim=True)
    new = excitation_response.shares([reported(theta)], {}, 6, reported(theta, 1, 0.05, trim=True))
    assert next(iter(new)) == (2,) and all(2 in who for who, p in new.items() if p > 0.03)
    old = excitation_response.shares([reported(theta)], {}, 6, nothing)
    # The pair that half of it each would answer as.
    assert {(2,), (3,), (2, 3)} >= {who for who, p in old.items() if p > 0.2} and old[()] < 0.01


def test_candidates_lack_the_same_in_hover():
    event = Event("loss_of_effectiveness", (1, 2), 20.0, 21.0, None, (0.3, 0.3), ((0.1, 0.5),) * 2, 0.4, ((3, 4), (5, 6)))
    found = excitation_response.candidates(event, B)
    for losses in found.values():
        assert B @ losses == pytest.approx(B @ found[(0, 1)], abs=1e-9)


def test_the_information_of_ticks_finds_the_losses_and_the_lag():
    """e made of a known loss, with a rotor lag that nobody reported: within its own uncertainty, at about the right delay."""
    rng, dt, T = np.random.default_rng(4), 0.05, 100
    time = dt * np.arange(T)
    q = (np.outer(np.sin(2 * np.pi * time / 0.5), N[:, 0]) + np.outer(np.sin(3 * np.pi * time / 0.5), N[:, 1])) * 0.5
    theta = np.array([0.3, 0.25, 0.0, 0.0, 0.0, 0.0])
    delay = 0.04
    late = np.column_stack([np.interp(time - delay, time, q[:, i]) for i in range(6)])
    e = 0.4 + late @ (B[3] * theta) + 0.02 * rng.standard_normal(T)
    noise = excitation.Noise(np.array([0.02**2, 0.0, 0.0, 1e-6]), np.array(TAU))
    model = excitation_response._Model(e, np.zeros(6), 0.0, noise)
    table = type("Table", (), {"time": time, "dt": dt})
    one = excitation_response._response(np.arange(2, T), (0.0, 5.0), q, model, table, B)
    best = [excitation_response._gaussian(J, z, np.zeros(6), np.full(6, 0.3))[0] for J, z in zip(one.J, one.z, strict=True)]
    assert excitation_response.DELAYS_S[int(np.argmax(best))] == delay
    found = excitation_response.shares([one], NAMED, 6)
    assert next(iter(found)) == (0, 1)
    k = int(np.argmax(best))
    seen = np.linalg.pinv(N.T @ one.J[k] @ N) @ (N.T @ one.z[k])
    assert seen == pytest.approx(N.T @ theta, abs=0.03)


@pytest.mark.parametrize("sd", [(1.0, 1.0), (0.5, 3.0), (2.0, 0.2)])
def test_the_probability_of_two_losses_above_nothing_is_that_of_the_quadrant(sd):
    """Sheppard's: 1/4 + asin(rho) / 2 pi without a mean; of independent ones the product."""
    sd = np.array(sd)
    for rho in (-0.9, -0.3, 0.0, 0.6, 0.95):
        cov = np.outer(sd, sd) * [[1.0, rho], [rho, 1.0]]
        wanted = 0.25 + np.arcsin(rho) / (2.0 * np.pi)
        assert excitation_response._positive(np.zeros(2), cov) == pytest.approx(wanted, abs=1e-3)
    mean = np.array([0.7, -0.4]) * sd
    wanted = float(normal_cdf(0.7) * normal_cdf(-0.4))
    assert excitation_response._positive(mean, np.diag(sd**2)) == pytest.approx(wanted, abs=1e-3)


def assessed_trim(biases, dt=0.1):
    """(carry, out, table) of a flight that learns for 3 s and is assessed for 9 s, with these biases (120, 4) of its trim."""
    time = dt * np.arange(120)
    mode, restart = np.where(time < 3.0, LEARN, ASSESS), np.arange(120) == 0
    carry = SimpleNamespace(spread=np.zeros(4))
    return carry, SimpleNamespace(biases=biases), SimpleNamespace(time=time, mode=mode, restart=restart)


def test_trim_has_shifted_by_its_last_two_seconds_less_its_first_two():
    """Of a bias that grows evenly: by the time between the middles of the two. What was learned before it was assessed does not count."""
    slope, time = np.array([0.1, -0.2, 0.05, 0.3]), 0.1 * np.arange(120)
    biases = np.where((time < 2.95)[:, None], 9.0, np.outer(time, slope))
    found, sd = excitation_response.shift(*assessed_trim(biases))
    np.testing.assert_allclose(found, 7.0 * slope, rtol=0.02)  # 9 s, less half of two seconds at either end
    assert (sd > 0.0).all()


@pytest.mark.parametrize("left, suspected", [(3.5, True), (4.5, False)])
def test_a_rotor_is_suspected_where_it_leaves_no_more_than_four_sd_of_trim_unexplained(left, suspected):
    carry, out, table = assessed_trim(np.zeros((120, 4)))
    _, sd = excitation_response.shift(carry, out, table)
    column, apart = B[:, 2] / sd, np.array([1.0, 1.0, 0.0, 0.0])
    apart = apart - column * (column @ apart) / (column @ column)  # what no loss of rotor 3 makes
    change = B[:, 2] * 0.4 + sd * left * apart / np.linalg.norm(apart)
    out.biases[table.time > 7.0] = change
    found = suspects(carry, out, table, B)
    assert ((2,) in found) == suspected
    if suspected:
        np.testing.assert_allclose(found[(2,)], 0.4 * np.eye(6)[2], atol=1e-9)


def test_a_loss_that_needs_no_asking_stays_and_those_after_it_are_asked_for(monkeypatch):
    """One that ended before the excitation is what it was; the ambiguous one after it is resolved."""
    over = Event("loss_of_effectiveness", (3,), 8.0, 9.0, 12.0, (0.3,), ((0.2, 0.4),), 0.99)
    event = Event("loss_of_effectiveness", (1, 2), 20.0, 21.0, None, (0.3, 0.3), ((0.1, 0.5),) * 2, 0.4, ((3, 4), (5, 6)))
    one = reported(np.where(np.isin(np.arange(6), (2, 3)), 0.3, 0.0))
    monkeypatch.setattr(excitation_response, "find", lambda *_: ((one,), None, ()))
    events, _ = excitation_response.resolve((over, event), None, B)
    assert events[0] is over and [e.rotors for e in events] == [(3,), (3, 4)] and not events[1].alternatives


def scenario(who, loss, wind=1.0):
    base = excitation_flights.draw(3, "hexa-x", 7)
    fault = {"kind": "loss", "strength": loss, "onset_s": excitation_flights.ONSET_S, "end_s": None, "ramp_s": 0.0, "period_s": None}
    rows = tuple({**fault, "rotor": r, "level": None, "duty": 0.5, "vibration": 6.0, "times": 4.0, "angle_deg": None} for r in who)
    return replace(base, faults=rows, wind={**base.wind, "speed_m_s": wind})


@pytest.fixture(scope="module")
def flown():
    """A pair of opposite rotors, and none: as they are, and excited from 21 s on."""
    scenarios = [scenario((3, 4), 0.35), scenario((), 0.0)]
    sets = [np.where(np.isin(np.arange(6), who), 0.3, 0.0) for who in (*PAIRS, ())]
    noise = excitation.Noise(np.array([0.025**2, 0.0, 0.02**2, 0.2**2]), np.array(TAU))
    made = excitation.design(B, sets, np.full(6, 0.45), noise, np.array([0.03, 0.03, 0.8]), 0.05, length_s=2.0)
    asks = made.signal._replace(start=np.array(21.0))
    four = [*scenarios, *scenarios]
    return excitation_flights.fly(four, [excitation.none(6)] * 2 + [asks] * 2)


def test_a_pair_that_is_ambiguous_is_named_once_it_is_asked(flown):
    before, after = diagnose(flown[0][1]), diagnose(flown[2][1])
    assert before.verdict == "ambiguous" and (3, 4) in {before.events[0].rotors, *before.events[0].alternatives}
    assert after.verdict == "fault" and [e.rotors for e in after.events] == [(3, 4)]
    event = after.events[0]
    assert not event.alternatives and event.probability > 0.95 and "excitation" in event.reason
    assert all(low < 0.35 < high for low, high in event.interval)
    assert event.extra["asked"]["start_s"] == pytest.approx(21.0, abs=0.3)
    assert excitation_flights.attitude_change(flown[0][0], flown[2][0]) < 1.0


def test_a_healthy_vehicle_stays_healthy_and_does_not_move(flown):
    answer = diagnose(flown[3][1])
    assert answer.verdict == "healthy" and not answer.events
    assert any("healthy rotors" in a for a in answer.assumptions)
    assert excitation_flights.attitude_change(flown[1][0], flown[3][0]) < 0.2


def test_without_an_excitation_nothing_changes(flown):
    table, _, _, B_, losses = excitation_flights.assessed(flown[0][1])
    assert excitation_response.find(table, B_) == ((), None, ())
    assert excitation_response.resolve(losses, table, B_) == (losses, ())


def test_as_much_calm_flight_is_looked_at_before_an_excitation_as_after_it(flown, monkeypatch):
    """Less than a second on either side; time stamps 1/16 s apart, so that some ticks are exactly a second away."""
    table, _, _, B_, _ = excitation_flights.assessed(flown[2][1])
    even = replace(table, time=np.arange(len(table.time)) / 16.0)
    response, looked = excitation_response._response, []

    def spy(rows, span, *rest):
        looked.append((rows, span))
        return response(rows, span, *rest)

    monkeypatch.setattr(excitation_response, "_response", spy)
    assert excitation_response.find(even, B_)[0]
    for rows, (start, end) in looked:
        first, last = np.searchsorted(even.command_time, start), np.searchsorted(even.time, end)
        assert first - rows[0] == rows[-1] - last == 15


def test_a_log_says_what_to_ask(flown):
    from rotorwatch_lab.planning.ask import ask

    found = ask(flown[0][1])
    assert set(found.candidates) == {(1, 2), (3, 4), (5, 6), ()}
    assert found.design.information.min() >= found.design.needed and found.design.signal.length <= 10.0


def test_the_lower_rotors_share_is_read_from_its_own_place_in_the_state():
    """Not from that of the air, which stands before it."""
    coaxial = airframes.named("ardupilot-y6").effectiveness()
    n, T = coaxial.shape[1], 5
    s, P = np.zeros(SHARE + 1 + n), 9.0 * np.eye(SHARE + 1 + n)
    s[AIR], s[SHARE], P[SHARE, SHARE] = 0.7, 0.1, 0.04**2
    thrust = np.random.default_rng(0).uniform(0.5, 1.5, (T, n))
    table = SimpleNamespace(thrust=thrust, wrench=np.zeros((T, 4)), load=np.zeros(T))
    model = excitation_response._model(SimpleNamespace(s=s, P=P, variances=np.zeros((4, 4))), table, coaxial)
    assert model.sd == pytest.approx(0.04)
    np.testing.assert_allclose(model.left, 0.1 * thrust @ model.more)
