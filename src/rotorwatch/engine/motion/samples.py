"""Signals and messages in the definitions' form."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rotorwatch.engine.definition import Part, states
from rotorwatch.flight import Message, Signal
from rotorwatch.flight.vehicle import Vehicle

SIGNALS = ("motors", "control", "gyro", "rates", "accel", "velocity", "attitude", "lift", "battery")


def parts(signals: Mapping[str, Signal], messages: Iterable[Message], vehicle: Vehicle, gyro: str | None, battery: bool) -> list[Part]:
    """The diagnoser's inputs from signals and messages of the autopilot. gyro: the signal with angular rates; battery: its voltage is
    known, now or later; it matters where motors are driven straight from it."""
    full = vehicle.extra.get("full_voltage") if battery else None
    found = [part for name, signal in signals.items() if (part := _numbers(name, signal, full, gyro)) is not None]
    words = list(messages)
    return [*found, states(words)] if words else found


def _numbers(name: str, signal: Signal, full: float | None, gyro: str | None) -> Part | None:
    """Samples of a signal; None where the diagnoser does not use it. full: voltage of a full battery."""
    time, values, valid = signal.time, signal.values, signal.valid
    if name == "battery" and full:
        ok = valid[:, 0] & (values[:, 0] > 0.5 * full)
        return Part("voltage", time[ok], values[ok, :1] / full)
    if name == "lift" and not full and "voltage_ratio" in signal.columns:
        column = signal.columns.index("voltage_ratio")
        ok = valid[:, column] & (values[:, column] > 0.3)
        return Part("voltage", time[ok], values[ok, column, None])
    if name == "control":
        return Part(name, time, values[:, :4], valid[:, :4])
    taken = name in ("motors", "gyro", "accel", "velocity", "attitude") or (name == "rates" and gyro == "rates")
    return Part(name, time, values, valid) if taken else None
