"""Getting a campaign done: parts handed to processes one by one, each written down as soon as it is finished.

Killing any of it at any moment loses at most the parts in the making; the same command goes on from there.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import connection, get_context, parent_process
from typing import Any

from rotorwatch import __version__
from rotorwatch.campaign import batch, methods
from rotorwatch.campaign.plan import Plan
from rotorwatch.campaign.score import COLUMNS
from rotorwatch.campaign.store import Folder, Work
from rotorwatch.errors import ConfigError, RotorwatchError

Tell = Callable[[int, int, float], None]
Judge = Callable[[Plan, Sequence[int], int], list[dict]]


def run(
    plan: Plan,
    flights: int,
    folder: str | os.PathLike,
    jobs: int | None = None,
    progress: Tell | None = None,
    judge: Judge = batch.judge,
    columns: Mapping[str, tuple[str, str]] = COLUMNS,
) -> Any:
    """Fly and judge flights 0..flights-1 of the plan, except those that the folder already holds; returns the table of all.

    jobs: processes, default one per processor; never more than one where JAX has an accelerator. progress(done, flights, flights a second):
    at the start and after every part. judge: what makes rows of flights (batch.judge), columns: of its rows. Raises
    ConfigError for a folder of another plan, or one that is in use.
    """
    if flights < 1:
        raise ConfigError(f"flights must be at least 1, not {flights}.")
    if jobs is not None and jobs < 1:
        raise ConfigError(f"jobs must be at least 1, not {jobs}.")
    place = Folder(folder, columns)
    with place.locked():
        width = place.open(plan, batch.width(), __version__, methods.engine())
        todo = place.missing(flights, len(plan.cells), width)
        left = sum(w.last - w.first for w in todo)
        tell = _Telling(flights, flights - left, progress)
        jobs = min(_processes(jobs), max(len(todo), 1))
        if jobs == 1:
            for work in todo:
                _do(plan, place, work, width, judge)
                tell(work)
        else:
            _spread(plan, place, todo, width, jobs, tell, judge)
        return place.table(flights)


class _Telling:
    """Counts finished flights for the progress bar."""

    def __init__(self, flights: int, done: int, progress: Tell | None):
        self.flights, self.done, self.progress, self.now = flights, done, progress, 0
        self.began = time.monotonic()
        if progress:
            progress(done, flights, 0.0)

    def __call__(self, work: Work) -> None:
        self.now += work.last - work.first
        self.done += work.last - work.first
        if self.progress:
            self.progress(self.done, self.flights, self.now / (time.monotonic() - self.began))


def _processes(jobs: int | None = None) -> int:
    """How many processes: as asked for, else one per processor; never more than one on an accelerator, whose memory one takes."""
    from rotorwatch.backend import jax

    return (jobs or os.cpu_count() or 1) if jax().default_backend() == "cpu" else 1


def _do(plan: Plan, folder: Folder, work: Work, width: int, judge: Judge) -> None:
    folder.write(work, judge(plan, work.flights(len(plan.cells), width), width))


def _spread(plan: Plan, folder: Folder, todo: list[Work], width: int, jobs: int, tell: _Telling, judge: Judge) -> None:
    """Processes that each take the next part when they have finished one."""
    context = get_context("spawn")
    workers, queue = {}, list(reversed(todo))
    try:
        for _ in range(jobs):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, plan, folder, width, judge), daemon=True)
            process.start()
            theirs.close()
            workers[ours] = process
            ours.send(queue.pop())
        while workers:
            for pipe in connection.wait(list(workers)):
                assert isinstance(pipe, connection.Connection)
                try:
                    work, error = pipe.recv()
                except EOFError:
                    raise ConfigError(
                        "A process of the campaign was killed (too little memory?); what is finished is kept: run the command again."
                    ) from None
                if error is not None:
                    raise error
                tell(work)
                if queue:
                    pipe.send(queue.pop())
                else:
                    pipe.send(None)
                    workers.pop(pipe).join()
    finally:
        for process in workers.values():
            process.terminate()


def _serve(pipe, plan: Plan, folder: Folder, width: int, judge: Judge) -> None:
    """A worker: parts in, words that they are done out. Ends at once when the process that started it does."""
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    while (work := pipe.recv()) is not None:
        error = None
        try:
            _do(plan, folder, work, width, judge)
        except RotorwatchError as why:
            error = why
        except Exception as why:
            import traceback

            error = RuntimeError(f"{type(why).__name__} in part {work.name}: {why}\n{traceback.format_exc()}")
        pipe.send((work, error))


def _follow(sentinel) -> None:
    connection.wait([sentinel])
    os._exit(1)
