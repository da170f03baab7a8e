"""Events that need no estimator: outputs that do not follow the mixer, and knocks from outside the vehicle."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rotorwatch.diagnosis import Event
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.motion import departures
from rotorwatch.motion.contact import Contact
from rotorwatch.motion.ticks import Ticks

TOUCH_DOWN_S = 1.0  # a contact so near the end of a flight is the landing, or the crash


def overrides(flight: Flight, vehicle: Vehicle, air, table: Ticks) -> tuple[Event, ...]:
    """Outputs that do not follow the mixer; none that parts from it only once the vehicle tumbles: by then mixers, failsafes and pilots
    do what they can."""
    return as_events(departures.overrides(flight, vehicle, air), falls(table, air))


def as_events(found: Iterable[departures.Override], fallen) -> tuple[Event, ...]:
    """The overrides that do not begin in a fall, as events."""
    return tuple(
        Event(
            "output_override", (o.rotor,), o.onset, o.detected, o.end, (), (), 1.0, (), o.reason, {"override": o.kind}
        )
        for o in found
        if not any(start < o.onset <= end for start, end in fallen)
    )


def falls(table: Ticks, air) -> tuple[tuple[float, float], ...]:
    """For each flight that ends in a fall: from when the vehicle tumbles, to the end."""
    return falls_in(table.time, table.upset, table.dt, air)


def falls_in(time: np.ndarray, upset: np.ndarray, dt: float, air) -> tuple[tuple[float, float], ...]:
    """The same of ticks at `time` (T,) s, `upset` (T,) bool or not."""
    spans = []
    for start, end in air:
        inside = np.flatnonzero((time >= start) & (time <= end + dt))
        if inside.size and upset[inside[-1]]:
            calm = inside[~upset[inside]]
            begin = inside[inside > calm[-1]][0] if calm.size else inside[0]
            spans.append((float(time[begin]), end))
    return tuple(spans)


def explains(overridden: tuple[Event, ...], event: Event) -> bool:
    """Does a loss begin while an output is overridden? Then it is the override, or what that does to the others."""
    return any(o.onset_s - 1.0 <= event.onset_s <= (np.inf if o.end_s is None else o.end_s) + 1.0 for o in overridden)


def unexplained(losses: Iterable[Event], overridden: tuple[Event, ...]) -> tuple[Event, ...]:
    """The losses that no overridden output explains."""
    return tuple(e for e in losses if not explains(overridden, e))


def contacts(table: Ticks, air) -> tuple[Event, ...]:
    """Knocks in flight; one that ends it is the landing, or the crash."""
    return contacts_in(table.contacts, air)


def contacts_in(found: Iterable[Contact], air) -> tuple[Event, ...]:
    """The same of contacts that were found."""
    return tuple(
        Event(
            "contact", (), c.time, c.time, c.time, (), (), 1.0, (),
            f"something outside the vehicle {c.what}, by {c.size:.1f} {c.unit}", {"size": c.size, "unit": c.unit},
        )
        for c in found
        if not any(abs(c.time - end) < TOUCH_DOWN_S for _, end in air)
    )  # fmt: skip
