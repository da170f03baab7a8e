"""MAVLink telemetry logs (.tlog), as ground stations write them. Messages: https://mavlink.io/en/messages/"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.output_functions import in_order, motor_outputs
from rotorwatch.flight.vehicle_kind import OTHERS
from rotorwatch.logs import mavlink_esc, mavlink_frames, mavlink_messages, parameter_ranges, px4_outputs, series, wall_clock
from rotorwatch.logs.dataflash_clock import make_clock
from rotorwatch.logs.dataflash_text import MODES
from rotorwatch.logs.px4_topics import MAV_TYPES, custom_mode
from rotorwatch.logs.px4_topics import rotor_count as px4_rotor_count

FORMAT = "MAVLink tlog"
ENDINGS = (".tlog",)

_AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}
_NO_AUTOPILOT = 8
_ARMED = 0x80  # HEARTBEAT.base_mode
_SIMULATOR = {"SIMSTATE", "SIM_STATE", "HIL_STATE", "HIL_STATE_QUATERNION"}  # ground truth: never decoded
UNTIMED = {
    *{"HEARTBEAT", "SYS_STATUS", "BATTERY_STATUS", "VFR_HUD", "STATUSTEXT", "PARAM_VALUE", "EXTENDED_SYS_STATE", "EKF_STATUS_REPORT"},
    *mavlink_esc.TELEMETRY,
}
_UNIX_US = 1e14  # larger time stamps count from 1970, smaller ones from the autopilot's start
_WRAP_US = 2.0**32  # SERVO_OUTPUT_RAW.time_usec starts again there
_SAME_MOMENT_US = 10e6  # between two messages of the same moment; a stamp further from its neighbours in the file is damaged
_FIX_3D, _UNKNOWN = 3, 65535  # of GPS_RAW_INT
_MG = G0 / 1000


def sniff(head: bytes, name: str) -> bool:
    """True when a MAVLink frame follows an 8-byte time stamp and another one follows that."""
    if name:
        return name.lower().endswith(ENDINGS)
    if len(head) < 30 or head[8] not in (0xFE, 0xFD):
        return False
    end = 8 + head[9] + (8 if head[8] == 0xFE else 12 + (13 if head[10] & 1 else 0))
    return end + 8 >= len(head) or head[end + 8] in (0xFE, 0xFD)


def read(data, name: str, progress=None) -> Flight:
    """Read the autopilot's side of a telemetry log. Times count from the smallest boot time of any of its messages.

    Raises LogError when no autopilot's heartbeat is in it."""
    log = _Log(data, progress)
    signals, facts = _signals(log)
    parameters, changes = parameters_of(log)
    end = series.end_of(signals)
    return Flight(
        format=FORMAT,
        autopilot=log.autopilot,
        signals=signals,
        duration=end,
        firmware=_firmware(log),
        vehicle_type=MAV_TYPES.get(log.vehicle, ("", 0))[0],
        parameters=parameters,
        parameter_changes=tuple(changes),
        messages=tuple(sorted((m for m in messages_of(log) if m.time <= end + 1), key=lambda m: m.time)),
        warnings=tuple(log.notes),
        start_us=int(log.start_us),
        facts={**facts, "mav_type": log.vehicle, "clock_jumps": log.clock_jumps, "utc_start": _utc_start(log)},
    )


def layouts() -> dict[str, mavlink_messages.Message]:
    """All messages that are read, by name."""
    known = mavlink_messages.by_name()
    clocked = {n for n, c in known.items() if {"time_boot_ms", "time_usec"} & set(c.fields)}
    return {n: known[n] for n in (clocked | UNTIMED & known.keys()) - _SIMULATOR}


