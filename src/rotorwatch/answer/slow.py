"""Losses that grow slowly, and losses that were announced as over but last, by the trim of a whole flight: merged with the others."""

from __future__ import annotations

from collections.abc import Sequence

from rotorwatch.answer.drift import Growth
from rotorwatch.engine.bindings import unexplained_evidence
from rotorwatch.engine.bindings.event_rows import TRIM, packed
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.drift import many
from rotorwatch.engine.events.events import GREW, STAYS
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS


def join(losses: Sequence[Event], grown: Growth | None) -> tuple[Event, ...]:
    """The losses of a flight with the one that the trim shows, if it is certain (`engine.drift.outcome.Growth.join`)."""
    if grown is None or not grown.certain:
        return tuple(losses)
    room = len(losses) + 1
    rows = packed(losses, room)
    count = ENGINE.call(many.with_growth, grown.rows, rows, len(losses), room)
    names, events = ("detail", "source", "onset", "detected"), []
    for detail, source, *times in zip(*(rows[name][:count].tolist() for name in names)):
        new = detail in (GREW, STAYS)
        events.append(_event(grown, detail == GREW, losses[source] if source >= 0 else None, *times) if new else losses[source])
    return tuple(events)


def _event(grown: Growth, grew: bool, first: Event | None, onset: float, detected: float) -> Event:
    """The event of a loss that grew, or lasts. first: the first one that it replaces."""
    (rotor,), (size,) = grown.rotors, grown.loss
    reason = (
        f"the commanded torque gradually departed from the motion, along the direction of rotor {rotor} and by more than wind or load drift"
    )
    if first is not None and not grew:
        reason = f"{first.reason}; its apparent end did not change the trim"
    return Event(
        LOSS, grown.rotors, onset, detected, None, (size,), grown.interval, grown.odds / (1.0 + grown.odds), (), reason,
        {"live": first is not None, "loss_2s": [round(size, 4)], **({"grew_until_s": grown.end_s} if grew else {})},
    )  # fmt: skip


def suspected(grown: Growth | None) -> tuple[Event, ...]:
    """Evidence against the rotors of a loss that seems to have grown."""
    if grown is None or not grown.grew:
        return ()
    share = grown.odds / (1.0 + grown.odds)
    who = grown.rotors, grown.start_s, grown.looked_s, grown.interval
    return (unexplained_evidence.claim(*who, probability=share, source=TRIM),)
