"""Foreign names, made harmless: shown as text, and never a path."""

from __future__ import annotations

import re
from urllib.parse import quote, unquote_to_bytes

from rotorwatch.base.files import one_line

MOST = 200  # letters of a name


def shown(header: str) -> str:
    """The name of an uploaded file as people may see it: the last part of a path, without signs that control a terminal, turn the
    direction of writing around or are no letters at all. header: percent-encoded UTF-8, as it stands in a header."""
    text = unquote_to_bytes(header[: 20 * MOST]).decode("utf-8", "replace")
    last = re.split(r"[/\\]", text)[-1]
    plain = one_line(last, MOST)
    return plain if plain.strip(". ") else "flight"


def on_disk(name: str) -> str:
    """A file name for it: its ending is kept, because some formats are known by it."""
    return "log-" + re.sub(r"[^A-Za-z0-9._]+", "_", name)[-60:]


def attachment(name: str) -> str:
    """The header Content-Disposition of the report of a log of that name: saved as NAME-report.html by all systems, whatever the name."""
    stem = re.sub(r"(?i)(\.(xz|gz|bz2))?$", "", one_line(re.split(r"[/\\]", name)[-1], MOST))
    stem = re.sub(r'[<>:"|?*%]+', "_", re.sub(r"\.\w{1,8}$", "", stem)).strip(". ") or "flight"
    plain = re.sub(r"[^A-Za-z0-9 ._()+-]+", "_", stem)
    return f"attachment; filename=\"{plain}-report.html\"; filename*=UTF-8''{quote(stem, safe='')}-report.html"
