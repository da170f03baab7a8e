"""Outputs against the mixer in C: what motion/departures.py finds, sample by sample, in double to the last digits, in float the same."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest

from embedded_c_parts import LASTS, SOURCES, STRICT, STUBS, Part, compilers, config
from rotorwatch import airframes
from rotorwatch.flight import Signal
from rotorwatch.motion.allocation import Comparison
from rotorwatch.motion.departures import Watch

KINDS = ("stuck", "off", "overridden")
FRAMES = {4: "ardupilot-quad-x", 6: "ardupilot-hexa-x"}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("departures")
    made = {}
    for n in FRAMES:
        (folder / str(n)).mkdir()
        made[n] = Part(folder / str(n), "drive_departures.c", ("rw_departures.c",), n)
    return made


def flown(n, seed):
    """A flight of n rotors whose outputs get stuck, stop, and part from the mixer: vehicle, comparison, outputs, aloft."""
    rng = np.random.default_rng(seed)
    vehicle = airframes.named(FRAMES[n])
    vehicle = replace(vehicle, extra={**vehicle.extra, "rests_at_minimum": bool(rng.integers(2))})
    low, span = vehicle.curve.u_min, vehicle.curve.u_max - vehicle.curve.u_min
    m, rate = 1200, 20.0
    time = 3.0 + np.cumsum(rng.uniform(0.7, 1.3, m)) / rate
    wave = np.cumsum(rng.normal(0.0, 0.02, (m, n)), axis=0)
    yaw = rng.choice([0.0, 0.1]) * np.sin(0.7 * time)[:, None] * (-1.0) ** np.arange(n)
    asked = np.clip(0.45 + 0.08 * np.sin(wave + np.arange(n)) + rng.normal(0, 0.004, (m, n)), 0.02, 1.1) + yaw
    if rng.random() < 0.3:  # a vehicle near its limits
        asked += rng.uniform(0.3, 0.55)
    top = np.full((m, 1), rng.choice([1.0, 0.9]))
    got = np.clip(asked + rng.normal(0, 0.003, (m, n)), 0.0, top)
    if rng.random() < 0.3:  # all share a gain
        got *= rng.uniform(0.9, 1.0)
    output = low + span * got
    for _ in range(rng.integers(1, 6)):
        k, first = rng.integers(n), rng.integers(60, m - 40)
        part = slice(first, first + rng.integers(2, 400))
        kind = rng.integers(6)
        if kind == 0:
            output[part, k] = output[first, k]
        elif kind == 1:
            output[part, k] = low - rng.choice([0.0, 0.03, 0.2]) * span
        elif kind == 2:
            output[part, k] += rng.choice([-0.2, 0.04, 0.1]) * span
        elif kind == 3:
            output[part, k] = low + span
        elif kind == 4:
            output[part] = np.round(output[part] / span * 30.0) / 30.0 * span
        else:
            output[part, k] = low
    demand = np.clip((output - low) / span, 0.0, 1.0)
    aloft = (time > 4.0) & ~((time > 40.0) & (time < 40.0 + 4.0 * rng.random()))
    deviation = demand - np.clip(asked, 0.0, top)
    none = np.zeros((m, 5, n))
    granted = rng.random(m) < 0.5
    check = Comparison(time, time + 0.01, demand, asked, top, yaw, granted, deviation, none, none[:, 0] > 0)
    valid = np.repeat(rng.random((m, 1)) < 0.99, n, axis=1)
    names = tuple(f"r{k + 1}" for k in range(n))
    return vehicle, check, Signal(time, output, names, "", "body", "", valid), aloft


def spans(time, aloft):
    """The same as intervals."""
    edge = np.flatnonzero(np.diff(np.r_[0, aloft.astype(int), 0]))
    late = np.r_[time, time[-1] + 1.0]
    return tuple((late[a], late[b]) for a, b in zip(edge[::2], edge[1::2]))


def both(part, flight, precision, cuts):
    """What C and Python have found after each of the samples `cuts`."""
    vehicle, check, motors, aloft = flight
    rows = [vehicle.effectiveness(), [vehicle.curve.u_min, vehicle.curve.u_max, vehicle.extra["rests_at_minimum"]]]
    watch, expected, start = Watch(vehicle), [], 0
    air = spans(check.time, aloft)
    for stop in cuts:
        for i in range(start, stop):
            c = (check.demand[i], check.asked[i], check.yaw[i], check.deviation[i], motors.values[i])
            rows.append(
                [
                    0.0,
                    check.time[i],
                    check.known[i],
                    aloft[i],
                    check.yaw_granted[i],
                    check.top[i, 0],
                    *np.concatenate(c),
                ]
            )
            whole = motors.valid[i].all()
            rows.append([1.0, motors.time[i], whole, aloft[i], *motors.values[i], *check.demand[i]])
        rows.append([2.0])
        watch.compared(check[start:stop], motors.values[start:stop], air)
        watch.logged(motors.part(slice(start, stop)), check.demand[start:stop], air)
        expected.append(watch.found())
        start = stop
    said = part.run(rows, precision)
    return [[[float(x) for x in line.split()] for line in block] for block in said], expected


@pytest.mark.parametrize("n", FRAMES)
def test_overrides_are_those_of_python(parts, n):
    told = 0
    for seed in range(12):
        flight = flown(n, seed)
        found, expected = both(parts[n], flight, "double", (300, 511, 802, 1200))
        for ours, theirs in zip(found, expected, strict=True):
            assert [(o[0] + 1, KINDS[int(o[1])]) for o in ours] == [(o.rotor, o.kind) for o in theirs], seed
            for o, p in zip(ours, theirs):
                asked = -1.0 if p.asked is None else p.asked
                assert o[2:5] == [p.onset, p.detected, LASTS if p.end is None else p.end]
                assert o[6] == pytest.approx(asked, abs=1e-12)
            told += len(theirs)
    assert told > 40


def test_single_precision_finds_the_same(parts):
    same = 0
    for seed in range(12):
        found, expected = both(parts[4], flown(4, seed), "float", (1200,))
        ours = [(o[0] + 1, KINDS[int(o[1])], round(o[2], 3), round(o[3], 3)) for o in found[0]]
        theirs = [(o.rotor, o.kind, round(o.onset, 3), round(o.detected, 3)) for o in expected[0]]
        same += ours == theirs
    assert same >= 11  # a value on its limit may fall to either side


def test_a_landing_that_is_known_later_ends_what_lasted(parts):
    """Samples after the landing are judged as flown, taken back when the landing is known, and not fed again."""
    told = 0
    for seed in range(6):
        vehicle, check, motors, aloft = flown(4, seed)
        landed, known = 600, 640
        aloft[landed:] = False
        b = vehicle.effectiveness()
        rows = [b, [vehicle.curve.u_min, vehicle.curve.u_max, vehicle.extra["rests_at_minimum"]]]
        for i in range(len(check.time)):
            if i == landed:
                rows.append([3.0])
            if i == known:
                rows.append([4.0, check.time[landed], motors.time[landed]])
            flying = aloft[i] or landed <= i < known
            c = (check.demand[i], check.asked[i], check.yaw[i], check.deviation[i], motors.values[i])
            rows.append(
                [0.0, check.time[i], check.known[i], flying, check.yaw_granted[i], check.top[i, 0], *np.concatenate(c)]
            )
            rows.append([1.0, motors.time[i], motors.valid[i].all(), flying, *motors.values[i], *check.demand[i]])
        said = parts[4].run([*rows, [2.0]], "double")[0]
        watch, air = Watch(vehicle), spans(check.time, aloft)
        watch.compared(check, motors.values, air)
        watch.logged(motors, check.demand, air)
        theirs = [(o.rotor - 1, o.onset, LASTS if o.end is None else o.end) for o in watch.found()]
        ours = [tuple(map(float, line.split())) for line in said]
        assert [(o[0], o[2], o[4]) for o in ours] == theirs, seed
        told += sum(abs(end - check.time[landed]) < 1e-9 for _, _, end in theirs)
    assert told


@pytest.mark.parametrize("precision", [(), ("-DROTORWATCH_FLOAT",)])
@pytest.mark.parametrize("n", [3, 8, 12])
def test_no_warning_whatever_the_number_of_rotors(tmp_path, n, precision):
    (tmp_path / "rw_config.h").write_text(config(n))
    for compiler in compilers():
        for source in sorted(SOURCES.glob("rw_*.c")):
            command = [
                compiler,
                *STRICT,
                *precision,
                "-fsyntax-only",
                *(f"-I{folder}" for folder in (tmp_path, SOURCES, STUBS)),
            ]
            subprocess.run([*command, str(source)], check=True)
