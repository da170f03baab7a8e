"""Flight log readers. Each module in this folder that has FORMAT is one format; nothing else lists them.

    FORMAT: str                                  name of the format
    sniff(head: bytes, name: str) -> bool        whether a file is of this format; name is "" when only the content may decide
    read(data, name, progress=None) -> Flight    data: bytes or a memory map; may raise LogError

ENDINGS, where given, are the file name endings of this format alone, as ".tlog"; COMMON_ENDINGS those that other files have as well.
Nothing else lists names of logs.

A format that is a folder of tables has sniff_folder(path) and read_folder(path, progress=None) besides or instead, and TABLES,
the pattern of the names of its files. One whose files hold several flights has parts(data) -> their numbers, the longest first, and its
read takes part=NUMBER. progress, where given, is called with the finished share, 0..1.

Another package may offer a module or an object with the same parts, as an entry point `rotorwatch.logs` (docs/plug-ins.md). It is tried
when no built-in format recognises the file.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from rotorwatch.base import discovery
from rotorwatch.base.progress import portion
from rotorwatch.errors import LogError, RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.logs import plausible, series

HEAD = 4096
"""Bytes that sniff sees."""
CHUNK = 1 << 20
"""Bytes that are hashed at once."""
READ = 0.75
"""Share of the work when a file is read; then its values are looked at."""
USUAL = {b"\xa3\x95": "dataflash", b"ULog": "ulog", b"H Product:Blackbox": "blackbox"}
"""What the most usual logs begin with: their module is asked first, and where it says yes no other is imported."""
FILE_PARTS, FOLDER_PARTS = ("sniff", "read"), ("sniff_folder", "read_folder")


@cache
def formats() -> tuple:
    """The modules of all log formats of this package, by name."""
    return tuple(m for m in discovery.modules(__name__) if hasattr(m, "FORMAT"))


def offered() -> dict[str, tuple[Any, Any]]:
    """FORMAT -> (entry point, format) that other installed packages offer; broken ones, and those whose FORMAT is taken, are left out with
    a PluginWarning."""

    def refuse(found) -> str:
        whole = any(all(hasattr(found, part) for part in pair) for pair in (FILE_PARTS, FOLDER_PARTS))
        taken = found.FORMAT in {m.FORMAT for m in formats()}
        if taken:
            return "its FORMAT is already in use"
        return "" if whole else "it needs sniff and read, or sniff_folder and read_folder"

    return {found.FORMAT: (entry, found) for entry, found in discovery.others(__name__, ("FORMAT",), refuse)}


@cache
def named(common: bool = True, archives: bool = False) -> re.Pattern:
    """Pattern of the endings of log names, compressed or not, case-insensitive; group 1 is the ending. common: include endings that other
    files share; archives: include compressions that are not opened here."""
    from rotorwatch.logs.container import PACKED, REFUSED

    known: list[Any] = [*formats(), *(found for _, found in offered().values())]
    parts = ("ENDINGS", "COMMON_ENDINGS") if common else ("ENDINGS",)
    endings = {ending for m in known for part in parts for ending in getattr(m, part, ())}
    endings = sorted(ending for ending in endings if len(ending) > 1 and ending[0] == ".")
    some, packed = ("|".join(map(re.escape, all_)) for all_ in (endings, PACKED + REFUSED * archives))
    return re.compile(rf"((?:{some})(?:{packed})?)$", re.IGNORECASE)


def read(path, progress=None) -> Flight:
    """Read a flight log of any known format, compressed (.xz, .gz, .bz2) or not.

    path: a file, or a folder: a ROS 2 bag, ulog2csv tables or those of Flight Review; of a file with several flights FILE#2 is the second.
    progress: called with the finished share, 0..1.
    Raises LogError with one sentence when there is no flight to be read; damage that leaves something is in `warnings`."""
    from rotorwatch.logs.container import open_log

    path, tell = Path(path), progress and portion(progress, 0.0, READ)
    if path.is_dir():
        folder_format = next((m for m in formats() if hasattr(m, "sniff_folder") and m.sniff_folder(path)), None)
        module: Any = folder_format or _theirs("sniff_folder", path)
        if module is None:
            raise LogError(f"{path}: a folder without ulog2csv tables, tables of Flight Review or a ROS 2 bag; give the log file itself")
        return _checked(lambda: module.read_folder(path, tell), module, path, (), progress)
    path, part = of_part(path)
    data, name, warnings = open_log(path, progress)
    module = recognise(bytes(data[:HEAD]), name)
    if progress and isinstance(data, bytes):  # it was unpacked first
        tell = portion(progress, 0.5, READ)
    if module is None:
        known = ", ".join(sorted({*(m.FORMAT for m in formats()), *offered()}))
        raise LogError(f"{path}: not a flight log of a known kind; known are {known}")
    if part is None:
        return _checked(lambda: module.read(data, name, tell), module, path, warnings, progress)
    if not hasattr(module, "parts"):
        raise LogError(f"{path}#{part}: a file of this kind ({module.FORMAT}) holds one flight; leave #{part} out")
    path = path.with_name(f"{path.name}#{part}")
    return _checked(lambda: module.read(data, f"{name}#{part}", tell, part=part), module, path, warnings, progress)


def from_bytes(data: bytes, name: str) -> Flight:
    """The flight of an uncompressed log file in memory with one flight, as `read` returns it for a file of that name. Raises LogError as it
    does."""
    module = recognise(data[:HEAD], name)
    if module is None:
        raise LogError(f"{name}: not a flight log of a known kind")
    return _checked(lambda: module.read(data, name), module, Path(name), ())


def of_part(path) -> tuple[Path, int | None]:
    """(file, number of a flight in it) of LOG.BFL#2; (path, None) of any other path, also of an existing file with such a name."""
    path = Path(path)
    name, mark, number = path.name.rpartition("#")
    if not mark or not name or not number.isascii() or not number.isdigit() or len(number) > 6 or path.exists():
        return path, None
    return path.with_name(name), int(number)


