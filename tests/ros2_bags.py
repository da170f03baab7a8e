"""Bags of one flight, written by another library (rosbags): as PX4's bridge to ROS 2 publishes it, and as mavros does."""

from dataclasses import fields

import numpy as np
from pyulog import ULog
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

# PX4 1.14: the fields that are filled here, and those around them.
PX4 = {
    "ActuatorMotors": "uint64 timestamp\nuint64 timestamp_sample\nuint16 reversible_flags\nuint8 MOST = 12\nfloat32[12] control # 0..1",
    "VehicleTorqueSetpoint": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[3] xyz",
    "VehicleThrustSetpoint": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[3] xyz",
    "VehicleAngularVelocity": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[3] xyz\nfloat32[3] xyz_derivative",
    "SensorCombined": (
        "uint64 timestamp\nint32 RELATIVE_TIMESTAMP_INVALID = 2147483647\nfloat32[3] gyro_rad\nuint32 gyro_integral_dt\n"
        "int32 accelerometer_timestamp_relative\nfloat32[3] accelerometer_m_s2\nuint32 accelerometer_integral_dt\n"
        "uint8 accelerometer_clipping"
    ),
    "VehicleAttitude": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[4] q\nfloat32[4] delta_q_reset\nuint8 quat_reset_counter",
    "VehicleAttitudeSetpoint": "uint64 timestamp\nfloat32 yaw_sp_move_rate\nfloat32[4] q_d\nfloat32[3] thrust_body",
    "VehicleLocalPosition": (
        "uint64 timestamp\nuint64 timestamp_sample\nbool xy_valid\nbool z_valid\nbool v_xy_valid\nbool v_z_valid\n"
        "float32 x\nfloat32 y\nfloat32 z\nfloat32[2] delta_xy\n"
        "uint8 xy_reset_counter\nfloat32 delta_z\nuint8 z_reset_counter\nfloat32 vx\nfloat32 vy\nfloat32 vz\n"
        "float32 z_deriv\nfloat64 ref_lat"
    ),
    "BatteryStatus": (
        "uint64 timestamp\nbool connected\nfloat32 voltage_v\nfloat32 voltage_filtered_v\nfloat32 current_a\nfloat32 current_filtered_a"
    ),
    "VehicleStatus": (
        "uint64 timestamp\nuint64 armed_time\nuint64 takeoff_time\nuint8 arming_state\nuint8 latest_arming_reason\n"
        "uint8 latest_disarming_reason\nuint64 nav_state_timestamp\nuint8 nav_state_user_intention\nuint8 nav_state\nuint8 hil_state"
    ),
    "VehicleLandDetected": "uint64 timestamp\nbool freefall\nbool ground_contact\nbool maybe_landed\nbool landed\nbool at_rest",
    "EscReport": (
        "uint64 timestamp\nuint32 esc_errorcount\nint32 esc_rpm\nfloat32 esc_voltage\nfloat32 esc_current\nfloat32 esc_temperature\n"
        "uint8 esc_address\nuint8 esc_cmdcount\nuint8 esc_state\nuint8 actuator_function\nuint16 failures\nint8 esc_power"
    ),
    "EscStatus": (
        "uint64 timestamp\nuint16 counter\nuint8 esc_count\nuint8 esc_connectiontype\nuint8 esc_online_flags\nuint8 esc_armed_flags\n"
        "px4_msgs/EscReport[8] esc"
    ),
}
ESC = ("esc_rpm", "esc_voltage", "esc_current", "esc_temperature", "actuator_function")
MAVROS = {
    "RCOut": "std_msgs/Header header\nuint16[] channels",
    "State": "std_msgs/Header header\nbool connected\nbool armed\nbool guided\nbool manual_input\nstring mode\nuint8 system_status",
    "ExtendedState": "uint8 LANDED_STATE_ON_GROUND = 1\nstd_msgs/Header header\nuint8 vtol_state\nuint8 landed_state",
    "VfrHud": "std_msgs/Header header\nfloat32 airspeed\nfloat32 groundspeed\nint16 heading\nfloat32 throttle\nfloat32 altitude",
    "StatusText": "std_msgs/Header header\nuint8 severity\nstring text",
    "ESCTelemetryItem": (
        "std_msgs/Header header\nfloat32 temperature\nfloat32 voltage\nfloat32 current\nfloat32 totalcurrent\nint32 rpm\nuint16 count"
    ),
    "ESCTelemetry": "std_msgs/Header header\nmavros_msgs/ESCTelemetryItem[] esc_telemetry",
    "ParamEvent": "std_msgs/Header header\nstring param_id\nrcl_interfaces/ParameterValue value\nuint16 param_index\nuint16 param_count",
}


