"""Two publishers in one topic instance: their samples alternate, and read as one series they make outputs jump to and fro.

An experimental controller that bypasses the mixer publishes its outputs beside the autopilot's own; both are logged under the
same name. A sample belongs to the series whose last value it is nearer to.
"""

from __future__ import annotations

import numpy as np

THERE_AND_BACK = 20  # jumps away and back again within three samples, before two publishers are believed
APART = 4.0  # how many times nearer a sample has to be to the one before last than to the last
AT_REST = 0.1  # of two series, one whose outputs move so much less than the other's is not what flew


def tracks(values: np.ndarray, step: float) -> list[np.ndarray]:
    """Indices of the samples of each publisher in values (n, k), in order; a single one where they do not alternate.

    step: a change from sample to sample below which nothing is a jump, in the unit of the values.
    """
    everything = [np.arange(len(values))]
    if len(values) < 3 * THERE_AND_BACK or not np.isfinite(values).all():
        return everything
    jump = np.abs(np.diff(values, axis=0)).max(axis=1)
    across = np.abs(values[2:] - values[:-2]).max(axis=1)
    lone = (np.minimum(jump[1:], jump[:-1]) > np.maximum(APART * across, step)).nonzero()[0] + 1
    if lone.size < THERE_AND_BACK:
        return everything
    rows = values.tolist()
    last = [rows[lone[0] - 1], rows[lone[0]]]
    member = np.zeros(len(rows), bool)
    for i, row in enumerate(rows):
        near, far = (max(abs(a - b) for a, b in zip(row, other)) for other in last)
        member[i] = far < near
        last[int(member[i])] = row
    found = [np.flatnonzero(~member), np.flatnonzero(member)]
    return found if min(len(f) for f in found) >= THERE_AND_BACK else everything


def flown(values: np.ndarray, found: list[np.ndarray]) -> np.ndarray | None:
    """The one of two series that moves while the other rests: what reached the motors. None when both move."""
    if len(found) == 1:
        return found[0]
    moves = [float(np.median(np.abs(np.diff(values[i], axis=0)).max(axis=1))) for i in found]
    return found[int(np.argmax(moves))] if min(moves) <= AT_REST * max(moves) else None
