"""Losses in the blind time after take-off, found afterwards: made-up quadrotors in hover whose truth is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.learning import dynamics
from rotorwatch.engine.bindings.program import estimate
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, HOVER_LEARN_S, LEARN, READY_S, Ticks
from rotorwatch.witnesses import hindsight

DT = 0.1
QUAD = airframes.named("ardupilot-quad-x").effectiveness()
HYP = list_hypotheses(4)


def flight(rotor=0, loss=0.0, onset=3.0, end=np.inf, seconds=30.0, knocked=None, seed=0):
    """Ticks of a quadrotor that hovers from 0 s on; `rotor` loses `loss` from onset to end [s]; knocked at that time, or never."""
    rng = np.random.default_rng(seed)
    time = np.arange(HOVER_LEARN_S, seconds, DT) + DT
    count = len(time)
    thrust = 1.0 + rng.normal(0.0, 0.01, (count, 4))
    weak = (time > onset) & (time <= end)
    thrust[weak, rotor] /= 1.0 - loss
    mode = np.where(time >= READY_S, ASSESS, LEARN).astype(np.int32)
    contact = np.zeros(count, bool) if knocked is None else np.abs(time - knocked) < 0.5 * DT
    return Ticks(
        time, time - 0.5 * DT, thrust, thrust @ QUAD.T, np.zeros((count, 3)), rng.normal(0.0, 0.05, (count, 3)),
        1.0 + rng.normal(0.0, 0.005, count), np.repeat(~contact[:, None], 4, axis=1), mode, np.arange(count) == 0,
        np.full(count, 0.4), DT, np.zeros(count, bool), contact=contact,
    )  # fmt: skip


def found(ticks):
    """(what a live observer was shown, what is found afterwards)."""
    last, out = estimate(ticks, QUAD)
    return event_rows.read(out, ticks, QUAD), hindsight.find(last, ticks, QUAD)


@pytest.mark.parametrize(("rotor", "loss", "onset"), [(0, 0.5, 2.5), (2, 0.2, 4.0), (3, 0.35, 7.5)])
def test_a_loss_in_the_blind_time_is_found_afterwards(rotor, loss, onset):
    (event,) = found(flight(rotor, loss, onset))[1]
    assert event.rotors == (rotor + 1,)
    assert event.alternatives == ()
    assert event.interval[0][0] <= loss <= event.interval[0][1]
    assert event.onset_s == pytest.approx(onset, abs=0.3)
    assert event.extra["live"] is False
    assert event.detected_s == pytest.approx(READY_S + hindsight.LOOK_S, abs=0.3)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"loss": 0.4, "onset": 3.0, "end": 6.0},  # no propeller grows again: a gust, or the ground that was left
        {"loss": 0.4, "onset": 3.0, "knocked": 3.0},  # what a knock broke is not assessed
        {"loss": 0.4, "onset": 3.0, "seconds": 7.0},  # nothing shows that it lasted
        {"loss": 0.4, "onset": 14.0},  # not in the blind time: reported in flight
    ],
)
def test_nothing_is_found_where_nothing_broke_or_nobody_can_say(changes):
    assert found(flight(**changes))[1] == ()


def test_a_hop_with_idling_motors_is_none():
    """After a crash the motors idle on the ground; their commands answer to a tilt that nothing takes away."""
    first, second = flight(seed=1), flight(loss=0.4, seed=2)
    two = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in vars(first)
        if isinstance(getattr(first, name), np.ndarray)
    }
    two["time"] = np.concatenate([first.time, second.time + 60.0])
    two["command_time"] = two["time"] - 0.5 * DT
    flown = Ticks(**{**vars(first), **two})
    assert [e.rotors for e in found(flown)[1]] == [(1,)]
    two["hover"] = np.where(two["time"] > 60.0, 0.05, 0.4)
    assert found(Ticks(**{**vars(first), **two}))[1] == ()


def ends(ticks):
    """Time of the last tick that is looked at again [s]; None when there is none."""
    again = hindsight.beginnings(ticks)
    return None if again is None else float(again.time[-1])


@pytest.mark.parametrize("leaves", [0.0, 4.0, 7.0])
def test_nothing_is_found_while_the_ground_carries_the_vehicle(leaves):
    """Rotors that spool up against the ground, which takes what one of them lacks; and a take-off at once."""
    ticks = flight()
    ground = ticks.time < leaves
    ticks.thrust[ground] = 0.6 + 0.01 * ticks.time[ground, None]
    ticks.thrust[ground, 1] += 0.25
    ticks.wrench[:] = ticks.thrust @ QUAD.T
    again = hindsight.beginnings(ticks)
    assert again is not None and again.time[0] == pytest.approx(max(leaves, ticks.time[0]), abs=1.1) and again.restart[0]
    assert again.restart.sum() == 1 and found(ticks)[1] == ()


def test_a_loss_of_a_vehicle_that_is_clear_of_the_ground_is_found_where_it_was():
    ticks = flight(loss=0.4, onset=5.0)
    ground = ticks.time < 3.0
    ticks.thrust[ground] *= 0.7
    ticks.wrench[:] = ticks.thrust @ QUAD.T
    (event,) = found(ticks)[1]
    assert event.rotors == (1,) and event.onset_s == pytest.approx(5.0, abs=0.3)


def test_the_second_look_ends_at_an_upset_and_needs_the_blind_time():
    ticks = flight()
    assert ends(ticks) == pytest.approx(READY_S + hindsight.LOOK_S, abs=2 * DT)
    ticks.upset[ticks.time > 10.0] = True
    assert ends(ticks) == pytest.approx(10.0, abs=2 * DT)
    ticks.upset[ticks.time > 5.0] = True
    assert ends(ticks) is None


def test_what_is_learned_from_is_all_that_follows_the_blind_time():
    ticks = flight()
    later = hindsight.rest(ticks)
    assert later is not None
    assert (later.time >= READY_S).all()
    ticks.mode[:] = GROUND
    assert hindsight.rest(ticks) is None


def test_what_a_flight_has_taught_leaves_biases_open():
    carry = SimpleNamespace(s=np.ones(24), P=0.01 * np.eye(24), variances=np.ones((4, 4)))
    known = dynamics(carry, QUAD)
    axes, spread = known["x0"].reshape(4, -1), np.diag(known["P0"]).reshape(4, -1)
    assert (axes[:, 3:] == 1.0).all()
    assert (axes[:, :3] == 0.0).all()
    assert spread[:, 3:] == pytest.approx(0.01)
    assert (spread[:, 2] > 0.01).all()
