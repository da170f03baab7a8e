"""Parameters, firmware and messages of a DataFlash log."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from rotorwatch.flight import Message
from rotorwatch.logs.dataflash_text import ERRORS, EVENTS, METHODS, MODES

PARAMETER_NAME = re.compile(r"[A-Z][A-Z0-9_]{1,15}")
FIRMWARE = re.compile(r"\b(APM:\w+|APMrover2?|Ardu\w+|Blimp|AntennaTracker)\s+[Vv]\d\S*(\s+\([0-9a-f]+\))?")
OLD_NAMES = {"APM:Copter": "ArduCopter", "APM:Plane": "ArduPlane", "APM:Rover": "ArduRover", "APMrover2": "ArduRover"}
FRAME_TEXT = re.compile(r"^Frame: (\w+)(?:/(\w+))?")
TEXT_COLUMNS = ("Name", "Message", "FWS")
SAME_EVENT_S = 1.0  # an arming logged by ARM and again by EV

ARMED, DISARMED, LANDED, NOT_LANDED = 10, 11, 18, 28  # EV.Id
CORE = 24  # ERR.Subsys whose code is the number of the newly selected EKF core


def parameters(log, clock) -> tuple[dict[str, float], tuple[tuple[float, str, float], ...]]:
    """(first value of each parameter, later changes as (time s, name, value)); none of the simulator's own (SIM_)."""
    first: dict[str, float] = {}
    changes: list[tuple[float, str, float]] = []
    now: dict[str, float] = {}
    for time, name, value in _rows(log, clock, "PARM", "Name", "Value"):
        value = float(value)
        if not math.isfinite(value):
            continue
        if name not in now:
            if not PARAMETER_NAME.fullmatch(name) or name.startswith("SIM_"):
                continue
            first[name] = value
        elif now[name] != value:
            changes.append((time, name, value))
        now[name] = value
    return first, tuple(sorted(changes, key=lambda c: c[0]))


def firmware(log, clock) -> tuple[str, str]:
    """(version text, vehicle type such as 'ArduCopter'), empty where unknown."""
    for kind, column in (("VER", "FWS"), ("MSG", "Message"), ("", "")):
        rows = _rows(log, clock, kind, column) if kind else ((0.0, text) for text in log.preamble)
        for _, text in rows:
            if match := FIRMWARE.search(text):
                return match.group(0), OLD_NAMES.get(match.group(1), match.group(1))
    return "", ""


def frame_text(log, clock) -> tuple[str, str]:
    """The airframe as the autopilot announces it: ('QUAD', 'X'); empty texts where it does not."""
    for _, text in _rows(log, clock, "MSG", "Message"):
        if match := FRAME_TEXT.match(text):
            return match.group(1), match.group(2) or ""
    return "", ""


def messages(log, clock) -> tuple[Message, ...]:
    """Texts, errors, events, modes and arming, in time order.

    'armed' and 'landed' have value 1 or 0; 'mode' and 'event' their number; 'error' that of the reporting subsystem."""
    entries = [Message(t, "text", text) for t, text in _rows(log, clock, "MSG", "Message") if "SIM_" not in text]
    for time, source, code in _rows(log, clock, "ERR", "Subsys", "ECode"):
        if np.isfinite([source, code]).all():
            name = ERRORS.get(int(source), f"part {int(source)}")
            over = code == 0 and source != CORE
            entries.append(Message(time, "error", f"{name}: {'resolved' if over else f'error {int(code)}'}", float(source)))
    number = "ModeNum" if "ModeNum" in log.columns("MODE") else "Mode"
    for time, mode in _rows(log, clock, "MODE", number):
        if np.isfinite(mode):
            entries.append(Message(time, "mode", MODES.get(int(mode), f"mode {int(mode)}"), float(mode)))
    arming = [(time, float(state != 0)) for time, state in _rows(log, clock, "ARM", "ArmState")]
    armings = len(arming)
    for time, state, method in _rows(log, clock, "ARM", "ArmState", "Method"):
        if state == 0 and np.isfinite(method) and int(method) in METHODS:
            entries.append(Message(time, "event", f"disarmed: {METHODS[int(method)]}", float(method)))
    for time, event in _rows(log, clock, "EV", "Id"):
        if not np.isfinite(event):
            continue
        if event in (ARMED, DISARMED):
            state = float(event == ARMED)
            if not any(s == state and abs(t - time) < SAME_EVENT_S for t, s in arming[:armings]):
                arming.append((time, state))
        elif event in (LANDED, NOT_LANDED):
            entries.append(Message(time, "landed", "landed" if event == LANDED else "in the air", float(event == LANDED)))
        else:
            entries.append(Message(time, "event", EVENTS.get(int(event), f"event {int(event)}"), float(event)))
    entries += [Message(t, "armed", "armed" if state else "disarmed", state) for t, state in arming]
    return tuple(sorted(entries, key=lambda m: m.time))


def _rows(log, clock, name, *columns) -> Iterator[tuple[Any, ...]]:
    """(time s, column...) of each record of message `name` with a valid time; texts decoded."""
    table = log.table(name, columns)
    if table is None or any(c not in table for c in columns):
        return
    if any((table[c].dtype.kind == "S") != (c in TEXT_COLUMNS) or table[c].ndim > 1 for c in columns):
        return  # a damaged definition
    values = [_texts(table[c]) if table[c].dtype.kind == "S" else table[c].tolist() for c in columns]
    times, good = (column.tolist() for column in clock.of(table.record))
    for k, time in enumerate(times):
        if good[k]:
            yield (time, *(v[k] for v in values))


def _texts(raw: np.ndarray) -> list[str]:
    return [r.split(b"\0", 1)[0].decode("utf-8", "replace").strip() for r in raw.tolist()]
