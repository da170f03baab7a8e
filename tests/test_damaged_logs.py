"""Damage inside valid framing: the answers to logs whose values or stamps are wrong, and the study that makes such logs."""

import lzma
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import framed_damage
import fuzzing
import rotorwatch as rw
from rotorwatch.logs import mavlink_frames, mavlink_messages, series
from rotorwatch.logs.dataflash_binary import BinaryLog
from rotorwatch.logs.dataflash_clock import make_clock
from rotorwatch_lab.simulation import scenario, simulate
from rotorwatch_lab.simulation.write_ulog import write_ulog

DAMAGED = Path(__file__).parents[1] / "../shared/flights/damaged"
SAMPLE = Path(rw.__file__).parent / "samples" / "quadx_healthy_hover.bin.xz"
TLOG = DAMAGED.parent / "ardupilot-sitl" / "quadx_m3_mul0.85_tlog.tlog.xz"


@cache
def sample() -> bytes:
    return lzma.open(SAMPLE).read()


@pytest.fixture(scope="module")
def ulog(tmp_path_factory) -> Path:
    """A healthy PX4 quad of our own that flies figures of eight for 40 s."""
    table = {"duration_s": 40.0, "seed": 2, "autopilot": "px4", "trajectory": {"kind": "figure-eight"}}
    table["airframe"] = {"frame": "quad-x", "mass_kg": 1.5, "arm_m": 0.25}
    path = tmp_path_factory.mktemp("px4") / "quad.ulg"
    write_ulog(simulate(scenario.from_table(table)).flight, path)
    return path


# -- the files that misled ---------------------------------------------------------------------------------------------

FILES = {
    "motb_one_bit.bin.xz": (("healthy",), 124.0),
    "rcou_one_value.bin.xz": (("healthy",), 99.2),
    "flip5_healthy_0.bin.xz": (("healthy", "inconclusive"), 124.0),
    "flip5_healthy_3.bin.xz": (("healthy", "inconclusive"), 124.0),
    "tlog_slow_107.tlog.xz": (("fault", "inconclusive"), 123.0),
    "text_46_bytes.log.xz": (("healthy", "inconclusive"), 123.8),
    "bin_11_places.bin.xz": (("healthy", "inconclusive"), 123.8),
    "bin_160_places.bin.xz": (("healthy", "inconclusive"), 123.8),
    "one_record_of_zeros.bin.xz": (("healthy",), 123.8),
    "ulog_last_stamp_one_bit.ulg.xz": (("healthy",), 60.0),
    "ulog_last_torque_stamp_one_bit.ulg.xz": (("healthy",), 60.0),
}


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("name", FILES)
def test_a_log_damaged_inside_its_framing(name):
    if not (DAMAGED / name).exists():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    verdicts, duration = FILES[name]
    found = rw.diagnose(DAMAGED / name)
    assert found.verdict in verdicts, found.reason
    assert {r for e in found.events for r in e.rotors} <= ({3} if name.startswith("tlog") else set())
    assert found.flight["duration_s"] == pytest.approx(duration, abs=1.0)
    assert found.warnings
    if "stamp" in name or name.startswith("tlog"):
        assert any("time" in w and "impossible" in w for w in found.warnings)


@pytest.mark.parametrize(
    "name, verdict, says",
    [
        ("gyro_in_degrees", "inconclusive", "the gyro turns 57.8 times as fast as the attitude: it seems to be in degrees/s"),
        ("outputs_held_3s", "inconclusive", "all outputs repeat from 74.6 to 77.5 s"),
    ],
)
def test_wrong_units_and_outputs_that_were_missed(name, verdict, says):
    if not (DAMAGED / f"{name}.bin.xz").exists():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    found = rw.diagnose(DAMAGED / f"{name}.bin.xz")
    assert found.verdict == verdict and says in " ".join((found.reason, *found.warnings))
    assert not [e for e in found.events if e.rotors]


@pytest.mark.parametrize("name, rotor, loss", [("gap_hides_loss_1", 1, 0.19), ("gap_hides_loss_2", 2, 0.37)])
def test_a_loss_soon_after_a_gap_in_the_air_is_found(name, rotor, loss):
    if not (DAMAGED / f"{name}.bin.xz").exists():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    found = rw.diagnose(DAMAGED / f"{name}.bin.xz")
    (event,) = found.events
    assert event.rotors == (rotor,) and event.interval[0][0] <= loss <= event.interval[0][1]
    assert event.detected_s - event.onset_s < 1.0  # what was learned before the gap holds after it
    assert len(found.flight["hops"]) == 1
    assert any("No motor outputs are logged from 33." in w and "in the air" in w for w in found.warnings)


# -- the same with our own logs ----------------------------------------------------------------------------------------


def changed(message: str, column: str, row: int, bit: int) -> bytes:
    """The sample with one bit of one value wrong."""
    data = bytearray(sample())
    log = BinaryLog(sample())
    _, fmt, records = next(v for v in log._versions(message) if v[2].size)
    at = int(log._at[records[row]]) + fmt.dtype.fields[column][1] + bit // 8
    data[at] ^= 1 << (bit % 8)
    return bytes(data)