class _Log:
    """The messages of a vehicle: `get(name)` -> (time s, structured array). notes: sentences on damage."""

    def __init__(self, data, progress):
        self.layouts = layouts()
        self.notes: list[str] = []
        self.frames = mavlink_frames.Frames(data, (c.id for c in self.layouts.values()), progress)
        if self.frames.skipped:
            self.notes.append(f"{self.frames.skipped} bytes of the log are damaged and were skipped")
        self._choose_vehicle()
        self._read_clock()

    def _choose_vehicle(self):
        """The multirotor with an autopilot whose heartbeat comes first; without one, the first vehicle of another kind."""
        heartbeat, first = self.layouts["HEARTBEAT"], None
        for system, component, message in self.frames.found:
            if message != heartbeat.id:
                continue
            beats, order = self.frames.decode(system, component, heartbeat)
            for other, kinds in enumerate((MAV_TYPES, OTHERS.keys() - MAV_TYPES.keys())):
                at = np.flatnonzero((beats["autopilot"] != _NO_AUTOPILOT) & np.isin(beats["type"], list(kinds)))
                if at.size and (first is None or (other, order[at[0]]) < first[:2]):
                    i = int(at[0])
                    first = other, order[i], system, component, int(beats["autopilot"][i]), int(beats["type"][i])
        if first is None:
            raise LogError("no heartbeat of a multirotor's autopilot is in this telemetry log")
        _, _, self.system, self.component, autopilot, self.vehicle = first
        self.autopilot = _AUTOPILOTS.get(autopilot, f"MAVLink autopilot {autopilot}")

    def _read_clock(self):
        """Decode all messages; find second 0 and the boot time at each place in the file."""
        self.tables, self._stamps = {}, {}
        clocks, short = [], []
        for name, layout in self.layouts.items():
            table, order = self.frames.decode(self.system, self.component, layout)
            if not table.size:
                continue
            self.tables[name] = table, order
            stamp = boot_us(table)
            if stamp is None:
                continue
            if "time_usec" in (table.dtype.names or ()) and table.dtype["time_usec"].itemsize == 4:
                short.append((name, stamp, order))
            else:
                clocks.append((name, stamp, order))
        if not any(np.isfinite(stamp).any() for _, stamp, _ in clocks):
            raise LogError("no message with a time stamp of the autopilot is in this telemetry log")
        place = np.concatenate([order for *_, order in clocks])
        raw = np.concatenate([stamp for _, stamp, _ in clocks])
        # In the order of the file all messages share one clock: damaged stamps do not fit into it.
        sequence = np.argsort(place, kind="stable")
        clock = make_clock(raw[sequence])
        self.notes += [w.rstrip(".") for w in clock.warnings]
        self.start_us, self.clock_jumps = clock.start_us, list(clock.jumps)
        fine, fixed = np.empty(raw.size, bool), np.empty(raw.size)
        fine[sequence] = clock.good & np.isfinite(raw[sequence])
        fixed[sequence] = clock.start_us + clock.time * 1e6
        self._place, first_come = place[sequence][fine[sequence]], fine[sequence]
        self._latest = np.maximum.accumulate(fixed[sequence][first_come])
        ahead = (raw - fixed)[sequence][first_come]
        at = 0
        for name, stamp, _ in clocks:
            part = slice(at, at + stamp.size)
            self._stamps[name] = np.where(fine[part], fixed[part], np.nan)
            at += stamp.size
        for name, stamp, order in short:  # 32-bit microseconds start again every 71 minutes
            before = self._before(order)
            now = self._latest[before] + ahead[before]
            unwrapped = stamp + _WRAP_US * np.round((now - stamp) / _WRAP_US)
            near = np.abs(unwrapped - now) < _SAME_MOMENT_US
            self._stamps[name] = np.where(near, np.maximum(unwrapped - ahead[before], self.start_us), np.nan)

    def _before(self, order):
        """Index into the known clock times of the latest one before each place in the file (the first, before any)."""
        return np.clip(np.searchsorted(self._place, order) - 1, 0, None)

    def get(self, name):
        """(time s (n,), table) of a message, or None. Messages without a clock get the latest time before them."""
        if name not in self.tables:
            return None
        table, order = self.tables[name]
        stamp = self._stamps.get(name)
        if stamp is None:
            return (self._latest[self._before(order)] - self.start_us) * 1e-6, table
        known = np.isfinite(stamp)
        return ((stamp[known] - self.start_us) * 1e-6, table[known]) if known.any() else None

    def clock(self, name) -> np.ndarray:
        """(n,) time s of each valid frame of a message that has a clock, NaN where unknown."""
        return (self._stamps[name] - self.start_us) * 1e-6


