"""Logs into the store: files, folders and patterns, once or as they come; and the store's own flights assessed again."""

from __future__ import annotations

import hashlib
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from rotorwatch import __version__
from rotorwatch.base import many
from rotorwatch.errors import LogError, NotInStore, RotorwatchError, StoreError, VehicleError
from rotorwatch.fleet import assess, condition, flight_result
from rotorwatch.fleet.store import Entry, Store
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.gathering import Gathered, fetched, full, is_address, is_log, is_several
from rotorwatch.logs import fingerprint

POLL_S = 2.0
ALERTED = ("crashed", "fault", "ambiguous")


@dataclass(frozen=True)
class Outcome:
    """The result for a log. state: added, known (its content is in the store), failed, or refused (it failed before, is unchanged, and was
    not tried again). verdict, text: of the flight, or why not. aircraft: its name, "" when unknown."""

    path: Path | str
    state: str
    verdict: str = ""
    text: str = ""
    aircraft: str = ""


def add(
    store: Store,
    given: Iterable[Path | str],
    aircraft: str = "",
    vehicle: Vehicle | None = None,
    tell: Callable[[Outcome], None] = lambda outcome: None,
    progress: Callable | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    insist: bool = True,
) -> tuple[list[Outcome], int]:
    """Add all logs that are new to the store, one transaction each: files, folders, patterns and addresses (`gathering`).

    aircraft: a name for the flights, in place of the logs' own. tell: called with each log's outcome; progress: as progress(share, text).
    jobs, scheduler: as for `many.run`, by default a process per processor, fewer for few logs; the store is the same, because this process
    alone writes it, in the order of the logs. insist: retry a log that is named by itself though it failed before and is unchanged; those
    in folders are not retried. Returns the outcomes, and the number of files in folders that were no logs. Standings are not updated
    (`assess.refresh`). Raises ConfigError, and StoreError, after which the same call resumes."""
    given, how = list(given), _given(vehicle)
    named = {full(one) for one in given if insist and not is_several(one)}
    gathered = Gathered(given)
    logs = list(gathered)
    if jobs is None and scheduler is None:
        jobs = many.useful_jobs(len(logs))
    fates: list[Outcome] = []
    new: list[Path | str] = []

    def fate(outcome: Outcome) -> None:
        fates.append(outcome)
        tell(outcome)
        if progress:
            progress(len(fates) / len(logs), "assessing")

    paths = store.paths() if any(map(is_address, logs)) else set()

    def unknown() -> Iterator[str]:
        for log in logs:
            outcome = _before(store, log, paths, "" if full(log) in named else how)
            if outcome is None:
                new.append(log)
                yield full(log) if scheduler else str(log)
            else:
                fate(outcome)

    for done in many.in_order(_Assessor(aircraft, vehicle), unknown(), jobs, scheduler):
        log = new[done.index]
        _expected(done.error)
        if done.error:
            _refuse(store, log, how, done.error)
            fate(Outcome(log, "failed", text=str(done.error)))
        else:
            fate(_added(store, log, done.value))
    return fates, gathered.others


@dataclass(frozen=True)
class _Assessor:
    """The work on a log, in any process."""

    aircraft: str
    vehicle: Vehicle | None

    def __call__(self, log: str) -> Entry:
        with fetched(log) as path, _readable(log):
            return replace(flight_result.entry(path, self.aircraft, self.vehicle), path=full(log))


@contextmanager
def _readable(log: Path | str) -> Iterator[None]:
    """Errors of the system on a log as a sentence."""
    try:
        yield
    except OSError as why:
        raise LogError(f"{log}: {why.strerror or why}.") from why


def _expected(error: Exception | None) -> None:
    """Raise errors that are not due to the log."""
    if error is not None and not isinstance(error, RotorwatchError):
        raise error


def _given(vehicle: Vehicle | None) -> str:
    """Key of everything but the file's bytes that decides whether it can be assessed: this version, and the given vehicle."""
    craft = "" if vehicle is None else hashlib.sha256(repr(vehicle).encode()).hexdigest()[:16]
    return f"{__version__} {craft}".strip()


def _refuse(store: Store, log: Path | str, how: str, error: Exception) -> None:
    """Remember a file that failed by its content: not where a library is missing, or the file or its server cannot be reached."""
    if isinstance(error, (LogError, VehicleError)):
        with suppress(RotorwatchError), fetched(log) as path, _readable(log):
            store.refuse(fingerprint(path)[1], full(log), how, str(error))


def _before(store: Store, log: Path | str, paths: Set[str], how: str) -> Outcome | None:
    """The outcome of a log that need not be assessed; None where it must be. A log behind an address that is not among `paths`, those in
    the store, is fetched once, by the process that assesses it. how: `_given`; empty for a log that is retried."""
    if is_address(log) and full(log) not in paths:
        return None
    try:
        with fetched(log) as path, _readable(log):
            hash = fingerprint(path)[1]
        if store.has(hash):
            return Outcome(log, "known")
        why = how and store.refused(hash, how)
        return Outcome(log, "refused", text=why) if why else None
    except StoreError:
        raise
    except RotorwatchError as why:
        return Outcome(log, "failed", text=str(why))


def _added(store: Store, log: Path | str, entry: Entry) -> Outcome:
    if not store.add(entry):
        return Outcome(log, "known")
    whose = store.find(entry.identity)["name"] if entry.identity else ""
    return Outcome(log, "added", entry.verdict, entry.headline, whose)


