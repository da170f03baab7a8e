"""Damaged DataFlash logs: read what is intact, say what is wrong, never anything but LogError."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.errors import LogError
from rotorwatch.logs import dataflash
from rotorwatch.logs.dataflash_binary import BinaryLog

CORRUPT = Path(__file__).parents[2] / "shared" / "flights" / "corrupt"
pytestmark = pytest.mark.skipif(not CORRUPT.exists(), reason=f"test flights are not at {CORRUPT}")
RELAXED = settings(deadline=2000, max_examples=trials(150), suppress_health_check=[HealthCheck.too_slow])


@cache
def _bytes(name: str = "intact_reference.bin") -> bytes:
    return (CORRUPT / name).read_bytes()


def _check(data: bytes):
    """Read; the result must hold what Flight promises."""
    try:
        flight = dataflash.read(data, "damaged.bin")
    except LogError as error:
        assert str(error).startswith("damaged.bin: ") and str(error).endswith(".")
        return None
    for signal in flight.signals.values():
        assert np.isfinite(signal.values).all()
        assert (np.diff(signal.time) >= 0).all() and signal.time[0] >= 0
        assert signal.time[-1] <= flight.duration + 1e-9
    assert not any(name.startswith("SIM_") for name in flight.parameters)
    return flight


def _flight(name: str = "intact_reference.bin"):
    flight = _check(_bytes(name))
    assert flight is not None
    return flight


def test_intact_reference():
    log = BinaryLog(_bytes())
    assert (log.record_count, log.warnings) == (679, [])
    assert log.counts["IMU"] == 200


def test_truncated_in_a_record():
    assert BinaryLog(_bytes("truncated_mid_message.bin")).record_count == 438
    flight = _flight("truncated_mid_message.bin")
    assert "The log ends inside a record; the incomplete record was dropped." in flight.warnings


def test_flipped_bytes():
    flight, intact = _flight("flipped_bytes.bin"), _flight()
    assert any("damaged in 9 places" in w for w in flight.warnings)
    assert flight.duration == pytest.approx(intact.duration, abs=0.2)
    for name, least in (("motors", 70), ("gyro", 180), ("rates", 70), ("attitude", 70)):
        assert least <= len(flight[name]) <= len(intact[name]), name
    motors = flight["motors"]
    assert motors.values[motors.valid].max() < 2600 and np.abs(flight["accel"].values).max() < 640


def test_zero_tail_changes_nothing():
    flight, intact = _flight("zero_tail.bin"), _flight()
    assert any("empty" in w for w in flight.warnings)
    for name, signal in intact.signals.items():
        np.testing.assert_array_equal(flight[name].values, signal.values)
        np.testing.assert_array_equal(flight[name].time, signal.time)


def test_clock_that_jumps_back():
    flight, intact = _flight("time_jumps_backwards.bin"), _flight()
    assert any("jumps back by 3.0 s" in w for w in flight.warnings)
    assert len(flight["gyro"]) == len(intact["gyro"])
    np.testing.assert_allclose(flight["gyro"].time, intact["gyro"].time, atol=0.2)


@pytest.mark.parametrize("name", ["empty.bin", "header_only.bin", "ulog_with_wrong_extension.bin"])
def test_no_data(name):
    assert _check(_bytes(name)) is None


@RELAXED
@given(st.integers(0, 33298))
def test_truncation_anywhere(length):
    _check(_bytes()[:length])


@RELAXED
@given(st.lists(st.tuples(st.integers(0, 33297), st.integers(0, 255)), max_size=300))
def test_random_bytes_changed(changes):
    data = bytearray(_bytes())
    for at, value in changes:
        data[at] = value
    _check(bytes(data))


@RELAXED
@given(st.integers(0, 33297), st.integers(0, 4000), st.binary(max_size=200))
def test_a_piece_replaced(at, removed, inserted):
    _check(_bytes()[:at] + inserted + _bytes()[at + removed :])


@RELAXED
@given(st.binary(max_size=300), st.integers(0, 33297))
def test_text_with_damage(inserted, at):
    from test_dataflash_pymavlink import as_text

    text = _text(as_text)
    at %= len(text)
    _check(text[:at] + inserted + text[at + len(inserted) :])


@cache
def _text(as_text) -> bytes:
    return as_text(BinaryLog(_bytes()))
