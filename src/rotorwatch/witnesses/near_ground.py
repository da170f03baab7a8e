"""Losses near the ground: ground effect, uneven when the vehicle leans, and a leg that catches look the same."""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

# m above the place of take-off: a rotor's diameter or two of most vehicles, and a leg. Ground effect is below 5 % of the thrust from one
# diameter on (Cheeseman and Bennett, ARC R&M 3021), but differs from rotor to rotor where the vehicle leans.
NEAR_M = 0.5
FRESH_S = 2.0  # greatest age of a height
MOVES_M = 0.02  # a height that changes less since before take-off is not measured: links send zeros for unknown values


def explains(flight: Flight, air: Spans, loss: Event) -> bool:
    """True if a loss began and was announced so near the height of take-off that the ground explains it as well."""
    if not flight.has("position"):
        return False
    start = next((a for a, b in air if a <= loss.onset_s <= b + FRESH_S), None)
    if start is None or start - 1.0 < flight["motors"].time[0]:  # a log that begins in the air does not show where the ground is
        return False
    position = flight["position"].wholes()
    when = np.array([start - 1.0, loss.onset_s, loss.detected_s])
    at = np.searchsorted(position.time, when, side="right") - 1
    if not len(position) or (at < 0).any() or (when - position.time[at] > FRESH_S).any():
        return False
    height = -position.values[:, 2]
    if np.ptp(height[at[0] : at[2] + 1]) < MOVES_M:
        return False
    ground, onset, detected = height[at]
    return bool(max(onset, detected) - ground < NEAR_M)


def warning(loss: Event) -> str:
    """A sentence on a loss that is not counted."""
    who = f"rotor{'s' if len(loss.rotors) > 1 else ''} {' and '.join(map(str, loss.rotors))}"
    return (
        f"At {loss.onset_s:.1f} s {who} seemed to lose thrust within {NEAR_M:g} m of the take-off height: "
        "ground effect explains that as well, so it is not counted."
    )


def _hear(view: View, claims: Events) -> Events:
    low = [c for c in claims if view.hovers and c.kind == LOSS and explains(view.flight, view.air, c)]
    view.warnings += map(warning, low)
    return tuple(c for c in claims if c not in low)


WITNESSES = (Witness("near the ground", Stage.REVISION, 20, _hear, needs=("position", "motors")),)
