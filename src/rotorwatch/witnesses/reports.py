"""Reports of the autopilot in flight: failsafes and results of its own checks; measured quantities beyond limits; and a log that ends in
the air.

Each trouble is one claim, at its first report. It implicates no rotor and clears none: it is reported beside the events of the rotors, in
order of time, and where control was lost those before it compete as causes (answer/falls.py). The texts and numbers are those of ArduPilot
(subsystems and codes of ERR, events, texts of MSG), PX4 (its log messages, events and flags), Betaflight and INAV (phases of the failsafe,
reasons of disarming), and MAVLink (texts, health of sensors, state of the system).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rotorwatch.engine.motion.allocation import Spans, within
from rotorwatch.flight import Flight, Message
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import REPORTED, Kind, Weight, Words, register
from rotorwatch.witnesses import battery
from rotorwatch.witnesses.battery import LASTS_S
from rotorwatch.witnesses.witness import Stage, View, Witness, adding

register(
    Kind(
        10, REPORTED, "autopilot report", "what the autopilot itself reported in flight: battery, radio, position, estimator, ...",
        Weight.NOTICE, by_outputs=False, brief="autopilot warning",
        headline=Words("", nameless="At {at} {why}."), watch=Words("{noun} of {who} at {ago}", nameless="{noun} at {ago}: {why}"),
        advice=Words("", nameless="At {at} {why}: find the cause before the next flight."),
    )
)  # fmt: skip
LATE_S = 1.0  # after a flight: the reason for its end is logged a moment later
CRASHED_S = 5.0  # the same, for a check that takes seconds to find the vehicle on its side (ArduPilot's: 2)
SAME_S = 1.0  # reports this close belong together
EVERY_S = 1.0  # on a link, between two looks
WRITES = ("error", "text", "event", "health")

# Limits of each autopilot for its own measure.
# ArduPilot, https://ardupilot.org/copter/docs/common-measuring-vibration.html: vibration "below 30m/s/s" is "normally acceptable"; of
# samples that clip "low numbers (<100) are likely ok".
# PX4: red in Flight Review's plot of vehicle_imu_status.accel_vibration_metric; 1000 samples more are what VehicleIMU.cpp calls
# "clipping, not safe to fly".
VIBRATION = {"ArduPilot": 30.0, "PX4": 9.81}  # m/s^2
CLIPPING = {"ArduPilot": 100.0, "PX4": 1000.0}  # samples in a flight
# https://mavlink.io/en/messages/common.html#ESTIMATOR_STATUS: "greater than 1.0 should be rare under normal operation and indicate that
# a measurement has been rejected by the filter. The user should be notified".
INNOVATIONS = 1.0


class Trouble(NamedTuple):
    """name: in `extra.trouble`. words: a clause that follows "the autopilot". says: pattern of its reports. late_s: time after a flight
    within which a report still belongs to it."""

    name: str
    words: str
    says: re.Pattern[str]
    late_s: float = LATE_S


def _of(name: str, words: str, *says: str, late_s: float = LATE_S) -> Trouble:
    return Trouble(name, words, re.compile("|".join(says), re.IGNORECASE), late_s)


# A report belongs to the first pattern that it matches.
TROUBLES = (
    _of("crash", "detected a crash", r"^crash check: error", r"^crash: disarming", late_s=CRASHED_S),
    _of(
        "stopped", "stopped the motors",
        r"^disarmed: ([\w ]*failsafe|crash protection|runaway take-off|gps rescue|kill switch|lockdown|failure detector|shutdown)",
        r"^disarmed: (termination|avoidance|parachute|fence breach|software error)",
        r"\bdisarmed by (kill-switch|lockdown|failure detector)", r"\bkill-switch engaged", r"^emergency stop of the motors$",
        r"\bflight termination\b",
    ),
    _of(
        "motor", "reported a loss of thrust or a motor fault", r"^thrust loss check: error", r"\bpotential thrust loss",
        r"^failure detector: (motor|esc)", r"\bmotor failure", r"\bmotor \d+ (under|over)current", r"\besc ?\d+ offline",
    ),
    _of(
        "attitude", "reported attitude or height beyond limits", r"^failure detector: (attitude|height|external)", r"\battitude failure",
        r"\battitude limit exceeded",
    ),
    _of(
        "battery", "reported a low battery", r"^battery failsafe: error", r"\b(low|critical|dangerous|emergency) battery",
        r"\bbattery\b(?!.*resolved).*\b(low|critical|dangerous|emergency|failsafe)\b", r"^battery (warning: failed|unhealthy)",
        r"^failure detector: battery",
    ),
    _of(
        "radio", "lost the radio link", r"^radio( failsafe)?: error", r"\b(rc|manual control)( signal)? lost",
        r"^radio (unhealthy|failsafe)(?!.*(cleared|:))", r"^failsafe: (?!over|signal back)",
    ),
    _of("link", "lost the ground station link", r"^ground station failsafe: error", r"\bgcs failsafe(?!.*cleared)"),
    _of(
        "vibration", "reported high vibration", r"^vibration: error", r"^vibration compensation on", r"\bhigh vibration",
        r"\bclipping, not safe to fly", r"\bimbalanced propeller",
    ),
    _of(
        "position", "lost its position estimate", r"^gps: error", r"\bgps glitch(?! cleared)",
        r"\b(global|local) (position|velocity) (lost|invalid)", r"\bnavigation failure", r"^dead reckoning failsafe: error",
        r"^(lost gps|gnss lost|gps unhealthy)", r"\bstopped aiding",
    ),
    _of(
        "estimator", "reported an estimator fault", r"^estimator (check|failsafe|core): error",
        r"\bekf\d? (variance|lane switch|primary changed)", r"\bprimary ekf changed", r"\bekf failsafe(?!.*cleared)",
        r"\bemergency yaw reset", r"^(attitude|angular velocity) invalid", r"^estimate unhealthy",
    ),
    _of("compass", "reported a compass fault", r"^compass: error", r"\bcompass(es)? (error|failure|inconsistent|unhealthy)"),
    _of(
        "imu", "reported an IMU fault", r"^imu failure", r"^sensor failsafe: error", r"^(accelerometer|gyro) unhealthy",
        r"\b(accel|gyro)\w*\b.*\b(failure|inconsistent|timeout)",
    ),
    _of("yaw", "reported a yaw imbalance", r"\byaw imbalance"),
    _of("internal", "reported an internal error", r"^internal: error", r"\binternal error"),
    _of("failsafe", "started a failsafe", r"^failsafe begins", r"\bfailsafe (mode )?activated"),
)  # fmt: skip


def claims(flight: Flight, air: Spans, lost: Sequence[float] = ()) -> tuple[Event, ...]:
    """The reports in the flights `air` ((start, end), ...) s, and quantities beyond limits in them until control was lost (`lost` [s])."""
    reported = _reports(flight.messages, air)
    until = {event.extra["trouble"]: event.onset_s for event in reported}
    held = tuple((start, min([end, *(t for t in lost if start <= t <= end)])) for start, end in air)
    beyond = (e for e in _limits(flight, held) if e.detected_s < until.get(e.extra["trouble"], np.inf))
    return tuple(sorted((*reported, *beyond), key=lambda e: e.onset_s))


def trouble(message: Message) -> Trouble | None:
    """The trouble that a message reports, or None."""
    return next((t for t in TROUBLES if t.says.search(message.text)), None)


def _reports(messages: Iterable[Message], air: Spans) -> list[Event]:
    by_name: dict[str, list[Message]] = {}
    for m in _happened(messages):
        matched = trouble(m)
        if matched is not None and any(start <= m.time <= end + matched.late_s for start, end in air):
            by_name.setdefault(matched.name, []).append(m)
    events, words = [], {t.name: t.words for t in TROUBLES}
    for name, all_ in by_name.items():
        first = all_[0]
        quoted = next((m for m in all_ if m.kind == "text" and m.time < first.time + SAME_S), first)
        again = f", and {len(all_) - 1} more" if len(all_) > 1 else ""
        reason = f'the autopilot {words[name]} ("{quoted.text}"{again})'
        texts = list(dict.fromkeys(m.text for m in (quoted, *all_)))[:5]
        events.append(_event(first.time, first.time, reason, {"trouble": name, "texts": texts}))
    return events


def _happened(messages: Iterable[Message]) -> Iterable[Message]:
    """Messages of an occurrence. Health messages count only on a loss of health: a part that was never healthy is not present."""
    well: dict[str, bool] = {}
    for m in messages:
        if m.kind == "health":
            part = m.text.partition(" ")[0]
            was, well[part] = well.get(part, False), not m.value
            if not (was and m.value):
                continue
        if m.kind in WRITES:
            yield m


def _limits(flight: Flight, air: Spans) -> list[Event]:
    """Quantities beyond a limit, each at its first time."""
    events = (_low_voltage(flight, air), _collapse(flight, air), _vibration(flight, air), _clipping(flight, air))
    return [event for event in (*events, *_innovations(flight, air)) if event is not None]


def _low_voltage(flight: Flight, air: Spans) -> Event | None:
    """The battery's voltage was below the autopilot's own limit in flight, for LASTS_S."""
    set_ = flight.parameters
    limits = {"BATT_LOW_VOLT": 1.0, "BATT_CRT_VOLT": 1.0, "BAT1_V_EMPTY": set_.get("BAT1_N_CELLS", 0.0)}
    name, limit = next(((k, set_[k] * n) for k, n in limits.items() if set_.get(k, 0.0) * n > 0.0), ("", 0.0))
    if not limit or (samples := _aloft(flight, "battery", air)) is None:
        return None
    time, volts = samples[0], samples[1][:, 0]
    low = (volts > 0.0) & (volts < limit)
    since = _lasts(time, low)
    if since is None:
        return None
    least = float(volts[low].min())
    reason = f"the battery had {least:.1f} V under load, below {name} ({limit:.1f} V)"
    extra = {"trouble": "battery", "least_v": round(least, 2), "limit_v": round(limit, 2)}
    return _event(since, since + LASTS_S, reason, extra)


def _collapse(flight: Flight, air: Spans) -> Event | None:
    """The battery's voltage fell by more than its current explains."""
    collapse_ = battery.collapse(flight, air)
    if collapse_ is None:
        return None
    time, least, usual = collapse_
    reason = f"the battery's voltage fell by {usual - least:.1f} V to {least:.1f} V, more than its current explains"
    return _event(time, time, reason, {"trouble": "power", "least_v": round(least, 2), "usual_v": round(usual, 2)})


