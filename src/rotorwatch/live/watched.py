"""A watched vehicle: its session, its alerts so far, and the state of its link."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rotorwatch.answer.wording import percent
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.alert_states import WITHDRAWN, Change, Changes
from rotorwatch.live.esc_notices import Rotors
from rotorwatch.live.guard import trouble
from rotorwatch.live.session import Session

Notify = Callable[[dict], None]
LOSING_S, MANY_LOST, FEW_LOST = 10.0, 0.2, 0.1  # window for losses; shares from which it is reported, and no longer
LOOK_S = 0.5  # of the vehicle's time, between two checks of known events


@dataclass
class Health:
    """State of a link: messages received, lost (by their running numbers), repeated or out of order, damaged; reboots and clock jumps of
    the vehicle; frames with its id from elsewhere, left out; last_frame: arrival of the last one (monotonic, s)."""

    taken: int = 0
    lost: int = 0
    twice: int = 0
    damaged: int = 0
    reboots: int = 0
    jumps: int = 0
    others: int = 0
    last_frame: float = field(default_factory=time.monotonic)

    @property
    def loss(self) -> float:
        """Share of messages lost."""
        return self.lost / max(self.lost + self.taken, 1)

    def words(self) -> str:
        """Defects of the link in words; empty without any."""
        counts = (
            (self.twice, "twice or late"),
            (self.damaged, "damaged"),
            (self.others, "from other addresses ignored"),
            (self.reboots, "reboots"),
            (self.jumps, "clock jumps"),
        )
        lost = [f"{percent(self.loss, 1)} lost"] if self.loss >= 0.0005 else []
        return ", ".join([*lost, *(f"{count} {what}" for count, what in counts if count)])


class Losing:
    """Reports when a link begins to lose many messages, and when it no longer does."""

    def __init__(self):
        self._since, self._taken, self._lost, self._bad = -np.inf, 0, 0, False

    def look(self, health: Health, now: float) -> str:
        """A sentence where that has changed; empty otherwise."""
        if now - self._since < LOSING_S:
            return ""
        taken, lost = health.taken - self._taken, health.lost - self._lost
        first = self._since == -np.inf
        self._since, self._taken, self._lost = now, health.taken, health.lost
        share = lost / max(taken + lost, 1)
        if first or not taken or self._bad == (share > (FEW_LOST if self._bad else MANY_LOST)):
            return ""
        self._bad = not self._bad
        if self._bad:
            return f"{percent(share)} of the messages of the last {LOSING_S:.0f} s were lost: detections may be delayed"
        return f"the link loses few messages again, {percent(share, 1)}"


class Watched:
    """A vehicle by its name. notify: called with each alert, a dict (docs/watch.md)."""

    def __init__(self, name: str, notify: Notify, vehicle: Vehicle | None = None):
        self.name, self.health, self.trouble, self.notice = name, Health(), "", ""
        self.gone = ""  # inputs of the evaluation that no longer come, in a few words
        self.broken = False  # by an internal error, not for the vehicle's kind
        self._notify, self._vehicle = notify, vehicle
        self.session: Session | None = None
        self.rotors = Rotors()
        self.changes = Changes()
        self._looked, self._revision, self._said, self._doubt = -np.inf, 0, ("", ""), ""

    def begin(self, about: Flight) -> None:
        """Begin a flight. about: its known facts, without signals."""
        self.session, self.changes = Session(about, self._vehicle), Changes()
        self.trouble, self.broken = "", False
        self.rotors = Rotors()
        self._looked, self._revision, self._doubt = -np.inf, 0, ""

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """Add samples and messages, in time order."""
        if self.session is None or self.trouble:
            return
        try:
            known = self.session.vehicle
            self.session.add(signals, messages)
            curve = None if known is None else known.curve
            for rotor, text in self.rotors.examine(signals.get("esc"), signals.get("motors"), self.session.flying, curve):
                self.say(text, rotor=rotor)
            if known is None and self.session.vehicle is not None:
                frame = self.session.vehicle
                self._notify({"type": "vehicle", "vehicle": self.name, "frame": frame.name, "rotors": len(frame.rotors)})
        except Exception as why:
            self.fail(why)

    def fail(self, why: Exception) -> None:
        """The vehicle can no longer be evaluated."""
        self.trouble, self.broken = trouble(why), not isinstance(why, RotorwatchError)
        self.say(self.trouble, "error")

    def advance(self, complete: float | None = None) -> bool:
        """Evaluate new samples; return whether there was a tick."""
        if self.session is None or self.trouble:
            return False
        try:
            stepped = self._advanced(complete)
        except Exception as why:  # the other vehicles are not affected
            self.fail(why)
            return False
        return stepped

    def _advanced(self, complete: float | None) -> bool:
        assert self.session is not None
        stepped = self.session.advance(complete)
        if stepped and self.session.flying:
            unseen = self.session.unseen
            unseen += " arrives over the link: nothing is assessed until it does" if unseen else ""
            before, self._said = self._said, (self.session.limits, unseen)
            for text, known in zip(self._said, before):
                if text and text != known:
                    self.say(text)
        revision = self.session.revision
        if (
            revision != self._revision
            or self.session.doubt != self._doubt
            or ((revision or self.changes.now) and self.session.now - self._looked > LOOK_S)
        ):
            self._look()
        return stepped

    def finish(self, duration: float | None = None) -> None:
        """The flight has ended: send the final state of each event."""
        if self.session is None or self.trouble:
            return
        try:
            self.session.finish(self.session.now if duration is None else duration)
            self._look(final=True)
        except Exception as why:
            self.fail(why)

    def withdraw(self) -> None:
        """Withdraw all alerts of this flight: it was evaluated with the wrong vehicle."""
        for change in self.changes.since_last(()):
            self._alert(change)

    @property
    def events(self) -> tuple[Event, ...]:
        """All valid announced events."""
        return tuple(self.changes.now.values())

    def _look(self, final: bool = False) -> None:
        assert self.session is not None
        self._revision, self._looked = self.session.revision, self.session.now
        for change in self.changes.since_last(self.session.events(), final):
            self._alert(change)
        if self.session.doubt != self._doubt:
            self._doubt = self.session.doubt
            self.say(self._doubt or "the data are consistent again; the assessment continues", "error" if self._doubt else "notice")

    def _alert(self, change: Change) -> None:
        alert = {"type": "event", "vehicle": self.name, "number": change.number, "state": change.what}
        self._notify({**alert, "event": change.event.to_dict()})
        if change.what == WITHDRAWN:
            self.notice = "an event was withdrawn: it began with the landing, or the data favour another explanation"

    def say(self, text: str, kind: str = "notice", **more: int | list[str]) -> None:
        """Send a notice on the link or the vehicle. more: further fields of the alert."""
        self.notice = text
        self._notify({"type": kind, "vehicle": self.name, "text": text, **more})
