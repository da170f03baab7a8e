"""From ticks to events: what the estimator announced is written down, with its times as they were, live."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch.evidence import events, hypotheses
from rotorwatch.motion.ticks import JUDGE, Ticks

DT, COUNT, N = 0.1, 300, 4
HYP = hypotheses.make(N)
SINGLE, PAIR = {i: i for i in range(N)}, {tuple(p): N + k for k, p in enumerate(HYP.pairs.tolist())}


def table(restarts=(0,)):
    time = 5.0 + DT * np.arange(COUNT)
    flat, restart = np.zeros((COUNT, 3)), np.zeros(COUNT, bool)
    restart[list(restarts)] = True
    return Ticks(
        time, time - 0.07, np.ones((COUNT, N)), np.zeros((COUNT, 4)), flat, flat, np.ones(COUNT),
        np.ones((COUNT, 4), bool), np.full(COUNT, JUDGE, np.int32), restart,
        np.full(COUNT, 0.4), DT, np.zeros(COUNT, bool),
    )  # fmt: skip


def silence():
    """Outputs of an estimator that saw nothing; `story` writes into them."""
    return SimpleNamespace(
        theta=np.zeros((COUNT, N)),
        theta_sd=np.full((COUNT, N), 0.01),
        announced=np.zeros(COUNT, bool),
        committed=np.zeros(COUNT, bool),
        active=np.zeros((COUNT, N), bool),
        best=np.zeros(COUNT, np.int32),
        onset=np.zeros(COUNT),
        probability=np.zeros((COUNT, len(HYP.names))),
        log_odds=np.zeros((COUNT, len(HYP.names))),
        opposite=np.full(COUNT, -1),
        opposite_onset=np.zeros(COUNT),
        opposite_loss=np.zeros((COUNT, 2)),
    )


def announce(out, k, shares, age, commit=15):
    """Announce at tick k the most probable of {hypothesis index: probability}, `age` ticks after its onset."""
    out.announced[k], out.committed[k + commit] = True, True
    out.best[k : k + commit + 1] = max(shares, key=shares.get)
    out.onset[k] = age
    for index, p in shares.items():
        out.probability[k : k + commit + 1, index] = p


def test_nothing_happened():
    assert events.read(silence(), table(), HYP) == ()


def test_one_loss_with_its_times_its_size_and_how_sure_it_is():
    out, ticks = silence(), table()
    announce(out, 100, {SINGLE[2]: 0.98, PAIR[(0, 2)]: 0.02}, age=4)
    out.theta[100:, 2], out.active[115:, 2] = 0.3, True
    (event,) = events.read(out, ticks, HYP)
    assert (event.kind, event.rotors, event.alternatives) == ("loss_of_effectiveness", (3,), ())
    assert event.detected_s == ticks.time[100]
    assert event.onset_s == pytest.approx(ticks.command_time[96])
    assert event.end_s is None and event.loss == (0.3,)
    lower, upper = event.interval[0]
    assert 0.3 - 2.5 * 0.015 < lower < 0.3 - 1.96 * 0.01 and 0.3 + 1.96 * 0.01 < upper < 0.3 + 2.5 * 0.015
    assert event.probability == pytest.approx(0.98)
    assert "rotor 3" in event.reason


def test_a_later_estimate_refines_the_loss_but_never_the_time():
    out, ticks = silence(), table()
    announce(out, 100, {SINGLE[0]: 1.0}, age=3)
    out.theta[100:, 0] = np.linspace(0.5, 0.2, COUNT - 100)
    out.active[115:, 0] = True
    (event,) = events.read(out, ticks, HYP)
    assert event.detected_s == ticks.time[100] and event.loss[0] == pytest.approx(0.2)


def test_what_cannot_be_told_apart_is_listed():
    out, ticks = silence(), table()
    announce(out, 100, {PAIR[(0, 1)]: 0.5, PAIR[(2, 3)]: 0.48, SINGLE[1]: 0.02}, age=3)
    out.theta[100:, :2], out.active[115:, :2] = 0.2, True
    (event,) = events.read(out, ticks, HYP)
    assert event.rotors == (1, 2) and event.alternatives == ((3, 4),)  # two in a hundred is not worth naming
    assert len(event.loss) == len(event.interval) == 2 and event.probability == pytest.approx(0.5)
    assert "3+4" in event.reason


def test_alone_and_with_a_common_shift_are_the_same_rotor():
    mixed = HYP.kinds.index("single_common") + 2
    probability = np.zeros(len(HYP.names))
    probability[SINGLE[2]], probability[mixed], probability[-1] = 0.5, 0.45, 0.05
    assert HYP.rotors[mixed] == (2,)
    assert events.rotor_sets(HYP, probability) == {(2,): pytest.approx(0.95)} | {
        who: 0.0 for who in dict.fromkeys(HYP.rotors) if who and who != (2,)
    }


def test_a_loss_that_ends_and_comes_back_is_two_events():
    out, ticks = silence(), table()
    announce(out, 50, {SINGLE[1]: 1.0}, age=3)
    announce(out, 120, {SINGLE[1]: 1.0}, age=5)  # the jump back
    announce(out, 200, {SINGLE[1]: 1.0}, age=2)
    for start, end in ((65, 135), (215, COUNT)):
        out.active[start:end, 1] = True
    out.theta[50:120, 1] = out.theta[200:, 1] = 0.4
    first, second = events.read(out, ticks, HYP)
    assert (first.rotors, second.rotors) == ((2,), (2,))
    assert first.detected_s == ticks.time[50] and first.loss == (0.4,)
    assert first.end_s == pytest.approx(ticks.command_time[115])  # when it went, not when that was noticed
    assert second.detected_s == ticks.time[200] and second.end_s is None


def test_a_second_rotor_is_an_event_of_its_own():
    out, ticks = silence(), table()
    announce(out, 50, {SINGLE[0]: 1.0}, age=3)
    announce(out, 150, {SINGLE[3]: 1.0}, age=3)
    out.active[65:, 0] = out.active[165:, 3] = True
    out.theta[50:, 0], out.theta[150:, 3] = 0.2, 0.5
    first, second = events.read(out, ticks, HYP)
    assert (first.rotors, first.loss, first.end_s) == ((1,), (0.2,), None)
    assert (second.rotors, second.loss, second.end_s) == ((4,), (0.5,), None)


@pytest.mark.parametrize("had, until", [(0.03, 150), (0.25, 90), (0.25, 150)])
def test_one_of_two_rotors_that_is_well_again_leaves_the_event(had, until):
    """It had lost something, and that is an event that ended; or it was named for the other's sake, and is named no more."""
    out, ticks = silence(), table()
    announce(out, 50, {PAIR[(0, 1)]: 0.97, PAIR[(0, 2)]: 0.03}, age=3)
    announce(out, until, {SINGLE[1]: 1.0}, age=5)  # the jump back
    out.active[65:, 0] = out.active[65 : until + 15, 1] = True
    out.theta[50:, 0], out.theta[50 : until - 4, 1] = 0.4, had
    found = events.read(out, ticks, HYP)
    (lasting,) = [e for e in found if e.end_s is None]
    assert (lasting.rotors, lasting.loss, lasting.alternatives) == ((1,), (0.4,), ())
    ended = [(e.rotors, e.loss, e.end_s) for e in found if e.end_s is not None]
    real = had > 0.1 and until == 150
    assert ended == ([((2,), (had,), pytest.approx(ticks.command_time[145]))] if real else [])


