"""Rates as the pilot wanted them and as the vehicle turned, of a vehicle that is flown by rates."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.axes import flight_range
from rotorwatch.report.figures import Series, assessed, followed

name, title, order = "rates", "Rates: sticks and gyro", 140
views = ("page",)


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    """None where the trace has no rates."""
    trace = diagnosis.trace
    there = trace is not None and (trace.rates is not None or trace.rates_wanted is not None)
    return assessed(diagnosis) if there else None


def words(data: Diagnosis) -> list[str]:
    return [
        "Blue: measured. Dashed: the pilot's setpoint, after rates and expo. A vehicle with a weak motor lags behind, "
        "or shakes, on the axes of that motor."
    ]


def plot(data: Diagnosis) -> dict[str, Any]:
    """rate_roll, rate_pitch, rate_yaw [degrees/s]."""
    series = Series(data)
    pairs = {"actual": series.trace.rates, "wanted": series.trace.rates_wanted}
    there = {name: values for name, values in pairs.items() if values is not None}
    return followed(series, flight_range(data), "rate", "°/s", there)
