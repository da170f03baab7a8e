"""Looking for plug-ins: in a room of this package, whose modules nothing lists by hand; in other installed packages, which name theirs
as entry points; and by `module:Class`.

A package hands in an estimator, a plant or a detector by three lines of its pyproject.toml (docs/your-own-method.md):

    [project.entry-points."rotorwatch.estimators"]
    fixed_gain = "two_methods.fixed_gain:FixedGain"

The name on the left is the plug-in's own `name`.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from importlib import metadata
from types import ModuleType
from typing import Any

from rotorwatch.errors import ConfigError

GROUPS = {"rotorwatch.estimators": "estimator", "rotorwatch.systems": "plant", "rotorwatch.detectors": "detector"}


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


def offered(group: str) -> dict[str, metadata.EntryPoint]:
    """Name -> entry point of what other installed packages offer in a group of GROUPS; nothing is loaded."""
    found: dict[str, metadata.EntryPoint] = {}
    for entry in metadata.entry_points(group=group):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


def load(entry: metadata.EntryPoint, parts: tuple[str, ...]) -> Any:
    """The class or module that an entry point names. Raises ConfigError, one sentence that names the package, when it cannot be loaded,
    lacks one of `parts`, or has another `name` than the entry point."""
    kind = GROUPS.get(entry.group, "plug-in")
    whose = f"The {kind} {entry.name} of the package {package(entry)}"
    try:
        found = entry.load()
    except Exception as why:  # a stranger's module may raise anything
        raise ConfigError(f"{whose} cannot be loaded ({brief(why)}): mend that package or uninstall it.") from why
    _complete(whose, found, parts)
    if found.name != entry.name:
        raise ConfigError(f"{whose} calls itself {found.name!r}: its entry point must have the same name.")
    return found


def imported(text: str, parts: tuple[str, ...], kind: str) -> Any:
    """What `package.module:Class` names. Raises ConfigError, one sentence, for another form, a module that cannot be imported, or a class
    that lacks one of `parts`. kind: what it is to be, for the sentence."""
    module, _, label = text.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), *label.split("."))):
        raise ConfigError(f"{text!r} names no {kind}: write package.module:Class.")
    try:
        found: Any = importlib.import_module(module)
    except Exception as why:
        raise ConfigError(f"The {kind} {text} cannot be loaded: importing {module} failed ({brief(why)}).") from why
    for part in label.split("."):
        if not hasattr(found, part):
            raise ConfigError(f"The {kind} {text} cannot be loaded: {module} has no {label}.")
        found = getattr(found, part)
    _complete(f"The {kind} {text}", found, parts)
    return found


def _complete(whose: str, found: Any, parts: tuple[str, ...]) -> None:
    missing = [part for part in parts if not hasattr(found, part)]
    if missing:
        raise ConfigError(f"{whose} lacks {', '.join(missing)}: see docs/your-own-method.md for what it must have.")
    if not isinstance(found.name, str) or not found.name:
        raise ConfigError(f"{whose} must have a text as its name, not {found.name!r}.")


def package(entry: metadata.EntryPoint) -> str:
    """Name and version of the package that offers an entry point."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.module


def brief(why: BaseException) -> str:
    """An exception in one line."""
    return " ".join(f"{type(why).__name__}: {why}".split())[:200].rstrip(": ")
