"""The autopilots' own threshold checks: they fire where documented and stay silent elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, detectors, logs
from rotorwatch.detectors import current_residual, esc_current, thrust_loss
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch_lab.simulation import scenario, simulate

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


def test_the_detectors_are_found():
    names = [module.name for module in detectors.modules()]
    assert names == ["ardupilot-thrust-loss", "px4-current-residual", "px4-esc-current"]


def test_an_autopilots_check_runs_on_its_own_logs_alone():
    """PX4's current check says nothing of an ArduPilot log, whose ESCs may report otherwise, and the other way round."""
    assert {module.name: module.autopilot for module in detectors.modules()} == {
        "ardupilot-thrust-loss": "ArduPilot",
        "px4-current-residual": "PX4",
        "px4-esc-current": "PX4",
    }
    stalled = with_esc([5.0, 5.0, 5.0, 0.2])
    assert {f["detector"] for f in detectors.detect(stalled, QUAD, ALWAYS)} == {"px4-esc-current", "px4-current-residual"}
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


def in_flight(currents, seconds=30.0, rate_hz=20.0, start=20.0, command=0.5):
    """A PX4 quad whose motors draw 20 u^2 + .8 A; `currents` (4,) times that from `start` s on, its commands wandering."""
    time = np.arange(0.0, seconds, 1.0 / rate_hz)
    u = np.clip(command + 0.1 * np.sin(time[:, None] + np.arange(4)), 0.0, 1.0)
    drawn = (20.0 * u**2 + 0.8) * np.where(time[:, None] >= start, currents, 1.0)
    columns = tuple(f"{what}{k}" for what in ("speed", "current") for k in range(1, 5))
    esc = Signal(time, np.column_stack([np.full((time.size, 4), 6000.0), drawn]), columns, "rad/s,A")
    signals = {"motors": Signal(time, u, ("r1", "r2", "r3", "r4"), "1"), "esc": esc}
    return Flight("made", "PX4", signals, seconds)


@pytest.mark.parametrize("rate_hz", [3.0, 20.0, 100.0])
@pytest.mark.parametrize(("currents", "word"), [((1, 1, 0.3, 1), "less"), ((1, 1, 2.5, 1), "more")])
def test_currents_are_watched_on_both_sides(currents, word, rate_hz):
    (found,) = current_residual.detect(in_flight(currents, rate_hz=rate_hz), QUAD, ALWAYS)
    assert found["rotor"] == 3 and word in found["reason"] and "model fitted" in found["reason"]
    assert 20.0 < found["time_s"] < 21.5
    assert current_residual.detect(in_flight((1.1, 0.9, 1.1, 0.9), rate_hz=rate_hz), QUAD, ALWAYS) == ()


def test_a_motor_that_fails_later_does_not_teach_what_motors_draw():
    (found,) = current_residual.detect(in_flight((1, 0.0, 1, 1), seconds=60.0, start=12.0), QUAD, ALWAYS)
    assert found["rotor"] == 2 and found["time_s"] < 13.5


def test_model_and_band_of_the_autopilot_count_where_its_check_was_on():
    flight = in_flight((1, 1, 0.5, 1))
    own = {"FD_ACT_EN": 1.0, "MOTFAIL_QUAD": 20.0, "MOTFAIL_C2T": 0.0, "MOTFAIL_IDLE": 0.8, "MOTFAIL_TIME": 1.0}
    for band, found in ((1.0, [3]), (9.0, [])):
        reported = current_residual.detect(replace(flight, parameters={**own, "MOTFAIL_OFF": band}), QUAD, ALWAYS)
        assert [one["rotor"] for one in reported] == found and not any("fitted" in one["reason"] for one in reported)
    sides = {**own, "MOTFAIL_UNDER": 9.0, "MOTFAIL_OVER": 1.0, "MOTFAIL_OVR_TIME": 2.5}
    assert current_residual.detect(replace(flight, parameters=sides), QUAD, ALWAYS) == ()
    (over,) = current_residual.detect(replace(in_flight((1, 2, 1, 1)), parameters=sides), QUAD, ALWAYS)
    assert over["rotor"] == 2 and 22.4 < over["time_s"] < 23.2
    off = {**own, "FD_ACT_EN": 0.0, "MOTFAIL_OFF": 0.01}  # a check that was off: PX4's values are another vehicle's
    assert "fitted" in current_residual.detect(replace(flight, parameters=off), QUAD, ALWAYS)[0]["reason"]


def test_a_dip_shorter_than_the_hold_time_is_no_failure():
    flight = in_flight((1, 1, 1, 1))
    esc = flight["esc"]
    values = esc.values.copy()
    values[(esc.time > 22.0) & (esc.time < 22.3), 6] = 0.0
    dipped = replace(flight, signals={**flight.signals, "esc": replace(esc, values=values)})
    assert current_residual.detect(dipped, QUAD, ALWAYS) == ()


@pytest.mark.parametrize(
    ("fault", "word"),
    [
        (None, ""), ({"kind": "complete loss"}, "less"), ({"kind": "stuck", "level": 0.9}, "more"),
        ({"kind": "bearing", "strength": 0.6}, "more"),
    ],
)  # fmt: skip
def test_simulated_motors_that_fail(fault, word):
    """A lost propeller draws less, a stuck output and a bearing more; a healthy flight has nothing."""
    table = {
        "duration_s": 41.0, "seed": 4, "autopilot": "px4", "airframe": {"frame": "hexa-x"}, "logging": {"esc": True, "profile": "full"},
        "faults": [] if fault is None else [{"rotor": 2, "onset_s": 16.0, **fault}],
    }  # fmt: skip
    flight = simulate(scenario.from_table(table)).flight
    reported = current_residual.detect(flight, airframes.identify(flight), ((4.0, 24.0),))
    assert [one["rotor"] for one in reported] == ([] if fault is None else [2])
    assert all(word in one["reason"] and 16.0 < one["time_s"] < 17.5 for one in reported)


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
