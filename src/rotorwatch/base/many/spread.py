"""A function over many items: in this process, in several, or on a cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from rotorwatch.base.many.done import Done, Task, attempt
from rotorwatch.base.many.result_cache import ResultCache
from rotorwatch.errors import ConfigError

EACH = 4
"""Logs that make it worth while to start one more process."""
TRIES = 2
"""How often an item is begun when workers die of it."""


def processors() -> int:
    """Number of processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on all systems
        return os.cpu_count() or 1


def useful_jobs(count: int) -> int:
    """Number of processes worth starting for so many logs: one more for every EACH of them, at most the number of processors."""
    return max(1, min(processors(), count // EACH))


def run(function: Callable[[Any], Any], items: Iterable[Any], jobs: int | None = None, scheduler: str | None = None) -> Iterator[Done]:
    """function(item) of every item: a `Done` for each, as they finish, in any order.

    Items are taken one by one when there is room for them, so that they may come from a generator that never ends; results are
    not kept. An exception of the function is the item's `error` and stops nothing. jobs: processes, one per processor by default;
    1: here, in line. scheduler: the address of a Dask scheduler (tcp://HOST:PORT), whose workers do it instead. Function, items and
    values have to be picklable then, and the function's module importable.

    A process that dies is replaced; its item is begun TRIES times in all, then its error is a WorkerError. On a cluster the scheduler
    decides how often (docs/cluster.md). When the iterator is closed, or left by an exception (Ctrl-C), all work ends. Raises ConfigError
    for arguments that do not fit together and for a scheduler that does not answer, WorkerError where processes do not start."""
    if jobs is not None and jobs < 1:
        raise ConfigError(f"jobs must be at least 1, not {jobs}.")
    if scheduler is not None:
        if jobs is not None:
            raise ConfigError("Give jobs or a scheduler, not both: a cluster has as many workers as are connected to it.")
        from rotorwatch.base.many import cluster

        return cluster.run(function, _tasks(items), cluster.address(scheduler))
    if isinstance(items, Sequence):
        jobs = min(jobs or processors(), max(1, len(items)))
    jobs = jobs or processors()
    if jobs == 1:
        return (Done(index, *attempt(function, item)) for index, item in enumerate(items))
    from rotorwatch.base.many import processes

    return processes.run(function, _tasks(items), jobs, TRIES)


def in_order(
    function: Callable[[Any], Any],
    items: Iterable[Any],
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
    keep: str | os.PathLike | None = None,
) -> Iterator[Done]:
    """A `Done` of every item, in order; early ones are kept until their turn. Arguments as for `run`; progress: called with the number of
    finished items. keep: a folder for values, from which the same call resumes (result_cache.py); ConfigError where it cannot be
    written."""
    early: dict[int, Done] = {}
    following = 0
    for finished, done in enumerate(_results(function, items, jobs, scheduler, keep), start=1):
        early[done.index] = done
        if progress:
            progress(finished)
        while following in early:
            yield early.pop(following)
            following += 1


def _results(function: Callable, items: Iterable[Any], jobs, scheduler, keep) -> Iterator[Done]:
    """`run`, with cached results first."""
    if keep is None:
        yield from run(function, items, jobs, scheduler)
        return
    items, store, left = list(items), ResultCache(keep, function), []
    for k, item in enumerate(items):
        value = store.load(item)
        if value is None:
            left.append(k)
        else:
            yield Done(k, *value)
    for done in run(function, [items[k] for k in left], jobs, scheduler) if left else ():
        k = left[done.index]
        if done.error is None:
            store.save(items[k], done.value)
        yield replace(done, index=k)


def ordered(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
    keep: str | os.PathLike | None = None,
) -> Iterator[Any]:
    """The values of all items in order; as `in_order`. Raises the first error at its turn."""
    return (done.result() for done in in_order(function, items, jobs, scheduler, progress, keep))


def _tasks(items: Iterable[Any]) -> Iterator[Task]:
    return (Task(index, item) for index, item in enumerate(items))
