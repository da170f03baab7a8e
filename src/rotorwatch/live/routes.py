"""The addresses that send under one vehicle's id, and the choice of the one to follow: one that sends the inputs of the evaluation.

They may be two radios, a router's copy, another vehicle, or an impostor: heartbeats alone are not sufficient. The followed address stays
while its samples are usable; frames of the others are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

from rotorwatch.live.requests import Rates
from rotorwatch.live.senders import Senders
from rotorwatch.logs import tlog

NEEDS = {"outputs": (tlog.MOTORS, tlog.STATUS), "rates": (*tlog.ATTITUDES, "HIGHRES_IMU", *tlog.IMUS)}
SIGNALS = {"motors": "outputs", "gyro": "rates"}  # signals, and their name in messages
WORDS = {"outputs": "motor outputs", "rates": "angular rates"}
SILENT_S = 3.0  # without a message, or without a needed one
LEAST = 3  # messages of each input before an address counts as sending it
FADED_S = 8.0  # the same, before another address is tried: slow links lose several in a row
TURN_S = 5.0  # for requests to each address, while none sends the inputs
DOUBT_S = 20.0  # of contradictory samples, before another address is tried
UNKNOWN_S = 15.0  # without any requested parameter
MOST = 8  # addresses kept of a vehicle


@cache
def _needed() -> dict[int, str]:
    """Message id -> the input of the evaluation that it contains."""
    layouts = tlog.layouts()
    return {layouts[name].id: need for need, names in NEEDS.items() for name in names if name in layouts}


class Route:
    """An address. heard: arrival of the last frame [s]; sequence: the last running number; rates: those requested there."""

    def __init__(self, peer: Any, rates: Rates, now: float):
        self.peer, self.rates, self.heard = peer, rates, now
        self.senders = Senders()
        self.sequence: int | None = None
        self.doubted = False  # contradictory samples, or another clock at take-over: others are preferred
        self._came = {need: (-SILENT_S, 0) for need in NEEDS}  # time of the last one, and number without a long pause

    def hear(self, identity: int, now: float) -> None:
        """Register a frame of this message."""
        self.heard = now
        need = _needed().get(identity)
        if need is not None:
            last, count = self._came[need]
            self._came[need] = now, count + 1 if now - last <= SILENT_S else 1

    def silent(self, now: float) -> bool:
        return now - self.heard > SILENT_S

    def carries(self, now: float) -> bool:
        """True if it sends the inputs of the evaluation."""
        return all(count >= LEAST and now - last <= SILENT_S for last, count in self._came.values())

    def __str__(self) -> str:
        return ":".join(map(str, self.peer)) if isinstance(self.peer, tuple) else f"{self.peer}"


class Routes:
    """The addresses of one vehicle. followed: the one used for assessing; since: its start [s]; usable: input -> time of its last usable
    samples."""

    def __init__(self, first: Route, now: float):
        self._all, self.followed, self.since = {first.peer: first}, first, now
        self.usable: dict[str, float] = {}

    def __iter__(self) -> Iterator[Route]:
        return iter(self._all.values())

    def find(self, peer: Any) -> Route | None:
        return self._all.get(peer)

    def add(self, route: Route, now: float) -> bool:
        """Add a route, in place of one that does not send the inputs of the evaluation; False where there is no room."""
        if len(self._all) >= MOST:
            others = [r for r in self if r is not self.followed and not r.carries(now)]
            if not others:
                return False
            del self._all[min(others, key=lambda r: r.heard).peer]
        self._all[route.peer] = route
        return True

    def used(self, now: float) -> bool:
        """True if recent samples of all inputs were usable."""
        return all(now - max(self.usable.get(need, -SILENT_S), self.since) <= SILENT_S for need in NEEDS)

    def doubt(self, now: float) -> None:
        """Mark that the samples contradict each other."""
        self.followed.doubted |= now - self.since > DOUBT_S

    def better(self, now: float, fails: bool) -> Route | None:
        """Another route to follow. fails: the current one does not send the inputs of the evaluation."""
        if not fails and not self.followed.doubted:
            return None
        others = [r for r in self._after() if r.carries(now) and (fails or not r.doubted)]
        return min(others, key=lambda r: r.doubted, default=None)

    def next(self, now: float) -> Route | None:
        """The next route to send requests to, where none sends the inputs of the evaluation."""
        last = min(self.usable.get(need, -FADED_S) for need in NEEDS)
        if now - self.since <= TURN_S or now - last <= FADED_S or self.followed.carries(now):
            return None
        return next((r for r in self._after() if not r.silent(now)), None)

    def _after(self) -> list[Route]:
        """The others, in order after the followed one."""
        routes = list(self)
        at = routes.index(self.followed)
        return [*routes[at + 1 :], *routes[:at]]

    def restarted(self, now: float) -> None:
        """The vehicle's clock restarted. All paths to one vehicle have its clock: a route that took over with another one is an impostor,
        or the vehicle after a reboot."""
        self.followed.doubted |= now - self.since <= DOUBT_S

    def follow(self, route: Route, now: float) -> None:
        self.followed, self.since = route, now
        route.sequence = None