def types():
    """A store of types with those of PX4 and mavros."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for package, texts in (("px4_msgs", PX4), ("mavros_msgs", MAVROS)):
        for name, text in texts.items():
            store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
    return store


def blank(store, kind, **values):
    """A message with these fields, the rest 0 or empty."""
    made = {}
    for name, (code, about) in store.fielddefs[kind][1]:
        if name in values:
            made[name] = values[name]
        elif code == 1:  # a single value
            made[name] = "" if about[0] == "string" else 0.0 if about[0].startswith("float") else 0
        elif code == 2:  # a message
            made[name] = blank(store, about)
        elif code == 3:  # an array
            inner, count = about
            made[name] = [blank(store, inner[1])] * count if inner[0] == 2 else np.zeros(count, inner[1][0])
        else:
            inner, _ = about
            made[name] = [] if inner[0] == 2 or inner[1][0] == "string" else np.zeros(0, inner[1][0])
    return store.types[kind](**made)


def write(folder, rows, storage="mcap", definitions=True, store=None):
    """A bag of rows (topic, type, ns, message), in order of time. definitions: SQLite bags before Iron carry none."""
    store = store or types()
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3)
    with writer:
        topics = {}
        for topic, kind, stamp, message in sorted(rows, key=lambda r: r[2]):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], stamp, store.serialize_cdr(message, kind))
    if storage != "mcap" and not definitions:
        import sqlite3
        from contextlib import closing

        with closing(sqlite3.connect(next(folder.glob("*.db3")))) as base:
            base.execute("DROP TABLE message_definitions")
            base.commit()
    return folder


def of_ulog(path, space="", later_ns=1_700_000_000_000_000_000):
    """Rows of a ULog's topics as /fmu/out/.. of PX4's bridge, received `later_ns` after their stamps."""
    store, rows = types(), []
    for dataset in ULog(str(path)).data_list:
        name = "".join(word.capitalize() for word in dataset.name.split("_"))
        kind, data = f"px4_msgs/msg/{name}", dataset.data
        version = "_v1" if dataset.name == "vehicle_status" else ""
        for i in range(len(data["timestamp"])):
            values = {}
            for field in fields(store.types[kind]):
                if field.name in data:
                    values[field.name] = data[field.name][i].item()
                elif f"{field.name}[0]" in data:
                    count = sum(k.startswith(f"{field.name}[") for k in data)
                    values[field.name] = np.array([data[f"{field.name}[{k}]"][i] for k in range(count)], np.float32)
            if name == "EscStatus":
                values["esc"] = [
                    blank(store, "px4_msgs/msg/EscReport", **{
                        f: data[f"esc[{k}].{f}"][i].item() for f in ESC
                    })
                    for k in range(8)
                ]  # fmt: skip
            if name == "BatteryStatus":
                values["voltage_filtered_v"] = values["voltage_v"]
            stamp = int(data["timestamp"][i]) * 1000 + later_ns
            rows.append((f"{space}/fmu/out/{dataset.name}{version}", kind, stamp, blank(store, kind, **values)))
    return rows


def of_flight(flight, space="/mavros", start_ns=1_700_000_000_000_000_000):
    """Rows of a flight as mavros publishes it: world east, north, up, body forward, left, up."""
    store, rows = types(), []
    make = store.types
    vector, point = make["geometry_msgs/msg/Vector3"], make["geometry_msgs/msg/Point"]

    def header(time, frame="base_link"):
        stamp = start_ns + round(time * 1e6) * 1000
        return make["std_msgs/msg/Header"](make["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), frame)

    def add(topic, kind, time, **values):
        stamp = start_ns + round(time * 1e6) * 1000 + 3_000_000
        rows.append((f"{space}/{topic}", kind, stamp, blank(store, kind, header=header(time), **values)))

    def flu(v):
        return vector(float(v[0]), -float(v[1]), -float(v[2]))

    s = flight.signals
    for t, u in zip(s["motors"].time, s["motors"].values):
        channels = np.r_[u, np.zeros(8 - len(u)), np.full(2, 1500)].astype(np.uint16)
        add("rc/out", "mavros_msgs/msg/RCOut", t, channels=channels)
    for i, t in enumerate(s["gyro"].time):
        add(
            *("imu/data_raw", "sensor_msgs/msg/Imu", t),
            angular_velocity=flu(s["gyro"].values[i]),
            linear_acceleration=flu(s["accel"].values[i]),
        )
    for t, q in zip(s["attitude"].time, s["attitude"].values):
        rates = [np.interp(t, s["rates"].time, c) for c in s["rates"].values.T]
        add("imu/data", "sensor_msgs/msg/Imu", t, orientation=_enu(make, q), angular_velocity=flu(rates))
    if "velocity" in s:
        for i, t in enumerate(s["velocity"].time):
            n, e, d = s["velocity"].values[i]
            twist = make["geometry_msgs/msg/Twist"](vector(e, n, -d), vector(0.0, 0.0, 0.0))
            add("local_position/velocity_local", "geometry_msgs/msg/TwistStamped", t, twist=twist)
    if "position" in s:
        for i, t in enumerate(s["position"].time):
            n, e, d = s["position"].values[i]
            pose = make["geometry_msgs/msg/Pose"](point(e, n, -d), _enu(make, np.array([1.0, 0, 0, 0])))
            add("local_position/pose", "geometry_msgs/msg/PoseStamped", t, pose=pose)
    if "battery" in s:
        for t, (volt, ampere) in zip(s["battery"].time, s["battery"].values):
            add("battery", "sensor_msgs/msg/BatteryState", t, voltage=volt, current=-ampere)
    armed, landed, mode = False, 1, "STABILIZE"
    for m in flight.messages:
        if m.kind == "armed":
            armed = m.value > 0.5
        if m.kind in ("armed", "mode"):
            add("state", "mavros_msgs/msg/State", m.time, connected=True, armed=armed, mode=mode)
        if m.kind == "landed":
            landed = 1 if m.value > 0.5 else 2
            add("extended_state", "mavros_msgs/msg/ExtendedState", m.time, landed_state=landed)
        if m.kind in ("text", "error"):
            add("statustext/recv", "mavros_msgs/msg/StatusText", m.time, severity=3 if m.kind == "error" else 6, text=m.text)
    return rows


def _enu(make, q):
    """ROS's quaternion of an attitude FRD -> NED, by matrices: north-east-down is turned into east-north-up, and the body likewise."""
    w, x, y, z = q
    down = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    up = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ down @ np.diag([1, -1, -1])
    from scipy.spatial.transform import Rotation

    return make["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(up).as_quat()))
