"""Signals that a log lacks, or has too slowly, and the autopilot's settings that log them."""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Sequence

from rotorwatch.answer.wording import listed
from rotorwatch.engine.motion.tick_table import tick_length
from rotorwatch.flight import Flight

# Faster logging than this finds nothing sooner; of vehicles that never hover no short moment.
FAST_HZ, FAST_BLACKBOX_HZ = 50.0, 500.0
# Settings that log a signal; {10} in one is a bit (`_with_values`). ArduPilot: LOG_BITMASK bits of ArduCopter/defines.h
# (MASK_LOG_*); PX4: SDLOG_PROFILE bits of src/modules/logger (logged_topics.cpp). Anything else: the column to add.
_ARDUPILOT = {
    "motors": "Set LOG_BITMASK{10} (motor outputs, RCOU).",
    "control": "Set LOG_BITMASK{0} (attitude and RATE at loop rate; bit 1: at 10 Hz).",
    "gyro": "Set LOG_BITMASK{18} (IMU at loop rate; bit 7: at 25 Hz).",
    "accel": "Set LOG_BITMASK{18} (IMU at loop rate; bit 7: at 25 Hz).",
    "attitude": "Set LOG_BITMASK{0} (attitude at loop rate; bit 1: at 10 Hz).",
    "battery": "Set LOG_BITMASK{9} (battery) and a battery monitor (BATT_MONITOR).",
    "lift": "Set LOG_BITMASK{17} (motor battery compensation, MOTB).",
}
_PX4 = {
    "motors": "Set SDLOG_PROFILE{0} (default set): actuator_motors and actuator_outputs at 10 Hz.",
    "control": "Set SDLOG_PROFILE{0} (default set): vehicle_torque_setpoint and vehicle_thrust_setpoint.",
    "gyro": "Set SDLOG_PROFILE{0} (default set): vehicle_angular_velocity or sensor_combined.",
    "accel": "Set SDLOG_PROFILE{0} (default set): vehicle_acceleration or sensor_combined.",
    "attitude": "Set SDLOG_PROFILE{0} (default set): vehicle_attitude.",
    "battery": "Set SDLOG_PROFILE{0} (default set): battery_status.",
}
_CRAZYFLIE = {"gyro": "Add gyro.x, gyro.y and gyro.z to config.txt on the memory card."}
_BLACKBOX = {
    "gyro": "Log it: set blackbox_disable_gyro = OFF (fields_disabled_mask).",
    "accel": "Switch the accelerometer on (acc_hardware = AUTO) and log it (blackbox_disable_acc = OFF).",
    "attitude": "Betaflight from 2025.12 on and INAV log it where an accelerometer is on (blackbox_disable_attitude = OFF).",
    "battery": "Set vbat as the battery's voltage meter and log it (blackbox_disable_bat = OFF).",
    "control": "Betaflight from 4.0 on logs it, with setpoint[3]: set blackbox_disable_pids and blackbox_disable_setpoint = OFF.",
    "esc": "Betaflight from 4.5 on logs it (eRPM) with bidirectional DShot: set dshot_bidir = ON and motor_poles. INAV: ESC telemetry.",
}
_TELEMETRY = "Telemetry may not carry it; use the log that the autopilot wrote itself (.bin or .ulg)."
_BAG = "Record its topic, and have the autopilot send it (docs/foxglove.md), or use the log that the autopilot wrote itself."
_FASTER = {
    "ardupilot": {
        "motors": "Set LOG_BITMASK{0} (RATE at loop rate): the commands are rebuilt from it.",
        "gyro": "Set LOG_BITMASK{18} (IMU at loop rate).",
    },
    "px4": {
        "motors": "Set SDLOG_PROFILE{4} (high rate): actuator_motors at full rate.",
        "gyro": "Set SDLOG_PROFILE{4} (high rate): vehicle_angular_velocity at full rate.",
    },
    "blackbox": {"gyro": "Set blackbox_sample_rate to 1/4 or more; before Betaflight 4.3: blackbox_p_ratio, blackbox_rate_denom."},
}
_WHY = {
    "motors": "No motor commands: without them no rotor can be assessed.",
    "gyro": "No angular rates: they can only be derived from the attitude, where that is logged.",
    "accel": "No accelerations: thrust cannot be checked, so a loss common to all rotors goes undetected.",
    "control": "No rate controller output: an overridden output cannot be distinguished from a commanded one.",
    "attitude": "No attitude: take-off, landing and flips are found less reliably.",
    "battery": "No battery voltage: battery sag cannot be distinguished from a loss common to all rotors.",
    "lift": "No battery compensation of the autopilot: it is estimated from the voltage.",
    "esc": "No motor speeds: a short desync is less certain, and a slow motor cannot be distinguished from a damaged propeller.",
}
_ONLY = {"lift": "ardupilot", "esc": "blackbox"}
"""Signals that only logs of one autopilot can lack."""


