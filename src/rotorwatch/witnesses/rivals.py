"""Losses compared with their rivals: nothing, wind, the ground, a slow motor, another rotor.

The estimator announces a loss as soon as it is likelier than what it has seen of this flight's disturbances. After the flight more is
known: the motion that followed. A loss must predict it, on all axes, as well as the healthy model predicted the motion before; wind, a
knock, the ground or a tether need not have the direction of a rotor, nor follow its command. odds.py has the weights of the explanations,
and decides what becomes of a claim. Before that, a loss that is said to be over lasts where the motion after its end is explained better
with the loss than without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rotorwatch.answer.wording import rotors
from rotorwatch.base.arrays import quantile
from rotorwatch.engine.bindings import event_rows, unexplained_evidence
from rotorwatch.engine.bindings.explaining import Explanation, Fit, Span, compare, lagged, span
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator.hypotheses import CLEAR as CLEAR_NATS
from rotorwatch.engine.estimator.plant import ANSWER_S
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import EVIDENCE, LOSS, LOST, SLOW_RESPONSE, UNBALANCED, Kind, Weight, Words, register
from rotorwatch.flight.kinds import Span as Lasting
from rotorwatch.witnesses import pushes, remainder
from rotorwatch.witnesses.odds import COMMON, SCAN, TEMPER, WEIGHTS, Comparison, Decision, Rival, Weighed, group, row, stated
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

register(
    Kind(
        18, SLOW_RESPONSE, "slow motor response", "a motor follows its commands later than the others", Weight.FAULT, Lasting.LASTS,
        impairs=True, brief="slow response",
        headline=Words("{who} has followed its commands too slowly since {at}{again}."),
        now=Words("slow since {at}"), past=Words("was slow from {at} to {end}"),
        advice=Words(
            "Do not fly again until {who} has been inspected: motor bearing and windings, ESC timing, a propeller too large or heavy, and "
            "the connectors between them."
        ),
    )
)  # fmt: skip
SOURCE, HEARD = Source(SCAN, 3), Source("balance", 3)
BEFORE_S, AFTER_S, OVER_S = 10.0, 20.0, 8.0  # s of the comparison: before the onset; after the detection, or the growth; after the end
SHORTEST_S, BRIEF_S = 3.0, 1.0  # of motion after the onset; of a loss that is over
MARGIN_S = 1.0  # about an end: it is known no better, and rotors may recover in some tenths of a second
FAINT = 0.16  # of a loss: the least lower bound of its interval, 1 - 1.96 / 2.33
LANDED_S = 1.0  # of the log after motion that could refute a loss
FALL_S = 4.0  # before a loss of control: what follows is the fall
FALLING_S, LEAST_S = 1.0, 0.2  # from then on, motion that tells rotors apart; the least
COMPARED = "compared"  # in View.facts: all comparisons of the flight
PUSH = Rival("push", Explanation(push=0.5, step=1.0))
# What else moves a vehicle: a step of the trim, in standard deviations of this flight's disturbances; one that grows with the thrust, as by
# a load that shifts; a centre of mass that moves: a drift of roll and pitch [hover thrusts per sqrt(s)], which grows with the thrust, and
# its lever in a side force; and a free wrench, as a factor of the disturbances.
ELSE = (
    *(Rival(f"step {step:g}", Explanation(step=step)) for step in (1.0, 4.0)),
    PUSH,
    Rival("push grows", Explanation(push=0.5, step=1.0, swells=0.07)),
    Rival("shift", Explanation(step=1.0, load=1.0)),
    *(Rival(f"move {x:g}, lever {y:g}", Explanation(drift=x, lever=y, load=1.0)) for x in (0.01, 0.04) for y in (0.0, 14.0)),
    Rival("wrench 3", Explanation(step=1.0, force=3.0)),
)  # fmt: skip
PASSED = " passes"  # of a push that is over
COMPANIONS = 2  # of these, the likeliest ones, that are tried beside the loss
TURNS = 2.0  # yaw by a turned mount, of that by the rotor's own torque
GROWS = 0.02  # of a loss that grows, 1 per sqrt(s)
GIVES = 2.0  # of a rotor that is stuck: standard deviation of its thrust, hover thrusts
CAP = 0.75  # quantile of a rotor's commands that may be its cap
LATES_S = (0.08, 0.2)  # of a slow motor
# Of the scan: evidence beyond any other rotor's, twice in nats; by which the onset's may be lower; lag; least information.
SUSPECTS, LATELY, SLOWS_S, INFORMATION = 60.0, 15.0, 0.1, 20.0
LAGS_S = (0.0, 0.03, 0.06, 0.12)  # of all motors, beyond the lag that the ticks assume


def rivals(n: int, claim: tuple[int, ...], end_s: float, pushed_s: float = np.inf, cap: float = 0.0) -> list[Rival]:
    """The explanations of a change that is over at end_s, or at pushed_s if it was a push, of n rotors. claim: rotors, from 0, that the
    change is said to be a loss of: it comes first; cap: thrust that may be the most that they give [hover thrusts], 0: none."""
    rest = [Rival("nothing", Explanation()), *ELSE]
    rest += [Rival(PUSH.name + PASSED, PUSH.how._replace(end_s=pushed_s))] if pushed_s < np.inf else []
    rest += [Rival(f"slow {late:g} s", Explanation((i,), end_s, late=late)) for i in range(n) for late in LATES_S]
    rest += [Rival("turned", Explanation((i,), end_s, turned=TURNS)) for i in range(n)]
    rest += [Rival(COMMON, Explanation(tuple(range(n)), end_s, grows=GROWS))]
    singles = [one for i in range(n) if (i,) != claim for one in _losses((i,), end_s)]
    if not claim:
        return [*rest, *singles]
    own = _losses(claim, end_s)
    own += [Rival("capped", Explanation(claim, end_s, cap=cap))] if cap else []
    return [*own, *rest, *singles]


def _losses(who: tuple[int, ...], end_s: float) -> list[Rival]:
    """A loss of these rotors: at once, growing, or of their commands' effect."""
    return [
        Rival("loss", Explanation(who, end_s)), Rival("growing loss", Explanation(who, end_s, grows=GROWS)),
        Rival("stuck", Explanation(who, end_s, gives=GIVES)),
    ]  # fmt: skip


