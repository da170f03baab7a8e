"""Input to the conclusion: the events of a flight, and how much of it was assessed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.answer import from_takeoff
from rotorwatch.answer.unassessed import UNKNOWN, Unassessed
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.engine.motion.air_spans import Gap
from rotorwatch.flight.diagnosis import Event, Trend
from rotorwatch.flight.kinds import CONTACT, EVIDENCE, FROM_TAKEOFF, LOST, Weight

ALOFT_S = 1.0  # from the begin of the log: a vehicle in the air by then took off before it
UNASSESSED_SHARE = 0.5  # largest unassessed time beyond the blind time, as a share of the assessed time


class Evidence(NamedTuple):
    """Input to the conclusion.

    n: rotors; places: `places.names`. hidden (n,): undetected loss of each rotor in flight, None when nothing was assessed; hidden_pair:
    the same of two opposite rotors. assessed_s: seconds of flight assessed. claims: those that count though they are no events
    (`ledger.open_claims`). hops: ((take-off, landing), ...) s. trends: `health.trends`, of each rotor, shown for rotors without suspicion,
    or empty. comparable: healthy flights of the vehicle would show more. missing: commands that the log lacks up to the end. matters: loss
    of one rotor that a healthy flight must be able to show. unassessed: why no more could be assessed. assessed_until: time of the last
    assessed tick [s]; blind_s: time after each take-off in which trim and noise are learned [s]. settings: a sentence on those that log
    what this log lacks."""

    events: Sequence[Event]
    n: int
    hidden: np.ndarray | None = None
    hidden_pair: float = 0.0
    assessed_s: float = 0.0
    claims: Sequence[Event] = ()
    places: Sequence[str] = ()
    hops: Sequence[tuple[float, float]] = ()
    trends: Sequence[Trend | None] = ()
    comparable: bool = True
    missing: Sequence[Gap] = ()
    matters: float = MATTERS
    unassessed: Unassessed = UNKNOWN
    assessed_until: float = np.inf
    blind_s: float = 0.0
    settings: str = ""

    @property
    def start(self) -> str:
        """The start of the assessed time, in words."""
        return "take-off" if not self.hops or self.hops[0][0] > ALOFT_S else "the start of the log"

    @property
    def patchy(self) -> bool:
        """True if too much of the flight, beyond the blind time after each take-off, was not assessed to call it healthy."""
        return self.flown_s - self.blind_s * len(self.hops) - self.assessed_s > UNASSESSED_SHARE * self.assessed_s

    @property
    def unseen(self) -> float:
        """The largest undetected loss of any rotor."""
        return float(np.max(self.hidden)) if self.hidden is not None else 1.0

    @property
    def growing(self) -> list[tuple[int, Trend]]:
        """Rotors without suspicion whose loss grows: (number, trend)."""
        open_ = {r for s in self.unexplained_evidence for r in s.rotors}
        open_ |= {r for e in self.losses if e.alternatives for r in e.suspects}
        return [(k, t) for k, t in enumerate(self.trends, start=1) if t and t.word == "growing" and k not in open_]

    @property
    def notices(self) -> list[Event]:
        return [e for e in self.events if e.means.weight is Weight.NOTICE]

    @property
    def flown_s(self) -> float:
        """Time in the air."""
        return sum(end - start for start, end in self.hops)

    @property
    def vague(self) -> bool:
        """True if a significant loss could have remained undetected."""
        return self.unseen > self.matters

    @property
    def knocked_s(self) -> float | None:
        """Time of the last knock, where nothing was assessed after it [s]."""
        last = max((e.onset_s for e in self.events if e.kind == CONTACT), default=-np.inf)
        return last if last >= self.assessed_until else None

    @property
    def missing_s(self) -> float:
        """Time from which missing commands prevent assessing; infinite without such [s]."""
        return min((gap.start for gap in self.missing), default=np.inf)

    @property
    def losses(self) -> list[Event]:
        return [e for e in self.events if e.means.weakens]

    @property
    def sure(self) -> list[Event]:
        """Faults that name one set of rotors."""
        return [e for e in self.events if e.means.accuses and not e.alternatives]

    @property
    def lost(self) -> Event | None:
        """The first loss of control."""
        return next((e for e in self.events if e.kind == LOST), None)

    @property
    def compared(self) -> Mapping[str, Any] | None:
        """Result of the comparison with healthy flights, or else with healthy vehicles; of one that leans to a rotor whose loss may matter,
        as ambiguous."""
        found = next((c.extra for c in self.claims if c.kind == FROM_TAKEOFF), None)
        if found and "leaning" in found and found["interval"][found["leaning"]["rotors"][0] - 1][1] > self.matters:
            return {**found, **found["leaning"]}
        return found

    @property
    def whole(self) -> bool:
        """True if it was compared with healthy flights."""
        return any(c.source.name == from_takeoff.FLIGHTS.name for c in self.claims)

    @property
    def unexplained_evidence(self) -> list[Event]:
        """Evidence against rotors that no event explains."""
        return [c for c in self.claims if c.kind == EVIDENCE]

    @property
    def bound(self) -> float | None:
        """The largest possible loss since take-off, where only healthy vehicles of other builds bound it."""
        return max(self.bounds) if self.compared and not self.whole else None

    @property
    def bounds(self) -> list[float]:
        """The same of each rotor, combined with its undetected loss in flight: the upper end of its interval at the end."""
        hidden = self.hidden if self.hidden is not None else np.zeros(self.n)
        known = self.compared["interval"] if self.compared else [(0.0, 1.0)] * self.n
        return [together([float(unseen), float(high)]) for unseen, (_, high) in zip(hidden, known)]


def together(bounds: Sequence[float]) -> float:
    """Upper bound of a loss that may have several contributions."""
    return 1.0 - float(np.prod([1.0 - bound for bound in bounds]))
