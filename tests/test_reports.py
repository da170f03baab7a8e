"""What the autopilot itself wrote in flight, and logs that end in the air."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import hexa_diagnosis, hexa_event
from rotorwatch.answer import falls, story
from rotorwatch.flight import Flight, Message, Signal, kinds
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
        ("error", "IMU failure 8", "imu"), ("error", "estimator core: error 1", "estimator"),
        ("text", "Potential Thrust Loss (3)", "motor"), ("error", "failure detector: motor", "motor"),
        ("text", "[health_and_arming_checks] Preflight Fail: Attitude failure (roll)", "attitude"),
        ("error", "battery warning: critical", "battery"), ("text", "Radio Failsafe", "radio"), ("error", "failsafe: landing", "radio"),
        ("event", "disarmed: crash protection", "stopped"), ("event", "disarmed: radio failsafe", "stopped"),
        ("event", "emergency stop of the motors", "stopped"),
        ("text", "[commander] Kill-switch engaged", "stopped"), ("error", "local position invalid", "position"),
        ("error", "ground station failsafe: error 1", "link"), ("text", "Accel 0 clipping, not safe to fly!", "vibration"),
        ("text", "Yaw Imbalance 38%", "yaw"), ("event", "failsafe begins", "failsafe"), ("error", "internal: error 1", "internal"),
    ],
)  # fmt: skip
def test_a_trouble_is_reported_once_at_its_first_report(kind, text, trouble):
    (event,) = reports.claims(flight(Message(31.2, kind, text), Message(33.0, kind, text)), AIR)
    assert event.kind == REPORTED and event.onset_s == 31.2 and event.extra["trouble"] == trouble and not event.rotors
    assert text in event.reason and "1 more" in event.reason


@pytest.mark.parametrize(("text", "late_s"), [("battery failsafe: error 1", reports.LATE_S), ("crash check: error 1", reports.CRASHED_S)])
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
        (20.0, "Radio Failsafe - Cleared"), (20.0, "failsafe: over"), (20.0, "failsafe: signal back"), (60.0, "disarmed: switch"),
        (60.0, "disarmed: disarm delay"),
        (60.0, "disarmed: sticks"), (60.0, "disarmed: landing"), (20.0, "rotorwatch: rotor 3 lost 35 % (19-52)"),
    ],
)  # fmt: skip
def test_what_is_no_trouble_or_not_of_the_flight_is_not_reported(time, text):
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


def test_a_voltage_below_the_autopilots_own_limit_is_reported_with_both():
    (event,) = sagging(9.6, BATT_LOW_VOLT=10.5)
    assert event.extra["trouble"] == "battery" and abs(event.onset_s - 30.0) < 1.0
    assert "9.6 V" in event.reason and "below BATT_LOW_VOLT (10.5 V)" in event.reason
    (event,) = sagging(10.0, BAT1_V_EMPTY=3.6, BAT1_N_CELLS=3.0)
    assert "10.8 V" in event.reason
    assert sagging(10.6, BATT_LOW_VOLT=10.5) == () == sagging(9.6) == sagging(9.6, BATT_LOW_VOLT=0.0)


def test_the_story_of_a_fall_has_it_in_its_place():
    lost = hexa_event(kind=LOST, rotors=(), loss=(), interval=(), onset_s=31.0, detected_s=31.5, extra={"cause": "controller"})
    (reported,) = reports.claims(flight(Message(30.2, "text", "EKF3 lane switch 1")), AIR)
    lines = story.narrate((reported, lost), None, 6, hops=AIR)
    assert [line.time_s for line in lines] == sorted(line.time_s for line in lines)
    assert any("reported an estimator fault" in line.text and line.time_s == 30.2 for line in lines)
    assert len(lines) == 1 + len(story.narrate((replace(lost),), None, 6, hops=AIR))


def test_the_autopilots_own_words_are_quoted_where_it_has_some():
    reported = flight(Message(30.0, "error", "radio: error 2"), Message(30.1, "text", "Radio Failsafe"))
    assert '"Radio Failsafe", and 1 more' in reports.claims(reported, AIR)[0].reason


def test_a_part_that_is_not_there_is_not_lost():
    """A vehicle without a radio says from the start that it is not well."""
    health = [Message(t, "health", f"radio {'un' * ill}healthy", float(ill)) for t, ill in ((1.0, 1), (30.0, 1))]
    assert reports.claims(flight(*health), AIR) == ()
    lost = [Message(t, "health", f"radio {'un' * ill}healthy", float(ill)) for t, ill in ((1.0, 0), (30.0, 1))]
    assert [e.onset_s for e in reports.claims(flight(*lost), AIR)] == [30.0]


TIME = np.arange(0.0, 70.0, 0.2)


def limited(name, values, autopilot="ArduPilot", lost=()):
    """What is reported of a signal that is compared with limits."""
    values = np.asarray(values, float).reshape(TIME.size, -1)
    columns = {"innovations": ("velocity", "position", "height", "compass")}.get(name, ("level",))
    one = Signal(TIME, np.broadcast_to(values, (TIME.size, len(columns))), columns, "1")
    return reports.claims(replace(flight(signals={name: one}), autopilot=autopilot), AIR, lost)


@pytest.mark.parametrize(("autopilot", "limit"), [("ArduPilot", 30.0), ("PX4", 9.81)])
def test_vibration_beyond_the_autopilots_limit(autopilot, limit):
    during = (TIME > 20.0) & (TIME < 26.0)
    (event,) = limited("vibration", np.where(during, 1.2 * limit, 0.5 * limit), autopilot)
    assert event.extra["trouble"] == "vibration" and abs(event.onset_s - 20.0) < 0.3 and f"{limit:.3g} m/s" in event.reason
    assert limited("vibration", np.where(during, 0.95 * limit, 1.0), autopilot) == ()
    knock = (TIME > 20.0) & (TIME < 22.0)
    assert limited("vibration", np.where(knock, 300.0, 1.0), autopilot) == ()


def test_what_a_vehicle_shakes_after_it_left_control_is_no_cause():
    during = (TIME > 20.0) & (TIME < 26.0)
    assert limited("vibration", np.where(during, 90.0, 1.0), lost=(20.0,)) == ()
    assert len(limited("vibration", np.where(during, 90.0, 1.0), lost=(25.0,))) == 1


@pytest.mark.parametrize(("autopilot", "limit"), [("ArduPilot", 100), ("PX4", 1000)])
def test_samples_that_clip_are_counted_in_flight(autopilot, limit):
    counts = 5e4 + np.clip((TIME - 20.0) * limit / 10.0, 0.0, 1.5 * limit)
    (event,) = limited("clipping", counts, autopilot)
    assert event.extra["trouble"] == "clipping" and abs(event.onset_s - 30.0) < 0.5
    assert limited("clipping", 5e4 + np.clip((TIME - 20.0) * limit / 10.0, 0.0, 0.9 * limit), autopilot) == ()
    assert limited("clipping", np.where(np.abs(TIME - 30.0) < 0.1, 4e9, 7.0), autopilot) == ()  # one damaged value


def test_measurements_that_the_estimator_rejects():
    ratio = np.where(((TIME > 20.0) & (TIME < 25.0))[:, None], [0.2, 0.3, 0.1, 2.4], 0.2)
    (event,) = limited("innovations", ratio)
    assert event.extra["trouble"] == "compass" and "2.4 times" in event.reason
    ratio = np.where(((TIME > 20.0) & (TIME < 25.0))[:, None], [1.2, 1.5, 0.1, 0.3], 0.2)
    (event,) = limited("innovations", ratio)
    assert event.extra["trouble"] == "estimator"
    assert limited("innovations", np.where(np.abs(TIME - 20.0)[:, None] < 1.0, 5.0, 0.2)) == ()


def discharged(volts, amps):
    battery = Signal(TIME, np.column_stack([volts, amps]), ("voltage", "current"), "V,A")
    return reports.claims(flight(signals={"battery": battery}), AIR)


def test_a_voltage_that_falls_by_more_than_its_current_explains():
    amps = 20.0 + 5.0 * np.sin(TIME)
    sound = 16.0 - 0.02 * TIME - 0.05 * amps
    (event,) = discharged(np.where(TIME > 40.0, sound - 4.0, sound), amps)
    assert event.extra["trouble"] == "power" and abs(event.onset_s - 40.0) < 0.5 and "more than its current explains" in event.reason
    pulls = np.where((TIME > 40.0) & (TIME < 46.0), 90.0, amps)
    assert discharged(16.0 - 0.02 * TIME - 0.05 * pulls, pulls) == ()  # 4.5 V less, which its resistance takes
    assert discharged(np.where(np.abs(TIME - 40.0) < 1.0, sound - 4.0, sound), amps) == ()  # and is back
    pinned = np.minimum(pulls, 40.0)  # a sensor at the end of its range: the current may have been any larger
    assert discharged(16.0 - 0.02 * TIME - 0.05 * pulls, pinned) == ()


def test_a_voltage_that_falls_as_the_flight_ends_is_reported():
    amps = 20.0 + 5.0 * np.sin(TIME)
    sound = 16.0 - 0.02 * TIME - 0.05 * amps
    (event,) = discharged(np.where(TIME > 59.0, sound - 5.0, sound), amps)
    assert event.extra["trouble"] == "power" and event.onset_s > 58.9


# Which explanation leads where control was lost


def answered(cause, *messages, onset_s=40.0, rotors=()):
    lost = hexa_event(
        kind=LOST, rotors=rotors, loss=(), interval=(), onset_s=onset_s, detected_s=onset_s + 0.5,
        extra={"cause": cause, "worked_until_s": [onset_s] * 6, "evidence": []},
    )  # fmt: skip
    reported = reports.claims(flight(*messages), AIR)
    events = [*reported, falls._with_reports(lost, reported)]
    if rotors:
        events.append(hexa_event(rotors=rotors, onset_s=onset_s, detected_s=onset_s + 0.4, loss=(0.95,), interval=((0.9, 1.0),)))
    return hexa_diagnosis(events=tuple(sorted(events, key=lambda e: e.detected_s)))


@pytest.mark.parametrize("cause", ["unknown", "controller", "saturated", "power"])
def test_what_was_reported_before_control_was_lost_leads(cause):
    answer = answered(cause, Message(30.0, "text", "Radio Failsafe"), Message(42.0, "text", "EKF3 lane switch 1"))
    assert answer.headline.startswith("At 30.00 s the autopilot lost the radio")
    assert " The vehicle departed controlled flight at 40.00 s." in answer.headline and len(answer.headline) <= 200
    assert "lane switch" not in answer.headline  # what came of it
    assert any("lane switch" in line.text for line in answer.story)
    lost = next(e for e in answer.events if e.kind == LOST)
    assert lost.extra["before"] == [{"trouble": "radio", "time_s": 30.0}] and "before that, at 30.0 s" in lost.reason


def test_a_report_clears_no_rotor_and_accuses_none():
    without, with_ = answered("unknown"), answered("unknown", Message(39.0, "text", "Low battery"))
    assert (without.verdict, with_.verdict) == ("inconclusive",) * 2
    assert with_.rotors == without.rotors
    assert "Not a rotor fault" not in with_.headline and "No rotor fault was found" in with_.headline


def test_a_rotor_that_is_shown_leads_before_what_was_reported():
    answer = answered("rotor", Message(30.0, "text", "Low battery"), Message(41.0, "error", "failure detector: motor"), rotors=(3,))
    assert answer.verdict == "fault" and answer.headline.startswith("Rotor 3 (front left) lost 95 %")
    assert "Low battery" in answer.headline and "failure detector" not in answer.headline


def test_what_was_long_ago_or_struck_competes_with_nothing():
    assert "Radio" not in answered("unknown", Message(9.0, "text", "Radio Failsafe"), onset_s=50.0).headline
    assert "battery" in answered("unknown", Message(9.0, "text", "Low battery"), onset_s=50.0).headline
    assert "Radio" not in answered("knock", Message(39.0, "text", "Radio Failsafe")).headline


def test_who_stopped_the_motors_is_reported_with_it():
    answer = answered("disarmed", Message(40.1, "event", "disarmed: runaway take-off"))
    assert answer.headline.startswith("At 40.10 s the autopilot stopped the motors")


def test_a_log_that_contradicts_itself_tells_what_was_reported_all_the_same():
    """It does not rest on the outputs."""
    reported = reports.claims(flight(Message(30.0, "text", "Low battery")), AIR)
    answer = hexa_diagnosis(events=(hexa_event(), *reported), doubts=("the outputs stand still.",))
    assert [e.kind for e in answer.events] == [REPORTED] and "Low battery" in answer.headline


def test_every_fault_and_every_notice_of_a_rotor_rests_on_outputs():
    assert {row.name for row in kinds.table().values() if not row.by_outputs} == {
        kinds.CONTACT, LOST, REPORTED, kinds.OUT_OF_BALANCE, kinds.UNBALANCED,
    }  # fmt: skip


def test_what_ends_a_flight_leads_where_no_fault_is_found():
    """Power that fails as the log ends is what the pilot asks about, not that no rotor lost thrust until then."""
    amps = 20.0 + 5.0 * np.sin(TIME)
    sound = 16.0 - 0.02 * TIME - 0.05 * amps
    reported = discharged(np.where(TIME > 55.0, sound - 5.0, sound), amps)
    assert hexa_diagnosis(events=reported).headline.startswith("At 55.20 s the battery's voltage fell by 5.")
    assert hexa_diagnosis(events=(hexa_event(), *reported)).headline.startswith("Rotor 3 (front left) lost 37 %")
