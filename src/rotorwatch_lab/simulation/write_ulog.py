"""A `Flight` as a PX4 ULog (`.ulg`): header, definitions, then data in order of time.

File format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html. Topics and fields: those that PX4 1.13 and later logs.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.logs import esc_columns
from rotorwatch_lab.simulation.logged import LOGGED, in_order
from rotorwatch_lab.simulation.write_dataflash import nearest

MAGIC = b"ULog\x01\x12\x35\x01"
TOPICS, NESTED = LOGGED["ulog"]["topics"], LOGGED["ulog"]["nested"]
SIZES = {"uint64_t": "<u8", "uint32_t": "<u4", "int32_t": "<i4", "float": "<f4", "bool": "u1"}
SIZES |= {"int16_t": "<i2", "uint16_t": "<u2", "uint8_t": "u1", "int8_t": "i1"}
WHOLE = ("CA_AIRFRAME", "CA_ROTOR_COUNT", "MAV_TYPE", "MC_BAT_SCALE_EN", "SYS_AUTOSTART")
ESCS = 8
FIFO, FIFO_LATE_S = 8, 0.0005  # samples of a block; from its last one to its message
FIFO_SCALES = {"accel": 9.80665 / 2048.0, "gyro": np.radians(2000.0) / 32768.0}
MOTOR_1 = 101  # actuator_function
ARMED, STANDBY = 2, 1


def write_ulog(flight: Flight, path: str | os.PathLike) -> None:
    """Write the flight's signals, parameters and messages. Raises ConfigError when it is no PX4 flight of up to 12 rotors."""
    Path(path).write_bytes(ulog(flight))


def ulog(flight: Flight) -> bytes:
    """Bytes of the log that `write_ulog` writes. Raises ConfigError as it does."""
    if flight.autopilot.lower() != "px4":
        raise ConfigError(f"a ULog is PX4's; this flight is of {flight.autopilot}: write a DataFlash log.")
    tables = {name: rows for name, rows in _tables(flight) if len(rows)}
    parts = [MAGIC + struct.pack("<Q", flight.start_us), _message(b"B", bytes(40))]
    used = {**({"esc_report": NESTED["esc_report"]} if "esc_status" in tables else {}), **{k: TOPICS[k] for k in tables}}
    parts += [_message(b"F", f"{name}:{fields};".encode()) for name, fields in used.items()]
    for key, text in (("sys_name", "PX4"), ("ver_hw", "simulated"), ("ver_sw", flight.firmware)):
        parts.append(_message(b"I", _keyed(f"char[{len(text)}] {key}") + text.encode()))
    for name, value in sorted(flight.parameters.items()):
        whole = name in WHOLE
        packed = struct.pack("<i", int(value)) if whole else struct.pack("<f", value)
        parts.append(_message(b"P", _keyed(f"{'int32_t' if whole else 'float'} {name}") + packed))
    records, texts = [], []
    for number, (name, rows) in enumerate(tables.items()):
        parts.append(_message(b"A", struct.pack("<BH", 0, number) + name.encode()))
        data = np.empty(len(rows), [("size", "<u2"), ("type", "u1"), ("id", "<u2"), ("data", rows.dtype)])
        data["size"], data["type"], data["id"], data["data"] = rows.dtype.itemsize + 2, ord("D"), number, rows
        records.append((rows["timestamp"].astype(np.int64), data))
    for m in flight.messages:
        if m.kind in ("text", "error"):
            stamp = flight.start_us + round(m.time * 1e6)
            level = b"3" if m.kind == "error" else b"6"
            texts.append((stamp, _message(b"L", level + struct.pack("<Q", stamp) + m.text.encode())))
    return b"".join([*parts, in_order(records, texts)])


def _message(kind: bytes, body: bytes) -> bytes:
    return struct.pack("<H", len(body)) + kind + body


def _keyed(key: str) -> bytes:
    return struct.pack("<B", len(key)) + key.encode()


def _kind(fields: str) -> np.dtype:
    """The NumPy type of a topic's records. ULog leaves out padding at the end, and these definitions have none inside."""
    columns = []
    for field in fields.split(";"):
        kind, name = field.split(" ")
        kind, _, count = kind.partition("[")
        base = _kind(NESTED[kind]) if kind in NESTED else SIZES[kind]
        columns.append((name, base, (int(count[:-1]),)) if count else (name, base))
    return np.dtype(columns)


def _blank(name: str, flight: Flight, time: np.ndarray) -> np.ndarray:
    rows = np.zeros(len(time), _kind(TOPICS[name]))
    rows["timestamp"] = flight.start_us + np.round(time * 1e6).astype(np.int64)
    if "timestamp_sample" in (rows.dtype.names or ()):
        rows["timestamp_sample"] = rows["timestamp"]
    return rows


