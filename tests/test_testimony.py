"""What a rotor's balance says on a loss of thrust, and what that changes: pairs that look alike, and a trim from take-off."""

import numpy as np
import pytest

from rotorwatch.airframes import named
from rotorwatch.toolkit import odds
from rotorwatch.witnesses.balance import testimony
from rotorwatch.witnesses.healthy import population, whole_flight
from test_balance import earlier, flown, heard

MOST, LEAST = np.log(testimony.SHARE / testimony.ELSE[0]), np.log(1.0 - testimony.SHARE)
ONSET = 12.0


def chipped(rotor, size, n=4):
    def changing(t):
        u = np.tile([0.8, 0.5, 1.2, 0.4, 0.6, 0.9][:n], (t.size, 1))
        u[t > ONSET, rotor] += size
        return u

    return changing


def said(rotor, size, **more):
    time = np.arange(0.0, 24.0, 1.0 / 504.0)
    return testimony.at(heard(flown(chipped(rotor, size)(time), **more)), ONSET)


@pytest.mark.parametrize("rotor", [0, 3])
def test_a_rotor_that_got_out_of_balance_supports_its_loss_alone(rotor):
    found = said(rotor, 5.0)
    assert 0.7 * MOST < found[rotor] < MOST
    assert ((found[np.arange(4) != rotor] < -0.4) & (found[np.arange(4) != rotor] > LEAST)).all()


def test_rotors_that_stay_as_they_were_speak_a_little_against_it():
    found = said(0, 0.0)
    assert (found < -0.4).all() and (found > LEAST).all()


def test_what_all_rotors_share_supports_none():
    time = np.arange(0.0, 24.0, 1.0 / 504.0)
    u = np.outer(np.where(time > ONSET, 3.0, 1.0), [0.8, 0.5, 1.2, 0.4])
    assert (testimony.at(heard(flown(u)), ONSET) < 0.0).all()


def test_a_rotor_that_is_not_heard_says_nothing():
    found = heard(flown([0.8, 0.5, 1.2, 0.4]))
    assert (testimony.at(found, -1.0) == 0.0).all()
    quiet = testimony.from_takeoff(found._replace(figures=(None,) * 4))
    assert (quiet == 0.0).all()


def test_from_takeoff_it_speaks_against_the_others_and_against_earlier_flights():
    whole, broken = heard(flown([0.8, 0.5, 1.2, 0.4])), heard(flown([0.8, 0.5, 4.0, 0.4]))
    most = np.log(testimony.SHARE / testimony.ELSE[1])
    assert (testimony.from_takeoff(whole) < 0.3).all()
    reported = testimony.from_takeoff(broken)
    assert 0.3 * most < reported[2] < most and (np.delete(reported, 2) < 0.0).all()
    past = earlier([0.8, 0.5, 1.2, 0.4], [0.82, 0.48, 1.25, 0.41], [0.79, 0.52, 1.1, 0.4])
    assert testimony.from_takeoff(broken, past)[2] > reported[2]
    usual = earlier([0.8, 0.5, 4.0, 0.4], [0.82, 0.48, 4.2, 0.41], [0.79, 0.52, 3.9, 0.4])
    assert testimony.from_takeoff(broken, usual)[2] < -0.4  # this vehicle was always so


def compared(reported):
    none = np.zeros(0)
    rows = [("loss", (0,), 30.0), ("nothing", (), 0.0), ("loss", (1,), 30.0)]
    rows = tuple(odds.Row(name, "", who, who, log_p, none, none) for name, who, log_p in rows)
    return odds.Comparison(30.0, (1,), True, (), "estimator", False, 4, rows, reported)


def test_a_pair_that_looks_alike_is_reported_apart():
    without = compared(()).weighed()
    assert without.near() == [(2,)]
    for reported, rotor in (((MOST, LEAST, LEAST, LEAST), 1), ((LEAST, MOST, LEAST, LEAST), 2)):
        claim = compared(reported)
        found = claim.weighed()
        assert (found.claim > 0.95) == (rotor == 1) and (found.near() == []) == (rotor == 1)
        assert odds.read(claim.to_dict(), 4).weighed().claim == pytest.approx(found.claim, abs=1e-3)
    assert compared((LEAST,) * 4).weighed().claim < without.claim  # a little less of any loss


def hovering(w, n=4):
    none, square = (0.0,) * 3, ((0.0,) * 3,) * 3
    return whole_flight.Features("", (0.5,) * n, tuple(w), (0.0, 0.0), (0.0, 0.0), (1.0, 1.0), square, none, square, (0.0,) * n, 60.0, 30.0)


def test_a_trim_from_takeoff_with_an_imbalance_is_a_propeller():
    B = named("px4-quad-x").effectiveness()
    theta = np.array([0.6])
    w = population._weak(B, 1, theta)[0] * [1.0, 1.0, 0.4]

    def share(reported):
        found = population.weigh(hovering(w), B, reported)
        return {tuple(c["rotors"]): c["probability"] for c in found["causes"]}

    plain, heard_, quiet = (share(reported) for reported in (0.0, np.array([-0.6, 2.2, -0.6, -0.6]), np.full(4, -0.6)))
    assert quiet[()] > plain[()] > heard_[()] and heard_[(2,)] > plain[(2,)] > quiet[(2,)]
    assert heard_[(2,)] > 0.9
