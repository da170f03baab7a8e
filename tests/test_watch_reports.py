"""What an autopilot says of itself over a link: `watch` tells it, in the words of `diagnose`, and the recorded link says the same."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from tests.link_faults import Faults, arriving, watched
from tests.mavlink_vehicle import Autopilot, messages

from rotorwatch import diagnose, logs
from rotorwatch.flight.kinds import REPORTED
from rotorwatch.live import ground, view
from rotorwatch_lab.simulation import scenario, simulate

QUAD, BOOT_S = 2, 30.0
SOUND = 0x1 | 0x2 | 0x4 | 0x10000  # gyro, accelerometer, compass, radio


@pytest.fixture(scope="module")
def flight():
    table = {"duration_s": 40.0, "seed": 3, "airframe": {"frame": "quad-x"}, "trajectory": {"kind": "hover"}}
    return simulate(scenario.from_table(table)).flight


def reported(flight, folder, more):
    """(events that `watch` holds, alerts, events that `diagnose` finds in the recorded link); more: (time s, message) besides."""
    said = [*messages(flight, kind=QUAD), *more]
    autopilot = Autopilot({})
    frames = [(at, bytes(autopilot.packed(m))) for at, m in sorted(said, key=lambda one: one[0])]
    parameters = {n: v for n, v in flight.parameters.items() if n.startswith(("FRAME", "MOT_", "SERVO")) and len(n) <= 16}
    alerts, _ = watched(arriving(frames, Faults(), np.random.default_rng(0)), parameters, QUAD, folder)
    (path,) = folder.glob("*.tlog")
    last = {a["number"]: a for a in alerts if a["type"] == "event"}
    held = [a["event"] for a in last.values() if a["state"] != "withdrawn"]
    return held, alerts, diagnose(logs.read(path)).to_dict()["events"]


def health(at, sound):
    status = mavlink.MAVLink_sys_status_message(SOUND, SOUND, sound, 0, 16000, 2000, 90, 0, 0, 0, 0, 0, 0)
    return at, status


def shakes(at, level):
    return at, mavlink.MAVLink_vibration_message(int((at + BOOT_S) * 1e6), level, 2.0, 3.0, 0, 0, 0)


def of_reports(events):
    found = [e for e in events if e["kind"] == REPORTED]
    return sorted((e["trouble"], round(e["onset_s"], 1)) for e in found)


def test_a_vehicle_without_trouble_reports_none(flight, tmp_path):
    more = [health(float(t), SOUND) for t in range(1, 40)] + [shakes(float(t), 12.0) for t in range(1, 40)]
    held, _, recorded = reported(flight, tmp_path, more)
    assert of_reports(held) == [] == of_reports(recorded)


def test_texts_health_and_vibration_of_a_link_go_through_the_same_table(flight, tmp_path):
    more = [health(float(t), SOUND & ~(0x10000 * (t >= 20))) for t in range(1, 40)]
    more += [shakes(0.5 * t, 45.0 if 50 <= t < 66 else 12.0) for t in range(2, 80)]
    more += [(28.0, mavlink.MAVLink_statustext_message(2, b"EKF variance"))]
    held, alerts, recorded = reported(flight, tmp_path, more)
    assert [name for name, _ in of_reports(held)] == ["estimator", "radio", "vibration"]
    for (name, at), (other, when) in zip(of_reports(held), of_reports(recorded), strict=True):
        assert name == other and abs(at - when) < 1.1
    texts = {e["trouble"]: e["reason"] for e in held if e["kind"] == REPORTED}
    assert '"EKF variance"' in texts["estimator"] and "radio unhealthy" in texts["radio"] and "45 m/s" in texts["vibration"]
    announced = [a for a in alerts if a["type"] == "event" and a["event"]["kind"] == REPORTED]
    (shaking,) = [a for a in announced if a["event"]["trouble"] == "vibration"]
    assert "vibration was up to" in view.announced(shaking)
    # Ground stations have heard the autopilot's own words; of what was measured they are reported.
    assert {a["event"]["trouble"] for a in announced if ground.worth_sending(None, a)} == {"vibration"}
    assert ground.text_of(shaking)[0] == "rotorwatch: autopilot warning: vibration"
