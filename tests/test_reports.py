"""What the autopilot itself wrote in flight, and logs that end in the air."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import hexa_event
from rotorwatch.answer import story
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.kinds import LOST, REPORTED
from rotorwatch.witnesses import reports

AIR = ((5.0, 60.0),)
LANDED = Message(60.2, "armed", "disarmed", 0.0)


def flight(*messages, duration=70.0, signals=None, parameters=None):
    said = tuple(sorted((*messages, LANDED), key=lambda m: m.time)) if duration > 61.0 else messages
    return Flight("test", "ArduPilot", signals or {}, duration, parameters=parameters or {}, messages=said)


@pytest.mark.parametrize(
    ("kind", "text", "trouble"),
    [
        ("error", "battery failsafe: error 1", "battery"), ("text", "Battery 1 is low 10.43V used 1033 mAh", "battery"),
        ("text", "[commander] Low battery level! Return advised", "battery"), ("error", "radio failsafe: error 1", "radio"),
        ("text", "Manual control lost", "radio"), ("error", "GPS: error 2", "position"),
        ("text", "GPS Glitch or Compass error", "position"),
        ("text", "EKF3 lane switch 1", "estimator"), ("error", "estimator failsafe: error 1", "estimator"),
        ("error", "compass: error 2", "compass"), ("error", "crash check: error 1", "crash"),
        ("text", "Crash: Disarming: AngErr=41>30, Accel=1.2<3.0", "crash"), ("error", "vibration: error 1", "vibration"),
        ("error", "IMU failure 8", "imu"),
    ],
)  # fmt: skip
def test_a_trouble_is_told_once_at_its_first_report(kind, text, trouble):
    (event,) = reports.claims(flight(Message(31.2, kind, text), Message(33.0, kind, text)), AIR)
    assert event.kind == REPORTED and event.onset_s == 31.2 and event.extra["trouble"] == trouble and not event.rotors
    assert text in event.reason and "1 more" in event.reason


@pytest.mark.parametrize(
    ("text", "late_s"), [("battery failsafe: error 1", reports.LATE_S), ("crash check: error 1", reports.CRASHED_S)]
)
def test_what_ended_a_flight_is_written_down_a_moment_later(text, late_s):
    """A crash check looks for seconds whether the vehicle lies on its side."""
    assert len(reports.claims(flight(Message(60.0 + 0.9 * late_s, "error", text)), AIR)) == 1
    assert reports.claims(flight(Message(60.0 + 1.1 * late_s, "error", text)), AIR) == ()


@pytest.mark.parametrize(
    ("time", "text"),
    [
        (2.0, "EKF3 lane switch 1"), (66.0, "GPS Glitch or Compass error"), (20.0, "EKF3 IMU0 MAG0 in-flight yaw alignment complete"),
        (20.0, "GPS Glitch cleared"), (20.0, "EKF Failsafe Cleared"), (20.0, "GPS 1: detected as u-blox at 230400 baud"),
        (20.0, "battery failsafe: resolved"), (20.0, "PreArm: Compass calibrated requires reboot"),
    ],
)  # fmt: skip
def test_what_is_no_trouble_or_not_of_the_flight_is_not_told(time, text):
    assert reports.claims(flight(Message(time, "text", text)), AIR) == ()


def test_a_log_ends_in_the_air_where_nothing_comes_after_its_flight():
    (said,) = reports.end(flight(duration=60.3), AIR)
    assert "ends in the air at 60.0 s" in said
    assert reports.end(flight(LANDED, duration=60.3), AIR) == () == reports.end(flight(), AIR)
    assert reports.end(flight(duration=60.3), ()) == ()


def sagging(least, **limits):
    time = np.arange(0.0, 70.0, 0.5)
    volts = np.where((time > 30.0) & (time < 40.0), least, 12.2)
    battery = Signal(time, volts[:, None], ("voltage",), "V")
    return reports.claims(flight(signals={"battery": battery}, parameters=limits), AIR)


def test_a_voltage_below_the_autopilots_own_limit_is_told_with_both():
    (event,) = sagging(9.6, BATT_LOW_VOLT=10.5)
    assert event.extra["trouble"] == "battery" and abs(event.onset_s - 30.0) < 1.0
    assert "9.6 V" in event.reason and "BATT_LOW_VOLT allows (10.5 V)" in event.reason
    (event,) = sagging(10.0, BAT1_V_EMPTY=3.6, BAT1_N_CELLS=3.0)
    assert "10.8 V" in event.reason
    assert sagging(10.6, BATT_LOW_VOLT=10.5) == () == sagging(9.6) == sagging(9.6, BATT_LOW_VOLT=0.0)


def test_the_story_of_a_fall_has_it_in_its_place():
    lost = hexa_event(
        kind=LOST, rotors=(), loss=(), interval=(), onset_s=31.0, detected_s=31.5, extra={"cause": "controller"}
    )
    (told,) = reports.claims(flight(Message(30.2, "text", "EKF3 lane switch 1")), AIR)
    lines = story.narrate((told, lost), None, 6, hops=AIR)
    assert [line.time_s for line in lines] == sorted(line.time_s for line in lines)
    assert any("doubted its own estimate" in line.text and line.time_s == 30.2 for line in lines)
    assert len(lines) == 1 + len(story.narrate((replace(lost),), None, 6, hops=AIR))
