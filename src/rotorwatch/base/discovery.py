"""Plug-ins: modules of a package of ours, which nothing lists by hand; entry points of installed packages; and `package.module:Class`,
wherever a name is accepted.

Names that start with an underscore, and classes that a module merely imports, do not count. A package adds an estimator, a plant, a
detector, a log format or an airframe by two lines of its pyproject.toml (docs/your-own-method.md, docs/plug-ins.md):

    [project.entry-points."rotorwatch.estimators"]
    fixed_gain = "two_methods.fixed_gain:FixedGain"

The name on the left is the plug-in's own `name`; formats and airframes have none, so that any name will do for them. An estimator or a
plant may also be a package without `:Class`: every class of its modules counts then, under its own `name`.

Three more groups extend the program itself; `rotorwatch_lab`, in the same wheel, uses these and the two above:

    rotorwatch.commands     name of a command (GROUP.NAME in a group of commands) -> a click command
    rotorwatch.api          name -> function or module: `rotorwatch.NAME`
    rotorwatch.estimation   any name -> a function that runs an estimator over a flight's ticks, for `diagnose(estimator=...)`
"""

from __future__ import annotations

import functools
import importlib
import importlib.machinery
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError, PluginWarning

if TYPE_CHECKING:  # it takes longer to load than a log takes to read
    from importlib import metadata

ESTIMATOR = ("name", "init", "step")
PARTS = {"rotorwatch.estimators": ESTIMATOR, "rotorwatch.systems": ("name", "f", "h")}
GROUPS = {
    "rotorwatch.estimators": "estimator",
    "rotorwatch.systems": "plant",
    "rotorwatch.detectors": "detector",
    "rotorwatch.logs": "log format",
    "rotorwatch.airframes": "airframe",
    "rotorwatch.commands": "command",
    "rotorwatch.api": "function",
    "rotorwatch.estimation": "runner of estimators",
    "rotorwatch.witnesses": "witness",
    "rotorwatch.sections": "report section",
}
OURS = "rotorwatch"  # our distribution; its classes come first
DEFAULT = "rotorwatch.engine.bindings"  # the package that holds the default estimator and its plant


def estimators() -> dict[str, type]:
    """Name -> class of every estimator (`core.Estimator`: name, init, step): the default one and those that installed packages offer as
    entry points `rotorwatch.estimators`; one that is broken is left out, with a PluginWarning."""
    return _with_offered("rotorwatch.estimators")


def systems() -> dict[str, type]:
    """Name -> class of every plant (`core.System`: name, f, h): the default estimator's and those that installed packages offer as entry
    points `rotorwatch.systems`."""
    return _with_offered("rotorwatch.systems")


def system(name: str) -> type:
    """The plant class of that name, or of `package.module:Class`. Raises ConfigError that lists the known ones."""
    return _named("rotorwatch.systems", name)


def estimator(spec: Any) -> Any:
    """The constructor of an estimator: kind(system, dt) with `name`, `init` and `step`.

    spec: a name, or `package.module:Class`; a class; a `functools.partial` of one with keywords; or an instance, of whose class another
    one is made with the same keywords, which it must keep as attributes of these names. Raises ConfigError that lists the known ones, or
    names the part that `spec` lacks."""
    if isinstance(spec, str):
        return _named("rotorwatch.estimators", spec)
    kind = spec.func if isinstance(spec, functools.partial) else spec if inspect.isclass(spec) else type(spec)
    missing = [part for part in ESTIMATOR if not hasattr(kind, part)]
    if missing:
        raise ConfigError(
            f"{kind.__name__} is no estimator, it has no {missing[0]}: give a name, or a class (or an instance) with name, init and step."
        )
    return spec if inspect.isclass(spec) or isinstance(spec, functools.partial) else functools.partial(kind, **_keywords(spec))


def title(spec: Any) -> str:
    """The name of an estimator; spec: as for `estimator`."""
    if isinstance(spec, str):
        return spec
    kind = estimator(spec)
    made: Any = kind.func if isinstance(kind, functools.partial) else kind
    return str(made.name)


def _keywords(instance: Any) -> dict[str, Any]:
    """The keywords that an instance was made with, beyond system and dt, from its attributes."""
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
    """Names of all estimators; classes of other packages that are named one by one are not loaded for that."""
    return sorted({*_own("rotorwatch.estimators"), *_single("rotorwatch.estimators")})


def _named(group: str, name: str) -> type:
    kind, parts = GROUPS[group], PARTS[group]
    if ":" in name:
        return imported(name, parts, kind)
    found = _own(group)
    if name in found:
        return found[name]
    theirs = _single(group)
    if name in theirs:  # only this one is loaded: a broken package must not keep others from being used
        return load(theirs[name], parts)
    known = sorted({*found, *theirs})
    listed = f"There is no {kind} called {name!r}{meant(name, known)}; known are {', '.join(known)}"
    if not any(entry.dist is not None and entry.dist.name == OURS and _installed(entry) for entry in offered(group).values()):
        listed += f"; published ones need rotorwatch_lab, which is not installed: pip install '{OURS}[research]'"
    raise ConfigError(f"{listed}.")


