"""An answer in a list of flights besides its words: its severity, the worst loss, and the time of its main event."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

# Severity of a verdict, in SQL with the column's name inserted.
GRAVITY = "CASE {verdict} WHEN 'crashed' THEN 4 WHEN 'fault' THEN 3 WHEN 'ambiguous' THEN 2 WHEN 'inconclusive' THEN 1 ELSE 0 END"
LOST = ("degraded", "failed", "suspect")  # states of a rotor other than healthy


def worst_loss(diagnosis: Mapping[str, Any]) -> float:
    """The largest loss of a rotor that an answer (`Diagnosis.to_dict`) names, 0 to 1: of its events, also past ones, and of its rotors at
    the end. 0 when it names none."""
    return max((min(loss, 1.0) for loss in _losses(diagnosis)), default=0.0)


def onset(diagnosis: Mapping[str, Any]) -> float | None:
    """Onset of the answer's main event [s of the log]; None without one."""
    events, main = _list(diagnosis.get("events")), diagnosis.get("main_event")
    if isinstance(main, int) and 0 <= main < len(events):
        return next(iter(_numbers([events[main].get("onset_s")])), None)
    return None


def _losses(diagnosis: Mapping[str, Any]) -> Iterator[float]:
    for event in _list(diagnosis.get("events")):
        yield from _numbers(event.get("loss"))
    yield from _numbers([r.get("loss") for r in _list(diagnosis.get("rotors")) if r.get("status") in LOST])


def _list(given: Any) -> list[Mapping[str, Any]]:
    """The tables in a list; anything else is left out: a store may hold answers of any version."""
    return [one for one in given if isinstance(one, Mapping)] if isinstance(given, (list, tuple)) else []


def _numbers(given: Any) -> Iterator[float]:
    for value in given if isinstance(given, (list, tuple)) else ():
        if isinstance(value, (int, float)) and math.isfinite(value) and value >= 0.0:
            yield float(value)
