"""What is known of a watched vehicle at one moment, for channels that publish a state."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rotorwatch.flight.diagnosis import Event
from rotorwatch.live import view
from rotorwatch.live.watched import Watched


@dataclass(frozen=True)
class Snapshot:
    """name: of the vehicle. state: of `view.Line`; blind: why nothing is assessed, in a few words. rotors: (loss, lower, upper) of each.
    events: that hold; lasting: those of them that still apply. ticks: assessed; taken, lost: messages; last_frame: arrival of the last one
    (monotonic, s)."""

    name: str
    state: str
    blind: str
    rotors: tuple[tuple[float, float, float], ...]
    events: tuple[Event, ...]
    ticks: int
    taken: int
    lost: int
    last_frame: float

    @property
    def lasting(self) -> list[Event]:
        return view.lasting(self.events)

    @property
    def faulty(self) -> bool:
        """True if a rotor, its motor or its output is at fault now, even if it is not known which."""
        return any(event.means.accuses or event.rotors for event in self.lasting)

    @property
    def assessed(self) -> bool:
        """True if the rotors are being assessed now."""
        silent = time.monotonic() - self.last_frame > view.SILENT_S
        return self.state in ("OK", "MAYBE", "FAULT") and not silent and (not self.blind or self.blind.startswith("thrust"))


def taken(watched: Watched, waits_for: str = "") -> Snapshot:
    """The current snapshot of a vehicle."""
    losses = None if watched.session is None else watched.session.losses()
    rotors = () if losses is None else tuple(zip(*(column.tolist() for column in losses)))
    ticks, health = 0 if watched.session is None else watched.session.ticks, watched.health
    line = view.line(watched, waits_for)
    return Snapshot(watched.name, line.state, line.blind, rotors, watched.events, ticks, health.taken, health.lost, health.last_frame)
