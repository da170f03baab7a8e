"""Losses compared with their rivals: made-up quadrotors whose truth is known, and the laws of the comparison."""

from dataclasses import replace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.bindings.explaining import Explanation, compare, lagged, span
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import estimate
from rotorwatch.engine.motion.ground_contact import on_ground
from rotorwatch.engine.motion.tick_table import ASSESS, HOVER_LEARN_S, LEARN, READY_S, Ticks
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import EVIDENCE, LOSS, LOST, OVERRIDE, SLOW_RESPONSE
from rotorwatch.witnesses import comparing, near_ground, remainder, rivals
from rotorwatch.witnesses.odds import Decision
from rotorwatch.witnesses.witness import View

DT, ONSET_S, SECONDS = 0.05, 25.0, 60.0
QUAD = airframes.named("ardupilot-quad-x").effectiveness()
THEM = comparing.rivals(4, (0,), 35.0)
WIND = np.array([0.35, 0.2, 0.0, 0.0])  # hover thrusts of one rotor, about roll and pitch: no rotor's direction


def ramp(time, start, end):
    """0 before start, 1 after end."""
    return np.clip((time - start) / (end - start), 0.0, 1.0)


def flight(loss=0.0, rotor=0, end=np.inf, late_s=0.0, trim=None, seed=0):
    """Ticks of a quadrotor whose commands follow gusts. rotor loses `loss` from ONSET_S to end, or lags late_s s behind its commands from
    ONSET_S on; trim(time): (T, 4) wrench that something else takes."""
    rng = np.random.default_rng(seed)
    time = np.arange(HOVER_LEARN_S, SECONDS, DT) + DT
    count = len(time)
    gusts = np.zeros((count, 4))
    for k in range(1, count):
        gusts[k] = 0.9 * gusts[k - 1] + rng.normal(0.0, 1.0, 4) * np.array([0.03, 0.03, 0.01, 0.02])
    needed = np.array([0.0, 0.0, 0.0, 4.0]) + gusts + (0.0 if trim is None else trim(time))
    thrust = needed @ np.linalg.inv(QUAD).T
    weak = (time > ONSET_S) & (time <= end)
    thrust[weak, rotor] /= 1.0 - loss
    gives = thrust @ QUAD.T
    gives[weak] -= np.outer(thrust[weak, rotor] * loss, QUAD[:, rotor])
    if late_s:
        given = thrust[:, rotor].copy()
        for k in range(1, count):
            given[k] = given[k - 1] + (1.0 - np.exp(-DT / late_s)) * (thrust[k, rotor] - given[k - 1]) if weak[k] else given[k]
        gives -= np.outer(thrust[:, rotor] - given, QUAD[:, rotor])
    turns = (gives - needed)[:, :3] / np.array([0.02, 0.02, 0.5]) + rng.normal(0.0, 0.05, (count, 3))
    return Ticks(
        time, time - 0.5 * DT, thrust, thrust @ QUAD.T, np.zeros((count, 3)), turns, 1.0 + rng.normal(0.0, 0.005, count),
        np.ones((count, 4), bool), np.where(time >= READY_S, ASSESS, LEARN).astype(np.int32), np.arange(count) == 0, np.full(count, 0.4),
        DT, np.zeros(count, bool),
    )  # fmt: skip


def claim(rotor=1, onset=ONSET_S, end=None, kind=LOSS):
    return Event(kind, (rotor,), onset, onset + 1.0, end, (0.2,), ((0.1, 0.3),), 0.99)


def view(ticks, claims=()):
    learned, out = estimate(ticks, QUAD)
    air = ((float(ticks.time[0]), float(ticks.time[-1])),)
    made = View(Flight("test", "ArduPilot", {}, SECONDS), airframes.named("ardupilot-quad-x"), air, (ticks,), QUAD, out, learned=learned)
    made.open = tuple(claims)
    return made


def heard(ticks, events, claims=()):
    """(events, open claims, warnings) after the comparison."""
    seen = view(ticks, claims)
    kept = rivals.WITNESSES[0].hear(seen, tuple(events))
    return kept, seen.open, seen.warnings


