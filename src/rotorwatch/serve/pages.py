"""The files of the page, and pages with a single message."""

from __future__ import annotations

from functools import cache
from html import escape
from pathlib import Path

from rotorwatch import report

OWN, SHARED = Path(__file__).parent / "page", Path(report.__file__).parent
# Files served from the package: by name from this table, never by a path.
FILES = {"page.css": SHARED / "page.css"} | {path.name: path for path in OWN.iterdir() if path.suffix in (".css", ".js", ".svg")}
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
    """A page with one sentence; with_form: and a form for the token, sent to the requested address."""
    form = (
        '<form method="post"><label for="token">Token</label> '
        '<input id="token" name="token" type="password" autocomplete="current-password" required> <button>Open</button></form>'
    )
    body = f"<h1>rotorwatch</h1><p>{escape(text)}</p>{form if with_form else ''}"
    back = "" if with_form else '<p><a href="/">Back to the list of flights</a></p>'
    return page("rotorwatch", f'<main class="only">{body}{back}</main>')


def page(title: str, body: str, *more: str) -> str:
    """A page around a body. more: files of the page that it needs besides: styles, scripts."""
    links = "".join(
        f'<script type="module" src="/static/{name}"></script>'
        if name.endswith(".js")
        else f'<link rel="stylesheet" href="/static/{name}">'
        for name in ("page.css", "serve.css", *more)
    )
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
    head += f'<link rel="icon" href="/static/icon.svg">{links}'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}</body></html>\n'
