"""What is made of the estimator's ticks, with a way back: a vehicle may turn out to have fallen to the ground some time ago."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from rotorwatch.default.events import COLUMNS, Losses, Report
from rotorwatch.motion.allocation import Spans
from rotorwatch.motion.ticks import GROUND, Ticks

KEPT_S = 120.0  # of ticks, at least, that can be taken back


class Account:
    """Losses, falls and contacts of one vehicle with effectiveness B (4, n)."""

    def __init__(self, B: np.ndarray):
        self._B = B
        self.losses, self.report = Losses(B), Report(B)
        # Two times from which it can be done again: losses and report then, and the ticks since, with what the estimator made of them.
        self._older, self._newer = self._mark(), self._mark()

    def _mark(self) -> tuple[Losses, Report, list[tuple[Ticks, SimpleNamespace]]]:
        return Losses(self._B, self.losses), Report(self._B, self.report), []

    def add(self, table: Ticks, out: Any, spans: Spans) -> None:
        """More ticks with the estimator's outputs, in flights `spans`."""
        tape = self._newer[2]
        if tape and table.time[0] - tape[0][0].time[0] > KEPT_S:
            self._older, self._newer = self._newer, self._mark()
        self._newer[2].append((table, SimpleNamespace(**{name: np.asarray(getattr(out, name)) for name in COLUMNS})))
        self._take(*self._newer[2][-1], spans)

    def cut(self, end: float, spans: Spans) -> None:
        """The last flight fell to the ground at `end` s, as `spans` have it: what was made of it after that was no flight."""
        losses, report, tape = self._older
        tape, cut = [*tape, *self._newer[2]], []
        self.losses, self.report = losses, report
        older = self._mark()
        for table, out in tape:
            after = table.command_time > end
            silent = {"announced": out.announced.astype(bool) & ~after, "opposite": np.where(after, -1, out.opposite)}
            cut.append((grounded(table, spans), SimpleNamespace(**{**vars(out), **silent})))
            self._take(*cut[-1], spans)
        self._older, self._newer = (*older[:2], cut), self._mark()

    def _take(self, table: Ticks, out: SimpleNamespace, spans: Spans) -> None:
        self.losses.add(table, out)
        self.report.add(table, spans)


def grounded(table: Ticks, spans: Spans) -> Ticks:
    """The ticks, with those after the end of their flight on the ground: where it was cut by an impact."""
    after = np.zeros(len(table.time), bool)
    for k, (start, end) in enumerate(spans):
        following = spans[k + 1][0] if k + 1 < len(spans) else np.inf
        after |= (table.command_time > end) & (table.time >= start) & (table.time < following)
    if not (after & (table.mode != GROUND)).any():
        return table
    mode, valid, upset = np.where(after, GROUND, table.mode), table.valid & ~after[:, None], table.upset & ~after
    return replace(table, mode=mode.astype(np.int32), valid=valid, upset=upset)