def lacking(flight: Flight, needed: str = "") -> list[dict]:
    """{signal, why, setting, needed, present} of each, as in docs/json.md. A signal counts as there with two valid samples. needed: the
    signal that prevents a diagnosis, besides motors."""
    telemetry = {"MAVLink tlog": _TELEMETRY, "ROS 2 bag": _BAG}.get(flight.format)
    settings = {"ardupilot": _ARDUPILOT, "px4": _PX4, "crazyflie": _CRAZYFLIE, "blackbox": _BLACKBOX}.get(_family(flight), {})
    gaps = []
    for name, why in _WHY.items():
        if _present(flight, name) or (name == "gyro" and _present(flight, "rates")):
            continue
        if _ONLY.get(name, _family(flight)) != _family(flight):
            continue
        setting = telemetry or settings.get(name, f"Log it, or give a table with the signal '{name}'.")
        gaps.append(gap(name, why, setting, name in ("motors", needed)))
    faster = {} if telemetry else _FASTER.get(_family(flight), {})
    for name, setting in faster.items():
        # ArduPilot's motor commands are rebuilt from the rate controller's output where that is logged faster.
        rates = [flight[n].rate_hz for n in ((name, "control") if name == "motors" else (name,)) if _present(flight, n)]
        if not _present(flight, name):
            continue
        if _family(flight) == "blackbox" and max(rates) < 0.99 * FAST_BLACKBOX_HZ:
            gaps.append(gap(name, f"Gyro at {max(rates):.3g} Hz: short events such as desyncs can be missed.", setting, False, True))
        elif max(rates) < FAST_HZ:
            often = f"assessed every {tick_length(max(rates)):g} s; faster logging detects a loss sooner"
            gaps.append(gap(name, f"{name.capitalize()} at {max(rates):.3g} Hz: {often}.", setting, False, True))
    return _with_values(flight, gaps)


def advice(flight: Flight) -> str:
    """A sentence with the settings for the next log; empty where none would add a signal. A bitmask's whole value is given once, for all
    signals; one that is set already adds nothing, and of an unknown autopilot no setting is known."""
    gaps, values = lacking(flight), {}
    for g in gaps:
        if (found := re.search(r"((?:LOG_BITMASK|SDLOG_PROFILE) to (\d+) \(it is (\d+)\))", g["setting"])) and found[2] != found[3]:
            values.setdefault(found[1], []).append(g["signal"] + (" faster" if g["present"] else ""))
    if values:
        return f"For the next log set {listed([f'{value}: it adds {listed(names)}' for value, names in values.items()])}."
    others = [g for g in gaps if "(it is" not in g["setting"] and not g["setting"].startswith("Log it, or")]
    return f"{others[0]['why'].partition(':')[0]}: {others[0]['setting']}" if others else ""


def _with_values(flight: Flight, gaps: Sequence[dict]) -> list[dict]:
    """Gaps with the whole new value of a parameter in place of a {bit}: the logged value with the bits of all gaps, so that following one
    does not undo another. Without the parameter in the log: the value that the bit adds."""

    def filled(setting: str) -> str:
        name = next((one for one in ("LOG_BITMASK", "SDLOG_PROFILE") if f"{one}{{" in setting), "")
        if not name:
            return setting
        bits = [int(bit) for gap in gaps for bit in re.findall(rf"{name}{{(\d+)}}", gap["setting"])]
        now = flight.parameters.get(name, -1.0)
        if not (0.0 <= now < 2.0**31 and now == int(now)):
            return re.sub(r"{(\d+)}", lambda bit: f" bit {bit[1]}, which adds {1 << int(bit[1])} to its value", setting)
        whole = functools.reduce(operator.or_, (1 << bit for bit in bits), int(now))
        return re.sub(r"{(\d+)}", rf" to {whole} (it is {int(now)}): bit \1", setting)

    return [gap | {"setting": filled(gap["setting"])} for gap in gaps]


def gap(signal: str, why: str, setting: str, needed: bool, present: bool = False) -> dict:
    return {"signal": signal, "why": why, "setting": setting, "needed": needed, "present": present}


def _present(flight: Flight, name: str) -> bool:
    valid = flight[name].valid if flight.has(name) else None
    return valid is not None and (bool(flight[name].whole[:2].all()) or int(valid.any(axis=1).sum()) >= 2)


def _family(flight: Flight) -> str:
    autopilot = flight.autopilot.lower()
    if flight.format.startswith("Blackbox"):
        return "blackbox"
    return next((name for name in ("ardupilot", "px4", "crazyflie") if name in autopilot), "")
