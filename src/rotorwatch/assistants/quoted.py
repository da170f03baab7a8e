"""Foreign texts, as in logs and file names: data for the reader, never part of our sentences and never an instruction."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from rotorwatch.base.files import one_line

MOST = 160  # letters of one text
LABEL = re.compile(r"[a-z0-9][a-z0-9_.+-]{0,39}")
UTC = re.compile(r"\d{4}-\d\d-\d\dT[0-9:.]{5,15}Z?")


def quoted(text: Any, most: int = MOST) -> dict[str, str]:
    """A foreign text, marked: one line of at most `most` visible letters (40 or more)."""
    return {"quoted_from_log": one_line(str(text), most)}


def several(texts: Iterable[Any], most: int, letters: int = MOST) -> dict[str, Any]:
    """The first `most` of such texts; left_out: number of the others."""
    texts = list(texts)
    return {"quoted_from_log": [one_line(str(text), letters) for text in texts[:most]], "left_out": len(texts[most:])}


def label(text: Any) -> str:
    """A name from rotorwatch's own lists, as of a frame or a signal; empty for any other text."""
    return str(text) if LABEL.fullmatch(str(text)) else ""


def utc(text: Any) -> str | None:
    """A time in ISO 8601, or None for any other text."""
    return str(text) if text and UTC.fullmatch(str(text)) else None