def fingerprint(path) -> tuple[int, str]:
    """(size in bytes, SHA-256 in hexadecimal) of a log: of a file, its bytes; of a folder, name, size and bytes of each file in order; of a
    flight in a file, its number, too. Raises OSError, and LogError for a pipe, a socket or a device."""
    import hashlib

    from rotorwatch.logs.container import ordinary

    path, number = of_part(path)
    folder, total, digest = path.is_dir(), 0, hashlib.sha256()
    if number is not None:
        digest.update(f"#{number}".encode())
    for file in sorted(f for f in path.iterdir() if f.is_file()) if folder else [path]:
        ordinary(file)
        size = file.stat().st_size
        if folder:
            digest.update(f"{file.name}\n{size}\n".encode("utf-8", "surrogateescape"))
        with open(file, "rb") as data:
            while block := data.read(CHUNK):
                digest.update(block)
        total += size
    return total, digest.hexdigest()


def sessions(path) -> list[str]:
    """The flights in a log file, the longest first: LOG.BFL#2, LOG.BFL#1 ..; the path itself where it holds one, or cannot be read."""
    from rotorwatch.logs.container import head, open_log

    path = Path(path)
    if not path.is_file():
        return [str(path)]
    format_ = recognise(*head(path, HEAD))
    if not hasattr(format_, "parts"):
        return [str(path)]
    try:
        numbers = format_.parts(open_log(path)[0])
    except RotorwatchError:
        return [str(path)]
    return [f"{path}#{number}" for number in numbers] if len(numbers) > 1 else [str(path)]


def recognise(head: bytes, name: str) -> Any:
    """The format for a file that starts with `head`: by content, failing that by `name`; None when unknown. Built-in formats come first."""
    for start, module in USUAL.items():
        if head.startswith(start) and (usual := import_module(f"{__name__}.{module}")).sniff(head, ""):
            return usual
    files: list[Any] = [m for m in formats() if hasattr(m, "sniff")]
    for label in ("", name):
        format_ = next((m for m in files if m.sniff(head, label)), None) or _theirs("sniff", head, label)
        if format_ is not None:
            return format_
    return None


def _theirs(part: str, *arguments) -> Any:
    """The format of another package whose `sniff` or `sniff_folder` is true, or None; one that raises is skipped, with a warning."""
    for entry, found in offered().values():
        try:
            if hasattr(found, part) and getattr(found, part)(*arguments):
                return found
        except Exception as why:  # a module of another package may raise anything
            discovery.failed(entry, part, why)
    return None


def _checked(job, module, path, warnings, progress=None) -> Flight:
    """Run a reader; any exception becomes a LogError, and so does a log without data."""
    try:
        flight = job()
    except RotorwatchError as error:
        text = str(error)
        raise LogError(text if path.name in text else f"{path}: {text}") from error
    except ModuleNotFoundError as error:
        needed = str(error.name).partition(".")[0]
        raise LogError(f"{path}: {module.FORMAT} needs {needed}, which is not installed: pip install {needed}.") from error
    except (Exception, RecursionError) as error:
        raise LogError(f"{path}: this {module.FORMAT} is too damaged to be read ({type(error).__name__})") from error
    if not isinstance(flight, Flight):
        raise LogError(f"{path}: the reader of {module.FORMAT} returned no Flight; fix or uninstall its package")
    if not any(len(s) >= 2 for name, s in flight.signals.items() if name not in series.SHOWN):
        raise LogError(f"{path}: this {module.FORMAT} holds no flight data; was logging switched on?")
    flight = replace(flight, name=path.name, warnings=(*warnings, *flight.warnings))
    return plausible.checked(flight, portion(progress, READ, 1.0))
