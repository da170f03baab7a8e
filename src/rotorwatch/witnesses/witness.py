"""The interface of a witness: evidence beside the default estimator.

A file of this folder, or of another package, that defines WITNESSES, a tuple of `Witness`, registers them; nothing lists them by hand
(docs/your-own-witness.md). `case.conductor.Case` asks all of them, of logs and links alike, in the order of stage and place.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import discovery
from rotorwatch.engine.bindings.program import Learned
from rotorwatch.engine.estimator.plant import AIR
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.ground_contact import on_ground
from rotorwatch.engine.motion.tick_table import Ticks, joined
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle

GROUP = "rotorwatch.witnesses"
Events = tuple[Event, ...]
FALLS_S = 8.0  # before a loss of control: what the controller does then is no landing
SPINS_S = 3.0  # after a loss, within which the spin begins that it causes


class Stage(Enum):
    """When a witness is asked, and what `hear` gets and returns.

    CLAIMS: all claims so far, before `answer.ledger` merges them into events; also on a link while the vehicle flies (`Witness.due`).
    REVISION: the same once the flight is over: claims may be withdrawn.
    EVENTS: the events of the flight.
    OPEN: open claims (kinds of weight OPEN); `View.events` holds the events.
    COMPARISON: the events, when the flight is over; `View.open` holds the open claims that no event explains, and may be changed.
    SETUP: the events, where the log is consistent.

    OPEN and SETUP are of the whole flight: on a link they are asked only if the samples that are kept begin before the first take-off.
    """

    CLAIMS, REVISION, EVENTS, OPEN, COMPARISON, SETUP = range(6)


@dataclass
class View:
    """A case as its witnesses see it.

    flight: the samples, of a link the last ten minutes. air: ((start, end), ...) s of each flight, cut at impacts, end infinite while
    airborne. tables: the ticks, in pieces; table: the same in one, None before there are any. out: its outputs, None on a
    link. B (4, n): effectiveness. over: no samples will follow. hovers: assessed by the hover model. default: by the default estimator.
    known: `vehicle` holds what healthy flights have shown, `dynamics` their gains and noise. learned: the estimator's last state. lost:
    times of losses of control [s]. spins: ((start, end), ...) s in which the vehicle spins and flies on. consistent: the log does not
    contradict itself. events, open: see `Stage`. facts: results by name, for the report. assumptions, warnings: sentences for the answer; a
    witness adds its own. merged: claims -> the events that they make. testimony: what witnesses say on a loss of each rotor's thrust at a
    time, or since take-off (None): (n,) log-odds.
    """

    flight: Flight
    vehicle: Vehicle
    air: Spans
    tables: Sequence[Ticks]
    B: np.ndarray
    out: Any = None
    over: bool = True
    hovers: bool = True
    default: bool = True
    known: bool = False
    dynamics: Mapping[str, Any] | None = None
    learned: Learned | None = None
    lost: tuple[float, ...] = ()
    spins: Spans = ()
    consistent: bool = True
    events: Events = ()
    open: Events = ()
    facts: dict[str, Any] = field(default_factory=dict)
    assumptions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    merged: Callable[[Events], Events] = lambda claims: claims
    testimony: list[Callable[[float | None], np.ndarray]] = field(default_factory=list)

    def said(self, onset: float | None) -> np.ndarray:
        """(n,) sum of the testimony on a loss of each rotor's thrust at `onset` s, None: since take-off."""
        return sum((one(onset) for one in self.testimony), np.zeros(self.B.shape[1]))

    @functools.cached_property
    def table(self) -> Ticks | None:
        """All ticks in one table."""
        return joined(self.tables) if self.tables else None

    @functools.cached_property
    def ground(self) -> np.ndarray:
        """(T,) bool: ticks in which the ground carries a part of the vehicle. A loss of control ends in no landing."""
        table = self.table
        if table is None:
            return np.zeros(0, bool)
        found = on_ground(table, self.air, 0.0 if self.learned is None else float(self.learned.s[AIR]))
        for start, end in self.air:
            lost = [t for t in self.lost if start <= t <= end]
            if lost:
                found &= ~((table.time > min(lost) - FALLS_S) & (table.time <= end))
        return found

    @functools.cached_property
    def clear(self) -> Ticks | None:
        """The table, invalid where the ground carries a part of the vehicle: it takes any wrench, so that no motion there is evidence."""
        return None if self.table is None else replace(self.table, valid=self.table.valid & ~self.ground[:, None])

    def spins_from(self, onset: float) -> bool:
        """True if a loss at `onset` [s] begins a spin in which the vehicle flies on, or is one of those in it."""
        return any(start - SPINS_S < onset < end for start, end in self.spins)

    def began(self, out: Any, tick: int) -> float:
        """Time [s] at which that began which is announced at a tick of these outputs of the table."""
        assert self.table is not None
        return float(self.table.command_time[max(tick - round(out.onset[tick]), 0)])

    def stands(self, time: float) -> bool:
        """True if the ground carries a part of the vehicle at a time [s]."""
        if self.table is None or not len(self.table.time):
            return False
        return bool(self.ground[min(int(np.searchsorted(self.table.time, time)), len(self.ground) - 1)])


class Witness(NamedTuple):
    """name. place: order among those of its stage. hear: (view, events or claims so far) -> all of them, see `Stage`. needs: signals
    without which it is not asked. due: of a CLAIMS witness that only adds, on a link: (flights, time now [s], time of the last look [s]) ->
    whether to ask it again; None: it is asked only when the flight is over."""

    name: str
    stage: Stage
    place: int
    hear: Callable[[View, Events], Events]
    needs: tuple[str, ...] = ()
    due: Callable[[Spans, float, float], bool] | None = None


_changes: list[Callable[[Witness], Witness | None]] = []


def adding(claims: Callable[[View], Iterable[Event]]) -> Callable[[View, Events], Events]:
    """`Witness.hear` of a witness that only adds."""
    return lambda view, before: (*before, *claims(view))


def registered() -> tuple[Witness, ...]:
    """All witnesses in the order in which they are asked: those of this folder, and of other packages by entry points of the group
    `rotorwatch.witnesses`, each a module with WITNESSES."""
    found = _registered(tuple(discovery.offered(GROUP)))
    for change in _changes:
        found = tuple(other for w in found if (other := change(w)) is not None)
    return found


@contextmanager
def changed(change: Callable[[Witness], Witness | None]) -> Iterator[None]:
    """Context in which `change` of every witness is asked in its place (None: nobody), to measure what they contribute."""
    _changes.append(change)
    try:
        yield
    finally:
        _changes.remove(change)


@functools.cache
def _registered(_offered: tuple[str, ...]) -> tuple[Witness, ...]:
    others = (module for _, module in discovery.others(GROUP, ("WITNESSES",)))
    found = [w for module in (*discovery.modules(GROUP, deep=False), *others) for w in getattr(module, "WITNESSES", ())]
    return tuple(sorted(found, key=lambda w: (w.stage.value, w.place, w.name)))


def ask(stage: Stage, view: View, before: Events = (), on_link: bool = False) -> Events:
    """`before` after the witnesses of a stage have been heard; on_link: only those that are not asked on the way (`Witness.due`)."""
    for witness in registered():
        asked = witness.stage is stage and not (on_link and witness.due)
        if asked and all(name in view.flight.signals for name in witness.needs):
            before = witness.hear(view, before)
    return before
