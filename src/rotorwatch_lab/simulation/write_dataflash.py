"""A `Flight` as an ArduPilot DataFlash log (`.bin`): the messages that the autopilot itself writes of such signals.

Records begin with 0xA3 0x95 and their type; FMT records (type 128) define each type's fields first, as ArduPilot's
documentation of its log format describes.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.logs import esc_columns
from rotorwatch_lab.simulation.logged import LOGGED, in_order

HEAD = b"\xa3\x95"
MESSAGES: dict[str, tuple[int, str, str]] = {name: tuple(row) for name, row in LOGGED["dataflash"].items()}
"""Name -> (type, format, columns)."""
RAW = {"raw_accel": "ACC", "raw_gyro": "GYR"}
CODES = {"Q": "Q", "f": "f", "B": "B", "M": "B", "H": "H", "I": "I", "c": "h", "n": "4s", "N": "16s", "Z": "64s"}
EVENTS = {("armed", 1.0): 10, ("armed", 0.0): 11, ("landed", 1.0): 18, ("landed", 0.0): 28}


def write_dataflash(flight: Flight, path: str | os.PathLike) -> None:
    """Write the flight's signals, parameters and messages. Raises ConfigError when it is no ArduPilot flight of up to 14 rotors."""
    Path(path).write_bytes(dataflash(flight))


def dataflash(flight: Flight) -> bytes:
    """Bytes of the log that `write_dataflash` writes. Raises ConfigError as it does."""
    if not flight.autopilot.lower().startswith("ardu"):
        raise ConfigError(f"a DataFlash log is ArduPilot's; this flight is of {flight.autopilot}: write a ULog.")
    records = [_packed(*message, flight.start_us) for message in _tables(flight)]
    used = {n: row for n, row in MESSAGES.items() if n not in RAW.values() or any(RAW.get(s) == n for s in flight.signals)}
    first = [_record("FMT", t, _size(f), n.encode(), f.encode(), c.encode()) for n, (t, f, c) in used.items()]
    first += [_record("MSG", flight.start_us, flight.firmware.encode())]
    first += [_record("PARM", flight.start_us, k.encode(), v, v) for k, v in sorted(flight.parameters.items())]
    return b"".join([*first, in_order(records, _events(flight))])


def _tables(flight: Flight):
    """(message, time (m,), columns after TimeUS (m, k)) of every signal there is."""
    s = flight.signals
    if "motors" in s:
        if s["motors"].unit != "us" or len(s["motors"].columns) > 14:
            raise ConfigError("RCOU holds pulses in us of up to 14 outputs; this flight has others.")
        pulses = np.zeros((len(s["motors"]), 14))
        pulses[:, : len(s["motors"].columns)] = s["motors"].values
        yield "RCOU", s["motors"].time, pulses
    if "control" in s and "rates" in s:
        rates = nearest(s["rates"], s["control"].time)
        both = np.stack([np.degrees(rates), s["control"].values[:, :3]], axis=2).reshape(len(rates), 6)
        throttle = s["control"].values[:, 3:]
        yield "RATE", s["control"].time, np.concatenate([both, throttle, throttle], axis=1)
    if "gyro" in s and "accel" in s:
        time, first = s["gyro"].time, np.zeros((len(s["gyro"]), 1))
        yield "IMU", time, np.concatenate([first, s["gyro"].values, nearest(s["accel"], time)], axis=1)
    if "attitude" in s:
        angles = _degrees(s["attitude"].values)
        wanted = np.full_like(angles, np.nan)
        if "attitude_wanted" in s:
            wanted = _degrees(nearest(s["attitude_wanted"], s["attitude"].time))
        yield "ATT", s["attitude"].time, np.stack([wanted, angles], axis=2).reshape(len(angles), 6)
    if "velocity" in s and "position" in s:
        v = s["velocity"]
        yield "XKF1", v.time, np.concatenate([np.zeros((len(v), 1)), v.values, nearest(s["position"], v.time)], axis=1)
    if "throttle" in s:
        yield "CTUN", s["throttle"].time, s["throttle"].values
    if "battery" in s:
        yield "BAT", s["battery"].time, np.concatenate([np.zeros((len(s["battery"]), 1)), s["battery"].values], axis=1)
    if "lift" in s:
        yield "MOTB", s["lift"].time, s["lift"].values
    if "esc" in s:
        yield from _escs(s["esc"])
    for name, message in RAW.items():
        if name in s:
            time = s[name].time
            stamps = flight.start_us + np.round(time * 1e6)
            yield message, time, np.column_stack([np.zeros(len(time)), stamps, s[name].values])


def _escs(esc: Signal):
    """ESC messages, one instance after the other, numbered as the servo outputs from 0. The charge is the current's integral [mAh]."""
    n = len(esc.columns) // len(esc_columns.QUANTITIES)
    step = np.diff(esc.time, prepend=esc.time[:1])
    none = np.zeros(len(esc))
    for k in range(n):
        speed, amps, volts, degrees = esc.values[:, k::n].T
        rpm, charge = np.round(speed / esc_columns.RPM), np.cumsum(amps * step) / 3.6
        yield "ESC", esc.time, np.column_stack([none + k, rpm, rpm, volts, amps, degrees, charge, none, none])


def nearest(signal: Signal, time: np.ndarray) -> np.ndarray:
    """Values of a signal at other times: the nearest sample's."""
    middle = 0.5 * (signal.time[1:] + signal.time[:-1])
    return signal.values[np.searchsorted(middle, time)]


def _degrees(q: np.ndarray) -> np.ndarray:
    """(m, 3) roll, pitch, yaw [deg], yaw in 0..360."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.stack([roll, pitch, yaw % (2 * np.pi)], axis=1))


def _size(form: str) -> int:
    return 3 + struct.calcsize("<" + "".join(CODES[c] for c in form))


def _packed(name: str, time: np.ndarray, values: np.ndarray, start_us: int) -> tuple[np.ndarray, np.ndarray]:
    """(TimeUS, records) of one message."""
    number, form, _ = MESSAGES[name]
    kinds = [("head", "S3"), *((f"c{k}", {"Q": "<u8", "f": "<f4", "B": "u1", "H": "<u2", "c": "<i2"}[c]) for k, c in enumerate(form))]
    table = np.zeros(len(time), np.dtype(kinds))
    table["head"] = HEAD + bytes([number])
    stamps = start_us + np.round(time * 1e6).astype(np.int64)
    table["c0"] = stamps
    for k in range(values.shape[1]):
        table[f"c{k + 1}"] = np.round(100.0 * values[:, k]) if form[k + 1] == "c" else values[:, k]
    return stamps, table


def _record(name: str, *values) -> bytes:
    number, form, _ = MESSAGES[name]
    return HEAD + bytes([number]) + struct.pack("<" + "".join(CODES[c] for c in form), *values)


def _events(flight: Flight) -> list[tuple[int, bytes]]:
    events = []
    for m in flight.messages:
        stamp = flight.start_us + round(m.time * 1e6)
        if m.kind == "armed":
            events.append((stamp, _record("ARM", stamp, int(m.value), 0, 0, 0)))
        if (m.kind, m.value) in EVENTS:
            events.append((stamp, _record("EV", stamp, EVENTS[m.kind, m.value])))
        elif m.kind == "mode":
            events.append((stamp, _record("MODE", stamp, int(m.value), int(m.value), 0)))
        elif m.kind == "text":
            events.append((stamp, _record("MSG", stamp, m.text.encode()[:64])))
    return events
