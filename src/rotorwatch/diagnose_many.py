"""Many logs, one after the other, in processes or on a cluster: an answer for each as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

from rotorwatch import gathering, logs
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import SCHEMA, Diagnosis
from rotorwatch.flight.vehicle import Vehicle

if TYPE_CHECKING:
    from rotorwatch.base.many import Done

ERROR = 2
"""Exit code of a log without an answer."""


class Known(NamedTuple):
    """A log that has its answer already, if it is still the same: size in bytes, sha256 of its content."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Answer:
    """The result of one log. index: its place among the logs; path: its full path, or its address. diagnosis: without the trace; None
    where there is an error. size, sha256: of the content, where requested. page: the HTML report, where requested.
    recording: the MCAP file, picture: a PNG, tables: those of `report.parquet_tables`, likewise. parts: sections of a post. unchanged: it
    is as it was known, and was not assessed again."""

    index: int
    path: str
    diagnosis: Diagnosis | None = None
    error: Exception | None = None
    size: int | None = None
    sha256: str | None = None
    page: str | None = None
    recording: bytes | None = None
    picture: bytes | None = None
    tables: Mapping[str, Any] | None = None
    parts: tuple[Any, ...] = ()
    unchanged: bool = False

    @property
    def exit_code(self) -> int:
        """Exit code of `rotorwatch diagnose`: 0 healthy, 1 fault or crashed, 3 inconclusive or ambiguous, 2 error."""
        return ERROR if self.diagnosis is None else self.diagnosis.exit_code

    def to_dict(self) -> dict[str, Any]:
        """The documented JSON structure of the answer (docs/json.md); of an error its schema, the flight's name and the sentence."""
        if self.diagnosis is not None:
            return self.diagnosis.to_dict()
        name = self.path.rpartition("/")[2]
        return {"schema": SCHEMA, "flight": {"name": name}, "error": str(self.error)}


def diagnose_many(
    paths: Iterable[str | PathLike],
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Sequence[Flight | str | PathLike] = (),
    estimator: str = "default",
    tuning: Any = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    pages: bool = False,
    recordings: bool = False,
    hashed: bool = False,
    known: Mapping[str, Known] | None = None,
    pictures: bool = False,
    matters: float = MATTERS,
    tables: bool = False,
) -> Iterator[Answer]:
    """`diagnose` of every log: an `Answer` for each as soon as it is there, in any order; an error of one stops no other.

    paths: logs, folders with all that is in them, quoted patterns, and addresses (s3://, http://, file:// ..), where fsspec is installed.
    They may come from a generator: no more logs are taken than are worked on. vehicle, baseline, estimator, tuning, matters: as for
    `diagnose`, for all logs. jobs, scheduler: as for `many.run`; by default a process per processor, fewer for few logs. The workers of a
    cluster have to find the same paths. pages: make HTML reports, too; recordings: MCAP files; pictures: PNGs, where there is something
    to draw; tables: pyarrow's tables of flights, ticks, losses and events (docs/parquet.md). hashed: size and SHA-256 of each log's
    content. known: full path -> what it was when it had its answer; those that did not change are not assessed again. Raises ConfigError,
    VehicleError or LogError where no log can be assessed: a folder without logs, a wrong vehicle or baseline, a scheduler that does not
    answer.
    """
    from rotorwatch.base.many.spread import run, useful_jobs
    from rotorwatch.witnesses.healthy.baselines import vehicle_of

    known = known or {}
    craft = vehicle_of(vehicle)
    for source in baseline:
        if not isinstance(source, Flight):
            read(source)  # an error in it would be every log's
    healthy = tuple(source if isinstance(source, Flight) else _named(source, scheduler) for source in baseline)
    assess = _Assessor(craft, healthy, estimator, tuning, pages, recordings, pictures, hashed, matters, tables)
    if isinstance(paths, Sequence):
        paths = paths if isinstance(paths, gathering.Found) else list(gathering.Gathered(paths))
        if jobs is None and scheduler is None:
            jobs = useful_jobs(len(paths))
    else:
        paths = gathering.Gathered(paths)
    names: dict[int, str] = {}

    def items() -> Iterator[tuple[str, Known | None]]:
        for index, path in enumerate(paths):
            names[index] = gathering.full(path)
            yield _named(path, scheduler), known.get(names[index])

    return _answers(run(assess, items(), jobs, scheduler), names)


