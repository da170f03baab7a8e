"""Looking for plug-ins: in a room of this package, whose modules nothing lists by hand; in other installed packages, which name theirs
as entry points; and by `module:Class`.

A package hands in an estimator, a plant, a detector, a log format or an airframe by three lines of its pyproject.toml
(docs/your-own-method.md, docs/plug-ins.md):

    [project.entry-points."rotorwatch.estimators"]
    fixed_gain = "two_methods.fixed_gain:FixedGain"

The name on the left is the plug-in's own `name`; formats and airframes have none, so that any name will do for them.
"""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata
from types import ModuleType
from typing import Any

from rotorwatch.errors import ConfigError, PluginWarning

GROUPS = {
    "rotorwatch.estimators": "estimator",
    "rotorwatch.systems": "plant",
    "rotorwatch.detectors": "detector",
    "rotorwatch.logs": "log format",
    "rotorwatch.airframes": "airframe",
}


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


def others(
    group: str, parts: tuple[str, ...], refuse: Callable[[Any], str] = lambda found: ""
) -> Iterator[tuple[metadata.EntryPoint, Any]]:
    """Every plug-in of a group of GROUPS that other packages offer, loaded, with its entry point; one that is broken is left out, with a
    PluginWarning that names its package. refuse: says why one is not used ("its name is taken"), "" for one that is."""
    for entry in offered(group).values():
        try:
            found = load(entry, parts)
            if why := refuse(found):
                raise ConfigError(
                    f"The {GROUPS[group]} {entry.name} of the package {package(entry)} is not used: {why}."
                )
        except ConfigError as why:
            warnings.warn(str(why), PluginWarning, stacklevel=3)
            continue
        yield entry, found


def failed(entry: metadata.EntryPoint, what: str, why: BaseException) -> None:
    """Warn, by a PluginWarning, that a plug-in of another package raised. what: what it was asked for."""
    kind = GROUPS.get(entry.group, "plug-in")
    sentence = (
        f"The {kind} {entry.name} of the package {package(entry)} is passed over: its {what} failed ({brief(why)})."
    )
    warnings.warn(sentence, PluginWarning, stacklevel=3)


def load(entry: metadata.EntryPoint, parts: tuple[str, ...]) -> Any:
    """The class or module that an entry point names. Raises ConfigError, one sentence that names the package, when it cannot be loaded,
    lacks one of `parts`, or has another `name` than the entry point where `parts` asks for a name."""
    kind = GROUPS.get(entry.group, "plug-in")
    whose = f"The {kind} {entry.name} of the package {package(entry)}"
    try:
        found = entry.load()
    except Exception as why:  # a stranger's module may raise anything
        raise ConfigError(f"{whose} cannot be loaded ({brief(why)}): mend that package or uninstall it.") from why
    _complete(whose, found, parts)
    if "name" in parts and found.name != entry.name:
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
        raise ConfigError(f"{whose} lacks {', '.join(missing)}: see docs/plug-ins.md for what it must have.")
    if "name" not in parts:
        return
    if not isinstance(found.name, str) or not found.name:
        raise ConfigError(f"{whose} must have a text as its name, not {found.name!r}.")


def package(entry: metadata.EntryPoint) -> str:
    """Name and version of the package that offers an entry point."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.module


def brief(why: BaseException) -> str:
    """An exception in one line."""
    return " ".join(f"{type(why).__name__}: {why}".split())[:200].rstrip(": ")
