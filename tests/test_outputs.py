"""What outputs show of how a vehicle is built, loaded and set up: each notice with its number, and what is none."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from conftest import hexa_event
from rotorwatch import airframes
from rotorwatch.answer import ledger
from rotorwatch.engine.motion.allocation import drive
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.kinds import AT_LIMIT, CAPPED, EXHAUSTED, GIVEN_UP, HEAVY, STANDS_APART, UNEVEN
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch.witnesses.healthy import outputs

AIR = ((0.0, 64.0),)
FLOWN_S = AIR[0][1] - outputs.AFTER_TAKE_OFF_S - outputs.BEFORE_LANDING_S
TIME = np.arange(0.0, 65.0, 0.1)
CURVE = ThrustCurve(0.0, 1.0, 0.65)
QUAD, HEXA = (replace(airframes.named(f"ardupilot-{name}"), curve=CURVE) for name in ("quad-x", "hexa-x"))


def flight(vehicle, share, down: Any = 0.0, velocity=True):
    """A flight whose rotors are commanded these shares of full thrust, (n,) or (T, n), and which sinks with `down` m/s."""
    n = len(vehicle.rotors)
    values = drive(CURVE.expo, np.broadcast_to(share, (TIME.size, n)))
    signals = {"motors": Signal(TIME, values, tuple(f"r{k + 1}" for k in range(n)), "1")}
    if velocity:
        v = np.zeros((TIME.size, 3))
        v[:, 2] = down
        signals["velocity"] = Signal(TIME, v, ("x", "y", "z"), "m/s")
    return Flight("test", "ArduPilot", signals, 65.0)


def reported(vehicle, share, until=np.inf, **how):
    flown = flight(vehicle, share, **how)
    none: Any = None  # of ticks that are asked for nothing without a loss
    return outputs.claims(flown, vehicle, none, AIR, until, ())


def lacking(vehicle, rotor, loss, hover=0.5):
    """Shares by which the mixer carries an equal vehicle whose rotor gives `loss` less than it is commanded."""
    B, n = vehicle.effectiveness(), len(vehicle.rotors)
    column = (np.linalg.pinv(B) @ B)[:, rotor - 1]
    return hover * (np.ones(n) + column * loss / (1.0 - column[rotor - 1] * loss))


def at_limit(seconds, rotors, again_s=100.0):
    """Full output of rotors for so many seconds, again after again_s."""
    share = np.full((TIME.size, 4), 0.5)
    share[np.ix_((TIME - 10.0) % again_s < seconds, [r - 1 for r in rotors])] = 1.0
    share[TIME < 10.0] = 0.5
    return share


@pytest.mark.parametrize(("seconds", "again_s"), [(8.0, 100.0), (2.0, 10.0)])
def test_outputs_at_their_limit_are_reported_with_how_long(seconds, again_s):
    (event,) = reported(QUAD, at_limit(seconds, (2, 4), again_s))
    spells = len(np.arange(10.0, AIR[0][1], again_s))
    assert event.kind == AT_LIMIT and event.extra["motors"] == [2, 4] and not event.rotors
    assert event.extra["seconds"] == pytest.approx(spells * seconds, abs=0.3)
    assert event.extra["longest_s"] == pytest.approx(seconds, abs=0.2)
    assert event.extra["of_s"] == pytest.approx(FLOWN_S, abs=0.3) and event.onset_s == pytest.approx(10.0, abs=0.15)
    assert "motors 2 and 4" in event.reason and f"{spells * seconds:.0f} s of" in event.reason


@pytest.mark.parametrize(("seconds", "again_s"), [(1.0, 15.0), (4.5, 100.0)])
def test_short_bursts_are_no_news(seconds, again_s):
    assert reported(QUAD, at_limit(seconds, (2,), again_s)) == ()


@pytest.mark.parametrize("hover", [0.82, 0.9])
def test_hover_near_full_thrust_is_reported_with_what_is_left(hover):
    event = next(e for e in reported(QUAD, np.full(4, hover)) if e.kind == HEAVY)
    assert event.extra["hover_share"] == pytest.approx(hover, abs=0.002)
    assert f"{round(100 * (1 - hover))} % is left" in event.reason
    unsure = replace(QUAD, curve=replace(CURVE, known=False))
    assert any("assumed" in e.reason for e in reported(unsure, np.full(4, hover)))


def test_a_climb_and_enough_thrust_are_not_heavy():
    assert not any(e.kind == HEAVY for e in reported(QUAD, np.full(4, 0.9), down=-2.0))
    assert not any(e.kind == HEAVY for e in reported(QUAD, np.full(4, 0.9), velocity=False))
    assert reported(QUAD, np.full(4, 0.75)) == ()


@pytest.mark.parametrize(("vehicle", "loss"), [(QUAD, 0.35), (QUAD, -0.4), (HEXA, 0.35)])
def test_the_one_rotor_that_explains_all_three_axes_stands_apart(vehicle, loss):
    for rotor in range(1, len(vehicle.rotors) + 1):
        share = lacking(vehicle, rotor, loss)
        (event,) = reported(vehicle, share)
        own = share[rotor - 1]
        more = drive(CURVE.expo, own) - drive(CURVE.expo, (1.0 - loss) * own)
        assert event.kind == STANDS_APART and event.extra["motors"][0] == rotor and not event.rotors
        assert event.extra["output"] == pytest.approx(more, abs=0.01)
        assert event.extra["thrust"] == pytest.approx(loss, abs=0.02)
        assert ("above" if loss > 0.0 else "below") in event.reason


def test_a_rotor_that_grew_weak_later_is_not_said_to_stand_apart_since_take_off():
    later = np.where(TIME[:, None] > 30.0, lacking(QUAD, 2, 0.35), 0.5)
    assert reported(QUAD, later) == ()


def test_of_two_opposite_rotors_of_a_hexa_the_weak_one_and_the_strong_one_are_named():
    (weak,) = reported(HEXA, lacking(HEXA, 1, 0.35))
    (strong,) = reported(HEXA, lacking(HEXA, 2, -0.6))
    assert weak.extra["motors"] == strong.extra["motors"] == [1, 2]
    assert "motor 1" in strong.reason and "or that of motor 2 below it" in strong.reason


@pytest.mark.parametrize("vehicle", [QUAD, HEXA])
@pytest.mark.parametrize("yaw", [-0.3, 0.24])
def test_one_sense_of_rotation_that_works_harder_is_a_yaw_imbalance(vehicle, yaw):
    spin = np.array([r.spin for r in vehicle.rotors])
    (event,) = reported(vehicle, 0.5 + 0.5 * yaw * spin)
    assert event.kind == UNEVEN and event.extra["yaw_share"] == pytest.approx(abs(yaw), abs=0.005)
    assert event.extra["harder"] == [k + 1 for k in np.flatnonzero(spin * yaw > 0)]
    ratio = (0.5 + 0.5 * abs(yaw)) / (0.5 - 0.5 * abs(yaw)) - 1.0
    assert event.extra["more"] == pytest.approx(ratio, abs=0.01)
    assert reported(vehicle, 0.5 + 0.5 * 0.5 * outputs.TWISTED * spin) == ()
    later = np.where(TIME[:, None] > 40.0, 0.5 + 0.5 * yaw * spin, 0.5)  # a mount that turns in flight has a kind of its own
    assert reported(vehicle, later) == ()


def test_a_load_off_the_middle_is_neither():
    B = QUAD.effectiveness()
    for roll, pitch in ((0.15, 0.0), (0.0, -0.15), (0.12, 0.12)):
        assert reported(QUAD, 0.5 * np.linalg.pinv(B) @ np.array([4.0 * roll, 4.0 * pitch, 0.0, 4.0])) == ()


def test_what_comes_after_a_fault_is_not_reported():
    share = lacking(QUAD, 2, 0.4)
    assert reported(QUAD, share, until=ledger.undisturbed((hexa_event(onset_s=2.0),))) == ()
    assert reported(QUAD, share, until=ledger.undisturbed(reported(QUAD, share)))  # a notice explains no other
    late = np.where(TIME[:, None] > 30.0, 1.0, 0.5) * np.ones(4)
    assert reported(QUAD, late) and reported(QUAD, late, until=29.0) == ()


def sinking(given, limit, down, weight=1.3):
    """What is reported of a hexa that loses rotor 3 at 30 s: its others give `given` of the weight from then on, rotor 3's output is at its
    limit or not. weight: full thrust over the weight."""
    hover, alive = 1.0 / weight, np.arange(6) != 2
    share = np.where(TIME[:, None] < 30.0, hover, np.where(alive, given * hover * 6.0 / 5.0, 1.0 if limit else 0.5))
    flown = flight(HEXA, share, down=np.where(TIME < 30.0, 0.0, down))
    some = np.ones(TIME.size, bool)
    none = np.zeros((TIME.size, 3))
    table = Ticks(
        TIME, TIME, share / hover, share @ HEXA.effectiveness().T, none, none, np.ones(TIME.size), np.ones((TIME.size, 4), bool),
        np.full(TIME.size, ASSESS), ~some, np.full(TIME.size, hover), 0.1, ~some,
    )  # fmt: skip
    lost = hexa_event(rotors=(3,), onset_s=30.0, end_s=None, loss=(1.0,), interval=((0.95, 1.0),), alternatives=())
    return outputs.exhausted(flown, HEXA, table, ((0.0, 40.0),), (lost,))


def test_why_a_vehicle_sank_without_a_rotor():
    (event,) = sinking(0.6, True, 3.0)
    # Four of six carry in balance: the opposite one cannot be used.
    assert event.kind == EXHAUSTED and event.extra["lift"] == pytest.approx(1.3 * 4.0 / 6.0, abs=0.01)
    assert event.extra["given"] == pytest.approx(0.6, abs=0.02) and event.extra["sank_m"] == pytest.approx(30.0, abs=1.0)
    assert "without rotor 3" in event.reason and "could not have stayed up" in event.reason
    (able,) = sinking(0.6, True, 3.0, weight=2.0)
    assert able.extra["lift"] > 1.0 and "the mixer limited them" in able.reason and "motor 3" in able.reason


@pytest.mark.parametrize("how", [(1.0, True, 3.0), (0.6, False, 3.0), (0.6, True, -1.0), (0.6, True, 0.1)], ids=str)
def test_a_descent_that_carries_the_weight_or_is_none_is_not(how):
    assert sinking(*how) == []


def plateaus(cap, motors, seconds=1.0, every=10.0):
    """Outputs of these motors that reach `cap` of their range for so long, again and again, and swing below it."""
    share = np.full((TIME.size, 4), 0.5) + 0.05 * np.sin(TIME[:, None] * (1.0, 1.1, 1.2, 1.3))
    at = (TIME % every < seconds) & (TIME > 9.0)
    for k in motors:
        share[at, k - 1] = cap
    return share


def shares(share):
    flown = flight(QUAD, 0.5)
    motors = flown["motors"]
    return replace(flown, signals={**flown.signals, "motors": replace(motors, values=share)})


@pytest.mark.parametrize(("cap", "motors"), [(0.75, (1, 2, 3, 4)), (0.8, (2,))])
def test_a_cap_is_reported_as_a_cap(cap, motors):
    (event,) = outputs.capped(shares(plateaus(cap, motors)), QUAD, AIR)
    assert event.kind == CAPPED and event.extra["motors"] == list(motors) and event.extra["output"] == pytest.approx(cap)
    assert f"never exceeded {100 * cap:.0f} %" in event.reason and event.extra["seconds"] >= outputs.CAPPED_S


@pytest.mark.parametrize("share", [
    plateaus(0.98, (1, 2)), plateaus(0.75, (1, 2), seconds=0.2), plateaus(0.75, (1, 2), seconds=9.0), plateaus(0.75, ()),
    plateaus(0.75, (1, 2), seconds=3.0, every=40.0),
], ids=["at the limit", "too short", "stands still", "never", "once"])  # fmt: skip
def test_what_is_no_cap(share):
    assert outputs.capped(shares(share), QUAD, AIR) == []


def test_the_output_that_the_mixer_gives_up_is_reported_and_not_accused():
    """Motors 3 and 4 of a hexa X are opposite."""
    lost = hexa_event(rotors=(3,), onset_s=30.0, end_s=None, loss=(1.0,), interval=((0.95, 1.0),))
    share = np.full((TIME.size, 6), 0.5)
    share[TIME >= 30.0] = (0.5, 0.5, 0.95, 0.0, 0.5, 0.5)
    (event,) = outputs.given_up(flight(HEXA, share), HEXA, (lost,))
    assert event.kind == GIVEN_UP and event.extra["motors"] == [4] and not event.rotors and "rotor 3 gives nothing" in event.reason
    share[TIME >= 30.0] = (0.5, 0.5, 0.95, 0.1, 0.5, 0.5)
    assert outputs.given_up(flight(HEXA, share), HEXA, (lost,)) == []
    share[:, 3] = 0.0  # it was off before
    assert outputs.given_up(flight(HEXA, share), HEXA, (lost,)) == []


@pytest.mark.parametrize("change", [{"loss": (0.5,)}, {"alternatives": ((4,),)}, {"end_s": 32.0}, {"extra": {"gives": 1.2}}], ids=str)
def test_only_a_certain_lasting_total_loss_explains_it(change):
    lost = hexa_event(**{"rotors": (3,), "onset_s": 30.0, "end_s": None, "loss": (1.0,), "interval": ((0.95, 1.0),)} | change)
    share = np.full((TIME.size, 6), 0.5)
    share[TIME >= 30.0] = (0.5, 0.5, 0.95, 0.0, 0.5, 0.5)
    assert outputs.given_up(flight(HEXA, share), HEXA, (lost,)) == []
