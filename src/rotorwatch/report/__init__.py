"""Views of a diagnosis: terminal, HTML page, Markdown, MCAP, notebook, pictures. Words that several of them use are below."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

from rotorwatch.answer.wording import (  # noqa: F401 - re-exported
    BASELINE,
    SCALE,
    VERDICTS,
    candidates,
    interval,
    listed,
    losses,
    percent,
    probability,
    rate,
    rotors,
    seconds,
    sentence,
    up_to,
)
from rotorwatch.flight.diagnosis import Diagnosis, Event, RotorState


def verdict(diagnosis: Diagnosis) -> str:
    """Whether to fly again, and the verdict: 'Do not fly · Fault found'."""
    fit = diagnosis.fit_to_fly
    return f"{sentence(fit.word)} · {VERDICTS[diagnosis.verdict]}" if fit else VERDICTS[diagnosis.verdict]


TONES = {"fly": "healthy", "look first": "ambiguous", "do not fly": "fault", "cannot say": "inconclusive"}


def tone(diagnosis: Diagnosis) -> str:
    """The verdict whose colour and sign an answer gets: that of its word, so that a healthy flight with a knock is not green."""
    return TONES[diagnosis.fit_to_fly.word] if diagnosis.fit_to_fly else diagnosis.verdict


def steps(diagnosis: Diagnosis) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Recommended actions: what to check, and what would make the answer surer."""
    surer = diagnosis.fit_to_fly.surer if diagnosis.fit_to_fly else ()
    return tuple(step for step in diagnosis.advice if step not in surer), tuple(step for step in diagnosis.advice if step in surer)


def frame(diagnosis: Diagnosis) -> str:
    """Frame and number of rotors as far as known: 'hexa X, 6 rotors'."""
    facts = diagnosis.flight
    parts = [str(facts["frame"])] if facts.get("frame") else []
    if facts.get("rotors"):
        parts.append(f"{facts['rotors']} rotors")
    return ", ".join(parts) or "unknown frame"


def places(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Place of each rotor in words; empty texts when unknown."""
    return tuple(r.place for r in diagnosis.rotors)


def who(event: Event, diagnosis: Diagnosis) -> str:
    """Rotors of an event with their places, and the alternatives; the subject of an event without rotors."""
    return candidates(event, places(diagnosis))


def moment(diagnosis: Diagnosis, time: float | None) -> str:
    """A time of the log on the autopilot's own clock and in UTC, where the log has them: '95.21 s since boot, 14:03:27.2 UTC'."""
    boot, start = diagnosis.flight.get("boot_s"), diagnosis.flight.get("utc_start")
    parts = [f"{boot + time:.2f} s since boot"] if time is not None and boot else []
    if time is not None and start:
        parts.append(f"{_utc(start, time):%H:%M:%S.%f}"[:-5] + " UTC")
    return ", ".join(parts)


def day(diagnosis: Diagnosis) -> str:
    """UTC of the first record: '2026-11-21 07:40:36 UTC'; empty where the log has none."""
    start = diagnosis.flight.get("utc_start")
    return f"{_utc(start, 0.0):%Y-%m-%d %H:%M:%S} UTC" if start else ""


def _utc(start: str, time: float) -> datetime:
    return datetime.fromisoformat(str(start).replace("Z", "+00:00")) + timedelta(seconds=time)


def rotor_loss(state: RotorState) -> str:
    """Loss in words: '37.0 %'; '?' when not observable; 'none seen' where none was found and damage present at take-off was not checked."""
    if state.status == "unobservable" or (state.status == "suspect" and state.loss == 0.0):
        return "?"
    only_in_flight = state.status == "healthy" and state.from_takeoff in ("not assessed", "bounded")
    return "none seen" if only_in_flight else percent(state.loss, 1)


def rotor_interval(state: RotorState) -> str:
    """The 95 % interval in words: of the loss, or of the change since take-off where only that was estimated."""
    if state.status == "unobservable":
        return f"up to {up_to(state.since_takeoff[1])} unseen" if state.since_takeoff else ""
    if state.status == "healthy" and state.from_takeoff in ("not assessed", "bounded") and state.since_takeoff:
        at_all = f" (take-off {up_to(state.interval[1])})" if state.from_takeoff == "bounded" else " in flight"
        return f"at most {up_to(state.since_takeoff[1])}{at_all}"
    return interval(*state.interval)


def size(event: Event) -> str:
    """Size of a contact, '3.2 g'; number of desyncs, '7 times'."""
    if "count" in event.extra:
        return f"{event.extra['count']} time{'' if event.extra['count'] == 1 else 's'}"
    value = event.extra.get("size")
    return f"{value:.2g} {event.extra.get('unit', '')}".strip() if value is not None else ""


def words(key: str) -> str:
    """'detected_s' -> 'detected', 'high_current' -> 'high current'."""
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
