"""PX4's reports in its topics: failsafe flags, failure detector, battery warnings, reasons of disarming; and quantities for its limits. The
texts of `Message`s are ours; `witnesses/reports.py` interprets them.

Flags count where they rise: one that is up when the log begins shows no event in flight.
"""

from __future__ import annotations

import contextlib
import json
import lzma
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from rotorwatch.flight import Message, Signal
from rotorwatch.logs import series

if TYPE_CHECKING:
    from rotorwatch.logs.px4_topics import Topics

TOPICS = ("failsafe_flags", "failure_detector_status", "vehicle_imu_status", "estimator_status")
EVENTS = "event"  # decoded by the log's own definitions
FLAGS = {
    **{f"{what}_invalid": f"{what.replace('_', ' ')} invalid" for what in ("angular_velocity", "attitude")},
    **{f"{what}_invalid": f"{what.replace('_', ' ')} invalid" for what in ("local_position", "local_velocity", "global_position")},
    "manual_control_signal_lost": "manual control lost", "battery_unhealthy": "battery unhealthy", "gnss_lost": "GNSS lost",
    "fd_critical_failure": "failure detector: attitude", "fd_alt_loss": "failure detector: height lost",
    "fd_motor_failure": "failure detector: motor", "fd_esc_arming_failure": "failure detector: ESC not armed",
    "fd_imbalanced_prop": "failure detector: imbalanced propeller",
}  # fmt: skip
"""Of failsafe_flags (1.14 on)."""
DETECTED = {
    "fd_roll": "attitude (roll)", "fd_pitch": "attitude (pitch)", "fd_alt": "height lost", "fd_ext": "external",
    "fd_arm_escs": "ESC not armed", "fd_battery": "battery", "fd_imbalanced_prop": "imbalanced propeller", "fd_motor": "motor",
}  # fmt: skip
"""Of failure_detector_status; vehicle_status.failure_detector_status has a bit for each, in this order (1.10 on)."""
WARNINGS = {1: "low", 2: "critical", 3: "emergency", 4: "failed"}
"""battery_status.warning."""
DISARMED = {9: "kill switch", 10: "lockdown", 11: "failure detector", 12: "shutdown"}
"""vehicle_status.latest_disarming_reason (1.12 on), of those that are no landing and no pilot's wish."""
WARNS, FAILS = 4, 3  # levels of events: at most a warning, at most an error
LONGEST = 1 << 24  # bytes of the definitions of events; PX4's have 400,000


def messages(topics: Topics) -> list[Message]:
    """Reports of all topics, in any order of time."""
    return [Message(time, kind, text, value) for time, kind, text, value in _reports(topics)]


def _reports(topics: Topics) -> Iterator[tuple[float, str, str, float]]:
    def rises(name: str, field: str) -> list[tuple[float, float]]:
        sample = topics.table(name, field)
        return [] if sample is None else series.rises(sample[0], sample[1][field])

    for field, text in FLAGS.items():
        for time, value in rises("failsafe_flags", field):
            yield time, "error", text, value
    for field, text in DETECTED.items():
        for time, value in rises("failure_detector_status", field):
            yield time, "error", f"failure detector: {text}", value
    status = topics.table("vehicle_status", "failure_detector_status")
    if status is not None and topics.table("failure_detector_status") is None:
        bits = np.asarray(status[1]["failure_detector_status"]).astype(np.int64)
        for k, text in enumerate(DETECTED.values()):
            for time, value in series.rises(status[0], bits >> k & 1):
                yield time, "error", f"failure detector: {text}", value
    for time, value in rises("vehicle_status", "rc_signal_lost"):
        yield time, "error", "manual control lost", value
    for time, value in rises("vehicle_status", "failsafe"):
        yield time, "event", "failsafe begins", value
    sample = topics.table("battery_status", "warning")
    for time, value in series.changes(sample[0], sample[1]["warning"])[1:] if sample is not None else ():
        if int(value) in WARNINGS:
            yield time, "error", f"battery warning: {WARNINGS[int(value)]}", value
    sample = topics.table("vehicle_status", "latest_disarming_reason", "arming_state")
    if sample is not None:
        armed = np.asarray(sample[1]["arming_state"]) == 2
        for k in np.flatnonzero(armed[:-1] & ~armed[1:]) + 1:
            reason = int(sample[1]["latest_disarming_reason"][k])
            if reason in DISARMED:
                yield float(sample[0][k]), "event", f"disarmed: {DISARMED[reason]}", float(reason)


def limited(topics: Topics) -> dict[str, Signal | None]:
    """The signals that are compared with the autopilot's limits: of the first IMU and the first estimator."""
    axes = [f"accel_clipping[{k}]" for k in range(3)]
    signals: dict[str, Signal | None] = {}
    imu = topics.table("vehicle_imu_status", "accel_vibration_metric", *axes)
    if imu is not None and imu[0].size:
        time, table = imu
        level, counts = series.stacked(table, ["accel_vibration_metric"]), series.stacked(table, axes)
        signals["vibration"] = series.signal("vibration", time, level, "vehicle_imu_status", [])
        signals["clipping"] = series.signal("clipping", time, counts.sum(axis=1), "vehicle_imu_status", [])
    ratios = topics.table("estimator_status", "vel_test_ratio", "pos_test_ratio", "hgt_test_ratio")
    if ratios is not None and ratios[0].size:
        time, table = ratios
        heading = "hdg_test_ratio" if "hdg_test_ratio" in table else "mag_test_ratio"
        values = series.stacked(table, ["vel_test_ratio", "pos_test_ratio", "hgt_test_ratio", heading])
        signals["innovations"] = series.signal("innovations", time, values, "estimator_status", [])
    return signals


def events(log: Any, start_us: int) -> list[Message]:
    """Warnings and errors of the topic `event` of a pyulog ULog, decoded by the definitions in the log; none without them."""
    with contextlib.suppress(Exception):  # definitions may be damaged; an old pyulog has no parser
        from pyulog.libevents_parse.parser import Parser

        packed = b"".join(log.msg_info_multiple_dict["metadata_events"][0])
        text = lzma.LZMADecompressor().decompress(packed, LONGEST)
        parser = Parser()
        parser.load_definitions(json.loads(text))
        parser.set_profile("normal")
        table = log.get_dataset(EVENTS).data
        arguments = [table[f"arguments[{k}]"] for k in range(sum(name.startswith("arguments[") for name in table))]
        out = []
        for k, number in enumerate(table["id"]):
            level = int(table["log_levels"][k]) >> 4
            event = parser.parse(int(number), bytes(int(a[k]) for a in arguments)) if level <= WARNS else None
            if event is not None and event.group() == "default":
                time = max(0.0, (int(table["timestamp"][k]) - start_us) * 1e-6)
                out.append(Message(time, "error" if level <= FAILS else "text", " ".join(event.message().split())))
        return out
    return []
