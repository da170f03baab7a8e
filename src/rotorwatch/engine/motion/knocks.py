"""Knocks as a readable list: the contacts found by engine/intake/contact.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.physics import G0
from rotorwatch.engine.intake import contact as definition
from rotorwatch.engine.intake.sense import BEFORE_S

LEAST_GAIN = np.array(definition.LEAST_GAIN)

__all__ = ["G0", "LEAST_GAIN", "Contact", "contacts", "look_back"]

# By kind of push: unit of its size, and wording.
WORDS = (("hover thrusts of one rotor", "turned it"), ("g", "pushed it sideways"), ("g", "pushed it upwards"))


class Contact(NamedTuple):
    """time s; size: of the force in g, or of the torque in hover thrusts of one rotor, by push (TURNED and so on of
    engine/intake/contact.py)."""

    time: float
    size: float
    push: int

    @property
    def unit(self) -> str:
        """Unit of the size."""
        return WORDS[self.push][0]

    @property
    def what(self) -> str:
        """Description of the effect on the vehicle."""
        return WORDS[self.push][1]


def look_back(dt: float) -> int:
    """Number of earlier ticks that a tick is compared with."""
    return max(2, round(BEFORE_S / dt))


def contacts(touch: Rows, before: tuple[Contact, ...] = ()) -> tuple[Contact, ...]:
    """The contacts of ticks, after those `before`: each with the size of its largest tick."""
    found = list(before)
    new = np.flatnonzero(touch["is_new"])
    for time, size, push in zip(touch["time"][new], touch["size"][new], touch["push"][new]):
        one = Contact(float(time), float(size), int(push))
        if found and found[-1].time == one.time:
            found[-1] = one
        else:
            found.append(one)
    return tuple(found)
