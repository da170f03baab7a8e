"""What people read: terminal tables and HTML pages. No estimation here; both say the same words, which are below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rotorwatch.diagnosis import Diagnosis
from rotorwatch.wording import (
    KINDS,
    VERDICTS,
    candidates,
    interval,
    kind,
    listed,
    losses,
    percent,
    probability,
    rotors,
    seconds,
    sentence,
)  # fmt: skip

__all__ = [
    "KINDS", "VERDICTS", "candidates", "comparison", "frame", "interval", "kind", "listed", "losses", "percent", "plain", "probability",
    "rotors", "seconds", "sentence", "words",
]  # fmt: skip


def frame(diagnosis: Diagnosis) -> str:
    """'hexa X, 6 rotors', as far as the flight says."""
    facts = diagnosis.flight
    parts = [str(facts["frame"])] if facts.get("frame") else []
    if facts.get("rotors"):
        parts.append(f"{facts['rotors']} rotors")
    return ", ".join(parts) or "unknown frame"


def comparison(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Who found what, when and why: our events among the other checks' findings, in time order. Empty without any."""
    ours = [
        ("rotorwatch", candidates(e) if e.rotors else "no single rotor", e.detected_s, kind(e))
        for e in diagnosis.events
    ]
    theirs = [
        (
            str(row.get("detector", "")),
            rotors((row["rotor"],) if row.get("rotor") else ()),
            row["time_s"],
            row.get("reason", ""),
        )
        for row in diagnosis.comparison
    ]
    rows = [(who, what, seconds(at), str(why)) for who, what, at, why in sorted(ours + theirs, key=lambda row: row[2])]
    if ours and not theirs:
        rows.append(_other_checks(str(diagnosis.flight.get("autopilot") or "")))
    return rows


def _other_checks(autopilot: str) -> tuple[str, str, str, str]:
    """The row that says which other checks found nothing, or that there is none: an autopilot's checks run on its own logs alone."""
    from rotorwatch import detectors

    names = ", ".join(module.name for module in detectors.of(autopilot))
    if names:
        return names, "nothing", seconds(None), "as far as this log lets it run"
    return (
        "other checks",
        "none made",
        seconds(None),
        f"no check of {autopilot or 'this autopilot'} itself is known here",
    )


def words(key: str) -> str:
    """'detected_s' -> 'detected', 'torque_bias' -> 'torque bias'."""
    return key.removesuffix("_s").replace("_", " ")


def plain(value: Any) -> str:
    """A value of a free-form part of the answer, short enough to read."""
    if isinstance(value, Mapping):
        return ", ".join(f"{words(str(k))} {plain(v)}" for k, v in value.items())
    if isinstance(value, str) or value is None or isinstance(value, bool):
        return {None: "–", True: "yes", False: "no"}.get(value, str(value))
    if hasattr(value, "__iter__"):
        return ", ".join(plain(v) for v in value)
    return f"{value:.4g}"
