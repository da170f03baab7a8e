"""When a flight was in the air: the definition of front/airborne.py over a whole log.

Strictly causal, so that a log cut at t gives the same intervals cut at t. Two exceptions, both about ends: an interval's end is put where
the landing or the fall began to show, up to `CONFIRM_S` before it was certain; and an interval that still lasts ends with the log.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.flight import Flight
from rotorwatch.front import airborne as definition
from rotorwatch.front import whole
from rotorwatch.front.airborne import CONFIRM_S, GAP_S, MOST_GAP_S, TICK_S
from rotorwatch.front.definition import FRONT, craft, known, merged, states
from rotorwatch.motion.allocation import output_range

__all__ = ["CONFIRM_S", "GAP_S", "MOST_GAP_S", "TICK_S", "airborne", "commands", "gaps", "output_range"]

BATCH = 16384  # samples in one call: fewer flights than sizes.FLIGHTS fit in


def airborne(flight: Flight) -> tuple[tuple[float, float], ...]:
    """Intervals (start s, end s) in the air, in time order; empty without motor commands.

    flight: needs `motors`; landings, velocity and position are used where the log has them.
    A flight that the log does not see end, ends with the last motor command. Starts are when lift-off is certain, late
    rather than early (a few tenths of a second); ends are where the landing or crash began to show.
    """
    if not flight.has("motors") or np.count_nonzero(np.asarray(flight["motors"].valid).any(axis=1)) < 2:
        return ()
    low, high = output_range(flight)
    motors = known(flight, "motors")
    vehicle = craft(motors.shape[1], output_low=low, output_high=max(high, low + 1e-6))
    parts = [("motors", flight["motors"].time, motors), ("state", *states(flight.messages))]
    parts += [(name, flight[name].time, known(flight, name)) for name in ("gyro", "accel") if flight.has(name)]
    if flight.has("velocity"):
        moved = known(flight, "velocity")
        parts.append(
            ("velocity", flight["velocity"].time, np.column_stack([-moved[:, 2], np.hypot(moved[:, 0], moved[:, 1])]))
        )
    samples, follow = merged(parts), FRONT.new(definition.Airborne)
    found: list[tuple[float, float]] = []
    for first in range(0, len(samples), BATCH):
        part = slice(first, first + BATCH)
        now = samples.kind[part], samples.time[part], samples.at[part]
        FRONT.call(whole.fly, follow, vehicle, len(now[0]), *now, samples.values)
        found += _ended(follow)
    FRONT.call(whole.wait, follow, max(flight.duration, float(flight["motors"].time[-1])))
    found += _ended(follow)
    start, last = float(follow["start"][0]), float(follow["last"][0])
    return tuple((a, min(b, last)) for a, b in [*found, *([(start, last)] if start < last else [])])


def _ended(follow) -> list[tuple[float, float]]:
    """Flights that have ended since it was asked last."""
    count = int(follow["ended"][0])
    if not count:
        return []
    flights = follow.part("flights")
    spans = list(zip(flights["start"].reshape(-1)[:count].tolist(), flights["end"].reshape(-1)[:count].tolist()))
    last = float(follow["last"][0])
    follow.set(ended=0)
    return [(start, min(end, last)) for start, end in spans]


def gaps(flight: Flight, air) -> tuple[tuple[float, float], ...]:
    """(start s, end s) of each gap of more than `GAP_S` in the motor commands within an interval in the air."""
    if not air:
        return ()
    time, _ = commands(flight)
    long = np.flatnonzero(np.diff(time) > GAP_S)
    found = [(float(time[k]), float(time[k + 1])) for k in long]
    return tuple((a, b) for a, b in found if any(start <= a and b <= end for start, end in air))


def commands(flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s at which motor commands are known, and the root mean square of the commands as shares of their range (n,)."""
    motors, (low, high) = flight["motors"], output_range(flight)
    valid = np.asarray(motors.valid)
    share = np.where(valid, np.clip((motors.values - low) / max(high - low, 1e-6), 0.0, 1.0), 0.0)
    level = np.sqrt((share**2).sum(axis=1) / np.maximum(valid.sum(axis=1), 1))
    some = valid.any(axis=1)
    return motors.time[some], level[some]
