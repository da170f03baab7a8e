"""PX4's topics -> signals, from any file format (ULog, ulog2csv tables).

Topics are {(name, instance): {field: (n,) array}} with fields named as PX4 flattens them ("control[0]") and `timestamp` in us. Message
definitions: https://docs.px4.io/main/en/msg_docs/
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.flight import Message, vehicle_kind
from rotorwatch.logs import px4_outputs, px4_raw, px4_reports, series, wall_clock

TOPICS = (
    *"actuator_armed actuator_controls_0 actuator_motors actuator_outputs battery_status esc_status sensor_combined sensor_gps".split(),
    *(f"vehicle_{name}" for name in "acceleration angular_velocity attitude attitude_setpoint gps_position land_detected".split()),
    *(f"vehicle_{name}" for name in "local_position rates_setpoint status thrust_setpoint torque_setpoint".split()),
    *px4_reports.TOPICS,
)
"""The topics that are read; all others, simulator truth among them, never are."""
RAW, SPEEDS = px4_raw.TOPICS, "esc_status"
"""Topics that are read as well where the log has the topic SPEEDS."""

MAV_TYPES = {
    2: ("quadrotor", 4),
    3: ("coaxial", 2),
    4: ("helicopter", 0),
    13: ("hexarotor", 6),
    14: ("octorotor", 8),
    15: ("tricopter", 3),
    29: ("dodecarotor", 12),
    35: ("decarotor", 10),
}
"""MAVLink MAV_TYPE: name, number of rotors (0: not a multirotor)."""

NAV_STATES = {
    **{0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return", 6: "Position slow"},
    **{10: "Acro", 12: "Descend", 13: "Termination", 14: "Offboard", 15: "Stabilized", 17: "Takeoff", 18: "Land"},
    **{19: "Follow", 20: "Precision land", 21: "Orbit"},
}

MAIN_MODES = {
    **{1: "Manual", 2: "Altitude", 3: "Position", 5: "Acro", 6: "Offboard", 7: "Stabilized", 8: "Rattitude"},
    **{10: "Termination", 11: "Altitude cruise"},
}
AUTO_MODES = {
    **{1: "Ready", 2: "Takeoff", 3: "Hold", 4: "Mission", 5: "Return", 6: "Land", 8: "Follow", 9: "Precision land"},
    **{10: "VTOL takeoff"},
}
"""px4_custom_mode.h: main modes, and the sub-modes of main mode 4."""

_AUTO = 4
_GPS_DEGREES = ("latitude_deg", "longitude_deg", "altitude_msl_m")  # as PX4 logs them from 1.14 on
_FIX_3D = 3
_ARMED = 2  # vehicle_status.arming_state


class Topics:
    """Read access to one log's topics. start_us: time stamp that is second 0; notes: sentences on damage."""

    def __init__(self, tables, start_us: int):
        self.tables, self.start_us, self.notes = tables, start_us, []

    def table(self, name, *fields, instance=0, early=False):
        """(time s (n,), table) of a topic that has all `fields`, else None.

        Samples from before the start (states latched there) are left out, or counted as second 0 with `early`."""
        table = self.tables.get((name, instance))
        if table is None and instance == 0:  # loggers may count instances from 1
            numbers = [number for topic, number in self.tables if topic == name]
            table = self.tables[name, min(numbers)] if numbers else None
        if table is None or "timestamp" not in table or any(f not in table for f in fields):
            return None
        stamp = np.asarray(table["timestamp"])
        # Difference in the stamp's own integer type: unix-epoch microseconds lose nothing that way.
        time = (stamp.astype(np.int64) - np.int64(self.start_us)) * 1e-6
        if early:
            return np.maximum(time, 0.0), table
        late = time >= 0
        if not late.all():
            table = {k: np.asarray(v)[late] for k, v in table.items()}
        return time[late], table

    def signal(self, kind, name, fields, valid=None):
        """The Signal `kind` from the given fields of a topic, or None. valid: 0/1 fields, one for each, or None."""
        data = self.table(name, *fields)
        if data is None:
            return None
        time, table = data
        fine = series.stacked(table, valid) != 0 if valid and all(v in table for v in valid) else None
        return series.signal(kind, time, series.stacked(table, fields), name, self.notes, fine)


def numbered(name, n) -> list[str]:
    return [f"{name}[{k}]" for k in range(n)]


