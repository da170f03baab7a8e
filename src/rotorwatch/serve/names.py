"""Sanitised foreign names: displayed as text, and never used as a path."""

from __future__ import annotations

import re
from urllib.parse import quote, unquote_to_bytes

from rotorwatch.base.files import one_line

MOST = 200  # letters of a name


def shown(header: str) -> str:
    """The name of an uploaded file for display: the last part of a path, without terminal control characters, bidirectional overrides and
    undecodable bytes. header: percent-encoded UTF-8, as in a header."""
    text = unquote_to_bytes(header[: 20 * MOST]).decode("utf-8", "replace")
    last = re.split(r"[/\\]", text)[-1]
    plain = one_line(last, MOST)
    return plain if plain.strip(". ") else "flight"


def on_disk(name: str) -> str:
    """A file name for it that keeps its ending, by which some formats are recognised."""
    return "log-" + re.sub(r"[^A-Za-z0-9._]+", "_", name)[-60:]


def attachment(name: str) -> str:
    """The header Content-Disposition of the report of a log of that name: saved as NAME-report.html by all systems."""
    stem = re.sub(r"(?i)(\.(xz|gz|bz2))?$", "", one_line(re.split(r"[/\\]", name)[-1], MOST))
    stem = re.sub(r'[<>:"|?*%]+', "_", re.sub(r"\.\w{1,8}$", "", stem)).strip(". ") or "flight"
    plain = re.sub(r"[^A-Za-z0-9 ._()+-]+", "_", stem)
    return f"attachment; filename=\"{plain}-report.html\"; filename*=UTF-8''{quote(stem, safe='')}-report.html"
