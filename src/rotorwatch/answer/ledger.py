"""The ledger: all that is claimed of a flight, and the one rule that makes events of the claims.

A claim is an event with its source, handed in by whoever testifies. They are merged in the order of the data: what the estimator
announced, with what excitations say of it; what hindsight saw of the blind time; outputs that left the mixer; contacts; losses of control.
ESC telemetry and desyncs are heard last, and know the events by then. A link and a log are merged by the same rule, and say the same.

    what claims it        is not said where
    estimator             hindsight tells of the same rotor since before (then the later claim is the rest of it); an output was overridden
                          as it began; or it may be nothing and is said of one set of rotors alone (then it stays as evidence)
    outputs               it began in the fall that ends a flight
    contacts              it is the landing
    any, of rotors        a loss of control, judged by all that was logged up to the impact, shows another one (witnesses/upset/find.py)
    ESC: a rotor stands   a lasting fault names the rotor since, or soon after
    ESC: its speed fell   a loss names the rotor
    desync                control is lost by then, or the rotor had lost most of its thrust
    trim                  a fault is told beside it: what a weak rotor does to yaw is not known well
    setup                 a fault, a turned mount, a loss of control or evidence against a rotor explains what outputs do from then on
                          (`undisturbed`)
    all that rests on     the log, or the link, contradicts itself
    outputs

Claims that are no events of their own (kinds of weight OPEN) are heard after all events:

    evidence of           is not told where
    the trim              something wrong is an event
    its steps             the same, or the trim's evidence is told
    the estimator         the trim's evidence, or its steps', is told: they are of all of the flight
    healthy flights       a fault in flight is certain: the mean of a whole flight cannot show what was there before
    healthy vehicles      the same, or there are healthy flights of this one
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rotorwatch.answer import falls, slow
from rotorwatch.answer.trim import Growth
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.front import whole
from rotorwatch.engine.host.events import HINDSIGHT, Report, accuses, packed, shared, unexplained
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import EVIDENCE, LOSS, ORDER, OVERRIDE, TURNED, Weight

if TYPE_CHECKING:
    from rotorwatch.witnesses.upset.find import Judged


class Merged(NamedTuple):
    """events: what is said; faint: losses that accuse no rotor, which are evidence; shared: outputs that left the mixer together."""

    events: tuple[Event, ...]
    faint: tuple[Event, ...]
    shared: tuple[Event, ...] = ()


def merge(
    claims: Sequence[Event],
    report: Report,
    upsets: Sequence[Judged],
    n: int,
    grown: Growth | None = None,
) -> Merged:
    """The events of a flight of n rotors, in the order in which they were detected. claims: of any kind; report: its falls and contacts;
    upsets: its losses of control; grown: what the trim of the whole flight shows."""
    losses = [c for c in claims if c.means.weakens and not explained(c, claims)]
    losses.sort(key=lambda c: (c.detected_s, c.source.name == HINDSIGHT))
    losses = slow.join(losses, grown)
    outputs = [c for c in claims if c.kind == OVERRIDE]
    known, together = report.events(losses, outputs), tuple(filter(shared, outputs))
    open_ = unexplained(losses, [*(e for e in known if e.kind == OVERRIDE), *together])
    others = [c for c in claims if not c.means.weakens and c.kind != OVERRIDE]
    found = falls.events(upsets, joined(known, others), n)
    return Merged(found, tuple(e for e in open_ if not accuses(e)), together)


def joined(known: Iterable[Event], claims: Iterable[Event]) -> tuple[Event, ...]:
    """What is known with the claims that it does not explain, in the order in which they were detected."""
    known = tuple(known)
    return tuple(sorted((*known, *(c for c in claims if not explained(c, known))), key=lambda e: e.detected_s))


def explained(claim: Event, known: Iterable[Event]) -> bool:
    """Whether something that is known explains a claim, so that it is not reported again."""
    rule = claim.source.explained
    return rule is not None and any(rule(claim, other) for other in known)


def undisturbed(known: Iterable[Event], claims: Iterable[Event] = ()) -> float:
    """Until when nothing that is known, no evidence against a rotor and no damage from take-off explains what outputs do, so that they show
    how the vehicle is set up [s]. claims: those that are no events."""
    explain = [e.onset_s for e in known if e.means.wrong or e.kind == TURNED]
    explain += [c.onset_s for c in claims if c.kind == EVIDENCE or c.extra["verdict"] == "fault"]
    return min(explain, default=np.inf)


def believed(events: Iterable[Event], until: float = np.inf) -> tuple[Event, ...]:
    """The events of a log or a link that contradicts itself up to `until` s, without those that rest on its outputs."""
    return tuple(e for e in events if e.onset_s > until or not e.means.by_outputs)


def open_claims(claims: Iterable[Event], events: Sequence[Event]) -> tuple[Event, ...]:
    """Of claims of weight OPEN those that neither events nor a claim before them explains."""
    told: list[Event] = []
    for claim in sorted(claims, key=lambda c: c.source.rank):
        if not explained(claim, (*events, *told)):
            told.append(claim)
    return tuple(sorted(told, key=lambda c: c.onset_s))


def main_event(events: Sequence[Event]) -> int | None:
    """Index of the event that matters: sure ones before ambiguous ones; the first that is large, or an override that came before it
    (one that comes after is what a falling vehicle's controller does); of losses that began together the largest. Motors in the wrong
    order come before all, for nothing can follow its command then. Where no rotor is accused, what upset the vehicle."""
    swapped = next((i for i, e in enumerate(events) if e.kind == ORDER and not e.alternatives), None)
    if swapped is not None:
        return swapped
    order = [i for i, e in enumerate(events) if e.means.accuses]
    named = [replace(events[i], kind=LOSS if events[i].means.weakens else OVERRIDE) for i in order]
    place = ENGINE.call(whole.most_important, packed(named), len(named))
    upsets = (i for i, e in enumerate(events) if e.means.weight is Weight.UPSET)
    return order[place] if place >= 0 else next(upsets, None)
