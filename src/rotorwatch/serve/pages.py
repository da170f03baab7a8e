"""The files of the page, and small pages that only say something."""

from __future__ import annotations

from functools import cache
from html import escape
from pathlib import Path

from rotorwatch import report

OWN, SHARED = Path(__file__).parent / "page", Path(report.__file__).parent
# All that is served as it lies in the package: by name from this table, never by a path.
FILES = {
    "page.css": (SHARED / "page.css", "text/css"),
    "serve.css": (OWN / "serve.css", "text/css"),
    "serve.js": (OWN / "serve.js", "text/javascript"),
    "dom.js": (OWN / "dom.js", "text/javascript"),
    "live.js": (OWN / "live.js", "text/javascript"),
    "flights.js": (OWN / "flights.js", "text/javascript"),
    "icon.svg": (OWN / "icon.svg", "image/svg+xml"),
}


@cache
def file(name: str) -> tuple[bytes, str] | None:
    """(content, type) of a file of the page; None when there is none of that name."""
    if name not in FILES:
        return None
    path, kind = FILES[name]
    return path.read_bytes(), kind


@cache
def index() -> str:
    """The page."""
    return (OWN / "index.html").read_text(encoding="utf-8")


def message(text: str, asks: bool = False) -> str:
    """A page with one sentence; asks: with a form for the token."""
    form = (
        '<form method="post" action="/login"><label for="token">Token</label> '
        '<input id="token" name="token" type="password" autocomplete="current-password" required> <button>Open</button></form>'
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        "<title>rotorwatch</title>"
        '<link rel="stylesheet" href="/static/page.css"><link rel="stylesheet" href="/static/serve.css"></head><body>'
        f'<main class="only"><h1>rotorwatch</h1><p>{escape(text)}</p>{form if asks else ""}'
        f"{'' if asks else '<p><a href=&quot;/&quot;>To the list of flights</a></p>'.replace('&quot;', chr(34))}</main></body></html>\n"
    )
