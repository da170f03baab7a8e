"""Loss of control of a vehicle that is watched: judged as of a log that ends now, once there is reason to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live.window import Window
from rotorwatch.witnesses.upset import find as upset
from rotorwatch.witnesses.upset import loss_of_control

NAMES = (
    "motors", "lift", "battery", "control", "gyro", "rates", "accel", "attitude", "attitude_wanted", "rates_wanted", "velocity", "position",
)  # fmt: skip
WINDOW_S = 600.0  # of samples; a flight that is longer is judged by its last ten minutes
RECENT_S = 6.0  # in which a departure shows, if there is one
EVERY_S, SELDOM_S = 0.5, 5.0  # between two looks: as long as since the first suspicion, within these
FINAL_S = upset.AFTER_S + 2.0  # after a loss of control: all that its cause is judged by has been heard


class Control:
    """The losses of control of one vehicle. found: with their causes, as they look now; revision: grows when these may be others."""

    def __init__(self, about: Flight, vehicle: Vehicle):
        self._window, self._vehicle = Window(about), vehicle
        self.found: tuple[upset.Judged, ...] = ()
        self.revision = 0
        self._hops = 0  # that have ended
        self._impacts: dict[float, float] = {}  # start of a flight -> when it fell to the ground
        self._suspected = np.inf
        self._looked = -np.inf

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of the flight, in time order."""
        self._window.add({name: s for name, s in signals.items() if name in NAMES}, messages)

    def follow(self, spans: Spans, final: bool = False) -> Spans:
        """The intervals `spans` ((start, end), ...) s in the air, infinite where the vehicle flies, each cut where it fell to the ground.
        final: nothing will come after."""
        now = self._window.now
        ended = sum(np.isfinite(end) for _, end in spans)
        over = final or ended != self._hops
        if over or now - self._looked >= np.clip(now - self._suspected, EVERY_S, SELDOM_S):
            self._looked, self._hops = now, ended
            if over or np.isfinite(self._suspected) or self._leaves(spans):
                self._suspected = min(self._suspected, now)
                self._judge(spans, final)
            self._window.forget(now - WINDOW_S)
        return tuple((start, min(end, self._impacts.get(start, np.inf))) for start, end in spans)

    def flight(self, since: float) -> Flight:
        """The samples from `since` s on, as far as they are kept."""
        return self._window.flight(since)

    def _leaves(self, spans: Spans) -> bool:
        """Do the last seconds look as if control was lost, or as if something had been hit?"""
        since = self._window.now - RECENT_S
        air = tuple((max(start, since), min(end, self._window.now)) for start, end in spans if end > since)
        flight = self._window.flight(since - 1.0)
        return bool(loss_of_control.find(flight, air)) or any(
            loss_of_control.hit(flight, *hop) is not None for hop in air
        )

    def _judge(self, spans: Spans, final: bool) -> None:
        """Find the losses of control anew in the window; those whose samples are forgotten stay."""
        flight = self._window.flight(-np.inf)
        since = self._window.now - WINDOW_S + upset.BEFORE_S
        old = tuple(j for j in self.found if j.left.onset < since)
        air = tuple((start, min(end, self._window.now)) for start, end in spans)
        recent = tuple(span for span in air if span[1] > since)
        final_ones = [j for j in self.found if not final and self._window.now > j.left.lost + FINAL_S]
        new = [
            next((j for j in final_ones if j.left == left), None) or upset.judge(flight, self._vehicle, recent, left)
            for left in (loss_of_control.find(flight, recent) if recent or not air else ())
            if left.onset >= since
        ]
        self.found = (*old, *new)
        for (start, end), (_, cut) in zip(recent, upset.until_impact(flight, recent, self.found)):
            if cut < end:
                self._impacts[start] = cut
            else:
                self._impacts.pop(start, None)
        self.revision += 1
        if not self.found:
            self._suspected = np.inf
