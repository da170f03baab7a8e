"""Reasons why a flight could not be assessed, or shows too little, with the numbers, and advice on what would show more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.answer import context
from rotorwatch.answer.wording import listed, seconds
from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.engine.intake.ticks import UPSET_LEVEL
from rotorwatch.engine.motion.air_spans import commands
from rotorwatch.engine.motion.allocation import Spans, within
from rotorwatch.engine.motion.tick_table import GROUND, LEARN, SHORTEST_S, Ticks
from rotorwatch.flight import Flight
from rotorwatch.logs.plausible import NAMED

SHAKEN = G0  # m/s^2: vibration as large as the weight, which masks lift-off, landing and thrust
CARRIED = 0.8  # of the usual command in the air: it carries the vehicle
RUNNING = 0.1  # share of the outputs' range, from which motors run
LOOKS = 2000  # times at which vibration is computed
FEW_S = 30.0  # of assessed flight: below, a longer flight shows more
MOST = 0.5  # of the time in the air
OUTPUTS = "Log the outputs that reach the motors; `rotorwatch info LOG` lists what a log holds and lacks."
LONGER = "Fly for at least a minute, mostly in steady hover."
CALM = "Hover for a minute in calm air, without a swinging or shifting load."


class Unassessed(NamedTuple):
    """why: a clause; advice: a sentence on what would show more."""

    why: str
    advice: str


def silent(what: str) -> Unassessed:
    """For a log with this description of its outputs."""
    return Unassessed(f"the log has {what}", OUTPUTS)


UNKNOWN = Unassessed("hardly any of the log is flight", "Fly for at least 20 s.")
SILENT = silent("no motor outputs")
MOTIONLESS = Unassessed(
    "the log has neither gyro nor attitude at 5 Hz or more, and commands alone do not show rotor thrust",
    "Log the gyro, or at least the attitude; `rotorwatch info LOG` lists what a log holds and lacks.",
)
NEVER = Unassessed(
    "the vehicle never took off",
    "Use a log with at least 20 s of flight; `rotorwatch info LOG` lists when this one was in the air, and what it holds.",
)


def shaken(flight: Flight, air: Spans) -> Unassessed | None:
    """For a flight that was taken as ended while its rotors carried it on, because vibration was as large as its weight; None otherwise."""
    time, level = commands(flight)
    up = within(time, air)
    if not up.any() or (level[~up] > CARRIED * median(level[up])).sum() < up.sum():
        return None
    size = vibration(flight)
    if size < SHAKEN:
        return None
    return Unassessed(
        f"vibration of {size:.0f} m/s2 masks rotor faults",
        "Balance the propellers, check for loose parts, and mount the autopilot on dampers: the assessment needs less than "
        f"{SHAKEN:.0f} m/s2 of vibration.",
    )


def find(
    air: Spans, table: Ticks, assessed_s: float, needed_s: float, hovers: bool, enough_s: float, steps: bool
) -> Unassessed:  # fmt: skip
    """The reason why only assessed_s s of a flight were assessed, or a significant loss could have remained undetected. needed_s: of
    continuous flight, for enough_s assessed; hovers: it is assessed by the balance of hover, not by its angular motion; steps: steps of its
    trim mask a loss."""
    return _shown_little(table, assessed_s, hovers, steps) if assessed_s >= enough_s else _too_little(air, table, needed_s, hovers)


def patchy(air: Spans, table: Ticks, hovers: bool) -> Unassessed:
    """The reason why much of a flight was not assessed, though the rest shows enough."""
    if table.contacts:
        when = [seconds(c.time) for c in table.contacts]
        times = listed(when) if len(when) <= NAMED else f"{when[0]} and {len(when) - 1} times more"
        return Unassessed(f"the trim is learned anew after the contact at {times}, with any damage from it", LONGER)
    return _too_little(air, table, 0.0, hovers)


def vibration(flight: Flight) -> float:
    """Usual size [m/s^2] of the accelerometer's signal above the motion while the motors run; 0 where unknown."""
    time, level = commands(flight)
    running = time[level > RUNNING]
    size = context.vibration(flight, running[:: 1 + len(running) // LOOKS])
    norms = np.zeros(0) if size is None else np.linalg.norm(size, axis=1)
    norms = norms[np.isfinite(norms)]
    return float(median(norms)) if norms.size else 0.0


def _too_little(air: Spans, table: Ticks, needed_s: float, hovers: bool) -> Unassessed:
    flown = max((end - start for start, end in air), default=0.0)
    up = table.mode > GROUND
    if flown < needed_s:
        piece = " without landing" if len(air) > 1 else ""
        return Unassessed(
            f"{needed_s:.0f} s of flight{piece} are needed, {flown:.{0 if flown < needed_s - 1.0 else 1}f} s were flown",
            f"Fly for at least {needed_s:.0f} s{piece}; a minute shows more.",
        )
    if table.contacts and (table.mode == LEARN).sum() * table.dt > MOST * up.sum() * table.dt:
        when = [seconds(c.time) for c in table.contacts]
        times = listed(when) if len(when) <= NAMED else f"{when[0]} and {len(when) - 1} times more"
        return Unassessed(f"it made contact at {times}, and its trim is learned anew after each contact", LONGER)
    if table.upset[up].mean() > MOST:
        tilt = np.degrees(np.arccos(UPSET_LEVEL))
        return Unassessed(f"it tumbled or was tilted by more than {tilt:.0f} degrees most of the time", LONGER)
    if not table.valid[up].any(axis=1).mean() > MOST:
        return Unassessed(
            "motion or command data are missing most of the time",
            "Log gyro and motor outputs all the time; `rotorwatch info LOG` lists what a log holds and lacks.",
        )
    if not hovers:
        return Unassessed("its rotation does not follow its outputs, or is too small to tell", LONGER)
    return Unassessed("too little of it was steady flight", LONGER)


def _shown_little(table: Ticks, assessed_s: float, hovers: bool, steps: bool) -> Unassessed:
    if table.dt > SHORTEST_S:
        return Unassessed(
            f"motor outputs every {table.dt:g} s are too sparse",
            "Log motor outputs and gyro at 10 Hz or more; `rotorwatch info LOG` shows how.",
        )
    if assessed_s < FEW_S:
        return Unassessed(f"{assessed_s:.0f} s of assessed flight are too few", LONGER)
    if not hovers:
        return Unassessed(
            "its angular motion does not resolve smaller losses",
            "Fly a minute in steady hover, or longer; log gyro and motors at 500 Hz or more.",
        )
    if steps:
        return Unassessed("a change of wind or a shifted load would look the same", CALM)
    return Unassessed("the flight was too rough to resolve smaller losses", CALM)
