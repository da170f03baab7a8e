"""PX4 over a telemetry radio, as file and as link: answered as the vehicle's own log is."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from tests.link_recordings import held, overheard

from rotorwatch import airframes, diagnose, logs
from rotorwatch.flight import output_functions
from rotorwatch.live import requests

OPEN = Path(__file__).resolve().parents[2] / "shared" / "flights" / "open"
HEXA, EXCHANGED = "px4_L2_hex_m5_dead", "px4_L6_remap_m3_40"
PARAM_VALUE, AUTOPILOT_VERSION = 22, 148
UNKNOWN = (PARAM_VALUE, AUTOPILOT_VERSION)  # without them a vehicle is not known, nor its kept parameters


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(requests, "cache_folder", lambda: tmp_path / "cache")


def radio(name):
    path = OPEN / f"{name}_radio.tlog.xz"
    if not path.exists():
        pytest.skip(f"the shared flight {path.name} is not here")
    return path


def loss(events):
    (one,) = [e for e in events if e["kind"] == "loss_of_effectiveness"]
    return one


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name, rotor, truth", [(EXCHANGED, 3, 0.4), (HEXA, 5, 1.0)])
def test_telemetry_is_answered_as_the_vehicles_own_log_is(name, rotor, truth):
    """A hexa whose heartbeat tells of a quadrotor, and a quad with outputs 1 and 3 exchanged by their functions."""
    path = radio(name)
    own = loss(diagnose(logs.read(OPEN / f"{name}.ulg.xz")).to_dict()["events"])
    recorded = loss(diagnose(logs.read(path)).to_dict()["events"])
    alerts, _ = overheard(path)
    reported = loss(held(alerts))
    assert not [a for a in alerts if a["type"] == "error"]
    for found in (own, recorded, reported):
        assert found["rotors"] == [rotor] and not found["alternatives"]
        assert found["interval"][0][0] <= truth <= found["interval"][0][1]
    assert abs(recorded["onset_s"] - own["onset_s"]) < 0.5


def test_without_parameters_a_watch_that_only_listens_says_at_once_what_is_missing():
    path = radio(HEXA)
    alerts, _ = overheard(path, without=UNKNOWN, until_s=15.0)
    (missed,) = [a for a in alerts if "missing" in a]
    assert missed["at"] < 5.0 and missed["missing"] == ["parameters"]
    assert "parameters" in missed["text"] and "--vehicle FILE" in missed["text"] and "--listen-only" in missed["text"]
    assert not [a for a in alerts if a["type"] == "vehicle"]  # a heartbeat's word for it is no airframe
    known = airframes.identify(logs.read(path))
    alerts, link = overheard(path, without=UNKNOWN, vehicle=known, until_s=20.0)
    (watched,) = link.vehicles
    assert watched.session is not None and watched.session.flying and not watched.trouble
    assert any("rotor k was taken to be output k" in a.get("text", "") for a in alerts)


def test_a_silent_link_says_what_does_not_come():
    outputs = (36, 375)
    alerts, _ = overheard(radio(EXCHANGED), without=outputs, until_s=15.0)
    (missed,) = [a for a in alerts if "missing" in a]
    assert missed["missing"] == ["outputs"] and "SERVO_OUTPUT_RAW" in missed["text"] and missed["at"] < 5.0
    json.dumps(missed)


def test_outputs_that_drive_other_rotors_accuse_nobody(monkeypatch):
    """The same flight, its functions not known: by its numbers rotor 1 would be accused with certainty."""
    path = radio(EXCHANGED)
    flight = logs.read(path)
    swapped = flight["motors"].values[:, [2, 1, 0, 3]]
    wrong = replace(flight, signals={**flight.signals, "motors": replace(flight["motors"], values=swapped)})
    answer = diagnose(wrong)
    assert answer.verdict == "inconclusive" and "other rotors" in answer.reason
    assert not [e for e in answer.events if e.kind == "loss_of_effectiveness"]
    monkeypatch.setattr("rotorwatch.logs.tlog.motor_outputs", lambda parameters: {"PWM_MAIN": {k: k for k in range(1, 5)}})
    alerts, _ = overheard(path)
    assert not held(alerts)
    assert "other rotors" in [a for a in alerts if a["type"] == "error"][-1]["text"]


@pytest.mark.parametrize(
    "name, value, means",
    [
        ("SERVO3_FUNCTION", 33, ("SERVO", 3, 1)), ("SERVO14_FUNCTION", 85, ("SERVO", 14, 12)), ("SERVO9_FUNCTION", 0, ("SERVO", 9, 0)),
        ("PWM_MAIN_FUNC1", 103, ("PWM_MAIN", 1, 3)), ("UAVCAN_EC_FUNC8", 112, ("UAVCAN_EC", 8, 12)),
        ("HIL_ACT_FUNC2", 101, ("HIL_ACT", 2, 1)), ("PWM_AUX_FUNC4", 201, ("PWM_AUX", 4, 0)), ("PWM_MAIN_DIS1", 900, None),
        ("SERVO_RATE", 50, None),
    ],
)  # fmt: skip
def test_one_table_tells_what_an_output_drives(name, value, means):
    assert output_functions.function(name, value) == means
