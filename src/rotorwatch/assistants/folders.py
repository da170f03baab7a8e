"""The readable files: ordinary files inside the folders that the user allowed, after resolving links and dots."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from rotorwatch import logs
from rotorwatch.errors import ConfigError

LOOKED_AT = 20_000  # entries of folders in one search
DEEPEST = 12  # folders inside folders
LONGEST = 1024  # letters of a path
ID = re.compile(r"[0-9a-f]{12}")
TABLE = re.compile(r"(\.toml)$", re.IGNORECASE)
OUTSIDE = "is in none of the allowed folders; `list_logs` shows what may be read."


@dataclass(frozen=True)
class Allowed:
    """A readable file. path: without links; part: number of a flight in it, or None; size: bytes; changed: time of the last change [ns];
    ending: of its name, from a fixed list."""

    path: Path
    part: int | None
    size: int
    changed: int
    ending: str

    @property
    def name(self) -> str:
        return self.path.name + ("" if self.part is None else f"#{self.part}")


class Folders:
    """The allowed folders. most: bytes of a file. Raises ConfigError for anything but a folder."""

    def __init__(self, folders: Sequence[str | os.PathLike], most: int):
        self.most, self._known = most, {}
        self.roots: list[Path] = []
        for folder in folders:
            try:
                root = Path(folder).expanduser().resolve(strict=True)
            except (OSError, RuntimeError, ValueError):
                raise ConfigError(f"{folder}: no such folder.") from None
            if not root.is_dir():
                raise ConfigError(f"{folder} is not a folder; name the folder of the logs.")
            if root not in self.roots:
                self.roots.append(root)

    def log(self, given: str) -> Allowed:
        """The log of that path or id. Raises ConfigError."""
        return self._file("log", given, logs.named())

    def vehicle(self, given: str) -> Allowed:
        """The vehicle file of that path. Raises ConfigError."""
        return self._file("vehicle", given, TABLE)

    def _file(self, what: str, given: str, endings: re.Pattern) -> Allowed:
        path, part = self._find(what, given, endings)
        try:
            about = path.lstat()
        except (OSError, ValueError):
            raise ConfigError(f"{what}: no such file.") from None
        if stat.S_ISDIR(about.st_mode):
            raise ConfigError(f"{what}: this is a folder; name one file in it.")
        if not stat.S_ISREG(about.st_mode):
            raise ConfigError(f"{what}: not a regular file.")
        ending = endings.search(path.name)
        if ending is None:
            wanted = "a vehicle file (.toml)" if endings is TABLE else "a log of a known kind, by the end of its name"
            raise ConfigError(f"{what}: this is not {wanted}.")
        if about.st_size > self.most:
            raise ConfigError(f"{what}: this is more than the {self.most / 2**20:g} MB that are read here.")
        if not about.st_size:
            raise ConfigError(f"{what}: the file is empty.")
        return Allowed(path, part, about.st_size, about.st_mtime_ns, ending.group(1).lower())

    def _find(self, what: str, given: str, endings: re.Pattern) -> tuple[Path, int | None]:
        """A path without links inside an allowed folder, and the number of a flight in it. Raises ConfigError."""
        if not given or len(given) > LONGEST or "\0" in given:
            raise ConfigError(f"{what}: give the path of a file, or the id that `list_logs` shows.")
        if ID.fullmatch(given):
            if given not in self._known:
                self.list("")
            if given in self._known:
                return self._inside(what, self._known[given]), None
        asked, part = logs.of_part(given) if endings is not TABLE else (Path(given), None)
        if not self.roots:
            raise ConfigError(f"{what}: no folder is allowed; start the server with the folders of your logs.")
        candidates = [asked] if asked.is_absolute() else [root / asked for root in self.roots]
        existing = [c for c in candidates if os.path.lexists(c)]
        return self._inside(what, existing[0] if existing else candidates[0]), part

    def _inside(self, what: str, path: Path) -> Path:
        try:
            real = path.resolve()
        except (OSError, RuntimeError, ValueError):
            raise ConfigError(f"{what}: no such file.") from None
        for root in self.roots:
            if real.is_relative_to(root):
                if any(part.startswith(".") for part in real.relative_to(root).parts):
                    raise ConfigError(f"{what}: hidden files are not read.")
                return real
        raise ConfigError(f"{what}: this {OUTSIDE}")

    def list(self, search: str) -> list[tuple[str, Path, Path, os.stat_result]]:
        """(id, its folder, path, facts) of every log, the newest first. search: words that the path contains."""
        words, logs_, ending = search.lower().split(), [], logs.named()
        for root in self.roots:
            for path in islice(_files(root, DEEPEST), LOOKED_AT):
                searched = str(path.relative_to(root)).lower()
                if ending.search(path.name) and all(word in searched for word in words):
                    try:
                        about = path.stat()
                    except OSError:
                        continue
                    name = hashlib.sha256(os.fsencode(path)).hexdigest()[:12]
                    self._known[name] = path
                    logs_.append((name, root, path, about))
        return sorted(logs_, key=lambda entry: (-entry[3].st_mtime_ns, str(entry[2])))


def _files(folder: Path, deep: int) -> Iterator[Path]:
    """Ordinary files in a folder and in those inside it; nothing hidden, no links."""
    try:
        entries: Iterable[os.DirEntry] = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return
    for entry in entries:
        try:
            if entry.name.startswith(".") or entry.is_symlink():
                continue
            if entry.is_file(follow_symlinks=False):
                yield Path(entry.path)
            elif deep and entry.is_dir(follow_symlinks=False):
                yield from _files(Path(entry.path), deep - 1)
        except OSError:
            continue
