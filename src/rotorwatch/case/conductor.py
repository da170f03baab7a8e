"""From a vehicle's samples to its answer. The same steps for a log and a link:

    samples -> engine (ticks, losses, trim) -> departures, impacts -> witnesses -> ledger -> conclusion

A log is a completed link: its samples come in one piece, so its impacts are known before the engine is fed. On a link an impact shows
afterwards, and the engine is rolled back. Witnesses that need the whole flight are evaluated when it is over, for both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from rotorwatch.answer import drift, ledger, slow, unseen
from rotorwatch.answer.ledger import Merged
from rotorwatch.case.departures import WINDOW_S, Departures
from rotorwatch.case.link_consistency import MEMORY_S, Consistency
from rotorwatch.engine.bindings import event_rows as events
from rotorwatch.engine.diagnoser import Diagnoser, Judged
from rotorwatch.engine.driver import Driver, Piece
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.overrides import in_flight
from rotorwatch.engine.motion.tick_table import JUDGE, Plan, Ticks, grounded, joined
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.witness import Events, Stage, View

CHUNK = 64  # ticks that are kept in one table


class Case:
    """A vehicle in progress. vehicle: with data from healthy flights, if `known`; air: ((start, end), ...) s of each flight,
    cut at impacts, end infinite while airborne; now: time of the newest sample [s]; ticks: number of evaluated ticks."""

    def __init__(self, about: Flight, vehicle: Vehicle):
        """about: parameters and facts of the flight."""
        self.about, self.vehicle, self.B = about, vehicle, vehicle.effectiveness()
        self.known = bool(vehicle.identified)
        self.departures, self.consistency = Departures(vehicle), Consistency(vehicle)
        self.air: Spans = ()
        self.over = False
        self.ticks = 0
        self.last: Judged | None = None  # the newest ticks
        self.unseen: unseen.Unseen | None = None
        self.grown: drift.Growth | None = None
        self._turned: tuple[Event, ...] = ()
        self._growths = 0  # 1 where the trim changes the losses
        self._looks = 0
        self._tables: list[Ticks] = []  # of the last WINDOW_S
        self._recent: list[Ticks] = []  # after these, in small pieces
        self._heard: dict[str, tuple[float, tuple[Event, ...]]] = {}  # witness -> when it was asked last [s], its claims
        self._open_claims: Events = ()  # of a flight that is over
        self._asked = [(one, one.due) for one in witness.registered() if one.stage is Stage.CLAIMS and one.due]  # on a link
        self._open()

    def _open(self) -> None:
        self.driver = Driver(self.about, self.vehicle, keep_s=WINDOW_S, snapshot=lambda: (self.unseen, self.ticks))

    def feed(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """Append samples and messages, in the order of time."""
        self.driver.add(signals, messages)

    def advance(self) -> bool:
        """Evaluate the samples that have become certain; return whether there was a new tick."""
        piece = self.driver.advance()
        if piece is None:
            return False
        flight = self.driver.replanned()
        if flight is not None:  # begin again with the stored samples
            self._open()
            self.feed(flight.signals, flight.messages)
            return self.advance()
        return self._take(piece)

    def finish(self, end: float) -> None:
        """No samples will follow after `end` s."""
        self.over = True
        piece = self.driver.finish(max(end, self.now))
        if piece is None:
            self.departures.follow(self.driver.window, (), True)
        else:
            self._take(piece)

    @property
    def now(self) -> float:
        """Time of the newest sample [s]."""
        return self.driver.window.now

    @property
    def plan(self) -> Plan | None:
        """Division of the flight into ticks, None until it is known."""
        return self.driver.plan

    @property
    def revision(self) -> int:
        """Changes when there may be other events."""
        diagnoser = self.driver.diagnoser
        if diagnoser is None:
            return self.departures.revision
        told = diagnoser.losses.announcements + len(diagnoser.overrides) + len(diagnoser.contacts)
        heard = sum(len(claims) for _, claims in self._heard.values())
        return told + heard + len(self._turned) + self._growths + self.departures.revision

    def events(self) -> tuple[Event, ...]:
        """The events as they look now, without those that rest on doubted outputs."""
        diagnoser, view = self.driver.diagnoser, self._view() if self.over else None
        others = [*self._turned, *(claim for _, heard in self._heard.values() for claim in heard)]
        losses: tuple[Event, ...] = ()
        if diagnoser is not None:
            losses = diagnoser.losses.events(flies=not self.over)
            others += map(events.overridden, in_flight(diagnoser.overrides, self.air))
        _, found = settled(losses, others, self._merged, view, on_link=True)
        if view is not None and not self.consistency.doubt:
            found, self._open_claims = compared(view, *self._with_open(found))
        return ledger.believed(found, self.consistency.until)

    def weighed(self, found: Iterable[Event]) -> tuple[tuple[Event, ...], tuple[Event, ...]]:
        """The events `found`, doubted where the steps of the trim are evidence against a rotor, and the open claims that none of them
        explains."""
        found, claims = self._with_open(tuple(found))
        return found, self._open_claims if self.over else claims

    def _with_open(self, found: Events) -> tuple[Events, Events]:
        if self.unseen is None or self.last is None:
            return found, ()
        now = float(self.last.table.time[-1])
        claims = () if self.consistency.doubt else (*slow.suspected(self.grown), *self.unseen.suspected(found, now))
        return self.unseen.doubted(found), ledger.open_claims(claims, found)

    def _take(self, piece: Piece) -> bool:
        """Take over new ticks, the engine rolled back where its flight ended earlier."""
        self._add(piece)
        self.air = self.departures.follow(self.driver.window, piece.spans, self.over)
        replaced = self.driver.follow(self.air)
        if replaced is not None:
            self._add(replaced)
        self.driver.checkpoint()
        diagnoser = self.driver.diagnoser
        assert diagnoser is not None
        self._look_at_trim(diagnoser)
        self._hear()
        if self.over or self.consistency.due(self.now, self.revision):
            since = self.now - MEMORY_S
            flight = self.driver.window.flight(since)
            self.consistency.examine(flight, [*self._tables, *self._recent], self.air, self.now, self.revision)
        return piece.judged is not None

    def _add(self, piece: Piece) -> None:
        judged = piece.judged
        if piece.rolled_back:
            self.unseen, self.ticks = piece.extra
            first = np.inf if judged is None else judged.table.time[0]
            self._tables = [t.part(t.time < first) for t in (*self._tables, *self._recent) if t.time[0] < first]
            self._recent.clear()
        if judged is None:
            return
        assert self.driver.plan is not None
        self.last = judged = judged._replace(table=grounded(judged.table, self.air or piece.spans))
        if self.unseen is None:
            self.unseen = unseen.Unseen(self.B, judged.table.dt)
        self.unseen.add(judged.out, judged.table)
        self.ticks += int(np.count_nonzero(judged.table.mode == JUDGE))
        self._recent.append(judged.table)
        if len(self._recent) >= CHUNK:
            self._tables.append(joined(self._recent))
            self._recent.clear()
            while self._tables[0].time[-1] < judged.table.time[-1] - WINDOW_S:
                del self._tables[0]

    def _look_at_trim(self, diagnoser: Diagnoser) -> None:
        if (looks := int(diagnoser.trim["looks"][0])) != self._looks:
            self._looks = looks
            self.grown, self._turned = drift.growth(diagnoser.trim), drift.mounts(diagnoser.trim)
            losses = diagnoser.losses.events(flies=not self.over)
            self._growths = int(slow.join(losses, self.grown) != losses)

    def _hear(self) -> None:
        """Evaluate the witnesses that are due. Their claims on removed samples stay."""
        view, since = None, self.now - WINDOW_S
        for one, due in self._asked:
            looked_s, old = self._heard.get(one.name, (-np.inf, ()))
            if not (self.over or due(self.air, self.now, looked_s)):
                continue
            view = view or self._view()
            if not all(name in view.flight.signals for name in one.needs):
                continue
            kept = tuple(e for e in old if e.onset_s < since)
            same = {(e.kind, e.rotors, e.extra.get("trouble")) for e in kept}
            new = tuple(e for e in one.hear(view, ()) if (e.kind, e.rotors, e.extra.get("trouble")) not in same)
            self._heard[one.name] = self.now, (*kept, *new)

    def _view(self) -> View:
        diagnoser = self.driver.diagnoser
        return View(
            self.driver.window.flight(self.now - WINDOW_S),
            self.vehicle,
            self.air,
            (*self._tables, *self._recent),
            self.B,
            over=self.over,
            known=self.known,
            learned=None if diagnoser is None else diagnoser.learned,
            lost=tuple(j.onset for j in self.departures.found),
            spins=self.departures.spins,
            merged=lambda claims: self._merged(claims).events,
        )

    def _merged(self, claims: tuple[Event, ...]) -> Merged:
        diagnoser = self.driver.diagnoser
        report = events.Report(self.B) if diagnoser is None else diagnoser.report
        return ledger.merge(claims, report, self.departures.found, self.B.shape[1], self.grown)


def settled(
    losses: Events, others: Iterable[Event], merge: Callable[[Events], Merged], view: View | None, on_link: bool = False
) -> tuple[Merged, Events]:
    """Claims to events: the estimator's losses and other claims after all witnesses have been evaluated, merged; and the events with the
    witnesses' additions. view: None while the vehicle flies; on_link: the witnesses for flights in progress have been evaluated."""
    claims = losses if view is None else witness.ask(Stage.CLAIMS, view, losses, on_link)
    claims = (*claims, *others)
    claims = claims if view is None else witness.ask(Stage.REVISION, view, claims)
    merged = merge(claims)
    return merged, merged.events if view is None else witness.ask(Stage.EVENTS, view, merged.events)


def compared(view: View, found: Events, claims: Events) -> tuple[Events, Events]:
    """The events and the open claims of a flight that is over, after the witnesses that compare what explains its motion."""
    view.open = claims
    found = witness.ask(Stage.COMPARISON, view, found)
    return found, ledger.open_claims(view.open, found)
