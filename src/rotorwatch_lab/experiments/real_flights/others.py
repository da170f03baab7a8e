"""Logs of real flights without a known fault, anywhere in a repository."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rotorwatch import logs

UNKNOWN = "what happened is not known"
SUFFIXES = (".ulg", ".bin", ".tlog", ".bfl", ".bbl", ".txt", ".log")


def flights(checkout: Path, out: Path, patterns: Sequence[str] = ("**/*",), unknown: Sequence[str] = ()) -> Iterator[dict[str, Any]]:
    """Rows of the logs that fit a pattern, each content once; their group is UNKNOWN for those of names `unknown`."""
    seen: set[str] = set()
    for pattern in patterns:
        for source in sorted(checkout.glob(pattern)):
            if source.suffix.lower() not in SUFFIXES or not source.is_file():
                continue
            digest = hashlib.sha256(source.read_bytes()).hexdigest()
            if digest in seen:
                continue
            seen.add(digest)
            sessions = logs.sessions(source)
            group = UNKNOWN if source.name in unknown else "no known fault"
            yield from ({"path": str(path), "group": group} for path in (sessions if len(sessions) > 1 else [source]))
