"""Findings of rotorwatch and of the other checks, in order of time."""

from __future__ import annotations

from rotorwatch.answer.wording import candidates, rotors, seconds
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.kinds import LOSS
from rotorwatch.report.blocks import Block, Table

name, title, order = "checks", "Detections by method", 310
views, post_order = ("page", "terminal", "post"), 60


def data(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]] | None:
    return rows(diagnosis) or None


def words(data: list[tuple[str, str, str, str]]) -> list[Block]:
    return [Table(("check", "found", "at", "why"), data, right=(2,), noun="finding")]


def rows(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """(check, finding, time, reason) of our events and of the other checks' findings, in order of time; empty without any."""
    method = "rotorwatch" if diagnosis.estimator == "default" else diagnosis.estimator
    rows = [(method if e.kind == LOSS else "rotorwatch", candidates(e), e.detected_s, e.means.noun) for e in diagnosis.events]
    for row in diagnosis.comparison:
        named = rotors((row["rotor"],) if row.get("rotor") else ())
        rows.append((str(row.get("detector", "")), named, row["time_s"], row.get("reason", "")))
    found = [(who, what, seconds(at), str(why)) for who, what, at, why in sorted(rows, key=lambda row: row[2])]
    if diagnosis.events and not diagnosis.comparison:
        found.append(_other_checks(str(diagnosis.flight.get("autopilot") or "")))
    return found


def _other_checks(autopilot: str) -> tuple[str, str, str, str]:
    """Row for other checks that found nothing, or for their absence: an autopilot's checks run on its own logs alone."""
    from rotorwatch import detectors

    names = ", ".join(module.name for module in detectors.for_autopilot(autopilot))
    if names:
        return names, "nothing", seconds(None), "as far as this log allows"
    why = f"no built-in check of {autopilot or 'this autopilot'} is available here"
    return "other checks", "none made", seconds(None), why