def follow(
    store: Store,
    folders: Iterable[Path],
    aircraft: str = "",
    vehicle: Vehicle | None = None,
    tell: Callable[[Outcome], None] = lambda outcomes: None,
    trouble: Callable[[str], None] = lambda text: None,
    poll_s: float = POLL_S,
    stop: Callable[[], bool] = lambda: False,
    assessed: Callable[[Store], None] = lambda store: None,
    alert: Callable[[dict[str, str]], None] = lambda reported: None,
) -> None:
    """Add logs as they come into folders, until `stop`. A file is taken when its size and time have not changed between two polls. When the
    store cannot be reached, `trouble` is called once, and every poll retries. assessed: called after the aircraft have been assessed.
    alert: called with each new flight that is not healthy, and with each aircraft whose state became more urgent."""
    folders = [Path(f) for f in folders]
    seen: dict[Path, tuple[int, int]] = {}
    settled: dict[Path, tuple[int, int]] = {}
    unwell, states = "", None
    while not stop():
        new = False
        try:
            states = {a["key"]: a["state"] for a in store.aircraft()} if states is None else states
            for path, mark in _files(folders):
                if settled.get(path) != mark and seen.get(path) == mark:
                    if is_log(path):
                        outcomes, _ = add(store, [path], aircraft, vehicle, tell, jobs=1, insist=False)
                        new |= any(one.state == "added" for one in outcomes)
                        for reported in _flight_alerts(outcomes):
                            alert(reported)
                    settled[path] = mark
                seen[path] = mark
            if new or unwell:
                assess.refresh(store)
                assessed(store)
                aircraft_now = store.aircraft()
                for reported in _aircraft_alerts(states, aircraft_now):
                    alert(reported)
                states = {a["key"]: a["state"] for a in aircraft_now}
            unwell = ""
        except StoreError as why:
            if str(why) != unwell:
                trouble(str(why))
            unwell = str(why)
        time.sleep(poll_s)


def _flight_alerts(outcomes: Iterable[Outcome]) -> Iterator[dict[str, str]]:
    """type flight, aircraft, log, verdict, headline of each added flight that was found faulty, crashed or ambiguous."""
    for one in outcomes:
        if one.state == "added" and one.verdict in ALERTED:
            name = Path(str(one.path)).name
            yield {"type": "flight", "aircraft": one.aircraft, "log": name, "verdict": one.verdict, "headline": one.text}


def _aircraft_alerts(before: Mapping[str, str], aircraft: Iterable[Mapping]) -> Iterator[dict[str, str]]:
    """type aircraft, aircraft, state, was, headline of each aircraft whose state is more urgent than before; a new one was not assessed."""
    for a in aircraft:
        was = before.get(a["key"], condition.UNKNOWN)
        if a["state"] in (condition.FAULT, condition.SUSPECT) and condition.STATES.index(a["state"]) < condition.STATES.index(was):
            headline = (a["standing"] or {}).get("headline", "")
            yield {"type": "aircraft", "aircraft": a["name"], "state": a["state"], "was": was, "headline": headline}


def _files(folders: Iterable[Path]) -> Iterator[tuple[Path, tuple[int, int]]]:
    """All files of folders and those below, but hidden ones, with size and time."""
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            try:
                state = path.stat()
            except OSError:  # gone since
                continue
            if stat.S_ISREG(state.st_mode) and not any(part.startswith(".") for part in path.relative_to(folder).parts):
                yield path, (state.st_size, state.st_mtime_ns)


@dataclass(frozen=True)
class Change:
    """A flight changed by assessing it again. before, after: (verdict, headline); lost: why it could not be assessed again, or ""."""

    hash: str
    name: str
    aircraft: str
    before: tuple[str, str]
    after: tuple[str, str]
    lost: str = ""


def reassess(
    store: Store,
    every: bool = False,
    aircraft: str | None = None,
    progress: Callable | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
) -> tuple[int, list[Change]]:
    """Assess flights again that another version of rotorwatch has assessed; every: all of them. Returns their number, and the changes; a
    log that is gone or has another content keeps its result, and is among them. jobs, scheduler: as for `add`."""
    rows = store.flights("date", limit=None, aircraft=aircraft)
    rows = [r for r in rows if every or r["version"] != __version__]
    if jobs is None and scheduler is None:
        jobs = many.useful_jobs(len(rows))
    changes, count = [], 0
    finished = (lambda n: progress(n / len(rows), "diagnosing again")) if progress else None
    for done in many.in_order(_again, [(r["path"], r["hash"]) for r in rows], jobs, scheduler, finished):
        row = rows[done.index]
        _expected(done.error)
        before = after = row["verdict"], row["headline"]
        if done.error is None:
            try:
                store.assess_again(done.value)
            except NotInStore:  # deleted meanwhile
                continue
            count += 1
            after = done.value.verdict, done.value.headline
        if done.error is not None or after != before:
            lost = str(done.error) if done.error else ""
            changes.append(Change(row["hash"], row["name"], row["aircraft_name"] or "", before, after, lost))
    return count, changes


def _again(known: tuple[str, str]) -> Entry:
    path, hash = known
    with fetched(path) as here, _readable(path):
        if fingerprint(here)[1] != hash:
            raise LogError(f"{path} has changed.")
        return flight_result.entry(here)
