"""Definitions of the messages that are read, for bags that do not carry their own: SQLite bags before ROS 2 Iron.

CDR is sequential, so the first fields of a message are enough, up to the last one that is used. Where releases of PX4 differ there,
each form is listed, and the values decide which it is (`fits`): quaternions have length 1, flags are 0 or 1, a sample is not younger
than its message.

https://docs.px4.io/main/en/msg_docs/ (1.13 to 1.18), https://docs.ros.org/en/jazzy/p/mavros_msgs/, sensor_msgs, nav_msgs, geometry_msgs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

_HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_GEOMETRY = """
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
================================================================================
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
================================================================================
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance
"""
_STAMPS = "uint64 timestamp\nuint64 timestamp_sample\n"
_POSITION = """bool xy_valid
bool z_valid
bool v_xy_valid
bool v_z_valid
float32 x
float32 y
float32 z
float32[2] delta_xy
uint8 xy_reset_counter
float32 delta_z
uint8 z_reset_counter
float32 vx
float32 vy
float32 vz
"""

PX4: dict[str, tuple[str, ...]] = {
    "ActuatorArmed": ("uint64 timestamp\nbool armed\n",),
    "ActuatorMotors": (_STAMPS + "uint16 reversible_flags\nfloat32[12] control\n",),
    "ActuatorOutputs": ("uint64 timestamp\nuint32 noutputs\nfloat32[16] output\n",),
    "BatteryStatus": (
        "uint64 timestamp\nbool connected\nfloat32 voltage_v\nfloat32 voltage_filtered_v\nfloat32 current_a\n",
        "uint64 timestamp\nbool connected\nfloat32 voltage_v\nfloat32 current_a\n",
    ),
    "SensorCombined": (
        "uint64 timestamp\nfloat32[3] gyro_rad\nuint32 gyro_integral_dt\nint32 accelerometer_timestamp_relative\n"
        "float32[3] accelerometer_m_s2\n",
    ),
    "VehicleAcceleration": (_STAMPS + "float32[3] xyz\n",),
    "VehicleAngularVelocity": (_STAMPS + "float32[3] xyz\n",),
    "VehicleAttitude": (_STAMPS + "float32[4] q\n", "uint64 timestamp\nfloat32[4] q\n"),
    "VehicleAttitudeSetpoint": (
        "uint64 timestamp\nfloat32 yaw_sp_move_rate\nfloat32[4] q_d\n",
        "uint64 timestamp\nfloat32 roll_body\nfloat32 pitch_body\nfloat32 yaw_body\nfloat32 yaw_sp_move_rate\nfloat32[4] q_d\n",
    ),
    "VehicleLandDetected": (
        "uint64 timestamp\nbool freefall\nbool ground_contact\nbool maybe_landed\nbool landed\n",
        "uint64 timestamp\nfloat32 alt_max\nbool freefall\nbool ground_contact\nbool maybe_landed\nbool landed\n",
    ),
    "VehicleLocalPosition": (_STAMPS + _POSITION, "uint64 timestamp\n" + _POSITION),
    "VehicleStatus": (
        "uint64 timestamp\nuint64 armed_time\nuint64 takeoff_time\nuint8 arming_state\nuint8 latest_arming_reason\n"
        "uint8 latest_disarming_reason\nuint64 nav_state_timestamp\nuint8 nav_state_user_intention\nuint8 nav_state\n",
    ),
    "VehicleThrustSetpoint": (_STAMPS + "float32[3] xyz\n",),
    "VehicleTorqueSetpoint": (_STAMPS + "float32[3] xyz\n",),
}
"""px4_msgs, of PX4 1.13 and later, one or more forms."""

OTHERS: dict[str, str] = {
    "mavros_msgs/msg/RCOut": "std_msgs/Header header\nuint16[] channels\n" + _HEADER,
    "mavros_msgs/msg/State": (
        "std_msgs/Header header\nbool connected\nbool armed\nbool guided\nbool manual_input\nstring mode\nuint8 system_status\n" + _HEADER
    ),
    "mavros_msgs/msg/ExtendedState": "std_msgs/Header header\nuint8 vtol_state\nuint8 landed_state\n" + _HEADER,
    "mavros_msgs/msg/VfrHud": (
        "std_msgs/Header header\nfloat32 airspeed\nfloat32 groundspeed\nint16 heading\nfloat32 throttle\n"
        + _HEADER
    ),
    "mavros_msgs/msg/StatusText": "std_msgs/Header header\nuint8 severity\nstring text\n" + _HEADER,
    "mavros_msgs/msg/AttitudeTarget": (
        "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Quaternion orientation\n" + _HEADER + _GEOMETRY
    ),
    "mavros_msgs/msg/ESCTelemetry": (
        "std_msgs/Header header\nmavros_msgs/ESCTelemetryItem[] esc_telemetry\n" + _HEADER + "=\nMSG: mavros_msgs/ESCTelemetryItem\n"
        "std_msgs/Header header\nfloat32 temperature\nfloat32 voltage\nfloat32 current\nfloat32 totalcurrent\nint32 rpm\nuint16 count\n"
    ),
    "mavros_msgs/msg/ESCStatus": (
        "std_msgs/Header header\nmavros_msgs/ESCStatusItem[] esc_status\n" + _HEADER + "=\nMSG: mavros_msgs/ESCStatusItem\n"
        "std_msgs/Header header\nint32 rpm\nfloat32 voltage\nfloat32 current\n"
    ),
    "mavros_msgs/msg/ParamEvent": (
        "std_msgs/Header header\nstring param_id\nrcl_interfaces/ParameterValue value\n" + _HEADER
        + "=\nMSG: rcl_interfaces/ParameterValue\nuint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\n"
    ),
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        + _HEADER + _GEOMETRY
    ),
    "sensor_msgs/msg/BatteryState": "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature\nfloat32 current\n" + _HEADER,
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist\n" + _HEADER + _GEOMETRY
    ),
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n" + _HEADER + _GEOMETRY,
    "geometry_msgs/msg/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist\n" + _HEADER + _GEOMETRY,
}  # fmt: skip
"""What mavros publishes, by type. ParamEvent ends where its numbers do."""


def forms(kind: str) -> tuple[str, ...]:
    """The definitions that a message of this type may have; none for types that are not read."""
    package, _, name = kind.replace("/msg/", "/").partition("/")
    if package == "px4_msgs":
        return PX4.get(name, ())
    return (OTHERS[kind],) if kind in OTHERS else ()


def fits(kind: str, columns: Mapping[str, np.ndarray]) -> bool:
    """Whether these values can be those of a px4_msgs message of this type; True for all others."""
    if not kind.startswith("px4_msgs/"):
        return True
    if "timestamp_sample" in columns:
        late = columns["timestamp"].astype(np.int64) - columns["timestamp_sample"].astype(np.int64)
        known = columns["timestamp_sample"] > 0
        if not _mostly((late >= -1_000_000) & (late < 10_000_000), known):
            return False
    for name in ("q", "q_d"):
        if f"{name}[0]" in columns:
            q = np.stack([columns[f"{name}[{k}]"] for k in range(4)], axis=1).astype(np.float64)
            with np.errstate(invalid="ignore", over="ignore"):
                return _mostly(np.abs((q * q).sum(axis=1) - 1.0) < 0.05)
    flags = [
        c
        for n, c in columns.items()
        if n.endswith("_valid") or n in ("connected", "landed", "freefall", "maybe_landed", "armed")
    ]
    if not all(_mostly(c <= 1) for c in flags):
        return False
    if "voltage_filtered_v" in columns:  # a filtered voltage is near the voltage, a current is not
        volts, slow = columns["voltage_v"], columns["voltage_filtered_v"]
        with np.errstate(invalid="ignore", over="ignore"):
            return _mostly(np.abs(slow - volts) <= 0.1 * np.abs(volts))
    if "arming_state" in columns:
        return _mostly((columns["arming_state"] <= 6) & (columns["nav_state"] <= 40))
    return True


def _mostly(fine: np.ndarray, among: np.ndarray | None = None) -> bool:
    fine = fine if among is None else fine[among]
    return fine.size == 0 or float(fine.mean()) > 0.9