def _tables(flight: Flight):
    """(topic, records) of every signal there is."""
    s = flight.signals

    def topic(name: str, time: np.ndarray, **fields: Any) -> tuple[str, np.ndarray]:
        rows = _blank(name, flight, time)
        for field, values in fields.items():
            rows[field] = values
        return name, rows

    if "motors" in s:
        n = len(s["motors"].columns)
        if s["motors"].unit != "1" or n > 12:
            raise ConfigError("actuator_motors holds shares of full thrust of up to 12 rotors; this flight has others.")
        motors = np.full((len(s["motors"]), 12), np.nan)
        motors[:, :n] = s["motors"].values
        yield topic("actuator_motors", s["motors"].time, control=motors)
    if "control" in s:
        time, values = s["control"].time, s["control"].values
        up = np.stack([0.0 * values[:, 3], 0.0 * values[:, 3], -values[:, 3]], axis=1)
        yield topic("vehicle_torque_setpoint", time, xyz=values[:, :3])
        yield topic("vehicle_thrust_setpoint", time, xyz=up)
    if "rates" in s:
        yield topic("vehicle_angular_velocity", s["rates"].time, xyz=s["rates"].values)
    if "gyro" in s and "accel" in s:
        time = s["gyro"].time
        accel = nearest(s["accel"], time)
        yield topic("sensor_combined", time, gyro_rad=s["gyro"].values, accelerometer_m_s2=accel)
    if "attitude" in s:
        yield topic("vehicle_attitude", s["attitude"].time, q=s["attitude"].values)
    if "attitude_wanted" in s:
        yield topic("vehicle_attitude_setpoint", s["attitude_wanted"].time, q_d=s["attitude_wanted"].values)
    if "velocity" in s and "position" in s:
        time, valid = s["velocity"].time, dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), 1)
        where = zip(("x", "y", "z"), nearest(s["position"], time).T)
        speed = zip(("vx", "vy", "vz"), s["velocity"].values.T)
        yield topic("vehicle_local_position", time, **dict(where), **dict(speed), **valid)
    if "battery" in s:
        volts, amps = s["battery"].values.T
        yield topic("battery_status", s["battery"].time, voltage_v=volts, current_a=amps)
    if "esc" in s:
        yield "esc_status", _escs(flight, s["esc"])
    for name, scale in FIFO_SCALES.items():
        if f"raw_{name}" in s:
            yield f"sensor_{name}_fifo", _blocks(flight, s[f"raw_{name}"], f"sensor_{name}_fifo", scale)
    yield "vehicle_status", _status(flight)
    landed = [m for m in flight.messages if m.kind == "landed"]
    yield topic("vehicle_land_detected", np.array([m.time for m in landed]), landed=[m.value > 0.5 for m in landed])


def _escs(flight: Flight, esc: Signal) -> np.ndarray:
    rows, n = _blank("esc_status", flight, esc.time), len(esc.columns) // len(esc_columns.QUANTITIES)
    if n > ESCS:
        raise ConfigError(f"esc_status holds {ESCS} ESCs; this flight has {n}.")
    rows["esc_count"], rows["esc_online_flags"], rows["esc_armed_flags"] = n, 2**n - 1, 2**n - 1
    rows["counter"] = np.arange(len(esc)) % 2**16
    reports = rows["esc"]
    for k in range(n):
        speed, amps, volts, degrees = esc.values[:, k::n].T
        reports["timestamp"][:, k] = rows["timestamp"]
        reports["esc_rpm"][:, k], reports["esc_current"][:, k] = np.round(speed / esc_columns.RPM), amps
        reports["esc_voltage"][:, k], reports["esc_temperature"][:, k] = volts, degrees
        reports["esc_address"][:, k], reports["actuator_function"][:, k] = k, MOTOR_1 + k
    return rows


def _blocks(flight: Flight, signal: Signal, name: str, scale: float) -> np.ndarray:
    """The samples of a sensor in blocks of FIFO, as it hands them out; a rest is left out. scale: m/s^2 or rad/s of a count."""
    blocks = len(signal) // FIFO
    last = signal.time[FIFO - 1 : blocks * FIFO : FIFO]
    rows = _blank(name, flight, last + FIFO_LATE_S)
    rows["timestamp_sample"] = flight.start_us + np.round(last * 1e6).astype(np.int64)
    rows["dt"], rows["scale"], rows["samples"] = 1e6 / signal.rate_hz, scale, FIFO
    counts = np.clip(np.round(signal.values[: blocks * FIFO] / scale), -32768, 32767).reshape(blocks, FIFO, 3)
    for k, axis in enumerate("xyz"):
        rows[axis][:, :FIFO] = counts[..., k]
    return rows


def _status(flight: Flight) -> np.ndarray:
    """vehicle_status: a row whenever arming or mode change."""
    changes = [m for m in flight.messages if m.kind in ("armed", "mode")]
    rows = _blank("vehicle_status", flight, np.array([m.time for m in changes]))
    arming, mode = STANDBY, 0
    for k, m in enumerate(changes):
        if m.kind == "armed":
            arming = ARMED if m.value > 0.5 else STANDBY
        else:
            mode = int(m.value)
        rows["arming_state"][k], rows["nav_state"][k] = arming, mode
    return rows
