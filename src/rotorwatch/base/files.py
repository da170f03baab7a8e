"""Output files: the target is checked before the work, and files are written atomically. Also TOML input, and foreign texts (of logs,
links, file names, addresses) made safe to display."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rotorwatch.errors import ConfigError

ADDRESS = re.compile(r"[a-z][a-z0-9+.-]*:/{1,2}[^/]", re.IGNORECASE)  # a Path has lost one of two slashes
USER = re.compile(r"([a-z][a-z0-9+.-]*://)[^\s/?#]*@", re.IGNORECASE)
QUERY = re.compile(r"([a-z][a-z0-9+.-]*://[^\s?]*\?)[^\s:]*", re.IGNORECASE)


def no_address(path: str | os.PathLike) -> None:
    """Raise ConfigError for an address on the web: only files of this computer are read and written."""
    text = os.fspath(path)
    if isinstance(text, str) and ADDRESS.match(text) and not Path(text).exists():
        text = re.sub(":/+", "://", text, count=1)
        raise ConfigError(f"{text} is an address, not a file: download it first (for instance with curl -O), then give the file.")


def toml(path: str | os.PathLike, what: str, most: int = 10_000_000) -> tuple[dict[str, Any], str]:
    """The table in a TOML file of at most `most` bytes, and its text. what: names the file in sentences, such as "plan". Raises
    ConfigError."""
    from rotorwatch.base.optional import tomllib

    try:
        with open(path, "rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise ConfigError(f"{path} is too large for a {what}.")
        text = data.decode()
        return tomllib.loads(text), text
    except OSError as error:
        raise ConfigError(f"Cannot read the {what} {path}: {error.strerror or error}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"The {what} {path} is not valid TOML: {error}.") from error


def writable(path: str | os.PathLike, what: str, make: bool = False) -> Path:
    """The path, when a file can be written there. Nothing is written; with `make` missing folders are made.

    what: names the target in the sentence, such as "--report". Raises ConfigError."""
    no_address(path)
    path = Path(path)
    if str(path) == "-":
        raise ConfigError(f"{what} -: give a file name; standard output carries the answer.")
    if path.is_dir():
        raise ConfigError(f"{what}: {path} is a folder; give a file name.")
    if path.exists() and not path.is_file():
        raise ConfigError(f"{what}: {path} is no ordinary file; give another name.")
    folder(path.parent, f"{what} {path}", make)
    if path.exists():
        try:
            path.open("ab").close()
        except OSError as why:
            raise ConfigError(f"{what} {path}: cannot be written to ({why.strerror or why}).") from None
    return path


def folder(path: str | os.PathLike, what: str, make: bool = True) -> Path:
    """The path, when files can be written into that folder; with `make` it is made. Raises ConfigError."""
    import tempfile

    no_address(path)
    path = Path(path)
    try:
        if make:
            path.mkdir(parents=True, exist_ok=True)
        if not path.is_dir():
            raise ConfigError(f"{what}: there is no folder {path}.")
        tempfile.TemporaryFile(dir=path).close()
    except FileExistsError:
        raise ConfigError(f"{what}: {path} is a file, not a folder.") from None
    except (OSError, ValueError) as why:
        reason = getattr(why, "strerror", None) or why
        raise ConfigError(f"{what}: cannot write into {path} ({reason}).") from None
    return path


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """A temporary path next to `path`, with its ending, that replaces it at the end; removed when something fails on the way. Raises
    ConfigError when it cannot be written."""
    import tempfile

    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    except (OSError, ValueError) as why:
        raise ConfigError(f"{path} cannot be written ({getattr(why, 'strerror', None) or why}).") from None
    os.close(handle)
    try:
        yield Path(name)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)  # mkstemp keeps files private; a result has the usual rights
        os.replace(name, path)
    except OSError as why:
        raise ConfigError(f"{path} cannot be written ({why.strerror or why}).") from None
    finally:
        with suppress(OSError):
            os.unlink(name)


def printable(text: str) -> str:
    """The text with all invisible characters escaped, as in \\x1b or \\n.

    A terminal, or a program that reads the output, takes control characters as commands; bytes that are no text, \\udcXX, cannot be written
    at all."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def one_line(text: str, most: int) -> str:
    """The text in one line of at most `most` letters (40 or more), its end kept, without terminal control characters, bidirectional
    overrides and undecodable bytes."""
    import unicodedata

    words = " ".join(text.split())
    plain = " ".join("".join(c for c in words if unicodedata.category(c)[0] != "C").split())
    return plain if len(plain) <= most else f"{plain[: most - 30]}…{plain[-29:]}"


def public(text: str) -> str:
    """The text without private parts of its addresses: user and password, and the query to a server."""
    return QUERY.sub(r"\1...", USER.sub(r"\1", text)) if "://" in text else text
