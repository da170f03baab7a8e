"""A thrust curve that is not known: a state of the default estimator, learned where commands stand out, and no rotor's loss meanwhile."""

from functools import cache

import numpy as np
import pytest
from tests.plain import filled, made, room, tick
from tests.plain import plant as plant_of

from rotorwatch.engine.estimator import plant
from rotorwatch.engine.estimator.model_error import Memory, Seen
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import CURVE, GAIN, PER_AXIS, THETA
from rotorwatch.engine.intake.ticks import JUDGE, LEARN
from rotorwatch.flight.vehicle import ThrustCurve
from test_default_estimator import DT, KNOWN_NOISE, make
from test_plant import QUAD

N, TICKS, READY = 4, 400, 60
HOVER = 0.45  # command that carries the vehicle
ASSUMED, LINEAR = 0.65, 0.0


def row(thrust, expo, sd, hover=HOVER):
    """(n + 13,) inputs of thrusts by a curve of that expo, at rest."""
    carries = float(ThrustCurve(0.0, 1.0, expo)(np.array(hover)))
    return np.concatenate([thrust, np.zeros(3), [N], np.zeros(5), [1.0 / carries, expo, sd, np.nan]])


@pytest.mark.parametrize("expo", [0.0, 0.3, 0.65, 1.0])
@pytest.mark.parametrize("usual", [1.0, 1.4])
def test_a_bent_curve_is_the_derivative_of_the_thrust(expo, usual):
    """By expo, at the same commands, with the thrust of the usual command as it is: against two curves next to each other."""
    commands, step = np.array([0.1, 0.3, HOVER, 0.8]), 1e-5
    unit = float(ThrustCurve(0.0, 1.0, expo)(np.array(HOVER)))
    thrust = ThrustCurve(0.0, 1.0, expo)(commands) / unit
    found = room(N)
    plant.bend(plant_of(QUAD), tick(row(thrust, expo, 0.2), N), thrust.tolist(), usual, found)
    drive = np.interp(usual * unit, *(lambda a: (ThrustCurve(0.0, 1.0, expo)(a), a))(np.linspace(0.0, 1.0, 200_001)))

    def given(e):
        curve = ThrustCurve(0.0, 1.0, e)
        return curve(commands) / curve(np.array(drive)) * usual

    away = min(max(expo, step), 1.0 - step)
    wanted = 0.2 * (given(away + step) - given(away - step)) / (2.0 * step)
    assert found == pytest.approx(wanted, abs=2e-4)


@cache
def flown(sd, loss=0.0, turn=1.2, seed=0, turns=150, fails=300, ready=READY, rotors=(0, 1)):
    """(outputs, carries) of a flight by a straight curve that is taken for a bent one: hover, from tick `turns` on a turn on the spot of
    `turn` rad/s^2 and back, and from tick `fails` on rotors without so much of their thrust, made up for at once. Judged from `ready`
    on."""
    quad, rng = make("ardupilot-quad-x"), np.random.default_rng(seed)
    B, gain = QUAD, N * np.array(plant.GAIN_MEAN[:3])
    when = np.arange(TICKS)
    yaw = turn * np.where((when >= turns) & (when < turns + 120), np.sign(np.sin((when - turns) * np.pi / 30.0)), 0.0)
    yaw = np.convolve(yaw, np.ones(8) / 8.0, "same")
    rates = np.cumsum(yaw) * DT
    wrench = np.column_stack([np.zeros((TICKS, 2)), gain[2] * (yaw + plant.DAMPING_RATE * rates), np.full(TICKS, float(N))])
    given = wrench @ np.linalg.pinv(B).T  # what each rotor has to give
    lost = np.zeros((TICKS, N))
    lost[fails:, list(rotors)] = loss
    commands = np.clip(given / np.maximum(1.0 - lost, 0.4) * HOVER, 0.0, 1.0)  # a straight curve
    curve = ThrustCurve(0.0, 1.0, ASSUMED)
    unit = float(curve(np.array(HOVER)))
    thrust = curve(commands) / unit
    y = thrust @ B.T + np.sqrt(KNOWN_NOISE[0]) * rng.standard_normal((TICKS, 4))
    zeros, full = np.zeros((TICKS, 2)), np.full(TICKS, 1.0 / unit)
    mode = np.where(when < ready, LEARN, JUDGE)
    motion = [zeros, yaw, np.full(TICKS, float(N)), zeros, rates, zeros]
    u = np.column_stack([thrust, *motion, full, np.full(TICKS, ASSUMED), np.full(TICKS, sd), np.full(TICKS, np.nan), mode, when == 0])
    return quad.over(u.astype(float), y, np.ones((TICKS, 4), bool))


