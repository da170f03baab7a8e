"""Contact with an obstacle: a lasting force in the rotor plane, and a lasting torque, that neither air nor a rotor causes.

A knock begins within a tick; an obstacle that a vehicle is flown against, a tether or a hand may take seconds. Air pushes a hovering
vehicle, too, but without a torque of more than two rotors' thrust; a lost rotor causes a smaller torque and no lateral force. Medians over
`LASTS_S` are compared with those of `BEFORE_S` before, at rest over ground.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.engine.motion.tick_table import GROUND, Ticks
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import CONTACT, LOSS, TURNED
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

LEANS_S = 15.0  # before a lasting push is that large, it turns the vehicle as well
LASTS_S, BEFORE_S, LEAST_S = 3.0, 40.0, 10.0  # s: of the force; of the comparison before it, and its least
SIDEWAYS, TORQUE = 0.3 * G0, 2.0  # m/s^2; hover thrusts of one rotor, on any axis
AT_REST = 1.0  # m/s over ground
BEGINS = 0.3  # share of the force that marks its onset


def find(flight: Flight, table: Ticks) -> Event | None:
    """The contact, from the onset of the force to the end of the flight; None where there is none, or speed or force are unknown."""
    if table.side is None or not flight.has("velocity"):
        return None
    velocity = flight["velocity"].wholes()
    if len(velocity) < 2:
        return None
    speed = np.interp(table.time, velocity.time, np.hypot(*velocity.values.T[:2]))
    use = (table.mode > GROUND) & ~table.upset & (speed < AT_REST)
    now, before = max(3, round(LASTS_S / table.dt)), round(BEFORE_S / table.dt)
    for start in range(now, len(use) - now, max(1, now // 3)):
        rows = slice(start, start + now)
        past = np.flatnonzero(use[max(0, start - before) : start - now // 2]) + max(0, start - before)
        if not use[rows].all() or past.size * table.dt < LEAST_S:
            continue
        usual, force = median(table.side[past], axis=0), median(table.side[rows], axis=0)
        torque = np.abs(median(table.wrench[rows, :3], axis=0) - median(table.wrench[past, :3], axis=0)).max()
        pushes = float(np.linalg.norm(force - usual))
        if pushes < SIDEWAYS or torque < TORQUE:
            continue
        grown = np.linalg.norm(table.side[:start] - usual, axis=1) > BEGINS * pushes
        calm = np.flatnonzero(~grown)
        onset = float(table.time[calm[-1] + 1 if calm.size and calm[-1] + 1 < start else start])
        reason = (
            f"an external force has pushed the vehicle sideways with {pushes / G0:.1f} g while it stood still, and turned it by "
            f"{torque:.1f} hover thrusts of one rotor"
        )
        extra = {"size": round(pushes / G0, 3), "unit": "g"}
        return Event(CONTACT, (), onset, float(table.time[start + now - 1]), None, (), (), 1.0, (), reason, extra)
    return None


def _hear(view: View, claims: Events) -> Events:
    """With the contact, and without the losses and turned mounts that it explains."""
    if not view.hovers or view.table is None or (contact := find(view.flight, view.table)) is None:
        return claims
    return (*(c for c in claims if c.kind not in (LOSS, TURNED) or c.onset_s < contact.onset_s - LEANS_S), contact)


WITNESSES = (Witness("leaning", Stage.REVISION, 10, _hear, needs=("velocity",)),)