def _vibration(flight: Flight, air: Spans) -> Event | None:
    samples, limit = _aloft(flight, "vibration", air), VIBRATION.get(flight.autopilot)
    if samples is None or limit is None:
        return None
    time, level = samples[0], samples[1][:, 0]
    since = _lasts(time, level > limit)
    if since is None:
        return None
    most = float(level[level > limit].max())
    reason = f"vibration was up to {most:.0f} m/s², above {limit:.3g} m/s² for {LASTS_S:.0f} s or longer"
    return _event(since, since + LASTS_S, reason, {"trouble": "vibration", "most": round(most, 2), "limit": limit})


def _clipping(flight: Flight, air: Spans) -> Event | None:
    limit = CLIPPING.get(flight.autopilot)
    for span in air if limit is not None else ():
        samples = _aloft(flight, "clipping", (span,))
        if samples is None:
            continue
        counts = np.minimum.accumulate(samples[1][::-1, 0])[::-1]  # counts never fall: a value above a later one is damaged data
        increase = counts - counts[0]
        if increase[-1] > limit:
            at = float(samples[0][int(np.argmax(increase > limit))])
            reason = f"the accelerometer clipped in {increase[-1]:.0f} samples, more than {limit:.0f}"
            return _event(at, at, reason, {"trouble": "clipping", "most": float(increase[-1]), "limit": limit})
    return None