def beside(n: int, claim: tuple[int, ...], end_s: float, them: Sequence[Rival], logs: np.ndarray) -> list[Rival]:
    """The loss together with the likeliest of what else moves the vehicle; and so the likeliest slow rotor or turned mount, and a loss of
    each other rotor of n: what else moves a vehicle has more freedom than its model, of which any rotor's loss takes a part. A step beside
    a loss does not give its thrust back: else two rotors that lost two thirds each explain a mount that turned."""
    evidence = {r.name: x for r, x in zip(them, logs)}
    likely = sorted((k for k, r in enumerate(them) if r in ELSE), key=lambda k: -max(logs[k], evidence.get(them[k].name + PASSED, -np.inf)))
    likely = likely[:COMPANIONS]
    odd = them[max((k for k, r in enumerate(them) if r.how.late or r.how.turned), key=lambda k: logs[k])]
    own = [Rival("loss", them[k].how._replace(rotors=claim, end_s=end_s, lifts=False), them[k].name) for k in likely]
    # Theirs last: an end would open the trim once more, as no disturbance alone does.
    others = [i for i in range(n) if (i,) != claim]
    own += [Rival("loss", them[k].how._replace(rotors=(i,), lifts=False), them[k].name) for i in others for k in likely]
    same = {name: getattr(odd.how, name) for name in ("rotors", "end_s", "late", "turned")}
    return [*own, *(Rival(odd.name, them[k].how._replace(**same), them[k].name) for k in likely)]


def weigh(view: View, event: Event, events: Sequence[Event], named: bool = True, fall_s: float | None = None) -> Comparison | None:
    """A loss compared with its rivals; None where too little follows it to tell. events: all of the flight; named: the event's rotors are
    claimed, else any one may be; fall_s: time of a loss of control that follows at once."""
    assert view.learned is not None
    claim = tuple(r - 1 for r in event.rotors) if named else ()
    end_s = np.inf if event.end_s is None or not named else event.end_s
    where = _span(view, event, events, named, end_s, fall_s)
    if where is None:
        return None
    cap = quantile(where.ticks.thrust[where.onset :, list(claim)].max(axis=1), CAP) if claim else 0.0
    side = pushes.SideForce(where)
    shoves = side.shove(float(where.ticks.command_time[where.onset])), side.shove(end_s)
    pushed_s = end_s if end_s < np.inf else side.end_s()
    where = replace(where, ends=(end_s, pushed_s))
    them = rivals(view.B.shape[1], claim, end_s, pushed_s, cap)
    also = [tuple(r - 1 for r in who) for who in event.alternatives] if named else []
    them += [Rival("loss", Explanation(who, end_s)) for who in also if len(who) > 1]
    fits, said = _fitted(where, them, end_s, shoves), tuple(map(float, view.said(event.onset_s)))

    def compared() -> Comparison:
        return Comparison(
            event.onset_s, event.rotors, named, event.alternatives if named else (), event.source.name, "grew_until_s" in event.extra,
            view.B.shape[1], tuple(map(row, them, fits)), said,
        )  # fmt: skip

    if claim:
        more = beside(view.B.shape[1], claim, end_s, them, compared().logs())
        fits += _fitted(where, [them[0], *more], end_s, shoves)[1:]
        them += more
    return compared()


