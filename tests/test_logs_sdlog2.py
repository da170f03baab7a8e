"""PX4's old log format sdlog2, on logs made here."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, diagnose, logs
from rotorwatch.errors import LogError
from rotorwatch.logs import dataflash, sdlog2
from test_dataflash import Writer

SAMPLES = Path(__file__).resolve().parents[1] / "src" / "rotorwatch" / "samples"
FAULTY, ONSET = "hexax_m3_mul0.80_square_wind.bin.xz", 47.60  # rotor 3
FORMATS = {
    "ATT": ("f" * 13, "qw,qx,qy,qz,Roll,Pitch,Yaw,RollRate,PitchRate,YawRate,GX,GY,GZ"),
    "ATSP": ("f" * 8, "RollSP,PitchSP,YawSP,ThrustSP,qw,qx,qy,qz"),
    "IMU": ("f" * 12, "AccX,AccY,AccZ,GyroX,GyroY,GyroZ,MagX,MagY,MagZ,tA,tG,tM"),
    "LPOS": ("ffffffffLLfBBff", "X,Y,Z,Dist,DistR,VX,VY,VZ,RLat,RLon,RAlt,PFlg,GFlg,EPH,EPV"),
    "ATTC": ("ffff", "Roll,Pitch,Yaw,Thrust"),
    "STAT": ("BBBBB", "MainState,NavState,ArmS,Failsafe,IsRotWing"),
    "OUT0": ("f" * 8, "Out0,Out1,Out2,Out3,Out4,Out5,Out6,Out7"),
    "BATT": ("ffffffB", "V,VFilt,C,CFilt,Discharged,Remaining,Warning"),
    "LAND": ("B", "Landed"),
    "TIME": ("Q", "StartTime"),
    "VER": ("NZ", "Arch,FwGit"),
    "PARM": ("Nf", "Name,Value"),
}


@cache
def origin():
    return logs.read(SAMPLES / FAULTY)


@cache
def made(angles=False, step=0.02) -> bytes:
    """The faulty sample as PX4 1.5 would have logged it, 50 times a second, starting 100 s after boot."""
    flight, log = origin(), Writer()
    log.data = b""  # sdlog2 does not define FMT itself
    for name, (codes, columns) in FORMATS.items():
        type_ = {"TIME": 129, "VER": 130, "PARM": 131}.get(name)
        if angles and name == "ATT":
            codes, columns = "f" * 9, columns.split(",", 4)[4]
        log.define(name, codes, columns, type_)
    log.add("VER", b"PX4FMU_V2", b"8b81cf5c7ece0c228eaaea3e9d8e667fc4d21a06")
    for name, value in {"MAV_TYPE": 13, "SYS_AUTOSTART": 6001, "THR_MDL_FAC": 0.0, "PWM_MIN": 1150, "SIM_SPEED": 9}.items():
        log.add("PARM", name.encode(), value)

    def at(signal, t):
        s = flight[signal]
        return s.values[np.searchsorted(s.time, t).clip(0, len(s) - 1)]

    for k in range(int(flight.duration / step)):
        t = k * step
        log.add("TIME", 100_000_000 + round(1e6 * t))
        w, x, y, z = at("attitude", t)
        roll, yaw = (np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        gyro = at("gyro", t)
        log.add("ATT", *([] if angles else [w, x, y, z]), roll, pitch, yaw, *gyro, 0, 0, 0)
        log.add("IMU", *at("accel", t), *gyro, *[0] * 6)
        log.add("OUT0", *at("motors", t), 0, 0)
        log.add("ATTC", 0, 0, 0, float(at("throttle", t)[0]))
        if k % 5 == 0:
            log.add("LPOS", *at("position", t), 0, 0, *at("velocity", t), 0, 0, 0, 0, 0, 0, 0)
            log.add("STAT", 2, 2, 2 if 1 < t < flight.duration - 1 else 1, 0, 1)
            log.add("LAND", int(t < 5))
            log.add("BATT", *[at("battery", t)[0]] * 2, -1, -1, 0, 0, 0)
    return log.data


@cache
def flight(angles=False):
    return sdlog2.read(made(angles), "x.bin")


@pytest.mark.parametrize("name", ["log.bin", "log.px4log", "log.ulg", "log.log", "x"])
def test_it_is_recognised_by_content_whatever_the_file_is_called(tmp_path, name):
    assert not dataflash.sniff(made()[: logs.HEAD], name) and sdlog2.sniff(made()[: logs.HEAD], "")
    path = tmp_path / name
    path.write_bytes(made()[:60_000])
    read = logs.read(path)
    assert read.format == "PX4 sdlog2" and read.autopilot == "PX4" and "sdlog2" in read.warnings[0]


def test_ardupilots_logs_are_not_taken_for_it():
    log = Writer()
    log.define("ATT", "Qcccc", "TimeUS,DesRoll,Roll,DesPitch,Pitch")
    assert dataflash.sniff(log.data, "") and not sdlog2.sniff(log.data, "")


@pytest.mark.parametrize("angles", [False, True])
def test_signals_have_the_values_units_and_times_that_were_logged(angles):
    read, was = flight(angles), origin()
    assert read.start_us == 100_000_000 and read.firmware == "PX4 8b81cf5c" and read.vehicle_type == "hexarotor"
    assert read.rotor_count == 6 and read["motors"].unit == "us" and read["motors"].source == "OUT0"
    for name in ("gyro", "accel", "velocity", "motors", "attitude"):
        ours, theirs = read[name], was[name]
        at = np.searchsorted(theirs.time, ours.time).clip(0, len(theirs) - 1)
        close = np.isclose(ours.values, theirs.values[at], atol=1e-3).all(axis=1)
        if name == "attitude":
            close = np.abs(np.sum(ours.values * theirs.values[at], axis=1)) > 1 - 1e-5
        assert close.mean() > 0.98, name  # the rest lies at the edge of a step
    assert read["gyro"].rate_hz == pytest.approx(50, rel=1e-3)
    assert not read["battery"].valid[:, 1].any()  # logged as -1: no current sensor
    assert "SIM_SPEED" not in read.parameters


def test_the_frame_comes_from_the_parameters_and_the_weak_rotor_is_found():
    assert airframes.identify(flight()).name == "px4-hexa-x"
    diagnosis = diagnose(flight())
    event = max((e for e in diagnosis.events if e.kind == "loss_of_effectiveness"), key=lambda e: e.probability)
    assert event.rotors == (3,) and event.onset_s == pytest.approx(ONSET, abs=1.5)


def test_state_changes_become_messages():
    kinds = {(m.kind, m.text) for m in flight().messages}
    assert {("armed", "armed"), ("armed", "disarmed"), ("landed", "in the air"), ("mode", "Position")} <= kinds


def outcome(data):
    """The Flight, or None where a sentence came instead; anything else fails."""
    try:
        module = logs.recognise(bytes(data[: logs.HEAD]), "x.bin")
        if module is None:
            return None
        read = logs._checked(lambda: module.read(data, "x.bin"), module, Path("x.bin"), ())
    except LogError as error:
        assert "\n" not in str(error)
        return None
    for signal in read.signals.values():
        assert np.isfinite(signal.values).all() and (np.diff(signal.time) >= 0).all() and signal.time[0] >= 0
    return read


def test_truncation_anywhere_is_read_or_refused(amount):
    data = made()
    definitions = data.index(b"8b81cf5c")
    piece = data[: definitions + 6000]
    outcomes = [outcome(piece[:end]) for end in range(1, len(piece), amount(53, 23))]
    assert outcomes[-1] is not None and outcomes[0] is None
    assert outcome(data[: len(data) // 2]).duration == pytest.approx(flight().duration / 2, rel=0.02)


def test_random_damage_is_read_or_refused(amount):
    piece = made()[:40_000]
    rng = np.random.default_rng(11)
    read, trials = 0, amount(50, 120)
    for _ in range(trials):
        hurt = np.frombuffer(piece, np.uint8).copy()
        where = rng.integers(0, rng.choice([1500, hurt.size]), rng.integers(1, 20))
        hurt[where] ^= rng.integers(1, 256, where.size).astype(np.uint8)
        read += outcome(hurt.tobytes()) is not None
    assert read > trials / 2


def test_a_log_without_times_is_refused():
    log = Writer()
    log.data = b""
    log.define("ATTC", *FORMATS["ATTC"])
    log.add("ATTC", 0, 0, 0, 0.5)
    with pytest.raises(LogError, match="no TIME records"):
        sdlog2.read(log.data, "x.bin")
