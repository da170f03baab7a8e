"""`info` says ready exactly when `diagnose` assesses the log: the same functions decide."""

from dataclasses import replace
from pathlib import Path

import pytest

from rotorwatch import logs
from rotorwatch.diagnose import diagnose
from rotorwatch.errors import RotorwatchError
from rotorwatch.report.info import info, obstacle
from test_baselines import slower
from test_calibrate import QUAD, flown, on_the_ground

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
WILD = ("slow-bin-1", "slow-tlog-1", "plane-1", "no-rcou-1", "frozen-fault-1", "healthy-real-1", "knock-2", "rotor-off-1", "on-its-side-1")


def without(flight, *names):
    return replace(flight, signals={k: s for k, s in flight.signals.items() if k not in names})


@pytest.mark.parametrize(
    ("flight", "what", "words"),
    [
        (flown, None, ""),
        (lambda: slower(flown()), None, ""),
        (lambda: without(flown(), "motors"), "motors", "no motor outputs"),
        (lambda: without(flown(), "gyro"), "gyro", "neither gyro nor attitude"),
        (lambda: without(flown(), "accel"), None, ""),
        (on_the_ground, "airborne", "in the air"),
        (lambda: replace(flown(), autopilot="", parameters={}), "frame", "does not say which airframe"),
        (lambda: flown(rotors=6), "frame", "commands 6 rotors but the frame"),
    ],
)
def test_ready_is_what_diagnose_does(flight, what, words):
    flight = flight()
    found = obstacle(flight)
    facts = info(flight)
    assert (found.what if found else None) == what and (found is None or words in found.why)
    assert facts["ready"] == (what is None) == (not any(gap["needed"] for gap in facts["missing"]))
    try:
        assessed = not diagnose(flight).headline.startswith("Not assessed")
    except RotorwatchError as why:
        assessed = False
        assert found is not None and str(why) == found.why
    assert assessed == facts["ready"]


def test_an_airframe_that_is_given_removes_that_obstacle():
    assert obstacle(replace(flown(), autopilot="", parameters={}), QUAD) is None


@pytest.mark.thorough(keep=3)
@pytest.mark.skipif(not (SHARED / "wild").is_dir(), reason="needs the test logs in ../shared/flights")
@pytest.mark.parametrize("name", WILD)
def test_real_logs_too(name):
    flight = logs.read(next((SHARED / "wild").glob(f"{name}.*")))
    try:
        answer = diagnose(flight)
        assessed = answer.verdict != "inconclusive"
    except RotorwatchError:
        assessed = False
    assert info(flight)["ready"] == assessed
