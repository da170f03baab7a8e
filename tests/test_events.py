"""From ticks to events: what the estimator announced is written down, with its times as they were, live."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.conftest import hexa_event

from rotorwatch import airframes
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator.posterior import PLACES
from rotorwatch.engine.events.losses import CURVE_SHARE
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks

DT, COUNT, N = 0.1, 300, 4
HYP = list_hypotheses(N)
QUAD = airframes.named("ardupilot-quad-x").effectiveness()


def table(restarts=(0,)):
    time = 5.0 + DT * np.arange(COUNT)
    flat, restart = np.zeros((COUNT, 3)), np.zeros(COUNT, bool)
    restart[list(restarts)] = True
    return Ticks(
        time, time - 0.07, np.ones((COUNT, N)), np.zeros((COUNT, 4)), flat, flat, np.ones(COUNT),
        np.ones((COUNT, 4), bool), np.full(COUNT, ASSESS, np.int32), restart,
        np.full(COUNT, 0.4), DT, np.zeros(COUNT, bool),
    )  # fmt: skip


def silence():
    """Outputs of an estimator that saw nothing; `announce` writes into them."""
    return SimpleNamespace(
        theta=np.zeros((COUNT, N)),
        theta_sd=np.full((COUNT, N), 0.01),
        announced=np.zeros(COUNT, bool),
        onsets=np.zeros((COUNT, PLACES)),
        active=np.zeros((COUNT, PLACES, N), bool),
        share=np.tile(np.eye(PLACES)[0], (COUNT, 1)),
        gives=np.zeros((COUNT, N)),
        probability=np.zeros((COUNT, len(HYP.names))),
        log_odds=np.zeros((COUNT, len(HYP.names))),
    )


def explain(out, k, shares, age):
    """From tick k on, the explanations {rotors: probability}, the leader first, with an onset `age` ticks before k: one for all, or one
    for each."""
    ages = [age] * PLACES if isinstance(age, int) else [*age, *[age[-1]] * (PLACES - len(age))]
    out.onsets[k:] = np.array(ages) + np.arange(COUNT - k)[:, None]
    out.active[k:], out.share[k:] = False, 0.0
    for place, (who, p) in enumerate(shares.items()):
        out.active[k:, place, list(who)] = True
        out.share[k:, place] = p


def announce(out, k, shares, age):
    """Announce at tick k that the weak rotors are one of these sets."""
    out.announced[k] = True
    explain(out, k, shares, age)


def test_nothing_happened():
    assert event_rows.read(silence(), table(), QUAD) == ()


def test_one_loss_with_its_times_its_size_and_how_sure_it_is():
    out, ticks = silence(), table()
    announce(out, 100, {(2,): 0.98, (0, 2): 0.02}, age=4)
    out.theta[100:, 2] = 0.3
    (event,) = event_rows.read(out, ticks, QUAD)
    assert (event.kind, event.rotors, event.alternatives) == ("loss_of_effectiveness", (3,), ())
    assert event.detected_s == ticks.time[100]
    assert event.onset_s == pytest.approx(ticks.command_time[96])
    assert event.end_s is None and event.loss == (0.3,)
    lower, upper = event.interval[0]
    sd = float(event_rows.sd_of(np.array(0.3), np.array(0.01), QUAD))
    assert 0.03 < sd < 0.04 and (lower, upper) == pytest.approx((0.3 - 1.96 * sd, 0.3 + 1.96 * sd))
    assert event.probability == pytest.approx(0.98)
    assert "rotor 3" in event.reason


def test_a_later_estimate_refines_the_loss_but_never_the_time():
    out, ticks = silence(), table()
    announce(out, 100, {(0,): 1.0}, age=3)
    out.theta[100:, 0] = np.linspace(0.5, 0.2, COUNT - 100)
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.detected_s == ticks.time[100] and event.loss[0] == pytest.approx(0.2)


def test_an_explanation_that_overtakes_is_what_happened_and_was_found_when_it_did():
    """Rotor 1 was announced; later its neighbour explains more, with an onset of its own."""
    out, ticks = silence(), table()
    announce(out, 100, {(0,): 0.6, (3,): 0.4}, age=(4, 2))
    explain(out, 130, {(3,): 0.95, (0,): 0.05}, age=(32, 34))
    out.theta[100:130, 0] = out.theta[130:, 3] = 0.3
    (event,) = event_rows.read(out, ticks, QUAD)
    assert (event.rotors, event.loss, event.end_s) == ((4,), (0.3,), None)
    assert event.detected_s == ticks.time[130]
    assert event.onset_s == pytest.approx(ticks.command_time[98])
    assert event.probability == pytest.approx(0.95) and event.alternatives == ()


def test_a_rotor_that_stays_while_its_partner_is_swapped():
    """One event for all that failed at once: the pair that leads at the end, found when this pair led."""
    out, ticks = silence(), table()
    announce(out, 100, {(0, 1): 0.7, (0, 2): 0.3}, age=4)
    explain(out, 120, {(0, 2): 0.92, (0, 1): 0.08}, age=24)
    out.theta[100:, 0] = out.theta[120:, 2] = 0.3
    (event,) = event_rows.read(out, ticks, QUAD)
    assert (event.rotors, event.loss) == ((1, 3), (0.3, 0.3)) and event.detected_s == ticks.time[120]
    assert event.probability == pytest.approx(0.92) and event.alternatives == ()


def test_what_no_longer_leads_leaves_no_event():
    """A loss was announced; in the end that nothing broke explains more."""
    out, ticks = silence(), table()
    announce(out, 100, {(0,): 0.8, (): 0.2}, age=4)
    explain(out, 140, {(): 0.97, (0,): 0.03}, age=44)
    out.theta[100:140, 0] = 0.2
    assert event_rows.read(out, ticks, QUAD) == ()


def test_that_nothing_broke_is_no_alternative():
    """It was weighed before the announcement; the shares left are those of the sets of rotors."""
    out = silence()
    announce(out, 100, {(0,): 0.47, (): 0.5, (3,): 0.03}, age=4)
    out.theta[100:, 0] = 0.2
    (event,) = event_rows.read(out, table(), QUAD)
    assert event.probability == pytest.approx(0.94) and event.alternatives == ()


def test_what_cannot_be_reported_apart_is_listed():
    out, ticks = silence(), table()
    announce(out, 100, {(0, 1): 0.5, (2, 3): 0.48, (1,): 0.02}, age=3)
    out.theta[100:, :2] = 0.2
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.rotors == (1, 2) and event.alternatives == ((3, 4),)  # two in a hundred is not worth naming
    assert len(event.loss) == len(event.interval) == 2 and event.probability == pytest.approx(0.5)
    assert "3+4" in event.reason


def test_a_pair_of_opposite_rotors_has_to_be_surer_than_another():
    """Only a manoeuvre tells a hexarotor's opposite pairs apart: 95 % names any other pair, but not these."""
    hexa = airframes.named("ardupilot-hexa-x").effectiveness()
    hyp, partners = list_hypotheses(6), event_rows.opposites(hexa)
    opposite = (0, partners[0][0])
    for pair in (opposite, next((0, j) for j in range(1, 6) if j not in partners[0])):
        out = silence()
        out.theta, out.theta_sd = np.zeros((COUNT, 6)), np.full((COUNT, 6), 0.01)
        out.active = np.zeros((COUNT, PLACES, 6), bool)
        out.probability = out.log_odds = np.zeros((COUNT, len(hyp.names)))
        announce(out, 100, {pair: 0.95, (1,): 0.05}, age=3)
        out.theta[100:, list(pair)] = 0.2
        (event,) = event_rows.read(out, table(), hexa)
        assert bool(event.alternatives) == (pair == opposite)


