"""A mount or an arm that turned, found in the trim of a whole flight (trim.py): it takes no thrust, and accuses no rotor."""

from __future__ import annotations

import numpy as np

from rotorwatch.answer.trim import AMOUNTS, Explained
from rotorwatch.engine.front.decisions import CLEAR
from rotorwatch.engine.front.losses import WITHIN_95
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import TURNED


def claims(found: Explained | None) -> tuple[Event, ...]:
    """The claim of a flight, if there is one."""
    if found is None or (odds := found.odds(found.turned)) < CLEAR:
        return ()
    weight = np.exp(found.turned - found.turned.max())
    course, of = weight.sum(axis=1), weight.sum(axis=0)
    onset, yaw = found.since(float(course @ found.starts / course.sum())), float(of @ AMOUNTS / of.sum())
    step = np.interp(yaw, AMOUNTS, np.gradient(AMOUNTS))
    half = WITHIN_95 * float(np.sqrt(of @ (AMOUNTS - yaw) ** 2 / of.sum() + (0.5 * step) ** 2))
    side = "right" if yaw > 0.0 else "left"
    reason = (
        f"since {onset:.1f} s the rotors have had to yaw the vehicle to the {side} by {abs(yaw):.1f} times what one rotor's drag does in "
        "hover, and the motion does not show it: more than wind or a load do. No thrust is missing"
    )
    extra = {"yaw": round(yaw, 3), "yaw_interval": [round(yaw - half, 3), round(yaw + half, 3)]}
    detected = float(found.trim.time[-1])
    return (Event(TURNED, (), onset, detected, None, (), (), odds / (1.0 + odds), (), reason, extra, Source.TRIM),)