def _with_offered(group: str) -> dict[str, type]:
    """Built-in classes and those of other packages; built-in names take precedence."""
    found = _own(group)
    for name, entry in _single(group).items():
        kind = GROUPS[group]
        if name in found:
            sentence = f"The {kind} {name} of the package {package(entry)} is not used: rotorwatch has one of that name."
            warnings.warn(sentence, PluginWarning, stacklevel=3)
            continue
        try:
            found[name] = load(entry, PARTS[group])
        except ConfigError as why:
            warnings.warn(str(why), PluginWarning, stacklevel=3)
    return dict(sorted(found.items()))


def _single(group: str) -> dict[str, metadata.EntryPoint]:
    """The entry points of a group that name one class each."""
    return {name: entry for name, entry in offered(group).items() if entry.attr}


def _own(group: str) -> dict[str, type]:
    """Classes of the default method and of the packages that are offered as a whole, by their `name`, in order of names. Another package's
    that cannot be imported, or has a name that is taken, is left out with a PluginWarning; of ours both raise. One that is not installed
    offers nothing."""
    found = _classes(DEFAULT, group)
    for entry in sorted(offered(group).values(), key=_not_ours):
        if entry.attr:
            continue
        try:
            for name, kind in _classes(entry.module, group).items():
                _once(name, kind, found)
                found[name] = kind
        except Exception as why:  # a module of another package may raise anything
            if absent(entry, why):
                continue
            if not _not_ours(entry):
                raise
            sentence = f"The {GROUPS[group]}s of the package {package(entry)} are not used ({brief(why)})."
            warnings.warn(sentence, PluginWarning, stacklevel=4)
    return dict(sorted(found.items()))


def _not_ours(entry: metadata.EntryPoint) -> bool:
    return entry.dist is None or entry.dist.name != OURS


def _classes(whole: str, group: str) -> dict[str, type]:
    """Classes defined in the modules of a package that have all the parts, by their `name`."""
    found: dict[str, type] = {}
    for module in modules(whole):
        members: list[tuple[str, Any]] = inspect.getmembers(module, inspect.isclass)
        for label, kind in members:
            own = kind.__module__ == module.__name__ and not label.startswith("_")
            if own and all(hasattr(kind, part) for part in PARTS[group]):
                _once(kind.name, kind, found)
                found[kind.name] = kind
    return found


def _once(name: str, kind: type, found: dict[str, type]) -> None:
    if name in found:
        raise TypeError(f"{kind.__module__} and {found[name].__module__} are both called {name!r}")


def modules(package: str, deep: bool = True) -> Iterator[ModuleType]:
    """Every module of a package, in the order of their names, or a module itself; not those with an underscore in front. deep: with those
    of its sub-packages."""
    depth = package.count(".") + 1
    yield from (importlib.import_module(name) for name in _names(package) if deep or name.count(".") == depth)


@functools.cache
def _names(package: str) -> tuple[str, ...]:
    import pkgutil

    parent = importlib.import_module(package)
    if not hasattr(parent, "__path__"):
        return (package,)
    names = (info.name for info in pkgutil.walk_packages(parent.__path__, f"{package}."))
    return tuple(name for name in names if not name.rpartition(".")[2].startswith("_"))


def member(package: str, name: str):
    """The class of that name defined in one of the package's modules. Raises AttributeError: for modules' __getattr__.

    Importing a submodule asks for its name here first: only what looks like a class is searched for, because that loads all."""
    if name[:1].isupper():
        for module in modules(package):
            found = getattr(module, name, None)
            if getattr(found, "__module__", None) == module.__name__:
                return found
    raise AttributeError(f"module {package!r} has no attribute {name!r}")


def offered(group: str) -> dict[str, metadata.EntryPoint]:
    """Name -> entry point that installed packages, ours included, offer in a group of GROUPS; nothing is loaded. Of two packages that
    offer one name, ours comes first."""
    return dict(_offered(group, _folders()))


def _folders() -> tuple[tuple[str, int], ...]:
    """Folders in which packages are found, with the time of their last change: installing a package changes it."""
    found = []
    for folder in sys.path:
        try:
            found.append((folder or ".", os.stat(folder or ".").st_mtime_ns))
        except OSError:  # not there
            continue
    return tuple(found)


@functools.cache
def _offered(group: str, folders: tuple[tuple[str, int], ...]) -> dict[str, metadata.EntryPoint]:
    mentioned = _mentioned(folders)
    if mentioned is not None and group not in mentioned:
        return {}
    from importlib import metadata

    found: dict[str, metadata.EntryPoint] = {}
    entries = list(metadata.entry_points(group=group))
    for entry in sorted(entries, key=_not_ours):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


