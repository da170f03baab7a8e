"""The HTML report: one self-contained file that opens offline. Everything that comes from a log is escaped."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

from rotorwatch import __version__, report
from rotorwatch.base import files, optional
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import figures, markdown, markup, sections, words

SYMBOLS = {"healthy": "✓", "fault": "✕", "crashed": "✕", "ambiguous": "?", "inconclusive": "?"}
# Copies the post of `diagnose --markdown`, which the page holds; where a browser forbids copying, the text is shown selected.
COPY = (
    '<div class="copy"><button type="button" id="copy-markdown">Copy for a forum</button> <span role="status" id="copied"></span>'
    '<textarea id="post" readonly hidden aria-label="Post for a forum, as Markdown" rows="8"></textarea></div>'
)
# The page may run its own inline scripts and styles only, and fetch nothing.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:"


def write(diagnosis: Diagnosis, path: str | os.PathLike) -> None:
    """Write the page to `path` atomically. Raises ConfigError when the place cannot be written to."""
    text = page(diagnosis)
    try:
        with files.replacing(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    except ConfigError as why:
        raise ConfigError(f"The report {why}") from None


def page(diagnosis: Diagnosis) -> str:
    """The page's HTML text. Raises ConfigError without Bokeh."""
    optional.library("bokeh", "An HTML report")
    title = str(diagnosis.flight.get("name") or "flight")
    shown = sections.shown(diagnosis, "page")
    scripts, divs = embed(figures.drawn(diagnosis, shown))
    body = [
        masthead(title),
        '<main id="report">',
        _verdict(diagnosis),
        *(markup.section(one, divs) for one in shown),
        "</main>",
        _footer(diagnosis, title),
    ]
    data = diagnosis.to_json()
    post = json.dumps(markdown.text(diagnosis))
    blocks = [_data("diagnosis", data), _data("markdown", post), scripts]
    return document(f"{title}: {report.VERDICTS[diagnosis.verdict]}", [*body, *blocks])


def document(title: str, parts: Iterable[str]) -> str:
    """A whole page of these parts, in the report's style; empty ones are left out."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} – rotorwatch</title>\n"
        f"<style>{_own('page.css')}</style>\n</head>\n<body>\n" + "\n".join(part for part in parts if part) + "\n</body>\n</html>\n"
    )


def _data(name: str, text: str) -> str:
    """JSON for the page's script; inside a script element no tag may begin."""
    safe = text.replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{safe}</script>'


def _own(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def embed(plots: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The scripts (library, data, our own) and one element per plot. Without plots only our own script."""
    own = f"<script>{_own('page.js')}</script>"
    if not plots:
        return own, {}
    from bokeh.document import Document
    from bokeh.embed import components
    from bokeh.resources import Resources

    document = Document()
    with document.models.freeze():  # all plots at once: the data that they share are searched only once
        for plot in plots.values():
            document.add_root(plot)

    # Only the core library: no widgets, no tables, no GL, no MathJax.
    library = Resources(mode="inline", components=["bokeh"]).render_js()
    data, divs = components(dict(plots))
    return f"{library}\n{data}\n{own}", divs


def masthead(title: str) -> str:
    brand = f'<span class="brand">rotorwatch {escape(__version__)}</span>'
    return f'<header class="masthead"><b>{escape(title)}</b>{brand}</header>'


def _verdict(diagnosis: Diagnosis) -> str:
    tone = report.tone(diagnosis)
    word = f"{SYMBOLS[tone]} {report.verdict(diagnosis)}"
    lists = zip(("What to check", "What would make the answer surer"), report.steps(diagnosis))
    return (
        f'<section class="verdict {escape(tone)}"><div class="word">{escape(word)}</div>'
        f"<h1>{markup.text(diagnosis.headline)}</h1>{_story(diagnosis)}<p>{markup.text(report.sentence(diagnosis.reason))}</p>"
        + "".join(f'<h2>{title}</h2><ul class="advice">{_items(steps)}</ul>' for title, steps in lists if steps)
        + COPY
        + "</section>"
    )


def _items(texts: Iterable[str]) -> str:
    return "".join(f"<li>{markup.text(text)}</li>" for text in texts)


def _story(diagnosis: Diagnosis) -> str:
    """Course of events up to a loss of control."""
    items = _items(s.text for s in diagnosis.story)
    return f'<h2>What happened</h2><ol class="story">{items}</ol>' if items else ""


def _footer(diagnosis: Diagnosis, title: str) -> str:
    durations = ", ".join(f"{words(k)} {v:.2f} s" for k, v in diagnosis.timing.items())
    name = f"{title.partition('.')[0] or 'flight'}.json"
    return (
        f"<footer>Written by rotorwatch {escape(__version__)}, estimator {escape(diagnosis.estimator)}."
        f"{f' Time taken: {escape(durations)}.' if durations else ''} Times are in seconds from the first record of the log. "
        f'<button type="button" id="save-json" data-name="{escape(name)}">Save the answer as JSON</button></footer>'
    )