def diagnosed(data: bytes, folder: Path, name="log.bin"):
    path = folder / name
    path.write_bytes(data)
    return rw.diagnose(path)


@pytest.mark.parametrize("bit", [19, 21, 22])
def test_one_bit_of_the_battery_factor(tmp_path, bit):
    found = diagnosed(changed("MOTB", "BatVolt", 500, bit), tmp_path)
    assert found.verdict == "healthy"
    assert any(w.startswith("lift (MOTB)") for w in found.warnings)


@pytest.mark.parametrize("bit", [4, 7, 9])
def test_one_bit_of_one_output(tmp_path, bit):
    found = diagnosed(changed("RCOU", "C3", 500, bit), tmp_path)
    assert found.verdict == "healthy"
    assert any(w.startswith("motors (RCOU)") for w in found.warnings)


@pytest.mark.thorough(keep=4)
@pytest.mark.parametrize("bit", [23, 26, 31, 36, 45, 63])
@pytest.mark.parametrize("message", ["IMU", "RCOU"])
def test_one_bit_of_the_last_time_stamp(tmp_path, message, bit):
    path = tmp_path / "log.bin"
    path.write_bytes(changed(message, "TimeUS", -1, bit))
    flight = rw.read(path)
    assert flight.duration == pytest.approx(rw.read(SAMPLE).duration, abs=0.5)
    assert any("time stamp" in w for w in flight.warnings)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("bit", [23, 26, 31])
