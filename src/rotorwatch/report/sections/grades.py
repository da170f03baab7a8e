"""Grade and trend of every rotor."""

from __future__ import annotations

from itertools import pairwise

from rotorwatch.answer.wording import SCALE, percent, rate, seconds
from rotorwatch.flight.diagnosis import Diagnosis, RotorState
from rotorwatch.report.blocks import Block, Table, Text

name, title, order = "health", "Health of every rotor", 40
views = ("page", "terminal", "notebook")
VAGUE = 0.1  # a minute: a loss that may grow by more is not known to stay


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    return diagnosis if rows(diagnosis) else None


def words(data: Diagnosis) -> list[Block]:
    head = ("rotor", "where", "grade", "trend (95 % interval)")
    return [Table(head, rows(data), long=(3,), short=(0, 2), most=None, name=name), Text(scale(data))]


def summary(data: Diagnosis) -> list[Block]:
    """The rotors whose loss grows or shrinks."""
    said = " ".join(f"Rotor {r.rotor}: {_trend(r)}." for r in data.rotors if r.trend and r.trend.word in ("growing", "shrinking"))
    return [Text(said)] if said else []


def rows(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """(rotor, where, grade, trend) of every rotor in words; empty where nothing was assessed or control was lost."""
    if all(r.status == "unobservable" for r in diagnosis.rotors) or diagnosis.story:
        return []  # grades and trends of a flight that ended out of control would be of the time before
    rows = [(str(r.rotor), r.place, grade(r), _trend(r)) for r in diagnosis.rotors]
    return rows if any(grade or trend for _, _, grade, trend in rows) else []


def grade(state: RotorState) -> str:
    """A rotor's grade in words: 'worn', 'at most worn', 'weak or critical'; empty where it may be anything."""
    least, _, most = state.grade.partition(" to ")
    if least == "not assessed":
        return ""
    return least if not most else f"at most {most}" if least == SCALE[0][0] else f"{least} or {most}"


def _trend(state: RotorState) -> str:
    """The trend in words; empty where its interval goes beyond VAGUE."""
    t = state.trend
    if t is None or (t.word in ("no trend", "unclear") and max(abs(t.interval[0]), abs(t.interval[1])) > VAGUE):
        return ""
    if t.word in ("growing", "shrinking"):
        return f"{t.word}: {rate(t.per_minute)} a minute ({rate(t.interval[0])[:-2]} to {rate(t.interval[1])})"
    return f"{t.word} (within {rate(max(abs(t.interval[0]), abs(t.interval[1])))} a minute)"


def scale(diagnosis: Diagnosis) -> str:
    """Limits of the grades, and the part of the flight that the trends cover."""
    steps = [f"{name} below {percent(least)}" for (name, _), (_, least) in pairwise(SCALE)]
    spans = [(r.trend.start_s, r.trend.end_s) for r in diagnosis.rotors if r.trend]
    start, end = map(seconds, min(spans, default=(None, None)))
    of = f" Trends: growth of the loss from {start} to {end}, 95 % intervals." if spans else ""
    return f"Grades of the loss: {', '.join(steps)}, else {SCALE[-1][0]}.{of}"