@pytest.mark.parametrize(
    "probability, named, later",
    [
        ({(0,): 0.99, (0, 1): 0.003}, ((1, 2),), ((1, 2),)),
        ({(0,): 0.99, (0, 1): 0.0009}, (), ()),
        ({(0, 1): 0.9, (0,): 0.1}, (), ()),
        # Equal losses of two rotors look at first like one of the rotor between them: while that may be, it is said.
        ({(0,): 0.99, (2, 3): 0.003, (1, 3): 9e-6}, ((3, 4),), ()),
        ({(0,): 0.99, (1, 3): 1.1e-5}, ((2, 4),), ()),
    ],
)
def test_a_rare_pair_hides_behind_one_rotor_only_where_the_data_prefer_it(probability, named, later):
    """Prior weights taken out: a pair is ten thousand times rarer than a rotor, and has to be ten times as likely by the data. Rotors 1
    and 2 of a quad X are opposite. Pairs without the rotor are named for the first second of a flight that goes on unless the data are
    ten times against them."""
    for stop, wanted in ((105, named), (115, later)):
        out, ticks = silence(), table()
        announce(out, 100, {(0,): 1.0}, age=3)
        out.theta[100:, 0] = 0.3
        for who, p in probability.items():
            out.probability[100, HYP.rotors.index(who)] = p
        state = event_rows.Losses(QUAD)
        state.add(ticks.part(np.arange(COUNT) < stop), SimpleNamespace(**{k: v[:stop] for k, v in vars(out).items()}))
        (event,) = state.events(flies=True)
        assert event.alternatives == wanted
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.alternatives == later


