"""Losses near the ground: ground effect, uneven when the vehicle leans, and a leg that catches or slides look the same.

A claim that began while the ground carried a part of the vehicle (`engine.motion.ground_contact`), or within NEAR_M of the height of
take-off, is not counted, and no loss ends there. The fall that a failure causes is no landing: it ends in a loss of control. Nor does
the ground explain a loss after which the vehicle spins and flies on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.answer.wording import rotors
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS, OVERRIDE, TURNED
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

# m above the place of take-off: a rotor's diameter or two of most vehicles, and a leg. Ground effect is below 5 % of the thrust from one
# diameter on (Cheeseman and Bennett, ARC R&M 3021), but differs from rotor to rotor where the vehicle leans.
NEAR_M = 0.5
FRESH_S = 2.0  # greatest age of a height
MOVES_M = 0.02  # a height that changes less since before take-off is not measured: links send zeros for unknown values


def explains(flight: Flight, air: Spans, begins: float, announced: float) -> bool:
    """True if what begins and is announced at these times [s] is so near the height of take-off that the ground explains it as well."""
    if not flight.has("position"):
        return False
    start = next((a for a, b in air if a <= begins <= b + FRESH_S), None)
    if start is None or start - 1.0 < flight["motors"].time[0]:  # a log that begins in the air does not show where the ground is
        return False
    position = flight["position"].wholes()
    when = np.array([start - 1.0, begins, announced])
    at = np.searchsorted(position.time, when, side="right") - 1
    if not len(position) or (at < 0).any() or (when - position.time[at] > FRESH_S).any():
        return False
    height = -position.values[:, 2]
    if np.ptp(height[at[0] : at[2] + 1]) < MOVES_M:
        return False
    ground, onset, detected = height[at]
    return bool(max(onset, detected) - ground < NEAR_M)


def warning(claim: Event, why: str) -> str:
    """A sentence on a claim that is not counted."""
    who = rotors(claim.rotors) if claim.rotors else "a motor mount"
    return f"At {claim.onset_s:.1f} s {who} seemed to be at fault {why}, so it is not counted."


def _hear(view: View, claims: Events) -> Events:
    if not view.hovers:
        return claims
    kept = []
    for c in claims:
        if c.kind == LOSS and view.spins_from(c.onset_s):
            kept.append(c)
            continue
        stands = c.kind in (LOSS, OVERRIDE, TURNED) and view.stands(c.onset_s)
        if stands or (c.kind == LOSS and explains(view.flight, view.air, c.onset_s, c.detected_s)):
            where = "while the ground carried a part of the vehicle" if stands else f"within {NEAR_M:g} m of the take-off height"
            view.warnings.append(warning(c, f"{where}: the ground explains that as well"))
        elif c.kind == LOSS and c.end_s is not None and (view.stands(c.end_s) or explains(view.flight, view.air, c.end_s, c.end_s)):
            kept.append(replace(c, end_s=None))
        else:
            kept.append(c)
    return tuple(kept)


WITNESSES = (Witness("near the ground", Stage.REVISION, 20, _hear, needs=("motors",)),)
