"""Values of finished items in a folder, to resume an interrupted call.

One file an item, named by the hash of its inputs: version, function with its arguments, the item, and size and time of the logs it names.
Files are written atomically.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from rotorwatch import __version__
from rotorwatch.base import files

PLAIN = {"builtins": {"range", "set", "frozenset", "complex", "slice"}, "collections": {"OrderedDict", "deque"}}
OURS = ("rotorwatch.", "numpy.", "numpy")


class ResultCache:
    """The folder of one function's values. Raises ConfigError where it cannot be written."""

    def __init__(self, folder: str | os.PathLike, function: Callable[[Any], Any]):
        self._folder = files.folder(folder, "--keep")
        self._function = pickle.dumps((__version__, function))
        self._ours = (*OURS, _package(function))

    def place(self, item: Any) -> Path:
        """The file of an item's value, whether it is there or not."""
        digest = hashlib.sha256(self._function + pickle.dumps(item))
        for path in _files(item):
            state = os.stat(path)
            digest.update(f"{path} {state.st_size} {state.st_mtime_ns}\n".encode())
        return self._folder / f"{digest.hexdigest()[:32]}.part"

    def load(self, item: Any) -> tuple[Any] | None:
        """(value,), or None where there is none that can be read."""
        with suppress(Exception):  # torn or foreign data end in any of them
            with self.place(item).open("rb") as file:
                return (_Plain(file, self._ours).load(),)
        return None

    def save(self, item: Any, value: Any) -> None:
        """Keep a value. Raises ConfigError where the disk is full."""
        with files.replacing(self.place(item)) as path:
            path.write_bytes(pickle.dumps(value))


class _Plain(pickle.Unpickler):
    """Loads numbers, texts, arrays and types of packages that are trusted, and nothing that could run other code."""

    def __init__(self, file: Any, trusted: tuple[str, ...]):
        super().__init__(file)
        self._trusted = trusted

    def find_class(self, module: str, name: str) -> Any:
        if not (module.startswith(self._trusted) or name in PLAIN.get(module, ())):
            raise pickle.UnpicklingError(f"{module}.{name} is no value.")
        return super().find_class(module, name)


def _package(function: Any) -> str:
    """The beginning of the names of modules in the package of a function, or of the one that a partial one calls."""
    while hasattr(function, "func"):
        function = function.func
    return function.__module__.partition(".")[0] + "."


def _files(item: Any) -> Iterator[str]:
    """Texts in an item that name a file."""
    if isinstance(item, str):
        with suppress(OSError, ValueError):
            if os.path.isfile(item):
                yield item
    elif isinstance(item, tuple | list):
        for part in item:
            yield from _files(part)