def test_a_pair_is_not_its_own_alternative():
    """When it was announced the data did not rule the pair out; later the pair leads, and is sure."""
    out, opposite = silence(), event_rows.opposites(QUAD)[0][0]
    announce(out, 100, {(0,): 0.9, (0, opposite): 0.1}, age=3)
    out.probability[100, HYP.rotors.index((0,))] = 0.99
    out.probability[100, HYP.rotors.index((0, opposite))] = 0.01
    explain(out, 150, {(0, opposite): 0.97, (0,): 0.03}, age=53)
    (event,) = event_rows.read(out, table(), QUAD)
    assert event.rotors == (1, opposite + 1) and event.alternatives == ()


def test_a_loss_that_is_over_is_as_large_as_it_mostly_was_by_its_first_rotor():
    out = silence()
    announce(out, 100, {(0, 1): 1.0}, age=3)
    announce(out, 200, {(): 1.0}, age=3)
    out.theta[100:200, 0] = 0.3
    out.theta[150:151, 0] = 0.31  # the second rotor is at its own middle elsewhere
    out.theta[100:200, 1] = np.linspace(0.1, 0.5, 100)
    (event,) = event_rows.read(out, table(), QUAD)
    assert event.end_s is not None and event.loss == pytest.approx((0.3, 0.1), abs=0.01)


def test_beside_a_known_loss_only_the_new_rotors_are_alternatives():
    out = silence()
    announce(out, 50, {(0,): 1.0}, age=3)
    announce(out, 150, {(0, 3): 0.7, (0, 1): 0.3}, age=3)
    out.theta[50:, 0] = out.theta[150:, 3] = 0.3
    first, second = event_rows.read(out, table(), QUAD)
    assert (first.rotors, first.alternatives) == ((1,), ())
    assert (second.rotors, second.alternatives) == ((4,), ((2,),)) and second.probability == pytest.approx(0.7)


def test_branches_with_the_same_rotors_are_one_explanation():
    """Of one rotor a change and a recovery that leaves some: different states, the same set."""
    out = silence()
    announce(out, 100, {(0,): 0.55}, age=3)
    out.active[100:, 1:3, :] = np.eye(N, dtype=bool)[[0, 2]]
    out.share[100:, 1:3] = 0.4, 0.05
    out.theta[100:, 0] = 0.3
    (event,) = event_rows.read(out, table(), QUAD)
    assert event.rotors == (1,) and event.probability == pytest.approx(0.95) and event.alternatives == ()


def test_a_loss_that_ends_and_comes_back_is_two_events():
    out, ticks = silence(), table()
    announce(out, 50, {(1,): 1.0}, age=3)
    announce(out, 120, {(): 1.0}, age=5)  # well again
    announce(out, 200, {(1,): 1.0}, age=2)
    out.theta[50:120, 1] = out.theta[200:, 1] = 0.4
    first, second = event_rows.read(out, ticks, QUAD)
    assert (first.rotors, second.rotors) == ((2,), (2,))
    assert first.detected_s == ticks.time[50] and first.loss == (0.4,)
    assert first.end_s == pytest.approx(ticks.command_time[115])  # when it went, not when that was noticed
    assert second.detected_s == ticks.time[200] and second.end_s is None