def _answers(found: Iterator[Done], names: dict[int, str]) -> Iterator[Answer]:
    for done in found:
        path = names.pop(done.index)
        if done.error is not None:
            yield Answer(done.index, path, error=done.error)
        else:
            yield replace(done.value, index=done.index, path=path)


def _named(path: Any, scheduler: str | None) -> str:
    """A path as it is understood where the work is done: on other computers only a full one."""
    return str(path) if scheduler is None else gathering.full(path)


def read(path: str | PathLike, progress: Any = None) -> Flight:
    """The flight in a log, or behind an address. Raises LogError, or ConfigError where there is no file."""
    with gathering.fetched(path) as here:
        if not gathering.is_there(here):
            raise ConfigError(f"{path}: no such file.")
        return logs.read(here, progress=progress)


@dataclass(frozen=True, eq=False, repr=False)
class _Assessor:
    """The work on one log, in any process; baselines are read and assessed once by each process."""

    vehicle: Vehicle | None
    baseline: tuple[Flight | str, ...]
    estimator: str
    tuning: Any
    pages: bool
    recordings: bool
    pictures: bool
    hashed: bool
    matters: float = MATTERS
    tables: bool = False

    @cached_property
    def healthy(self) -> tuple[Any, ...]:
        from rotorwatch.witnesses.healthy.baselines import Candidate

        return tuple(Candidate(g if isinstance(g, Flight) else read(g), self.vehicle) for g in self.baseline)

    def __call__(self, item: tuple[str, Known | None]) -> Answer:
        path, before = item
        size = sha256 = here = None
        try:
            with gathering.fetched(path) as here:
                if not gathering.is_there(here):
                    raise ConfigError(f"{path}: no such file.")
                if self.hashed:
                    size, sha256 = logs.fingerprint(here)
                    if before == Known(size, sha256):
                        return Answer(0, path, size=size, sha256=sha256, unchanged=True)
                found = timed(partial(logs.read, here), self.vehicle, self.healthy, self.estimator, self.tuning, self.matters)
        except RotorwatchError as why:
            if gathering.is_address(path) and here is not None:
                why = type(why)(str(why).replace(str(here), path))  # nobody knows the copy's name
            return Answer(0, path, error=why, size=size, sha256=sha256)
        from rotorwatch.report import markdown

        page = recording = picture = tables = None
        if self.pages:
            from rotorwatch.report import html

            page = html.page(found)
        if self.recordings:
            from rotorwatch.report import mcap_file

            recording = mcap_file.content(found)
        if self.tables:
            from rotorwatch.report import parquet_tables

            tables = parquet_tables.tables(found, gathering.full(path))
        if self.pictures:
            with suppress(ConfigError):  # there is nothing to draw
                picture = markdown.picture_of(found)
        return Answer(
            0, path, replace(found, trace=None), size=size, sha256=sha256, page=page, recording=recording, picture=picture,
            tables=tables, parts=markdown.prepared(found),
        )  # fmt: skip


def timed(
    reading: Callable[[], Flight],
    vehicle: Vehicle | None,
    baseline: Sequence[Any],
    estimator: str,
    tuning: Any,
    matters: float = MATTERS,
    progress: Callable | None = None,
) -> Diagnosis:
    """`diagnose` of what `reading` returns; `timing` holds the reading, too."""
    from rotorwatch.diagnose import diagnose

    began = time.perf_counter()
    flight = reading()
    read_s = time.perf_counter() - began
    how: dict[str, Any] = {"vehicle": vehicle, "baseline": baseline, "estimator": estimator, "tuning": tuning, "matters": matters}
    found = diagnose(flight, progress=progress, **how)
    timing = {**found.timing, "read_s": read_s, "total_s": found.timing.get("total_s", 0.0) + read_s}
    return replace(found, timing=timing)
