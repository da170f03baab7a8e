"""PX4's binary log before ULog (sdlog2, until 1.6): DataFlash's framing, other messages, times in records of their own.

Messages: PX4 1.6, src/modules/sdlog2/sdlog2_messages.h. All records between two TIME records have the time of the first.

    motors    OUT0, OUT1 Out0..            control   ATTC Roll Pitch Yaw Thrust
    gyro      IMU GyroX.. rad/s            accel     IMU AccX.. m/s^2
    rates     ATT RollRate.. rad/s         attitude  ATT qw.., in older ones Roll Pitch Yaw in rad
    velocity, position   LPOS VX.. X..     battery   BATT V C
"""

from __future__ import annotations

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message
from rotorwatch.logs import dataflash_events, px4_outputs, px4_topics, series
from rotorwatch.logs.dataflash_binary import SDLOG2, BinaryLog
from rotorwatch.logs.dataflash_clock import make_clock

FORMAT = "PX4 sdlog2"
COMMON_ENDINGS = (".px4log",)

_ARMED = 2  # STAT.ArmS
_QUATERNION, _ANGLES = ("qw", "qx", "qy", "qz"), ("Roll", "Pitch", "Yaw")


def sniff(head: bytes, name: str) -> bool:
    """True when the file starts with DataFlash message definitions that only PX4 had; never by name."""
    return SDLOG2.search(head) is not None


@np.errstate(all="ignore")  # damaged numbers may be NaN or huge; they are masked, not computed with
def read(data, name: str, progress=None) -> Flight:
    """Read an sdlog2 file from bytes or a memory map. Times count from the first TIME record.

    Raises LogError when it holds no time or nothing that is read here."""
    log = BinaryLog(data, progress)
    times = log.table("TIME", ("StartTime",))
    if times is None or "StartTime" not in times or times["StartTime"].ndim != 1:
        raise LogError(f"{name}: this {FORMAT} log holds no TIME records; what it shows has no time")
    stamps = np.full(log.record_count, np.nan)
    stamps[times.record] = times["StartTime"]
    clock = make_clock(stamps)
    parameters, changes = dataflash_events.parameters(log, clock)
    tables = _Tables(log, clock)
    signals, facts = _signals(tables, parameters)
    if progress:
        progress(1.0)
    notes = ["This is an sdlog2 file, PX4's log format before ULog; its outputs are from OUT0 records."]
    return Flight(
        format=FORMAT,
        autopilot="PX4",
        signals=signals,
        duration=series.end_of(signals),
        firmware=_firmware(log),
        vehicle_type=px4_topics.MAV_TYPES.get(int(parameters.get("MAV_TYPE", 0)), ("", 0))[0],
        parameters=parameters,
        parameter_changes=changes,
        messages=_messages(tables),
        warnings=(*notes, *log.warnings, *clock.warnings, *tables.notes),
        name=name,
        start_us=int(clock.start_us),
        facts={**facts, "log_messages": dict(sorted(log.counts.items())), "clock_jumps": list(clock.jumps)},
    )


class _Tables:
    """Read access to one log's messages. notes: sentences on damage."""

    def __init__(self, log, clock):
        self.log, self.clock = log, clock
        self.notes: list[str] = []

    def get(self, message, *columns):
        """(time s (n,), values (n, k)) of a message that has all the columns, else None."""
        table = self.log.table(message, columns)
        if table is None or any(c not in table or table[c].ndim > 1 or table[c].dtype.kind not in "iuf" for c in columns):
            return None
        time, good = self.clock.of(table.record)
        values = np.stack([table[c].astype(float) for c in columns], axis=1)
        return (time[good], values[good]) if good.any() else None

    def signal(self, kind, message, *columns, valid=None):
        sample = self.get(message, *columns)
        if sample is None:
            return None
        return series.signal(kind, *sample, message, self.notes, None if valid is None else valid(sample[1]))


def _signals(tables: _Tables, parameters) -> tuple[dict, dict]:
    rates = tables.signal("rates", "ATT", "RollRate", "PitchRate", "YawRate")
    motors, facts = _motors(tables, parameters)
    signals = {
        "motors": motors,
        "control": tables.signal("control", "ATTC", "Roll", "Pitch", "Yaw", "Thrust"),
        "throttle": tables.signal("throttle", "ATTC", "Thrust"),
        "gyro": series.fastest(rates, tables.signal("gyro", "IMU", "GyroX", "GyroY", "GyroZ")),
        "rates": rates,
        "accel": tables.signal("accel", "IMU", "AccX", "AccY", "AccZ"),
        "attitude": _attitude(tables),
        "velocity": tables.signal("velocity", "LPOS", "VX", "VY", "VZ"),
        "position": tables.signal("position", "LPOS", "X", "Y", "Z"),
        "battery": tables.signal("battery", "BATT", "V", "C", valid=series.voltage_and_current),
    }
    return {k: v for k, v in signals.items() if v is not None}, facts


def _motors(tables: _Tables, parameters):
    """The outputs of the driver that moves rotors, in rotor order, and the facts about them."""
    outputs = [f"Out{k}" for k in range(8)]
    instances = ((message, tables.get(message, *outputs)) for message in ("OUT0", "OUT1"))
    best = px4_outputs.best(instances, parameters, px4_topics.rotor_count(parameters))
    if best is None:
        return None, {}
    message, time, reading = best
    tables.notes += [reading.note] if reading.note else []
    motors = series.motors(time, reading.values, reading.unit, message, tables.notes)
    return motors, dict(reading.facts)


def _attitude(tables: _Tables):
    sample = tables.get("ATT", *_QUATERNION)
    if sample is not None:
        q, fine = series.unit_quaternion(sample[1])
        if fine.any():
            return series.signal("attitude", sample[0], q, "ATT", tables.notes, fine)
    sample = tables.get("ATT", *_ANGLES)
    if sample is None:
        return None
    fine = np.all(np.abs(sample[1]) < 7.0, axis=1)
    return series.signal("attitude", sample[0], series.quaternion(*np.where(fine[:, None], sample[1], 0.0).T), "ATT", tables.notes, fine)


def _messages(tables: _Tables) -> tuple[Message, ...]:
    """Arming, landing and flight mode, in time order."""
    out = []
    for column in ("ArmS", "ArmState"):
        if (sample := tables.get("STAT", column)) is not None:
            out += series.states("armed", sample[0], sample[1][:, 0] == _ARMED)
    if (sample := tables.get("LAND", "Landed") or tables.get("STAT", "Landed")) is not None:
        out += series.states("landed", sample[0], sample[1][:, 0])
    if (sample := tables.get("STAT", "NavState")) is not None:
        out += px4_topics.modes(sample[0], sample[1][:, 0])
    return tuple(sorted(out, key=lambda m: m.time))


def _firmware(log) -> str:
    """The first digits of the commit."""
    table = log.table("VER", ("FwGit",))
    if table is None or "FwGit" not in table or table["FwGit"].dtype.kind != "S":
        return "PX4"
    return f"PX4 {table['FwGit'][0].split(bytes(1), 1)[0].decode('latin-1')[:8]}".strip()