def boot_us(table):
    """(n,) us since the autopilot's start, NaN where unknown; None for a message without a clock."""
    names = table.dtype.names
    if "time_boot_ms" in names:
        stamp = table["time_boot_ms"] * 1e3
    elif "time_usec" in names:
        stamp = table["time_usec"].astype(float)
    else:
        return None
    return np.where((stamp > 0) & (stamp < _UNIX_US), stamp, np.nan)


def _columns(table, fields) -> np.ndarray:
    return series.floats([table[f] for f in fields]).T


# Signals of several messages: the fastest counts. For the others, the first available one.
FASTEST = ("motors", "gyro", "rates", "accel", "attitude")
MOTORS, STATUS = "SERVO_OUTPUT_RAW", "ACTUATOR_OUTPUT_STATUS"
BY_NUMBER = "no parameter says which output drives which rotor: rotor k was taken to be output k"
BANK = 16  # outputs of each of its ports
AXES, TURNS, PUSH = ("xgyro", "ygyro", "zgyro"), ("rollspeed", "pitchspeed", "yawspeed"), ("xacc", "yacc", "zacc")
IMUS = ("SCALED_IMU", "RAW_IMU", "SCALED_IMU2", "SCALED_IMU3")
ATTITUDES = ("ATTITUDE", "ATTITUDE_QUATERNION")
PARTS = {0x1: "gyro", 0x2: "accelerometer", 0x4: "compass", 0x20: "GPS", 0x10000: "radio", 0x200000: "estimate", 0x2000000: "battery"}
"""Bits of MAV_SYS_STATUS_SENSOR that are read."""
CRITICAL = 5  # MAV_STATE: a failsafe is active
VIBES = ("vibration_x", "vibration_y", "vibration_z")
VARIANCES = ("velocity_variance", "pos_horiz_variance", "pos_vert_variance", "compass_variance")
RATIOS = ("vel_ratio", "pos_horiz_ratio", "pos_vert_ratio", "mag_ratio")


