"""Losses of control of a current flight: searched for in the samples so far, once there is reason to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.spin.turning import SPUN
from rotorwatch.engine.window import Window
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.upset import find as upset
from rotorwatch.witnesses.upset import loss_of_control
from rotorwatch.witnesses.upset.loss_of_control import LossOfControl

NAMES = (
    "motors", "lift", "battery", "control", "gyro", "rates", "accel", "attitude", "attitude_wanted", "rates_wanted", "velocity", "position",
)  # fmt: skip
WINDOW_S = 600.0  # of a link: older samples are gone
RECENT_S = 6.0  # a departure shows within this time
# Between two searches: as long as since the first suspicion, within these limits; the most while it spins.
EVERY_S, SELDOM_S, SPINNING_S = 0.5, 5.0, 1.0
FINAL_S = upset.AFTER_S + 2.0  # after a loss of control: its cause rests on no later samples


class Departures:
    """found: losses of control with their causes, as they look now. revision: changes with them."""

    def __init__(self, vehicle: Vehicle):
        self._vehicle = vehicle
        self.found: tuple[upset.Assessed, ...] = ()
        self.revision = 0
        self._landings = 0
        self._impacts: dict[float, float] = {}  # start of a flight -> its impact [s]
        self._suspected = np.inf
        self._looked = -np.inf

    @property
    def spins(self) -> Spans:
        """((start, end), ...) s in which the vehicle spins and flies on."""
        return upset.spins(self.found)

    def of_log(self, flight: Flight, air: Spans, progress: Callable[[float], object] | None = None) -> Spans:
        """Find them in a whole log; its flights `air` ((start, end), ...) s, cut at impacts."""
        self.found = upset.assessed(flight, self._vehicle, air, progress)
        return upset.until_impact(flight, air, self.found)

    def follow(self, window: Window, spans: Spans, over: bool = False) -> Spans:
        """The flights `spans` ((start, end), ...) s of a link, end infinite while airborne, cut at impacts. over: no samples will
        follow."""
        now = window.now
        landings = sum(np.isfinite(end) for _, end in spans)
        ended = over or landings != self._landings
        wait = np.clip(now - self._suspected, EVERY_S, SELDOM_S)
        if ended or now - self._looked >= wait or (now - self._looked >= SPINNING_S and self._turns(window)):
            self._looked, self._landings = now, landings
            if ended or np.isfinite(self._suspected) or self._departs(window, spans):
                self._suspected = min(self._suspected, now)
                self._assess(window, spans, over)
        return tuple((start, min(end, self._impacts.get(start, np.inf))) for start, end in spans)

    def _turns(self, window: Window) -> bool:
        """Return whether the vehicle turns fast now."""
        turning = window.flight(window.now - SPINNING_S, ("gyro", "rates")).angular_rate()
        return turning is not None and bool((np.abs(turning.values[-10:, 2]) > SPUN).any())

    def _departs(self, window: Window, spans: Spans) -> bool:
        """Return whether the last seconds look like a loss of control or a collision."""
        since = window.now - RECENT_S
        air = tuple((max(start, since), min(end, window.now)) for start, end in spans if end > since)
        flight = window.flight(since - 1.0, NAMES)
        return bool(loss_of_control.find(flight, air)) or any(loss_of_control.hit(flight, *hop) is not None for hop in air)

    def _assess(self, window: Window, spans: Spans, final: bool) -> None:
        """Evaluate the window again; losses of control whose samples have been removed stay."""
        now = window.now
        flight = window.flight(now - WINDOW_S, NAMES)
        since = now - WINDOW_S + upset.BEFORE_S
        old = tuple(j for j in self.found if j.left.onset < since)
        air = tuple((start, min(end, now)) for start, end in spans)
        recent = tuple(span for span in air if span[1] > since)
        settled = [j for j in self.found if not final and now > j.left.lost + FINAL_S]

        def looks_now(left: LossOfControl) -> upset.Assessed:
            known = next((j for j in settled if j.left == left or (j.spin is not None and j.left.onset == left.onset)), None)
            if known is None:
                return upset.assess(flight, self._vehicle, recent, left)
            return upset.follow(flight, self._vehicle, recent, known._replace(left=left))

        lost = loss_of_control.find(flight, recent) if recent or not air else ()
        new = [looks_now(left) for left in lost if left.onset >= since]
        self.found = (*old, *new)
        for (start, end), (_, cut) in zip(recent, upset.until_impact(flight, recent, self.found)):
            if cut < end:
                self._impacts[start] = cut
            else:
                self._impacts.pop(start, None)
        self.revision += 1
        if not self.found:
            self._suspected = np.inf
