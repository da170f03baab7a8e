"""What a method is and where it comes from: its description, package, version and class."""

from __future__ import annotations

import functools
import inspect
import sys
from importlib import metadata
from typing import Any, NamedTuple

from rotorwatch import __version__
from rotorwatch.base.discovery import GROUPS, OURS, offered


class Source(NamedTuple):
    """Origin of a method: the package and its version, and the class as `module:Class`."""

    package: str
    version: str
    path: str


def source(found: Any) -> Source:
    """Origin of a class or a module. A package that is not installed has no version."""
    module = getattr(found, "__module__", None) or found.__name__
    path = f"{module}:{found.__qualname__}" if inspect.isclass(found) else module
    top = module.partition(".")[0]
    if top == OURS:
        return Source(OURS, __version__, path)
    for group in GROUPS:
        for entry in offered(group).values():
            if entry.module.partition(".")[0] == top and entry.dist is not None:
                return Source(entry.dist.name, entry.dist.version, path)
    for name in _distributions(top, tuple(sys.path)):
        return Source(name, metadata.version(name), path)
    return Source(top, "", path)


@functools.cache
def _distributions(top: str, _path: tuple[str, ...]) -> list[str]:
    """Names of the installed packages that contain a module of that name; reading all installed packages takes a second."""
    return metadata.packages_distributions().get(top, [])


def about(found: Any) -> str:
    """Description of a plug-in: the first sentence of its module, or of its class where the module says nothing."""
    own = found if not inspect.isclass(found) else sys.modules.get(found.__module__)
    text = getattr(own, "__doc__", None) or found.__doc__ or ""
    return " ".join(text.split("\n\n")[0].split()).rstrip(".")
