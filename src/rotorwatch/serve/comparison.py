"""The page of two flights side by side."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from rotorwatch import report
from rotorwatch.fleet.compare import Comparison, Moment, Row
from rotorwatch.report import drawing
from rotorwatch.report.html import SYMBOLS
from rotorwatch.serve.pages import page as around

LETTERS = "AB"


def page(found: Comparison) -> str:
    """The page, as text. Its script sets the colours of the drawings: inline styles are forbidden on this server's pages."""
    swap = f"/compare?a={found.flights[1]['hash']}&amp;b={found.flights[0]['hash']}"
    body = (
        '<header class="masthead"><nav aria-label="rotorwatch"><a href="/">All flights</a></nav>'
        f'<a href="{swap}">Swap A and B</a></header>'
        f'<main id="compared"><h1>Two flights compared</h1><p class="lead">{escape(found.headline)}</p>'
        f'<div class="pair">{_card(found, 0)}{_card(found, 1)}</div>'
        "<h2>Rotors</h2><p>Loss of effectiveness with its 95 % interval. ≠ marks a rotor whose state differs, or whose intervals do "
        f"not overlap.</p>{_table(found.rotors, 'rotor')}"
        f'<h2>Events</h2><div class="pair">{_events(found, 0)}{_events(found, 1)}</div>'
        f"<h2>Flight, vehicle and log</h2>{_table(found.facts, 'what')}</main>"
        "<footer>Times are in seconds from the first record of each log.</footer>"
    )
    return around("Two flights compared – rotorwatch", body, "compare.css", "compare.js")


def _card(found: Comparison, k: int) -> str:
    flight, answer = found.flights[k], found.answers[k]
    word = f"{SYMBOLS[answer.verdict]} {report.VERDICTS[answer.verdict]}"
    at = f"/flights/{flight['hash']}"
    picture = drawing.airframe(answer).replace("spin-tip", f"spin-tip-{LETTERS[k]}").replace(' style="', ' data-style="')
    return (
        f'<section class="verdict {escape(answer.verdict)}" aria-labelledby="name-{LETTERS[k]}">'
        f'<h2 id="name-{LETTERS[k]}"><span class="letter">{LETTERS[k]}</span> <bdi>{escape(flight["name"])}</bdi></h2>'
        f'<div class="word">{escape(word)}</div><p class="what">{escape(answer.headline)}</p>{picture}'
        f'<p class="doors"><a href="{at}">Open the report of {LETTERS[k]}</a> <a href="{at}/download">Download it</a></p></section>'
    )


def _table(rows: Iterable[Row], what: str) -> str:
    head = "".join(f'<th scope="col" role="columnheader">{letter}</th>' for letter in LETTERS)
    lines = "".join(_line(row) for row in rows)
    first = f'<th scope="col" role="columnheader">{what}</th>'
    return (
        f'<table role="table"><thead role="rowgroup"><tr role="row">{first}{head}</tr></thead>'
        f'<tbody role="rowgroup">{lines}</tbody></table>'
    )


def _line(row: Row) -> str:
    mark = '<span class="mark" aria-hidden="true">≠</span><span class="unseen">differs: </span>' if row.differs else ""
    cells = "".join(f'<td role="cell" data-of="{letter}">{escape(value)}</td>' for letter, value in zip(LETTERS, row.values))
    kind = ' class="differs"' if row.differs else ""
    return f'<tr role="row"{kind}><th scope="row" role="rowheader">{mark}{escape(row.what)}</th>{cells}</tr>'


def _events(found: Comparison, k: int) -> str:
    at = f"/flights/{found.flights[k]['hash']}"
    items = "".join(_event(event, LETTERS[k], at) for event in found.events[k])
    listed = f'<ol class="moments">{items}</ol>' if items else "<p>No event.</p>"
    return f'<section aria-label="Events of {LETTERS[k]}"><h3><span class="letter">{LETTERS[k]}</span></h3>{listed}</section>'


def _event(event: Moment, letter: str, report_at: str) -> str:
    mark = f'<span class="mark" aria-hidden="true">≠</span><span class="unseen">only in {letter}: </span>' if event.alone else ""
    kind = ' class="differs"' if event.alone else ""
    at = f"{event.onset_s:.2f}"
    link = f'<a href="{report_at}#t={at}">see it at {at} s<span class="unseen"> in the report of {letter}</span></a>'
    return f"<li{kind}>{mark}{escape(event.text)} {link}</li>"
