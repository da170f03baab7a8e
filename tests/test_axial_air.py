"""Air along the thrust axis: what it takes is a state of the default estimator, and no rotor's loss; a loss in it has its size."""

from functools import cache

import numpy as np
import pytest
from tests.plain import measured
from tests.plain import plant as plant_of

from rotorwatch.engine.estimator import plant
from rotorwatch.engine.estimator.plant import AIR
from rotorwatch.engine.intake.ticks import ASSESS, LEARN
from test_default_estimator import DT, EXPO, FULL, KNOWN_NOISE, make
from test_plant import QUAD

N, TICKS, READY = 4, 500, 100
CLIMBS = 160  # tick at which it first climbs


@cache
def flown(takes, loss=0.0, fails=TICKS, known=True, wash=0.0, lean=0.0, seed=0):
    """(outputs, carries) of a flight that hovers and then climbs and sinks with 4 m/s in turns of 3 s; air takes `takes` of the thrust for
    each m/s. From tick `fails` on rotor 1 lacks `loss`, made up for at once. known: velocity and attitude are logged. wash: share of its
    thrust by which each rotor varies in its own wake. lean: roll and pitch [hover thrusts] that come with each m/s."""
    quad, rng, when = make("ardupilot-quad-x"), np.random.default_rng(seed), np.arange(TICKS)
    going = (when >= CLIMBS) * np.sign(np.sin((when - CLIMBS) * np.pi / 60.0))
    axial = np.convolve(4.0 * going, np.ones(16) / 16.0, "same")
    load = 1.0 + np.gradient(axial, DT) / 9.80665
    wrench = np.column_stack([-lean * axial, lean * axial, np.zeros(TICKS), N * (load + takes * axial)])
    wrench += wash * (axial < -1.0)[:, None] * rng.standard_normal((TICKS, N)) @ QUAD.T
    weak = QUAD * np.array([1.0 - loss, 1.0, 1.0, 1.0])
    given = np.where((when >= fails)[:, None], wrench @ np.linalg.inv(weak).T, wrench @ np.linalg.inv(QUAD).T)
    y = given @ QUAD.T + np.sqrt(KNOWN_NOISE[0]) * rng.standard_normal((TICKS, 4))
    zeros, side = np.zeros((TICKS, 3)), np.zeros((TICKS, 2))
    curve = np.full(TICKS, EXPO), np.zeros(TICKS)
    mode = np.where(when < READY, LEARN, ASSESS)
    air = axial if known else np.full(TICKS, np.nan)
    u = np.column_stack([given, zeros, N * load, zeros, side, np.full(TICKS, FULL), *curve, air, mode, when == 0])
    return quad.over(u.astype(float), y, np.ones((TICKS, 4), bool))


@pytest.mark.parametrize("takes", [0.0, 0.05, 0.09])
def test_the_first_climb_teaches_what_air_takes_and_accuses_nobody(takes):
    """0 to a tenth of the thrust for each m/s: as vehicles differ."""
    out, carries = flown(takes)
    assert not out.announced.any()
    k, variance = carries.s[:, 0, AIR], carries.P[:, 0, AIR, AIR]
    assert k[-1] == pytest.approx(takes, abs=0.01) and variance[-1] < 0.01**2
    assert k[CLIMBS - 10] == pytest.approx(plant.INFLOW, abs=0.005)  # hover shows nothing of it
    assert variance[CLIMBS - 10] == pytest.approx(plant.INFLOW_SD**2, rel=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_unsteady_thrust_in_descents_accuses_nobody(seed):
    """Each rotor by itself, in its own wake."""
    assert not flown(0.05, wash=0.15, seed=seed)[0].announced.any()


@pytest.mark.parametrize("fails", [130, 340])
def test_a_loss_in_hover_or_in_a_climb_has_its_size(fails):
    """Before the first climb, and in the middle of the second one."""
    out, _ = flown(0.08, loss=0.3, fails=fails)
    assert out.announced.any() and np.flatnonzero(out.announced)[0] >= fails
    assert out.theta[-1] == pytest.approx([0.3, 0.0, 0.0, 0.0], abs=0.03)


def test_air_from_above_gives_no_thrust():
    """Wind that is not known may look so: as far as it does, it is a disturbance."""
    _, carries = flown(-0.08)
    assert carries.s[:, 0, AIR].min() > -1e-9


def test_where_velocity_is_not_logged_nothing_is_learned():
    _, carries = flown(0.05, known=False)
    assert carries.s[-1, 0, AIR] == pytest.approx(plant.INFLOW, abs=1e-9)
    assert carries.P[-1, 0, AIR, AIR] == pytest.approx(plant.INFLOW_SD**2)


def test_what_air_takes_is_thrust_alone_and_nothing_where_its_speed_is_not_known():
    p = plant_of(QUAD)
    u = np.concatenate([np.ones(N), np.zeros(3), [N], np.zeros(5), [FULL, EXPO, 0.0, -2.0]])
    assert measured(p, u)[0][:, AIR] == pytest.approx([0.0, 0.0, 0.0, -2.0 * N])
    u[-1] = np.nan
    assert not measured(p, u)[0][:, AIR].any()