def test_an_explanation_fits_the_same_in_any_company():
    ticks = flight(loss=0.3, end=35.0)
    where = span(ticks, QUAD, estimate(ticks, QUAD)[0], ONSET_S, 10.0, 43.0, np.zeros_like(ticks.thrust))
    hows = [rival.how for rival in THEM]
    for k, fit in list(enumerate(compare(where, hows)))[1::7]:
        alone = compare(where, [hows[0], hows[k]])[1]
        assert alone.log_p == fit.log_p and all(map(np.array_equal, alone[1:], fit[1:]))


@pytest.mark.parametrize(("rotor", "loss"), [(0, 0.15), (2, 0.3), (3, 0.6)])
def test_a_loss_is_confirmed_with_its_rotor(rotor, loss):
    (event,), open_, warnings = heard(flight(loss, rotor), [claim(rotor + 1)])
    assert event.rotors == (rotor + 1,) and not event.alternatives and not open_ and not warnings


@pytest.mark.parametrize(("low", "named"), [(0.0, False), (0.03, False), (0.04, True)])
def test_a_loss_that_may_be_none_is_not_certain(low, named, monkeypatch):
    """By the interval of 95 % of a loss of 0.2: 0.033 is its lower bound where it is above 0 with 99 %."""
    faint, seen = replace(claim(1), interval=((low, 0.4 - low),)), view(flight(0.3))
    evidence = Event(EVIDENCE, (1,), ONSET_S, ONSET_S + 5.0, ONSET_S + 5.0, (), (), 0.5, source=remainder.SOURCE)
    monkeypatch.setattr(rivals, "_event", lambda *given: faint)
    assert not rivals._faint(replace(faint, alternatives=((2, 3),)))
    for events, open_ in (rivals._confirmed(seen, faint, (faint,)), rivals._settled(seen, evidence, ())):
        assert [e.rotors for e in events] == [(1,)] * named and [c.rotors for c in open_] == [(1,)] * (not named)


@pytest.mark.parametrize(
    "trim",
    [None, lambda time: np.outer(time > ONSET_S, WIND), lambda time: np.outer(ramp(time, ONSET_S, ONSET_S + 15.0), WIND)],
    ids=["nothing", "wind", "moving centre of mass"],
)
def test_what_the_motion_denies_is_no_event(trim):
    kept, open_, warnings = heard(flight(trim=trim), [claim(2)])
    assert not kept and not open_
    assert len(warnings) == 1 and "rotor 2" in warnings[0] and "25.0 s" in warnings[0]


@pytest.mark.parametrize(("sag", "seconds", "loss"), [(0.45, 1.0, 0.0), (0.6, 10.0, 0.0), (0.45, 1.0, 0.5), (0.6, 10.0, 0.5)])
def test_thrust_that_all_rotors_lack_alike_accuses_none_and_hides_no_loss(sag, seconds, loss):
    """A battery that sags, and rotor 2 that fails as it does, or not."""
    ticks = flight(loss, 1)
    thrust = ticks.thrust / (1.0 - sag * ramp(ticks.time, ONSET_S, ONSET_S + seconds))[:, None]
    kept, open_, _ = heard(replace(ticks, thrust=thrust, wrench=thrust @ QUAD.T), [claim(2)])
    assert [e.rotors for e in kept] == ([(2,)] if loss else []) and not open_


def pushed(end=np.inf, rate=0.8):
    """Ticks of a healthy quadrotor that turns by `rate` rad/s, pushed from ONSET_S to end by a force to the north above its centre."""

    def torque(time):
        heading = rate * (time - ONSET_S)
        now = (time > ONSET_S) & (time <= end)
        return np.outer(now, [0.5, 0.5, 0.0, 0.0]) * np.stack([np.sin(heading), np.cos(heading), heading, heading], axis=1)

    ticks = flight(trim=torque)
    return replace(ticks, rate=np.outer(np.ones(len(ticks.time)), [0.0, 0.0, rate]))


