"""One vehicle while it is watched: what is known of it, its stream of samples, and the judge of its ticks."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rotorwatch import airframes
from rotorwatch.answer import ledger, slow
from rotorwatch.answer.wording import rotors
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.host import events
from rotorwatch.engine.motion.airborne import Gap
from rotorwatch.engine.motion.ticks import JUDGE, LEARN
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.control import Control
from rotorwatch.live.judge import Judge
from rotorwatch.live.reported import ALONE, Reported
from rotorwatch.live.stream import Piece, Stream
from rotorwatch.live.trust import MEMORY_S, Trust


class Building:
    """The diagnoser's code, loaded in a thread of its own, which ends with the program: where it is built for the first time that takes
    seconds, in which a link must be read. Code that is half built is built again another time."""

    def __init__(self):
        self._thread = threading.Thread(target=lambda: ENGINE.library, daemon=True)
        self._thread.start()

    def done(self, wait: bool) -> bool:
        """Whether it is there."""
        self._thread.join(None if wait else 0.0)
        return not self._thread.is_alive()


building = functools.cache(Building)  # one for all vehicles


class Session:
    """A vehicle from the first sample on. vehicle: None until there are motor outputs to say what it is."""

    def __init__(self, about: Flight, vehicle: Vehicle | None = None):
        """about: what is known of the flight besides its signals: parameters, autopilot, facts. vehicle: None to identify it by these."""
        self.about, self.vehicle = about, vehicle
        self._judge: Judge | None = None
        self._control: Control | None = None
        self._reported = Reported(about)
        self._trust: Trust | None = None
        self._stream: Stream | None = None
        self._early: list[tuple[Mapping[str, Signal], tuple[Message, ...]]] = []
        self._spans: tuple[tuple[float, float], ...] = ()
        self.now = -np.inf

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of the flight, in time order. Raises VehicleError when the airframe cannot be identified."""
        self._reported.add(signals, messages := tuple(messages))
        signals = {name: signal for name, signal in signals.items() if name not in ALONE}
        self.now = max([self.now, *(float(s.time[-1]) for s in signals.values() if len(s))])
        if self._stream is not None and self._control is not None:
            self._stream.add(signals, messages)
            self._control.add(signals, messages)
            return
        self._early.append((signals, messages))
        motors = next((s["motors"] for s, _ in self._early if "motors" in s), None)
        if motors is None:
            del self._early[:-500]
            return
        if self.vehicle is None:
            self.vehicle = airframes.identify(replace(self.about, signals={"motors": motors}))
        else:
            airframes.check(self.vehicle, replace(self.about, signals={"motors": motors}))
        self._open()
        self._control = Control(self.about, self.vehicle)
        early, self._early = self._early, []
        for more in early:
            self._stream_of().add(*more)
            self._control.add(*more)

    def _stream_of(self) -> Stream:
        assert self._stream is not None
        return self._stream

    def _open(self) -> None:
        assert self.vehicle is not None
        self._stream, self._judge = Stream(self.about, self.vehicle), None
        self._trust = Trust(self.vehicle)

    def advance(self, complete: float | None = None) -> bool:
        """Judge what has become certain; whether there was anything. complete: time up to which all samples have been added, where that is
        known; None on a link, where nothing may be waited for."""
        stream = self._stream
        if stream is None or not building().done(wait=complete is not None):
            return False
        piece = stream.advance()
        if piece is None:
            return False
        flight = stream.replanned()
        if flight is not None:  # begin anew with what is kept
            self._open()
            self._stream_of().add(flight.signals, flight.messages)
            return self.advance(complete)
        return self._judged(piece)

    def _judged(self, piece: Piece, final: bool = False) -> bool:
        """Give a piece to the judge, its flights cut where the vehicle fell to the ground; final: the last one."""
        stream = self._stream_of()
        assert (
            stream.diagnoser is not None
            and stream.account is not None
            and self._trust is not None
            and self._control is not None
        )
        piece = replace(piece, spans=self._control.follow(piece.spans, final))
        self._spans = piece.spans
        self._reported.follow(piece.spans, tuple(j.onset for j in self._control.found), self.now, final)
        if self._judge is None:
            self._judge = Judge(stream.diagnoser, stream.account)
        self._judge.judge(piece, final)
        if piece.judged is not None:
            self._trust.add(piece.judged.table)
        if final or self._trust.due(self.now, self._judge.revision):
            self._trust.examine(self._control.flight(self.now - MEMORY_S), self._spans, self.now, self._judge.revision)
        return piece.judged is not None

    @property
    def due_s(self) -> float:
        """The vehicle's time from which there may be something to judge."""
        return -np.inf if self._stream is None else self._stream.due_s

    def finish(self, duration: float) -> None:
        """The flight has ended, after `duration` s."""
        if self._stream is None or self._control is None:
            return
        building().done(wait=True)
        piece = self._stream.finish(duration)
        if piece is not None:
            self._judged(piece, True)
        else:
            self._control.follow((), True)

    def events(self) -> tuple[Event, ...]:
        """All that has happened, as it looks now."""
        if self._control is None or self._trust is None or self.vehicle is None:
            return ()
        B = self.vehicle.effectiveness()
        if self._judge is None:
            claims, report, grown = (), events.Report(B), None
        else:
            claims, report, grown = self._judge.claims(), self._judge.report, self._judge.grown
        claims = (*claims, *self._reported.found)
        merged = ledger.merge(claims, report, self._control.found, B.shape[1], grown)
        return ledger.believed(merged.events, self._trust.until)

    @property
    def doubt(self) -> str:
        """Why what comes cannot be what flies, a sentence; empty while nothing contradicts it. Then nothing is concluded from it."""
        return "" if self._trust is None else self._trust.doubt

    @property
    def lost(self) -> tuple[float, ...]:
        """Times [s] at which control was lost."""
        return () if self._control is None else tuple(j.left.lost for j in self._control.found)

    @property
    def judged(self) -> bool:
        """Whether any tick has been judged."""
        return self.ticks > 0

    @property
    def ticks(self) -> int:
        """Ticks that have been judged."""
        return 0 if self._judge is None else self._judge.ticks

    @property
    def limits(self) -> str:
        """What cannot be seen at the rate of this link, a sentence; empty where that is no limit, or not known yet."""
        plan = None if self._stream is None else self._stream.plan
        return next((note for note in plan.notes if "are judged every" in note), "") if plan is not None else ""

    @property
    def missing(self) -> tuple[Gap, ...]:
        """Commands that the link has not brought for long, in the flight that goes on or was the last."""
        return () if self._stream is None else self._stream.missing

    @property
    def unseen(self) -> str:
        """The same in words, empty where it brings all."""
        who = [rotor for gap in self.missing for rotor in gap.rotors]
        return f"no command for {rotors(who)}" if who else ""

    @property
    def flying(self) -> bool:
        return bool(self._spans) and self._spans[-1][1] == np.inf

    @property
    def spans(self) -> tuple[tuple[float, float], ...]:
        """(start, end) [s] of each flight so far; infinite end: it flies."""
        return self._spans

    @property
    def revision(self) -> int:
        """Grows when there may be other events."""
        known = 0 if self._judge is None else self._judge.revision
        return known + self._reported.revision + (0 if self._control is None else self._control.revision)

    def losses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """(loss, lower, upper), each (n,): of every rotor at the last tick; None before there is one."""
        if self._judge is None or self._judge.now is None:
            return None
        table, out = self._judge.now
        loss = np.asarray(out.theta[-1])
        sd = events.sd_of(loss, np.asarray(out.theta_sd[-1]), self._judge.B)
        judged = table.mode[-1] == JUDGE
        measured = 1.96 * np.asarray(out.detectable[-1])
        unseen = np.maximum(measured, self._judge.unseen.losses()) if judged else np.ones_like(loss)
        spread = np.where(loss > 0, 1.96 * sd, unseen)
        return loss, np.clip(loss - spread, 0.0, 1.0), np.clip(loss + spread, 0.0, 1.0)

    def weighed(self, found: Sequence[Event]) -> tuple[tuple[Event, ...], tuple[Event, ...]]:
        """The events `found` and the open claims that none of them explains, with what all of the flight says of both."""
        if self._judge is None or self._judge.now is None:
            return tuple(found), ()
        steps, now = self._judge.unseen, float(self._judge.now[0].time[-1])
        claims = () if self.doubt else (*slow.suspected(self._judge.grown), *steps.suspected(found, now))
        return steps.doubted(found), ledger.open_claims(claims, found)

    def blind(self) -> str:
        """Why nothing can be judged right now, in a few words; empty when it is judged."""
        if self._stream is None:
            return "no motor outputs yet"
        if not building().done(wait=False):
            return "building the estimator, the first time only"
        if self._judge is None:
            return "waiting for data"
        if not self.flying:
            return "on the ground"
        if self._judge.now is None:
            return "taking off"
        if self.doubt:
            return self.doubt
        table, _ = self._judge.now
        if self.now - table.time[-1] > 2.0:
            return "motor outputs stopped"
        if self.unseen:
            return self.unseen
        if table.seen is not None and not table.seen[-1]:
            return "not all motor outputs are known"
        if table.upset[-1]:
            return "upset"
        if table.mode[-1] == LEARN:
            if self._judge.contact_s > self._spans[-1][0]:
                return "learning after a contact"
            left = self._spans[-1][0] + self._judge.plan.ready_s - table.time[-1]
            return f"learning, {max(left, 0.0):.0f} s left"
        if table.mode[-1] != JUDGE:
            return "taking off"
        if not table.valid[-1, :3].any():
            return "no angular rates"
        return "" if table.valid[-1, 3] else "thrust: no accelerometer"
