"""The files of the page, and pages with a single message."""

from __future__ import annotations

from functools import cache
from html import escape
from pathlib import Path

from rotorwatch import report

OWN, SHARED = Path(__file__).parent / "page", Path(report.__file__).parent
# All that is served as it lies in the package: by name from this table, never by a path.
FILES = {"page.css": SHARED / "page.css"} | {
    name: OWN / name for name in ("serve.css", "serve.js", "dom.js", "live.js", "flights.js", "icon.svg")
}
TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


@cache
def file(name: str) -> tuple[bytes, str] | None:
    """(content, type) of a file of the page; None when there is none of that name."""
    if name not in FILES:
        return None
    return FILES[name].read_bytes(), TYPES[FILES[name].suffix]


@cache
def index() -> str:
    """The page."""
    return (OWN / "index.html").read_text(encoding="utf-8")


def message(text: str, with_form: bool = False) -> str:
    """A page with one sentence; with_form: and a form for the token."""
    form = (
        '<form method="post" action="/login"><label for="token">Token</label> '
        '<input id="token" name="token" type="password" autocomplete="current-password" required> <button>Open</button></form>'
    )
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>rotorwatch</title>'
        '<link rel="stylesheet" href="/static/page.css"><link rel="stylesheet" href="/static/serve.css">'
    )
    body = f"<h1>rotorwatch</h1><p>{escape(text)}</p>{form if with_form else ''}"
    back = "" if with_form else '<p><a href="/">To the list of flights</a></p>'
    main = f'<main class="only">{body}{back}</main>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{main}</body></html>\n'
