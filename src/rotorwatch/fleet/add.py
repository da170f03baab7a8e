"""Logs into the store: files, folders and patterns, once or as they come; and the store's own flights judged again."""

from __future__ import annotations

import glob
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rotorwatch import __version__
from rotorwatch.errors import ConfigError, LogError, RotorwatchError, StoreError
from rotorwatch.fleet import assess, judge
from rotorwatch.fleet.store import Store, digest
from rotorwatch.flight.vehicle import Vehicle

POLL_S = 2.0
HEAD = 4096


@dataclass(frozen=True)
class Told:
    """What became of a file. state: added, known (its content is in the store), no log (in a folder), or failed. verdict, text: of the
    flight, or why not. aircraft: its name, "" when nothing tells."""

    path: Path
    state: str
    verdict: str = ""
    text: str = ""
    aircraft: str = ""


def collect(given: Iterable[Path | str]) -> Iterator[tuple[Path, bool]]:
    """Files in a fixed order, and whether each was named itself: files as given, folders with all that is below, patterns such as *.bin.
    Raises ConfigError for what is not there."""
    for one in given:
        path = Path(one)
        if path.is_dir():
            for found in sorted(path.rglob("*")):
                hidden = any(part.startswith(".") for part in found.relative_to(path).parts)
                if found.is_file() and not hidden:
                    yield found, False
        elif path.exists():
            yield path, True
        else:
            matches = sorted(glob.glob(str(one), recursive=True))
            if not matches:
                raise ConfigError(f"{one}: there is no such file, folder or pattern with a match.")
            for match in matches:
                yield from collect([match])


def is_log(path: Path) -> bool:
    """Whether a file looks like a flight log, by its first bytes and its name."""
    from rotorwatch import logs
    from rotorwatch.logs.container import open_log

    try:
        data, name, _ = open_log(path, None)
        return logs.recognise(bytes(data[:HEAD]), name) is not None
    except (LogError, OSError, EOFError):
        return False


def add(
    store: Store,
    given: Iterable[Path | str],
    aircraft: str = "",
    vehicle: Vehicle | None = None,
    tell: Callable[[Told], None] = lambda told: None,
    progress: Callable | None = None,
) -> list[Told]:
    """Add all logs that are new to the store, one transaction each. aircraft: a name for the flights, in place of what the logs say.
    tell: called with each file's fate. Standings are not worked out (`assess.refresh`). Raises StoreError, after which the same call goes
    on."""
    return [
        told for path, named in collect(given) if (told := _one(store, path, named, aircraft, vehicle, tell, progress))
    ]


def _one(store: Store, path: Path, named: bool, aircraft: str, vehicle: Vehicle | None, tell, progress) -> Told:
    told = _added(store, path, named, aircraft, vehicle, progress)
    tell(told)
    return told


def _added(store: Store, path: Path, named: bool, aircraft: str, vehicle: Vehicle | None, progress) -> Told:
    try:
        mark = digest(path)
    except OSError as why:
        return Told(path, "failed", text=f"{path}: {why.strerror or why}.")
    if store.has(mark):
        return Told(path, "known")
    if not named and not is_log(path):
        return Told(path, "no log")
    try:
        entry = judge.entry(path, aircraft, vehicle, progress)
    except (StoreError, KeyboardInterrupt):
        raise
    except RotorwatchError as why:
        return Told(path, "failed", text=str(why))
    except OSError as why:
        return Told(path, "failed", text=f"{path}: {why.strerror or why}.")
    if not store.add(entry):
        return Told(path, "known")
    whose = store.find(entry.identity)["name"] if entry.identity else ""
    return Told(path, "added", entry.verdict, entry.headline, whose)


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
            for path, _ in collect(folders):
                try:
                    state = path.stat()
                except OSError:
                    continue
                mark = state.st_size, state.st_mtime_ns
                if settled.get(path) == mark:
                    continue
                if seen.get(path) == mark:
                    new |= _one(store, path, False, aircraft, vehicle, tell, None).state == "added"
                    settled[path] = mark
                seen[path] = mark
            if new:
                assess.refresh(store)
            unwell = ""
        except StoreError as why:
            if str(why) != unwell:
                trouble(str(why))
            unwell = str(why)
        time.sleep(poll_s)


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
            if digest(row["path"]) != row["hash"]:
                lost = f"{row['path']} has another content now."
            else:
                entry = judge.entry(row["path"])
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
