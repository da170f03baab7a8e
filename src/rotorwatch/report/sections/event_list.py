"""Events: losses, contacts, desyncs, losses of control, with times, size and reason."""

from __future__ import annotations

from typing import Any

from rotorwatch import report
from rotorwatch.answer.wording import interval, losses, percent, probability, seconds
from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.flight.kinds import LOST
from rotorwatch.report import colours, markup
from rotorwatch.report.blocks import Block, Strong, Table, Text

name, title, order = "events", "Events", 50
post_top = True
OTHERS = 5  # events that the short terminal view names besides the main one
APART = ("history", "loss_2s", "size", "unit", "own_loss", "own_interval", "own_at_s")
"""Fields of an event that have a row of their own, or none."""


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    return diagnosis if diagnosis.events else None


def words(data: Diagnosis) -> list[Block]:
    rows = [_cells(e, data, k == data.main and len(data.events) > 1) for k, e in enumerate(data.events)]
    head = ("what", "rotor", "since", "found after", "loss (95 % interval)", "how sure")
    return [Table(head, rows, ranks=ranked(data), noun="event", most=None)]


def ranked(diagnosis: Diagnosis) -> list[int]:
    """Indices of the events, the most important first."""
    out: list[int] = []
    for count in range(1, len(diagnosis.events) + 1):
        out += [k for k in diagnosis.important(count) if k not in out]
    return out


def _cells(event: Event, diagnosis: Diagnosis, main: bool) -> tuple[str, ...]:
    lasted = event.end_s is not None and event.end_s > event.onset_s
    until = f" until {seconds(event.end_s)}" if lasted else ""
    return (
        Strong(event.means.noun) if main else event.means.noun,
        report.who(event, diagnosis),
        f"{seconds(event.onset_s)}{until}",
        f"{event.detected_s - event.onset_s:.2f} s",
        losses(event) or report.size(event) or "–",
        probability(event.probability),
    )


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    shown = data.trace is not None and data.trace.time.size > 1  # plots that can show where an event began
    items = []
    for number, e in enumerate(data.events, 1):
        several = number - 1 == data.main and len(data.events) > 1
        main = ' <span class="main">main event</span>' if several else ""
        items.append(
            f'<li style="--tint:{colours.of_event(e)}"><h3>{number}. {markup.text(report.sentence(e.means.noun))}: '
            f"{markup.text(report.who(e, data))}{main}</h3>"
            f"{markup.facts(rows(e, data))}<p>{markup.text(report.sentence(e.reason))}</p>"
            + (f'<p><a href="#t={e.onset_s:.2f}">Show where it began</a></p>' if shown else "")
            + "</li>"
        )
    return f'<h2>{title}</h2><ol class="events">{"".join(items)}</ol>'


def rows(event: Event, diagnosis: Diagnosis) -> dict[str, str]:
    """Label -> text of the fields that an event has, most important first."""
    lasts = event.end_s is None and event.means.lasts
    later = event.detected_s - event.onset_s
    own = event.extra.get("own_loss", ())
    rows = {
        "since": seconds(event.onset_s),
        "clock": report.moment(diagnosis, event.onset_s),
        "announced": f"{seconds(event.detected_s)} ({later:.2f} s later)",
        "until": "it lasts" if lasts else seconds(event.end_s) if event.end_s is not None else "",
        "loss (95 % interval)": losses(event),
        "estimate 2 s later": ", ".join(percent(v) for v in event.extra.get("loss_2s", ())),
        f"{diagnosis.estimator}'s own estimate": "; ".join(
            f"{percent(loss)} ({interval(*bounds)})" for loss, bounds in zip(own, event.extra.get("own_interval", ()))
        )
        + (f" at {seconds(event.extra['own_at_s'])}" if own else ""),
        "how sure": probability(event.probability),
        "size": report.size(event),
    }
    rest = {k: v for k, v in event.extra.items() if k not in APART}
    return {k: v for k, v in rows.items() if v} | {report.words(str(k)): report.plain(v) for k, v in rest.items()}


def summary(data: Diagnosis) -> list[Block]:
    """Events besides the main one; the story tells of losses of control."""
    others = [e for k, e in enumerate(data.events) if k != data.main and not (data.story and e.kind == LOST)]
    out: list[Block] = []
    for e in others[:OTHERS]:
        who = f" of {report.candidates(e)}" if e.rotors else ""
        out.append(Text(f"{seconds(e.onset_s)}: {e.means.noun}{who}"))
    return [*out, Text(f"and {len(others) - OTHERS} more events")] if len(others) > OTHERS else out


def screen(data: Diagnosis) -> list[Any]:
    from rich.text import Text as Line

    from rotorwatch.report import terminal

    rows, reasons = [], []
    for number, e in enumerate(data.events):
        main = " (main)" if number == data.main and len(data.events) > 1 else ""
        what = Line(f"{e.means.noun}{main}\n").append(report.candidates(e), style="bold")
        loss = "\n".join(losses(e).split(", ")) or report.size(e)
        times = [seconds(t) for t in (e.onset_s, e.detected_s, e.end_s)]
        rows.append([what, *map(Line, (*times, loss or "–", probability(e.probability)))])
        clock = report.moment(data, e.onset_s)
        reasons.append(terminal.aside(f"{seconds(e.onset_s)}{f' ({clock})' if clock else ''}: {e.reason}"))
    head = ("what", "since", "announced", "until", "loss (95 %)", "sure")
    return [terminal.Fitted(title, head, rows, right=(1, 2, 3, 4, 5), wide=(0,)), *reasons]
