"""From the events of a whole log to its verdict: bounds, open claims, doubts, and the conclusion."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotorwatch.answer import conclusion, drift, health, ledger, places, slow, unjudged, unseen, wording
from rotorwatch.base.arrays import median
from rotorwatch.base.progress import portion
from rotorwatch.case.conductor import compared, settled
from rotorwatch.engine.bindings import event_rows, residual_evidence
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import TickOutput, threshold
from rotorwatch.engine.diagnoser import Written
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.engine.motion import trust
from rotorwatch.engine.motion.air_spans import Gap
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.overrides import in_flight
from rotorwatch.engine.motion.tick_table import JUDGE, Ticks
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import CONTACT, EVIDENCE
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.aerobatic import judge as aerobatic
from rotorwatch.witnesses.leaning import LEANS_S
from rotorwatch.witnesses.odds import Comparison
from rotorwatch.witnesses.upset import find as upset
from rotorwatch.witnesses.witness import Events, Stage, View


@dataclass(frozen=True, eq=False, repr=False)
class Estimated:
    """An estimator's outputs `out` at the ticks `table`. default: of the default estimator; written: the engine's records, if it ran
    there. series: of a published method, its own estimate. assumptions: of the method. own_limit: `limit`, None: the default
    estimator's."""

    table: Ticks
    out: TickOutput
    default: bool = True
    written: Written | None = None
    series: MethodSeries | None = None
    assumptions: tuple[str, ...] = ()
    own_limit: float | None = None

    @functools.cached_property
    def limit(self) -> float:
        """Log-likelihood ratio from which a loss is announced."""
        return threshold(self.out.theta.shape[1], self.table.dt) if self.own_limit is None else self.own_limit


class Judgement(NamedTuple):
    """end: the answer. doubts: why the log contradicts itself. evidence: open claims. whole: the comparison with healthy flights, None
    without. assumptions, warnings: sentences for the answer. compared: the comparisons of claims with what else explains the motion."""

    end: conclusion.Conclusion
    doubts: tuple[str, ...]
    evidence: tuple[Event, ...]
    whole: dict | None
    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    compared: tuple[Comparison, ...] = ()


class LogCase(NamedTuple):
    """A log ready for evaluation.

    known: the vehicle holds data from healthy flights, from `source`; dynamics: their gains and noise, None where these do not fit this
    log. air: ((start, end), ...) s of each flight, cut at impacts; written: the engine's records, estimated: the outputs of the method
    that decides by default, table: its ticks; all None without a flight. ready_s: after take-off, in which trim and noise are learned.
    hovers: False where only angular motion is evaluated (witnesses/aerobatic). assumptions, warnings: sentences. missing: commands that
    the log lacks in the air. matters: loss of one rotor that a healthy flight must have excluded.
    """

    flight: Flight
    vehicle: Vehicle
    known: bool
    dynamics: dict | None
    source: str
    air: Spans
    upsets: tuple[upset.Judged, ...]
    written: Written | None = None
    estimated: Estimated | None = None
    ready_s: float = 0.0
    hovers: bool = True
    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    missing: tuple[Gap, ...] = ()
    matters: float = MATTERS

    @property
    def table(self) -> Ticks | None:
        """The ticks."""
        return None if self.estimated is None else self.estimated.table

    @property
    def lost(self) -> tuple[float, ...]:
        """Times at which control was lost [s]."""
        return tuple(judged.onset for judged in self.upsets)


