"""What plug-ins there are: every module of a room is looked at, and nothing lists them by hand; and what other packages offer.

Names that start with an underscore, and classes that a module merely imports, do not count. A class can also be named as
`package.module:Class` wherever a name is asked for.
"""

from __future__ import annotations

import functools
import inspect
import sys
import warnings
from importlib import metadata
from typing import Any, NamedTuple

from rotorwatch import __version__, plugins
from rotorwatch.errors import ConfigError, PluginWarning
from rotorwatch.plugins import modules

ESTIMATOR, SYSTEM = ("name", "init", "step"), ("name", "f", "h")


class Source(NamedTuple):
    """Where a method comes from: the package and its version, and the class as `module:Class`."""

    package: str
    version: str
    path: str


def estimators() -> dict[str, type]:
    """Name -> class of every estimator (`core.Estimator`: name, init, step) in `rotorwatch.estimators`, the default one, and those that
    other packages offer as entry points `rotorwatch.estimators`; one that is broken is left out, with a PluginWarning."""
    return _with_offered("rotorwatch.estimators", _own_estimators(), ESTIMATOR)


def systems() -> dict[str, type]:
    """Name -> class of every plant (`core.System`: name, f, h) in `rotorwatch.systems`, the default estimator's, and those that other
    packages offer as entry points `rotorwatch.systems`."""
    return _with_offered("rotorwatch.systems", _own_systems(), SYSTEM)


def system(name: str) -> type:
    """The plant class of that name, or of `package.module:Class`. Raises ConfigError that lists the known ones."""
    return _named("rotorwatch.systems", name, _own_systems, SYSTEM)


def estimator(given: Any) -> Any:
    """What makes the estimator asked for: kind(system, dt) with `name`, `init` and `step`.

    given: a name, or `package.module:Class`; a class; a `functools.partial` of one with keywords; or an instance, of whose class another
    one is made with the same keywords, which it must keep as attributes of these names. Raises ConfigError that lists the known ones, or
    says what the thing that was given lacks.
    """
    if isinstance(given, str):
        return _named("rotorwatch.estimators", given, _own_estimators, ESTIMATOR)
    kind = given.func if isinstance(given, functools.partial) else given if inspect.isclass(given) else type(given)
    missing = [part for part in ESTIMATOR if not hasattr(kind, part)]
    if missing:
        raise ConfigError(
            f"{kind.__name__} is no estimator, it has no {missing[0]}: give a name, or a class (or an instance) with name, init and step."
        )
    return (
        given
        if inspect.isclass(given) or isinstance(given, functools.partial)
        else functools.partial(kind, **_keywords(given))
    )


def title(given: Any) -> str:
    """The name of an estimator that is given as for `estimator`."""
    if isinstance(given, str):
        return given
    kind = estimator(given)
    made: Any = kind.func if isinstance(kind, functools.partial) else kind
    return str(made.name)


def _keywords(instance: Any) -> dict[str, Any]:
    """The keywords that an instance was made with, beyond system and dt, as its attributes say."""
    found = {}
    for name, parameter in list(inspect.signature(type(instance)).parameters.items())[2:]:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        if not hasattr(instance, name):
            raise ConfigError(
                f"{type(instance).__name__} does not keep its keyword {name} as an attribute, so that no other one like it can be made: "
                f"give the class, or functools.partial({type(instance).__name__}, {name}=...)."
            )
        found[name] = getattr(instance, name)
    return found


def names() -> list[str]:
    """Names of all estimators, those of other packages included, which are not loaded for that."""
    return sorted({*_own_estimators(), *plugins.offered("rotorwatch.estimators")})


def source(found: Any) -> Source:
    """Where a class or a module comes from. A package that is not installed has no version."""
    module = getattr(found, "__module__", None) or found.__name__
    path = f"{module}:{found.__qualname__}" if inspect.isclass(found) else module
    top = module.partition(".")[0]
    if top == "rotorwatch":
        return Source("rotorwatch", __version__, path)
    for name in _distributions(top, tuple(sys.path)):
        return Source(name, metadata.version(name), path)
    for group in plugins.GROUPS:  # a package that is only on the path, with its metadata beside it
        for entry in plugins.offered(group).values():
            if entry.module.partition(".")[0] == top and entry.dist is not None:
                return Source(entry.dist.name, entry.dist.version, path)
    return Source(top, "", path)


@functools.cache
def _distributions(top: str, _path: tuple[str, ...]) -> list[str]:
    """Names of the installed packages that bring a module of that name; all that is installed is read for it, which takes a second."""
    return metadata.packages_distributions().get(top, [])


def about(found: Any) -> str:
    """What a plug-in says of itself: the first sentence of its module, or of its class where the module says nothing."""
    own = found if not inspect.isclass(found) else sys.modules.get(found.__module__)
    text = getattr(own, "__doc__", None) or found.__doc__ or ""
    return " ".join(text.split("\n\n")[0].split()).rstrip(".")


def _own_estimators() -> dict[str, type]:
    return _classes(("rotorwatch.estimators", "rotorwatch.default"), ESTIMATOR)


def _own_systems() -> dict[str, type]:
    return _classes(("rotorwatch.systems", "rotorwatch.default"), SYSTEM)


def _named(group: str, name: str, own: Any, parts: tuple[str, ...]) -> type:
    kind = plugins.GROUPS[group]
    if ":" in name:
        return plugins.imported(name, parts, kind)
    found = own()
    if name in found:
        return found[name]
    offered = plugins.offered(group)
    if name in offered:  # only this one is loaded: another package that is broken is no concern of who asks for it
        return plugins.load(offered[name], parts)
    known = ", ".join(sorted({*found, *offered}))
    raise ConfigError(f"There is no {kind} called {name!r}; known are {known}.")


def _with_offered(group: str, found: dict[str, type], parts: tuple[str, ...]) -> dict[str, type]:
    """Our own and those of other packages; ours stay what they are."""
    found = dict(found)
    for name, entry in plugins.offered(group).items():
        kind = plugins.GROUPS[group]
        if name in found:
            sentence = f"The {kind} {name} of the package {plugins.package(entry)} is not used: rotorwatch has one of that name."
            warnings.warn(sentence, PluginWarning, stacklevel=3)
            continue
        try:
            found[name] = plugins.load(entry, parts)
        except ConfigError as why:
            warnings.warn(str(why), PluginWarning, stacklevel=3)
    return dict(sorted(found.items()))


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