def test_one_bit_of_the_first_time_stamp(tmp_path, bit):
    path = tmp_path / "log.bin"
    path.write_bytes(changed("IMU", "TimeUS", 0, bit))
    flight, intact = rw.read(path), rw.read(SAMPLE)
    assert flight.duration == pytest.approx(intact.duration, abs=0.5)
    assert abs(flight.start_us - intact.start_us) < 0.5e6


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("bit", [23, 26, 36])
@pytest.mark.parametrize("last", [True, False])
def test_one_bit_of_a_ulogs_stamp(ulog, tmp_path, bit, last):
    data = bytearray(ulog.read_bytes())
    found = framed_damage.records(bytes(data), "quad.ulg")
    k = np.flatnonzero(found.stamp_size > 0)[-1 if last else 0]
    data[found.stamp[k] + bit // 8] ^= 1 << (bit % 8)
    path = tmp_path / "quad.ulg"
    path.write_bytes(bytes(data))
    flight = rw.read(path)
    assert flight.duration == pytest.approx(40.0, abs=1.0)
    assert flight.start_us == rw.read(ulog).start_us


def test_the_header_of_a_ulog_with_a_wrong_start(ulog, tmp_path):
    data = bytearray(ulog.read_bytes())
    data[8 + 3] ^= 0x10  # 268 s
    path = tmp_path / "quad.ulg"
    path.write_bytes(bytes(data))
    flight = rw.read(path)
    assert flight.duration == pytest.approx(40.0, abs=1.0) and len(flight["motors"]) == len(rw.read(ulog)["motors"])
    assert any("start time" in w for w in flight.warnings)


@pytest.mark.parametrize("digit", [1e2, 4e3, 8e5])
def test_one_digit_of_the_last_time_in_a_table(digit):
    time = np.arange(0.0, 20.0, 0.05)
    time[-1] += digit
    assert series.steady(time).tolist() == list(range(time.size - 1))


def test_a_few_records_long_after_the_flight_are_believed():
    """Logs are closed half a minute after disarming: no single bit makes 31 s."""
    stamps = np.r_[np.arange(0.0, 60e6, 0.01e6), 91.0e6, 91.1e6]
    clock = make_clock(stamps)
    assert clock.good.all() and clock.end == pytest.approx(91.1) and clock.warnings == ()


def test_days_without_commands_cost_nothing(tmp_path):
    """Two flights, and a clock that says a day lies between them: ticks are made where commands are."""
    flight = rw.read(SAMPLE)
    late = {k: rw.Signal(np.r_[s.time, s.time + 80_000.0], np.r_[s.values, s.values], s.columns, s.unit, s.frame, s.source)
            for k, s in flight.signals.items()}  # fmt: skip
    both = replace(flight, signals=late, duration=flight.duration + 80_000.0)
    found = rw.diagnose(both)
    assert found.verdict == "healthy" and found.trace is not None
    assert found.trace.time.size < 2.2 * rw.diagnose(flight).trace.time.size  # pyright: ignore[reportOptionalMemberAccess]


# -- the study ---------------------------------------------------------------------------------------------------------


def stamps(data):
    return BinaryLog(data).stamps()


def test_each_kind_of_damage_does_what_it_says():
    data, rng = sample(), np.random.default_rng(0)
    found = framed_damage.records(data, "a.bin")
    n, whole = found.start.size, BinaryLog(data).record_count
    out = {kind: framed_damage.damaged(data, found, kind, 0.05, rng) for kind in fuzzing.KINDS}
    many = round(0.05 * n)
    assert BinaryLog(out["dropped"]).record_count == whole - many
    assert BinaryLog(out["doubled"]).record_count == whole + many
    for kind in ("bit flips", "swapped", "wrong times"):
        assert len(out[kind]) == len(data) and BinaryLog(out[kind]).record_count == whole
    wrong = np.frombuffer(out["bit flips"], np.uint8) ^ np.frombuffer(data, np.uint8)
    assert np.unpackbits(wrong).sum() == many
    late = stamps(out["wrong times"]) != stamps(data)
    assert 0.9 * many <= late[np.isfinite(stamps(data))].sum() <= many
    assert np.array_equal(np.sort(stamps(out["swapped"])), np.sort(stamps(data)), equal_nan=True)
    assert (stamps(out["swapped"]) != stamps(data)).any()


def test_damage_leaves_a_ulog_readable(ulog):
    from io import BytesIO

    from pyulog import ULog

    data = ulog.read_bytes()
    found = framed_damage.records(data, "quad.ulg")
    for kind in fuzzing.KINDS:
        damaged = framed_damage.damaged(data, found, kind, 0.05, np.random.default_rng(1))
        assert damaged != data and not ULog(BytesIO(damaged)).file_corruption


def test_check_sums_of_a_telemetry_log_are_made_right():
    if not TLOG.exists():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    data = lzma.open(TLOG).read()[:200_000]
    damaged = framed_damage.damaged(data, framed_damage.records(data, "a.tlog"), "bit flips", 0.2, np.random.default_rng(1))
    layouts = mavlink_messages.by_id()
    for bytes_ in (data, damaged):
        frames = mavlink_frames.Frames(bytes_, layouts)
        whole = sum(len(places) for places, _ in frames.found.values())
        sound = sum(frames.decode(s, c, layouts[m])[0].size for s, c, m in frames.found)
        assert sound == whole and frames.skipped < 300


def test_what_an_answer_to_a_damaged_log_is_worth():
    class Answer:
        def __init__(self, verdict, *events):
            self.verdict, self.events = verdict, [type("E", (), {"rotors": r, "alternatives": a}) for r, a in events]

    def worth(intact, damaged):
        return fuzzing.compared(intact, damaged)  # pyright: ignore[reportArgumentType]

    healthy, fault = Answer("healthy"), Answer("fault", ((3,), ()))
    assert worth(healthy, healthy) == worth(fault, fault) == "same"
    assert worth(healthy, fault) == "false fault"
    assert worth(fault, Answer("fault", ((2,), ()))) == "wrong rotor"
    assert worth(fault, Answer("fault", ((3,), ()), ((2,), ()))) == "wrong rotor"
    assert worth(fault, healthy) == "missed"
    assert worth(fault, Answer("ambiguous", ((2,), ((3,),)))) == "ambiguous"
    assert worth(healthy, Answer("inconclusive")) == "inconclusive"


@pytest.mark.thorough
@pytest.mark.parametrize("which", ["bin", "ulg"])
def test_a_small_study_makes_nothing_up(which, ulog):
    path = SAMPLE if which == "bin" else ulog
    table, failures = fuzzing.framed(path, copies=3, seed=4)
    assert failures == [] and {kind: sum(row.values()) for kind, row in table.items()} == dict.fromkeys(fuzzing.KINDS, 3)
    assert sum(row["same"] for row in table.values()) >= 12


def test_damage_is_made_only_where_the_framing_is_known():
    with pytest.raises(ValueError, match="only"):
        framed_damage.records(b"time_s,motor_1\n0,1\n", "a.csv")


def test_one_bit_of_the_name_of_a_servo_function_puts_no_two_rotors_on_one_output():
    """SERVO6_FUNCTION became SERVO7_FUNCTION, and is logged before it."""
    from rotorwatch.logs import dataflash_rotors

    functions = {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 9) if k != 6} | {"SERVO7_FUNCTION": 38.0}
    assert dataflash_rotors.outputs(functions, 3, {})[0] == {k: k for k in range(1, 9)}


@pytest.mark.parametrize("wrong", [34.5, 32.0, 35.0, 50.0, 2.0])
def test_one_bit_of_a_servo_function_is_no_other_rotor(wrong):
    """35 is motor 3, which output 3 says it is, too."""
    from rotorwatch.logs import dataflash_rotors, parameter_ranges

    functions = {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 5)} | {"SERVO2_FUNCTION": wrong}
    fine, _ = parameter_ranges.checked(functions)
    outputs, notes = dataflash_rotors.outputs(fine, 1, {})
    if wrong != 2.0:  # two bits away: that output is something else
        assert outputs == {1: 1, 2: 2, 3: 3, 4: 4} and notes
    else:
        assert 2 not in outputs
