"""Session of a vehicle on a link: its case, and its state in words for the observer."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from rotorwatch import airframes
from rotorwatch.answer.wording import rotors
from rotorwatch.case.conductor import Case
from rotorwatch.engine.bindings import event_rows as events
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.motion.air_spans import Gap
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN
from rotorwatch.engine.window import LATE
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle

STOPPED_S = 2.0  # without outputs, or without the spin that went on


class Building:
    """Loads the diagnoser's code in a thread of its own, which ends with the program: the first build takes seconds, during which the
    link must be read. An incomplete build is repeated next time."""

    def __init__(self):
        self._thread = threading.Thread(target=lambda: ENGINE.library, daemon=True)
        self._thread.start()

    def done(self, wait: bool) -> bool:
        """Return whether the code is loaded."""
        self._thread.join(None if wait else 0.0)
        return not self._thread.is_alive()


building = functools.cache(Building)  # one for all vehicles


class Session:
    """A vehicle from the first sample on. vehicle, case: None until there are motor outputs to identify it by."""

    def __init__(self, about: Flight, vehicle: Vehicle | None = None):
        """about: parameters, autopilot and facts of the flight. vehicle: None to identify it by these."""
        self.about, self.vehicle = about, vehicle
        self.case: Case | None = None
        self._early: list[tuple[Mapping[str, Signal], tuple[Message, ...]]] = []
        self.now = -np.inf

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """Append samples and messages, in the order of time. Raises VehicleError when the airframe cannot be identified."""
        self.now = max([self.now, *(float(s.time[-1]) for name, s in signals.items() if len(s) and name not in LATE)])
        if self.case is not None:
            self.case.feed(signals, messages)
            return
        self._early.append((signals, tuple(messages)))
        motors = next((s["motors"] for s, _ in self._early if "motors" in s), None)
        if motors is None:
            del self._early[:-500]
            return
        self.vehicle = airframes.of(replace(self.about, signals={"motors": motors}), self.vehicle)
        self.case = Case(self.about, self.vehicle)
        early, self._early = self._early, []
        for more in early:
            self.case.feed(*more)

    def advance(self, complete: float | None = None) -> bool:
        """Evaluate the samples that have become certain; return whether there was a new tick. complete: time up to which all samples have
        been added, where known; None on a link, where nothing may be waited for."""
        if self.case is None or not building().done(wait=complete is not None):
            return False
        return self.case.advance()

    @property
    def due_s(self) -> float:
        """Time of the vehicle from which there may be another tick [s]."""
        return -np.inf if self.case is None else self.case.driver.due_s

    def finish(self, duration: float) -> None:
        """The flight has ended, after `duration` s."""
        if self.case is not None:
            building().done(wait=True)
            self.case.finish(duration)

    def events(self) -> tuple[Event, ...]:
        """All events, as they look now."""
        return () if self.case is None else tuple(e.stated() for e in self.case.claims().events)

    @property
    def doubt(self) -> str:
        """Why the samples cannot be of what flies, a sentence; empty while nothing contradicts them. With a doubt nothing is concluded
        from them."""
        return "" if self.case is None else self.case.consistency.doubt

    @property
    def lost(self) -> tuple[float, ...]:
        """Times [s] at which control was lost."""
        return () if self.case is None else tuple(j.left.lost for j in self.case.departures.found)

    @property
    def assessed(self) -> bool:
        """Return whether any tick has been evaluated."""
        return self.ticks > 0

    @property
    def ticks(self) -> int:
        """Number of evaluated ticks."""
        return 0 if self.case is None else self.case.ticks

    @property
    def limits(self) -> str:
        """A sentence on the limits of this link's rate; empty where it is no limit, or not known yet."""
        plan = None if self.case is None else self.case.plan
        return next((note for note in plan.notes if "are assessed every" in note), "") if plan is not None else ""

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that the link has not delivered for long, in the current or last flight."""
        return () if self.case is None else self.case.missing

    @property
    def unseen(self) -> str:
        """The same in words, empty where none is missing."""
        who = [rotor for gap in self.missing for rotor in gap.rotors]
        return f"no command for {rotors(who)}" if who else ""

    @property
    def flying(self) -> bool:
        return bool(self.spans) and self.spans[-1][1] == np.inf

    @property
    def spans(self) -> tuple[tuple[float, float], ...]:
        """(start, end) [s] of each flight so far; infinite end while airborne, be it spinning out of control."""
        return () if self.case is None else tuple((start, self._end(start, end)) for start, end in self.case.air)

    def _end(self, start: float, end: float) -> float:
        """The end of a flight [s], which is cut for the estimator where a spin began to last."""
        assert self.case is not None
        spins = [until for since, until in self.case.departures.spins if start <= since and end < until]
        if not spins or not np.isfinite(end):
            return end
        return np.inf if self.now - max(spins) < STOPPED_S and not self.case.over else max(spins)

    @property
    def revision(self) -> int:
        """Grows when there may be other events."""
        return 0 if self.case is None else self.case.revision

    def losses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """(loss, lower, upper), each (n,): of every rotor at the last tick; None before there is one."""
        if self.case is None or self.case.last is None or self.case.unseen is None:
            return None
        table, out = self.case.last
        loss = np.asarray(out.theta[-1])
        sd = events.sd_of(loss, np.asarray(out.theta_sd[-1]), self.case.B)
        assessed = table.mode[-1] == ASSESS
        measured = 1.96 * np.asarray(out.detectable[-1])
        unseen = np.maximum(measured, self.case.unseen.losses()) if assessed else np.ones_like(loss)
        spread = np.where(loss > 0, 1.96 * sd, unseen)
        return loss, np.clip(loss - spread, 0.0, 1.0), np.clip(loss + spread, 0.0, 1.0)

    def blind(self) -> str:
        """Why nothing can be evaluated right now, in a few words; empty when it is evaluated."""
        case = self.case
        if case is None:
            return "no motor outputs yet"
        if not building().done(wait=False):
            return "building the estimator, the first time only"
        if case.driver.diagnoser is None:
            return "waiting for data"
        if not self.flying:
            return "on the ground"
        if case.last is None:
            return "taking off"
        if self.doubt:
            return self.doubt
        table = case.last.table
        if np.isfinite(case.air[-1][1]):
            return "spinning: only rotors that are off are found"
        if self.now - table.time[-1] > STOPPED_S:
            return "motor outputs stopped"
        if self.unseen:
            return self.unseen
        if table.seen is not None and not table.seen[-1]:
            return "not all motor outputs are known"
        if table.upset[-1]:
            return "upset"
        if table.mode[-1] == LEARN:
            if max([-np.inf, *(c.time for c in case.driver.diagnoser.contacts[-1:])]) > self.spans[-1][0]:
                return "learning after a contact"
            left = self.spans[-1][0] + case.driver.diagnoser.plan.ready_s - table.time[-1]
            return f"learning, {max(left, 0.0):.0f} s left"
        if table.mode[-1] != ASSESS:
            return "taking off"
        if not table.valid[-1, :3].any():
            return "no angular rates"
        return "" if table.valid[-1, 3] else "thrust: no accelerometer"
