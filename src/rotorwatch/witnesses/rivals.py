"""Losses compared with their rivals: what becomes of claims when the flight is over.

The estimator announces a loss as soon as it is likelier than what it has seen of this flight's disturbances. After the flight more is
known: the motion that followed. comparing.py weighs a claim against what else explains it, odds.py decides what becomes of it, ends.py
decides whether it was over before; remainder.py, the scan and a rotor out of balance add claims that nobody announced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rotorwatch.answer.wording import rotors
from rotorwatch.engine.bindings import event_rows, unexplained_evidence
from rotorwatch.engine.bindings.explaining import lagged
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.tick_table import ASSESS
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import EVIDENCE, LOSS, LOST, SLOW_RESPONSE, UNBALANCED, Kind, Weight, Words, register
from rotorwatch.flight.kinds import Span as Lasting
from rotorwatch.witnesses import remainder
from rotorwatch.witnesses.comparing import AFTER_S, LATES_S, SHORTEST_S, missing, weigh
from rotorwatch.witnesses.ends import lasting, recovered
from rotorwatch.witnesses.odds import SCAN, Decision, Weighed, stated
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
FAINT = 0.16  # of a loss: the least lower bound of its interval, 1 - 1.96 / 2.33
LANDED_S = 1.0  # of the log after motion that could refute a loss
FALL_S = 4.0  # before a loss of control: what follows is the fall
COMPARED = "compared"  # in View.facts: all comparisons of the flight
# Of the scan: evidence beyond any other rotor's, twice in nats; by which the onset's may be lower; lag; least information.
SUSPECTS, LATELY, SLOWS_S, INFORMATION = 60.0, 15.0, 0.1, 20.0


def _hear(view: View, events: Events) -> Events:
    """The events and, in `view.open`, the open claims, as the comparison leaves them."""
    if not (view.hovers and view.default) or view.learned is None or view.table is None:
        return events
    events = tuple(recovered(view, e, events) for e in events)
    events = tuple(lasting(view, e, events) for e in events)
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
    if decision is Decision.OPEN or _faint(event):
        suspected = event if found.claim > 0.5 else _named(event, found)
        return [], [_opened(suspected, stated(found.claim * (1.0 - found.common)))]
    return [_named(event, found)], []


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
    """True for a loss that is not above 0 with 99 %, by its interval of 95 %: loss - low > 1.96 / 2.33 loss. One with alternatives is not
    certain anyway, and the interval is so wide because of them."""
    return not event.alternatives and any(low < FAINT * loss for loss, (low, _) in zip(event.loss, event.interval))


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
    for c in remainder.claims(view, known, missing(view.clear, known)):
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