def test_a_push_turns_against_a_vehicle_that_turns():
    """With the heading it is explained; as a step of the trim, or of a loss, it is not."""
    ticks = pushed()
    found, other = (comparing.weigh(view(t), claim(2), ()) for t in (ticks, replace(ticks, rate=-ticks.rate)))
    assert found is not None and other is not None and found.weighed().none > 0.99

    def ahead(claim):
        fits = {r.name: r.log_p for r in claim.rows if not r.beside and not r.weak}
        return fits["push"] - max(fits[name] for name in ("nothing", "step 1", "step 4", "shift"))

    assert ahead(found) > 25.0 and ahead(other) < 0.0


@pytest.mark.parametrize("rate", [0.0, 0.8])
def test_what_passes_when_the_claimed_loss_does_is_no_loss(rate):
    end = ONSET_S + 12.0
    found = comparing.weigh(view(pushed(end, rate)), claim(2, end=end), ())
    assert found is not None and found.decided(found.weighed()) is Decision.DROPPED
    best = max((r for r in found.rows if not r.weak and not r.beside), key=lambda r: r.log_p)
    assert best.name.endswith(comparing.PASSED)


def test_a_loss_that_a_tumble_hides_stays_open():
    """Half a second of motion after the onset could not have refuted it, and the log goes on."""
    ticks = flight(0.3)
    hidden = ticks.valid & (ticks.time < ONSET_S + 0.5)[:, None]
    kept, open_, _ = heard(replace(ticks, valid=hidden), [claim(1)])
    assert not kept and [c.rotors for c in open_] == [(1,)]


@pytest.mark.parametrize(("claimed", "alternatives"), [(1, ()), (3, ((1,),))])
def test_in_a_fall_rotors_are_told_apart(claimed, alternatives):
    """Rotor 1 fails, and the vehicle departs controlled flight a second later."""
    ticks = flight(0.6)
    seen = view(replace(ticks, valid=ticks.valid & (ticks.time < ONSET_S + 2.0)[:, None]))
    seen.lost = (ONSET_S + 1.0,)
    kept = rivals.WITNESSES[0].hear(seen, (claim(claimed), claim(claimed, kind=LOST)))
    assert [(e.kind, e.rotors, e.alternatives) for e in kept] == [(kind, (claimed,), alternatives) for kind in (LOSS, LOST)]
    assert all(("of a loss of rotor 1" in e.reason) is bool(alternatives) for e in kept)


def test_what_comes_long_after_a_fall_says_nothing_of_it():
    """Rotor 1 fails; from a second after the loss of control on it is as if rotor 3 had."""
    first, then = flight(0.6), flight(0.6, 2)
    until = len(first.part(first.time < ONSET_S + 2.2).time)
    names = ("thrust", "wrench", "rate_dot")
    both = {name: np.concatenate([getattr(first, name)[:until], getattr(then, name)[until:]]) for name in names}
    seen = view(replace(first, **both))
    seen.lost = (ONSET_S + 1.0,)
    kept = rivals.WITNESSES[0].hear(seen, (claim(1),))
    assert [e.alternatives for e in kept if e.rotors == (1,)] == [()]


def test_two_seconds_of_contact_accuse_nobody():
    def contact(time):
        return np.outer((time > ONSET_S) & (time < ONSET_S + 2.0), 6.0 * WIND) * np.sin(9.0 * time)[:, None]

    kept, open_, warnings = heard(flight(trim=contact), [claim(2)])
    assert not kept and (open_ or warnings)


def test_an_open_claim_is_of_all_suspects():
    alone, several = (rivals._opened(e, 0.5) for e in (claim(2), replace(claim(2), alternatives=((1, 2), (3,)))))
    assert (alone.rotors, alone.interval) == ((2,), claim(2).interval) and (several.rotors, several.interval) == ((1, 2, 3), ())


