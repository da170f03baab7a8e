"""Crazyflie uSD-card logs. Format: https://www.bitcraze.io/documentation/repository/crazyflie-firmware/master/userguides/logparam/

Axes there are x forward, y left, z up; world x, y, z with z up. Inside rotorwatch body FRD and world NED (x, -y, -z).
"""

from __future__ import annotations

import zlib

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import series

FORMAT = "Crazyflie uSD log"
COMMON_ENDINGS = (".usd",)

_FULL = 65535.0
_FLIP = np.array([1.0, -1.0, -1.0])
_CONTROLLERS = ("controller", "ctrlMel", "ctrlINDI")  # log groups with the input of the power distribution
_MAIN = "fixedFrequency"
_TYPES = {code: np.dtype(code).newbyteorder("<") for code in "bBhHiIqQefd"}


def sniff(head: bytes, name: str) -> bool:
    """True for byte 0xBC, version 1 or 2 and a plausible number of event types."""
    return len(head) > 5 and head[0] == 0xBC and head[1] in (1, 2) and head[2] == 0 and 0 < head[3] and head[4] == 0


def read(data, name: str, progress=None) -> Flight:
    """Read the log's fixed-frequency variables. Times count from the first record.

    Raises LogError when the header is damaged or it has no record of known variables."""
    notes: list[str] = []
    data = bytes(data)
    table = _records(data, notes)
    time = table["time"].astype(np.float64) * (1e-6 if data[1] == 2 else 1e-3)
    start = float(time[series.steady(time)[0]])
    signals = _signals(time - start, {n: table[n] for n in table.dtype.names or ()}, notes)
    return Flight(
        format=FORMAT,
        autopilot="Crazyflie",
        signals=signals,
        duration=series.end_of(signals),
        firmware="Crazyflie",
        vehicle_type="quadrotor",
        warnings=tuple(notes),
        start_us=round(start * 1e6),
        facts={"frame": "Crazyflie"},
    )


def _records(data: bytes, notes) -> np.ndarray:
    """The records of the fixed-frequency event as a structured array with a field `time`."""
    at, kinds = 5, {}
    version = data[1]
    try:
        for _ in range(int.from_bytes(data[3:5], "little")):
            number, at = int.from_bytes(data[at : at + 2], "little"), at + 2
            event, at = _text(data, at)
            fields: list = [("event", "<u2"), ("time", "<u8" if version == 2 else "<u4")]
            count, at = data[at : at + 2], at + 2
            for _ in range(int.from_bytes(count, "little")):
                variable, at = _text(data, at)
                field, code = variable[:-3], variable[-2]
                fields.append((field, _TYPES[code]))
            kinds[number] = event, np.dtype(fields)
    except (ValueError, IndexError, KeyError) as error:
        raise LogError("the header of this Crazyflie log is damaged") from error
    main = next((n for n, (event, _) in kinds.items() if event == _MAIN), None)
    if main is None:
        raise LogError(f"this Crazyflie log has no '{_MAIN}' variables; log motor.m1..m4 and gyro at a fixed frequency")
    places, end = [], len(data) - 4
    while at + 2 <= end:
        number = data[at] | data[at + 1] << 8
        if number not in kinds:
            notes.append(f"damaged from byte {at} on; {len(places)} records before it were read")
            break
        size = kinds[number][1].itemsize
        if at + size > end:
            notes.append(f"the log ends in the middle of a record; {len(places)} records before it were read")
            break
        if number == main:
            places.append(at)
        at += size
    else:
        if zlib.crc32(memoryview(data)[:-4]) != int.from_bytes(data[-4:], "little"):
            notes.append("the log's check sum is wrong: it is damaged or was not closed")
    if not places:
        raise LogError("this Crazyflie log holds no records")
    kind = kinds[main][1]
    rows = np.frombuffer(data, np.uint8)[np.array(places)[:, None] + np.arange(kind.itemsize)]
    return rows.reshape(-1).view(kind)


def _text(data: bytes, at: int) -> tuple[str, int]:
    """The NUL-terminated text at a position, and the position after it."""
    end = data.index(b"\0", at, at + 256)
    return data[at:end].decode("ascii"), end + 1


