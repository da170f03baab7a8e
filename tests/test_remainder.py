"""Losses in the motion that known losses leave: made-up quadrotors that lose two rotors, one after the other."""

from dataclasses import replace

import numpy as np
import pytest

from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.flight.kinds import LOSS
from rotorwatch.toolkit import odds
from rotorwatch.witnesses import comparing, remainder
from test_rivals import ONSET_S, QUAD, claim, flight, heard, view

LATER_S = ONSET_S + comparing.AFTER_S + 3.0
FIRST = replace(claim(2), loss=(0.3,), interval=((0.2, 0.4),))


def flown(second=0.0, missing=0.3):
    """Ticks of a quadrotor whose rotor 2 loses `missing` at ONSET_S, and rotor 4 `second` at LATER_S."""
    ticks = flight(missing, 1)
    thrust = ticks.thrust.copy()
    thrust[ticks.time > LATER_S, 3] /= 1.0 - second
    return replace(ticks, thrust=thrust, wrench=thrust @ QUAD.T)


def claimed(ticks, known=(FIRST,)):
    seen = view(ticks)
    return list(remainder.claims(seen, known, comparing.missing(ticks, known)))


def test_a_second_loss_is_found_beside_a_known_one():
    first, second = (e for e in heard(flown(0.25), [FIRST])[0] if e.kind == LOSS)
    assert first.rotors == (2,) and second.rotors == (4,) and second.onset_s == pytest.approx(LATER_S, abs=0.2)
    (low, high), (loss,) = second.interval[0], second.loss
    assert low < 0.25 < high and loss == pytest.approx(0.25, abs=0.08)


def test_a_known_loss_alone_leaves_nothing():
    assert claimed(flown()) == [] and [e.rotors for e in heard(flown(), [FIRST])[0]] == [(2,)]


def test_rotors_that_are_known_or_suspected_are_not_claimed_again():
    ticks = flown(0.25)
    assert [c.rotors for c in claimed(ticks)] == [(4,)]
    doubted = replace(FIRST, rotors=(4,), alternatives=((2,), (3,)))
    assert claimed(ticks, (FIRST, doubted)) == []


def test_the_estimator_sees_a_whole_vehicle_and_its_likeliest_announcement_counts(monkeypatch):
    ticks = flown(0.25)
    seen = view(ticks)
    missing = comparing.missing(ticks, [FIRST])
    assert missing[-1, 1] == 0.3 * ticks.thrust[-1, 1] and not missing[:, [0, 2, 3]].any()
    fourth = list_hypotheses(4).names.index("rotor 4")

    def fake(table, B, dynamics):
        assert np.allclose(table.wrench, ticks.wrench - missing @ QUAD.T) and dynamics is seen.dynamics
        out = seen.out._replace(announced=np.zeros(len(table.time), bool), log_odds=np.full_like(seen.out.log_odds, -9.0))
        for k, odds_of in ((300, 5.0), (400, 30.0), (500, 20.0)):
            out.announced[k], out.log_odds[k, fourth], out.onset[k] = True, odds_of, 40
        return None, out

    monkeypatch.setattr(remainder, "estimate", fake)
    (found,) = remainder.claims(seen, [FIRST], missing)
    assert (found.rotors, found.onset_s, found.detected_s) == ((4,), ticks.command_time[360], ticks.time[400])


def test_nothing_is_looked_for_beside_doubted_losses_and_stuck_rotors(monkeypatch):
    monkeypatch.setattr(remainder, "claims", lambda *given: pytest.fail("asked"))
    heard(flown(), [])
    heard(flown(), [replace(FIRST, alternatives=((3,),))])
    heard(flown(), [replace(FIRST, extra={"gives": 1.2})])


@pytest.mark.parametrize(("origin", "decisions"), [("steps", ["loss", "loss"]), (odds.BESIDE, ["open", "loss"])])
def test_a_loss_beside_a_known_one_needs_the_odds_of_an_accusation(origin, decisions):
    found = []
    for odds_of in (30.0, 80.0):
        nats = (odds.WEIGHTS["nothing"] + np.log(odds_of)) / odds.TEMPER
        rows = tuple(odds.Row(name, "", who, who, x, *np.zeros((2, 1))) for name, who, x in (("nothing", (), 0.0), ("loss", (0,), nats)))
        one = odds.Comparison(30.0, (1,), False, (), origin, False, 4, rows)
        found.append(one.decided(one.weighed()).value)
    assert found == decisions
