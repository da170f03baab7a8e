"""Logs into the store: files, folders and patterns, once or as they come; and the store's own flights judged again."""

from __future__ import annotations

import stat
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from rotorwatch import __version__
from rotorwatch.errors import RotorwatchError, StoreError
from rotorwatch.fleet import assess, judge
from rotorwatch.fleet.store import Store, digest
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.gathering import Gathered, fetched, full, is_log

POLL_S = 2.0


@dataclass(frozen=True)
class Told:
    """What became of a log. state: added, known (its content is in the store), or failed. verdict, text: of the flight, or why not.
    aircraft: its name, "" when nothing tells."""

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
    tell: Callable[[Told], None] = lambda told: None,
    progress: Callable | None = None,
) -> tuple[list[Told], int]:
    """Add all logs that are new to the store, one transaction each: files, folders, patterns and addresses (`gathering`). aircraft: a
    name for the flights, in place of what the logs say. tell: called with each log's fate. Returns those, and how many files in folders
    were no logs. Standings are not worked out (`assess.refresh`). Raises ConfigError, and StoreError, after which the same call goes on."""
    gathered = Gathered(given)
    found = [_one(store, log, aircraft, vehicle, tell, progress) for log in gathered]
    return found, gathered.others


def _one(store: Store, log: Path | str, aircraft: str, vehicle: Vehicle | None, tell, progress) -> Told:
    try:
        with fetched(log) as path:
            told = _added(store, log, path, aircraft, vehicle, progress)
    except StoreError:
        raise
    except RotorwatchError as why:
        told = Told(log, "failed", text=str(why))
    except OSError as why:
        told = Told(log, "failed", text=f"{log}: {why.strerror or why}.")
    tell(told)
    return told


def _added(store: Store, log: Path | str, path: Path, aircraft: str, vehicle: Vehicle | None, progress) -> Told:
    if store.has(digest(path)):
        return Told(log, "known")
    entry = replace(judge.entry(path, aircraft, vehicle, progress), path=full(log))
    if not store.add(entry):
        return Told(log, "known")
    whose = store.find(entry.identity)["name"] if entry.identity else ""
    return Told(log, "added", entry.verdict, entry.headline, whose)


def follow(
    store: Store,
    folders: Iterable[Path],
    aircraft: str = "",
    vehicle: Vehicle | None = None,
    tell: Callable[[Told], None] = lambda told: None,
    trouble: Callable[[str], None] = lambda text: None,
    poll_s: float = POLL_S,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Add logs as they come into folders, until `stop`. A file is taken when its size and time have not changed from one look to the
    next. When the store cannot be reached, `trouble` is told once, and it is tried again at every look."""
    folders = [Path(f) for f in folders]
    seen: dict[Path, tuple[int, int]] = {}
    settled: dict[Path, tuple[int, int]] = {}
    unwell = ""
    while not stop():
        new = False
        try:
            for path, mark in _files(folders):
                if settled.get(path) != mark and seen.get(path) == mark:
                    if is_log(path):
                        new |= _one(store, path, aircraft, vehicle, tell, None).state == "added"
                    settled[path] = mark
                seen[path] = mark
            if new or unwell:
                assess.refresh(store)
            unwell = ""
        except StoreError as why:
            if str(why) != unwell:
                trouble(str(why))
            unwell = str(why)
        time.sleep(poll_s)


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
    """What judging again changed in a flight. before, after: (verdict, headline); lost: why it could not be judged again, or ""."""

    hash: str
    name: str
    aircraft: str
    before: tuple[str, str]
    after: tuple[str, str]
    lost: str = ""


def rejudge(
    store: Store, every: bool = False, aircraft: str | None = None, progress: Callable | None = None
) -> tuple[int, list[Change]]:
    """Judge flights again that another version of rotorwatch has judged; every: all of them. Returns how many were, and what changed; a
    log that is gone or has another content keeps its judgement, and is among them."""
    rows = [
        r
        for r in store.flights(aircraft=aircraft, limit=None, newest_first=False)
        if every or r["version"] != __version__
    ]
    changes, count = [], 0
    for k, row in enumerate(rows):
        before = row["verdict"], row["headline"]
        lost = ""
        try:
            with fetched(row["path"]) as path:
                same = digest(path) == row["hash"]
                entry = judge.entry(path) if same else None
            if entry is None:
                lost = f"{row['path']} has another content now."
            else:
                store.judge_again(entry)
                count += 1
                if (entry.verdict, entry.headline) != before:
                    changes.append(
                        Change(
                            row["hash"],
                            row["name"],
                            row["aircraft_name"] or "",
                            before,
                            (entry.verdict, entry.headline),
                        )
                    )
        except OSError as why:
            lost = f"{row['path']}: {why.strerror or why}."
        except StoreError:
            raise
        except RotorwatchError as why:
            lost = str(why)
        if lost:
            changes.append(Change(row["hash"], row["name"], row["aircraft_name"] or "", before, before, lost))
        if progress:
            progress((k + 1) / len(rows), "judging again")
    return count, changes