def test_an_open_claim_that_another_rotor_explains_better_is_of_both(monkeypatch):
    found = rivals._weighed(view(flight(0.3)), claim(1), (claim(1),), True)[0]
    doubted = found._replace(claim=0.3, others={(2,): 0.7})
    monkeypatch.setattr(rivals, "_weighed", lambda *given: (doubted, Decision.OPEN))
    events, (opened,) = rivals._confirmed(view(flight(0.3)), claim(1), ())
    assert events == [] and opened.rotors == (1, 3)


def test_the_wrong_rotor_is_not_left_alone():
    kept, _, _ = heard(flight(0.3, rotor=0), [claim(3)])
    assert all(e.rotors == (1,) or (1,) in e.alternatives for e in kept)


def test_every_rotors_loss_is_tried_beside_the_likeliest_disturbances():
    """Only the claimed one ends: an end opens the trim once more."""
    found = comparing.weigh(view(flight(0.3, end=ONSET_S + 10.0)), claim(1, end=ONSET_S + 10.0), ())
    assert found is not None
    tried = [r.rotors for r in found.rows if r.group == "loss" and r.beside]
    assert sorted(tried) == sorted([(i,) for i in range(4)] * comparing.COMPANIONS)
    assert {
        r.how.end_s for r in comparing.beside(4, (0,), 35.0, THEM, np.zeros(len(THEM))) if r.name == "loss" and r.how.rotors != (0,)
    } == {np.inf}


def test_a_step_beside_a_loss_does_not_give_its_thrust_back():
    ticks = flight(trim=lambda time: np.outer(time > ONSET_S, [0.0, 0.0, 0.0, 0.5]))
    learned, _ = estimate(ticks, QUAD)
    where = span(ticks, QUAD, learned, ONSET_S, 10.0, ONSET_S + 10.0, np.zeros_like(ticks.thrust))
    whole, level, none = (fit.log_p for fit in compare(where, [Explanation(step=1.0), Explanation(step=1.0, lifts=False), Explanation()]))
    assert whole > level + 10.0 and level == pytest.approx(none, abs=10.0)
    tried = comparing.beside(4, (0,), 35.0, THEM, np.zeros(len(THEM)))
    assert {r.how.lifts for r in tried if r.name == "loss"} == {False} and all(r.how.lifts for r in THEM)


@pytest.mark.parametrize("end", [45.0, None])
def test_a_change_that_was_taken_for_a_disturbance_ends_a_loss_only_where_the_motion_says_so(end):
    """A lasting loss with a step of the trim that cancels a third of it is not over."""
    step = None if end else lambda time: np.outer(time > 45.0, -0.1 * QUAD[:, 0])
    ticks = flight(0.3, end=end or np.inf, trim=step)
    seen = view(ticks)
    known, k = list_hypotheses(4), int(np.searchsorted(ticks.time, 46.0))
    odds, reported = seen.out.log_odds.copy(), np.zeros(len(ticks.time), bool)
    odds[k, known.kinds.index("recovery")], reported[k] = 99.0, True
    seen.out = seen.out._replace(log_odds=odds, announced=reported, onset=np.full(len(reported), 1.0 / ticks.dt))
    (event,) = rivals.WITNESSES[0].hear(seen, (replace(claim(1), loss=(0.3,)),))
    assert event.end_s is None if end is None else abs(event.end_s - end) < 0.5


def test_a_slow_motor_elsewhere_is_no_loss_here():
    found = comparing.weigh(view(flight(late_s=0.15, rotor=1)), claim(1), ())
    assert found is not None and found.weighed().none > 0.9


def test_a_loss_that_is_said_to_be_over_lasts():
    first, second = claim(1, end=ONSET_S + 10.0), claim(1, ONSET_S + 12.0)
    (event,), _, _ = heard(flight(0.3), [first, second])
    assert event.end_s is None and event.onset_s == ONSET_S


def test_a_loss_that_is_over_stays_over():
    end = ONSET_S + 10.0
    (event,), _, _ = heard(flight(0.3, end=end), [claim(1, end=end)])
    assert event.end_s == end