def test_a_known_loss_that_grows_is_no_new_event():
    out, ticks = silence(), table()
    announce(out, 50, {SINGLE[0]: 1.0}, age=3)
    announce(out, 150, {SINGLE[0]: 1.0}, age=3)
    out.active[65:, 0] = True
    out.theta[50:150, 0], out.theta[150:, 0] = 0.2, 0.4
    (event,) = events.read(out, ticks, HYP)
    assert event.detected_s == ticks.time[50] and event.loss == (0.4,) and event.end_s is None


def test_landing_ends_an_event():
    out, ticks = silence(), table(restarts=(0, 200))
    announce(out, 50, {SINGLE[2]: 1.0}, age=3)
    out.active[65:200, 2] = True
    out.theta[50:200, 2] = 0.25
    (event,) = events.read(out, ticks, HYP)
    assert event.loss == (0.25,)
    assert event.end_s == ticks.time[199]  # it lasted until the landing


def test_an_announcement_at_the_very_end_is_kept():
    out, ticks = silence(), table()
    k = COUNT - 1
    out.announced[k], out.best[k], out.onset[k] = True, SINGLE[1], 4
    out.probability[k, SINGLE[1]] = 1.0
    out.theta[k, 1] = 0.3
    (event,) = events.read(out, ticks, HYP)
    assert event.rotors == (2,) and event.detected_s == ticks.time[k] and event.loss == (0.3,)


def test_intervals_stay_within_a_loss():
    out, ticks = silence(), table()
    announce(out, 100, {PAIR[(1, 3)]: 1.0}, age=3)
    out.theta[100:, 1], out.theta[100:, 3], out.active[115:, [1, 3]] = 0.01, 0.99, True
    out.theta_sd[:] = 0.1
    (event,) = events.read(out, ticks, HYP)
    assert event.interval[0][0] == 0.0 and event.interval[1][1] == 1.0
