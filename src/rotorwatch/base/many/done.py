"""The result of an item: its value, or the exception that it ended with."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rotorwatch.errors import RotorwatchError


@dataclass(frozen=True, slots=True)
class Done:
    """index: of the item, from 0. value: what the function returned; error: what it raised instead, or a WorkerError."""

    index: int
    value: Any = None
    error: Exception | None = None

    def result(self) -> Any:
        """The value. Raises the error where there is one."""
        if self.error is not None:
            raise self.error
        return self.value


@dataclass(frozen=True, slots=True)
class Task:
    """An item in work. tries: number of workers that died of it."""

    index: int
    item: Any
    tries: int = 0


def attempt(function: Callable, item: Any) -> tuple[Any, Exception | None]:
    """(value, None), or (None, the exception)."""
    try:
        return function(item), None
    except Exception as why:
        return None, why


def packed(value: Any, error: Exception | None) -> bytes:
    """(value, error) as bytes; a value that cannot be pickled becomes an error that says so."""
    try:
        return pickle.dumps((value, None if error is None else portable(error)))
    except Exception as why:
        return pickle.dumps((None, portable(RuntimeError(f"The result cannot be sent back ({why})."))))


def portable(why: Exception) -> Exception:
    """The exception in a form that can be sent to another process. An unexpected one carries its traceback as a note."""
    where = "".join(traceback.format_exception(why))
    try:
        if type(pickle.loads(pickle.dumps(why))) is not type(why):
            raise TypeError
    except Exception:
        why = RuntimeError(f"{type(why).__name__}: {why}")
    if not isinstance(why, RotorwatchError):
        why.__notes__ = [*getattr(why, "__notes__", ()), where]  # add_note is not in Python 3.10
    return why
