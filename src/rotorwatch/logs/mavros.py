"""Topics of mavros -> signals. mavros speaks ROS's frames: world east, north, up, body forward, left, up (REP 103); both are turned here.

    rc/out               mavros_msgs/RCOut           channels, us                        motors
    imu/data_raw         sensor_msgs/Imu             angular_velocity, linear_acceleration (about +9.8 up in hover)
    imu/data             sensor_msgs/Imu             orientation, angular_velocity
    local_position/odom  nav_msgs/Odometry           position in the world, velocity in the body
    global_position/raw/fix, global_position/global                                      gps
    local_position/pose, local_position/velocity_local, battery (current is negative), esc_telemetry, esc_status, vfr_hud (throttle),
    setpoint_raw/target_attitude, state, extended_state, statustext, param/event

Time is the header's, on ROS's clock. https://github.com/mavlink/mavros/tree/ros2/mavros
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import numpy as np

from rotorwatch.base.arrays import median, unique
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.logs import dataflash_rotors, esc_columns, parameter_ranges, px4_outputs, series, wall_clock
from rotorwatch.logs.px4_topics import rotor_count

Table = tuple[str, np.ndarray, Mapping[str, np.ndarray]]
"""Type, times of receipt (m,) ns, columns."""

_TOPICS = {
    "rc/out": "mavros_msgs/msg/RCOut",
    "imu/data": "sensor_msgs/msg/Imu",
    "imu/data_raw": "sensor_msgs/msg/Imu",
    "state": "mavros_msgs/msg/State",
    "extended_state": "mavros_msgs/msg/ExtendedState",
    "battery": "sensor_msgs/msg/BatteryState",
    "local_position/odom": "nav_msgs/msg/Odometry",
    "local_position/pose": "geometry_msgs/msg/PoseStamped",
    "local_position/velocity_local": "geometry_msgs/msg/TwistStamped",
    "global_position/global": "sensor_msgs/msg/NavSatFix",
    "global_position/raw/fix": "sensor_msgs/msg/NavSatFix",
    "esc_telemetry": "mavros_msgs/msg/ESCTelemetry",
    "esc_telemetry/telemetry": "mavros_msgs/msg/ESCTelemetry",
    "esc_status": "mavros_msgs/msg/ESCStatus",
    "esc_status/status": "mavros_msgs/msg/ESCStatus",
    "vfr_hud": "mavros_msgs/msg/VfrHud",
    "setpoint_raw/target_attitude": "mavros_msgs/msg/AttitudeTarget",
    "statustext/recv": "mavros_msgs/msg/StatusText",
    "param/event": "mavros_msgs/msg/ParamEvent",
}
FIELDS = {
    "sensor_msgs/msg/Imu": ("header", "orientation", "angular_velocity", "linear_acceleration"),
    "sensor_msgs/msg/BatteryState": ("header", "voltage", "current"),
    "sensor_msgs/msg/NavSatFix": ("header", "status", "latitude", "longitude", "altitude"),
    "nav_msgs/msg/Odometry": ("header", "pose", "twist"),
}
"""The fields that are used, where a message has many others."""

_PLACES = ("global_position/raw/fix", "global_position/global")
_OUTPUTS = "rc/out"
_FLU = np.array([1.0, -1.0, -1.0])  # forward, left, up -> forward, right, down
_CHANNELS = 18
_PX4_MODES = ("AUTO.", "POSCTL", "ALTCTL", "OFFBOARD", "STABILIZED", "RATTITUDE")
_ARDUPILOT_MODES = "STABILIZE ALT_HOLD GUIDED LOITER RTL LAND POSHOLD SMART_RTL BRAKE GUIDED_NOGPS AUTO".split()
_NUMBERS = {1: "bool_value", 2: "integer_value", 3: "double_value"}  # rcl_interfaces/ParameterType
_LAST_SEVERE = 3
_ESC = {"speed": "rpm", "current": "current", "voltage": "voltage", "temperature": "temperature"}


def place(topic: str, kind: str) -> tuple[str, str] | None:
    """(name space, topic without it) of a topic of mavros: ("/mavros", "rc/out"); None for others."""
    for name, of in _TOPICS.items():
        if kind == of and topic.endswith("/" + name):
            return topic[: -len(name) - 1], name
    return None


def has_outputs(found: Mapping[str, Table]) -> bool:
    """True if servo outputs are among these topics."""
    return any((at := place(name, kind)) and at[1] == _OUTPUTS for name, (kind, *_) in found.items())


def flight(found: Mapping[str, Table], notes: list[str], form: str) -> Flight:
    """The flight of one vehicle's topics. Raises LogError when none of them is mavros's own."""
    log = _Log(found, notes)
    parameters = _parameters(log)
    autopilot = _autopilot(log, parameters)
    parameters, impossible = parameter_ranges.checked(parameters)
    notes += impossible
    signals, facts = _signals(log, parameters, autopilot)
    if "motors" not in signals:
        notes.append("the bag has no motor commands: record /mavros/rc/out, and have the autopilot stream SERVO_OUTPUT_RAW")
    if not parameters:
        notes.append("parameters are not in this bag; --vehicle FILE describes the airframe")
    end = series.end_of(signals)
    return Flight(
        format=form,
        autopilot=autopilot,
        signals=signals,
        duration=end,
        firmware=autopilot,
        parameters=parameters,
        messages=tuple(sorted((m for m in _messages(log) if m.time <= end + 1), key=lambda m: m.time)),
        warnings=tuple(notes),
        start_us=round(log.start * 1e6),
        facts={**facts, "utc_start": wall_clock.start([0.0], [log.start])},
    )


class _Log:
    """The topics of a vehicle: `get(name)` -> (time s, columns). start: s on ROS's clock that is second 0."""

    def __init__(self, found: Mapping[str, Table], notes: list[str]):
        self.notes = notes
        spaces: dict[str, dict[str, tuple[np.ndarray, Mapping[str, np.ndarray]]]] = {}
        for topic, (kind, received, columns) in found.items():
            at = place(topic, kind)
            if at and "header.stamp.sec" in columns:
                spaces.setdefault(at[0], {})[at[1]] = _time(columns, received), columns
        # An IMU's or a battery's topic alone may be any robot's.
        spaces = {s: t for s, t in spaces.items() if {_OUTPUTS, "state", "extended_state", "vfr_hud"} & set(t)}
        if not spaces:
            raise LogError("this bag holds no topic of mavros that says what an autopilot did (record /mavros/rc/out, /mavros/state)")
        chosen = max(sorted(spaces), key=lambda s: (_OUTPUTS in spaces[s], sum(len(t) for t, _ in spaces[s].values())))
        if len(spaces) > 1:
            others = ", ".join(sorted(s for s in spaces if s != chosen))
            notes.append(f"this bag is of several vehicles; {chosen} was read, {others} was not")
        self.topics = spaces[chosen]
        flown = {name: t for name, (t, _) in self.topics.items() if name not in _PLACES}
        self.start = min(float(t[series.steady(t)[0]]) for t in flown.values())

    def get(self, name: str) -> tuple[np.ndarray, Mapping[str, np.ndarray]] | None:
        topic = self.topics.get(name)
        return None if topic is None else (topic[0] - self.start, topic[1])

    def signal(self, kind: str, name: str, read: Callable, source: str = "") -> Signal | None:
        """The Signal `kind` of a topic; None without it. read(columns): values, or (values, valid)."""
        sample = self.get(name)
        if sample is None:
            return None
        values = read(sample[1])
        values, valid = values if isinstance(values, tuple) else (values, None)
        return series.signal(kind, sample[0], values, source or name, self.notes, valid)


