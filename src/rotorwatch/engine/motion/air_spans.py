"""Flights of a whole log, by the definition in engine/intake/airborne.py.

Strictly causal, so that a log cut at t gives the same intervals cut at t. Two exceptions, both about ends: an interval ends where the
landing or the fall began to show, up to `CONFIRM_S` before it was certain; and an interval in progress ends with the log.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.engine.definition import ENGINE, Part, craft, pieces, states
from rotorwatch.engine.events import calls
from rotorwatch.engine.intake import airborne as definition
from rotorwatch.engine.intake.airborne import CONFIRM_S, GAP_S, MOST_GAP_S, TICK_S
from rotorwatch.engine.motion.allocation import output_range
from rotorwatch.flight import Flight

__all__ = ["CONFIRM_S", "GAP_S", "MOST_GAP_S", "TICK_S", "Gap", "airborne", "commands", "gaps", "output_range"]

BATCH = 16384  # samples in one call: fewer flights than sizes.FLIGHTS fit in


def airborne(flight: Flight) -> tuple[tuple[float, float], ...]:
    """Intervals (start s, end s) in the air, in time order; empty without motor commands.

    flight: needs `motors`; landings, velocity and position are used where the log has them. A flight whose end is not in the log ends
    with the last motor command. Starts are when lift-off is certain, late rather than early (a few tenths of a second); ends are where
    the landing or crash began to show.
    """
    if not flight.has("motors") or np.count_nonzero(np.asarray(flight["motors"].valid).any(axis=1)) < 2:
        return ()
    low, high = output_range(flight)
    vehicle = craft(flight.rotor_count, output_low=low, output_high=max(high, low + 1e-6))
    parts = [Part.of(flight, "motors"), states(flight.messages)]
    parts += [Part.of(flight, name) for name in ("gyro", "accel", "velocity") if flight.has(name)]
    follow = ENGINE.new(definition.Airborne)
    found: list[tuple[float, float]] = []
    for samples in pieces(parts):
        for first in range(0, len(samples), BATCH):
            now = samples.part(first, first + BATCH)
            ENGINE.call(calls.fly, follow, vehicle, len(now), now.kind, now.time, now.at, now.values)
            found += _ended(follow)
    ENGINE.call(calls.wait, follow, max(flight.duration, float(flight["motors"].time[-1])))
    found += _ended(follow)
    start, last = float(follow["start"][0]), float(follow["last"][0])
    return tuple((a, min(b, last)) for a, b in [*found, *([(start, last)] if start < last else [])])


def _ended(follow) -> list[tuple[float, float]]:
    """Flights that have ended since the last call."""
    count = int(follow["ended"][0])
    if not count:
        return []
    flights = follow.part("flights")
    spans = list(zip(flights["start"].reshape(-1)[:count].tolist(), flights["end"].reshape(-1)[:count].tolist()))
    last = float(follow["last"][0])
    follow.set(ended=0)
    return [(start, min(end, last)) for start, end in spans]


class Gap(NamedTuple):
    """Commands that a log lacks in the air. rotors: 1-based; start, end: from the last command of these before it, or from lift-off, to
    the first after it, or to the end of the flight [s]; first: none before it in this flight; lasts: none after it."""

    rotors: tuple[int, ...]
    start: float
    end: float
    first: bool = False
    lasts: bool = False


def gaps(flight: Flight, air) -> tuple[Gap, ...]:
    """Gaps of more than `GAP_S` in the commands of one or more rotors within an interval in the air, in time order.

    A flight ends with its last command; where no landing shows by then, the log's motion continues, and nothing indicates ground contact,
    a gap of all rotors follows.
    """
    motors, found = flight["motors"], dict[tuple[float, float, bool, bool], list[int]]()
    for start, end in air:
        for k in range(motors.values.shape[1]):
            known = motors.time[motors.valid[:, k]]
            edges = np.concatenate([[start], known[(known >= start) & (known <= end)], [end]])
            for i in np.flatnonzero(np.diff(edges) > GAP_S):
                key = float(edges[i]), float(edges[i + 1]), bool(i == 0), bool(i + 2 == edges.size)
                found.setdefault(key, []).append(k + 1)
    every = tuple(range(1, motors.values.shape[1] + 1))
    last = float(motors.time[motors.valid.any(axis=1)][-1]) if air else np.inf
    moved = max((float(s.time[-1]) for name in ("gyro", "accel") if (s := flight.signals.get(name)) and len(s)), default=0.0)
    grounded = any(m.time > last - CONFIRM_S and m.kind == kind and (m.value > 0.5) == down
                   for m in flight.messages for kind, down in (("landed", True), ("armed", False)) if m.time <= last + GAP_S)  # fmt: skip
    open_ended = [(last, moved, False, True)] if air and air[-1][1] >= last and moved > last + GAP_S and not grounded else []
    return tuple(
        Gap(rotors, *span) for span, rotors in sorted([*((k, tuple(v)) for k, v in found.items()), *((s, every) for s in open_ended)])
    )


def commands(flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s with known motor commands, and the root mean square of the commands as shares of their range (n,)."""
    motors, (low, high) = flight["motors"], output_range(flight)
    valid = np.asarray(motors.valid)
    share = np.where(valid, np.clip((motors.values - low) / max(high - low, 1e-6), 0.0, 1.0), 0.0)
    level = np.sqrt((share**2).sum(axis=1) / np.maximum(valid.sum(axis=1), 1))
    some = valid.any(axis=1)
    return motors.time[some], level[some]
