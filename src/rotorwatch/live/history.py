"""What of the estimator's ticks events are made of, kept for as long as they may still be.

A healthy flight keeps two minutes. From the first announcement on all of a hop is kept, up to MOST ticks; then its events stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rotorwatch.default import events
from rotorwatch.default.hypotheses import Hypotheses
from rotorwatch.diagnosis import Event
from rotorwatch.motion.ticks import GROUND, Ticks

QUIET, MOST = 2400, 72_000
SETTLE_EVERY_S = 1.0
FRESH = 50  # pieces that are put into the columns at once
TICK = ("time", "command_time", "mode", "restart", "upset")
OUT = ("theta", "theta_sd", "announced", "since", "active", "share", "opposite", "opposite_onset", "opposite_loss")
RARE = ("probability", "log_odds")  # asked for only where something was announced


@dataclass
class _Rows:
    """Columns by name."""

    dt: float
    columns: dict[str, Any]

    def __getattr__(self, name: str):
        try:
            return self.columns[name]
        except KeyError:
            raise AttributeError(name) from None


class _Rare:
    """Rows of a table of which few are kept, by their running numbers."""

    def __init__(self, first: int, rows: dict[int, np.ndarray]):
        self._first, self._rows = first, rows

    def __getitem__(self, k) -> np.ndarray:
        return self._rows[self._first + int(k)]


class History:
    """The ticks since `first` (running number); `end` is one past the last."""

    def __init__(self, dt: float):
        self._dt, self.first, self.end, self._settled = dt, 0, 0, 0
        self._columns: dict[str, np.ndarray] = {}
        self._fresh: list[dict[str, np.ndarray]] = []  # the last of them, not yet in the columns
        self._rare: dict[str, dict[int, np.ndarray]] = {name: {} for name in RARE}
        self._said: list[int] = []  # ticks at which something was announced or suspected
        self._restarts: list[int] = []

    def add(self, table: Ticks, out) -> None:
        """More ticks with what the estimator made of them."""
        count = len(table.time)
        self._fresh.append(
            {name: getattr(table, name) for name in TICK} | {name: np.asarray(getattr(out, name)) for name in OUT}
        )
        told = np.asarray(out.announced, bool) | (np.asarray(out.opposite) >= 0)
        if told.any():
            for k in np.flatnonzero(told).tolist():
                self._said.append(self.end + k)
                for name in RARE:
                    self._rare[name][self.end + k] = np.array(getattr(out, name)[k])
        if table.restart.any():
            self._restarts += (self.end + np.flatnonzero(table.restart)).tolist()
        self.end += count
        if len(self._fresh) >= FRESH:
            self._join()

    def _join(self) -> None:
        """The ticks that came since the last time, put into the columns: many at once, as one after the other takes longer."""
        fresh, self._fresh = self._fresh, []
        for name in fresh[0] if fresh else ():
            new = np.concatenate([rows[name] for rows in fresh])
            column, used = self._columns.get(name), self.end - self.first - len(new)
            if column is None or used + len(new) > len(column):
                room = np.empty((max(1024, 2 * (used + len(new))), *new.shape[1:]), new.dtype)
                if column is not None:
                    room[:used] = column[:used]
                column = self._columns[name] = room
            column[used : used + len(new)] = new

    @property
    def said(self) -> int:
        """How often something was announced or suspected in these ticks."""
        return len(self._said)

    def ground(self, start: float, end: float) -> None:
        """The flight that began at `start` ended at `end` s: its later ticks are on the ground, and announced nothing."""
        time = self.column("time")
        after = np.flatnonzero((self.column("command_time") > end) & (time >= start))
        for name, value in (("mode", GROUND), ("upset", False), ("announced", False), ("opposite", -1)):
            if name in self._columns:
                self._columns[name][after] = value
        gone = set((self.first + after).tolist())
        self._said = [k for k in self._said if k not in gone]

    def events(self, hyp: Hypotheses, B: np.ndarray, end: int | None = None, flies: bool = False) -> tuple[Event, ...]:
        """Events of the ticks that are kept, or of those before `end`. flies: as for `default.events.read`."""
        end = self.end if end is None else end
        if not any(k < end for k in self._said):
            return ()
        self._join()
        columns = {name: column[: end - self.first] for name, column in self._columns.items()}
        rare = {name: _Rare(self.first, rows) for name, rows in self._rare.items()}
        rows: Any = _Rows(self._dt, {**columns, **rare})
        return events.read(rows, rows, hyp, B, flies)

    def column(self, name: str) -> np.ndarray:
        """A column of the ticks that are kept."""
        self._join()
        return self._columns[name][: self.end - self.first] if name in self._columns else np.empty(0)

    def settle(self, until: float, hyp: Hypotheses, B: np.ndarray) -> tuple[Event, ...]:
        """Drop what is not needed any more; the events of flights that are over for good. until: s, ticks before are certain."""
        if (self.end - self._settled) * self._dt < SETTLE_EVERY_S:
            return ()
        self._settled = self.end
        sure = self.first + int(np.searchsorted(self.column("time"), until))
        over = [k for k in self._restarts if self.first < k < sure]
        if over:
            done = self.events(hyp, B, over[-1] + 1)
            self._drop(over[-1])
            return done
        if not self._said and self.end - self.first > 2 * QUIET:
            self._drop(min(sure, self.end - QUIET))
        elif self.end - self.first > MOST and sure - self.first > MOST // 2:
            done = self.events(hyp, B)
            self._drop(sure)
            return done
        return ()

    def _drop(self, first: int) -> None:
        self._join()
        for name, column in self._columns.items():
            self._columns[name] = column[first - self.first : self.end - self.first].copy()
        self.first = first
        self._said = [k for k in self._said if k >= first]
        self._restarts = [k for k in self._restarts if k >= first]
        for rows in self._rare.values():
            for k in [k for k in rows if k < first]:
                del rows[k]
