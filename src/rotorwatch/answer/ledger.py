"""The ledger: all claims on a flight, and the one rule that makes events of them.

A claim is an event with its source, from any witness module. Claims are merged in the order of the data: announcements of the estimator,
updated by excitations; hindsight on the blind time; outputs that left the mixer; contacts; losses of control. ESC telemetry and desyncs
come last, with the events by then. A link and a log are merged by the same rule, with the same result.

    claim by              is dropped where
    estimator             hindsight finds the same rotor earlier (the later claim is then the rest of it); an output was overridden
                          as it began; or it may be nothing and names one set of rotors alone (then it stays as evidence)
    outputs               it began in the fall that ends a flight
    contacts              it is the landing
    any, of rotors        a loss of control, with all data up to the impact, shows another one (witnesses/upset/find.py)
    ESC: stopped rotor    a lasting fault names the rotor since, or soon after
    ESC: its speed fell   a loss names the rotor
    desync                control is lost by then, or the rotor had lost most of its thrust
    trim                  a fault is an event as well: the effect of a weak rotor on yaw is not known well
    setup                 a fault, a turned mount, a loss of control or evidence against a rotor explains the outputs from then on
                          (`undisturbed`)
    all that rests on     the log, or the link, contradicts itself
    outputs

Claims that are no events of their own (kinds of weight OPEN) are merged after all events:

    evidence of           is dropped where
    the trim              a fault is an event
    its steps             the same, or the trim's evidence is kept
    the estimator         the trim's evidence, or its steps', is kept: they use all of the flight
    healthy flights       a fault in flight is certain: the mean of a whole flight cannot show what was there before
    healthy vehicles      the same, or there are healthy flights of this one
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rotorwatch.answer import falls, slow
from rotorwatch.answer.drift import Growth
from rotorwatch.engine.bindings.event_rows import HINDSIGHT, Report, packed, shared
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.events import calls
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import EVIDENCE, LOSS, ORDER, OVERRIDE, TURNED, Weight

if TYPE_CHECKING:
    from rotorwatch.witnesses.upset.find import Assessed


class Merged(NamedTuple):
    """events: the answer's; shared: outputs that left the mixer together."""

    events: tuple[Event, ...]
    shared: tuple[Event, ...] = ()


def merge(claims: Sequence[Event], report: Report, upsets: Sequence[Assessed], n: int, grown: Growth | None = None) -> Merged:
    """The events of a flight of n rotors, in order of detection. claims: of any kind; report: its falls and contacts; upsets: its losses of
    control; grown: the growth by the trim of the whole flight."""
    losses = [c for c in claims if c.means.weakens and not explained(c, claims)]
    losses.sort(key=lambda c: (c.detected_s, c.source.name == HINDSIGHT))
    losses = slow.join(losses, grown)
    outputs = [c for c in claims if c.kind == OVERRIDE]
    known, together = report.events(losses, outputs), tuple(filter(shared, outputs))
    others = [c for c in claims if not c.means.weakens and c.kind != OVERRIDE]
    return Merged(falls.events(upsets, joined(known, others), n), together)


def joined(known: Iterable[Event], claims: Iterable[Event]) -> tuple[Event, ...]:
    """The events and the claims that they do not explain, in order of detection."""
    known = tuple(known)
    return tuple(sorted((*known, *(c for c in claims if not explained(c, known))), key=lambda e: e.detected_s))


def explained(claim: Event, known: Iterable[Event]) -> bool:
    """Whether something that is known explains a claim, so that it is not reported again."""
    rule = claim.source.explained
    return rule is not None and any(rule(claim, other) for other in known)


def undisturbed(known: Iterable[Event], claims: Iterable[Event] = ()) -> float:
    """Time [s] until which no event, no evidence against a rotor and no damage from take-off explains the outputs, so that they show the
    vehicle's setup. claims: those that are no events."""
    explain = [e.onset_s for e in known if e.means.wrong or e.kind == TURNED]
    explain += [c.onset_s for c in claims if c.kind == EVIDENCE or c.extra["verdict"] == "fault"]
    return min(explain, default=np.inf)


def believed(events: Iterable[Event], until: float = np.inf) -> tuple[Event, ...]:
    """The events of a log or a link that contradicts itself up to `until` s, without those that rest on its outputs."""
    return tuple(e for e in events if e.onset_s > until or not e.means.by_outputs)


def open_claims(claims: Iterable[Event], events: Sequence[Event]) -> tuple[Event, ...]:
    """The claims of weight OPEN that neither events nor an earlier claim explain."""
    kept: list[Event] = []
    for claim in sorted(claims, key=lambda c: c.source.rank):
        if not explained(claim, (*events, *kept)):
            kept.append(claim)
    return tuple(sorted(kept, key=lambda c: c.onset_s))


def main_event(events: Sequence[Event]) -> int | None:
    """Index of the main event: certain ones before ambiguous ones; the first large one, or an override that came before it (a later one is
    the controller's reaction to the fall); of losses that began together the largest. Motors in the wrong order come before all, as nothing
    can follow its command then. Where no rotor is at fault, the cause of the upset."""
    swapped = next((i for i, e in enumerate(events) if e.kind == ORDER and not e.alternatives), None)
    if swapped is not None:
        return swapped
    order = [i for i, e in enumerate(events) if e.means.accuses]
    named = [replace(events[i], kind=LOSS if events[i].means.weakens else OVERRIDE) for i in order]
    place = ENGINE.call(calls.most_important, packed(named), len(named))
    upsets = (i for i, e in enumerate(events) if e.means.weight is Weight.UPSET)
    return order[place] if place >= 0 else next(upsets, None)
