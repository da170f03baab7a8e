"""The addresses that send under one vehicle's id, and which of them is followed: one that sends what judging needs.

Two radios, a router's copy, another vehicle, or somebody who pretends to be it: heartbeats alone win nothing. The one that is followed
stays so while its samples can be used; what the others send is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

from rotorwatch.live.requests import Rates
from rotorwatch.live.senders import Senders
from rotorwatch.logs import tlog

NEEDS = {"outputs": (tlog.MOTORS, tlog.STATUS), "rates": (*tlog.ATTITUDES, "HIGHRES_IMU", *tlog.IMUS)}
SIGNALS = {"motors": "outputs", "gyro": "rates"}  # samples, and what they are of it
WORDS = {"outputs": "motor outputs", "rates": "angular rates"}
SILENT_S = 3.0  # without a message, or without one that judging needs
LEAST = 3  # of each that judging needs, before an address is one that sends it
FADED_S = 8.0  # the same, before it is asked whether another address would send it: slow links lose several in a row
TURN_S = 5.0  # each is asked for what judging needs, while none sends it
DOUBT_S = 20.0  # that samples contradict each other, before another address is tried
UNKNOWN_S = 15.0  # that none of the parameters that were asked for comes
MOST = 8  # addresses of a vehicle that are known


@cache
def _needed() -> dict[int, str]:
    """Message id -> what it is of what judging needs."""
    layouts = tlog.layouts()
    return {layouts[name].id: need for need, names in NEEDS.items() for name in names if name in layouts}


class Route:
    """One address. heard: when the last frame came [s]; sequence: the last running number; rates: those requested there."""

    def __init__(self, peer: Any, rates: Rates, now: float):
        self.peer, self.rates, self.heard = peer, rates, now
        self.senders = Senders()
        self.sequence: int | None = None
        self.doubted = (
            False  # its samples contradicted each other, or it took over with another clock: others are preferred
        )
        self._came = {
            need: (-SILENT_S, 0) for need in NEEDS
        }  # when the last one did, and how many without a long pause

    def hear(self, identity: int, now: float) -> None:
        """A frame of this message."""
        self.heard = now
        need = _needed().get(identity)
        if need is not None:
            last, count = self._came[need]
            self._came[need] = now, count + 1 if now - last <= SILENT_S else 1

    def silent(self, now: float) -> bool:
        return now - self.heard > SILENT_S

    def carries(self, now: float) -> bool:
        """Whether it sends what judging needs."""
        return all(count >= LEAST and now - last <= SILENT_S for last, count in self._came.values())

    def __str__(self) -> str:
        return ":".join(map(str, self.peer)) if isinstance(self.peer, tuple) else f"{self.peer}"


class Routes:
    """Of one vehicle. followed: the one that it is judged by; since: from when on [s]; usable: need -> when the last samples that could be
    used came."""

    def __init__(self, first: Route, now: float):
        self._all, self.followed, self.since = {first.peer: first}, first, now
        self.usable: dict[str, float] = {}

    def __iter__(self) -> Iterator[Route]:
        return iter(self._all.values())

    def find(self, peer: Any) -> Route | None:
        return self._all.get(peer)

    def add(self, route: Route, now: float) -> bool:
        """One more, in the place of one that does not send what judging needs; False where there is no room."""
        if len(self._all) >= MOST:
            others = [r for r in self if r is not self.followed and not r.carries(now)]
            if not others:
                return False
            del self._all[min(others, key=lambda r: r.heard).peer]
        self._all[route.peer] = route
        return True

    def used(self, now: float) -> bool:
        """Whether samples of all that judging needs could be used of late."""
        return all(now - max(self.usable.get(need, -SILENT_S), self.since) <= SILENT_S for need in NEEDS)

    def doubt(self, now: float) -> None:
        """The samples contradict each other."""
        self.followed.doubted |= now - self.since > DOUBT_S

    def better(self, now: float, fails: bool) -> Route | None:
        """Another one that is to be followed. fails: this one does not send what judging needs."""
        if not fails and not self.followed.doubted:
            return None
        others = [r for r in self._after() if r.carries(now) and (fails or not r.doubted)]
        return min(others, key=lambda r: r.doubted, default=None)

    def next(self, now: float) -> Route | None:
        """The one whose turn it is to be asked, where none sends what judging needs."""
        last = min(self.usable.get(need, -FADED_S) for need in NEEDS)
        if now - self.since <= TURN_S or now - last <= FADED_S or self.followed.carries(now):
            return None
        return next((r for r in self._after() if not r.silent(now)), None)

    def _after(self) -> list[Route]:
        """The others, from the one that is followed on."""
        routes = list(self)
        at = routes.index(self.followed)
        return [*routes[at + 1 :], *routes[:at]]

    def restarted(self, now: float) -> None:
        """The vehicle's clock began anew. All paths of one vehicle have its clock: who took over with another one is a stranger, or the
        vehicle after a reboot."""
        self.followed.doubted |= now - self.since <= DOUBT_S

    def follow(self, route: Route, now: float) -> None:
        self.followed, self.since = route, now
        route.sequence = None
