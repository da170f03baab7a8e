"""When the vehicle is in the air, in C: the intervals of motion/airborne.py, from samples as they come."""

from pathlib import Path

import numpy as np
import pytest

from embedded_c_parts import Part
from rotorwatch import logs
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.motion.airborne import airborne, output_range

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the shared test flights are not beside the repository")
N = 4
ALL = (
    "ardupilot-sitl/quadx_m1_mul0.90_hover.bin.xz",
    "ardupilot-real-dronekit/log171.bin.xz",
    "ardupilot-real-twoflights/sample.bin.xz",
)


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    return Part(tmp_path_factory.mktemp("airborne"), "drive_airborne.c", ("rw_airborne.c",), N)


def rows(flight):
    """All samples in time order, and at last how long the log is."""
    motors = flight["motors"]
    masks = np.asarray(np.asarray(motors.valid) @ (1 << np.arange(motors.values.shape[1])))
    found = [[0.0, t, m, *u] for t, m, u in zip(motors.time, masks, motors.values)]
    for kind, name in ((1.0, "accel"), (2.0, "gyro")):
        if flight.has(name):
            signal = flight[name]
            whole = np.asarray(np.asarray(signal.valid).all(axis=1))
            found += [[kind, t, ok, *x] for t, ok, x in zip(signal.time, whole, signal.values)]
    if flight.has("velocity"):
        velocity = flight["velocity"]
        value = np.where(velocity.valid, velocity.values, np.nan)
        found += [[3.0, t, 1.0, -x[2], np.hypot(x[0], x[1])] for t, x in zip(velocity.time, value)]
    for m in flight.messages:
        if m.kind in ("landed", "armed"):
            said = float(m.value > 0.5)
            found.append([4.0, m.time, 1.0, *((said, -1.0) if m.kind == "landed" else (-1.0, said))])
    found.sort(key=lambda row: row[1])
    last = motors.time[np.asarray(motors.valid).any(axis=1)][-1]
    return [list(output_range(flight)), *found, [5.0, max(flight.duration, float(last)), 1.0]]


def flights_of(part, flight, precision="double"):
    (block,) = part.run(rows(flight), precision)
    return tuple(tuple(map(float, line.split())) for line in block)


def hops(seed):
    """A made-up log of take-offs, landings, falls, blows and gaps in the outputs."""
    rng = np.random.default_rng(seed)
    duration = 90.0
    plan = np.interp(
        np.arange(0.0, duration, 0.02), np.sort(rng.uniform(0, duration, 14)), rng.choice([0.0, 0.1, 0.45, 0.6], 14)
    )
    time = np.arange(0.0, duration, 0.02)
    flying = plan > 0.3
    motors_t = time[:: rng.integers(1, 6)] + 0.003
    gap = rng.uniform(20.0, 80.0)
    motors_t = motors_t[(motors_t < gap) | (motors_t > gap + rng.choice([0.5, 3.0, 5.0]))]
    u = 1000.0 + 1000.0 * np.clip(
        np.interp(motors_t, time, plan)[:, None] + rng.normal(0, 0.02, (len(motors_t), N)), 0, 1
    )
    up = np.where(flying & (rng.random(len(time)) < 0.98), 1.0, rng.choice([1.0, 0.2])) * 9.81
    force = np.column_stack([rng.normal(0, 0.5, (len(time), 2)), -up + rng.normal(0, 0.3, len(time))])
    force[rng.integers(0, len(time), 3), 0] = 25.0
    rate = rng.normal(0, 0.1, (len(time), 3))
    climb = np.convolve(np.gradient(plan, 0.02), np.ones(25) / 25, "same")
    velocity = np.column_stack([rng.normal(0, 0.1, (len(time), 2)), -4.0 * climb])[::5]
    xyz = ("x", "y", "z")
    good = np.repeat(rng.random((len(time), 1)) < 0.95, 3, axis=1)
    signals = {
        "motors": Signal(motors_t, u, tuple(f"r{k + 1}" for k in range(N)), "us", valid=rng.random(u.shape) < 0.97),
        "accel": Signal(time + 0.001, force, xyz, "m/s^2", valid=good),
        "gyro": Signal(time[::2] + 0.002, rate[::2], xyz, "rad/s"),
    }
    if rng.random() < 0.7:
        signals["velocity"] = Signal(time[::5] + 0.004, velocity, ("north", "east", "down"), "m/s")
    words = [
        Message(float(t), "", "landed", float(rng.integers(2)))
        for t in np.sort(rng.uniform(0, duration, rng.integers(0, 5)))
    ]
    return Flight("made", "ArduPilot", signals, duration, messages=tuple(words))


def test_flights_are_those_of_python(part):
    total = 0
    for seed in range(16):
        flight = hops(seed)
        theirs = airborne(flight)
        assert flights_of(part, flight) == theirs, seed
        total += len(theirs)
    assert total > 16


@needs_flights
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("log", ALL)
def test_flights_of_a_log_are_those_of_python(part, log, precision):
    flight = logs.read(FLIGHTS / log)
    theirs = airborne(flight)
    assert theirs and flights_of(part, flight, precision) == theirs
