"""From a vehicle's samples to its answer. The same steps for a log and a link:

    samples -> engine (ticks, losses, trim) -> departures, impacts -> witnesses -> ledger -> conclusion

A log is a link that is over: its samples come in one piece, so its impacts are known before the engine is fed. On a link an impact shows
afterwards, and the engine is rolled back. Witnesses that need the whole flight are evaluated when it is over, for both. A log keeps the
outputs of all ticks; a link keeps none, and of the ticks those of the last WINDOW_S.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from rotorwatch.answer import conclusion, drift, ledger, slow, unseen, wording
from rotorwatch.answer.ledger import Merged
from rotorwatch.base.progress import portion
from rotorwatch.case import verdict, whole_log
from rotorwatch.case.departures import WINDOW_S, Departures
from rotorwatch.case.estimated import Estimated
from rotorwatch.case.in_flight import InFlight
from rotorwatch.case.link_consistency import MEMORY_S, Consistency
from rotorwatch.case.verdict import Answer, Bounds, Claims
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.diagnoser import Assessed, Diagnoser, Written
from rotorwatch.engine.driver import Driver, Piece
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.engine.motion import trust
from rotorwatch.engine.motion.air_spans import Gap, gaps
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.overrides import in_flight
from rotorwatch.engine.motion.tick_table import ASSESS, Plan, Ticks, grounded, joined
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import CONTACT, EVIDENCE
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.aerobatic import assess as aerobatic
from rotorwatch.witnesses.leaning import LEANS_S
from rotorwatch.witnesses.upset import find as upset
from rotorwatch.witnesses.witness import Events, Stage, View

CHUNK = 64  # ticks that are kept in one table
FINAL_S = 5.0  # after a landing, within which the events of a flight may be withdrawn


class Case:
    """A vehicle, its samples so far, and what they show.

    vehicle: with data from healthy flights, of `source`, if `known`; B (4, n): its effectiveness; dynamics: their gains and noise, None
    where they do not fit. air: ((start, end), ...) s of each flight, cut at impacts, end infinite while airborne. over: no samples will
    follow. hovers: False where only angular motion is evaluated (witnesses/aerobatic). ticks: number of evaluated ticks; last: the newest
    ones. unseen, grown: what the trim shows so far. written, estimated: of a log, the engine's records, and the outputs that assess it;
    None without a flight. ready_s: of a log, time after take-off in which trim and noise are learned. assumptions, warnings: sentences.
    matters: loss of one rotor that a healthy flight must have excluded."""

    def __init__(
        self, about: Flight, vehicle: Vehicle, *, source: str = "", assumptions: Sequence[str] = (), warnings: Sequence[str] = (),
        matters: float = MATTERS,
    ):  # fmt: skip
        """about: a log, or parameters and facts of the flight on a link. source: of the vehicle's healthy flights, in words."""
        self.about, self.vehicle, self.B = about, vehicle, vehicle.effectiveness()
        self.known = bool(vehicle.identified)
        self.source = source if self.known else "the first healthy part of this flight"
        self.assumptions, self.warnings, self.matters = (*vehicle.assumptions, *assumptions), tuple(warnings), matters
        self.departures, self.consistency = Departures(vehicle), Consistency(vehicle)
        self.air: Spans = ()
        self.over = False
        self.hovers = True
        self.dynamics: dict | None = None
        self.ready_s = 0.0
        self.written: Written | None = None
        self.estimated: Estimated | None = None
        self.ticks = 0
        self.last: Assessed | None = None
        self.unseen: unseen.Unseen | None = None
        self.grown: drift.Growth | None = None
        self._whole = False  # it is a log
        self._report = event_rows.Report(self.B)  # falls and contacts, where the engine has none
        self._gaps: tuple[Gap, ...] = ()  # of a log
        self._turned: tuple[Event, ...] = ()
        self._growths = 0  # 1 where the trim changes the losses
        self._looks = 0
        self._tables: list[Ticks] = []  # of the last WINDOW_S
        self._recent: list[Ticks] = []  # after these, in small pieces
        self._heard: dict[str, tuple[float, tuple[Event, ...]]] = {}  # witness -> when it was asked last [s], its claims
        self._in_flight = InFlight()
        self._asked = [(one, one.due) for one in witness.registered() if one.stage is Stage.CLAIMS and one.due]  # on a link
        self._open()

    def _open(self) -> None:
        self.driver = Driver(self.about, self.vehicle, keep_s=WINDOW_S, snapshot=lambda: (self.unseen, self.ticks))

    # A log

    def feed_log(self, air: Spans, progress: Callable[[float], object] | None = None) -> None:
        """Evaluate all samples of the log. air: its flights, cut at impacts (`Departures.of_log`); progress: called with the finished
        share, 0..1."""
        self._whole = self.over = True
        self.air = air
        reported = whole_log.flown(self.about, self.vehicle, air, progress)
        self.written, self.dynamics, self.ready_s, self.hovers = reported.written, reported.dynamics, reported.ready_s, reported.hovers
        self._gaps = gaps(self.about, air) if air else ()
        self.assumptions += reported.assumptions
        self.warnings += tuple(wording.not_commanded(self._gaps, len(self.vehicle.rotors)))
        if reported.estimated is not None:
            self._assess_by(reported.estimated)
            if not self.hovers:  # contacts of a vehicle that does not hover are its manoeuvres
                self._report.add(reported.estimated.table, air).finish(air)

    def by(self, done: Estimated) -> Case:
        """The same log, assessed by other outputs."""
        other = copy.copy(self)
        other._assess_by(done)
        other.assumptions += done.assumptions
        return other

    def _assess_by(self, done: Estimated) -> None:
        table, out = done.table, done.out
        self.estimated, self.last = done, Assessed(table, out)
        self.unseen, self.grown, self._turned = unseen.bounds(out, table, self.B), None, ()
        if self._by_hover:
            slow_changes = done.written.trim if done.written is not None else drift.look(out, table, self.B)
            self.grown, self._turned = drift.growth(slow_changes), drift.mounts(slow_changes)

    @property
    def table(self) -> Ticks | None:
        """The ticks of a log; None without a flight."""
        return None if self.estimated is None else self.estimated.table

    # A link

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
        reported = diagnoser.losses.announcements + len(diagnoser.overrides) + len(diagnoser.contacts)
        heard = sum(len(claims) for _, claims in self._heard.values())
        return reported + heard + len(self._turned) + self._growths + self.departures.revision

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
        return piece.assessed is not None

    def _add(self, piece: Piece) -> None:
        assessed = piece.assessed
        if piece.rolled_back:
            self.unseen, self.ticks = piece.extra
            first = np.inf if assessed is None else assessed.table.time[0]
            self._tables = [t.part(t.time < first) for t in (*self._tables, *self._recent) if t.time[0] < first]
            self._recent.clear()
        if assessed is None:
            return
        assert self.driver.plan is not None
        self.last = assessed = assessed._replace(table=grounded(assessed.table, self.air or piece.spans))
        if self.unseen is None:
            self.unseen = unseen.Unseen(self.B, assessed.table.dt)
        self.unseen.add(assessed.out, assessed.table)
        self.ticks += int(np.count_nonzero(assessed.table.mode == ASSESS))
        self._recent.append(assessed.table)
        if len(self._recent) >= CHUNK:
            self._tables.append(joined(self._recent))
            self._recent.clear()
            while self._tables[0].time[-1] < assessed.table.time[-1] - WINDOW_S:
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

    # Both

    @property
    def flight(self) -> Flight:
        """The samples; of a link those of the last WINDOW_S."""
        return self.about if self._whole else self.driver.window.flight(self.now - WINDOW_S)

    @property
    def tables(self) -> tuple[Ticks, ...]:
        """The ticks, in pieces; of a link those of the last WINDOW_S."""
        return (*self._tables, *self._recent) if self.table is None else (self.table,)

    @property
    def upsets(self) -> tuple[upset.Assessed, ...]:
        """Losses of control."""
        return self.departures.found

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that are missing in the air; on a link in the current or last flight."""
        return self._gaps if self._whole else self.driver.missing

    @property
    def engine(self) -> Diagnoser | Written | None:
        """The engine's records."""
        return self.written if self._whole else self.driver.diagnoser

    @property
    def _from_takeoff(self) -> bool:
        """True if the samples begin before the first take-off: witnesses of the whole flight then see all of it."""
        return self._whole or (bool(self.air) and self.air[0][0] > self.now - WINDOW_S)

    @property
    def _records(self) -> Diagnoser | Written | None:
        """The same, where the estimator that assesses is the engine's."""
        return self.engine if self.estimated is None else self.estimated.written

    @property
    def _by_hover(self) -> bool:
        """True if the default estimator's model of hover assesses."""
        return self.hovers and (self.estimated is None or self.estimated.default)

    def claims(self, hop: tuple[float, float] | None = None, progress: Callable[[float], object] | None = None) -> Claims:
        """The events and the open claims as they look now. hop: (start, end) s of one flight, for those of that flight alone; progress:
        called with the finished share, 0..1."""
        if self._whole and self.estimated is None:
            return self._of_no_flight()
        tell, view = progress or (lambda share: None), self._view() if self.over else None
        merged, found = self._settled(view)
        tell(0.1)
        doubts, warnings = self._doubts(merged, portion(tell, 0.1, 0.6))
        until = np.inf if self.over and doubts else self.consistency.until
        if view is None:
            found, opened = self._in_flight.reconsidered(found, self.now, self.air, self._view)
            found, evidence = self._evidence(found, view)
            found = _of(hop, ledger.believed(found, until))
            return Claims(found, _in(hop, ledger.open_claims((*opened, *evidence), found)), doubts)
        view.consistent, view.events, before = not doubts, found, found
        view.warnings += warnings
        found, evidence = self._evidence(found, view)
        tell(0.7)
        view.open = ledger.open_claims(evidence, found)
        if view.consistent:
            found = witness.ask(Stage.COMPARISON, view, found)
            view.open = ledger.open_claims(view.open, found)
            tell(0.8)
            if self.hovers and self._from_takeoff:
                found = witness.ask(Stage.SETUP, view, found)
        found = _of(hop, ledger.believed(found, until))
        said = tuple(view.assumptions), tuple(view.warnings)
        return Claims(found, _in(hop, view.open), doubts, before, view.facts, *said)

    def answer(
        self, hop: tuple[float, float] | None = None, bounds: Bounds | None = None, progress: Callable[[float], object] | None = None
    ) -> Answer:
        """The verdict. hop, progress: as of `claims`. bounds: on a link, how much was assessed, and how well; of a log, its outputs show
        that."""
        claims = self.claims(hop, progress)
        if self._whole and self.estimated is None:
            return verdict.of_no_flight(self, claims)
        return verdict.conclude(self, claims, bounds or verdict.bounds(self, claims), self.air if hop is None else (hop,))

    def _settled(self, view: View | None) -> tuple[Merged, Events]:
        """Claims to events: the estimator's losses and other claims after all witnesses have been evaluated, merged; and the events with
        the witnesses' additions. view: None while the vehicle flies."""
        done, engine, losses = self.estimated, self.engine, ()
        if done is not None:
            losses = event_rows.read(done.out, done.table, self.B, None if done.written is None else done.written.losses)
        elif engine is not None:
            losses = engine.losses.events(flies=not self.over)
        overrides = () if engine is None else map(event_rows.overridden, in_flight(engine.overrides, self.air))
        others = (*overrides, *self._turned, *(claim for _, heard in self._heard.values() for claim in heard))
        claims = (*(losses if view is None else witness.ask(Stage.CLAIMS, view, losses, on_link=not self._whole)), *others)
        claims = claims if view is None else witness.ask(Stage.REVISION, view, claims)
        merged = self._merged(claims)
        return merged, merged.events if view is None else witness.ask(Stage.EVENTS, view, merged.events)

    def _merged(self, claims: Events) -> Merged:
        report = self._report if self.engine is None or not self.hovers else self.engine.report
        return ledger.merge(claims, report, self.upsets, self.B.shape[1], self.grown)

    def _doubts(self, merged: Merged, progress: Callable[[float], object]) -> tuple[tuple[str, ...], list[str]]:
        """Why the samples contradict themselves, and warnings of outputs that left the mixer together."""
        doubts, together = (self.consistency.doubt,) if self.consistency.doubt else (), []
        if self.table is not None:
            doubts = trust.contradictions(self.flight, self.vehicle, self.air, self.table, progress)
        if self.over:
            together = wording.together(merged.shared)
        doubts += tuple(text for text, lasts in together if lasts)
        doubts += () if self.hovers else aerobatic.lacks(self.flight)
        return doubts, [text for text, lasts in together if not lasts]

    def _evidence(self, found: Events, view: View | None) -> tuple[Events, list[Event]]:
        """The events, doubted where the steps of the trim are evidence against a rotor, and all open claims. view: None while the vehicle
        flies."""
        tables = self.tables
        if not tables or self.unseen is None:
            return found, []
        end_s = float(tables[-1].time[-1])
        claims = list(witness.ask(Stage.OPEN, view)) if view is not None and self._from_takeoff else []
        claims += slow.suspected(self.grown)
        if self._by_hover:
            found = self.unseen.doubted(found)
            claims += self.unseen.suspected(found, end_s)
        pushed_s = min((e.onset_s for e in found if e.kind == CONTACT and e.end_s is None), default=np.inf)
        return found, [c for c in claims if c.kind != EVIDENCE or c.onset_s < pushed_s - LEANS_S]

    def _of_no_flight(self) -> Claims:
        """The events of a log without ticks; of one without a flight only why the autopilot ended it."""
        view = View(
            self.flight, self.vehicle, self.air or ((0.0, self.flight.duration),), (), self.B, hovers=self.hovers, lost=self._lost
        )  # fmt: skip
        reported = witness.ask(Stage.CLAIMS, view)
        if not self.air:
            reported = tuple(e for e in reported if e.extra.get("trouble") in conclusion.GRAVE)
        return Claims(self._merged(reported).events)

    @property
    def _lost(self) -> tuple[float, ...]:
        return tuple(assessed.onset for assessed in self.upsets)

    def _view(self) -> View:
        done, records = self.estimated, self._records
        return View(
            self.flight, self.vehicle, self.air, self.tables, self.B, None if done is None else done.out, over=self.over,
            hovers=self.hovers, default=done is None or done.default, known=self.known,
            dynamics=self.dynamics if self._whole else self.driver.dynamics,
            learned=None if records is None else records.learned, lost=self._lost, spins=self.departures.spins,
            merged=lambda claims: self._merged(claims).events,
        )  # fmt: skip


def _of(hop: tuple[float, float] | None, found: Events) -> Events:
    """The events of one flight (start, end) s; None: all."""
    return found if hop is None else tuple(e for e in found if hop[0] <= e.detected_s <= hop[1] + FINAL_S)


def _in(hop: tuple[float, float] | None, claims: Events) -> Events:
    """The open claims that begin in one flight (start, end) s; None: all."""
    return claims if hop is None else tuple(c for c in claims if hop[0] <= c.onset_s <= hop[1])
