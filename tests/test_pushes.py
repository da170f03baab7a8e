"""A push from outside in the side force: it begins and ends with a step, and a loss does not."""

from dataclasses import replace

import numpy as np
import pytest

from rotorwatch.base.physics import G0
from rotorwatch.engine.bindings.explaining import Explanation, compare, span
from rotorwatch.engine.bindings.program import estimate
from rotorwatch.witnesses import comparing, pushes
from test_rivals import DT, ONSET_S, QUAD, claim, flight, pushed, view

END_S = ONSET_S + 12.0


def aside(ticks, size, end=np.inf, seed=1):
    """The ticks with a side force [m/s^2] to the north from ONSET_S to end, as the mean of the last half second, in gusts."""
    time, turn = ticks.time, np.cumsum(ticks.rate[:, 2]) * DT
    force = size * ((time > ONSET_S) & (time <= end))
    north = np.convolve(force, np.full(round(pushes.MEAN_S / DT), DT / pushes.MEAN_S))[: len(time)]
    gusts = np.random.default_rng(seed).normal(0.0, 0.05, (len(time), 2))
    return replace(ticks, side=np.stack([north * np.cos(turn), -north * np.sin(turn)], axis=1) + gusts)


def ticks_around(ticks, until=END_S + 8.0):
    return span(ticks, QUAD, estimate(ticks, QUAD)[0], ONSET_S, 10.0, until, np.zeros_like(ticks.thrust))


@pytest.mark.parametrize(("size", "likely"), [(0.0, False), (0.1, False), (1.0, True), (2.5, True)])
def test_a_push_is_a_step_of_the_side_force(size, likely):
    found = pushes.SideForce(ticks_around(aside(flight(), size))).shove(ONSET_S)
    assert found.size == pytest.approx(size, abs=0.25) and 0.01 < found.usual < 0.2
    assert (found.log_odds > 2.0) if likely else (found.log_odds < -1.0)
    assert found.lift == pytest.approx((found.size / G0) ** 2)


def test_without_a_side_force_nothing_is_said():
    side = pushes.SideForce(ticks_around(flight()))
    assert side.shove(ONSET_S) == pushes.Shove() and pushes.Shove().log_odds == 0.0
    assert side.end_s() == np.inf


