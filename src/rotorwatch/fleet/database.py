"""The database under a store: SQLite in a file, or PostgreSQL by URL; its transactions, and its errors as one sentence each.

Changes committed before an error stay, and the same command resumes from there.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event, exc

from rotorwatch.errors import ConfigError, StoreError, StoreFull
from rotorwatch.fleet.address import resolve

WAIT_S = 30.0  # for another writer
LOCK = 7_306_117  # of PostgreSQL's advisory locks: one writer at a time, so that flights are numbered without gaps


class Queries:
    """A connection for SQL with named parameters (`:name`)."""

    def __init__(self, connection: sa.Connection):
        self.connection = connection

    def rows(self, sql: str, **given: Any) -> sa.MappingResult:
        """Rows by column names."""
        return self.connection.execute(sa.text(sql), given).mappings()

    def value(self, sql: str, **given: Any) -> Any:
        """The first column of the first row; None without a row."""
        return self.connection.execute(sa.text(sql), given).scalar()

    def run(self, sql: str, **given: Any) -> int:
        """Execute a statement and return the number of changed rows."""
        return self.connection.execute(sa.text(sql), given).rowcount

    def insert(self, table: str, **row: Any) -> None:
        """Insert a row into a table."""
        self.run(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({', '.join(f':{name}' for name in row)})", **row)


class Database:
    """An open database. url: as `Store`; make: whether a missing file is created. Raises StoreError, or ConfigError for an invalid
    address."""

    def __init__(self, url: str | os.PathLike | None, make: bool):
        self.url, self.label = resolve(url)
        self._lite = self.url.startswith("sqlite")
        file = Path(self.label) if self._lite else None
        if file is not None and not file.exists():
            if not make:
                raise StoreError(f"No store {file} yet; `rotorwatch fleet add` creates it.")
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as why:
                raise StoreError(f"The store {file} cannot be created: {why.strerror or why}.") from None
        with self._errors_as_sentences():
            self.engine = _engine(self.url, self._lite)

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Queries]:
        """A connection that only reads."""
        with self._errors_as_sentences(), self.engine.connect() as connection:
            yield Queries(connection)

    @contextmanager
    def writing(self) -> Iterator[Queries]:
        """A connection in an exclusive write transaction; committed at the end, else rolled back."""
        connected = self.engine.connect
        with self._errors_as_sentences(), connected().execution_options(rotorwatch_write=True) as connection, connection.begin():
            if not self._lite:
                connection.execute(sa.text(f"SELECT pg_advisory_xact_lock({LOCK})"))
            yield Queries(connection)

    @contextmanager
    def _errors_as_sentences(self) -> Iterator[None]:
        """Errors of the database as one sentence."""
        try:
            yield
        except exc.SQLAlchemyError as why:
            raise _error(why, self.label, self._lite) from None


def _engine(url: str, lite: bool) -> sa.Engine:
    try:
        if not lite:
            args = {"connect_timeout": 10, "application_name": "rotorwatch"}
            return sa.create_engine(url, connect_args=args, pool_pre_ping=True)
        path = Path(url.removeprefix("sqlite:///"))
        engine = sa.create_engine(url, creator=lambda: _connected(path))
    except ImportError:
        raise ConfigError('A store in PostgreSQL needs psycopg, which is not installed: pip install "psycopg[binary]".') from None

    # SQLite's Python driver begins transactions late and excludes DDL: they are begun here, at once for writers.
    @event.listens_for(engine, "begin")
    def begun(connection: Any) -> None:
        write = connection.get_execution_options().get("rotorwatch_write")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")

    return engine


def _connected(path: Path) -> sqlite3.Connection:
    """A connection to a file, which is read also where nothing may be written. Raises sqlite3.Error."""
    options: dict[str, Any] = {"timeout": WAIT_S, "check_same_thread": False, "isolation_level": None}
    base = sqlite3.connect(path, **options)
    try:
        log = base.execute("PRAGMA journal_mode").fetchone()[0]
        base.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.DatabaseError as why:
        base.close()
        left = path.with_name(f"{path.name}-wal")
        fine = not os.access(path.parent, os.W_OK) and not (left.exists() and left.stat().st_size)
        if not fine or not isinstance(why, sqlite3.OperationalError):
            raise
        # SQLite cannot create its companion files here. No writer is active: its files would be there.
        base = sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True, **options)
        log = "wal"
    pragmas = ["foreign_keys=ON", "synchronous=FULL"]
    if log != "wal" and os.access(path, os.W_OK):
        pragmas.append("journal_mode=WAL")
    for pragma in pragmas:
        base.execute(f"PRAGMA {pragma}")
    return base


AGAIN = "No partial data were written; run the same command again afterwards."


def _error(why: Exception, label: str, lite: bool) -> StoreError:
    text = " ".join(str(getattr(why, "orig", None) or why).split())
    low = text.lower()
    if "disk is full" in low or "no space left" in low or "disk i/o error" in low:
        return StoreFull(f"The disk of the store {label} is full or broken: free some space. {AGAIN}")
    return StoreError(_sentence(text, low, label, lite))


def _sentence(text: str, low: str, label: str, lite: bool) -> str:
    copy = "give another file, or restore a backup"
    known = (
        ("locked", f"Another program has kept the store {label} busy for {WAIT_S:.0f} s: wait for it or stop it. {AGAIN}"),
        ("not a database|malformed", f"{label} is not a store of rotorwatch, or is damaged; {copy}."),
        ("readonly|read-only", f"The store {label} is not writable; check the permissions of its file and folder."),
        ("unable to open", f"The store {label} cannot be opened; check its folder and permissions."),
    )
    if not lite:
        away = f"The database {label} cannot be reached ({text[:120]}): check that it is running. {AGAIN}"
        known = (*known, ("connect|server|terminat|shutting down", away))
    return next((reply for words, reply in known if re.search(words, low)), f"The store {label} failed ({text[:160]}). {AGAIN}")
