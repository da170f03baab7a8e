"""Texts from outside (logs, links, file names) as they may be shown."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text with all that is no visible character written out, as in \\x1b or \\n.

    A terminal, and whoever reads a program's output, takes control characters as commands; bytes that are no text, \\udcXX, cannot be
    written at all.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
