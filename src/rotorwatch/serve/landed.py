"""A watched flight that has ended: the live answer, for the list of flights."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np

from rotorwatch import __version__
from rotorwatch.case.conductor import FINAL_S
from rotorwatch.case.verdict import Bounds
from rotorwatch.fleet.store import Entry
from rotorwatch.flight import identity
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.live.session import Session

LEAST_S = 5.0  # in the air: less is a motor test, unless control was lost
GAP_S = 1.5  # between two points of a band; more is an unassessed gap


class Landings:
    """Flights of a vehicle that have ended and are not listed yet."""

    def __init__(self):
        self._listed: list[float] = []

    def over(self, session: Session, all_is_over: bool) -> list[tuple[float, float]]:
        """(start, end) [s] of each new one. all_is_over: the session has ended."""
        hops = []
        for start, end in session.spans:
            end = min(end, session.now)
            sure = all_is_over or (end < session.now - FINAL_S and np.isfinite(end))
            flown = end - start >= LEAST_S or any(start <= lost <= end + FINAL_S for lost in session.lost)
            if sure and flown and not any(abs(start - known) < LEAST_S for known in self._listed):
                self._listed.append(start)
                hops.append((start, end))
        return hops


def answer(name: str, session: Session, rows: Sequence[tuple], hop: tuple[float, float]) -> Diagnosis:
    """The Diagnosis of one flight from the live assess's events. rows: of its band (`live.Band`). hop: (start, end) [s]."""
    assert session.case is not None
    start, end = hop
    case, vehicle, about = session.case, session.case.vehicle, session.about
    rows_assessed = [row for row in rows if len(row) > 1 and start <= row[0] <= end]
    steps = np.diff([row[0] for row in rows_assessed])
    hidden = np.ones(len(vehicle.rotors))
    for row in rows_assessed:  # the bound of a healthy rotor covers the flight up to then
        hidden = np.where(np.asarray(row[1]) > 0.0, hidden, row[3])
    assessed_s, blind_s = float(steps[steps < GAP_S].sum()), rows_assessed[0][0] - start if rows_assessed else 0.0
    end_of = case.answer(hop, Bounds(hidden, assessed_s=assessed_s, blind_s=blind_s)).end
    began = datetime.fromtimestamp(time.time() - session.now, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
    return Diagnosis(
        flight={
            "name": name, "format": about.format, "autopilot": about.autopilot, "firmware": about.firmware, "frame": vehicle.name,
            "geometry": [{"x": r.x, "y": r.y, "spin": r.spin} for r in vehicle.rotors], "rotors": len(vehicle.rotors),
            "duration_s": round(end - start, 3), "boot_s": None, "utc_start": began,
            "airborne_s": [round(start, 3), round(end, 3)], "hops": [[round(start, 3), round(end, 3)]], "profile": "diagnosed in flight",
        },
        verdict=end_of.verdict, reason=end_of.reason, rotors=end_of.rotors, events=end_of.events, common_mode={},
        baseline=case.source,
        assumptions=(
            *case.assumptions,
            "diagnosed in flight from telemetry: the vehicle's own log has more data and is diagnosed as a whole",
        ),
        warnings=(), timing={}, headline=end_of.headline, main=end_of.main, advice=end_of.advice, story=end_of.story,
        fit_to_fly=end_of.fit_to_fly, causes=end_of.causes,
    )  # fmt: skip


def entry(session: Session, found: Diagnosis) -> Entry:
    """The store entry. There is no log: the hash is that of the answer."""
    content = {k: v for k, v in found.to_dict().items() if k != "timing"}
    who = identity.identify(session.about)
    name, start, end = str(found.flight["name"]), *found.flight["airborne_s"]
    return Entry(
        hash=hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest(), path="", name=name, size=0,
        identity=who.text, called=who.called, utc=found.flight["utc_start"], duration_s=end - start, airborne_s=end - start,
        autopilot=session.about.autopilot, firmware=session.about.firmware, frame=str(found.flight["frame"]), rotors=len(found.rotors),
        verdict=found.verdict, headline=found.headline, version=__version__, diagnosis=content,
    )  # fmt: skip