def _signals(time, table, notes) -> dict:
    def columns(*names):
        if any(n not in table for n in names):
            return None
        with np.errstate(invalid="ignore"):  # damaged floats may be signalling NaNs
            return np.stack([table[n].astype(float) for n in names], 1)

    def make(kind, values, source, valid=None):
        return None if values is None else series.signal(kind, time, values, source, notes, valid)

    motors, valid, origin = columns("motor.m1", "motor.m2", "motor.m3", "motor.m4"), None, "motor.m1..m4"
    if motors is None:
        motors, valid, origin = _mixed(columns, notes)
    gyro, acc = columns("gyro.x", "gyro.y", "gyro.z"), columns("acc.x", "acc.y", "acc.z")
    place = columns("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
    speed = columns("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz")
    attitude = _attitude(columns, notes)
    if acc is not None:
        accel, source = acc * G0 * _FLIP, "acc"
    else:
        accel, source = _specific_force(columns, attitude), "stateEstimate.ax..az"
    battery = columns("pm.vbatMV")
    volts = columns("pm.vbat") if battery is None else battery * 1e-3
    voltage = None if volts is None else np.column_stack([volts, np.full(time.size, np.nan)])
    signals = {
        "motors": None if motors is None else series.motors(time, motors / _FULL, "1", origin, notes, valid),
        "gyro": make("gyro", None if gyro is None else np.radians(gyro) * _FLIP, "gyro"),
        "accel": make("accel", accel, source),
        "attitude": make("attitude", attitude, "stateEstimate"),
        "velocity": make("velocity", None if speed is None else speed * _FLIP, "stateEstimate"),
        "position": make("position", None if place is None else place * _FLIP, "stateEstimate"),
        "battery": make("battery", voltage, "pm.vbatMV"),
    }
    return {k: v for k, v in signals.items() if v is not None}


def _mixed(columns, notes):
    """((n, 4) motor commands, (n,) valid, source) from the controller's outputs; (None, None, "") where they are not logged.

    The firmware's power distribution halves roll and pitch: power_distribution_quadrotor.c, powerDistributionLegacy. Newer firmware reduces
    all motors by the excess of the strongest: the commands are then unknown."""
    for group in _CONTROLLERS:
        wanted = columns(*(f"{group}.cmd_{axis}" for axis in ("thrust", "roll", "pitch", "yaw")))
        if wanted is not None:
            thrust, roll, pitch, yaw = np.where(np.abs(wanted) < 1e6, wanted, np.nan).T
            r, p = np.trunc(roll / 2.0), np.trunc(pitch / 2.0)
            motors = np.stack([thrust - r + p + yaw, thrust - r - p - yaw, thrust + r - p + yaw, thrust + r + p - yaw], 1)
            notes.append(f"motor.m1..m4 were not logged; motor commands are rebuilt from {group}.cmd_* with the firmware's mixer")
            with np.errstate(invalid="ignore"):
                return np.clip(motors, 0.0, _FULL), (motors <= _FULL).all(axis=1), f"{group}.cmd_*"
    return None, None, ""


def _attitude(columns, notes):
    """(n, 4) quaternion body FRD -> NED-like world, from the logged one or from the angles; None without either."""
    q = columns("stateEstimate.qw", "stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz")
    if q is not None:
        return q * [1.0, 1.0, -1.0, -1.0]  # both frames turned half round x
    tilt, pitch = columns("stateEstimate.roll", "stateEstimate.yaw"), columns("stateEstimate.pitch")
    if tilt is None:
        return None
    if pitch is None:
        notes.append("pitch was not logged and is taken as zero")
        pitch = np.zeros((tilt.shape[0], 1))
    # The firmware logs pitch with the sign of aerospace convention, nose up positive; yaw is counter-clockwise.
    return series.quaternion(*np.radians([tilt[:, 0], pitch[:, 0], -tilt[:, 1]]))


def _specific_force(columns, attitude):
    """(n, 3) specific force, body FRD, m/s^2, from the estimator's world acceleration in g without gravity."""
    world = columns("stateEstimate.ax", "stateEstimate.ay", "stateEstimate.az")
    if world is None or attitude is None:
        return None
    force = np.add(world, [0.0, 0.0, 1.0]) * _FLIP * G0
    w, v = attitude[:, :1], -attitude[:, 1:]  # the inverse rotation
    return force + 2 * np.cross(v, np.cross(v, force) + w * force)
