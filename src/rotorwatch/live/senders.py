"""Number of senders under one MAVLink id: each numbers its frames itself, so that the numbers form as many sequences."""

from __future__ import annotations

NEAR = 24  # frames: longest loss or delay within a sequence; a longer gap begins another one
TREND = 0.02  # weight of a frame in its sequence's share
# Share of the second sequence from which there are two senders; below which there is one again; below which a sequence is over.
SECOND, SILENT, FORGOTTEN = 0.25, 0.05, 0.01
ALTERNATING = 150  # frames for which that must hold: after a gap the old sequence fades within a third of it
# Share of frames that continue an older sequence: two senders alternate; after a gap none returns.
RETURNS = 0.1


class Senders:
    """several: there is more than one sender. suspected: there may be."""

    def __init__(self):
        self._rows: list[list[float]] = []  # [last number, share of the frames]
        self._latest: list[float] = []
        self._spell, self._returns = 0, 0.0
        self.several = self.suspected = False

    def count(self, number: int) -> None:
        """Count a frame, with its running number (0 to 255)."""
        rows = self._rows
        nearest = min(rows, key=lambda row: _apart(row[0], number)) if rows else None
        if nearest is None or _apart(nearest[0], number) > NEAR:
            nearest = [number, 0.0 if rows else 1.0]
            rows.append(nearest)
            went_back = False
        else:
            went_back = nearest is not self._latest
            if (number - nearest[0]) % 256 <= NEAR:
                nearest[0] = number
        self._latest = nearest
        self._returns += TREND * (went_back - self._returns)
        if len(rows) == 1:
            self.several = self.suspected = False
            return
        for row in rows:
            row[1] += TREND * ((row is nearest) - row[1])
        second = sorted(row[1] for row in rows)[-2]
        self._spell = self._spell + 1 if second > SECOND else 0
        self.several = second > SILENT if self.several else self._spell > ALTERNATING
        self.suspected = self._spell > 0 and self._returns > RETURNS
        self._rows = [row for row in rows if row is nearest or row[1] > FORGOTTEN]


def _apart(one: float, other: float) -> float:
    return min((one - other) % 256, (other - one) % 256)
