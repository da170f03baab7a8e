"""How many send under one MAVLink id: each numbers its frames for itself, so that the numbers follow each other in as many rows."""

from __future__ import annotations

NEAR = 24  # frames: what is lost or late within a row; a longer gap begins another one
TREND = 0.02  # weight of a frame in its row's share
# Share of the second row from which there are two senders; below which there is one again; below which a row is over.
SECOND, SILENT, FORGOTTEN = 0.25, 0.05, 0.01
ALTERNATING = 150  # frames for which that must hold: after a gap the old row fades within a third of it
# Share of frames that go on with the row that was left: two senders take turns, after a gap nobody goes back.
RETURNS = 0.1


class Senders:
    """several: more than one sends. suspected: it looks like it."""

    def __init__(self):
        self._rows: list[list[float]] = []  # [last number, share of the frames]
        self._latest: list[float] = []
        self._spell, self._returns = 0, 0.0
        self.several = self.suspected = False

    def count(self, number: int) -> None:
        """One frame more, with its running number (0 to 255)."""
        rows = self._rows
        own = min(rows, key=lambda row: _apart(row[0], number)) if rows else None
        if own is None or _apart(own[0], number) > NEAR:
            own = [number, 0.0 if rows else 1.0]
            rows.append(own)
            went_back = False
        else:
            went_back = own is not self._latest
            if (number - own[0]) % 256 <= NEAR:
                own[0] = number
        self._latest = own
        self._returns += TREND * (went_back - self._returns)
        if len(rows) == 1:
            self.several = self.suspected = False
            return
        for row in rows:
            row[1] += TREND * ((row is own) - row[1])
        second = sorted(row[1] for row in rows)[-2]
        self._spell = self._spell + 1 if second > SECOND else 0
        self.several = second > SILENT if self.several else self._spell > ALTERNATING
        self.suspected = self._spell > 0 and self._returns > RETURNS
        self._rows = [row for row in rows if row is own or row[1] > FORGOTTEN]


def _apart(one: float, other: float) -> float:
    return min((one - other) % 256, (other - one) % 256)
