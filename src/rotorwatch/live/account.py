"""What is made of the estimator's ticks, with a way back: a flight may turn out to have ended some time ago, or to have gone on."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from rotorwatch.engine.default.events import COLUMNS, Losses, Report
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.ticks import GROUND, Ticks, joined

REPLAY_S = 120.0  # of ticks, at least, that can be gone through again


class Account:
    """Losses, falls and contacts of one vehicle with effectiveness B (4, n)."""

    def __init__(self, B: np.ndarray):
        self._B = B
        self.losses, self.report = Losses(B), Report(B)
        self._spans: Spans = ()
        self._time = -np.inf  # of the last commands
        # Two times from which it can be done again: losses and report then, and the ticks since, with what the estimator made of them.
        self._older, self._newer = self._mark(), self._mark()

    def _mark(self) -> tuple[Losses, Report, list[tuple[Ticks, SimpleNamespace]]]:
        return Losses(self._B, self.losses), Report(self._B, self.report), []

    def at(self, spans: Spans) -> None:
        """The flights are these, (start, end) s, infinite where it lasts. Where one ends earlier or later than was known, its ticks are
        gone through again."""
        before, self._spans = dict(self._spans), spans
        ends = [(before.get(start, end), end) for start, end in spans]
        if any(old != new and min(old, new) < self._time for old, new in ends):
            self.losses, self.report, tape = self._older
            tape = [*tape, *self._newer[2]]
            names = vars(tape[0][1])
            table = joined([table for table, _ in tape])
            out = SimpleNamespace(**{name: np.concatenate([getattr(out, name) for _, out in tape]) for name in names})
            self._older = (*self._mark()[:2], [(table, out)])
            self._feed(table, out)
            self._newer = self._mark()

    def add(self, table: Ticks, out: Any) -> None:
        """More ticks with the estimator's outputs."""
        tape = self._newer[2]
        if tape and table.time[0] - tape[0][0].time[0] > REPLAY_S:
            self._older, self._newer = self._newer, self._mark()
        self._time = float(table.command_time[-1])
        self._newer[2].append((table, SimpleNamespace(**{name: np.asarray(getattr(out, name)) for name in COLUMNS})))
        self._feed(*self._newer[2][-1])

    def _feed(self, table: Ticks, out: SimpleNamespace) -> None:
        after = landed(table, self._spans)
        if after.any():
            silent = {"announced": out.announced.astype(bool) & ~after}
            table, out = grounded(table, self._spans), SimpleNamespace(**{**vars(out), **silent})
        self.losses.add(table, out)
        self.report.add(table, self._spans)


def landed(table: Ticks, spans: Spans) -> np.ndarray:
    """(T,) bool: ticks after the end of the flight that they come after the start of."""
    after = np.zeros(len(table.time), bool)
    for k, (start, end) in enumerate(spans):
        following = spans[k + 1][0] if k + 1 < len(spans) else np.inf
        after |= (table.command_time > end) & (table.time >= start) & (table.time < following)
    return after


def grounded(table: Ticks, spans: Spans) -> Ticks:
    """The ticks, with those after the end of their flight on the ground: where it was cut by an impact."""
    after = landed(table, spans)
    if not (after & (table.mode != GROUND)).any():
        return table
    mode, valid, upset = np.where(after, GROUND, table.mode), table.valid & ~after[:, None], table.upset & ~after
    return replace(table, mode=mode.astype(np.int32), valid=valid, upset=upset)
