"""Errors a user can do something about. Each carries one sentence: what is wrong and what to do."""


class RotorwatchError(Exception):
    """Base of every error rotorwatch raises on purpose; the command line prints it and exits with 2."""


class LogError(RotorwatchError):
    """A file cannot be read as a flight log."""


class VehicleError(RotorwatchError):
    """The airframe is unknown, contradictory or its description file is wrong."""


class ConfigError(RotorwatchError):
    """A call's arguments do not fit together."""


class LinkError(RotorwatchError):
    """An endpoint cannot be opened, or no vehicle sends on it."""


class WorkerError(RotorwatchError):
    """A process that did a part of the work ended, or a cluster cannot go on with it. how: how a process ended."""

    def __init__(self, text: str, how: str = ""):
        super().__init__(text, how)
        self.text, self.how = text, how

    def __str__(self) -> str:
        return self.text


class WorkerWarning(RuntimeWarning):
    """A cluster waits for workers, or a connection to it was lost and is made anew; one sentence says which."""


class BackendWarning(RuntimeWarning):
    """Native code cannot be had, or not be kept; one sentence says why and what happens instead."""


class FirstUse(BackendWarning):
    """A slow operation on first use on this computer, reported once; one sentence says why."""


class PluginWarning(RuntimeWarning):
    """A plug-in of another package is not used; one sentence says which and why."""


class StoreError(RotorwatchError):
    """The store of a fleet cannot be opened, read or written, or lacks the wanted entry."""


class NotInStore(StoreError):
    """The store lacks the wanted entry."""


class StoreFull(StoreError):
    """The disk of a store has no room."""


# Packages of the extra `research`, as they are imported.
RESEARCH = ("jax", "jaxlib", "scipy", "cvxpy", "matplotlib")


def lacking(why: BaseException) -> str | None:
    """The sentence where an exception is due to a missing package of the extra `research`, else None."""
    name = (getattr(why, "name", None) or "").split(".")[0]
    if not isinstance(why, ModuleNotFoundError) or name not in RESEARCH:
        return None
    return f"This needs {name}, which is not installed: pip install {name}."
