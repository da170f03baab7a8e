"""ESC telemetry in MAVLink: the rotor of each message, and its units.

    ESC_STATUS             index, rpm[4] (negative: backwards), voltage[4] V, current[4] A          PX4
    ESC_INFO               index, temperature[4] 0.01 degC (32767: none), count                     PX4, slower
    ESC_TELEMETRY_1_TO_4   rpm[4], voltage[4] 0.01 V, current[4] 0.01 A, temperature[4] degC        ArduPilot, to 29_TO_32

`index` is the number of a message's first ESC, from 0. ArduPilot numbers ESCs as it numbers servo outputs, PX4 as its drivers do, in the
order of the motors. https://mavlink.io/en/messages/common.html#ESC_STATUS,
https://mavlink.io/en/messages/ardupilotmega.html#ESC_TELEMETRY_1_TO_4
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.flight import Signal
from rotorwatch.logs import esc_columns, series

TELEMETRY = tuple(f"ESC_TELEMETRY_{n}_TO_{n + 3}" for n in range(1, 33, 4))
STATUS, INFO = "ESC_STATUS", "ESC_INFO"
NO_TEMPERATURE = 32767


def read(get: Callable, outputs: Sequence[int], notes: list[str]) -> Signal | None:
    """The signal `esc`; None where the log has none of these messages.

    get(message): (time (m,) s, table) or None. outputs: servo output of each rotor, from 1; empty when not known."""
    reports, source = _status(get), STATUS
    if not reports:
        reports, source = _telemetry(get), "ESC_TELEMETRY"
    if not reports:
        return None
    count = len(outputs) or max(reports) + 1
    places = range(count) if source == STATUS else [n - 1 for n in outputs] or range(count)
    if not set(places) & set(reports):
        places = sorted(reports)[:count]
    return esc_columns.together([reports.get(k) for k in places], range(1, len(places) + 1), source, notes)


def _status(get: Callable) -> dict:
    """ESC number, from 0 -> (time, quantity -> values) of ESC_STATUS, with temperatures of the last ESC_INFO."""
    sample = get(STATUS)
    if sample is None:
        return {}
    time, table = sample
    reports = {}
    for first in np.unique(table["index"]).tolist():
        rows = table["index"] == first
        reports |= {first + k: (time[rows], _measured(table[rows], k)) for k in range(4)}
    sample = get(INFO)
    if sample is None:
        return reports
    slow, table = sample
    for number, (time, values) in reports.items():
        rows = np.flatnonzero(table["index"] == number - number % 4)
        if rows.size:
            degrees = table["temperature"][rows, number % 4].astype(float)
            degrees = np.where(degrees == NO_TEMPERATURE, np.nan, 0.01 * degrees)
            last = np.searchsorted(slow[rows], time, side="right") - 1
            values["temperature"] = np.where(last >= 0, degrees[np.maximum(last, 0)], np.nan)
    most = int(median(table["count"])) if table["count"].any() else len(reports)
    return {number: report for number, report in reports.items() if number < most}


def _measured(table, k: int, unit: float = 1.0) -> dict[str, np.ndarray]:
    """Speed, current and voltage of the k-th ESC of a message. unit: of current and voltage [A, V]."""
    measured = {quantity: unit * series.floats(table[quantity][:, k]) for quantity in ("current", "voltage")}
    return {"speed": table["rpm"][:, k] * esc_columns.RPM, **measured}


def _telemetry(get: Callable) -> dict:
    reports: dict[int, tuple[np.ndarray, Mapping[str, np.ndarray]]] = {}
    for block, message in enumerate(TELEMETRY):
        sample = get(message)
        if sample is None:
            continue
        time, table = sample
        order = np.argsort(time, kind="stable")
        for k in range(4):
            degrees = {"temperature": table["temperature"][order, k].astype(float)}
            reports[4 * block + k] = time[order], _measured(table[order], k, 0.01) | degrees
    return reports
