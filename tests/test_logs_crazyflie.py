"""Crazyflie uSD logs: units, axes, and damage."""

import lzma
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import logs
from rotorwatch.errors import LogError
from rotorwatch.logs import usd as reader

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights" / "crazypad"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the folder of test flights, ../shared/flights, is missing")


def usd(rows, variables, version=2, other=()):
    """A log with one fixed-frequency event (id 255) and, before each row in `other`, an event 0 with one byte."""
    data = bytes([0xBC]) + struct.pack("<HH", version, 2)
    data += struct.pack("<H", 255) + b"fixedFrequency\0" + struct.pack("<H", len(variables))
    data += b"".join(f"{name}({code})\0".encode() for name, code in variables)
    data += struct.pack("<H", 0) + b"mode\0" + struct.pack("<H", 1) + b"mode(B)\0"
    stamp = "Q" if version == 2 else "I"
    layout = "<H" + stamp + "".join(code for _, code in variables)
    for k, row in enumerate(rows):
        if k in other:
            data += struct.pack("<H" + stamp + "B", 0, 1000 + 10 * k, 1)
        data += struct.pack(layout, 255, (10_000 * k + 5_000_000) if version == 2 else 10 * k + 5000, *row)
    return data + struct.pack("<I", zlib.crc32(data))


VARIABLES = [*((f"motor.m{k}", "H") for k in (1, 2, 3, 4)), *((f"gyro.{a}", "f") for a in "xyz")]
VARIABLES += [*((f"acc.{a}", "f") for a in "xyz"), ("pm.vbat", "f")]
ROW = (65535, 0, 32768, 13107, 57.29578, 10, 20, 0.1, 0.2, 1.0, 3.7)


@pytest.mark.parametrize("version", [1, 2])
def test_units_and_axes_of_body_signals(version):
    flight = reader.read(usd([ROW] * 50, VARIABLES, version, other=(3, 17)), "x.usd")
    assert flight.start_us == 5_000_000 and len(flight["motors"]) == 50
    assert np.allclose(flight["motors"].values[0], [1, 0, 0.5, 0.2], atol=1e-4) and flight["motors"].unit == "1"
    assert np.allclose(flight["gyro"].values[0], np.radians([57.29578, -10, -20]))
    assert np.allclose(flight["accel"].values[0], np.array([0.1, -0.2, -1.0]) * 9.80665)
    assert flight["battery"].values[0, 0] == pytest.approx(3.7) and not flight["battery"].valid[:, 1].any()
    assert flight["motors"].rate_hz == pytest.approx(100) and flight.warnings == ()


def test_world_acceleration_becomes_specific_force_in_the_body():
    names = [f"stateEstimate.{n}" for n in ("ax", "ay", "az", "roll", "pitch", "yaw", "x", "y", "z")]
    # Level, facing the world's y (left of x), pushed along world y with 0.5 g: that is forward in the body.
    rows = [(0.0, 0.5, 0.0, 0.0, 0.0, 90.0, 1.0, 2.0, 3.0)] * 10
    flight = reader.read(usd(rows, [(n, "f") for n in names]), "x.usd")
    assert np.allclose(flight["accel"].values[0] / 9.80665, [0.5, 0, -1], atol=1e-6)
    assert np.allclose(flight["position"].values[0], [1, -2, -3])
    # Rolled 30 degrees right and hovering: the rotors push along body -z only if that balances; here nothing else does.
    flight = reader.read(usd([(0.0, 0.0, 0.0, 30.0, 0.0, 0.0, 0, 0, 0)] * 10, [(n, "f") for n in names]), "x.usd")
    assert np.allclose(flight["accel"].values[0] / 9.80665, [0, -0.5, -np.sqrt(0.75)], atol=1e-6)


COMMANDS = [(f"controller.cmd_{n}", "f") for n in ("thrust", "roll", "pitch", "yaw")]


@pytest.mark.parametrize(
    "command, motors",
    [
        ((40000.0, 0.0, 0.0, 0.0), (40000, 40000, 40000, 40000)),
        ((40000.0, 2001.0, 0.0, 0.0), (39000, 39000, 41000, 41000)),  # roll right: the left motors; halves are cut off
        ((40000.0, 0.0, 2000.0, 0.0), (41000, 39000, 39000, 41000)),
        ((40000.0, 0.0, 0.0, 500.0), (40500, 39500, 40500, 39500)),
        ((1000.0, 0.0, 0.0, -2000.0), (0, 3000, 0, 3000)),
    ],
)
def test_motors_are_rebuilt_from_the_controllers_outputs(command, motors):
    flight = reader.read(usd([command + ROW[4:]] * 30, COMMANDS + VARIABLES[4:]), "x.usd")
    assert np.allclose(flight["motors"].values[0] * 65535, motors) and flight["motors"].valid.all()
    assert flight["motors"].source == "controller.cmd_*" and any("rebuilt" in w for w in flight.warnings)


