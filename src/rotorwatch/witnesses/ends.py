"""The end of a loss, by the motion after it: one that is said to be over may last, and one that lasts may be over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rotorwatch.engine.bindings.explaining import Explanation, compare, lagged, span
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator.hypotheses import CLEAR as CLEAR_NATS
from rotorwatch.engine.estimator.plant import ANSWER_S
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses.comparing import BEFORE_S, ELSE, OVER_S, SHORTEST_S, missing
from rotorwatch.witnesses.odds import TEMPER, WEIGHTS, Rival, group
from rotorwatch.witnesses.witness import View

MARGIN_S = 1.0  # about an end: it is known no better, and rotors may recover in some tenths of a second


def lasting(view: View, event: Event, events: Sequence[Event]) -> Event:
    """The event; without an end where the motion after it has more evidence with the loss than without. The loss takes thrust with ANSWER_S
    of lag: a controller answers gusts by quick commands, which any loss would seem to explain in part. What is within MARGIN_S of the end
    does not count: it would be taken for a change of the trim."""
    if event.kind != LOSS or event.end_s is None or event.alternatives or view.learned is None or view.clear is None:
        return event
    rest, logs, slow = [e for e in events if e is not event], [], lagged(view.clear, view.B, ANSWER_S)
    for reported in (event, replace(event, end_s=None)):
        taken = missing(slow, [*rest, reported])
        where = span(view.clear, view.B, view.learned, event.end_s, BEFORE_S, event.end_s + OVER_S, taken)
        if (len(where.ticks.time) - where.onset) * view.clear.dt < SHORTEST_S:
            return event
        near = abs(where.ticks.command_time - event.end_s) < MARGIN_S
        where = replace(where, ticks=replace(where.ticks, valid=where.ticks.valid & ~near[:, None]))
        logs.append(compare(where, [Explanation()])[0].log_p)
    return event if logs[0] >= logs[1] else replace(event, end_s=None)


def recovered(view: View, event: Event, events: Sequence[Event]) -> Event:
    """The event; one that lasts ends where the estimator took a change for a disturbance, the likeliest fault being its rotor's recovery,
    and the motion after it has more evidence for the end. With the loss, as in `lasting`, something else must have cancelled it: a step of
    the trim pays for that by its width."""
    table, out = view.clear, view.out
    if event.kind != LOSS or event.end_s is not None or event.alternatives or len(event.rotors) != 1 or out is None or table is None:
        return event
    changes = np.flatnonzero(out.announced & (table.time > event.detected_s))
    if not changes.size:
        return event
    known, rest, slow = list_hypotheses(view.B.shape[1]), [e for e in events if e is not event], lagged(table, view.B, ANSWER_S)
    recovery = next(h for h, who in enumerate(known.rotors) if known.kinds[h] == "recovery" and who == (event.rotors[0] - 1,))
    for k in changes[np.where(known.fault, out.log_odds[changes], -np.inf).argmax(axis=1) == recovery]:
        end_s = view.began(out, k)
        over, reported = replace(event, end_s=end_s), [*rest, event]
        if end_s > event.detected_s and _log_odds(view, end_s, missing(slow, [*rest, over]), missing(slow, reported)) > CLEAR_NATS:
            return over
    return event


def _log_odds(view: View, end_s: float, without: np.ndarray, lasting: np.ndarray) -> float:
    """Log-odds of the end of a loss at end_s against a loss that lasts, alone or beside what else moves a vehicle. without, lasting (T, n):
    thrust that losses take then [hover thrusts]."""
    assert view.clear is not None and view.learned is not None
    logs = []
    for rows, taken in (((Rival("loss", Explanation()),), without), ((Rival("nothing", Explanation()), *ELSE), lasting)):
        where = span(view.clear, view.B, view.learned, end_s, BEFORE_S, end_s + OVER_S, taken)
        if (len(where.ticks.time) - where.onset) * view.clear.dt < SHORTEST_S:
            return -np.inf
        fits = compare(where, [r.how for r in rows])
        logs.append(np.logaddexp.reduce([WEIGHTS[group(r.name)] + TEMPER * fit.log_p for r, fit in zip(rows, fits)]))
    return float(logs[0] - logs[1])