def _time(columns, received) -> np.ndarray:
    """(m,) s on ROS's clock: the header's, else the time of receipt."""
    stamp = columns["header.stamp.sec"].astype(np.float64) + 1e-9 * columns["header.stamp.nanosec"].astype(np.float64)
    known = stamp > 0
    received = received * 1e-9
    later = float(median(stamp[known] - received[known])) if known.any() else 0.0
    return np.where(known, stamp, received + later)


def _vector(table, name: str) -> np.ndarray:
    return series.stacked(table, [f"{name}.{a}" for a in "xyz"])


def _quaternion(table, name: str) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4) body to world in our axes, and (n,) bool where it is one."""
    return series.unit_quaternion(turned(series.stacked(table, [f"{name}.{a}" for a in "xyzw"])))


def turned(q: np.ndarray) -> np.ndarray:
    """(n, 4) quaternion x, y, z, w of forward-left-up in east-north-up -> w, x, y, z of forward-right-down in north-east-down.

    q' = e * q * b with e the turn of the world, (i + j) / sqrt 2, and b that of the body, i: half a turn about the nose."""
    x, y, z, w = q.T
    return np.stack([w + z, x + y, x - y, w - z], axis=1) * np.sqrt(0.5)


def _signals(log: _Log, parameters, autopilot: str) -> tuple[dict, dict]:
    turning, pushing = _in_body("angular_velocity"), _in_body("linear_acceleration")
    rates = log.signal("rates", "imu/data", turning)
    motors, facts = _motors(log, parameters, autopilot)
    odom = "local_position/odom" if "local_position/odom" in log.topics else ""
    signals = {
        "motors": motors,
        # Raw rates come in steps of 1 mrad/s, so at equal speed the others, which are finer, are preferred.
        "gyro": series.fastest(rates, log.signal("gyro", "imu/data_raw", turning)),
        "rates": rates,
        "accel": series.fastest(*(log.signal("accel", name, pushing) for name in ("imu/data_raw", "imu/data"))),
        "attitude": log.signal("attitude", "imu/data", lambda t: _quaternion(t, "orientation"), "mavros attitude"),
        "attitude_wanted": log.signal(
            "attitude_wanted", "setpoint_raw/target_attitude", lambda t: _quaternion(t, "orientation"), "mavros attitude_wanted"
        ),
        "velocity": log.signal("velocity", odom, _odometry)
        if odom
        else log.signal("velocity", "local_position/velocity_local", _ned("twist.linear")),
        "position": log.signal("position", odom, _ned("pose.pose.position"))
        if odom
        else log.signal("position", "local_position/pose", _ned("pose.position")),
        "gps": next(filter(None, (_gps(log, name) for name in _PLACES)), None),
        "throttle": log.signal("throttle", "vfr_hud", lambda t: series.stacked(t, ["throttle"])),
        "battery": log.signal("battery", "battery", _battery),
        "esc": _esc(log, len(motors.columns) if motors is not None else 0),
    }
    return {k: v for k, v in signals.items() if v is not None}, facts


