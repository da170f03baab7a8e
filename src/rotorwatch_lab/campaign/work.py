"""Runs a campaign: parts go to processes or to a cluster one by one (`rotorwatch.base.many`), and each is written as soon as it is
finished. An interruption loses at most the parts in progress; the same command resumes the campaign."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rotorwatch import __version__
from rotorwatch.base import many
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import batch, methods
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.campaign.score import COLUMNS
from rotorwatch_lab.campaign.store import Folder, Work

Progress = Callable[[int, int, float], None]
Assessor = Callable[[Plan, Sequence[int], int], list[dict]]


def run(
    plan: Plan,
    flights: int,
    folder: str | os.PathLike,
    jobs: int | None = None,
    progress: Progress | None = None,
    assess: Assessor = batch.assess,
    columns: Mapping[str, tuple[str, str]] = COLUMNS,
    scheduler: str | None = None,
) -> Any:
    """Fly and assess flights 0..flights-1 of the plan, except those that the folder already holds; returns the table of all.

    jobs: processes, default one per processor; never more than one where JAX has an accelerator. progress(done, flights, flights a second):
    at the start and after every part. assess: what makes rows of flights (batch.assess), columns: of its rows. scheduler: address of
    a Dask scheduler whose workers do it instead (docs/cluster.md). Raises ConfigError for a folder of another plan, or one that is in use,
    and WorkerError for a part of which processes die.
    """
    if flights < 1:
        raise ConfigError(f"flights must be at least 1, not {flights}.")
    if jobs is not None and jobs < 1:
        raise ConfigError(f"jobs must be at least 1, not {jobs}.")
    if scheduler is not None and jobs is not None:
        raise ConfigError("Give jobs or a scheduler, not both: a cluster has as many workers as are connected to it.")
    place = Folder(folder, columns)
    with place.locked():
        width = place.open(plan, batch.width(), __version__, methods.engine())
        todo = place.missing(flights, len(plan.cells), width)
        done, now, began = flights - sum(w.last - w.first for w in todo), 0, time.monotonic()
        if progress:
            progress(done, flights, 0.0)
        do = _Parts(plan, width, assess, methods.engine())
        for part in many.run(do, todo, None if scheduler else _processes(jobs), scheduler):
            place.write(todo[part.index], part.result())
            now += todo[part.index].last - todo[part.index].first
            if progress:
                progress(done + now, flights, now / (time.monotonic() - began))
        return place.table(flights)


def _processes(jobs: int | None = None) -> int:
    """Number of processes: `jobs`, else one per processor; one on an accelerator, whose memory a single process takes."""
    from rotorwatch.base.backend import jax

    return (jobs or many.processors()) if jax().default_backend() == "cpu" else 1


class _Parts:
    """Makes the rows of a part of a campaign, wherever that is done. Its engine must be that of the campaign: last digits differ."""

    def __init__(self, plan: Plan, width: int, assess: Assessor, engine: str):
        self.plan, self.width, self.assess, self.engine = plan, width, assess, engine

    def __call__(self, work: Work) -> list[dict]:
        if methods.engine() != self.engine:
            raise ConfigError(
                f"A worker of the cluster would step estimators as {methods.engine()} code, this campaign was begun with {self.engine}: "
                "let all computers have a C compiler, or none."
            )
        return self.assess(self.plan, work.flights(len(self.plan.cells), self.width), self.width)
