"""The fast comparison (engine/estimator/sudden.py): what it must announce within 60 ms, and what it must not."""

from __future__ import annotations

import numpy as np
import pytest

from rotorwatch.engine.estimator import sudden
from rotorwatch.engine.estimator.plant import GAIN, PER_AXIS, Plant
from rotorwatch.engine.events.events import Event
from rotorwatch.engine.events.losses import CONFIRM_S, Losses
from rotorwatch.engine.events.records import Found, Records
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import RECORDS
from rotorwatch.engine.intake.ticks import JUDGE

HZ, ONSET_S, END_S = 400.0, 4.6, 4.9
GAINS = np.array([60.0, 50.0, 3.0])  # rad/s^2 per hover thrust
QUAD = np.array([[-1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
ARMS = np.array([[-1.0, -1.0, 1.0, 1.0, 0.0, 0.0], [0.6, 0.6, 0.6, 0.6, -1.2, -1.2], [1.0, -1.0] * 3, [1.0] * 6])
CLEAR = np.array([0.9, 0.3, 0.0])  # a torque between the directions of two rotors


def alarms(B=QUAD, torque=lambda t: np.zeros(3), load=lambda t: 0.0, asked=lambda t: np.zeros(3), command_hz=HZ):
    """(seconds after the onset, rotor, others of its arm) of each alarm in a hover with gyro noise. torque, asked: on the vehicle, and by
    the commands, in hover thrusts; load: change of the load factor; all of the time since the onset [s]."""
    n = B.shape[1]
    vehicle, plant, one = Vehicle(), Plant(), sudden.Sudden()
    vehicle.rotors = plant.rotors = n
    for a in range(4):
        for k in range(n):
            vehicle.effectiveness[a][k] = B[a, k]
    for a in range(3):
        plant.mean[a * PER_AXIS + GAIN] = 1.0 / GAINS[a]
        plant.variance[a * PER_AXIS + GAIN][a * PER_AXIS + GAIN] = (0.1 / GAINS[a]) ** 2
    one.begin_with(plant)
    rng, rate, behind, found, commanded, thrust = np.random.default_rng(0), np.zeros(3), np.zeros(3), [], -1.0, [0.4] * n
    for k in range(int(END_S * HZ)):
        t = k / HZ
        wish = asked(t - ONSET_S)
        if t - commanded >= 1.0 / command_hz - 1e-9:
            commanded, thrust = t, list(0.4 * (1.0 + np.linalg.pinv(B[:3]) @ wish))
        behind = behind + (wish - behind) / HZ / 0.03
        rate = rate + (torque(t - ONSET_S) + behind) * GAINS / HZ
        one.accel(-9.80665 * (1.0 + load(t - ONSET_S) + 0.02 * rng.standard_normal()))
        if one.gyro(vehicle, t, list(rate + 0.01 * rng.standard_normal(3)), thrust, commanded, True):
            found.append((t - ONSET_S, int(one.named), int(one.mates)))
    return found


def lost(B, rotor, share):
    """Torque and load factor when a rotor gives `share` less."""
    return {"torque": lambda t: -B[:3, rotor] * share * (t >= 0.0), "load": lambda t: -share / B.shape[1] * (t >= 0.0)}


@pytest.mark.parametrize("rotor", range(4))
def test_a_rotor_that_is_gone_is_named_within_60_ms(rotor):
    ((delay, named, mates),) = alarms(**lost(QUAD, rotor, 1.0))
    assert 0.0 < delay <= 0.06 and named == rotor and mates == 0


def test_a_loss_of_55_percent_is_named_and_one_of_20_is_left_to_the_bank():
    assert [named for _, named, _ in alarms(**lost(QUAD, 2, 0.55))] == [2]
    assert alarms(**lost(QUAD, 2, 0.2)) == []


def test_rotors_of_one_arm_are_named_together():
    ((delay, named, mates),) = alarms(ARMS, **lost(ARMS, 3, 1.0))
    assert delay <= 0.06 and {named} | {k for k in range(6) if mates >> k & 1} == {2, 3}


@pytest.mark.parametrize(
    "what",
    [
        {},
        {"torque": lambda t: CLEAR * (t >= 0.0), "load": lambda t: -0.25 * (t >= 0.0)},  # no rotor lies there
        {"torque": lambda t: -QUAD[:3, 0] * 12.0 * (0.0 <= t < 0.005)},  # a knock
        {"torque": lambda t: -QUAD[:3, 0] * (t >= 0.0), "load": lambda t: 0.5 * (t >= 0.0)},  # something lifts the other side
        {"asked": lambda t: -QUAD[:3, 0] * (t >= 0.0)},  # the autopilot wants to turn
        {**lost(QUAD, 0, 1.0), "command_hz": 10.0},  # unknown what the autopilot wanted
    ],
)
def test_what_no_lost_rotor_explains_is_no_alarm(what):
    assert alarms(**what) == []


def chain(rotor: int, announced_s: float | None, named: int, until: float) -> tuple[list[Event], Losses]:
    """Events of a flight of 10 s, in ticks of 50 ms, whose fast alarm for a rotor comes at 5 s; a loss of `named` is announced later."""
    vehicle, record = Vehicle(), Losses()
    vehicle.rotors = 4
    for a in range(4):
        for k in range(4):
            vehicle.effectiveness[a][k] = QUAD[a, k]
    for k in range(round(until / 0.05)):
        t, found = 0.05 * k, Found()
        if k == 100:
            record.suspect(rotor, 0, 5.0, 4.97)
        found.share[0] = 1.0
        if announced_s is not None and t >= announced_s:
            found.announced = t < announced_s + 0.04
            found.active[0][named] = True
            found.theta[named], found.theta_sd[named] = 0.9, 0.02
            found.onsets[0] = round((t - 4.95) / 0.05)
            found.probability[named] = 1.0
        record.write(vehicle, t, t - 0.04, JUDGE, k == 0, found)
        if t > 5.0:
            record.wait(0.05)
    out = [Event() for _ in range(RECORDS)]
    return out[: record.losses(vehicle, True, Records(), out)], record


def test_an_alarm_is_told_at_once_as_more_than_half():
    (event,), _ = chain(1, None, 0, 5.1)
    assert event.rotors == 0b10 and event.detected == 5.0 and (event.lower[0], event.upper[0]) == (0.5, 1.0)


def test_an_announcement_confirms_the_alarm_and_keeps_its_time():
    (event,), record = chain(1, 5.2, 1, 8.0)
    assert event.rotors == 0b10 and event.detected == 5.0 and event.loss[0] == pytest.approx(0.9) and record.refuted == 0


def test_an_alarm_that_nothing_confirms_is_withdrawn():
    assert len(chain(1, None, 0, 5.0 + CONFIRM_S - 0.1)[0]) == 1
    events, record = chain(1, None, 0, 5.2 + CONFIRM_S)
    assert events == [] and record.refuted == 1


def test_an_announcement_of_another_rotor_withdraws_the_alarm():
    (event,), record = chain(1, 5.2, 2, 5.5)
    assert event.rotors == 0b100 and event.detected == pytest.approx(5.2) and record.refuted == 1