def _in_body(field: str) -> Callable:
    def read(table):
        values = _vector(table, field) * _FLU
        return values, values.any(axis=1)  # all 0: unknown

    return read


def _ned(field: str) -> Callable:
    return lambda table: _vector(table, field)[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def _odometry(table) -> tuple[np.ndarray, np.ndarray]:
    """(velocity (n, 3) in north, east, down, valid), from the odometry's body velocity."""
    q, fine = _quaternion(table, "pose.pose.orientation")
    return _rotated(q, _vector(table, "twist.twist.linear") * _FLU), fine


def _rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) vectors of the body in the world; q (n, 4) scalar first, body to world."""
    w, u = q[:, :1], q[:, 1:]
    t = 2.0 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def _motors(log: _Log, parameters, autopilot: str) -> tuple[Signal | None, dict]:
    sample = log.get(_OUTPUTS)
    if sample is None:
        return None, {}
    time, table = sample
    names = [name for k in range(_CHANNELS) if (name := f"channels[{k}]") in table]
    if not names:
        return None, {}
    channels = series.stacked(table, names)
    if autopilot == "PX4":
        reading = px4_outputs.read(channels, parameters, rotor_count(parameters))
        if reading is None:
            return None, {}
        log.notes += [reading.note] if reading.note else []
        return series.motors(time, reading.values, reading.unit, _OUTPUTS, log.notes), dict(reading.facts)
    class_ = dataflash_rotors.frame(parameters, ("", ""))[0]
    named = class_ or any(re.fullmatch(r"SERVO\d+_FUNCTION", n) for n in parameters)
    moving = {k + 1: column for k, column in enumerate(channels.T) if _moves(column)}
    outputs, assumptions = dataflash_rotors.outputs(
        parameters, class_, {k + 1: c for k, c in enumerate(channels.T)} if named else _first(moving)
    )
    log.notes += [s.rstrip(".") for s in assumptions]
    picked = [n for n in outputs.values() if n <= channels.shape[1]]
    if not picked:
        return None, {}
    values = channels[:, [n - 1 for n in picked]]
    driven = values > 0
    return series.motors(time, values, "us", _OUTPUTS, log.notes, driven), {"outputs": tuple(picked)}


def _moves(column: np.ndarray) -> bool:
    """True if an output takes many values, as rotors' do: servos and spare outputs step between a few."""
    fine = column[np.isfinite(column) & (column > 500) & (column < 2600)]
    return unique(fine).size >= px4_outputs.LEAST_VALUES


