"""Flight modes, errors and texts of the autopilot."""

from __future__ import annotations

from rotorwatch import report
from rotorwatch.answer.wording import seconds
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import markup
from rotorwatch.report.blocks import Block, Bullets, Logged

name, title, order = "messages", "Messages of the autopilot around the main event", 320
views, post_order = ("page", "post"), 50
MOST = 300  # messages on the page
AROUND_S, MOST_AROUND = 10.0, 8  # messages in a post


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    return diagnosis if diagnosis.trace is not None and diagnosis.trace.messages else None


def words(data: Diagnosis) -> list[Block]:
    return [Bullets([(f"{seconds(t)} {kind}: ", Logged(text)) for t, kind, text in around(data)])]


def around(diagnosis: Diagnosis) -> list[tuple[float, str, str]]:
    """(time s, kind, text) of the messages closest to the main event, in order of time; none without one or without a trace."""
    if diagnosis.main is None or diagnosis.trace is None:
        return []
    event = diagnosis.events[diagnosis.main]
    start, end = event.onset_s - AROUND_S, max(event.onset_s, event.detected_s) + AROUND_S
    near = [m for m in diagnosis.trace.messages if start <= m[0] <= end]
    return sorted(sorted(near, key=lambda m: abs(m[0] - event.onset_s))[:MOST_AROUND])


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    assert data.trace is not None
    messages = data.trace.messages
    rows = (markup.row((seconds(t), report.moment(data, t), *what)) for t, *what in messages[:MOST])
    table = markup.table(markup.row(("at", "clock", "what", "text"), cell="th"), "".join(rows))
    more = f"<p>The first {MOST} of {len(messages)}.</p>" if len(messages) > MOST else ""
    return f"<details><summary>Modes and messages of the autopilot ({len(messages)})</summary>{table}{more}</details>"