def _innovations(flight: Flight, air: Spans) -> list[Event]:
    """Measurements that the autopilot's estimator rejected."""
    samples = _aloft(flight, "innovations", air)
    events: dict[str, Event] = {}
    for k, column in enumerate(flight["innovations"].columns if samples is not None else ()):
        assert samples is not None
        ratio = samples[1][:, k]
        since = _lasts(samples[0], ratio > INNOVATIONS)
        if since is None:
            continue
        name = "compass" if column == "compass" else "estimator"
        most = float(ratio[ratio > INNOVATIONS].max())
        reason = f"the autopilot's estimator rejected its {column}: the innovation was up to {most:.1f} times its limit"
        event = _event(since, since + LASTS_S, reason, {"trouble": name, "most": round(most, 2), "limit": INNOVATIONS})
        if name not in events or since < events[name].onset_s:
            events[name] = event
    return list(events.values())


def _aloft(flight: Flight, name: str, air: Spans) -> tuple[np.ndarray, np.ndarray] | None:
    """(time (n,) s, values (n, k)) of the samples of a signal in the flights `air` that are known in its first column; None without any."""
    if not air or not flight.has(name):
        return None
    signal = flight[name]
    inside = within(signal.time, air) & signal.valid[:, 0]
    return (signal.time[inside], np.where(signal.valid, signal.values, 0.0)[inside]) if inside.any() else None


def _lasts(time: np.ndarray, over: np.ndarray) -> float | None:
    """Time [s] at which (n,) samples were first `over` for LASTS_S; None where they never were."""
    gap = np.diff(time, prepend=time[:1]) > LASTS_S
    begins = over & (gap | ~np.append(False, over[:-1]))
    since = np.maximum.accumulate(np.where(begins, time, -np.inf))
    lasted = np.flatnonzero(over & (time - since >= LASTS_S))
    return float(since[lasted[0]]) if lasted.size else None


def _event(time: float, certain: float, reason: str, extra: dict) -> Event:
    return Event(REPORTED, (), time, certain, None, (), (), 1.0, (), reason, extra)


def end(flight: Flight, air: Spans) -> tuple[str, ...]:
    """A sentence where the log ends in the air: neither a landing nor disarmed motors follow its last flight."""
    if not air or air[-1][1] < flight.duration - LATE_S:
        return ()
    last = air[-1][1]
    if any(m.kind in ("landed", "armed") and m.time > last - LATE_S for m in flight.messages):
        return ()
    why = "power or logging failed, or logging was stopped"
    return (f"The log ends in the air at {last:.1f} s: {why}. What followed is not in the log.",)


def _claims(view: View) -> tuple[Event, ...]:
    if view.over:
        view.warnings += end(view.flight, view.air)
    return claims(view.flight, view.air, view.lost)


def _due(air: Spans, now: float, looked_s: float) -> bool:
    return now - looked_s >= EVERY_S


WITNESSES = (Witness("autopilot reports", Stage.CLAIMS, 30, adding(_claims), due=_due),)
