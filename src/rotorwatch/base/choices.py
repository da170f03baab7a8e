"""Suggestions for an unknown name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def meant(given: Any, known: Iterable[Any], least: float = 0.6) -> str:
    """' (did you mean axkf?)', for a sentence on an unknown name; empty without a similar one. least: similarity, 0 to 1."""
    import difflib

    names = {str(name).lower(): str(name) for name in known if name is not None}
    near = difflib.get_close_matches(str(given).lower()[:60], names, 1, least)
    return f" (did you mean {names[near[0]]}?)" if near else ""
