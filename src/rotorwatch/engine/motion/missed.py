"""Outputs that a log has missed: all of them repeat for a while, though other outputs must have flown the vehicle.

A late logger, or a bridge between two of them, repeats the last outputs. The repeated values did not fly, so they are marked as unknown,
like a gap. Outputs that stand still for longer, or through much of a flight, are no logging slip: `trust` tests these.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import Spans, within
from rotorwatch.flight import Flight
from rotorwatch.logs.plausible import NAMED

LEAST_S, MOST_S = 0.3, 5.0  # how long outputs repeat
LEAST = 3  # samples that repeat
RARE = 0.2  # share of a flight's outputs beyond which repetition is normal in this log
ENOUGH = 64  # outputs needed to learn how they follow the rate controller
STEPS, SIGMAS = 2.0, 6.0  # steps of the outputs' resolution, and usual deviations, by which they would have changed
ROTORS, AT_LIMIT = 2, 0.02  # at least so many of them; share of their range in the air at its ends
LIVELY, CHANCE = 0.5, 1e-3  # share of the flight's usual rotation, and the accepted chance probability of such a run


def without_missed(flight: Flight, air: Spans) -> Flight:
    """The flight with outputs that the log missed in the air marked invalid, and a warning."""
    if not flight.has("motors"):
        return flight
    motors = flight["motors"]
    inside = within(motors.time, air) & motors.whole
    again = np.zeros(len(motors), bool)
    again[1:] = (motors.values[1:] == motors.values[:-1]).all(axis=1) & inside[1:] & inside[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], again, [False]]).astype(np.int8)))
    runs = [(a - 1, b) for a, b in edges.reshape(-1, 2) if b - a >= LEAST]  # from the repeated sample on
    runs = [(a, b) for a, b in runs if LEAST_S <= motors.time[b - 1] - motors.time[a] < MOST_S]
    if not runs or (inside & ~again).sum() < ENOUGH:
        return flight
    low, high = motors.values[inside].min(), motors.values[inside].max()
    away = AT_LIMIT * (high - low)  # at idle, or at its limits, an output may rest
    held = motors.values[[a for a, _ in runs]]
    some = ((held > low + away) & (held < high - away)).sum(axis=1) >= ROTORS
    runs = [run for run, moves in zip(runs, some) if moves]
    runs = (_unlike_wanted if flight.has("control") else _unlike_motion)(flight, inside, again, runs)
    valid = motors.valid.copy()
    for a, b in runs:
        valid[a + 1 : b] = False
    if not runs or sum(b - a for a, b in runs) > RARE * inside.sum():
        return flight
    when = ", ".join(f"from {motors.time[a]:.1f} to {motors.time[b - 1]:.1f} s" for a, b in runs[:NAMED])
    warning = (
        f"motors ({motors.source}): all outputs repeat {when}{' and later' if len(runs) > NAMED else ''}, while the vehicle is flown "
        "by others that the log missed: the repeats are not used."
    )
    signals = {**flight.signals, "motors": replace(motors, valid=valid)}
    return replace(flight, signals=signals, warnings=(*flight.warnings, warning))


def _unlike_wanted(flight: Flight, inside: np.ndarray, again: np.ndarray, runs: list) -> list:
    """The runs [(begin, end), ...] in which the rate controller demands other outputs.

    The demand is a linear function of its output (and its throttle squared), fitted to the rest of the flight.
    """
    motors, control, moving = flight["motors"], flight["control"].wholes(), inside & ~again
    if len(control) < ENOUGH:
        return []
    asked = [np.interp(motors.time, control.time, column) for column in control.values.T]
    asked = np.column_stack([*asked, asked[3] ** 2, np.ones(len(motors))])
    wanted = asked @ np.linalg.lstsq(asked[moving], motors.values[moving], rcond=1e-9)[0]
    usual = 1.48 * median(np.abs(motors.values - wanted)[moving], axis=0)
    steps = np.abs(np.diff(motors.values[inside], axis=0))
    least = STEPS * steps[steps > 0.0].min() + SIGMAS * usual
    return [(a, b) for a, b in runs if (np.ptp(wanted[a:b], axis=0) > least).sum() >= ROTORS]


def _unlike_motion(flight: Flight, inside: np.ndarray, again: np.ndarray, runs: list) -> list:
    """The same where the log has no output of the rate controller: the vehicle turns about as much as elsewhere, where outputs do not
    rest for so long."""
    if not flight.has("gyro"):
        return []
    time, gyro = flight["motors"].time, flight["gyro"]
    fine, count, rests = gyro.whole, int(inside.sum()), int(again.sum())

    def restless(begin, end) -> float:
        here = gyro.values[fine & (gyro.time >= begin) & (gyro.time <= end)]
        return float(here.std(axis=0).max()) if len(here) > LEAST else 0.0

    usual = restless(*time[inside][[0, -1]])
    chance = [count * ((rests - (b - a) + 2) / count) ** (b - a - 1) for a, b in runs]  # of such a run
    lively = [restless(time[a], time[b - 1]) > LIVELY * usual for a, b in runs]
    return [run for run, low, moved in zip(runs, chance, lively) if low < CHANCE and moved]
