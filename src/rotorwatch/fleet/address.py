"""Location of a store: a file name or a URL."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from urllib.parse import urlsplit

from rotorwatch.base.files import public
from rotorwatch.errors import ConfigError


def default_url() -> str:
    """ROTORWATCH_STORE, or `data_file`."""
    return os.environ.get("ROTORWATCH_STORE") or str(data_file())


def data_file() -> Path:
    """A SQLite file in the platform's folder for user data."""
    home = Path.home()
    if sys.platform == "win32":
        folder = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        folder = home / "Library" / "Application Support"
    else:
        folder = Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share")
    return folder / "rotorwatch" / "fleet.db"


def resolve(url: str | os.PathLike | None) -> tuple[str, str]:
    """(SQLAlchemy's URL, name for messages: the file, or the URL without its password)."""
    text = os.fspath(url) if url is not None else default_url()
    if re.match(r"postgres(ql)?(\+\w+)?://", text):
        rest = text.partition("://")[2]
        label = public(f"postgresql://{rest.rpartition('@')[2]}")
        try:
            urlsplit(f"postgresql://{rest}").port  # noqa: B018 - raises for what is no port
        except ValueError:
            raise ConfigError(f"{label} is not a database address; give postgresql://USER@HOST/DATABASE.") from None
        if rest.count("@") > 1:  # drivers end the password at the first @, and show the rest of it as the host
            raise ConfigError(f"{label}: write @ in a user's name or a password as %40.")
        return f"postgresql+psycopg://{rest}", label
    if text.startswith("sqlite:///"):
        text = text.removeprefix("sqlite:///")
    elif re.match(r"[a-z][a-z0-9+.-]+:/", text, re.IGNORECASE) and not Path(text).exists():  # a single letter is a drive
        text = re.sub(":/+", "://", text, count=1)
        raise ConfigError(f"{public(text)} is not a store; give a file name or postgresql://USER@HOST/DATABASE.")
    if not text:
        raise ConfigError("An empty name was given for the store; give a file name or postgresql://USER@HOST/DATABASE.")
    try:
        path = Path(text).expanduser()
    except RuntimeError:
        raise ConfigError(f"The store {text}: no such user; give a file name.") from None
    if path.is_dir():
        raise ConfigError(f"The store {path} is a folder; give a file name.")
    return f"sqlite:///{path}", str(path)
