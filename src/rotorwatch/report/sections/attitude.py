"""Attitude as the controller wanted it and as flown."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.flight.diagnosis import Diagnosis, Trace
from rotorwatch.report.axes import flight_range
from rotorwatch.report.figures import Series, assessed, followed

name, title, order = "attitude", "Attitude: setpoint and actual", 150
views = ("page",)


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    """None where the trace has no attitude."""
    trace = diagnosis.trace
    there = trace is not None and (trace.attitude is not None or trace.wanted is not None)
    return assessed(diagnosis) if there else None


def words(data: Diagnosis) -> list[str]:
    return ["Blue: actual. Dashed: the controller's setpoint. A vehicle at its limit no longer follows it."]


def plot(data: Diagnosis) -> dict[str, Any]:
    """angle_roll, angle_pitch, angle_yaw [degrees]."""
    series = Series(data)
    return followed(series, flight_range(data), "angle", "°", _attitudes(series.trace))


def _attitudes(trace: Trace) -> dict[str, np.ndarray]:
    """Roll, pitch and yaw (T, 3) [degrees], actual and wanted, unwrapped: beyond 180 they go on instead of jumping back."""
    out: dict[str, np.ndarray] = {}
    if trace.attitude is not None:
        out["actual"] = _unwrapped(trace.attitude)
    if trace.wanted is not None:
        flown = out.get("actual")
        near = 0.0 if flown is None else 360.0 * np.round(np.nan_to_num((flown - trace.wanted) / 360.0))
        out["wanted"] = _unwrapped(trace.wanted) if flown is None else trace.wanted + near
    return out


def _unwrapped(degrees: np.ndarray) -> np.ndarray:
    out = degrees.copy()
    for column in out.T:
        fine = np.isfinite(column)
        column[fine] = np.unwrap(column[fine], period=360.0)
    return out
