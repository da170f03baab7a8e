"""Knocks: what rotors cannot make is an event of its own, and no rotor is accused on what follows."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import diagnose
from rotorwatch.base.compiling.running import Rows
from rotorwatch.engine.intake import contact as definition
from rotorwatch.engine.intake import sense
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.motion import knocks
from rotorwatch_lab.simulation import scenario, simulate

WILD = Path(__file__).resolve().parents[2] / "shared" / "flights" / "wild"
DT, T, N = 0.1, 200, 4
TIME = DT * np.arange(T)


def struck(side=None, load=None, rate_dot=None, thrust=None, torque=None, shake=0.0):
    """(T,) which ticks were hit, and the contacts: front.contact.Contact over the ticks of a made-up flight."""
    side, load = np.zeros((T, 2)) if side is None else side, np.ones(T) if load is None else load
    thrust, zeros = np.ones((T, N)) if thrust is None else thrust, np.zeros((T, 3))
    torque, rate_dot = zeros if torque is None else torque, zeros if rate_dot is None else rate_dot
    state, craft, back = definition.Contact(), Vehicle(), knocks.look_back(DT)
    craft.rotors = N
    touches = []
    for k in range(T):
        shove, touch = definition.Shove(), definition.Touch()
        shove.time, shove.load, shove.shake, shove.fresh, shove.accelerometer = TIME[k], load[k], shake, True, True
        shove.forward, shove.right = side[k]
        shove.thrust[:N], shove.torque[:], shove.rate_dot[:] = thrust[k], torque[k], rate_dot[k]
        state.tick(craft, shove, back, touch)
        touches.append(touch)
    hit = np.array([touch.hit for touch in touches])
    return hit, knocks.contacts(Rows(definition.Touch, None, touches))


@settings(max_examples=trials(40), deadline=None)
@given(
    drag=st.floats(0.0, 0.45), wave=st.floats(0.1, 2.0), climb=st.floats(-0.5, 0.5), turn=st.floats(-15.0, 15.0), loss=st.floats(0.0, 1.0)
)
def test_flying_is_no_contact(drag, wave, climb, turn, loss):
    """Drag that comes and goes with speed, climbs that were commanded, a rotor that stops, turns within what any vehicle can."""
    swing = np.sin(2 * np.pi * wave * TIME / 10.0)
    side = knocks.G0 * drag * np.stack([swing, np.zeros(T)], axis=1)
    load = 1.0 + climb * (TIME > 10.0)
    thrust = np.repeat(load[:, None], N, axis=1)
    load = load - loss / N * (TIME > 15.0)
    rate_dot = turn * np.stack([swing, -swing, 0.2 * swing], axis=1)
    hit, found = struck(side, load, rate_dot, thrust)
    assert not hit.any() and found == ()


@settings(max_examples=trials(40), deadline=None)
@given(turn=st.floats(0.0, 15.0), falls_turning=st.floats(0.0, 4.5))
def test_a_vehicle_whose_motors_are_cut_in_the_air_is_not_struck(turn, falls_turning):
    """Motors that run down turn it for a tick or two, and then the air does, gently: no rotor is commanded to, and nothing struck it."""
    cut = TIME > 10.0
    thrust, load = np.where(cut, 0.0, 1.0)[:, None].repeat(N, axis=1), np.where(cut, 0.1, 1.0)
    rate_dot = np.where(cut, np.where(TIME < 10.25, turn, falls_turning), 0.0)[:, None] * [1.0, -1.0, 0.1]
    hit, found = struck(None, load, rate_dot, thrust)
    assert not hit.any() and found == ()


@pytest.mark.parametrize(
    "what, axis, size", [("sideways", 0, 8.0), ("sideways", 1, -20.0), ("upwards", 0, 1.2), ("turned", 2, 60.0), ("turned", 0, 900.0)]
)
def test_what_rotors_cannot_make(what, axis, size):
    side, load, rate_dot = np.zeros((T, 2)), np.ones(T), np.zeros((T, 3))
    k = 120
    rate_dot[k, 1] = 8.0
    if what == "sideways":
        side[k, axis] = size
    elif what == "upwards":
        load[k] += size
    else:
        rate_dot[k, axis] = size
    hit, (one,) = struck(side, load, rate_dot)
    assert np.flatnonzero(hit).tolist() == [k]
    assert one.time == pytest.approx(TIME[k]) and what in one.what and one.size > 0


def shaken(time, force):
    """Vibration of samples (n, 3), m/s^2, as front.sense follows it."""
    state = sense.Sense()
    for t, row in zip(time.tolist(), force.tolist()):
        state.accel(t, *row)
    state._shake(math.inf)
    return state.vibration.rms()


def test_vibration_is_the_deviation_from_the_mean_of_the_half_second_before():
    """The first sample deviates from nothing; of a step, each sample deviates from what came before; what knocks add is cut off at g."""
    assert shaken(np.arange(3) * 0.1, np.array([[0.0, 0.0, -9.8]] * 3)) == 0.0
    time = np.arange(10) * 0.2  # two samples in the half second before
    step = np.repeat([0.0, 3.0], 5)[:, None] * [1.0, 0.0, 0.0]
    assert shaken(time, step) == pytest.approx(math.sqrt((3.0**2 + 1.5**2) / 10))
    assert shaken(time, 1000.0 * step) == pytest.approx(math.sqrt(2 * knocks.G0**2 / 10))


def test_vibration_is_that_of_numpy_whatever_comes():
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.uniform(0.001, 0.02, 2000))
    force = rng.standard_normal((2000, 3)) * np.where(rng.random((2000, 1)) > 0.99, 30.0, 1.0) + [0.0, 0.0, -9.8]
    squares = [0.0]
    for k in range(1, 2000):
        before = force[np.searchsorted(time, time[k] - sense.BEFORE_S) : k]
        squares.append(min(float(((force[k] - before.mean(axis=0)) ** 2).sum()), knocks.G0**2))
    assert shaken(time, force) == pytest.approx(math.sqrt(np.mean(squares)), rel=1e-9)


def test_vibration_is_no_knock():
    """Sampled slowly it looks like a push as large as itself; the same push in calm air is one."""
    rng = np.random.default_rng(2)
    time = np.arange(0.0, 20.0, 0.04)
    force = np.stack([6.0 * np.sin(2 * np.pi * 27.0 * time), *rng.standard_normal((2, time.size))], axis=1)
    assert 3.0 < shaken(time, force) < 8.0
    side = np.zeros((T, 2))
    side[120:123, 0] = 6.0
    turning = np.full((T, 3), 8.0)
    assert not struck(side, rate_dot=turning, shake=4.0)[0].any() and struck(side, rate_dot=turning)[0].any()
    assert not struck(side)[0].any()  # what shakes does not turn


def test_motors_that_are_cut_push_nothing():
    """Commands end at once, thrust a little later: more load than was commanded is no push from below."""
    thrust = np.repeat(np.where(TIME > 10.0, 0.1, 1.0)[:, None], N, axis=1)
    load = np.where(TIME > 10.25, 0.1, 1.0)
    assert not struck(load=load, thrust=thrust)[0].any()


def test_knocks_close_together_are_one():
    side = np.zeros((T, 2))
    side[[100, 103, 150], 0] = 9.0, 15.0, 8.0
    _, found = struck(side, rate_dot=np.full((T, 3), 8.0))
    assert [round(c.time, 1) for c in found] == [10.0, 15.0]
    assert found[0].size == pytest.approx(15.0 / knocks.G0, rel=0.2)


@cache
def flown(faults=()):
    made = simulate(
        scenario.from_table(
            {
                "duration_s": 60.0,
                "seed": 11,
                "airframe": {"frame": "quad-x"},
                "trajectory": {"kind": "hover", "land": False},
                "wind": {"speed_m_s": 2.0},
                "faults": [dict(f) for f in faults],
            }
        )
    )
    return made.flight


def knocked(flight, time, shift=0.25, sideways=20.0):
    """The flight with a push at `time` that tilts it, after which its first rotor needs more: an arm was bent."""
    accel, gyro, motors = flight["accel"], flight["gyro"], flight["motors"]
    rate = gyro.values.copy()
    rate[(gyro.time >= time) & (gyro.time < time + 0.15), 0] += 0.1 * sideways
    force = accel.values.copy()
    force[(accel.time >= time) & (accel.time < time + 0.1), 0] += sideways
    values = motors.values.copy()
    values[motors.time >= time, 0] += 150.0 * shift
    changed = {"accel": replace(accel, values=force), "gyro": replace(gyro, values=rate), "motors": replace(motors, values=values)}
    return replace(flight, signals={k: changed.get(k, v) for k, v in flight.signals.items() if k not in ("control", "rates")})


def test_no_rotor_is_accused_on_the_after_effects_of_a_knock():
    answer = diagnose(knocked(flown(), 30.0))
    assert [e.kind for e in answer.events] == ["contact"]
    (event,) = answer.events
    assert abs(event.onset_s - 30.0) < 0.3 and event.rotors == () and event.extra["size"] > 1.0
    assert answer.verdict == "healthy"
    # The same shift without the push is a loss: the test above can fail.
    accused = diagnose(knocked(flown(), 30.0, sideways=0.0))
    assert accused.verdict == "fault" and accused.events[0].rotors == (1,)


def test_a_loss_long_after_a_knock_is_found_and_one_before_it_stays():
    loss = (("kind", "loss"), ("rotor", 2), ("onset_s", 45.0), ("strength", 0.4))
    answer = diagnose(knocked(flown((loss,)), 25.0))
    assert [e.rotors for e in answer.events] == [(), (2,)]
    early = (("kind", "loss"), ("rotor", 2), ("onset_s", 25.0), ("strength", 0.4))
    answer = diagnose(knocked(flown((early,)), 40.0, shift=0.0))
    event = next(e for e in answer.events if e.rotors)
    assert event.rotors == (2,) and event.end_s is None and event.loss[0] == pytest.approx(0.4, abs=0.06)
    assert answer.rotors[1].loss == pytest.approx(0.4, abs=0.06)


def test_an_announcement_that_a_knock_cut_short_keeps_its_size():
    """Reported at 25.3 s, not yet part of the filter when the vehicle hits something half a second later."""
    early = (("kind", "loss"), ("rotor", 2), ("onset_s", 25.0), ("strength", 0.5))
    quiet = next(e for e in diagnose(flown((early,))).events if e.rotors)
    answer = diagnose(knocked(flown((early,)), quiet.detected_s + 0.6, shift=0.0))
    event = next(e for e in answer.events if e.rotors)
    assert event.rotors == (2,) and event.loss[0] == pytest.approx(0.5, abs=0.15) and event.probability > 0.5


@pytest.mark.skipif(not WILD.is_dir(), reason="the shared test flights are not beside the repository")
@pytest.mark.parametrize("name", ["knock-1", "knock-2", "knock-3", "knock-scale-1", "knock-scale-2", "obstacle-scale-1", "ground-1"])
def test_knocks_in_logs_of_others(name):
    answer = diagnose(WILD / f"{name}.bin.xz")
    assert (answer.verdict != "fault" and any(e.kind == "contact" for e in answer.events)) or answer.verdict == "inconclusive"