def judge(log: LogCase, done: Estimated, progress: Callable[[float], object] | None = None) -> Judgement:
    """The verdict on a log by an estimator's outputs. progress: called with the finished share, 0..1."""
    tell, table, out, B = progress or (lambda share: None), done.table, done.out, log.vehicle.effectiveness()
    assert log.written is not None and log.table is not None
    n, written, hover_model = B.shape[1], done.written, done.default and log.hovers
    # Contacts of a vehicle that does not hover are its manoeuvres.
    report = log.written.report if log.hovers else event_rows.Report(B).add(table, log.air).finish(log.air)
    grown, turned = None, ()
    if hover_model:
        slow_changes = written.trim if written is not None else drift.look(out, table, B)
        grown, turned = drift.growth(slow_changes), drift.mounts(slow_changes)

    def merge(claims: Events) -> ledger.Merged:
        return ledger.merge(claims, report, log.upsets, n, grown)

    view = View(
        log.flight, log.vehicle, log.air, (table,), B, out, hovers=log.hovers, default=done.default, known=log.known,
        dynamics=log.dynamics, learned=None if written is None else written.learned, lost=log.lost,
        merged=lambda claims: merge(claims).events,
    )  # fmt: skip
    losses = event_rows.read(out, table, B, None if written is None else written.losses)
    others = (*map(event_rows.overridden, in_flight(log.written.overrides, log.air)), *turned)
    merged, found = settled(losses, others, merge, view)
    tell(0.1)
    together = wording.together(merged.shared)
    doubts = trust.contradictions(log.flight, log.vehicle, log.air, log.table, portion(tell, 0.1, 0.6))
    doubts += tuple(text for text, lasts in together if lasts)
    doubts += () if log.hovers else aerobatic.lacks(log.flight)
    view.warnings += [text for text, lasts in together if not lasts]
    view.consistent, view.events = not doubts, found
    end_s = float(table.time[-1])
    claims = (
        *witness.ask(Stage.OPEN, view),
        *slow.suspected(grown),
        *residual_evidence.find(out, table, list_hypotheses(n), done.limit, found, B),
        *residual_evidence.faint(merged.faint, found, end_s),
    )
    tell(0.7)
    steps = unseen.bounds(out, table, B)
    if hover_model:
        found, claims = steps.doubted(found), (*claims, *steps.suspected(found, end_s))
    pushed_s = min((e.onset_s for e in found if e.kind == CONTACT and e.end_s is None), default=np.inf)
    claims = [c for c in claims if c.kind != EVIDENCE or c.onset_s < pushed_s - LEANS_S]
    view.open = ledger.open_claims(claims, found)
    if view.consistent:
        found, view.open = compared(view, found, view.open)
    tell(0.8)
    if view.consistent and log.hovers:
        found = witness.ask(Stage.SETUP, view, found)
    end, evidence = _concluded(log, done, view, found, steps, doubts)
    notes, compared_ = (tuple(view.assumptions), tuple(view.warnings)), tuple(view.facts.get("compared", ()))
    return Judgement(end, doubts, evidence, view.facts.get("whole_flight"), *notes, compared_)


def _concluded(
    log: LogCase, done: Estimated, view: View, found: Events, steps: unseen.Unseen, doubts: tuple[str, ...]
) -> tuple[conclusion.Conclusion, Events]:
    """The conclusion, and the evidence that no event explains."""
    table, out, B, flight, air = done.table, done.out, view.B, log.flight, log.air
    judged = (table.mode == JUDGE) & table.valid.any(axis=1)
    judged_s = float(judged.sum() * table.dt)
    blind_s = log.ready_s if log.hovers else aerobatic.READY_S
    hidden, hidden_pair = _hidden(out, table, steps, B, log.hovers)
    trusted = log.hovers and not doubts
    seen = conclusion.Evidence(
        found, B.shape[1], hidden, hidden_pair, judged_s, view.open, places.names(log.vehicle.rotors), air,
        health.trends(out, table, B, view.events) if trusted else (), log.hovers and "whole_flight" not in view.facts,
        tuple(g for g in log.missing if g.lasts and g.start >= air[-1][0]), log.matters,
        judged_until=_judged_until(table.time[judged], found), blind_s=blind_s,
    )  # fmt: skip
    short = judged_s < conclusion.LEAST_S or seen.vague
    if log.hovers and (shaken := unjudged.shaken(flight, air)) is not None:
        seen = seen._replace(hidden=None, unjudged=shaken)
    elif not doubts and not short and seen.patchy:
        seen = seen._replace(unjudged=unjudged.patchy(air, table, log.hovers))
    elif not doubts and short:
        stepped, needed = bool(np.max(steps.losses()) >= np.max(hidden)), blind_s + conclusion.LEAST_S
        why = unjudged.find(air, table, judged_s, needed, log.hovers, conclusion.LEAST_S, stepped)
        seen = seen._replace(unjudged=why)
    return conclusion.conclude(seen, doubts), tuple(seen.residual_evidence)


def _judged_until(judged: np.ndarray, found: Sequence[Event]) -> float:
    """The last evaluated time [s], of ticks at these times: a disturbance that lasts to the end masks a loss."""
    pushed = (e.onset_s for e in found if e.kind == CONTACT and e.end_s is None)
    return min([float(judged[-1]) if judged.size else np.inf, *pushed])


def _hidden(out, table: Ticks, seen: unseen.Unseen, B: np.ndarray, hovers: bool) -> tuple[np.ndarray, float]:
    """(n,) largest undetectable loss of each rotor: too small to be measured, or absorbed as a disturbance; and the same of two opposite
    rotors."""
    judged = table.mode == JUDGE
    if not judged.any():
        return np.ones(out.theta.shape[1]), 1.0
    if not hovers:  # its bound covers all blocks so far; two opposite rotors at once are not tested
        return np.minimum(1.0, 1.96 * out.detectable[judged][-1]), 0.0
    measured = 1.96 * median(out.detectable[judged], axis=0)
    single = np.minimum(1.0, np.maximum(measured, seen.losses()))
    return single, min(1.0, seen.pair(event_rows.opposites(B)))