def test_ticks_slower_than_the_mean_have_steps_too():
    where = ticks_around(aside(flight(), 2.0))
    slow = where.ticks.part(np.arange(0, len(where.ticks.time), 25))
    side = pushes.SideForce(replace(where, ticks=replace(slow, dt=25 * DT), onset=where.onset // 25))
    assert len(side.steps) == len(slow.time) - 1 and side.shove(ONSET_S).size > 1.5 and np.isfinite(side.end_s())


@pytest.mark.parametrize("rate", [0.0, 0.8])
def test_the_end_of_a_push_is_the_step_back(rate):
    ticks = replace(flight(), rate=np.outer(np.ones(len(flight().time)), [0.0, 0.0, rate]))
    assert pushes.SideForce(ticks_around(aside(ticks, 2.0, END_S))).end_s() == pytest.approx(END_S - pushes.NEAR_S, abs=0.15)


def test_what_the_side_force_says_decides_between_a_push_and_a_loss():
    """A constant moment in the direction of rotor 2."""

    def moment(time):
        return np.outer(time > ONSET_S, [*(-0.25 * QUAD[:2, 1]), 0.0, 0.0])

    calm = flight(trim=moment)
    nats = []
    for ticks in (aside(calm, 0.0), calm, aside(calm, 2.0)):
        found = comparing.weigh(view(ticks), claim(2), ())
        assert found is not None
        rows = {(r.name, r.rotors): r.log_p for r in found.rows if not r.beside}
        nats.append(rows["push", ()] - rows["loss", (1,)])
    assert nats[0] < nats[1] - 1.0 and nats[2] > nats[1] + 2.0


def test_a_brief_push_explains_a_loss_whose_end_nobody_has_seen():
    ticks = pushed(END_S, 0.3)
    found = comparing.weigh(view(aside(ticks, 2.0, END_S)), claim(2), ())
    assert found is not None
    best = max((r for r in found.rows if not r.rotors), key=lambda r: r.log_p)
    assert best.name == comparing.PUSH.name + comparing.PASSED and found.weighed().none > 0.99


def test_a_push_takes_thrust():
    """The vehicle leans into a push, which then also pulls down."""
    lift = 0.3

    def taken(time):
        return np.outer(time > ONSET_S, [0.4, 0.0, 0.0, lift])

    where = ticks_around(aside(flight(trim=taken), 2.0), ONSET_S + 15.0)
    _, with_, without = compare(where, [Explanation(), *(Explanation(push=0.5, step=0.1, lift=x) for x in (lift, 0.0))])
    assert with_.log_p > without.log_p + 3.0


def test_the_force_of_a_push_does_not_drag_at_the_rotors():
    """With unequal thrusts a side force of the air yaws the vehicle by their drag; that of a push does not, and nothing is commanded."""
    ticks = flight(trim=lambda time: np.outer(np.ones_like(time), [1.2, 0.0, 0.0, 0.0]))
    nothing, push = compare(ticks_around(aside(ticks, 2.5)), [Explanation(), Explanation(push=0.5)])
    assert push.log_p > nothing.log_p + 20.0


def test_the_side_force_speaks_of_pushes_that_begin_at_once():
    """At the begin, and where the change is over with the push, at the end; not of what grows, or of no push."""
    where = ticks_around(flight())
    begins, ends = pushes.Shove(2.0, 0.1), pushes.Shove(1.0, 0.1)
    grows = next(r for r in comparing.ELSE if r.how.swells)
    them = [
        comparing.Rival("nothing", Explanation()),
        comparing.PUSH,
        comparing.PUSH._replace(how=comparing.PUSH.how._replace(end_s=END_S)),
        grows,
    ]
    lift = 4.0 * begins.lift
    fits = compare(where, [r.how._replace(lift=lift if r.how.push else 0.0) for r in them])
    reported = comparing._fitted(where, them, END_S, (begins, ends))
    more = [a.log_p - b.log_p for a, b in zip(reported, fits, strict=True)]
    assert more == pytest.approx([0.0, begins.log_odds, begins.log_odds + ends.log_odds, 0.0], abs=1e-9)


def test_losses_that_follow_each_other_at_once_are_compared():
    ticks, both = flight(), [claim(2), claim(3, onset=ONSET_S + 2.0)]
    assert all(comparing.weigh(view(ticks), one, both) is not None for one in both)


def test_a_push_that_is_over_leaves_the_trim_as_it_is():
    """It does not explain, as a second step would, what changes at its end and stays."""

    def steps(time):
        return np.outer(time > ONSET_S, [0.4, 0.2, 0.0, 0.0]) + np.outer(time > END_S, [0.0, 0.0, 0.0, 0.6])

    where = ticks_around(flight(trim=steps))
    ended = Explanation(push=0.5, step=1.0, end_s=END_S)
    assert compare(where, [ended])[0].log_p < compare(where, [ended._replace(push=0.0)])[0].log_p


def test_the_ticks_about_an_end_are_not_counted():
    ticks = flight(0.3, end=END_S)
    where = replace(ticks_around(ticks), ends=(END_S,))
    spoilt = ticks.command_time[(ticks.command_time > END_S) & (ticks.command_time < END_S + 0.25)]
    wrench = where.y.copy()
    wrench[np.isin(where.ticks.command_time, spoilt)] += 3.0
    fits = [compare(replace(where, y=y), [Explanation((0,), END_S)])[0].log_p for y in (where.y, wrench)]
    assert fits[0] == pytest.approx(fits[1], abs=1e-6)
