"""The logs of a call: files with all their flights, folders with all their logs, patterns, and addresses that fsspec supports (the extra
`cluster`)."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rotorwatch import logs
from rotorwatch.base import incoming, optional
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.logs import container, parquet_pages

ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)
PATTERN = re.compile(r"[*?\[]")
TABLES = (".csv", ".parquet")
"""Names that many files have which are no flights: their content has to say that they are."""


def is_address(source: Any) -> bool:
    """True if this is the address of one or more logs (s3://, http://, file:// ..), not a path."""
    return isinstance(source, str) and ADDRESS.match(source) is not None and not os.path.exists(source)


def is_several(source: Any) -> bool:
    """True if this stands for any number of logs: a folder that is no log itself, a pattern, such an address, or a file with several
    flights."""
    if is_address(source):
        return source.endswith("/") or "*" in source
    path = Path(source)
    if path.is_dir():
        return not is_log(path)
    if path.is_file():
        return len(logs.sessions(path)) > 1
    return not path.exists() and PATTERN.search(str(source)) is not None


class Found(tuple):
    """Logs that have been gathered, and need not be looked for again."""


class Gathered:
    """The logs of a call, each once, in the order found: files by name as they are given, what is in folders and fits patterns when it is
    named or recognised as a log. `others`: how many files in those were not, counted while this is iterated over."""

    def __init__(self, source: Iterable[str | os.PathLike]):
        self.source, self.others = source, 0

    def __iter__(self) -> Iterator[str | Path]:
        """Raises ConfigError for a folder, a pattern or an address without logs."""
        seen: set[str] = set()
        self.others = 0
        for source in self.source:
            count = 0
            for log in self._of(source):
                count += 1
                if (name := full(log)) not in seen:
                    seen.add(name)
                    yield log
            if not count:
                what = "holds no flight log" if is_address(source) or Path(source).is_dir() else "fits no flight log"
                raise ConfigError(f"{source} {what}; give a log, a folder or a pattern.")

    def _of(self, source: str | os.PathLike) -> Iterator[str | Path]:
        if not is_address(source) and Path(source).is_file():
            yield from self._flights(Path(source))
        elif not is_several(source):
            yield str(source) if is_address(source) else Path(source)
        elif is_address(source):
            yield from self._behind(str(source))
        elif Path(source).is_dir():
            yield from self._inside(Path(source))
        else:
            import glob

            for name in sorted(glob.glob(str(source), recursive=True)):
                path = Path(name)
                if not path.is_dir() or is_log(path):
                    yield from self._recognised(path)

    def _inside(self, folder: Path) -> Iterator[Path]:
        if is_log(folder):
            yield folder
            return
        entries = sorted(folder.iterdir(), key=lambda path: path.name)
        for path in entries:
            if path.name.startswith("."):
                continue
            if path.is_dir():
                if not path.is_symlink():  # a link may lead back here
                    yield from self._inside(path)
            else:
                yield from self._recognised(path)

    def _recognised(self, path: Path) -> Iterator[Path]:
        ordinary = path.is_file() or path.is_dir() or not path.exists()  # no pipe, socket or device: to open one may wait for ever
        if ordinary and is_meant(path):
            yield from self._flights(path)
        else:
            self.others += 1

    def _flights(self, path: Path) -> Iterator[Path]:
        """The flights in a file, as `logs.read` takes them."""
        names = logs.sessions(path) if path.is_file() else []
        yield from map(Path, names) if len(names) > 1 else [path]

    def _behind(self, address: str) -> Iterator[str]:
        fsspec = _fsspec(address)
        try:
            system, path = fsspec.core.url_to_fs(address)
            found = system.glob(path) if "*" in path else system.find(path)
        except Exception as why:  # every store has errors of its own
            raise ConfigError(_unreadable(address, why)) from why
        folders = {name.rpartition("/")[0] for name in found if _is_part(name)}
        yield from (f"{system.unstrip_protocol(folder)}/" for folder in sorted(folders))
        for name in sorted(found):
            folder, _, file = name.rpartition("/")
            if file.startswith(".") or folder in folders:
                continue
            if logs.named().search(name.split("?")[0]):
                yield system.unstrip_protocol(name)
            else:
                self.others += 1


def full(log: str | os.PathLike) -> str:
    """The log's name wherever one is: its address, or its absolute path."""
    return str(log) if is_address(log) else os.path.abspath(log)


@contextmanager
def fetched(log: str | os.PathLike) -> Iterator[Path]:
    """The log as a file or a folder here: itself, or what its address holds, in a folder that goes afterwards. Raises LogError."""
    if not is_address(log):
        yield Path(log)
        return
    import tempfile
    from urllib.parse import unquote, urlsplit

    address = str(log)
    try:
        name = unquote(urlsplit(address).path)
    except ValueError as why:
        raise LogError(f"{address} is no address ({why}).") from None
    if address.lower().startswith("file://"):
        yield Path(name)
        return
    fsspec = _fsspec(address)
    with tempfile.TemporaryDirectory(dir=incoming.spool()) as folder:
        path = Path(folder) / (name.rstrip("/").rpartition("/")[2] or "log")
        try:
            if address.endswith("/"):  # a folder of tables
                path.mkdir()
                system, there = fsspec.core.url_to_fs(address)
                for file in system.ls(there, detail=False):
                    if _is_part(file) or file.endswith(".json"):
                        with system.open(file, "rb") as source:
                            incoming.keep(source, path / file.rpartition("/")[2], address)
            else:
                with fsspec.open(address, "rb") as source:
                    incoming.keep(source, path, address)
        except LogError:
            raise
        except Exception as why:
            raise LogError(_unreadable(address, why)) from why
        yield path


def _is_part(name: str) -> bool:
    """True for the name of a table of a format that is a folder of tables."""
    file = name.rpartition("/")[2]
    return any(m.TABLES.fullmatch(file) for m in logs.formats() if hasattr(m, "TABLES"))


def is_there(path: Path) -> bool:
    """True if there is a file or a folder, or the file that contains a flight such as LOG.BFL#2."""
    return logs.of_part(path)[0].exists()


def is_meant(path: Path, archives: bool = False) -> bool:
    """True if a file is a log by its content or its name: an unreadable one with a log's name was a flight, and is not skipped. archives:
    include compressions that are not opened here."""
    return logs.named(common=False, archives=archives).search(path.name) is not None or is_log(path)


def is_log(path: Path) -> bool:
    """True if a reader recognises its content; by its name only where that is not one of any table."""
    if path.is_dir():
        try:
            return any(m.sniff_folder(path) for m in logs.formats() if hasattr(m, "sniff_folder"))
        except OSError:
            return False
    if not path.is_file():
        return False
    data, name = container.head(path, logs.HEAD)
    table = name.lower().endswith(TABLES)
    found: Any = logs.recognise(data, "" if table else name) if data else None
    if table and hasattr(found, "sniff_folder"):  # a table of a set: others begin with such a column, too
        return found.sniff_folder(path.parent)
    return found is not None and not (table and parquet_pages.is_answer(path))


def _fsspec(address: str) -> Any:
    return optional.library("fsspec", f"Reading {address}")


def _unreadable(address: str, why: Exception) -> str:
    if isinstance(why, FileNotFoundError):
        return f"{address}: nothing is there."
    text = " ".join(f"{type(why).__name__}: {why}".split())[:200].rstrip(".")
    return f"{address}: cannot be read ({text})."
