"""Texts from outside (logs, links, file names, addresses) as they may be shown."""

from __future__ import annotations

import re

USER = re.compile(r"([a-z][a-z0-9+.-]*://)[^\s/?#]*@", re.IGNORECASE)
QUERY = re.compile(r"([a-z][a-z0-9+.-]*://[^\s?]*\?)[^\s:]*", re.IGNORECASE)


def printable(text: str) -> str:
    """The text with all that is no visible character written out, as in \\x1b or \\n.

    A terminal, and whoever reads a program's output, takes control characters as commands; bytes that are no text, \\udcXX, cannot be
    written at all.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def public(text: str) -> str:
    """The text with nothing in its addresses that only their owner may know: user and password go, and what is asked of a server."""
    return QUERY.sub(r"\1...", USER.sub(r"\1", text)) if "://" in text else text
