"""ESC telemetry of every format and age: which report is which rotor's, in rad/s, A, V and degC; and the logs the simulator writes."""

import re
import struct

import numpy as np
import pytest

from rotorwatch.logs import dataflash, esc_columns, log_memory, mavlink_frames, mavlink_messages, px4_topics, tlog
from test_dataflash import RCOU, pwm
from test_dataflash import Writer as DataFlash
from test_logs_px4 import topics
from test_logs_tlog import Writer as Telemetry

INFO, STATUS = (mavlink_messages.by_name()[name] for name in ("ESC_INFO", "ESC_STATUS"))

RPM = np.pi / 30.0
ESC_OF_EACH_AGE = {
    "4.2": ("ESC", "QBffffcfcf", "TimeUS,Instance,RPM,RawRPM,Volt,Curr,Temp,CTot,MotTemp,Err"),
    "4.1": ("ESC", "QBeffcfcff", "TimeUS,Instance,RPM,Volt,Curr,Temp,CTot,MotTemp,Err,RXErr"),
    "4.0": ("ESC", "QBeCCcHc", "TimeUS,Instance,RPM,Volt,Curr,Temp,CTot,MotTemp"),
    "CAN": ("CESC", "QBIfffiB", "TimeUS,Id,ECnt,Voltage,Curr,Temp,RPM,Pow"),
}


def quad(definitions, escs, functions=(33, 34, 35, 36), outputs=(1, 2, 3, 4)):
    """A log of 12 times RCOU and what `escs(k)` yields: (message, fields after TimeUS)."""
    log = DataFlash()
    log.parameters(time=1_000_000, FRAME_CLASS=1, **{f"SERVO{n}_FUNCTION": f for n, f in zip(outputs, functions)})
    for definition in (RCOU, *definitions):
        log.define(*definition)
    for k in range(12):
        us = 1_000_000 + 100_000 * k
        log.add("RCOU", us, *pwm(**{f"o{n}": 1500 for n in outputs}))
        for message, *fields in escs(k):
            log.add(message, us + 50, *fields)
    return dataflash.read(log.data, "made.bin")


def values_of(age, k):
    """Fields after TimeUS and the instance: 6000 + k rpm, 15.5 V, 4 + k A, 42.5 degC, as that firmware packs them."""
    rpm, volts, amps, degrees = 6000 + k, 15.5, 4.0 + k, 42.5
    return {
        "4.2": (rpm, rpm, volts, amps, round(100 * degrees), 0.0, 0, 0.0),
        "4.1": (100 * rpm, volts, amps, round(100 * degrees), 0.0, 0, 0.0, 0.0),
        "4.0": (100 * rpm, round(100 * volts), round(100 * amps), round(100 * degrees), 0, 0),
        "CAN": (0, volts, amps, degrees + 273.15, rpm, 50),
    }[age]


def check(esc, order=(0, 1, 2, 3)):
    """Rotor i has the numbers of ESC order[i]."""
    assert esc.columns == tuple(f"{q}{k}" for q in ("speed", "current", "voltage", "temperature") for k in (1, 2, 3, 4))
    assert esc.unit == "rad/s,A,V,degC" and esc.valid.all()
    k = np.array(order)
    assert esc.values[-1, :4] == pytest.approx((6000 + k) * RPM, rel=1e-6)
    assert esc.values[-1, 4:] == pytest.approx([*(4.0 + k), *[15.5] * 4, *[42.5] * 4], rel=1e-6)


@pytest.mark.parametrize("age", ESC_OF_EACH_AGE)
def test_dataflash_of_every_age(age):
    name = ESC_OF_EACH_AGE[age][0]
    flight = quad([ESC_OF_EACH_AGE[age]], lambda k: [(name, i, *values_of(age, i)) for i in range(4)], (36, 35, 34, 33))
    check(flight["esc"], (3, 2, 1, 0))
    assert flight.warnings == ()


def test_dataflash_with_a_message_for_each_esc():
    definitions = [(f"ESC{n}", "QeCCcH", "TimeUS,RPM,Volt,Curr,Temp,CTot") for n in range(1, 5)]
    check(quad(definitions, lambda k: [(f"ESC{i + 1}", 100 * (6000 + i), 1550, 400 + 100 * i, 4250, 7) for i in range(4)])["esc"])


