"""All vehicles in a terminal, for reading at arm's length: faults first, then each rotor, the link, and missing data."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rotorwatch.answer.falls import CAUSES
from rotorwatch.answer.wording import percent, said
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOST, Span
from rotorwatch.live.alert_states import ANNOUNCED
from rotorwatch.live.routes import SILENT_S
from rotorwatch.live.watch import Source
from rotorwatch.live.watched import Watched

BAR = " ▁▂▃▄▅▆▇█"
SHOWN = 3  # events of a vehicle: a loss of control, and the newest
STYLES = {
    "LOST": "bold white on red",
    "FAULT": "bold white on red",
    "MAYBE": "bold black on yellow",
    "OK": "bold green",
    "SILENT": "bold yellow",
    "ERROR": "bold red",
}


@dataclass(frozen=True)
class Line:
    """A vehicle in words. state: LOST (control), FAULT, MAYBE, OK, GROUND, BLIND, SILENT or ERROR. rotors: (number, loss, style) of
    each."""

    name: str
    state: str
    rotors: tuple[tuple[int, float, str], ...]
    events: tuple[str, ...]
    link: str
    blind: str
    esc: str = ""


def lasting(events: Iterable[Event]) -> list[Event]:
    """Events that still apply: losses of control, motors in the wrong order, and faults that are not over."""
    return [e for e in events if e.means.ongoing(e.end_s)]


def line(watched: Watched, waits_for: str = "") -> Line:
    """The current line of a vehicle."""
    session, health = watched.session, watched.health
    silence = time.monotonic() - health.last_frame
    losses = None if session is None else session.losses()
    wrong = lasting(watched.events)
    blind = watched.trouble or (
        f"waiting for {waits_for}" if waits_for else "not known yet" if session is None else watched.gone or session.blind()
    )
    if any(e.kind == LOST for e in wrong):
        state = "LOST"
    elif watched.trouble:
        state = "ERROR"
    elif any(e.means.accuses and not e.alternatives for e in wrong):
        state = "FAULT"
    elif wrong:
        state = "MAYBE"
    elif silence > SILENT_S:
        state = "SILENT"
    elif session is not None and session.flying:
        state = "BLIND" if blind and not blind.startswith("thrust") else "OK"
    else:
        state = "GROUND"
    named = {r for e in wrong for r in e.rotors}
    bars = ()
    if losses is not None:
        bars = tuple((k + 1, float(loss), "bold red" if k + 1 in named else "") for k, loss in enumerate(losses[0]))
    now = 0.0 if session is None else session.now
    newest = sorted(watched.events, key=lambda e: (e.kind != LOST, -e.detected_s))[:SHOWN]
    alerts = tuple(words(e, now) for e in newest)
    return Line(watched.name, state, bars, alerts, _link(health, silence), blind, watched.rotors.words())


def announced(alert: dict) -> str:
    """The alert of an event, as a sentence that names the rotors first; of a new one with the reason."""
    event = Event.from_dict(alert["event"])
    what = words(event)
    why = f"; {event.reason}" if alert["state"] == ANNOUNCED and event.reason not in what else ""
    return f"{alert['state']}: {what}{why}"


def words(event: Event, now: float | None = None) -> str:
    """The event and its time; its age, when `now` is given."""
    ago = f"{event.onset_s:.1f} s" + ("" if now is None else f" ({max(now - event.onset_s, 0.0):.0f} s ago)")
    over = "" if event.end_s is None or event.means.span is Span.MOMENT else f", over at {event.end_s:.1f} s"
    others = f"; or {' or '.join('+'.join(map(str, a)) for a in event.alternatives)}" if event.alternatives else ""
    why = CAUSES.get(event.extra.get("cause", ""), "")
    return said(event.means.watch, event, ago=ago, over=over, others=others, lost_why=why)


def _link(health, silence: float) -> str:
    parts = [f"silent for {silence:.0f} s"] if silence > SILENT_S else []
    parts += [health.words()] if health.words() else []
    return ", ".join(parts) or "good"


def _besides(shown: Line) -> list[str]:
    return [f"link: {shown.link}", *([f"blind: {shown.blind}"] if shown.blind else []), *([shown.esc] if shown.esc else [])]


def table(sources: Sequence[Source]) -> Any:
    """All vehicles of all sources, as a Rich table."""
    from rich.console import Group
    from rich.padding import Padding
    from rich.text import Text

    parts: list[Any] = []
    for source in sources:
        for watched, waits_for in source.shown():
            row = line(watched, waits_for)
            head = Text(f" {row.state:<6} ", STYLES.get(row.state, "bold"))
            head.append(f" {row.name}  ", "bold default on default")
            for number, loss, style in row.rotors:
                bar = BAR[min(round(loss * (len(BAR) - 1)), len(BAR) - 1)]
                head.append(f" {number}", style or "default not bold on default")
                head.append(f"{bar}", style or "default not bold on default")
                head.append(f"{percent(loss):>5}" if loss >= 0.01 else "    –", style or "default not bold on default")
            parts.append(head)
            parts += [Padding(Text(event), (0, 0, 0, 9)) for event in row.events]
            parts.append(Padding(Text("; ".join(_besides(row)), "dim"), (0, 0, 0, 9)))
        if sentences := getattr(source, "trouble", ""):
            parts.append(Text(sentences, "bold red"))
    return Group(*parts) if parts else Text("nothing received yet")
