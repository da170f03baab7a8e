"""What plug-ins there are: every module of a room is looked at, and nothing lists them by hand.

Names that start with an underscore, and classes that a module merely imports, do not count.
"""

from __future__ import annotations

import inspect
from typing import Any

from rotorwatch.errors import ConfigError
from rotorwatch.plugins import modules


def estimators() -> dict[str, type]:
    """Name -> class of every estimator (`core.Estimator`: name, init, step) in `rotorwatch.estimators`, and the default one."""
    return _classes(("rotorwatch.estimators", "rotorwatch.default"), ("name", "init", "step"))


def systems() -> dict[str, type]:
    """Name -> class of every plant (`core.System`: name, f, h) in `rotorwatch.systems`, and the default estimator's."""
    return _classes(("rotorwatch.systems", "rotorwatch.default"), ("name", "f", "h"))


def system(name: str) -> type:
    """The plant class of that name. Raises ConfigError that lists the known ones."""
    known = systems()
    if name not in known:
        raise ConfigError(f"There is no plant called {name!r}; known are {', '.join(known)}.")
    return known[name]


def estimator(name: str) -> type:
    """The estimator class of that name. Raises ConfigError that lists the known ones."""
    known = estimators()
    if name not in known:
        raise ConfigError(f"There is no estimator called {name!r}; known are {', '.join(known)}.")
    return known[name]


def _classes(rooms: tuple[str, ...], parts: tuple[str, ...]) -> dict[str, type]:
    """Classes defined in the rooms' modules that have all `parts`, by their `name`, in the order of names."""
    found: dict[str, type] = {}
    for module in (module for room in rooms for module in modules(room)):
        members: list[tuple[str, Any]] = inspect.getmembers(module, inspect.isclass)
        for label, kind in members:
            own = kind.__module__ == module.__name__ and not label.startswith("_")
            if not own or not all(hasattr(kind, part) for part in parts):
                continue
            if kind.name in found:
                raise TypeError(f"{kind.__module__} and {found[kind.name].__module__} are both called {kind.name!r}")
            found[kind.name] = kind
    return dict(sorted(found.items()))