def test_escs_that_are_counted_apart_from_the_outputs_are_taken_in_order():
    escs = [("ESC", i, *values_of("4.2", i)) for i in range(4)]
    flight = quad([ESC_OF_EACH_AGE["4.2"]], lambda k: escs, outputs=(9, 10, 11, 12))
    check(flight["esc"])
    assert any("does not name the motors' outputs" in w for w in flight.warnings)


def test_a_speed_that_the_esc_does_not_know_is_invalid():
    unknown = (np.nan, np.nan, 15.5, 4.0, 4250, 0.0, 0, 0.0)
    esc = quad([ESC_OF_EACH_AGE["4.2"]], lambda k: [("ESC", i, *(unknown if i == 1 else values_of("4.2", i))) for i in range(4)])["esc"]
    assert not esc.valid[:, 1].any() and esc.valid[:, [0, 2, 3, 5]].all() and np.isfinite(esc.values).all()


def test_reports_are_not_held_over():
    """An ESC at half the rate of the others is invalid in every other row."""
    time = np.arange(20) * 0.1
    reports = [(time, {"speed": np.full(20, 500.0)}), (time[::2] + 0.01, {"speed": np.arange(10.0) + 1})]
    esc = esc_columns.together(reports, (1, 2), "made", [])
    assert esc.valid[:, 0].all() and esc.valid[:, 1].sum() == 10
    assert esc.values[esc.valid[:, 1], 1].tolist() == (np.arange(10.0) + 1).tolist()


def test_impossible_values_are_counted():
    notes = []
    speed, volts = np.full((9, 2), 500.0), np.full((9, 2), 15.0)
    speed[3, 0], volts[:, 1] = 1e9, 0.0
    esc = esc_columns.build(np.arange(9.0), {"speed": speed, "voltage": volts}, (1, 2), "made", notes)
    assert notes == ["made: 1 impossible value ignored"]  # 0 V is no measurement, and no damage
    assert not esc.valid[3, 0] and not esc.valid[:, 5].any() and esc.valid[:, 4].all()


def px4(order=(101, 102, 103, 104), **more):
    fields = {}
    for i in range(4):
        fields |= {f"esc[{i}].esc_rpm": np.full(20, (-1) ** i * (6000 + i)), f"esc[{i}].esc_voltage": np.full(20, 15.5)}
        fields |= {f"esc[{i}].esc_current": np.full(20, 4.0 + i), f"esc[{i}].esc_temperature": np.full(20, 42.5)}
        fields |= {f"esc[{i}].actuator_function": np.full(20, order[i])} if order else {}
        fields |= {f"esc[{i}].{key}": np.full(20, value[i]) for key, value in more.items() if key == "esc_address"}
    fields |= {key: np.full(20, value) for key, value in more.items() if key != "esc_address"}
    return px4_topics.signals(topics(esc_status=fields), {"CA_ROTOR_COUNT": 4})[0]["esc"]


def test_px4_by_function_address_and_order():
    check(px4())
    check(px4((104, 103, 102, 101)), (3, 2, 1, 0))
    check(px4(None, esc_address=(3, 0, 1, 2)), (1, 2, 3, 0))
    check(px4(None, esc_address=(1, 2, 3, 4)))
    check(px4(None, esc_address=(0, 0, 0, 0)))


def test_px4_says_which_escs_are_online():
    esc = px4(esc_online_flags=0b1011)
    assert not esc.valid[:, 2::4].any() and esc.valid[:, [0, 1, 3]].all()


@pytest.mark.parametrize("reverse", [False, True])
def test_mavlink_telemetry_of_ardupilot(reverse):
    log = Telemetry()
    for output in range(1, 5):
        log.add("param_value", b"SERVO%d_FUNCTION" % output, 32 + (5 - output if reverse else output), 9, 100, 1)
    log.flight(samples=3)
    for k in range(12):
        log.add("attitude", 5100 + 100 * k, 0, 0, 0, 0, 0, 0)
        amps = [400, 500, 600, 700]
        # 42.5 degC do not fit into whole degrees.
        log.add("esc_telemetry_1_to_4", bytes([42] * 4), [1550] * 4, amps, [0] * 4, [6000, 6001, 6002, 6003], [k] * 4)
    esc = tlog.read(log.data, "x.tlog")["esc"]
    k = np.arange(4)[:: -1 if reverse else 1]
    assert esc.values[5] == pytest.approx([*(6000 + k) * RPM, *(4.0 + k), *[15.5] * 4, *[42.0] * 4])


