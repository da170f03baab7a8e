"""A thrust curve that is not known: noise where commands leave the usual ones, and no rotor's loss."""

from functools import cache

import numpy as np
import pytest
from tests.plain import filled, made, room, tick
from tests.plain import plant as plant_of

from rotorwatch.engine.estimator import plant
from rotorwatch.engine.estimator.model_error import Memory, Seen
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import THETA
from rotorwatch.engine.intake.ticks import ASSESS, LEARN
from rotorwatch.flight.vehicle import ThrustCurve
from test_default_estimator import DT, KNOWN_NOISE, make
from test_plant import QUAD

N, TICKS, READY = 4, 400, 60
HOVER = 0.45  # command that carries the vehicle
ASSUMED = 0.65


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
    `turn` rad/s^2 and back, and from tick `fails` on rotors without so much of their thrust, made up for at once. Assessed from `ready`
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
    mode = np.where(when < ready, LEARN, ASSESS)
    motion = [zeros, yaw, np.full(TICKS, float(N)), zeros, rates, zeros]
    u = np.column_stack([thrust, *motion, full, np.full(TICKS, ASSUMED), np.full(TICKS, sd), np.full(TICKS, np.nan), mode, when == 0])
    return quad.over(u.astype(float), y, np.ones((TICKS, 4), bool))


def test_a_turn_by_another_curve_accuses_nobody():
    """Taken as known, the same turn is a loss of two rotors."""
    assert not flown(0.35)[0].announced.any()
    assert flown(0.0)[0].announced.any()


def test_what_no_curve_explains_is_a_loss():
    """Two rotors that make yaw lose as much as a curve could hide in part."""
    out, _ = flown(0.35, loss=0.4, turn=0.0)
    assert out.announced.any() and (out.theta[-1, :2] > 0.2).all() and (out.theta[-1, 2:] < 0.15).all()


def test_what_is_open_of_the_curve_is_open_of_a_loss_as_far_as_the_rotor_still_gives_thrust():
    def open_(loss):
        unknown, known = (flown(sd, loss=loss, turn=0.0, fails=150, rotors=(0,))[0] for sd in (0.35, 0.0))
        assert (unknown.theta[-1, 0] > 0.2) and (known.theta[-1, 0] > 0.2)
        return unknown.theta_sd[-1, 0] - known.theta_sd[-1, 0], unknown.theta[-1, 0]

    part, _ = open_(0.4)
    assert part > 0.02
    none, loss = open_(1.0)
    assert none < part * (1.0 - loss) / 0.4 + 1e-3  # the weaker it is, the further it is commanded along the curve


def test_the_error_of_the_curve_is_noise_where_commands_leave_the_usual_ones():
    """Against the change of the wrench by another expo, of commands that turn the vehicle; in hover it is nothing."""
    p, noise = plant_of(QUAD, DT), made(Noise, v=KNOWN_NOISE)

    def variance(thrust, sd):
        memory, seen, found = Memory(), Seen(), room(4)
        now = filled(tick(row(thrust, ASSUMED, sd), N), wrench=QUAD @ thrust, valid=[True] * 4)
        memory.begin(p)
        memory.weigh_inputs(p, now, [0.0] * (THETA + N), room(4), noise, True, seen)
        seen.thrust = list(thrust)
        memory.variance(p, now, seen, [0.0] * (THETA + N), 1.0, noise, found)
        memory.variance(p, now, seen, [0.0] * (THETA + N), 1.0, noise, found)  # the wrench has been the same
        return np.array(found)

    turning = np.array([1.6, 1.6, 0.4, 0.4])
    bends = room(N)
    plant.bend(p, tick(row(turning, ASSUMED, 0.35), N), turning.tolist(), 1.0, bends)
    wanted = (QUAD @ np.array(bends)) ** 2
    np.testing.assert_allclose(variance(turning, 0.35) - variance(turning, 0.0), wanted, atol=1e-9)
    assert wanted[2] > 0.02
    np.testing.assert_allclose(variance(np.ones(N), 0.35), variance(np.ones(N), 0.0), atol=1e-9)
