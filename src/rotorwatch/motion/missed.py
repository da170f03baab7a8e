"""Outputs that a log has missed: all of them repeat for a while, though the rate controller asks for other ones.

A logger that was late, or a bridge between two of them, shows the last outputs again. What repeats is not what flew, so it is marked as not
known, as a gap is. Outputs that stand still for longer, or through much of a flight, are no slip of a log: `trust` judges these.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.flight import Flight
from rotorwatch.motion.allocation import Spans, within

LEAST_S, MOST_S = 0.3, 5.0  # how long outputs repeat
LEAST = 3  # samples that repeat
RARE = 0.2  # share of a flight's outputs beyond which repeating is what the log is like
ENOUGH = 64  # outputs that show how they follow the rate controller
STEPS, SIGMAS = 2.0, 6.0  # steps of the outputs' resolution, and usual deviations, by which they would have changed
ROTORS = 2  # at least so many of them
NAMED = 3  # times that a warning names


def without_missed(flight: Flight, air: Spans) -> Flight:
    """The flight with outputs that the log missed in the air marked invalid, and a warning.

    What the outputs would have been is told by a straight line from the rate controller's output (and its throttle squared), fitted to the
    rest of the flight. Without the rate controller's output nothing is marked: in calm air outputs may rest.
    """
    if not flight.has("motors", "control"):
        return flight
    motors, control = flight["motors"], flight["control"]
    inside = within(motors.time, air) & motors.valid.all(axis=1)
    again = np.zeros(len(motors), bool)
    again[1:] = (motors.values[1:] == motors.values[:-1]).all(axis=1) & inside[1:] & inside[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], again, [False]]).astype(np.int8)))
    runs = [(a - 1, b) for a, b in edges.reshape(-1, 2) if b - a >= LEAST]  # from the sample that is repeated on
    runs = [(a, b) for a, b in runs if LEAST_S <= motors.time[b - 1] - motors.time[a] < MOST_S]
    moving, fine = inside & ~again, control.valid.all(axis=1)
    if not runs or moving.sum() < ENOUGH or fine.sum() < ENOUGH:
        return flight
    asked = [np.interp(motors.time, control.time[fine], column) for column in control.values[fine].T]
    asked = np.column_stack([*asked, asked[3] ** 2, np.ones(len(motors))])
    wanted = asked @ np.linalg.lstsq(asked[moving], motors.values[moving], rcond=1e-9)[0]
    usual = 1.48 * np.median(np.abs(motors.values - wanted)[moving], axis=0)
    steps = np.abs(np.diff(motors.values[inside], axis=0))
    least = STEPS * steps[steps > 0.0].min() + SIGMAS * usual
    runs = [(a, b) for a, b in runs if (np.ptp(wanted[a:b], axis=0) > least).sum() >= ROTORS]
    valid = motors.valid.copy()
    for a, b in runs:
        valid[a + 1 : b] = False
    if not runs or sum(b - a for a, b in runs) > RARE * inside.sum():
        return flight
    when = ", ".join(f"from {motors.time[a]:.1f} to {motors.time[b - 1]:.1f} s" for a, b in runs[:NAMED])
    warning = (
        f"motors ({motors.source}): all outputs repeat {when}{' and later' if len(runs) > NAMED else ''}, while the rate controller asks "
        "for other ones: the log has missed them, and they are not used."
    )
    signals = {**flight.signals, "motors": replace(motors, valid=valid)}
    return replace(flight, signals=signals, warnings=(*flight.warnings, warning))
