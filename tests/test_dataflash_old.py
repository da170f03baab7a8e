"""Logs of ArduCopter 3.0 and 3.1: motors in MOT, no time stamps but the GPS receiver's."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, diagnose, logs
from rotorwatch.errors import VehicleError
from rotorwatch.logs import dataflash, dataflash_clock
from test_dataflash import Writer

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "src" / "rotorwatch" / "samples"
WILD = ROOT / ".." / "shared" / "flights" / "wild"
FAULTY, ONSET = "hexax_m3_mul0.80_square_wind.bin.xz", 47.60  # rotor 3
GPS = ("GPS", "BIHBcLLeeEe", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs")
LOOP_S = 0.02


@cache
def sample(name):
    return logs.read(SAMPLES / name)


def as_old(flight, gps=True, wild_stamp=None, motors=True) -> bytes:
    """The flight as ArduCopter 3.1 would have logged it: 50 loops a second, GPS written up to a tenth of a second late."""
    rng = np.random.default_rng(5)
    n = flight.rotor_count
    log = Writer()
    log.define("PARM", "Nf", "Name,Value")
    log.define("MSG", "Z", "Message")
    log.define("IMU", "ffffff", "GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("ATT", "cccccCC", "RollIn,Roll,PitchIn,Pitch,YawIn,Yaw,NavYaw")
    log.define("CTUN", "hcefchhhh", "ThrIn,SonAlt,BarAlt,WPAlt,DesSonAlt,AngBst,CRate,ThrOut,DCRate")
    log.define("MOT", "h" * n, ",".join(f"Mot{k + 1}" for k in range(n)))
    log.define("EV", "B", "Id")
    log.define(*GPS)
    log.add("MSG", b"ArduCopter V3.1.2 (abcdef01)")
    old = {"RC3_MIN": 1000, "RC3_MAX": 2000, "THR_MIN": 150, "FRAME": 1, "MOT_THST_MAX": 0.94}
    for name, value in old.items():
        log.add("PARM", name.encode(), value)

    def at(signal, t):
        return flight[signal].values[np.searchsorted(flight[signal].time, t).clip(0, len(flight[signal]) - 1)]

    log.add("EV", 10)
    w, x, y, z = flight["attitude"].values.T
    roll = np.degrees(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    pitch = np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))) % 360
    late, fix = rng.uniform(0, 0.1), 0.0
    for k in range(int(flight.duration / LOOP_S)):
        t = k * LOOP_S
        log.add("IMU", *at("gyro", t), *at("accel", t))
        if t >= fix + late:
            stamp = 1000 * (300_000 + fix)
            stamp = 3_000_000_000 if wild_stamp is not None and fix <= wild_stamp < fix + 0.2 else stamp
            if gps:
                log.add("GPS", 3, round(stamp), 1700, 9, 1, 0, 0, 0, 0, 0, 0)
            fix, late = fix + 0.2, rng.uniform(0, 0.1)
        if k % 5 == 0:
            i = np.searchsorted(flight["attitude"].time, t).clip(0, w.size - 1)
            log.add("ATT", 0, round(100 * roll[i]), 0, round(100 * pitch[i]), 0, round(100 * yaw[i]), 0)
            log.add("CTUN", 500, 0, 0, 0.0, 0, 0, 0, round(1000 * float(at("throttle", t)[0])), 0)
            if motors:
                log.add("MOT", *np.round(at("motors", t)).astype(int))
    log.add("EV", 11)
    return log.data


@cache
def old(name, **how):
    return dataflash.read(as_old(sample(name), **how), "old.bin")


@pytest.mark.parametrize("how", [{}, {"wild_stamp": 30.0}, {"gps": False}])
def test_times_are_rebuilt_from_what_keeps_time(how):
    """Every IMU sample within a tenth of a second of its loop, and no step between samples stretched or squeezed."""
    flight = old(FAULTY, **how)
    gyro = flight["gyro"]
    wanted = np.arange(len(gyro)) * LOOP_S
    error = gyro.time - gyro.time[0] - wanted
    assert np.abs(error - np.median(error)).max() < 0.12
    steps = np.diff(gyro.time)
    assert 0.9 * LOOP_S < steps.min() and steps.max() < 1.1 * LOOP_S
    assert any("no times" in w for w in flight.warnings)
    assert flight.start_us == 0


def test_motors_come_from_mot_in_rotor_order_and_that_is_said():
    flight, origin = old(FAULTY), sample(FAULTY)
    assert flight["motors"].source == "MOT" and flight.rotor_count == 6
    assert any("MOT" in w for w in flight.warnings)
    assert flight["motors"].rate_hz == pytest.approx(10, rel=0.02)
    assert np.allclose(flight["motors"].between(30, 40).values.mean(axis=0), origin["motors"].between(30, 40).values.mean(axis=0), atol=3)
    assert flight.firmware.startswith("ArduCopter V3.1.2") and flight.vehicle_type == "ArduCopter"
    assert airframes.identify(flight).name == "ardupilot-hexa-x"


def test_a_weak_rotor_is_found_in_such_a_log():
    diagnosis = diagnose(old(FAULTY))
    event = max((e for e in diagnosis.events if e.kind == "loss_of_effectiveness"), key=lambda e: e.probability)
    assert event.rotors == (3,) and event.onset_s == pytest.approx(ONSET, abs=2.0)


def test_a_text_log_has_the_same():
    from rotorwatch.logs.dataflash_binary import BinaryLog
    from test_dataflash_pymavlink import as_text

    binary = old(FAULTY)
    text = b"3\n\nArduCopter V3.0.1 (5c6503e2)\nFree RAM: 1331\nAPM 2\n" + as_text(BinaryLog(as_old(sample(FAULTY))))
    flight = dataflash.read(text.replace(b"MSG, ArduCopter V3.1.2", b"MSG, hello"), "old.log")
    assert flight.firmware == "ArduCopter V3.0.1 (5c6503e2)"
    assert np.array_equal(flight["motors"].values, binary["motors"].values)
    assert np.allclose(flight["gyro"].time, binary["gyro"].time, atol=1e-6)


def test_a_log_without_motors_names_the_record_that_is_missing():
    flight = old(FAULTY, motors=False)
    with pytest.raises(VehicleError, match=r"no motor outputs .*MOT.* LOG_BITMASK"):
        airframes.identify(flight)


def test_nothing_keeps_time():
    log = Writer()
    log.define("GPS", *GPS[1:])
    stamps, said = dataflash_clock.rebuilt(dataflash.BinaryLog(log.data))
    assert np.isnan(stamps).all() and said == ""


def test_truncation_and_damage_are_survived():
    data = as_old(sample(FAULTY))
    start = len(data) // 3
    rng = np.random.default_rng(3)
    for cut in [*range(1, 1500, 13), *rng.integers(1500, len(data), 12)]:
        outcome(data[:cut])
    piece = data[:900] + data[start : start + 40_000]
    for _ in range(40):
        hurt = np.frombuffer(piece, np.uint8).copy()
        hurt[rng.integers(0, hurt.size, 20)] ^= rng.integers(1, 256, 20).astype(np.uint8)
        flight = outcome(hurt.tobytes())
        assert flight is None or flight.duration < 200


def outcome(data):
    """The Flight, or None where a sentence came instead; anything else fails."""
    try:
        flight = dataflash.read(data, "damaged.bin")
    except dataflash.LogError as error:
        assert str(error).startswith("damaged.bin: ")
        return None
    for signal in flight.signals.values():
        assert np.isfinite(signal.values).all() and (np.diff(signal.time) >= 0).all()
    return flight


@pytest.mark.skipif(not (WILD / "no-rcou-1.log.xz").is_file(), reason="this flight is missing")
def test_a_real_log_of_3_0_without_motors_says_so():
    flight = logs.read(WILD / "no-rcou-1.log.xz")
    assert flight.firmware.startswith("ArduCopter V3.0.1") and 150 < flight.duration < 200
    with pytest.raises(VehicleError, match="MOT"):
        airframes.identify(flight)


def test_a_gps_whose_clock_mostly_stands_still_keeps_no_time():
    """Less than half of its steps are of a moving clock: then the ten records a second of the loop do."""
    for moving, source in ((0.7, "GPS"), (0.3, "ten records")):
        log = Writer()
        log.define("MOT", "hhhh", "Mot1,Mot2,Mot3,Mot4")
        log.define(*GPS)
        stamp = 1000
        for k in range(200):
            log.add("MOT", 1500, 1500, 1500, 1500)
            if k % 2 == 0:
                stamp += 200 if (k // 2) % 10 < 10 * moving else 0
                log.add("GPS", 3, stamp, 1700, 9, 1, 0, 0, 0, 0, 0, 0)
        read = dataflash.read(log.data, "old.bin")
        assert any("rebuilt from" in w and source in w for w in read.warnings), (moving, read.warnings)
