"""When a fault is announced or something is absorbed without, tick by tick, and when noise may be learned."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.plain import filled, made

from rotorwatch.engine.bindings import program
from rotorwatch.engine.estimator import announcement
from rotorwatch.engine.estimator.announcement import ABSORB_S, EDGE, RECOVERS_S, TICKS, Alarm
from rotorwatch.engine.estimator.hypotheses import CLEAR, PAIR, PAIR_WEIGHT, RECOVERY, SINGLE, STUCK_WEIGHT
from rotorwatch.engine.estimator.noise import MEMORY_S
from rotorwatch.engine.estimator.plant import BURST_S, USUAL_S, Plant
from rotorwatch.engine.events.decisions import CERTAIN_NATS, FALSE_ALARM_PERIOD_S

N, DT, LIMIT, REACH = 4, 0.05, 14.0, 64.0
MUCH = UNDECIDED = CLEAR


def decide(
    alarm=None,
    fault=0.0,
    other=-9.0,
    far=-9.0,
    kind=SINGLE,
    since=5.0,
    asked=True,
    missing=True,
    weak=False,
    assess=True,
    dt=DT,
    gives=0.0,
    pushed=False,
):
    """One tick more."""
    alarm = alarm or made(Alarm, limit=LIMIT)
    found = SimpleNamespace(fault=fault, other=other, far=far, asked=SimpleNamespace(weak=weak))
    best = SimpleNamespace(kind=kind, since=since, gives=gives)
    may = SimpleNamespace(asked=asked, missing=missing)
    alarm.decide(made(Plant, rotors=N, dt=dt), found, best, SimpleNamespace(reach=REACH), may, assess, pushed)
    return alarm


def ticks_until_alarm(dt=DT, **more):
    """How many ticks in a row it takes; None when it never comes."""
    said = None
    for k in range(1, 30):
        said = decide(said, dt=dt, **more)
        if said.alarm:
            assert said.above == 0  # the next one starts anew
            return k
    return None


@pytest.mark.parametrize("dt", [0.05, 0.1, 1.0])
def test_a_fault_over_the_threshold_at_two_ticks_in_a_row_is_announced(dt):
    assert TICKS == 2
    assert ticks_until_alarm(dt, fault=LIMIT + 0.1) == TICKS and ticks_until_alarm(dt, fault=LIMIT - 0.1) is None


@pytest.mark.parametrize("dt", [0.05, 0.1, 1.0])
def test_a_recovery_has_to_last_until_commands_have_answered(dt):
    """Unless no disturbance comes near it."""
    doubtful, sure = (dict(fault=LIMIT + CERTAIN_NATS + more, weak=True) for more in (-1.0, 1.0))
    assert ticks_until_alarm(dt, kind=RECOVERY, **doubtful) == max(TICKS, round(RECOVERS_S / dt))
    assert ticks_until_alarm(dt, kind=RECOVERY, **sure) == ticks_until_alarm(dt, **doubtful) == TICKS


@pytest.mark.parametrize("weak", [False, True])
@pytest.mark.parametrize("name", ["other", "far"])
def test_it_has_to_be_ten_times_likelier_than_any_disturbance(name, weak):
    """Also than something else, which is larger than the flight has shown."""
    assert ticks_until_alarm(fault=30.0, weak=weak, **{name: 30.0 - MUCH - 0.1}) is not None
    assert ticks_until_alarm(fault=30.0, weak=weak, **{name: 30.0 - MUCH + 0.1}) is None
    both = decide(fault=30.0, other=25.0, far=25.0, weak=weak).statistic
    assert both == pytest.approx(min(30.0 - LIMIT, 5.0 - np.log(2.0) - MUCH))


def test_nothing_is_announced_while_something_pushes_the_vehicle_sideways():
    assert ticks_until_alarm(fault=LIMIT + CERTAIN_NATS + 10.0, pushed=True) is None


def test_pairs_which_are_rare_by_their_prior_are_not_held_against_something_else():
    for weak in (False, True):
        assert ticks_until_alarm(fault=30.0, far=30.0, kind=PAIR, weak=weak) is not None
        assert ticks_until_alarm(fault=30.0, far=30.0, weak=weak) is None
    assert ticks_until_alarm(fault=30.0, other=30.0, kind=PAIR) is None


@pytest.mark.parametrize("blocked", [{"asked": False}, {"missing": False}, {"assess": False}, {"since": EDGE * REACH}])
def test_what_cannot_be_is_not_assessed_or_began_before_the_bank_is_not_announced(blocked):
    fault = LIMIT + CERTAIN_NATS - 1.0
    assert ticks_until_alarm(fault=fault, **blocked) is None
    said = decide(fault=fault)
    assert said.above == 1 and decide(said, fault=fault, **blocked).above == 0
    assert ticks_until_alarm(fault=fault, since=EDGE * REACH - 1.0) is not None


@pytest.mark.parametrize("refused", [{"since": EDGE * REACH}, {"asked": False}])
def test_what_a_gate_refuses_is_announced_where_no_disturbance_comes_near(refused):
    fault = LIMIT + CERTAIN_NATS + 1.0
    assert ticks_until_alarm(fault=fault, **refused) == TICKS
    assert ticks_until_alarm(fault=fault, other=fault - MUCH - CERTAIN_NATS + 1.0, **refused) is None
    assert ticks_until_alarm(fault=fault, kind=PAIR, **refused) is None
    assert ticks_until_alarm(fault=fault, missing=False, **refused) is None  # what the ground does is in no model
    assert ticks_until_alarm(fault=fault, gives=1.8, **refused) is None  # what pushes from outside looks like that


def ticks_until_absorbed(**more):
    said = None
    for k in range(1, 90):
        said = decide(said, **more)
        if said.absorbed:
            assert said.sure_s == 0.0
            return k
    return None


def test_what_has_certainly_happened_for_a_second_is_absorbed():
    """A disturbance that beats every fault; where a rotor is known to be weak, whatever it was."""
    second = round(ABSORB_S / DT)
    sure = dict(other=CERTAIN_NATS + 0.1, fault=0.0)
    assert ticks_until_absorbed(**sure) in (second, second + 1)
    assert ticks_until_absorbed(other=CERTAIN_NATS - 0.1) is None
    assert ticks_until_absorbed(other=20.0, fault=20.0 - UNDECIDED - 0.1) is not None
    assert ticks_until_absorbed(other=20.0, fault=20.0 - UNDECIDED + 0.1) is None
    assert ticks_until_absorbed(other=20.0, fault=20.0, weak=True) is not None
    refused = dict(other=-9.0, fault=CERTAIN_NATS + 0.1, weak=True, missing=False)
    assert ticks_until_absorbed(**refused) in (second, second + 1)
    assert ticks_until_absorbed(**refused, kind=RECOVERY) in (round(BURST_S / DT), round(BURST_S / DT) + 1)  # it may still become clear
    assert ticks_until_absorbed(**sure, assess=False) is None
    standing = filled(made(Alarm, limit=LIMIT), above=9, sure_s=9.0)
    assert not decide(standing, fault=90.0, weak=True).absorbed  # announced instead
    assert decide(filled(made(Alarm, limit=LIMIT), sure_s=0.7)).sure_s == 0.0


def test_noise_is_not_learned_from_a_growing_suspicion_but_not_for_ever():
    """Six seconds of it; as long a calm makes up for it."""
    p, alarm = made(Plant, rotors=N, dt=DT), Alarm()
    alarm.begin(p)
    limit = announcement.threshold(p, MEMORY_S)
    growing, calm = (SimpleNamespace(fault=limit + more) for more in (0.1, -0.1))
    waited = next(k for k in range(1, 1000) if alarm.quiet(p, growing))
    assert waited == pytest.approx(USUAL_S / DT, abs=1.5)
    assert all(alarm.quiet(p, growing) for _ in range(200)) and alarm.frozen == pytest.approx(2.0 * USUAL_S)
    for left in (2.0 * USUAL_S - DT, 2.0 * USUAL_S - 2 * DT):
        assert alarm.quiet(p, calm) and alarm.frozen == pytest.approx(left)
    fresh = Alarm()
    fresh.begin(p)
    assert fresh.quiet(p, calm) and fresh.frozen == 0.0


def test_the_threshold_is_the_promised_time_in_ticks_over_the_weights_of_new_faults():
    """Pollak: at least threshold / sum of weights ticks to a false alarm. A rotor that is well again is no new fault."""
    weight, p = 4 + 6 * PAIR_WEIGHT + 4 * STUCK_WEIGHT, made(Plant, rotors=N, dt=DT)
    assert np.exp(announcement.threshold(p, 600.0)) == pytest.approx(600.0 / DT * weight)
    promised, alarm = announcement.GATES * FALSE_ALARM_PERIOD_S, Alarm()
    alarm.begin(p)
    assert alarm.limit == program.threshold(N, DT) == pytest.approx(np.log(promised / DT * weight))
    assert FALSE_ALARM_PERIOD_S == 36_000.0 and 0.0 < announcement.GATES < 1.0