def test_an_open_claim_becomes_an_event_or_goes():
    kept, open_, _ = heard(flight(0.3), (), [claim(1, kind=EVIDENCE)])
    assert [(e.kind, e.rotors) for e in kept] == [(LOSS, (1,))] and not open_
    assert kept[0].interval[0][0] <= 0.3 <= kept[0].interval[0][1] and kept[0].extra["live"] is False
    assert heard(flight(trim=lambda time: np.outer(time > ONSET_S, WIND)), (), [claim(1, kind=EVIDENCE)])[:2] == ((), ())


def test_just_before_a_landing_a_loss_is_open_unless_it_may_be_total():
    late = claim(1, SECONDS - 2.0)
    total = replace(late, loss=(0.95,), interval=((0.85, 1.0),))
    assert heard(flight(), [late])[:2] == ((late,), ())  # the log ends in the air
    landed = view(flight())
    landed.flight = replace(landed.flight, duration=SECONDS + 5.0)
    assert rivals.WITNESSES[0].hear(landed, (total,)) == (total,)
    assert rivals.WITNESSES[0].hear(landed, (late,)) == ()
    assert [(c.kind, c.rotors) for c in landed.open] == [(EVIDENCE, (1,))]


def test_a_slow_motor_is_named():
    (event,), _, _ = heard(flight(late_s=0.3, rotor=1), ())
    assert (event.kind, event.rotors) == (SLOW_RESPONSE, (2,)) and event.onset_s == pytest.approx(ONSET_S, abs=3.0)
    assert event.means.accuses and not event.means.weakens


def test_a_turned_mount_is_no_loss():
    def turned(time):
        return np.outer(time > ONSET_S, [0.0, 0.0, 0.6, 0.0])

    assert heard(flight(trim=turned), [claim(1)])[0] == ()


def test_a_load_that_shifts_weighs_with_the_thrust():
    def more(time):
        return 1.6 * np.sin(time)  # hover thrusts, as in climbs

    def shifted(time):
        moment = np.outer((time > ONSET_S) * (1.0 + more(time) / 4.0), -0.8 * QUAD[:2, 0])
        return np.column_stack([moment, np.zeros_like(time), more(time)])

    ticks = flight(trim=shifted)
    ticks = replace(ticks, load=ticks.load + more(ticks.time) / 4.0)
    found = comparing.weigh(view(ticks), claim(1), ())
    assert found is not None and found.weighed().claim < 0.01 and found.weighed().none > 0.8
    nats = {r.name: r.log_p for r in found.rows if not r.beside}
    assert nats["shift"] > nats["step 1"] + 20.0
    assert heard(ticks, [claim(1)])[:2] == ((), ())


def test_explanations_are_alike_until_the_onset_and_independent_of_their_order():
    ticks = flight(0.3)
    learned, _ = estimate(ticks, QUAD)
    where = span(ticks, QUAD, learned, ONSET_S, 10.0, ONSET_S + 10.0, np.zeros_like(ticks.thrust))
    them = [Explanation((0,)), Explanation(), Explanation((1,)), Explanation(step=1.0), Explanation((2,)), Explanation(force=3.0)]
    fits = compare(where, them)
    again = compare(where, [them[0], *them[:0:-1]])
    assert [f.log_p for f in fits[1:]] == [f.log_p for f in again[:0:-1]]
    none = compare(replace(where, onset=len(where.ticks.time)), them)
    assert {f.log_p for f in none} == {0.0}
    assert fits[0].log_p == max(f.log_p for f in fits) and fits[0].loss[0] == pytest.approx(0.3, abs=0.03)


def test_losses_that_are_no_question_are_taken_out():
    ticks = flight(0.3)
    learned, _ = estimate(ticks, QUAD)
    missing = np.zeros_like(ticks.thrust)
    late = ticks.time > ONSET_S
    missing[late, 0] = 0.3 * ticks.thrust[late, 0]
    where = span(ticks, QUAD, learned, ONSET_S, 10.0, ONSET_S + 10.0, missing)
    loss, none = compare(where, [Explanation((0,)), Explanation()])
    assert none.log_p > loss.log_p - 1.0 and abs(loss.loss[0]) < 0.03


