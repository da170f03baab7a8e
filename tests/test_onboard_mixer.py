"""The mixer in C: comparisons and rebuilt thrusts of motion/allocation.py, and the overrides of a whole flight from raw outputs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from embedded_c_parts import LASTS, Part, vehicle_row
from rotorwatch import airframes, logs
from rotorwatch.flight import Flight, Signal
from rotorwatch.motion import airborne, allocation, departures

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the shared test flights are not beside the repository")
KINDS = ("stuck", "off", "overridden")
N = 4
COLUMNS = tuple(f"r{k + 1}" for k in range(N))


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    return Part(tmp_path_factory.mktemp("mixer"), "drive_mixer.c", ("rw_mixer.c", "rw_departures.c"), N)


def made_up(rate, outputs, mixer, seed):
    """A flight whose outputs follow a mixer, with gaps, values that are not valid, limits, and one output that gets stuck."""
    rng = np.random.default_rng(seed)
    vehicle = airframes.named("ardupilot-quad-x")
    factors = vehicle.mixer
    assert factors is not None
    vehicle = replace(vehicle, extra={**vehicle.extra, "mixer_expo": 0.3} if rng.random() < 0.5 else vehicle.extra)
    duration = 40.0
    # Whole microseconds, and never the same time twice: at the same time either may have come first.
    times = [np.cumsum(rng.uniform(0.6, 1.4, int(duration * hz))) / hz for hz in (rate, outputs)]
    when, out = np.round(times[0], 5), np.round(times[1], 5) + 3e-6
    if rate == outputs:
        out = when + 0.0007
    when = when[(when < 20.0) | (when > 21.0)]

    def controls(time):
        waves = [np.sin(2 * np.pi * f * time + p) for f, p in ((0.9, 0.0), (0.7, 1.0), (0.4, 2.0), (0.2, 3.0))]
        control = np.stack(waves, axis=1) * [0.06, 0.06, 0.3, 0.1] + [0.0, 0.0, 0.0, 0.45]
        control[(time > 25.0) & (time < 27.0), 3] += 0.45
        return control

    control = controls(when) + 0.002 * rng.standard_normal((len(when), 4))
    demand = np.clip(1.06 * controls(out) @ factors.T, 0.0, 1.0)
    curve = allocation.believed_curve(vehicle)
    command = curve.u_min + (curve.u_max - curve.u_min) * allocation.drive(curve.expo, demand) / 0.95
    command[out > 30.0, 1] = command[np.argmax(out > 30.0), 1]
    valid = rng.random((len(when), 1)) < 0.99
    signals = {
        "motors": Signal(out, command, COLUMNS, "us", valid=np.repeat(rng.random((len(out), 1)) < 0.99, N, axis=1)),
        "control": Signal(when, control, ("roll", "pitch", "yaw", "thrust"), "1", valid=np.repeat(valid, 4, axis=1)),
        "lift": Signal(
            np.array([0.0, 15.0]),
            np.array([[1.0, 0.97, 1.0], [1.0, 0.95, 1.0]]),
            ("lift_max", "voltage_ratio", "limit"),
            "1",
        ),
    }
    return Flight("made", "ArduPilot", signals, duration), vehicle if mixer else replace(vehicle, mixer=None)


def rows(flight, vehicle, air):
    """All samples in time order, outputs first."""
    headroom = np.clip(np.nan_to_num(flight.parameters.get("MOT_YAW_HEADROOM", 200.0), nan=200.0), 100.0, 500.0)
    found = []
    for kind, name in enumerate(("motors", "control")):
        signal = flight[name]
        battery = allocation.battery_ratio(flight, signal.time)
        valid = signal.valid.all(axis=1)
        found += [
            (t, kind, [float(kind), t, ok, b, *values])
            for t, ok, b, values in zip(signal.time.tolist(), valid, battery, signal.values)
        ]
    return [
        vehicle_row(vehicle, air, float(headroom) / 1000.0),
        *(row for _, _, row in sorted(found, key=lambda x: x[:2])),
    ]


def said(part, flight, vehicle, air, precision="double"):
    """Lines of numbers by their first word."""
    (block,) = part.run(rows(flight, vehicle, air), precision)
    found = {"compared": [], "thrust": [], "override": []}
    for line in block:
        name, *numbers = line.split()
        found[name].append([float(x) for x in numbers])
    return found


@pytest.mark.parametrize("mixer", [True, False])
@pytest.mark.parametrize(("rate", "outputs"), [(50.0, 10.0), (25.0, 25.0), (20.0, 50.0)])
def test_comparisons_and_rebuilt_thrusts_are_those_of_python(part, rate, outputs, mixer):
    flight, vehicle = made_up(rate, outputs, mixer, 7)
    found = said(part, flight, vehicle, ())
    check = allocation.compare(flight, vehicle)
    ours = np.array(found["compared"])
    assert len(ours) == len(check.time) > 300
    theirs = [check.time, check.known, check.top[:, 0], check.yaw_granted]
    theirs = np.column_stack([*theirs, check.demand, check.asked, check.yaw, check.deviation])
    assert ours == pytest.approx(theirs, abs=1e-9)
    mixed = allocation.rebuilt(flight, vehicle, check)
    assert mixed is not None
    usable = mixed.valid.any(axis=1)
    ours = np.array(found["thrust"])
    assert ours[:, 0] == pytest.approx(mixed.time[usable], abs=1e-12) and len(ours) > 200
    assert (ours[:, 1 + N :] == mixed.valid[usable]).all()
    trusted = mixed.valid[usable]
    assert ours[:, 1 : 1 + N][trusted] == pytest.approx(mixed.values[usable][trusted], abs=1e-9)


def overrides(flight, vehicle, air):
    """What Python finds, as C says it."""
    return [
        (o.rotor - 1, KINDS.index(o.kind), o.onset, o.detected, LASTS if o.end is None else o.end)
        for o in departures.overrides(flight, vehicle, air)
    ]


@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_stuck_output_of_a_made_up_flight(part, precision):
    flight, vehicle = made_up(50.0, 10.0, True, 3)
    air = ((2.0, 39.0),)
    theirs = overrides(flight, vehicle, air)
    assert (1, 0) in [o[:2] for o in theirs]
    assert [tuple(o) for o in said(part, flight, vehicle, air, precision)["override"]] == theirs


@needs_flights
@pytest.mark.parametrize(
    "log", ["ardupilot-sitl/quadx_m1_mul0.90_hover.bin.xz", "ardupilot-real-dronekit/log171.bin.xz"]
)
def test_overrides_of_a_logged_flight(part, log):
    flight = logs.read(FLIGHTS / log)
    vehicle = airframes.identify(flight)
    air = airborne.airborne(flight)
    found = said(part, flight, vehicle, air)
    assert len(found["compared"]) == len(allocation.compare(flight, vehicle).time) > 100
    assert [tuple(o) for o in found["override"]] == overrides(flight, vehicle, air)
