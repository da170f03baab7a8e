"""Logs of real flights without a known fault, anywhere in a repository."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rotorwatch import logs

SUFFIXES = (".ulg", ".bin", ".tlog", ".bfl", ".bbl", ".txt", ".log")
SEEN = "a motor stops: read off the log after the alarm"


def flights(
    checkout: Path, out: Path, patterns: Sequence[str] = ("**/*",), seen: Mapping[str, Sequence[float]] | None = None
) -> Iterator[dict[str, Any]]:
    """Rows of the logs that fit a pattern, each content once. seen: name of a log -> rotor and onset [s] of a fault that whoever looks at
    its outputs and rates sees."""
    known, seen = set(), seen or {}
    for pattern in patterns:
        for source in sorted(checkout.glob(pattern)):
            if source.suffix.lower() not in SUFFIXES or not source.is_file():
                continue
            digest = hashlib.sha256(source.read_bytes()).hexdigest()
            if digest in known:
                continue
            known.add(digest)
            sessions = logs.sessions(source)
            for path in map(Path, sessions if len(sessions) > 1 else [source]):
                row: dict[str, Any] = {"path": str(path), "group": "no known fault"}
                if path.name in seen:
                    rotor, onset = seen[path.name]
                    row |= {"group": SEEN, "rotor": str(int(rotor)), "onset_s": onset}
                yield row