def _first(moving: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """The first outputs that move, up to the first that does not: motors come before a gimbal."""
    out = {}
    for number in sorted(moving):
        if out and number - 1 not in out:
            break
        out[number] = moving[number]
    return out


def _gps(log: _Log, name: str) -> Signal | None:
    sample = log.get(name)
    if sample is None:
        return None
    table = sample[1]
    degrees = series.stacked(table, ["latitude", "longitude"])
    altitude = np.asarray(table["altitude"], float)
    return series.gps(sample[0], degrees, altitude, np.full(len(degrees), np.nan), table["status.status"] >= 0, name)


def _battery(table) -> tuple[np.ndarray, np.ndarray]:
    values = series.stacked(table, ["voltage", "current"]) * [1.0, -1.0]  # a discharge current is negative there
    return values, series.voltage_and_current(values)


def _esc(log: _Log, count: int) -> Signal | None:
    """ESC telemetry, in the order of the motors' outputs."""
    for topic, field in (("esc_telemetry/telemetry", "esc_telemetry"), ("esc_status/status", "esc_status")):
        sample = log.get(topic) or log.get(field)
        there = [k for k in range(px4_outputs.MOTOR_12) if f"{field}[{k}].rpm" in sample[1]] if sample else []
        if sample and there:
            return esc_columns.numbered(*sample, f"{field}[{{}}].", _ESC, there[: count or None], field, log.notes)
    return None


def _parameters(log: _Log) -> dict[str, float]:
    """Parameters of param/event without the simulator's: SIM_* would disclose a fault."""
    sample, out = log.get("param/event"), {}
    if sample is None:
        return out
    table = sample[1]
    for i, name in enumerate(table.get("param_id", ())):
        column = table.get(f"value.{_NUMBERS.get(int(table['value.type'][i]), '')}")
        if column is None or not name or name.startswith("SIM_"):
            continue
        value = float(column[i])
        if np.isfinite(value):
            out.setdefault(str(name), value)
    return out


def _autopilot(log: _Log, parameters) -> str:
    """ArduPilot or PX4, by the names of parameters or of flight modes; "" where unknown."""
    if "CA_ROTOR_COUNT" in parameters or "SYS_AUTOSTART" in parameters:
        return "PX4"
    if "FRAME_CLASS" in parameters or "SERVO1_FUNCTION" in parameters:
        return "ArduPilot"
    sample = log.get("state")
    modes = [str(m) for m in sample[1].get("mode", ())] if sample is not None else []
    if any(m.startswith(_PX4_MODES) and m != "STABILIZE" for m in modes):
        return "PX4"
    return "ArduPilot" if any(m in _ARDUPILOT_MODES for m in modes) else ""


def _messages(log: _Log) -> list[Message]:
    out = []
    state = log.get("state")
    if state is not None and "armed" in state[1]:
        time = np.maximum(state[0], 0.0)
        out += series.states("armed", time, state[1]["armed"])
        modes = state[1].get("mode", np.zeros(0, object))
        known, number = np.unique(modes.astype(str), return_inverse=True)
        for at, value in series.changes(time, number) if modes.size else []:
            out.append(Message(at, "mode", str(known[int(value)]), value))
    extended = log.get("extended_state")
    if extended is not None and "landed_state" in extended[1]:
        landed = extended[1]["landed_state"]
        out += series.states("landed", np.maximum(extended[0], 0.0)[landed > 0], landed[landed > 0] == 1)
    texts = log.get("statustext/recv")
    if texts is not None and "text" in texts[1]:
        for at, severity, text in zip(texts[0], texts[1]["severity"], texts[1]["text"]):
            out.append(Message(float(at), "error" if severity <= _LAST_SEVERE else "text", str(text).strip()))
    return out
