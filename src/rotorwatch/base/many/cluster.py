"""Work for the workers of a Dask scheduler (the package `distributed`), which may come, go and be killed; so may the scheduler.

The client holds the items in flight: twice as many as there are workers. Each result is fetched as soon as it is ready and then released by
the cluster, so that nothing is stored or shuffled there. The scheduler restarts an item whose worker is lost; when the scheduler itself is
lost, all items in flight go to the next one that answers.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import logging
import os
import pickle
import re
import time
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from rotorwatch import __version__
from rotorwatch.base import optional
from rotorwatch.base.many.done import Done, Task, attempt, packed
from rotorwatch.errors import ConfigError, WorkerError, WorkerWarning

AHEAD, LEAST = 2, 16
"""Items in flight for each worker, and in all."""
COUNT_S, QUIET_S = 5.0, 10.0
"""How often workers are counted; how long without any before a warning."""
ANSWER_S, RETURN_S = 10.0, 120.0
"""For a scheduler to answer, and for one that was lost to come back."""


def address(scheduler: str) -> str:
    """The scheduler's address. Raises ConfigError where it is none, or Dask is not installed."""
    if not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://[^\s/]+:\d+/?", scheduler):
        raise ConfigError(f"scheduler {scheduler}: give the address of a Dask scheduler, as in tcp://HOST:8786.")
    optional.library("distributed", "A scheduler")
    return scheduler


def run(function: Callable, tasks: Iterator[Task], scheduler: str) -> Iterator[Done]:
    """`spread.run`, by the workers of this scheduler."""
    import distributed
    from distributed.protocol import pickle as dask_pickle

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are reported here, in one sentence
    work = dask_pickle.dumps(function)  # functions of scripts, too, which plain pickle cannot send to other programs
    name, turns = f"rotorwatch-{uuid.uuid4().hex[:12]}", itertools.count()
    again: deque[Task] = deque()
    flying: dict[str, tuple[Any, Task]] = {}
    client: Any = None
    completed: Any = None
    room: Any = None
    try:
        while True:
            if client is None:
                client = _connected(scheduler, ANSWER_S if completed is None else RETURN_S)
                completed = distributed.as_completed([], loop=client.loop, with_results=True, raise_errors=False)
                room = _Room(client, scheduler)
            while len(flying) < room() and (task := again.popleft() if again else next(tasks, None)) is not None:
                key = f"{name}-{task.index}-{next(turns)}"
                future = client.submit(_do, work, task.item, __version__, key=key, pure=False)
                flying[key] = future, task
                completed.add(future)
            if not flying:
                return
            with completed.thread_condition:
                if not completed.has_ready():
                    completed.thread_condition.wait(0.5)
            batch = completed.next_batch(block=False)
            lost = False
            for future, answer in batch:
                _, task = flying.pop(future.key)
                if isinstance(answer, bytes):
                    yield Done(task.index, *pickle.loads(answer))
                elif isinstance(answer, tuple):
                    yield Done(task.index, None, _error(answer[1]))
                else:  # cancelled: the scheduler is lost, and with it all that it knew
                    again.append(task)
                    lost = True
            if lost:
                text = f"The scheduler at {scheduler} was lost; waiting for it to come back."
                warnings.warn(text, WorkerWarning, stacklevel=2)
                again.extend(task for _, task in flying.values())
                flying.clear()
                _close(client, 1.0)
                client = None
    finally:
        if client is not None:
            _close(client, ANSWER_S)


def _connected(scheduler: str, patience_s: float) -> Any:
    """A client of the scheduler. Raises ConfigError when none answers in time."""
    import distributed

    until = time.monotonic() + patience_s
    while True:
        try:
            return distributed.Client(scheduler, timeout=ANSWER_S, set_as_default=False, name="rotorwatch")
        except (OSError, asyncio.TimeoutError) as why:
            if time.monotonic() > until:
                raise ConfigError(
                    f"No Dask scheduler answers at {scheduler}: start one with `dask scheduler`, or check the address. What is "
                    "finished is kept."
                ) from why
            time.sleep(0.5)


def _close(client: Any, timeout: float) -> None:
    """Leave the scheduler, ignoring the error of a client that is reconnecting to a lost scheduler."""
    with suppress(OSError, asyncio.TimeoutError, RuntimeError):
        client.close(timeout=timeout)


class _Room:
    """Capacity for items in flight; workers are counted periodically, and a lasting absence is an error."""

    def __init__(self, client: Any, scheduler: str):
        self.client, self.scheduler = client, scheduler
        self.workers, self.counted, self.seen, self.reported = 0, float("-inf"), time.monotonic(), False

    def __call__(self) -> int:
        now = time.monotonic()
        if now - self.counted > COUNT_S:
            with suppress(OSError, asyncio.TimeoutError, RuntimeError, ValueError, AttributeError):  # lost
                self.workers = sum(self.client.nthreads().values())
            self.counted = now
            if self.workers:
                self.seen = now
            elif now - self.seen > QUIET_S and not self.reported:
                self.reported = True
                start = f"start some with `dask worker {self.scheduler} --nthreads 1`"
                warnings.warn(f"No worker is connected to {self.scheduler}: {start}.", WorkerWarning, stacklevel=3)
        return max(LEAST, AHEAD * self.workers)


def _error(why: Exception) -> Exception:
    """Dask's reason for giving up an item, as an exception with one sentence."""
    kind = type(why).__name__
    if kind == "KilledWorker":
        return WorkerError("every worker that began it died (too little memory?)", "died")
    same = "its workers need the same Python, rotorwatch and libraries"
    return WorkerError(f"the cluster cannot do it ({kind}: {why}): {same}", kind)


@functools.lru_cache(maxsize=4)
def _function(work: bytes) -> Callable:
    """The function, loaded once in each worker with its state."""
    os.environ.setdefault("NPROC", "1")  # XLA's threads: there are as many workers as processors
    return pickle.loads(work)


def _do(work: bytes, item: Any, version: str) -> bytes:
    """An item's work in a worker: (value, error), packed."""
    if version != __version__:
        text = f"A worker of the cluster has rotorwatch {__version__}, here it is {version}: install the same."
        return packed(None, ConfigError(text))
    return packed(*attempt(lambda item: _function(work)(item), item))