def signals(topics: Topics, parameters) -> tuple[dict, dict]:
    """All signals that the topics hold, and the facts about them: pwm_min, pwm_max."""
    xyz, motors = numbered("xyz", 3), None
    rates = topics.signal("rates", "vehicle_angular_velocity", xyz) or topics.signal(
        "rates", "vehicle_attitude", ["rollspeed", "pitchspeed", "yawspeed"]
    )
    battery = _battery(topics)
    signals_ = {
        "control": _control(topics),
        "gyro": series.fastest(rates, topics.signal("gyro", "sensor_combined", numbered("gyro_rad", 3))),
        "rates": rates,
        "accel": series.fastest(
            topics.signal("accel", "vehicle_acceleration", xyz),
            topics.signal("accel", "sensor_combined", numbered("accelerometer_m_s2", 3)),
        ),
        "attitude": _attitude(topics, "attitude", "vehicle_attitude", "q"),
        "attitude_wanted": _attitude(topics, "attitude_wanted", "vehicle_attitude_setpoint", "q_d"),
        "rates_wanted": topics.signal("rates_wanted", "vehicle_rates_setpoint", ["roll", "pitch", "yaw"]),
        "velocity": topics.signal(
            "velocity", "vehicle_local_position", ["vx", "vy", "vz"], valid=["v_xy_valid", "v_xy_valid", "v_z_valid"]
        ),
        "position": topics.signal("position", "vehicle_local_position", ["x", "y", "z"], valid=["xy_valid", "xy_valid", "z_valid"]),
        "battery": battery,
        "gps": _gps(topics),
        "esc": (esc := _esc(topics, parameters)),
        **(px4_raw.signals(topics) if esc is not None else {}),
        **px4_reports.limited(topics),
    }
    motors, facts = _motors(topics, parameters)
    signals_["motors"] = motors
    facts |= _kind(topics)
    if signals_["control"] is not None:
        thrust = signals_["control"]
        valid = None if thrust.valid is None else thrust.valid[:, 3:]
        signals_["throttle"] = series.signal("throttle", thrust.time, thrust.values[:, 3:], thrust.source, topics.notes, valid)
    return {k: v for k, v in signals_.items() if v is not None}, facts | {"utc_start": _utc_start(topics)}


def rotor_count(parameters) -> int:
    """Number of rotors by parameter (CA_ROTOR_COUNT, else MAV_TYPE); 0 when unknown."""
    count = int(parameters.get("CA_ROTOR_COUNT", 0))
    return count if 0 < count <= 12 else MAV_TYPES.get(int(parameters.get("MAV_TYPE", 0)), ("", 0))[1]


def _kind(topics: Topics) -> dict:
    """Fact mav_type, from vehicle_status: its system_type (MAV_TYPE), else is_vtol and vehicle_type (1.10 and later)."""
    data = topics.table("vehicle_status", early=True)
    if data is None or not data[0].size:
        return {}
    usual = {k: float(median(data[1][k])) for k in ("system_type", "is_vtol", "vehicle_type") if k in data[1]}
    if usual.get("system_type", 0) > 0:
        return {"mav_type": int(usual["system_type"])}
    if usual.get("is_vtol", 0) > 0:
        return {"mav_type": vehicle_kind.VTOL}
    kinds = {2: vehicle_kind.PLANE, 3: vehicle_kind.ROVER}
    return {"mav_type": kinds[int(usual["vehicle_type"])]} if usual.get("vehicle_type") in kinds else {}


def _motors(topics: Topics, parameters):
    """Rotor commands and facts. actuator_motors (1.13+) is in rotor order; actuator_outputs may need mapping."""
    count = rotor_count(parameters)
    data = topics.table("actuator_motors", "control[0]")
    if data is not None and data[0].size:
        time, table = data
        fields = [f for f in numbered("control", 12) if f in table]
        values = series.stacked(table, fields)
        finite = np.isfinite(values).mean(axis=0)
        used = np.flatnonzero(finite > 0.1 * finite.max())  # a damaged NaN can be a number
        if used.size:
            left = [int(k) + 1 for k in used[used >= count] if np.nanstd(values[:, k]) > 0.0] if count else []
            values = values[:, : count or used[-1] + 1]
            return series.motors(time, values, "1", "actuator_motors", topics.notes), {"outputs_left_out": left}

    def outputs(instance):
        data = topics.table("actuator_outputs", "output[0]", instance=instance)
        if data is None:
            return None
        return data[0], series.stacked(data[1], [f for f in numbered("output", 16) if f in data[1]])

    instances = ((f"actuator_outputs[{k}]" if k else "actuator_outputs", outputs(k)) for k in range(4))
    best = px4_outputs.best(instances, parameters, count)
    if best is None:
        return _mixed(topics, parameters), {}
    source, time, reading = best
    topics.notes += [reading.note] if reading.note else []
    facts = dict(reading.facts)
    time, values = _one_publisher(topics, time, reading, source, facts)
    return series.motors(time, values, reading.unit, source, topics.notes), facts


def _mixed(topics: Topics, parameters):
    """Outputs computed from the rate controller's output by a quad's mixer, where the log holds that alone."""
    data = topics.table("actuator_controls_0", *numbered("control", 4))
    values = None if data is None else px4_outputs.mixed(series.stacked(data[1], numbered("control", 4)), parameters)
    if data is None or values is None:
        return None
    topics.notes.append(
        "the log has no motor outputs: they were computed by the quad's mixer from what the rate controller asked for, so that an output "
        "that did not follow the mixer is not seen"
    )
    return series.motors(data[0], values, "1", "actuator_controls_0", topics.notes)


