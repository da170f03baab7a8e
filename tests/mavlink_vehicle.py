"""A vehicle that speaks MAVLink as an autopilot does, made of a recorded or simulated flight: for tests of links."""

from __future__ import annotations

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

G = 9.80665
QUAD, HEXA, ARDUPILOT = 2, 13, 3


def messages(flight, seconds=np.inf, boot_s=30.0, kind=QUAD, outputs_hz=25.0, motion_hz=50.0):
    """[(time s, message)] of a flight in time order."""
    out = []

    def say(time, make):
        out.append((float(time), make))

    def ms(t):
        return int((t + boot_s) * 1e3)

    motors, gyro, accel, attitude = (flight[n] for n in ("motors", "gyro", "accel", "attitude"))
    for t, row in thin(motors, outputs_hz):
        pwm = [round(v) for v in row] + [0] * (16 - len(row))
        say(t, lambda t=t, p=pwm: mavlink.MAVLink_servo_output_raw_message(int((t + boot_s) * 1e6) % 2**32, 0, *p))
    for t, row in thin(accel, motion_hz):
        at = gyro.values[np.searchsorted(gyro.time, t, "right") - 1]
        values = [int(v) for v in np.clip(np.round([*row / G * 1e3, *at * 1e3]), -32768, 32767)]
        say(t, lambda t=t, v=values: mavlink.MAVLink_raw_imu_message(int((t + boot_s) * 1e6), *v, 0, 0, 0))
    for t, (w, x, y, z) in thin(attitude, motion_hz):
        at = gyro.values[np.searchsorted(gyro.time, t, "right") - 1]
        angles = (
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        )  # fmt: skip
        say(t, lambda t=t, a=angles, r=at: mavlink.MAVLink_attitude_message(ms(t), *map(float, a), *map(float, r)))
    if "attitude_wanted" in flight.signals:
        for t, q in thin(flight["attitude_wanted"], 5.0):
            say(t, lambda t=t, q=q: mavlink.MAVLink_attitude_target_message(ms(t), 0, list(map(float, q)), 0, 0, 0, 0))
    if "velocity" in flight.signals:
        for t, row in thin(flight["velocity"], 5.0):
            say(t, lambda t=t, v=row: mavlink.MAVLink_local_position_ned_message(ms(t), 0, 0, 0, *map(float, v)))
    for t in np.arange(motors.time[0], motors.time[-1], 1.0):
        say(t, lambda: mavlink.MAVLink_heartbeat_message(kind, ARDUPILOT, 0x80, 0, 4, 3))
    out.sort(key=lambda pair: pair[0])
    return [(time, make()) for time, make in out if time <= seconds]


def thin(signal, rate_hz):
    """Samples of a signal, at most so many a second."""
    step = max(1, round(signal.rate_hz / rate_hz))
    return list(zip(signal.time[::step].tolist(), signal.values[::step]))


class Autopilot:
    """Answers what a watcher asks: parameters, some of which are lost, rates and who it is. asked: what was asked of it."""

    def __init__(self, parameters, system=1, lose=0.0, seed=0, intervals=True, second=True):
        self._pack = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._parse = mavlink.MAVLink(None)
        self._values, self._lose, self._rng = sorted(parameters.items()), lose, np.random.default_rng(seed)
        self._intervals, self._second = intervals, second
        self.asked = []

    def answer(self, data: bytes) -> bytes:
        """What it says to these bytes."""
        out = []
        for message in self._parse.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "HEARTBEAT":
                continue
            self.asked.append(message)
            if kind == "PARAM_REQUEST_LIST":
                out += [self._value(k) for k in range(len(self._values)) if self._rng.random() >= self._lose]
            elif kind == "PARAM_REQUEST_READ" and self._rng.random() >= self._lose:
                out.append(self._value(message.param_index))
            elif kind == "COMMAND_LONG" and message.command == 512:
                out.append(mavlink.MAVLink_autopilot_version_message(0, 0x04050700, 0, 0, 0, bytes(8), bytes(8), bytes(8), 1, 2, 77))
            elif kind == "COMMAND_LONG" and message.command == 510:
                out.append(mavlink.MAVLink_message_interval_message(int(message.param1), 250000))
            elif kind == "COMMAND_LONG":
                out.append(mavlink.MAVLink_command_ack_message(message.command, 0 if self._intervals else 3))
        return b"".join(self.packed(m) for m in out)

    def _value(self, k):
        name, value = self._values[k]
        return mavlink.MAVLink_param_value_message(name.encode(), float(value), 9, len(self._values), k)

    def packed(self, message) -> bytes:
        """A frame, MAVLink 2 or 1, with the next running number."""
        data = message.pack(self._pack, force_mavlink1=not self._second)
        self._pack.seq = (self._pack.seq + 1) % 256
        return data
