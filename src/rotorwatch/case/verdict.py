"""From the claims of a case to its verdict: bounds, the reason why no more could be assessed, and the conclusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rotorwatch.answer import conclusion, health, places, settings, unassessed, unseen, wording
from rotorwatch.answer.unassessed import Unassessed
from rotorwatch.base.arrays import median
from rotorwatch.case.estimated import Estimated
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import ASSESS
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import CONTACT
from rotorwatch.witnesses.aerobatic import assess as aerobatic
from rotorwatch.witnesses.witness import Events

if TYPE_CHECKING:
    from rotorwatch.case.conductor import Case


class Claims(NamedTuple):
    """events: those that stand as things look now. open: open claims that none of them explains. doubts: why the samples contradict
    themselves. before: the events before comparison. facts: the witnesses' results by name, for the report. assumptions, warnings: of the
    witnesses, sentences."""

    events: Events
    open: Events = ()
    doubts: tuple[str, ...] = ()
    before: Events = ()
    facts: Mapping[str, Any] = {}
    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


class Bounds(NamedTuple):
    """How much of a flight was assessed, and how well. hidden (n,): largest undetectable loss of each rotor; pair: the same of two opposite
    rotors. assessed_s: seconds assessed; assessed_until: end of that [s]; blind_s: after each take-off, in which trim and noise are
    learned."""

    hidden: np.ndarray
    pair: float = 0.0
    assessed_s: float = 0.0
    assessed_until: float = np.inf
    blind_s: float = 0.0


class Answer(NamedTuple):
    """end: the conclusion. doubts: why the samples contradict themselves. evidence: open claims. facts, assumptions, warnings: as of
    `Claims`."""

    end: conclusion.Conclusion
    doubts: tuple[str, ...] = ()
    evidence: Events = ()
    facts: Mapping[str, Any] = {}
    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def bounds(case: Case, claims: Claims) -> Bounds:
    """The bounds of a log."""
    done, steps = case.estimated, case.unseen
    assert done is not None and steps is not None
    assessed = (done.table.mode == ASSESS) & done.table.valid.any(axis=1)
    blind_s = case.ready_s if case.hovers else aerobatic.READY_S
    until = _assessed_until(done.table.time[assessed], claims.events)
    return Bounds(*_hidden(done, steps, case.hovers), float(assessed.sum() * done.table.dt), until, blind_s)


def conclude(case: Case, claims: Claims, known: Bounds, air: Spans) -> Answer:
    """The answer. air: the flights that it is about."""
    done, doubts = case.estimated, claims.doubts
    trends = health.trends(done.out, done.table, case.B, claims.before) if done is not None and case.hovers and not doubts else ()
    missing = tuple(g for g in case.missing if g.lasts and air[-1][0] <= g.start <= air[-1][1])
    seen = conclusion.Evidence(
        claims.events, case.B.shape[1], known.hidden, known.pair, known.assessed_s, claims.open, places.names(case.vehicle.rotors), air,
        trends, case.hovers and "whole_flight" not in claims.facts, missing, case.matters, assessed_until=known.assessed_until,
        blind_s=known.blind_s, settings=settings.advice(case.flight) if done is not None else "",
    )  # fmt: skip
    if done is not None:
        seen = _explained(case, seen, doubts)
    evidence = tuple(seen.unexplained_evidence)
    return Answer(conclusion.conclude(seen, doubts), doubts, evidence, claims.facts, claims.assumptions, claims.warnings)


def _explained(case: Case, seen: conclusion.Evidence, doubts: Sequence[str]) -> conclusion.Evidence:
    """The same with the reason why no more of a log could be assessed."""
    table, air, hovers = case.table, case.air, case.hovers
    assert table is not None and case.unseen is not None and seen.hidden is not None
    short = seen.assessed_s < conclusion.LEAST_S or seen.vague
    if hovers and (shaken := unassessed.shaken(case.flight, air)) is not None:
        return seen._replace(hidden=None, unassessed=shaken)
    if not doubts and not short and seen.patchy:
        return seen._replace(unassessed=unassessed.patchy(air, table, hovers))
    if not doubts and short:
        stepped, needed = bool(np.max(case.unseen.losses()) >= np.max(seen.hidden)), seen.blind_s + conclusion.LEAST_S
        return seen._replace(unassessed=unassessed.find(air, table, seen.assessed_s, needed, hovers, conclusion.LEAST_S, stepped))
    return seen


def of_no_flight(case: Case, claims: Claims) -> Answer:
    """The answer to a log without ticks."""
    n, never = case.B.shape[1], sorted({rotor for gap in case.missing for rotor in gap.rotors})
    why = _unflown(case, never)
    seen = conclusion.Evidence(
        claims.events, n, places=places.names(case.vehicle.rotors), hops=case.air, unassessed=why, settings=settings.advice(case.flight)
    )
    wrong = any(e.means.wrong for e in claims.events)
    return Answer(conclusion.conclude(seen), () if wrong else (why.why,))


def _unflown(case: Case, never: Sequence[int]) -> Unassessed:
    """Why there are no ticks. never: rotors without a command."""
    if case.flight.has("motors") and case.flight.angular_rate() is None:
        return unassessed.MOTIONLESS
    if case.air:
        return unassessed.silent(f"no command for {wording.rotors(never)}" if never else "too few motor outputs")
    return unassessed.NEVER if case.flight.has("motors") else unassessed.SILENT


def _assessed_until(assessed: np.ndarray, found: Sequence[Event]) -> float:
    """The last evaluated time [s], of ticks at these times: a disturbance that lasts to the end masks a loss."""
    pushed = (e.onset_s for e in found if e.kind == CONTACT and e.end_s is None)
    return min([float(assessed[-1]) if assessed.size else np.inf, *pushed])


def _hidden(done: Estimated, steps: unseen.Unseen, hovers: bool) -> tuple[np.ndarray, float]:
    """(n,) largest undetectable loss of each rotor: too small to be measured, or absorbed as a disturbance; and the same of two opposite
    rotors."""
    out, assessed = done.out, done.table.mode == ASSESS
    if not assessed.any():
        return np.ones(out.theta.shape[1]), 1.0
    if not hovers:  # its bound covers all blocks so far; two opposite rotors at once are not tested
        return np.minimum(1.0, WITHIN_95 * out.detectable[assessed][-1]), 0.0
    measured = WITHIN_95 * median(out.detectable[assessed], axis=0)
    single = np.minimum(1.0, np.maximum(measured, steps.losses()))
    return single, min(1.0, steps.pair(event_rows.opposites(steps.B)))
