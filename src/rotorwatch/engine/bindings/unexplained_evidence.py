"""Evidence against rotors that is no event: which rotor, and how much, remains open, but it is reported."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.engine.estimator import plant
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import CONTACT, EVIDENCE


def _shown_otherwise(claim: Event, known: Event) -> bool:
    return known.kind == EVIDENCE and known.source.name != OPENED.name


OPENED = Source("opened", 12, _shown_otherwise)
"""Of losses that a comparison opened (witnesses/rivals.py): announced, but other explanations are as likely."""


def claim(
    rotors: tuple[int, ...],
    start_s: float,
    end_s: float,
    interval: tuple[tuple[float, float], ...] = (),
    probability: float = 0.5,
    source: Source = OPENED,
) -> Event:
    """Evidence against each of these rotors (1-based), from start to end [s]; interval: of the loss of each, 95 %, where known."""
    return Event(EVIDENCE, rotors, start_s, end_s, end_s, (), interval, probability, source=source)


def knocked(time: np.ndarray, events: Sequence[Event]) -> np.ndarray:
    """Return whether a knock among the events explains the evidence at these times [s], which it leaves behind."""
    near = np.zeros(np.shape(time), bool)
    for e in events:
        if e.kind == CONTACT:
            near |= (time >= e.onset_s - 0.5) & (time <= max(e.detected_s, e.end_s or 0.0) + plant.USUAL_S)
    return near
