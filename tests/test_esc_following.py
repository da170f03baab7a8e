"""Rotors whose speed leaves what their command asks for: within samples, the right one, and nobody where the telemetry is at fault."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rotorwatch as rw
from rotorwatch.flight import Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS, LOST
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch.live.esc_notices import Rotors
from rotorwatch.logs import esc_columns
from rotorwatch.witnesses.esc.following import Departure, Follower, sooner
from rotorwatch_lab.simulation import scenario, simulate

DT, ONSET, END = 0.002, 8.0, 10.0
FULL = 2000.0  # rad/s


def motors(seed, n=4):
    """(time, thrust commanded, speed (T, n)) of motors that follow with their lag, slower where nothing but drag slows them, noisy, in a
    flight with steps of all sizes, on a battery that sags."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, END, DT)
    knots = np.arange(0.0, END + 1.0, 0.2)
    thrust = np.stack([np.interp(time, knots, rng.uniform(0.3, 0.42, knots.size)) for _ in range(n)], axis=1)
    for at in rng.uniform(3.0, END, 8):  # and rolls
        rows = slice(int(at / DT), int((at + rng.uniform(0.1, 0.3)) / DT))
        thrust[rows, rng.permutation(n)[: n // 2]] *= rng.uniform(0.1, 2.0)
    goal = FULL * (0.05 + 0.9 * np.sqrt(thrust)) * (1.0 - 0.1 * time / END)[:, None]
    w = np.empty_like(goal)
    w[0] = goal[0]
    for k in range(1, len(time)):
        lag = np.where(goal[k] > w[k - 1], 0.03, 0.045)
        w[k] = w[k - 1] + DT / lag * (goal[k] - w[k - 1])
    return time, thrust, w + rng.normal(0.0, 8.0, w.shape)


def broken(time, w, rotor, how, size):
    """The same speeds with a rotor that stops with a time constant, speeds up by a share, or slows by one."""
    w, later = w.copy(), time >= ONSET
    since = time[later] - ONSET
    change = 1.0 / (1.0 + since / size) if how == "stops" else 1.0 + size * (1.0 - np.exp(-since / 0.02))
    w[later, rotor] *= change
    return w


def followed(time, thrust, speed, hz=500.0, fresh=True):
    """(follower, departures) of reports so often."""
    step = round(1.0 / hz / DT)
    follower = Follower(speed.shape[1])
    time, thrust, speed = (v[::step] for v in (time, thrust, speed))
    return follower, follower.add(time, speed, thrust, np.full(len(time), fresh))


@pytest.mark.parametrize("hz, usual, most", [(500.0, 0.06, 0.13), (100.0, 0.06, 0.13), (50.0, 0.09, 0.15)])
def test_a_rotor_that_stops_or_loses_its_propeller_is_known_within_samples(hz, usual, most):
    late = []
    for seed in range(12):
        time, thrust, w = motors(seed)
        rotor = seed % 4
        for how, size in (("stops", 0.03), ("stops", 0.2), ("speeds up", 0.2), ("slows", -0.25)):
            follower, left = followed(time, thrust, broken(time, w, rotor, how, size), hz)
            first = left[0]
            assert first.rotor == rotor and rotor in follower.gone, (seed, how)
            assert ONSET - 0.02 < first.onset < first.certain
            assert (first.ratio > 1.0) == (how == "speeds up")
            late.append(first.certain - ONSET)
    assert np.median(late) < usual and np.quantile(late, 0.9) < most


def test_rotors_that_follow_are_not_named():
    assert [followed(*motors(seed), hz)[1] for seed in range(100, 115) for hz in (500.0, 50.0, 25.0)] == [[]] * 45


@pytest.mark.parametrize("hz", [500.0, 50.0])
def test_nothing_rests_on_bad_telemetry(hz):
    time, thrust, w = motors(3)
    rng = np.random.default_rng(0)
    frozen, holes, spikes = w.copy(), w.copy(), w.copy()
    rows = (time > ONSET) & (time < ONSET + 0.5)
    frozen[rows, 1] = frozen[np.flatnonzero(rows)[0], 1]
    holes[rows, 2] = np.nan
    at = rng.choice(len(time), 20, replace=False)
    spikes[at[:10], 0], spikes[at[10:], 3] = 0.0, 2.0 * FULL
    for speed in (frozen, holes, spikes, 0.8 * w):
        assert followed(time, thrust, speed, hz)[1] == []
    gap = (time < ONSET) | (time > ONSET + 0.4)
    assert followed(time[gap], thrust[gap], broken(time, w, 0, "speeds up", 0.0)[gap], hz)[1] == []
    assert followed(time, thrust, broken(time, w, 0, "stops", 0.03), hz, fresh=False)[1] == []  # the commands are old
    assert followed(time, thrust, broken(time, w, 0, "stops", 0.03), 15.0)[1] == []  # too slow


def test_a_rotor_that_turns_again_returns():
    time, thrust, w = motors(4)
    stopped = broken(time, w, 2, "stops", 0.03)
    speed = np.where((time < ONSET + 0.3)[:, None], stopped, w)
    follower, left = followed(time, thrust, speed)
    assert [d.rotor for d in left] == [2] and follower.gone == {}


@cache
def flown(kind):
    table = {
        "duration_s": 40.0, "seed": 5, "autopilot": "px4", "airframe": {"frame": "hexa-x"},
        "trajectory": {"kind": "square", "altitude_m": 6.0}, "logging": {"esc": True, "profile": "fast", "raw_hz": 100.0},
        "faults": [{"rotor": 3, "onset_s": 18.0, "kind": kind}],
    }  # fmt: skip
    return simulate(scenario.from_table(table)).flight


@pytest.mark.parametrize("kind, way", [("float", "below"), ("complete loss", "above")])
def test_a_loss_is_announced_when_its_speed_shows_it(kind, way):
    event = next(e for e in rw.diagnose(flown(kind)).events if e.kind == "loss_of_effectiveness")
    assert event.rotors == (3,) and event.detected_s - 18.0 < 0.17 and abs(event.onset_s - 18.0) < 0.16
    assert f"{way} what its command asks for" in event.reason


LEFT = Departure(5, 20.14, 20.16, 0.0, 12.0)


def loss(rotor, alternatives=(), onset=20.2, detected=22.0):
    return Event(LOSS, (rotor,), onset, detected, None, (1.0,), ((0.9, 1.0),), 0.9, alternatives, "it lacks thrust")


def test_a_speed_decides_what_the_motion_leaves_open_or_takes_for_another():
    known = sooner(loss(6), [LEFT])
    assert (known.rotors, known.detected_s, known.onset_s, known.probability) == ((6,), 20.16, 20.14, 0.9)
    either = sooner(loss(5, ((6,),)), [LEFT])
    assert (either.rotors, either.alternatives) == ((6,), ()) and either.probability > 0.99
    other = sooner(loss(5), [LEFT])
    assert other.rotors == (6,) and "while rotor 5 turns as commanded" in other.reason
    fallen = sooner(replace(loss(5), kind=LOST), [LEFT])
    assert (fallen.rotors, fallen.detected_s) == ((6,), 22.0)


def test_a_speed_changes_no_loss_that_it_does_not_contradict():
    both = [LEFT, Departure(4, 20.3, 20.32, 0.2, 9.0)]
    assert sooner(loss(5), both).rotors == (5,)  # its own speed left as well
    faster = LEFT._replace(ratio=1.15)  # other rotors speed up in a fall, too
    for event, left in ((loss(5), faster), (loss(5, onset=18.0), LEFT), (loss(6, detected=20.1), LEFT)):
        assert sooner(event, [left]) is event
    assert sooner(replace(loss(6), kind=LOST), [LEFT]).reason == "it lacks thrust"


def test_a_link_tells_it():
    time, thrust, w = motors(6)
    speed, rotors, said = broken(time, w, 3, "stops", 0.05), Rotors(), []
    for k in range(0, len(time) - 10, 10):
        rows = slice(k, k + 10)
        esc = esc_columns.build(time[rows][::5], {"speed": speed[rows][::5]}, range(1, 5), "link", [])
        sent = Signal(time[rows], thrust[rows], ("r1", "r2", "r3", "r4"), "1")
        said += [(time[k + 9], *one) for one in rotors.examine(esc, sent, True, ThrustCurve(0.0, 1.0, 0.0))]
    at, rotor, text = said[0]
    assert rotor == 4 and ONSET < at < ONSET + 0.13 and "below what its command asks for" in text
    assert {r for _, r, _ in said} == {4}