def _fitted(where: Span, them: Sequence[Rival], end_s: float, shoves: tuple[pushes.Shove, pushes.Shove]) -> list[Fit]:
    """The fit of each explanation, with what the side force says of a push that begins, or ends with the change at end_s. shoves: its
    steps then."""
    begins, ends = shoves
    lift = where.B.shape[1] * begins.lift
    fits = compare(where, [r.how._replace(lift=lift) if r.how.push else r.how for r in them])
    both = begins.log_odds + ends.log_odds
    said = [0.0 if not r.how.push or r.how.swells else both if r.how.end_s == end_s else begins.log_odds for r in them]
    return [fit._replace(log_p=fit.log_p + more) for fit, more in zip(fits, said)]


def _span(view: View, event: Event, events: Sequence[Event], named: bool, end_s: float, fall_s: float | None) -> Span | None:
    """The ticks that tell of an event that is over at end_s, or None where they are too few."""
    table, learned = view.clear, view.learned
    assert table is not None and learned is not None
    begun = event.extra.get("grew_until_s", event.detected_s) if named else event.onset_s
    # Up to the next loss, unless that leaves too little.
    others = [e.onset_s for e in events if e.kind == LOSS and e.onset_s > begun + SHORTEST_S and not set(e.rotors) & set(event.rotors)]
    again = [e.onset_s for e in events if e.kind == LOSS and e.onset_s > end_s and set(e.rotors) & set(event.rotors)]
    until = begun + AFTER_S if fall_s is None else max(begun, fall_s) + FALLING_S
    until = min([until, end_s + OVER_S, *others, *again])
    where = span(table, view.B, learned, event.onset_s, BEFORE_S, until, _missing(table, events, event.rotors))
    least, brief = (SHORTEST_S, BRIEF_S) if fall_s is None else (LEAST_S, LEAST_S)
    if where.ticks.valid[where.onset :].any(axis=1).sum() * table.dt < least or min(end_s, until) - event.onset_s < brief:
        return None
    return _in_time(where)


def _in_time(where: Span) -> Span:
    """The span with its commands delayed by the lag of all motors that explains the motion before the change best."""
    early = replace(where, onset=round(1.0 / where.ticks.dt))
    before = [early] + [replace(early, ticks=lagged(where.ticks, where.B, lag)) for lag in LAGS_S[1:]]
    before = [replace(s, y=s.y + s.ticks.wrench - where.ticks.wrench) for s in before]
    fits = [compare(replace(s, ticks=s.ticks.part(slice(0, where.onset)), y=s.y[: where.onset]), [Explanation()])[0].log_p for s in before]
    return replace(before[int(np.argmax(fits))], onset=where.onset)


def _missing(table: Ticks, events: Sequence[Event], but: Sequence[int] = ()) -> np.ndarray:
    """(T, n) thrust that losses take at the ticks, without those of some rotors, from 1."""
    lost = np.zeros_like(table.thrust)
    for e in events:
        if e.kind != LOSS or e.alternatives or set(e.rotors) & set(but):
            continue
        rows = (table.command_time >= e.onset_s) & (table.command_time <= (np.inf if e.end_s is None else e.end_s))
        for rotor, loss in zip(e.rotors, e.loss):
            lost[rows, rotor - 1] = loss
    return lost * table.thrust