class Messages(Protocol):
    """Messages of one vehicle, of a file or of a link. notes: sentences on damage."""

    autopilot: str
    vehicle: int
    notes: list[str]

    def get(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """(time s (n,), table) of a message, or None."""
        ...


class Reading(NamedTuple):
    """A message that carries a signal. make(log): the signal, or None without usable data."""

    source: str
    make: Callable[[Messages], Signal | None]


class Outputs(NamedTuple):
    """Location of the rotors' commands. numbers: output of each rotor, from 1; driver: PX4's output driver. least, most: of its counts,
    where its driver takes counts; empty where the outputs are pulses in us."""

    numbers: tuple[int, ...]
    driver: str = ""
    least: tuple[float, ...] = ()
    most: tuple[float, ...] = ()


@cache
def readings(outputs: Outputs) -> dict[str, tuple[Reading, ...]]:
    """Signal -> the messages that carry it, in order of preference: of a file and of a link. outputs: of `rotor_outputs`."""

    def by(kind, name, read, rows=lambda table: slice(None)):
        """Values, or (values, valid), that read(table) makes of a message's `rows`."""

        def make(log: Messages) -> Signal | None:
            sample = log.get(name)
            if sample is None:
                return None
            selected = rows(sample[1])
            values = read(sample[1][selected])
            values, valid = values if isinstance(values, tuple) else (values, None)
            return series.signal(kind, sample[0][selected], values, name, log.notes, valid)

        return Reading(name, make)

    def of(kind, name, fields, scale=1.0):
        return by(kind, name, lambda table: _columns(table, fields) * scale)

    return {
        "motors": (Reading(MOTORS, lambda log: _motors(log, outputs)), Reading(STATUS, lambda log: _actuators(log, outputs))),
        # At equal speed the attitude's rates are preferred: they are filtered, where an IMU's samples that far apart alias its vibration;
        # those of RAW_IMU come in steps of 1 mrad/s besides.
        "gyro": (
            *(of("rates", name, TURNS) for name in ATTITUDES),
            of("gyro", "HIGHRES_IMU", AXES),
            *(of("gyro", name, AXES, 1e-3) for name in IMUS),
        ),
        "rates": tuple(of("rates", name, TURNS) for name in ATTITUDES),
        "accel": (of("accel", "HIGHRES_IMU", PUSH), *(of("accel", name, PUSH, _MG) for name in IMUS)),
        "attitude": (by("attitude", "ATTITUDE", _angles), by("attitude", "ATTITUDE_QUATERNION", _quaternions)),
        "attitude_wanted": (by("attitude_wanted", "ATTITUDE_TARGET", lambda table: series.unit_quaternion(table["q"])),),
        "velocity": (
            of("velocity", "LOCAL_POSITION_NED", ("vx", "vy", "vz")),
            of("velocity", "GLOBAL_POSITION_INT", ("vx", "vy", "vz"), 0.01),
        ),
        "position": (of("position", "LOCAL_POSITION_NED", ("x", "y", "z")), by("position", "GLOBAL_POSITION_INT", _height)),
        "gps": (
            Reading("GPS_RAW_INT", lambda log: _gps(log, "GPS_RAW_INT")),
            Reading("GLOBAL_POSITION_INT", lambda log: _gps(log, "GLOBAL_POSITION_INT")),
        ),
        "throttle": (of("throttle", "VFR_HUD", ("throttle",), 0.01),),
        "battery": (by("battery", "SYS_STATUS", _battery), by("battery", "BATTERY_STATUS", _cells, _first_battery)),
        # PX4 sends coning and the gyro's vibration in the fields of x and y, which are below 1.
        "vibration": (by("vibration", "VIBRATION", lambda table: _columns(table, VIBES).max(axis=1)),),
        "clipping": (of("clipping", "VIBRATION", ("clipping_0",)),),
        "innovations": (of("innovations", "EKF_STATUS_REPORT", VARIANCES), of("innovations", "ESTIMATOR_STATUS", RATIOS)),
    }


def _signals(log: _Log) -> tuple[dict, dict]:
    parameters = parameters_of(log)[0]
    outputs = rotor_outputs(log, parameters)
    signals: dict[str, Signal | None] = {}
    for name, options in readings(outputs).items():
        if name == "motors" and log.autopilot == "PX4":
            continue
        there = [signal for option in options if (signal := option.make(log)) is not None]
        signals[name] = series.fastest(*there) if name in FASTEST else (there or [None])[0]
    facts: dict = {}
    if log.autopilot == "PX4":
        signals["motors"], facts = _px4_motors(log, parameters)
    if signals["motors"] is not None:
        facts.setdefault("outputs", outputs.numbers)
        if not motor_outputs(parameters):
            log.notes.append(BY_NUMBER)
    signals["esc"] = mavlink_esc.read(log.get, facts.get("outputs", ()), log.notes)
    return {k: v for k, v in signals.items() if v is not None}, facts


def rotor_count(log: Messages, parameters: Mapping[str, float]) -> int:
    """Number of rotors: of PX4 by its parameters, as its heartbeat may name another kind of vehicle; 0 where unknown."""
    by_type = MAV_TYPES.get(log.vehicle, ("", 0))[1]
    if log.autopilot != "PX4":
        return by_type
    if "CA_ROTOR_COUNT" in parameters:
        return px4_rotor_count(parameters) or by_type
    named = max((len(in_order(one)) for one in motor_outputs(parameters).values()), default=0)
    return named or px4_rotor_count(parameters) or by_type


def rotor_outputs(log: Messages, parameters: Mapping[str, float], rotors: int = 0) -> Outputs:
    """Outputs of the rotors: by the outputs' functions (`output_functions`) where known, else the first outputs; empty for an unknown
    vehicle. rotors: number of them, where known from elsewhere.

    Of several PX4 drivers with all motors the first counts; in a whole log the one that moves (`px4_outputs.best`)."""
    count = rotors or rotor_count(log, parameters)
    numbers, driver = tuple(range(1, count + 1)), px4_outputs.PWM if log.autopilot == "PX4" else ""
    for name, outputs in motor_outputs(parameters).items():
        if len(named := in_order(outputs)) >= max(count, 1):
            numbers, driver = named, name
            break
    counts = px4_outputs.count_range(parameters, driver, [n - 1 for n in numbers]) if log.autopilot == "PX4" else None
    return Outputs(numbers, driver, *(() if counts is None else (tuple(ends.tolist()) for ends in counts)))


def output_limits(log: Messages, parameters: Mapping[str, float], outputs: Outputs) -> dict:
    """Facts pwm_min and pwm_max of PX4's pulses, by its parameters."""
    if log.autopilot != "PX4" or outputs.least:
        return {}
    return px4_outputs.pulse_limits(parameters, outputs.driver, [n - 1 for n in outputs.numbers])


def _px4_motors(log: _Log, parameters: Mapping[str, float]) -> tuple[Signal | None, dict]:
    """Rotor commands of a whole PX4 log and the facts about them, as from its ULog: each port is an instance of its outputs.

    Without a parameter for the number of rotors, the moving outputs are counted: a heartbeat may name another kind of vehicle."""
    count, readings_ = rotor_count(log, parameters), []
    known = "CA_ROTOR_COUNT" in parameters or bool(motor_outputs(parameters))
    for source, instances in ((MOTORS, _ports(log)), (STATUS, [_status(log)])):
        tried = (px4_outputs.best(((source, one) for one in instances), parameters, n) for n in ((count,) if known else (0, count)))
        best = next((one for one in tried if one is not None), None)
        if best is None:
            continue
        _, time, reading = best
        driven = reading.values > 0 if reading.unit == "us" else None
        signal = series.motors(time, reading.values, reading.unit, source, log.notes, driven)
        if signal is not None:
            readings_.append((signal, reading))
    motors = series.fastest(*(signal for signal, _ in readings_))
    reading = next((reading for signal, reading in readings_ if signal is motors), None)
    if reading is None:
        return None, {}
    log.notes += [reading.note] if reading.note else []
    return motors, {**reading.facts, "outputs": reading.outputs}


def _ports(log: Messages) -> list[tuple[np.ndarray, np.ndarray]]:
    """(time, outputs (m, 16)) of each port of SERVO_OUTPUT_RAW."""
    sample = log.get(MOTORS)
    if sample is None:
        return []
    time, table = sample
    rows = [table["port"] == port for port in np.unique(table["port"])]
    fields = [f"servo{k + 1}_raw" for k in range(BANK)]
    return [(time[on_port], _columns(table[on_port], fields)) for on_port in rows]


def _status(log: Messages) -> tuple[np.ndarray, np.ndarray] | None:
    """(time, outputs (m, k)) of ACTUATOR_OUTPUT_STATUS, for the active outputs."""
    sample = log.get(STATUS)
    if sample is None:
        return None
    return sample[0], series.floats(sample[1]["actuator"][:, : int(sample[1]["active"].max())])


def _motors(log: Messages, outputs: Outputs) -> Signal | None:
    """Rotor commands from SERVO_OUTPUT_RAW: outputs 1 to 16 are on port 0, 17 to 32 on port 1."""
    sample = log.get(MOTORS)
    numbers = outputs.numbers
    if sample is None or not numbers:
        return None
    bank = int(min(numbers) > BANK)
    if max(numbers) > BANK * (bank + 1):
        log.notes.append(f"{MOTORS}: rotors on both banks of outputs (port 0 and 1) are not read")
        return None
    on_port = sample[1]["port"] == bank
    time, table = sample[0][on_port], sample[1][on_port]
    if not time.size:
        return None
    values = _columns(table, [f"servo{n - BANK * bank}_raw" for n in numbers])
    return _commands(log, time, values, outputs, MOTORS, values > 0)  # 0: not driven yet


def _actuators(log: Messages, outputs: Outputs) -> Signal | None:
    """Rotor commands from ACTUATOR_OUTPUT_STATUS, in the units of SERVO_OUTPUT_RAW."""
    sample = log.get(STATUS)
    if sample is None or not outputs.numbers:
        return None
    values = series.floats(sample[1]["actuator"][:, [n - 1 for n in outputs.numbers]])
    with np.errstate(invalid="ignore"):
        driven = (values > 0) & (np.array(outputs.numbers) <= sample[1]["active"][:, None])
    return _commands(log, sample[0], values, outputs, STATUS, driven)


def _commands(log: Messages, time, values, outputs: Outputs, source: str, driven) -> Signal | None:
    """Values of the rotors' outputs, pulses or counts, as commands."""
    if not outputs.least:
        return series.motors(time, values, "us", source, log.notes, driven)
    values = np.where(values == px4_outputs.NO_COMMAND, 0.0, values)
    least, most = np.array(outputs.least), np.array(outputs.most)
    return series.motors(time, np.clip((values - least) / (most - least), 0.0, 1.0), "1", source, log.notes)


def _angles(table):
    return series.quaternion(*_columns(table, ("roll", "pitch", "yaw")).T)


def _quaternions(table):
    return series.unit_quaternion(_columns(table, ("q1", "q2", "q3", "q4")))


def _utc_start(log: _Log) -> str | None:
    """UTC of second 0: by the autopilot, else from the times at which the ground station received its attitude."""
    sample = log.get("SYSTEM_TIME")
    utc = wall_clock.start(sample[0], sample[1]["time_unix_usec"] * 1e-6) if sample is not None else None
    if utc is None and "ATTITUDE" in log.tables:
        received = log.frames.received(log.system, log.component, log.layouts["ATTITUDE"])
        time = log.clock("ATTITUDE")
        utc = wall_clock.start(time, received) if received.size == time.size else None
    return utc


def _height(table):
    """Position with only its height."""
    height = table["relative_alt"] * -1e-3
    return np.column_stack([np.full((height.size, 2), np.nan), height])


def _gps(log: Messages, name: str) -> Signal | None:
    """The GPS's own message, or the estimate that follows it."""
    sample = log.get(name)
    if sample is None:
        return None
    table = sample[1]
    if "fix_type" in (table.dtype.names or ()):
        fixed, speed = table["fix_type"] >= _FIX_3D, np.where(table["vel"] < _UNKNOWN, table["vel"] * 1e-2, np.nan)
    else:
        fixed, speed = np.ones(table.size, bool), np.hypot(table["vx"] * 1e-2, table["vy"] * 1e-2)
    degrees = _columns(table, ("lat", "lon")) * 1e-7
    return series.gps(sample[0], degrees, table["alt"] * 1e-3, speed, fixed, name)


def _battery(table):
    values = _columns(table, ("voltage_battery", "current_battery"))
    fine = np.column_stack([(values[:, 0] > 0) & (values[:, 0] < 65535), values[:, 1] >= 0])
    return values * [1e-3, 1e-2], fine


def _first_battery(table):
    return table["id"] == 0


def _cells(table):
    """A battery by its cells."""
    cells = table["voltages"].astype(float)
    there = (cells > 0) & (cells < 65535)
    volt, ampere = np.where(there, cells, 0.0).sum(axis=1), table["current_battery"].astype(float)
    fine = np.column_stack([there.any(axis=1), ampere >= 0])
    return np.column_stack([volt * 1e-3, ampere * 1e-2]), fine


def parameters_of(log: Messages):
    """(parameters, changes) from PARAM_VALUE without the simulator's: SIM_* can disclose a fault."""
    values, changes = {}, []
    sample = log.get("PARAM_VALUE")
    if sample is None:
        return values, changes
    for time, row in zip(sample[0], sample[1]):
        name = row["param_id"].decode("ascii", "replace")
        value = row["param_value"]
        if log.autopilot == "PX4" and row["param_type"] == 6:  # PX4 sends the bytes of an int32 as they are
            value = value.view("<i4")
        value = float(value)
        if name.startswith("SIM_") or not np.isfinite(value) or not parameter_ranges.possible(name, value):
            continue
        if values.setdefault(name, value) != value:
            if next((v for _, n, v in reversed(changes) if n == name), values[name]) != value:
                changes.append((float(time), name, value))
    return values, changes


def _mode(autopilot: str, number: int) -> str:
    """The name of a flight mode (HEARTBEAT.custom_mode) of a multirotor."""
    if autopilot == "PX4":
        return custom_mode(number)
    return MODES.get(number, f"mode {number}") if autopilot == "ArduPilot" else f"mode {number}"


def messages_of(log: Messages) -> list[Message]:
    out = []
    beats = log.get("HEARTBEAT")
    if beats is not None:
        out += series.states("armed", beats[0], beats[1]["base_mode"] & _ARMED)
        for time, value in series.changes(beats[0], beats[1]["custom_mode"]):
            out.append(Message(time, "mode", _mode(log.autopilot, int(value)), value))
    states = log.get("EXTENDED_SYS_STATE")
    if states is not None:
        known = states[1]["landed_state"] > 0
        out += series.states("landed", states[0][known], states[1]["landed_state"][known] == 1)
    out += _health(log)
    texts = log.get("STATUSTEXT")
    if texts is not None:
        for time, row in zip(texts[0], texts[1]):
            text = row["text"].decode("utf-8", "replace").strip()
            out.append(Message(float(time), "error" if row["severity"] <= 3 else "text", text))
    return out


def _health(log: Messages) -> list[Message]:
    """Changes of the health of each part, value 1 where unhealthy, and its first state; and whether a failsafe is active."""
    out, status, beats = [], log.get("SYS_STATUS"), log.get("HEARTBEAT")
    if status is not None:
        time, table = status
        watched = table["onboard_control_sensors_present"] & table["onboard_control_sensors_enabled"]
        ill = watched & ~table["onboard_control_sensors_health"]
        for bit, part in PARTS.items():
            there = (watched & bit) != 0
            for when, value in series.changes(time[there], (ill[there] & bit) != 0):
                out.append(Message(when, "health", f"{part} {'un' * int(value)}healthy", value))
    if beats is not None:
        for when, value in series.changes(beats[0], beats[1]["system_status"] == CRITICAL):
            out.append(Message(when, "health", f"failsafe {'begins' if value else 'over'}", value))
    return out


def _firmware(log: _Log) -> str:
    """From the version text that the autopilot announces on a parameter download, where that is in the log."""
    texts = log.get("STATUSTEXT")
    if texts is not None:
        for row in texts[1]["text"]:
            text = row.decode("utf-8", "replace").strip()
            if text.startswith(("ArduCopter V", "APM:Copter V", "PX4 v")):
                return text
    return log.autopilot
