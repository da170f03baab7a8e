"""The autopilots' own threshold checks: they fire where documented and stay silent elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, logs
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch.methods.published import detectors
from rotorwatch.methods.published.detectors import esc_current, thrust_loss

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the shared test flights are not beside the repository")
ALWAYS = ((0.0, 1e9),)
VEHICLE = airframes.named("ardupilot-quad-x")


def sinking(seconds=3.0, throttle=0.95, sink=1.0, lean=5.0, output=1900.0):
    """A quad that sinks at high throttle from 2 s on, output 3 highest."""
    time = np.arange(0.0, 6.0, 0.1)
    on = (time >= 2.0) & (time < 2.0 + seconds)
    motors = np.where(on[:, None], [1700.0, 1700.0, output, 1700.0], 1500.0)
    half = np.radians(lean) / 2
    attitude = np.tile([np.cos(half), np.sin(half), 0.0, 0.0], (time.size, 1))
    velocity = np.zeros((time.size, 3))
    velocity[on, 2] = sink
    signals = {
        "motors": Signal(time, motors, ("r1", "r2", "r3", "r4"), "us"),
        "throttle": Signal(time, np.where(on, throttle, 0.4), ("out",), "1"),
        "velocity": Signal(time, velocity, ("n", "e", "d"), "m/s"),
        "attitude": Signal(time, attitude, ("w", "x", "y", "z"), "1"),
    }
    return Flight("made", "ArduPilot", signals, 6.0)


def test_both_detectors_are_found():
    assert [module.name for module in detectors.modules()] == ["ardupilot-thrust-loss", "px4-esc-current"]


def test_an_autopilots_check_runs_on_its_own_logs_alone():
    """PX4's current check says nothing of an ArduPilot log, whose ESCs may report otherwise, and the other way round."""
    assert {module.name: module.autopilot for module in detectors.modules()} == {
        "ardupilot-thrust-loss": "ArduPilot",
        "px4-esc-current": "PX4",
    }
    stalled = with_esc([5.0, 5.0, 5.0, 0.2])
    assert [f["detector"] for f in detectors.detect(stalled, QUAD, ALWAYS)] == ["px4-esc-current"]
    assert detectors.detect(replace(stalled, autopilot="ArduPilot"), QUAD, ALWAYS) == ()
    assert detectors.detect(replace(sinking(), autopilot="PX4"), VEHICLE, ALWAYS) == ()
    said = (Message(1.5, "text", "Potential Thrust Loss (2)"),)
    assert detectors.detect(Flight("t", "", {}, 3.0, messages=said), VEHICLE, ALWAYS) == ()


def test_thrust_loss_names_the_highest_output_after_a_second():
    (found,) = detectors.detect(sinking(), VEHICLE, ALWAYS)
    assert (found["detector"], found["rotor"]) == ("ardupilot-thrust-loss", 3)
    assert found["time_s"] == pytest.approx(3.0, abs=0.11)


@pytest.mark.parametrize(
    "change", [{"seconds": 0.9}, {"throttle": 0.8}, {"sink": -1.0}, {"lean": 20.0}, {"throttle": 0.2, "output": 1950.0}]
)
def test_thrust_loss_needs_all_its_conditions(change):
    assert detectors.detect(sinking(**change), VEHICLE, ALWAYS) == ()


def test_thrust_loss_by_an_output_at_its_limit():
    (found,) = detectors.detect(sinking(throttle=0.5, output=1950.0), VEHICLE, ALWAYS)
    assert found["rotor"] == 3


def test_thrust_loss_only_in_the_air():
    assert detectors.detect(sinking(), VEHICLE, ((0.0, 2.5),)) == ()


def test_the_autopilots_own_words_are_an_entry():
    said = (Message(1.5, "text", "Potential Thrust Loss (2)"), Message(2.0, "text", "Disarming motors"))
    (found,) = thrust_loss.detect(Flight("t", "ArduPilot", {}, 3.0, messages=said), VEHICLE, ())
    assert found == {"detector": "autopilot-message", "rotor": 2, "time_s": 1.5, "reason": "Potential Thrust Loss (2)"}


def with_esc(currents, start=2.0):
    """A PX4 quad at half command whose ESC currents change to `currents` at `start`."""
    time = np.arange(0.0, 4.0, 0.05)
    columns = tuple(f"{what}{k}" for what in ("speed", "current") for k in range(1, 5))
    values = np.concatenate([np.full((time.size, 4), 6000.0), np.full((time.size, 4), 5.0)], axis=1)
    values[time >= start, 4:] = currents
    motors = Signal(time, np.full((time.size, 4), 0.5), ("r1", "r2", "r3", "r4"), "1")
    signals = {"motors": motors, "esc": Signal(time, values, columns, "rad/s,A")}
    return Flight("made", "PX4", signals, 4.0)


QUAD = replace(airframes.named("px4-quad-x"), curve=ThrustCurve(0.0, 1.0, 0.3))


def test_a_motor_without_current_has_failed():
    (found,) = esc_current.detect(with_esc([5.0, 5.0, 5.0, 0.2]), QUAD, ALWAYS)
    assert found["rotor"] == 4
    assert found["time_s"] == pytest.approx(2.1, abs=0.06)


def test_parameters_of_the_log_count():
    flight = with_esc([5.0, 5.0, 5.0, 3.0])
    assert esc_current.detect(flight, QUAD, ALWAYS) == ()
    strict = replace(flight, parameters={"FD_ACT_MOT_C2T": 8.0, "FD_ACT_MOT_TOUT": 500.0})
    (found,) = esc_current.detect(strict, QUAD, ALWAYS)
    assert found["time_s"] == pytest.approx(2.5, abs=0.06)
    assert esc_current.detect(replace(strict, parameters={"FD_ACT_MOT_THR": 0.6}), QUAD, ALWAYS) == ()


def test_escs_that_never_reported_current_are_not_believed():
    assert esc_current.detect(with_esc([0.0] * 4, start=0.0), QUAD, ALWAYS) == ()


def test_nothing_without_signals():
    assert detectors.detect(Flight("t", "PX4", {}, 1.0), QUAD, ALWAYS) == ()


@needs_flights
def test_total_loss_is_named_when_the_autopilot_names_it():
    flight = logs.read(FLIGHTS / "ardupilot-sitl/hexaplus_m6_mul0.00_fwdback_wind.bin.xz")
    found = detectors.detect(flight, airframes.identify(flight), ((4.0, 94.0),))
    assert {f["detector"] for f in found} == {"autopilot-message", "ardupilot-thrust-loss"}
    assert {f["rotor"] for f in found} == {6}
    assert abs(found[0]["time_s"] - found[1]["time_s"]) < 0.5


@needs_flights
@pytest.mark.parametrize(
    "path",
    [
        "ardupilot-sitl/hexax_m3_mul0.80_square_wind.bin.xz",
        "ardupilot-real-rrc/25_mm_cut_hover_2.bin.xz",
        "px4-pyulog/sample_px4_events.ulg.xz",
    ],
)
def test_partial_losses_and_healthy_flights_are_not_found(path):
    flight = logs.read(FLIGHTS / path)
    assert detectors.detect(flight, airframes.identify(flight), ALWAYS) == ()
