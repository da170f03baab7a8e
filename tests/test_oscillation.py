"""Outputs that oscillate: frequency through the aliases of slow logs, axis, the gain to lower; and swings that are flying."""

from dataclasses import replace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch.witnesses import oscillation

END = 60.0
AIR = ((0.0, END),)
QUAD = replace(airframes.named("ardupilot-quad-x"), curve=ThrustCurve(1000.0, 2000.0, 0.5))
GAINS = {"ATC_RAT_RLL_P": 0.135, "ATC_RAT_RLL_D": 0.0036, "ATC_RAT_RLL_FLTD": 20.0, "ATC_ANG_RLL_P": 4.5}


def flight(swing=0.2, hz=8.0, axis=0, outputs_hz=10.0, gyro_hz=25.0, spread=0.0, wanted=0.0, until=END, parameters=None, answers=True):
    """A hover whose outputs swing by `swing` of their range, peak to peak, and whose rates follow. spread: sd of noise beside it, of the
    range; wanted: swing of the attitude setpoint, of that of the attitude; answers: the rates swing at the same frequency."""
    draw = np.random.default_rng(4)

    def wave(time, of=hz):
        return np.where(time < until, np.sin(2 * np.pi * of * time), 0.0)

    time, fast = np.arange(0.0, END, 1 / outputs_hz), np.arange(0.0, END, 1 / gyro_hz)
    B = QUAD.effectiveness()[:3]
    pattern = B[axis] / np.abs(B[axis]).max()
    share = 0.5 + 0.5 * swing * wave(time)[:, None] * pattern + draw.normal(0, spread, (time.size, 1)) * pattern
    rate = np.zeros((fast.size, 3))
    rate[:, axis] = 0.3 * wave(fast, hz if answers else 0.31 * hz) + draw.normal(0, spread + 1e-3, fast.size)

    def attitude(size):
        half = np.radians(size * wave(time)) / 2
        q = np.zeros((time.size, 4))
        q[:, 0], q[:, 1 + axis] = np.cos(half), np.sin(half)
        return Signal(time, q, ("w", "x", "y", "z"), "1")

    signals = {
        "motors": Signal(time, 1000.0 + 1000.0 * share, tuple(f"r{k + 1}" for k in range(4)), "us"),
        "gyro": Signal(fast, rate, ("x", "y", "z"), "rad/s", "FRD"),
        "attitude": attitude(2.0), "attitude_wanted": attitude(2.0 * wanted),
    }  # fmt: skip
    return Flight("test", "ArduPilot", signals, END, parameters=GAINS if parameters is None else parameters)


def reported(until=np.inf, **how):
    return list(oscillation.claims(flight(**how), QUAD, AIR, until))


@pytest.mark.parametrize("hz", [1.5, 3.7, 4.2, 8.0, 12.3, 19.25, 21.4])
def test_the_frequency_is_found_through_the_aliases_of_both_logs(hz):
    (event,) = reported(hz=hz)
    assert event.extra["frequency_hz"] == pytest.approx(hz, abs=0.2)
    assert event.extra["axis"] == "roll" and event.extra["swing"] == pytest.approx(0.2, abs=0.02) and not event.rotors
    assert event.extra["seconds"] == pytest.approx(END - 2 * oscillation.EDGE_S, abs=2.5)
    assert " Hz in roll, for " in event.reason


@pytest.mark.parametrize("axis", [1, 2])
def test_the_axis_is_reported(axis):
    (event,) = reported(axis=axis)
    assert event.extra["axis"] == oscillation.AXES[axis]


@pytest.mark.parametrize("rates", [(250.0, 250.0), (400.0, 1000.0), (6.8, 16.7)])
def test_any_rate_of_the_log(rates):
    (event,) = reported(hz=8.1, outputs_hz=rates[0], gyro_hz=rates[1])
    assert event.extra["frequency_hz"] == pytest.approx(8.1, abs=0.3)


@pytest.mark.parametrize(
    "how",
    [
        {"swing": 0.05}, {"spread": 0.1}, {"answers": False}, {"until": 9.0}, {"hz": 0.7}, {"hz": 1.5, "wanted": 0.8}, {"hz": 55.0},
    ],
    ids=str,
)  # fmt: skip
def test_what_is_no_oscillation(how):
    """Small, broadband, not felt by the vehicle, short, as slow as flying, asked for, or faster than a rotor can follow."""
    assert reported(**how) == []


def test_only_what_came_before_a_fault_is_reported():
    assert reported(until=8.0) == []
    (event,) = reported(until=30.0)
    assert event.detected_s <= 30.0 + oscillation.WINDOW_S


@pytest.mark.parametrize(
    ("parameters", "hz", "gain"),
    [
        ({}, 8.0, "ATC_RAT_RLL_D"), ({"ATC_RAT_RLL_D": 0.001}, 8.0, "ATC_RAT_RLL_P"), ({"ATC_ANG_RLL_P": 9.0}, 1.5, "ATC_ANG_RLL_P"),
        ({"ATC_RAT_RLL_FLTD": 2.0}, 8.0, "ATC_RAT_RLL_P"),
    ],
)  # fmt: skip
def test_the_gain_that_dominates_is_named_with_its_value(parameters, hz, gain):
    (event,) = reported(hz=hz, parameters=GAINS | parameters)
    assert event.extra["gain"] == gain and f"lower {gain} (it is {(GAINS | parameters)[gain]:g})" in event.reason


def test_without_known_gains_the_axis_is_named():
    (event,) = reported(parameters={})
    assert event.extra["gain"] == "the rate gains of roll: D first, then P"