def test_rebuilt_motors_beyond_full_command_are_not_known_and_logged_motors_go_first():
    rows = [((60000.0, 0.0, 12000.0, 0.0) if k > 20 else (30000.0, 0.0, 0.0, 0.0)) + ROW[4:] for k in range(40)]
    flight = reader.read(usd(rows, COMMANDS + VARIABLES[4:]), "x.usd")
    assert flight["motors"].valid.all(axis=1).sum() == 21
    both = reader.read(usd([(30000.0, 0, 0, 0, *ROW)] * 9, COMMANDS + VARIABLES), "x.usd")
    assert both["motors"].source == "motor.m1..m4" and both.warnings == ()


@needs_flights
def test_real_hover_flights():
    for path in sorted(FLIGHTS.glob("normal*.xz")):
        flight = logs.read(path)
        high = -flight["position"].values[:, 2] > 0.35
        assert flight["motors"].rate_hz == pytest.approx(100, rel=0.03)
        assert 0.4 < np.median(flight["motors"].values[high]) < 0.8
        assert np.median(flight["accel"].values[high, 2]) == pytest.approx(-9.8, abs=0.3)
        assert 3.0 < np.median(flight["battery"].values[:, 0]) < 4.3


def test_a_wrong_check_sum_is_a_warning():
    data = bytearray(usd([ROW] * 50, VARIABLES))
    data[-30] ^= 1
    assert "check sum" in reader.read(bytes(data), "x.usd").warnings[0]


def test_damage_in_the_middle_keeps_what_came_before():
    good = usd([ROW] * 50, VARIABLES)
    hurt = bytearray(good)
    record = 2 + 8 + 4 * 2 + 7 * 4
    hurt[len(good) - 4 - 20 * record] = 99  # an event id that nobody declared
    flight = reader.read(bytes(hurt), "x.usd")
    assert len(flight["motors"]) == 30 and "30 records" in flight.warnings[0]


def test_truncation_and_damage_anywhere_is_read_or_refused(amount):
    data = usd([ROW] * 40, VARIABLES)
    rng = np.random.default_rng(5)
    trials = [data[:end] for end in range(6, len(data), amount(17, 7))]
    for _ in range(amount(80, 200)):
        hurt = np.frombuffer(data, np.uint8).copy()
        where = rng.integers(5, rng.choice([200, hurt.size]), 3)
        hurt[where] = rng.integers(0, 256, 3)
        trials.append(hurt.tobytes())
    outcomes = []
    for trial in trials:
        try:
            flight = logs._checked(lambda t=trial: reader.read(t, "x"), reader, Path("x"), ())
            outcomes.append(all(np.isfinite(s.values).all() for s in flight.signals.values()))
        except LogError:
            outcomes.append(None)
    assert set(outcomes) == {True, None}


def test_recognised_by_content_only():
    assert reader.sniff(usd([ROW], VARIABLES)[:100], "") and not reader.sniff(b"\xbc\x02\x00\x01\x07\x00", "x.usd")
    with pytest.raises(LogError, match="fixedFrequency"):
        reader.read(bytes([0xBC, 2, 0, 1, 0]) + b"\0\0mode\0\0\0" + bytes(20), "x.usd")


@needs_flights
def test_the_check_sum_of_a_real_log_holds():
    data = lzma.decompress(next(FLIGHTS.glob("normal*E9*.xz")).read_bytes())
    assert not [w for w in reader.read(data, "x").warnings if "sum" in w]


def test_a_battery_in_millivolts_goes_before_one_in_volts():
    flight = reader.read(usd([(*ROW, 3900)] * 9, [*VARIABLES, ("pm.vbatMV", "H")]), "x.usd")
    assert flight["battery"].values[0, 0] == pytest.approx(3.9)


def test_angles_in_degrees_turn_as_the_firmware_says():
    """Roll right and nose up as they are, yaw the other way round; without pitch it is taken as none."""
    names = ("roll", "pitch", "yaw")
    for angles, axis in (((90.0, 0.0, 0.0), 1), ((0.0, 90.0, 0.0), 2), ((0.0, 0.0, -90.0), 3)):
        variables = [*VARIABLES, *((f"stateEstimate.{n}", "f") for n in names)]
        q = reader.read(usd([(*ROW, *angles)] * 9, variables), "x.usd")["attitude"].values[0]
        assert q[0] == pytest.approx(np.sqrt(0.5)) and q[axis] == pytest.approx(np.sqrt(0.5))
    flight = reader.read(usd([(*ROW, 0.0, -90.0)] * 9, [*VARIABLES, ("stateEstimate.roll", "f"), ("stateEstimate.yaw", "f")]), "x.usd")
    assert flight["attitude"].values[0] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    assert any("pitch was not logged" in w for w in flight.warnings)