def _one_publisher(topics: Topics, time, reading: px4_outputs.Reading, source, facts):
    """The samples of the publisher whose outputs reached the motors; `facts` holds their number where none can be chosen."""
    values = reading.values
    series_ = px4_outputs.tracks(values, 0.01 * (1000.0 if reading.unit == "us" else 1.0))
    if len(series_) == 1:
        return time, values
    keep = px4_outputs.flown(values, series_)
    sentence = f"{source}: the outputs of two publishers alternate in one instance"
    if keep is None:
        facts["publishers"] = len(series_)
        topics.notes.append(f"{sentence}, and both move")
        return time, values
    topics.notes.append(f"{sentence}; the {keep.size} of {len(values)} samples that move were taken")
    return time[keep], values[keep]


def _control(topics: Topics):
    """Rate controller output: torque and thrust set points (1.13+), else actuator_controls_0."""
    xyz = numbered("xyz", 3)
    torque, thrust = (topics.table(f"vehicle_{k}_setpoint", *xyz) for k in ("torque", "thrust"))
    if torque is not None and thrust is not None and thrust[0].size:
        time, values = torque[0], series.stacked(torque[1], xyz)
        # The latest thrust set point at each torque set point; both are published within the same controller cycle.
        keep = series.steady(thrust[0])
        latest = np.clip(np.searchsorted(thrust[0][keep], time + 1e-3, side="right") - 1, 0, None)
        values = np.column_stack([values, -np.asarray(thrust[1]["xyz[2]"], float)[keep][latest]])
        return series.signal("control", time, values, "vehicle_torque_setpoint", topics.notes)
    return topics.signal("control", "actuator_controls_0", numbered("control", 4))


def _attitude(topics: Topics, kind, name, field):
    data = topics.table(name, *numbered(field, 4))
    if data is None:
        return None
    q, fine = series.unit_quaternion(series.stacked(data[1], numbered(field, 4)))
    return series.signal(kind, data[0], q, name, topics.notes, fine)


def _utc_start(topics: Topics) -> str | None:
    """UTC of second 0, by the GPS."""
    for name in ("vehicle_gps_position", "sensor_gps"):
        data = topics.table(name, "time_utc_usec")
        if data is not None:
            return wall_clock.start(data[0], np.asarray(data[1]["time_utc_usec"], float) * 1e-6)
    return None


def _gps(topics: Topics):
    for name in ("vehicle_gps_position", "sensor_gps"):
        for fields, units in ((("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)), (_GPS_DEGREES, (1.0, 1.0, 1.0))):
            data = topics.table(name, *fields, "vel_m_s", "fix_type")
            if data is not None and data[0].size:
                latitude, longitude, altitude = (series.stacked(data[1], fields) * units).T
                speed, fix = series.stacked(data[1], ("vel_m_s", "fix_type")).T
                degrees = np.column_stack([latitude, longitude])
                return series.gps(data[0], degrees, altitude, speed, fix >= _FIX_3D, name)
    return None


def _battery(topics: Topics):
    data = topics.table("battery_status", "voltage_v", "current_a")
    if data is None:
        return None
    values = series.stacked(data[1], ["voltage_v", "current_a"])
    return series.signal("battery", data[0], values, "battery_status", topics.notes, series.voltage_and_current(values))


def _esc(topics: Topics, parameters):
    data = topics.table("esc_status", "esc[0].esc_rpm")
    return None if data is None else px4_outputs.escs(*data, rotor_count(parameters), topics.notes)


def modes(time, nav_state) -> list[Message]:
    """Messages of the flight modes that were entered."""
    return [Message(t, "mode", NAV_STATES.get(int(v), f"mode {int(v)}"), v) for t, v in series.changes(time, nav_state)]


def custom_mode(number: int) -> str:
    """The name of a flight mode as HEARTBEAT.custom_mode codes it: a main mode, and a sub-mode of those that fly by themselves."""
    main, sub = number >> 16 & 0xFF, number >> 24 & 0xFF
    return (AUTO_MODES.get(sub) if main == _AUTO else MAIN_MODES.get(main)) or f"mode {number}"


def messages(topics: Topics) -> list[Message]:
    """State changes: landed, armed, flight mode; and the autopilot's own reports."""
    out = px4_reports.messages(topics)
    data = topics.table("vehicle_land_detected", "landed", early=True)
    if data is not None:
        out += series.states("landed", data[0], data[1]["landed"])
    status = topics.table("vehicle_status", "arming_state", early=True)
    armed = topics.table("actuator_armed", "armed", early=True)
    if armed is not None:
        out += series.states("armed", armed[0], armed[1]["armed"])
    elif status is not None:
        out += series.states("armed", status[0], np.asarray(status[1]["arming_state"]) == _ARMED)
    if status is not None and "nav_state" in status[1]:
        out += modes(status[0], status[1]["nav_state"])
    return out
