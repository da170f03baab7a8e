"""Isolation of displays, records, alerts and counters, whose failures must never end the evaluation."""

from __future__ import annotations

import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from rotorwatch.errors import RotorwatchError


def trouble(why: BaseException) -> str:
    """A sentence for an error; its traceback, too, on standard error under $ROTORWATCH_DEBUG."""
    if os.environ.get("ROTORWATCH_DEBUG") and sys.stderr is not None:
        with suppress(Exception):
            traceback.print_exception(type(why), why, why.__traceback__)
    if isinstance(why, RotorwatchError):
        return str(why)
    text = " ".join(f"{type(why).__name__}: {why}".split())[:200]
    return f"an internal error of rotorwatch ({text}); please report it"


class Guard:
    """Runs such work. notify: called once when a part of it begins to fail, and when it works again. failed: a sentence for each failing
    part, by its name."""

    def __init__(self, notify: Callable[[str], None]):
        self._notify, self._failing = notify, set[str]()
        self.failed: dict[str, str] = {}

    def run(self, what: str, work: Callable[..., Any], *args: Any) -> bool:
        """Run it; return whether it succeeded."""
        try:
            work(*args)
        except Exception as why:
            if what not in self._failing:
                self._failing.add(what)
                reason = f"{why.strerror or why}" if isinstance(why, OSError) else trouble(why)
                self.failed[what] = f"{what}: {reason.rstrip('.')}; the diagnosis continues."
                self._report(self.failed[what])
            return False
        if what in self._failing:
            self._failing.discard(what)
            self._report(f"{what}: it works again.")
        return True

    def _report(self, text: str) -> None:
        with suppress(Exception):  # notification may fail, too: `failed` has it
            self._notify(text)


def as_json(value: Any) -> str:
    """JSON of a value. NumPy numbers become numbers, nan and infinity null."""
    try:
        return json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return json.dumps(_plain(value), allow_nan=False)


def _plain(value: Any) -> Any:
    import numpy as np

    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(one) for name, one in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (str, int)) else str(value)
