"""Outputs that a log has missed: what all of them repeat while others must have flown the vehicle."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import diagnose, read
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.missed import without_missed
from rotorwatch_lab.simulation import scenario, simulate

REAL = Path(__file__).parents[1] / "../shared/flights/ardupilot-real-rrc"


@cache
def flown(kind="square", wind=4.0, fault=0.0):
    table = {"duration_s": 60.0, "seed": 3, "airframe": {"frame": "quad-x"}, "wind": {"speed_m_s": wind}}
    table["trajectory"] = {"kind": kind, "land": False}
    table["faults"] = [{"kind": "loss", "rotor": 2, "onset_s": 40.0, "strength": fault}] if fault else []
    return simulate(scenario.from_table(table)).flight


def held(flight, start, seconds, columns: slice | list[int] = slice(None)):
    """From `start` s on the outputs repeat."""
    motors = flight["motors"]
    values, still = motors.values.copy(), (motors.time >= start) & (motors.time < start + seconds)
    values[still, columns] = values[np.argmax(still), columns]
    return replace(flight, signals={**flight.signals, "motors": replace(motors, values=values)})


def without_control(flight):
    return replace(flight, signals={name: signal for name, signal in flight.signals.items() if name != "control"})


def missed(flight):
    """(n,) bool: outputs that are taken for missed."""
    return ~without_missed(flight, airborne(flight))["motors"].valid.all(axis=1)


@pytest.mark.parametrize("seconds", [1.0, 3.0])
@pytest.mark.parametrize("start", [18.0, 31.0, 47.0])
def test_what_repeats_is_not_known(start, seconds):
    time, found = flown()["motors"].time, missed(held(flown(), start, seconds))
    assert (found <= ((time > start) & (time < start + seconds))).all()
    assert found.sum() >= 0.8 * seconds * flown()["motors"].rate_hz


def test_without_the_rate_controller_the_motion_tells():
    """Where the vehicle turns as elsewhere; what rests in a dead calm was not missed."""
    time, flight = flown()["motors"].time, without_control(flown())
    found = missed(held(flight, 33.0, 3.0))
    assert found.sum() >= 0.8 * 3.0 * flight["motors"].rate_hz and (found <= ((time > 33.0) & (time < 36.0))).all()
    assert not missed(flight).any() and not missed(without_control(flown("hover", 0.0))).any()


def test_motors_at_idle_may_rest_while_the_vehicle_turns_over():
    flight = without_control(flown())
    motors = flight["motors"]
    values, idle = motors.values.copy(), (motors.time > 33.0) & (motors.time < 34.5)
    values[idle] = 1150.0
    assert not missed(replace(flight, signals={**flight.signals, "motors": replace(motors, values=values)})).any()


@pytest.mark.parametrize("start", [20.0, 33.0, 46.0])
def test_a_healthy_flight_stays_healthy_and_says_what_is_missing(start):
    found = diagnose(held(flown(), start, 3.0))
    assert found.verdict == "healthy", found.reason
    assert any(f"all outputs repeat from {start:.1f} to" in w for w in found.warnings)


def test_a_loss_after_outputs_that_were_missed_is_found():
    found = diagnose(held(flown(fault=0.35), 32.0, 3.0))
    assert found.verdict == "fault" and [e.rotors for e in found.events] == [(2,)]


def test_outputs_that_rest_because_nothing_was_asked_of_them_were_not_missed():
    """In a dead calm, and on the ground; nor is an output that is stuck, or a log that repeats all the time."""
    flight = flown("hover", 0.0)
    assert without_missed(flight, airborne(flight)) is flight
    control = flight["control"]
    values = control.values.copy()
    calm = (control.time > 25.0) & (control.time < 29.0)
    values[calm] = values[np.argmax(calm)]
    resting = held(replace(flight, signals={**flight.signals, "control": replace(control, values=values)}), 25.2, 3.0)
    assert not missed(resting).any()
    assert not missed(held(flown(), 20.0, 3.0, columns=[1])).any()
    often = flown()
    for start in np.arange(8.0, 56.0, 2.0):
        often = held(often, start, 1.0)
    assert not missed(often).any()


@pytest.mark.skipif(not REAL.is_dir(), reason="the shared test flights are not beside the repository")
@pytest.mark.parametrize("name", ["good_prop_hover_2", "good_prop_straight_line_2"])
def test_outputs_of_a_real_flight_that_repeat_or_are_coarse(name):
    flight = read(REAL / f"{name}.bin.xz")
    start = airborne(flight)[0][0]
    motors = flight["motors"]
    coarse = replace(motors, values=25.0 * np.round(motors.values / 25.0))
    for changed in (held(flight, start + 20.0, 3.0), replace(flight, signals={**flight.signals, "motors": coarse})):
        found = diagnose(changed)
        wind = "of one rotor could have gone undetected" in found.headline  # 21 and 20 %
        assert (found.verdict == "healthy" or wind) and not [e for e in found.events if e.rotors]
