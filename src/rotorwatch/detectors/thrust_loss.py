"""ArduPilot Copter's thrust-loss check, re-built from its published description, and the autopilot's own message.

For 1 s without a break: throttle over 0.9 or limited by outputs at their top, throttle over 0.25, sinking, a desired
tilt under 15 deg and attitude under control. The rotor with the highest output (low-passed over 0.5 s) is named.
Desired angles are not among the signals here: the tilt itself is used instead.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from rotorwatch.engine.motion import allocation
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

name = "ardupilot-thrust-loss"
autopilot = "ArduPilot"
MESSAGE = re.compile(r"potential thrust loss \((\d+)\)", re.IGNORECASE)

HIGH_THROTTLE, LOW_THROTTLE = 0.9, 0.25
MAX_TILT = np.radians(15.0)
TRIGGER_S = 1.0
FILTER_S = 0.5
TOP = 0.98  # share of full thrust from which an output counts as being at its limit


def detect(flight: Flight, vehicle: Vehicle, airborne: allocation.Spans) -> tuple[dict[str, Any], ...]:
    """Findings of the check (none where throttle, velocity or attitude are not logged) and the autopilot's messages."""
    findings = [
        {"detector": "autopilot-message", "rotor": int(match.group(1)), "time_s": message.time, "reason": message.text}
        for message in flight.messages
        if (match := MESSAGE.search(message.text))
    ]
    if flight.has("motors", "throttle", "velocity", "attitude"):
        findings += _check(flight, vehicle, airborne)
    return tuple(findings)


def _check(flight: Flight, vehicle: Vehicle, airborne: allocation.Spans) -> list[dict[str, Any]]:
    """The conditions at each throttle sample; one finding for each second in which they all hold."""
    time = flight["throttle"].time
    throttle = flight["throttle"].values[:, 0]
    outputs = allocation.motor_thrusts(flight, vehicle)
    thrust = allocation.hold(outputs.time, outputs.values, time)
    velocity, attitude = flight["velocity"], flight["attitude"]
    sinking = allocation.hold(velocity.time, velocity.values[:, 2], time) > 0
    _, x, y, _ = allocation.hold(attitude.time, attitude.values, time).T
    tilt = np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))
    limited = thrust.max(axis=1) > TOP
    holds = ((throttle > HIGH_THROTTLE) | limited) & (throttle > LOW_THROTTLE) & sinking & (tilt < MAX_TILT)
    holds &= allocation.within(time, airborne)
    if not holds.any():
        return []
    findings, since, smooth = [], None, thrust[0].copy()
    for k in range(len(time)):
        step = time[k] - time[max(k - 1, 0)]
        smooth += step / (FILTER_S + step) * (thrust[k] - smooth)
        if not holds[k]:
            since = None
            continue
        since = time[k] if since is None else since
        if time[k] - since >= TRIGGER_S:
            rotor, since = int(np.argmax(smooth)) + 1, np.inf  # once for each spell
            reason = f"sinking for 1 s at throttle {throttle[k]:.2f} with output {rotor} highest"
            findings.append({"detector": name, "rotor": rotor, "time_s": float(time[k]), "reason": reason})
    return findings