def test_a_recovery_that_is_taken_back_ended_nothing():
    """Announced as the end of the loss, it turns out to have been a second rotor."""
    out, ticks = silence(), table()
    announce(out, 50, {(1,): 1.0}, age=3)
    announce(out, 120, {(): 0.6, (1, 2): 0.4}, age=5)
    explain(out, 135, {(1, 2): 0.99, (): 0.01}, age=20)
    out.theta[50:, 1] = out.theta[135:, 2] = 0.4
    first, second = event_rows.read(out, ticks, QUAD)
    assert (first.rotors, first.end_s) == ((2,), None)
    assert (second.rotors, second.detected_s, second.end_s) == ((3,), ticks.time[135], None)


def test_a_second_rotor_is_an_event_of_its_own():
    out, ticks = silence(), table()
    announce(out, 50, {(0,): 1.0}, age=3)
    announce(out, 150, {(0, 3): 1.0}, age=3)
    out.theta[50:, 0], out.theta[150:, 3] = 0.2, 0.5
    first, second = event_rows.read(out, ticks, QUAD)
    assert (first.rotors, first.loss, first.end_s) == ((1,), (0.2,), None)
    assert (second.rotors, second.loss, second.end_s) == ((4,), (0.5,), None)
    assert second.onset_s == pytest.approx(ticks.command_time[147])


def test_one_of_two_rotors_that_is_well_again_leaves_the_event():
    out, ticks = silence(), table()
    announce(out, 50, {(0, 1): 0.97, (0, 2): 0.03}, age=3)
    announce(out, 150, {(0,): 1.0}, age=5)
    out.theta[50:, 0], out.theta[50:150, 1] = 0.4, 0.25
    found = event_rows.read(out, ticks, QUAD)
    (lasting,) = [e for e in found if e.end_s is None]
    assert (lasting.rotors, lasting.loss, lasting.alternatives) == ((1,), (0.4,), ())
    (ended,) = [e for e in found if e.end_s is not None]
    assert (ended.rotors, ended.loss) == ((2,), (0.25,))
    assert ended.end_s == pytest.approx(ticks.command_time[145])
    assert {e.detected_s for e in found} == {ticks.time[50]}


def test_of_two_losses_that_came_one_by_one_the_first_ends():
    out, ticks = silence(), table()
    announce(out, 50, {(0,): 1.0}, age=3)
    announce(out, 120, {(0, 3): 1.0}, age=3)
    announce(out, 200, {(3,): 1.0}, age=6)
    out.theta[50:200, 0], out.theta[120:, 3] = 0.2, 0.5
    first, second = event_rows.read(out, ticks, QUAD)
    assert (first.rotors, first.loss, first.end_s) == ((1,), (0.2,), pytest.approx(ticks.command_time[194]))
    assert (second.rotors, second.loss, second.end_s) == ((4,), (0.5,), None)


def test_one_rotor_ends_where_another_begins():
    """The same announcement: rotor 1 is well again and rotor 3 is not."""
    out, ticks = silence(), table()
    announce(out, 50, {(0,): 1.0}, age=3)
    announce(out, 150, {(2,): 1.0}, age=4)
    out.theta[50:150, 0], out.theta[150:, 2] = 0.2, 0.5
    first, second = event_rows.read(out, ticks, QUAD)
    assert (first.rotors, first.end_s) == ((1,), pytest.approx(ticks.command_time[146]))
    assert (second.rotors, second.onset_s) == ((3,), first.end_s)


def test_a_known_loss_that_grows_is_no_new_event():
    out, ticks = silence(), table()
    announce(out, 50, {(0,): 1.0}, age=3)
    announce(out, 150, {(0,): 1.0}, age=3)
    out.theta[50:150, 0], out.theta[150:, 0] = 0.2, 0.4
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.detected_s == ticks.time[50] and event.loss == (0.4,) and event.end_s is None


def test_landing_ends_an_event():
    out, ticks = silence(), table(restarts=(0, 200))
    announce(out, 50, {(2,): 1.0}, age=3)
    out.active[200:] = False
    out.theta[50:200, 2] = 0.25
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.loss == (0.25,)
    assert event.end_s == ticks.time[199]  # it lasted until the landing


def test_an_announcement_at_the_very_end_is_kept():
    out, ticks = silence(), table()
    k = COUNT - 1
    announce(out, k, {(1,): 1.0}, age=4)
    out.theta[k, 1] = 0.3
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.rotors == (2,) and event.detected_s == ticks.time[k] and event.loss == (0.3,)