def _ended(view: View, event: Event, events: Sequence[Event]) -> Event:
    """The event; without an end where the motion after it has more evidence with the loss than without. The loss takes thrust with ANSWER_S
    of lag: a controller answers gusts by quick commands, which any loss would seem to explain in part. What is within MARGIN_S of the end
    does not count: it would be taken for a change of the trim."""
    if event.kind != LOSS or event.end_s is None or event.alternatives or view.learned is None or view.clear is None:
        return event
    rest, logs, slow = [e for e in events if e is not event], [], lagged(view.clear, view.B, ANSWER_S)
    for reported in (event, replace(event, end_s=None)):
        missing = _missing(slow, [*rest, reported])
        where = span(view.clear, view.B, view.learned, event.end_s, BEFORE_S, event.end_s + OVER_S, missing)
        if (len(where.ticks.time) - where.onset) * view.clear.dt < SHORTEST_S:
            return event
        near = abs(where.ticks.command_time - event.end_s) < MARGIN_S
        where = replace(where, ticks=replace(where.ticks, valid=where.ticks.valid & ~near[:, None]))
        logs.append(compare(where, [Explanation()])[0].log_p)
    return event if logs[0] >= logs[1] else replace(event, end_s=None)


def _over(view: View, event: Event, events: Sequence[Event]) -> Event:
    """The event; one that lasts ends where the estimator took a change for a disturbance, the likeliest fault being its rotor's recovery,
    and the motion after it has more evidence for the end. With the loss, as in `_ended`, something else must have cancelled it: a step of
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
        end_s = float(table.command_time[max(k - round(out.onset[k]), 0)])
        over, reported = replace(event, end_s=end_s), [*rest, event]
        if end_s > event.detected_s and _log_odds(view, end_s, _missing(slow, [*rest, over]), _missing(slow, reported)) > CLEAR_NATS:
            return over
    return event


def _log_odds(view: View, end_s: float, without: np.ndarray, lasting: np.ndarray) -> float:
    """Log-odds of the end of a loss at end_s against a loss that lasts, alone or beside what else moves a vehicle. without, lasting (T, n):
    thrust that losses take then [hover thrusts]."""
    assert view.clear is not None and view.learned is not None
    logs = []
    for rows, missing in (((Rival("loss", Explanation()),), without), ((Rival("nothing", Explanation()), *ELSE), lasting)):
        where = span(view.clear, view.B, view.learned, end_s, BEFORE_S, end_s + OVER_S, missing)
        if (len(where.ticks.time) - where.onset) * view.clear.dt < SHORTEST_S:
            return -np.inf
        fits = compare(where, [r.how for r in rows])
        logs.append(np.logaddexp.reduce([WEIGHTS[group(r.name)] + TEMPER * fit.log_p for r, fit in zip(rows, fits)]))
    return float(logs[0] - logs[1])


def _hear(view: View, events: Events) -> Events:
    """The events and, in `view.open`, the open claims, as the comparison leaves them."""
    if not (view.hovers and view.default) or view.learned is None or view.table is None:
        return events
    events = tuple(_over(view, e, events) for e in events)
    events = tuple(_ended(view, e, events) for e in events)
    kept: list[Event] = []
    open_: list[Event] = []
    for e in events:
        if e.kind == LOSS and any(k.end_s is None and k.kind in (LOSS, SLOW_RESPONSE) and k.rotors == e.rotors for k in kept):
            continue  # an earlier one lasts
        event, claim = _confirmed(view, e, events)
        kept += event
        open_ += claim
    for c in view.open:
        if c.kind != EVIDENCE or not view.stands(c.onset_s):
            event, claim = _settled(view, c, kept)
            kept += event
            open_ += claim
    for c in (*_suspects(view, kept), *_unbalanced(events, kept)):
        kept += _settled(view, c, kept)[0]
    while more := _beside(view, kept):
        kept += more
    doubted = {(e.rotors, e.onset_s): e.alternatives for e in kept if e.kind == LOSS}
    kept = [_or(e, doubted.get((e.rotors, e.onset_s), ())) if e.kind == LOST else e for e in kept]
    view.open = tuple(open_)
    return tuple(sorted(kept, key=lambda e: e.detected_s))


def _weighed(view: View, event: Event, events: Sequence[Event], named: bool) -> tuple[Weighed | None, Decision]:
    """The probabilities and the decision on a claim; the comparison is kept for the answer."""
    compared = weigh(view, event, events, named)
    if compared is None:
        return None, Decision.OPEN
    view.facts.setdefault(COMPARED, []).append(compared)
    found = compared.weighed()
    return found, compared.decided(found)


def _confirmed(view: View, event: Event, events: Events) -> tuple[list[Event], list[Event]]:
    """(the event that a claimed loss turns out to be, the claim where it stays open)."""
    if event.kind != LOSS or view.spins_from(event.onset_s) or "asked" in event.extra:
        return [event], []
    falls = [t for t in view.lost if event.onset_s <= t <= event.detected_s + FALL_S]
    if falls:
        return [_falling(view, event, events, min(falls))], []
    found, decision = _weighed(view, event, events, True)
    if found is None:
        refutable = _total(event) or event.alternatives or not _unreported(view, event)
        return ([event], []) if refutable else ([], [_opened(event, event.probability)])
    if decision is Decision.SLOW:
        return [_slow(event.onset_s, event.detected_s, event.rotors[0], found)], []
    if decision is Decision.DROPPED:
        view.warnings.append(_warning(event))
        return [], []
    doubted = decision is Decision.OPEN or _faint(event)
    return ([], [_opened(event, stated(found.claim * (1.0 - found.common)))]) if doubted else ([_named(event, found)], [])


def _falling(view: View, event: Event, events: Sequence[Event], fall_s: float) -> Event:
    """A loss in which the vehicle departs controlled flight: with another rotor, if its loss is likelier than not. What is left of the
    motion cannot tell a loss from a gust, but rotors from each other."""
    compared = weigh(view, event, events, fall_s=fall_s)
    others = {} if compared is None else compared.weighed().others
    return _or(event, [tuple(i + 1 for i in sorted(who)) for who, p in others.items() if p > 0.5])


def _or(event: Event, them: Sequence[tuple[int, ...]]) -> Event:
    """The event with other sets of rotors, from 1, as alternatives."""
    more = [who for who in them if who not in event.alternatives]
    if not more:
        return event
    reason = f"{event.reason}; the motion that followed is that of a loss of {' or '.join(map(rotors, more))}"
    return replace(event, alternatives=(*event.alternatives, *more), reason=reason)


def _unreported(view: View, event: Event) -> bool:
    """True for a loss that the motion after it could not refute, though the log goes on: it begins just before a landing or a tumble, or is
    over as it begins."""
    if event.end_s is not None and event.end_s <= event.onset_s:
        return True
    assert view.clear is not None
    after = view.clear.valid.any(axis=1) & (view.clear.command_time >= event.onset_s)
    return after.sum() * view.clear.dt < SHORTEST_S and view.flight.duration > event.onset_s + SHORTEST_S + LANDED_S


def _faint(event: Event) -> bool:
    """True for a loss that is not above 0 with 99 %, by its interval of 95 %: loss - low < 2.33 / 1.96 loss."""
    return any(low < FAINT * loss for loss, (low, _) in zip(event.loss, event.interval))


def _total(event: Event) -> bool:
    """True for a loss that may be total: it is seen at once."""
    return any(high >= 1.0 for _, high in event.interval)


def _opened(event: Event, probability: float) -> Event:
    """A loss as an open claim, of all of its suspects."""
    until = event.detected_s if event.end_s is None else max(event.end_s, event.onset_s)
    interval = () if event.alternatives else event.interval
    return unexplained_evidence.claim(tuple(sorted(event.suspects)), event.onset_s, until, interval, probability)


def _settled(view: View, claim: Event, events: Sequence[Event]) -> tuple[list[Event], list[Event]]:
    """(the event that an open claim turns out to be, the claim where it stays open)."""
    if claim.kind != EVIDENCE:
        return [], [claim]
    found, decision = _weighed(view, claim, events, False)
    who = None if found is None else found.likeliest(claim.rotors)
    if found is not None and who is not None and decision is Decision.LOSS:
        event = _event(view, claim, who, found)
        return ([], [claim]) if _faint(event) else ([event], [])
    if found is not None and decision is Decision.SLOW:
        return [_slow(claim.onset_s, claim.onset_s + AFTER_S, int(np.argmax(found.slow)) + 1, found)], []
    return [], [claim] if decision is Decision.OPEN else []


def _suspects(view: View, events: Sequence[Event]) -> list[Event]:
    """A rotor whose quick commands the motion has not followed since some time, and none of the others as much: to be compared.

    With d, the part of a rotor's thrust that is faster than a lag, its share that is missing since tick k has the evidence
    (sum_t B_a d nu_a / S_a)^2 / sum_t (B_a d)^2 / S_a over the innovations nu from k on."""
    table, out, B = view.clear, view.out, view.B
    if out is None or table is None or any(e.means.accuses for e in events):
        return []
    assessed = (table.mode == ASSESS) & table.valid.all(axis=1) & ~table.upset
    quick = table.thrust - lagged(table, B, SLOWS_S).thrust
    weight = assessed[:, None] / out.innovation_var
    score = np.cumsum(((weight * out.innovation) @ B * quick)[::-1], axis=0)[::-1]
    information = np.cumsum((weight @ B**2 * quick**2)[::-1], axis=0)[::-1]
    nats = np.where(information > INFORMATION, score * abs(score) / np.maximum(information, 1e-9), 0.0)
    ahead = nats - np.stack([np.delete(nats, i, axis=1).max(axis=1, initial=0.0) for i in range(B.shape[1])], axis=1)
    rotor = int(np.argmax(ahead.max(axis=0)))
    most = float(ahead[:, rotor].max())
    if most < SUSPECTS:
        return []
    since = np.flatnonzero(ahead[:, rotor] > most - LATELY)[-1]
    onset = float(table.command_time[since])
    return [unexplained_evidence.claim((rotor + 1,), onset, float(table.time[-1]), source=SOURCE)]


def _beside(view: View, events: Sequence[Event]) -> list[Event]:
    """One more loss, or none, in the motion that known losses leave. A stuck rotor lacks no share of what is commanded."""
    known = [e for e in events if e.kind == LOSS]
    if all(e.alternatives for e in known) or any("gives" in e.extra for e in known) or view.clear is None:
        return []
    for c in remainder.claims(view, known, _missing(view.clear, known)):
        falls = any(t - FALL_S <= c.onset_s <= t for t in view.lost)
        if not falls and not view.spins_from(c.onset_s) and (found := _settled(view, c, events)[0]):
            return found
    return []


def _unbalanced(events: Sequence[Event], kept: Sequence[Event]) -> list[Event]:
    """Rotors that became out of balance while no loss of theirs is known: to be compared, too."""
    lost = {r for e in kept if e.kind == LOSS for r in e.suspects}
    return [
        unexplained_evidence.claim(tuple(sorted(e.suspects)), e.onset_s, e.detected_s, source=HEARD)
        for e in events
        if e.kind == UNBALANCED and lost.isdisjoint(e.suspects)
    ]


def _named(event: Event, found: Weighed) -> Event:
    """The event with the rotors that explain the motion nearly as well."""
    more = (who for who in found.near() if who not in event.alternatives)
    return replace(event, alternatives=(*event.alternatives, *more), probability=min(event.probability, found.claim))


def _event(view: View, claim: Event, who: tuple[int, ...], found: Weighed) -> Event:
    """A loss that an open claim has turned out to be."""
    loss = np.clip(found.best[who].loss, 0.0, 1.0)
    sd = event_rows.sd_of(loss, found.best[who].sd, view.B)
    interval = tuple((float(max(0.0, a - WITHIN_95 * b)), float(min(1.0, a + WITHIN_95 * b))) for a, b in zip(loss, sd))
    names = " and ".join(str(i + 1) for i in who)
    reason = (
        f"the motion of the {AFTER_S:.0f} s after {claim.onset_s:.1f} s is that of a vehicle whose rotor {names} lacks thrust, and no "
        "wind, load or other rotor explains it as well"
    )
    extra = {"live": False, "loss_2s": [round(float(x), 4) for x in loss]}
    return Event(
        LOSS, tuple(i + 1 for i in who), claim.onset_s, claim.onset_s + AFTER_S, None, tuple(map(float, loss)), interval, found.others[who],
        (), reason, extra, SOURCE,
    )  # fmt: skip


def _slow(onset_s: float, detected_s: float, rotor: int, found: Weighed) -> Event:
    """A rotor that follows its commands late."""
    reason = (
        f"since {onset_s:.1f} s rotor {rotor} has followed its commands about {LATES_S[0]:.1f} s later than the others: its quick changes "
        "of thrust have come too late"
    )
    extra = {"live": False}
    return Event(SLOW_RESPONSE, (rotor,), onset_s, detected_s, None, (), (), float(found.slow[rotor - 1]), (), reason, extra, SOURCE)


def _warning(loss: Event) -> str:
    who = rotors(loss.rotors)
    return f"At {loss.onset_s:.1f} s {who} seemed to lose thrust, but the motion that followed is explained without it: not counted."


WITNESSES = (Witness("rivals", Stage.COMPARISON, 10, _hear),)
