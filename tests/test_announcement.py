"""When a fault is announced or something is absorbed without, tick by tick, and when noise may be learned."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch.engine.default import announcement, hypotheses, noise
from rotorwatch.engine.default.announcement import ABSORB_S, CERTAIN_NATS, EDGE, TICKS, AlarmState
from rotorwatch.engine.default.hypotheses import CLEAR
from rotorwatch.engine.default.plant import USUAL_S
from rotorwatch.engine.default.plausibility import Plausible

HYP, DT, LIMIT, REACH = hypotheses.make(4), 0.05, 14.0, 64.0
MUCH = UNDECIDED = CLEAR


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def decide(
    standing=None,
    fault=0.0,
    other=-9.0,
    far=-9.0,
    rotors=(1,),
    since=5.0,
    asked=True,
    missing=True,
    weak=False,
    judge=True,
    dt=DT,
    gives=0.0,
):
    found = SimpleNamespace(fault=np.float64(fault), other=np.float64(other), far=np.float64(far))
    best = SimpleNamespace(rotors=np.isin(np.arange(1, 5), rotors), since=np.float64(since), gives=np.float64(gives))
    return announcement.decide(
        standing or announcement.init(),
        found,
        best,
        SimpleNamespace(reach=REACH),
        LIMIT,
        Plausible(np.bool_(asked), np.bool_(missing)),
        np.bool_(weak),
        np.bool_(judge),
        dt,
    )


def ticks_until_alarm(dt=DT, **more):
    """How many ticks in a row it takes; None when it never comes."""
    standing = announcement.init()
    for k in range(1, 30):
        standing, said = decide(standing, dt=dt, **more)
        if said.alarm:
            assert standing.above == 0  # the next one starts anew
            return k
    return None


@pytest.mark.parametrize("dt", [0.05, 0.1, 1.0])
def test_a_fault_over_the_threshold_at_two_ticks_in_a_row_is_announced(dt):
    assert TICKS == 2
    assert ticks_until_alarm(dt, fault=LIMIT + 0.1) == TICKS and ticks_until_alarm(dt, fault=LIMIT - 0.1) is None


@pytest.mark.parametrize("name", ["other", "far"])
def test_it_has_to_be_ten_times_likelier_than_any_disturbance(name):
    """Also than one larger than the flight has shown, where a rotor is weak already."""
    assert ticks_until_alarm(fault=30.0, weak=True, **{name: 30.0 - MUCH - 0.1}) is not None
    assert ticks_until_alarm(fault=30.0, weak=True, **{name: 30.0 - MUCH + 0.1}) is None
    both = decide(fault=30.0, other=25.0, far=25.0, weak=True)[1].statistic
    assert both == pytest.approx(min(30.0 - LIMIT, 5.0 - np.log(2.0) - MUCH))


def test_disturbances_such_as_this_flight_has_not_seen_are_asked_about_for_one_more_rotor_only():
    assert ticks_until_alarm(fault=30.0, far=30.0, rotors=(1, 3), weak=True) is not None
    assert ticks_until_alarm(fault=30.0, far=30.0, rotors=(1,), weak=True) is None
    assert ticks_until_alarm(fault=30.0, far=30.0, rotors=(1,)) is not None
    assert ticks_until_alarm(fault=30.0, other=30.0, rotors=(1, 3)) is None


@pytest.mark.parametrize("blocked", [{"asked": False}, {"missing": False}, {"judge": False}, {"since": EDGE * REACH}])
def test_what_cannot_be_is_not_judged_or_began_before_the_bank_is_not_announced(blocked):
    fault = LIMIT + CERTAIN_NATS - 1.0
    assert ticks_until_alarm(fault=fault, **blocked) is None
    standing, _ = decide(fault=fault)
    assert standing.above == 1 and decide(standing, fault=fault, **blocked)[0].above == 0
    assert ticks_until_alarm(fault=fault, since=EDGE * REACH - 1.0) is not None


@pytest.mark.parametrize("refused", [{"since": EDGE * REACH}, {"asked": False}])
def test_what_a_gate_refuses_is_announced_where_no_disturbance_comes_near(refused):
    fault = LIMIT + CERTAIN_NATS + 1.0
    assert ticks_until_alarm(fault=fault, **refused) == TICKS
    assert ticks_until_alarm(fault=fault, other=fault - MUCH - CERTAIN_NATS + 1.0, **refused) is None
    assert ticks_until_alarm(fault=fault, rotors=(1, 3), **refused) is None
    assert ticks_until_alarm(fault=fault, missing=False, **refused) is None  # what the ground does is in no model
    assert ticks_until_alarm(fault=fault, gives=1.8, **refused) is None  # what pushes from outside looks like that


def ticks_until_absorbed(**more):
    standing = announcement.init()
    for k in range(1, 60):
        standing, said = decide(standing, **more)
        if said.absorbed:
            assert standing.sure_s == 0.0
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
    assert ticks_until_absorbed(other=-9.0, fault=CERTAIN_NATS + 0.1, weak=True, missing=False) is not None
    assert ticks_until_absorbed(**sure, judge=False) is None
    assert not decide(AlarmState(np.int32(9), np.float64(9.0), np.float64(0.0)), fault=90.0, weak=True)[
        1
    ].absorbed  # announced instead
    assert decide(AlarmState(np.int32(0), np.float64(0.7), np.float64(0.0)))[0].sure_s == 0.0


def test_noise_is_not_learned_from_a_growing_suspicion_but_not_for_ever():
    """Four seconds of it; as long a calm makes up for it."""
    limit = announcement.threshold(HYP, DT, noise.MEMORY_S)
    standing, waited, learns = announcement.init(), 0, False
    while not learns:
        standing, learns = announcement.suspicion(standing, SimpleNamespace(fault=np.float64(limit + 0.1)), HYP, DT)
        waited += 1
    assert waited == pytest.approx(USUAL_S / DT, abs=1.5)
    for _ in range(200):
        standing, learns = announcement.suspicion(standing, SimpleNamespace(fault=np.float64(limit + 0.1)), HYP, DT)
    assert learns and standing.frozen == pytest.approx(2.0 * USUAL_S)
    for left in (2.0 * USUAL_S - DT, 2.0 * USUAL_S - 2 * DT):
        standing, learns = announcement.suspicion(standing, SimpleNamespace(fault=np.float64(limit - 0.1)), HYP, DT)
        assert learns and standing.frozen == pytest.approx(left)
    calm, learns = announcement.suspicion(announcement.init(), SimpleNamespace(fault=np.float64(limit - 0.1)), HYP, DT)
    assert learns and calm.frozen == 0.0


def test_the_threshold_is_the_promised_time_in_ticks_over_the_weights_of_new_faults():
    """Pollak: at least threshold / sum of weights ticks to a false alarm. A rotor that is well again is no new fault."""
    weight = 4 + 6 * hypotheses.WEIGHT["pair"] + 4 * hypotheses.WEIGHT["stuck"]
    assert np.exp(announcement.threshold(HYP, DT, 600.0)) == pytest.approx(600.0 / DT * weight)
    promised = announcement.GATES * announcement.FALSE_ALARM_PERIOD_S
    assert (
        announcement.threshold(HYP, DT)
        == announcement.threshold(HYP, DT, promised)
        == pytest.approx(np.log(promised / DT * weight))
    )
    assert announcement.FALSE_ALARM_PERIOD_S == 36_000.0 and 0.0 < announcement.GATES < 1.0