@pytest.mark.parametrize("theta", [0.0, 0.1, 0.4, 0.8, 0.97])
def test_a_thrust_curve_that_is_off_is_within_the_interval(theta):
    """A rotor that lost theta and carries its share of the weight in hover, seen through a curve whose slope is off by k."""
    k = CURVE_SHARE
    thrust = 1.0 / (1.0 - theta)  # what the log's curve makes of its command
    true = 1.0 - 1.0 / (thrust + k * thrust * (thrust - 1.0))
    assert float(event_rows.sd_of(np.array(theta), np.array(0.0), QUAD)) == pytest.approx(abs(true - theta), rel=1e-9)
    assert float(event_rows.sd_of(np.array(1.0), np.array(0.0), QUAD)) == pytest.approx(0.0, abs=1e-8)  # gone is gone


def test_intervals_stay_within_a_loss():
    out, ticks = silence(), table()
    announce(out, 100, {(1, 3): 1.0}, age=3)
    out.theta[100:, 1], out.theta[100:, 3] = 0.01, 0.99
    out.theta_sd[:] = 0.1
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.interval[0][0] == 0.0 and event.interval[1][1] == 1.0


@pytest.mark.parametrize(
    "rotors, interval, reported",
    [
        ((4, 7), ((0.27, 0.47), (0.61, 0.88)), True),  # together about one whole rotor of one arm
        ((4, 7), ((0.1, 0.2), (0.2, 0.3)), False),  # less than a rotor
        ((4, 7), ((0.6, 0.8), (0.7, 0.9)), False),  # more than one can lose
        ((4, 8), ((0.27, 0.47), (0.61, 0.88)), False),  # two arms
        ((7,), ((0.6, 1.0),), False),
    ],
)
def test_a_rotor_that_is_gone_is_not_two_of_its_arm_for_certain(rotors, interval, reported):
    B = airframes.named("ardupilot-octaquad-x").effectiveness()
    event = hexa_event(rotors=rotors, interval=interval, loss=tuple(np.mean(i) for i in interval))
    (said,) = event_rows.Report(B).events((event,), ())
    assert said.alternatives == (((4,), (7,)) if reported else ())
    assert ("only one of them may have failed" in said.reason) == reported
    flat = airframes.named("ardupilot-octa-x").effectiveness()
    assert event_rows.Report(flat).events((event,), ()) == (event,)


@pytest.mark.parametrize(
    "theta, sd, ticks_long, again, reported",
    [(0.3, 0.05, 8, False, 0), (0.3, 0.05, 30, False, 1), (0.95, 0.05, 8, False, 1), (0.3, 0.05, 8, True, 2)],
)
def test_a_loss_that_is_over_in_a_moment_is_none_unless_it_was_total_or_comes_again(theta, sd, ticks_long, again, reported):
    """A gust in a turn does the same; a motor that cuts out loses all, or does so again. Until it is over it is reported."""
    out, ticks = silence(), table()
    for start in (100, 200) if again else (100,):
        announce(out, start, {(2,): 1.0}, age=2)
        out.theta[start : start + ticks_long, 2] = theta
        out.theta_sd[start : start + ticks_long, 2] = sd
        announce(out, start + ticks_long, {(): 1.0}, age=2)
    found = event_rows.read(out, ticks, QUAD)
    assert len(found) == reported and all(e.rotors == (3,) for e in found)
    if not again:
        state = event_rows.Losses(QUAD)
        state.add(ticks.part(np.arange(COUNT) < 105), SimpleNamespace(**{k: v[:105] for k, v in vars(out).items()}))
        assert len(state.events(flies=True)) == 1


def test_a_loss_just_before_the_end_of_a_flight_is_one():
    """What ends with the flight has not recovered: a vehicle that falls, and takes off again."""
    out, ticks = silence(), table(restarts=(0, 106))
    announce(out, 100, {(2,): 1.0}, age=2)
    out.theta[100:106, 2] = 0.3
    explain(out, 106, {(): 1.0}, age=0)
    (event,) = event_rows.read(out, ticks, QUAD)
    assert event.rotors == (3,) and event.end_s is not None and event.end_s - event.onset_s < 1.0