def test_a_lag_delays_commands_and_keeps_their_mean():
    ticks = flight()
    slow = lagged(ticks, QUAD, 0.1)
    assert slow.thrust.mean() == pytest.approx(ticks.thrust.mean(), abs=1e-3)
    assert np.ptp(slow.thrust) < np.ptp(ticks.thrust)
    assert slow.wrench == pytest.approx(slow.thrust @ QUAD.T)
    given, kept = ticks.thrust.copy(), np.exp(-DT / 0.1)
    for k in range(1, len(given)):
        given[k] = kept * given[k - 1] + (1.0 - kept) * ticks.thrust[k]
    assert slow.thrust == pytest.approx(given, rel=1e-12)


def grounded(carried, loss=0.0, axial=None):
    """The spans [s] in which the ground carries a part, where the rotors' commands are `carried`(time) of those in flight."""
    ticks = flight(loss)
    thrust = ticks.thrust * carried(ticks.time)[:, None]
    ticks = replace(ticks, thrust=thrust, axial=None if axial is None else axial(ticks.time))
    found = on_ground(ticks)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], found, [False]]).astype(int)))
    return [(float(ticks.time[a]), float(ticks.time[b - 1])) for a, b in zip(edges[::2], edges[1::2])]


def test_the_ground_carries_at_the_begin_and_the_end_only():
    lifts = lambda time: np.minimum(0.5 + 0.1 * time, 1.0)  # noqa: E731
    lands = lambda time: np.where(time > 55.0, 0.7, 1.0)  # noqa: E731
    dips = lambda time: np.where((time > 30.0) & (time < 34.0), 0.7, 1.0)  # noqa: E731
    ((start, end),) = grounded(lifts)
    assert start < 1.2 and end == pytest.approx(5.0, abs=0.8)
    ((start, end),) = grounded(lands)
    assert start == pytest.approx(54.2, abs=0.4) and end > 59.9
    assert grounded(dips) == grounded(np.ones_like) == []


def test_the_ground_does_not_move_and_a_weak_rotor_is_not_the_ground():
    lands = lambda time: np.where(time > 55.0, 0.7, 1.0)  # noqa: E731
    assert grounded(lands, axial=lambda time: np.full_like(time, -1.5)) == []
    assert grounded(np.ones_like, loss=0.6) == []


def test_what_begins_on_the_ground_is_not_counted():
    ticks = flight()
    thrust = ticks.thrust * np.where(ticks.time > 55.0, 0.7, 1.0)[:, None]
    seen = view(replace(ticks, thrust=thrust))
    claims = tuple(claim(2, onset, kind=kind) for onset in (30.0, 57.0) for kind in (LOSS, OVERRIDE))
    assert near_ground.WITNESSES[0].hear(seen, claims) == claims[:2]
    assert len(seen.warnings) == 2 and "57.0 s rotor 2" in seen.warnings[0] and "ground" in seen.warnings[0]
    seen = view(replace(ticks, thrust=thrust))
    seen.lost = (58.0,)  # a fall is no landing
    assert near_ground.WITNESSES[0].hear(seen, claims) == claims


def test_what_moves_on_the_ground_is_no_evidence():
    """A leg that catches takes any wrench, one like that of a weak rotor as well."""
    ticks = flight()
    landed = replace(ticks, thrust=ticks.thrust * np.where(ticks.time > 55.0, 0.7, 1.0)[:, None])
    leaning = replace(landed, wrench=landed.wrench + np.outer(ticks.time > 55.5, 0.6 * QUAD[:, 1]))
    seen, other = view(landed), view(leaning)
    assert seen.clear is not None and not seen.clear.valid[seen.ground].any() and seen.clear.valid[~seen.ground].any(axis=1).all()
    other.learned = seen.learned
    one, two = (comparing.weigh(v, claim(2, 50.0), ()) for v in (seen, other))
    assert one is not None and two is not None
    np.testing.assert_allclose(one.logs(), two.logs())
    assert comparing.weigh(seen, claim(2, 53.0), ()) is None  # too little is flown after it