def test_a_turn_by_another_curve_teaches_the_curve_and_accuses_nobody():
    """Taken as known, the same turn is a loss of two rotors."""
    out, carries = flown(0.35)
    assert not out.announced.any()
    expo = ASSUMED + 0.35 * carries.s[-1, 0, CURVE]
    assert LINEAR <= expo < 0.25 and carries.P[-1, 0, CURVE, CURVE] < 0.1
    known, _ = flown(0.0)
    assert known.announced.any()


def test_what_no_curve_explains_is_a_loss():
    """Two rotors that make yaw lose as much as a curve could hide in part: its expo stays within 0 and 1."""
    out, carries = flown(0.35, loss=0.4, turn=0.0)
    bent = ASSUMED + 0.35 * carries.s[:, 0, CURVE]
    assert bent.min() > -0.01 and bent.max() < 1.01
    assert out.announced.any() and (out.theta[-1, :2] > 0.2).all() and (out.theta[-1, 2:] < 0.15).all()


def test_hover_teaches_no_curve():
    """Where commands do not stand out nothing is learned, and nothing is less certain."""
    _, carries = flown(0.35, turn=0.0)
    assert abs(carries.s[-1, 0, CURVE]) < 0.2 and carries.P[-1, 0, CURVE, CURVE] > 0.9


def curve_of(carries, k=-1):
    """(mean, variance) of the state after tick k."""
    return carries.s[k, 0, CURVE], carries.P[k, 0, CURVE, CURVE]


def test_the_ground_and_a_weak_rotor_teach_no_curve():
    """The same turn before the flight is judged, and beside a loss that is known."""
    mean, variance = curve_of(flown(0.35, ready=TICKS)[1])
    assert mean == 0.0 and variance == pytest.approx(1.0)
    out, carries = flown(0.35, loss=0.4, fails=100, turns=200, rotors=(0,))
    known = int(np.flatnonzero(out.announced)[0])
    assert 100 < known < 150 and carries.active[199:, 0, 0].all()
    assert curve_of(carries) == pytest.approx(curve_of(carries, 199), abs=1e-6)


def test_what_is_open_of_the_curve_is_open_of_a_loss_as_far_as_the_rotor_still_gives_thrust():
    def open_(loss):
        unknown, known = (flown(sd, loss=loss, turn=0.0, fails=150, rotors=(0,))[0] for sd in (0.35, 0.0))
        assert (unknown.theta[-1, 0] > 0.2) and (known.theta[-1, 0] > 0.2)
        return unknown.theta_sd[-1, 0] - known.theta_sd[-1, 0], unknown.theta[-1, 0]

    part, _ = open_(0.4)
    assert part > 0.02
    none, loss = open_(1.0)
    assert none < part * (1.0 - loss) / 0.4 + 1e-3  # the weaker it is, the further it is commanded along the curve


@pytest.mark.parametrize("share, load, teaches", [(1.0, 1.0, True), (0.0, 1.0, False), (-1.0, 1.0, False), (1.0, 1.7, False)])
def test_the_curve_shows_near_hover_in_what_moves_the_vehicle(share, load, teaches):
    """share: how much of the turn its yaw has been commanded for, less what moves nothing."""
    x, gain, p, memory, seen = np.zeros(THETA + N), N * plant.GAIN_MEAN[2], plant_of(QUAD, DT), Memory(), Seen()
    x[2 * PER_AXIS + GAIN] = gain
    u = np.concatenate([np.ones(N), [0.0, 0.0, 4.0 * share, load * N], np.zeros(5), [2.5, ASSUMED, 0.35, 0.0]])
    now = filled(tick(u, N), wrench=np.array([0.0, 0.0, 4.0 * gain, N]))
    memory.begin(p)
    memory.weigh_inputs(p, now, x.tolist(), room(4), [0.5] * 4, made(Noise, v=KNOWN_NOISE), True, seen)
    assert (seen.curve > 0.5) if teaches else (seen.curve == 0.0)