@functools.cache
def _mentioned(folders: tuple[tuple[str, int], ...]) -> frozenset[str] | None:
    """The groups of GROUPS in which an installed package names entry points: without one, `importlib.metadata` need not be loaded. None
    where packages are not found in folders alone, so that any group may be there."""
    finders = (finder for finder in sys.meta_path if finder is not importlib.machinery.PathFinder)
    if any(hasattr(finder, "find_distributions") for finder in finders):
        return None
    groups: set[str] = set()
    for folder, _ in folders:
        if not os.path.isdir(folder):
            return None
        for name in os.listdir(folder):
            if name.endswith(".egg"):
                return None
            if name.endswith((".dist-info", ".egg-info")):
                try:
                    with open(os.path.join(folder, name, "entry_points.txt"), "rb") as file:
                        text = file.read()
                except OSError:  # it has none
                    continue
                if b"[rotorwatch." in text:
                    groups |= {group for group in GROUPS if f"[{group}]".encode() in text}
    return frozenset(groups)


def others(
    group: str, parts: tuple[str, ...], refuse: Callable[[Any], str] = lambda found: ""
) -> Iterator[tuple[metadata.EntryPoint, Any]]:
    """Every plug-in of a group of GROUPS that other packages offer, loaded, with its entry point; broken ones are left out, with a
    PluginWarning that names the package. refuse: returns the reason not to use one ("its name is taken"), or ""."""
    for entry in offered(group).values():
        try:
            found = load(entry, parts)
            if why := refuse(found):
                raise ConfigError(f"The {GROUPS[group]} {entry.name} of the package {package(entry)} is not used: {why}.")
        except ConfigError as why:
            warnings.warn(str(why), PluginWarning, stacklevel=3)
            continue
        yield entry, found


def failed(entry: metadata.EntryPoint, what: str, why: BaseException) -> None:
    """Warn, by a PluginWarning, that a plug-in of another package raised. what: the part that failed."""
    kind = GROUPS.get(entry.group, "plug-in")
    sentence = f"The {kind} {entry.name} of the package {package(entry)} is passed over: its {what} failed ({brief(why)})."
    warnings.warn(sentence, PluginWarning, stacklevel=3)


def load(entry: metadata.EntryPoint, parts: tuple[str, ...]) -> Any:
    """The class or module that an entry point names. Raises ConfigError, one sentence that names the package, when it cannot be loaded,
    lacks one of `parts`, or has another `name` than the entry point where `parts` asks for a name."""
    kind = GROUPS.get(entry.group, "plug-in")
    whose = f"The {kind} {entry.name} of the package {package(entry)}"
    try:
        found = entry.load()
    except Exception as why:  # a module of another package may raise anything
        if absent(entry, why):
            raise Absent(missing(entry)) from why
        raise ConfigError(f"{whose} cannot be loaded ({brief(why)}): fix or uninstall that package.") from why
    _complete(whose, found, parts)
    if "name" in parts and found.name != entry.name:
        raise ConfigError(f"{whose} calls itself {found.name!r}: its entry point must have the same name.")
    return found


class Absent(ConfigError):
    """The package of an entry point is not installed, although its metadata are."""


def absent(entry: metadata.EntryPoint, why: BaseException) -> bool:
    """Whether an exception says that the package of an entry point is not there at all."""
    return isinstance(why, ModuleNotFoundError) and why.name == entry.module.partition(".")[0]


def _installed(entry: metadata.EntryPoint) -> bool:
    """Whether the package of an entry point is there; it is not imported."""
    from importlib.util import find_spec

    try:
        return find_spec(entry.module.partition(".")[0]) is not None
    except (ImportError, ValueError):
        return False


def missing(entry: metadata.EntryPoint) -> str:
    """One sentence on what to install for an entry point whose package is not there."""
    extra = f"'{OURS}[research]'" if entry.dist is None or entry.dist.name == OURS else entry.dist.name
    kind, top = GROUPS.get(entry.group, "plug-in"), entry.module.partition(".")[0]
    return f"The {kind} {entry.name} is part of {top}, which is not installed: pip install {extra}."


def api(name: str) -> Any:
    """The function or module that an installed package offers as `rotorwatch.NAME` (entry points `rotorwatch.api`). A module is loaded
    whole. Raises AttributeError for a name that nothing offers, ConfigError for one that cannot be loaded."""
    entry = offered("rotorwatch.api").get(name)
    if entry is None:
        raise AttributeError(f"module 'rotorwatch' has no attribute {name!r}")
    return load(entry, ())


def first(group: str, what: str, name: str | None = None) -> Any:
    """The entry point of that name in a group, or its first, loaded. what: begins the sentence of the ConfigError that is raised where no
    installed package offers it."""
    entries = offered(group)
    entry = entries.get(name) if name else next(iter(entries.values()), None)
    if entry is None:
        raise ConfigError(f"{what} needs rotorwatch_lab, which is not installed: pip install '{OURS}[research]'.")
    return load(entry, ())


def imported(text: str, parts: tuple[str, ...], kind: str) -> Any:
    """The object that `package.module:Class` names. Raises ConfigError, one sentence, for another form, a module that cannot be imported,
    or a class that lacks one of `parts`. kind: its expected kind, for the sentence."""
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
        raise ConfigError(f"{whose} must have a string as its name, not {found.name!r}.")


def package(entry: metadata.EntryPoint) -> str:
    """Name and version of the package that offers an entry point."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.module


def brief(why: BaseException) -> str:
    """An exception in one line."""
    return " ".join(f"{type(why).__name__}: {why}".split())[:200].rstrip(": ")
