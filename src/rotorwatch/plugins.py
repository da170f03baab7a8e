"""Looking into a room: the modules of a package, and the class of a given name in one of them. Nothing lists them by hand."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType


def modules(package: str) -> Iterator[ModuleType]:
    """Every module of a package, those of its sub-packages included, in the order of their names; not those with an
    underscore in front."""
    parent = importlib.import_module(package)
    for info in pkgutil.walk_packages(parent.__path__, f"{package}."):
        if not info.name.rpartition(".")[2].startswith("_"):
            yield importlib.import_module(info.name)


def member(package: str, name: str):
    """The class of that name defined in one of the package's modules. Raises AttributeError: for modules' __getattr__.

    Importing a submodule asks for its name here first: only what looks like a class is searched for, because that loads all.
    """
    if name[:1].isupper():
        for module in modules(package):
            found = getattr(module, name, None)
            if getattr(found, "__module__", None) == module.__name__:
                return found
    raise AttributeError(f"module {package!r} has no attribute {name!r}")
