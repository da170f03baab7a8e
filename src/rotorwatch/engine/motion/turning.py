"""Angular rates of a log that has no gyro: the attitude's change from one sample to the next.

omega = 2 log(q_k^* q_{k+1}) / (t_{k+1} - t_k), at the middle of the two times, body FRD
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.flight import Flight, Signal

SLOWEST_HZ = 5.0  # of an attitude whose change is worth a rate
MADE = ", differentiated"  # behind the source of such rates
LONGEST_S = 0.5  # between two samples
NOTE = "the log has no gyro: angular rates are differentiated from the attitude ({source}, {rate:.0f} Hz)"


def with_rates(flight: Flight) -> tuple[Flight, str]:
    """The flight with a signal `rates` made of its attitude where it has neither gyro nor rates, and a sentence on that; the flight itself
    and "" where it needs none or the attitude is too slow."""
    if flight.angular_rate() is not None or not flight.has("attitude"):
        return flight, ""
    attitude = flight["attitude"].wholes()
    time, q = attitude.time, attitude.values
    keep = np.concatenate([[True], np.diff(time) > 0.0]) if len(time) else np.zeros(0, bool)
    time, q = time[keep], q[keep]
    if len(time) < 2 or attitude.rate_hz < SLOWEST_HZ:
        return flight, ""
    length = np.diff(time)
    source, middle = attitude.source or "attitude", 0.5 * (time[1:] + time[:-1])
    values, columns = between(q[:-1], q[1:]) / length[:, None], ("x", "y", "z")
    rates = Signal(middle, values, columns, "rad/s", "FRD", f"{source}{MADE}", valid=length < LONGEST_S)
    note = NOTE.format(source=source, rate=attitude.rate_hz)
    return replace(flight, signals={**flight.signals, "rates": rates}), note


def between(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Rotation vectors (m, 3) rad, body, that lead from attitudes p (m, 4) to attitudes q (m, 4), quaternions body to world."""
    a, b, c, d = (p * [1.0, -1.0, -1.0, -1.0]).T
    w, x, y, z = q.T
    turned = np.stack(
        [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w], axis=1
    )
    turned *= np.where(turned[:, :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(turned[:, 1:], axis=1, keepdims=True)
    return turned[:, 1:] / np.maximum(sine, 1e-12) * 2.0 * np.arctan2(sine, turned[:, :1])