def frame(layout, *fields):
    """A record of a telemetry log: stamp, MAVLink 2 header, payload without its last zeros, check sum. pymavlink lacks these messages."""
    payload = struct.pack(layout.form, *fields).rstrip(b"\0")
    body = struct.pack("<BBBBBB", len(payload), 0, 0, 0, 1, 1) + layout.id.to_bytes(3, "little") + payload
    check_sum = mavlink_frames.checksum(np.frombuffer(body, np.uint8)[None], layout.seed)[0]
    return struct.pack(">Q", 1_700_000_000_000_000) + b"\xfd" + body + struct.pack("<H", check_sum)


def test_the_seeds_of_check_sums_follow_from_the_definitions():
    """https://mavlink.io/en/guide/serialization.html: the check sum of name and fields in wire order, folded."""
    kinds = {"Q": "uint64_t", "I": "uint32_t", "i": "int32_t", "H": "uint16_t", "h": "int16_t", "f": "float", "B": "uint8_t"}
    for layout in (INFO, STATUS):
        text = f"{layout.name} ".encode()
        for name, (count, code) in zip(layout.fields, re.findall(r"(\d*)([A-Za-z])", layout.form), strict=True):
            text += f"{kinds[code]} {name} ".encode() + (bytes([int(count)]) if count else b"")
        crc = int(mavlink_frames.checksum(np.frombuffer(text[:-1], np.uint8)[None], text[-1])[0])
        assert (crc & 0xFF) ^ (crc >> 8) == layout.seed, layout.name


def test_mavlink_status_of_px4():
    log = Telemetry()
    log.flight(samples=3, kind=13, autopilot=12)
    for k in range(12):
        us = 5_100_000 + 100_000 * k
        for first in (0, 4):
            number = first + np.arange(4)
            info = (us, *[0] * 4, k, *[0] * 4, 4250, 4250, 32767, 4250, first, 6, 4, 63)
            log.data += frame(INFO, *info)
            log.data += frame(STATUS, us, *(6000 + number), *[15.5] * 4, *(4.0 + number), first)
    esc = tlog.read(log.data, "x.tlog")["esc"]
    k = np.arange(6)
    assert esc.columns[5] == "speed6" and len(esc.columns) == 24
    assert esc.values[5, :18] == pytest.approx([*(6000 + k) * RPM, *(4.0 + k), *[15.5] * 6])
    assert esc.valid[5, 18:].tolist() == [True, True, False, True, True, True] and esc.values[5, 18] == 42.5


def test_tables():
    time = np.arange(50) / 10
    columns = {"time_s": time, "gyro_x_rad_s": time, "gyro_y_rad_s": time, "gyro_z_rad_s": time}
    for k in (1, 2, 3, 4):
        columns |= {f"motor_{k}": np.full(50, 0.5), f"rpm_{k}": np.full(50, 5999.0 + k)}
        columns |= {f"esc_current_{k}_A": np.full(50, 3.0 + k), f"esc_voltage_{k}_V": np.full(50, 15.5)}
        columns |= {f"esc_temperature_{k}_degC": np.full(50, 42.5)}
    check(log_memory.from_arrays(columns)["esc"])
    columns["esc_current_2_A"] = np.full(50, np.nan)
    assert log_memory.from_arrays(columns)["esc"].valid[0, 4:8].tolist() == [True, False, True, True]


def test_the_layout_of_the_golden_record():
    """The writer of these tests packs an ESC record as ArduPilot 4.2 and later do, byte for byte."""
    log = DataFlash()
    log.define(*ESC_OF_EACH_AGE["4.2"])
    start = len(log.data)
    log.add("ESC", 123_456_789, 2, 6000.0, 5990.0, 15.5, 4.0, 4250, 120.0, 3100, 0.5)
    record = log.data[start:]
    assert len(record) == 3 + 8 + 1 + 4 * 4 + 2 + 4 + 2 + 4
    assert record[3:12] == struct.pack("<QB", 123_456_789, 2) and record[28:30] == struct.pack("<h", 4250)
