"""The list of flights: rows of the fleet's store, and next to it a folder with the page of each flight."""

from __future__ import annotations

import json
import os
import queue
import re
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rotorwatch.base import files
from rotorwatch.errors import RotorwatchError, StoreError, StoreFull, WorkerError
from rotorwatch.fleet.compare import Comparison, compare
from rotorwatch.fleet.listing import NEWEST
from rotorwatch.fleet.store import Entry, Store
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.live.guard import as_json
from rotorwatch.report.html import page

AGAIN_S = 30.0  # between two attempts to reach a store
DIGEST = re.compile("[0-9a-f]{64}")
SHOWN = ("hash", "name", "utc", "verdict", "headline", "frame", "duration_s", "aircraft_name", "loss", "onset_s")


class Flights:
    """The store, and the folder of pages. url: as for `Store`. Raises StoreError or ConfigError where unavailable."""

    def __init__(self, url: str | None = None):
        self._store = Store(url)
        self._folder = files.folder(self._store.reports.folder, "--store")

    def folder(self, name: str) -> Path:
        """A folder of that name next to the store, created when missing."""
        return files.folder(self._folder / name, "--store")

    def page(self, digest: str) -> Path:
        """The path of a flight's page, whether it exists or not."""
        return self._store.reports.path(digest)

    def rows(self, limit: int, offset: int = 0, sort: str = NEWEST, **filters: Any) -> dict[str, Any]:
        """{total, flights}. sort, filters: as for `Store.flights`. Raises as that does."""
        flights = self._store.flights(sort, limit, offset, **filters)
        return {"total": self._store.count(**filters), "flights": [_listed(row) for row in flights]}

    def aircraft(self) -> list[dict[str, Any]]:
        """All aircraft by name: key, name and number of flights."""
        return self._store.aircraft_names()

    def compared(self, a: str, b: str) -> Comparison:
        """Two flights side by side. Raises as `compare` does."""
        return compare(self._store, a, b)

    def delete(self, digest: str) -> dict[str, Any]:
        """Delete a flight with its report; returns its row of the list. Raises NotInStore."""
        return _listed(self._store.delete(digest))

    def row(self, digest: str) -> dict[str, Any] | None:
        """A flight; None when unknown."""
        flight = self._store.flight(digest)
        return None if flight is None else _listed(flight)

    def keep(self, entry: Entry) -> dict[str, Any]:
        """Put a flight into the store, once; its row there."""
        self._store.add(entry)
        stored = self.row(entry.hash)
        assert stored is not None
        return stored

    def store_writer(self, on_stored: Callable[[dict[str, Any]], None], trouble: Callable[[str], None]) -> StoreWriter:
        """A thread that stores flights. on_stored: called with the row of each; trouble: called with a sentence on failure."""
        return StoreWriter(self, on_stored, trouble, self.folder("heard"))

    def diagnosis(self, digest: str) -> dict[str, Any] | None:
        """The diagnosis of a flight, as in docs/json.md."""
        flight = self._store.flight(digest)
        return None if flight is None else flight["diagnosis"]

    def report(self, digest: str) -> str | None:
        """The page of a flight: as written, or, for a flight that came into the store another way, made from the stored answer, without
        plots."""
        diagnosis = self.diagnosis(digest)
        if diagnosis is None:
            return None
        try:
            return self.page(digest).read_text(encoding="utf-8")
        except OSError:
            return page(Diagnosis.from_dict(diagnosis))

    def close(self) -> None:
        """Close the store."""
        self._store.close()


class StoreWriter:
    """A thread that writes flights to the store, and retries while the store cannot be reached.

    waiting: folder for flights not yet stored; the next server begins with them."""

    def __init__(self, flights: Flights, on_stored: Callable, trouble: Callable[[str], None], waiting: Path):
        self._flights, self._on_stored, self._trouble, self._waiting = flights, on_stored, trouble, waiting
        self._queue: queue.SimpleQueue[Entry | None] = queue.SimpleQueue()
        for path in sorted(waiting.glob("*.json")):
            with suppress(OSError, ValueError, TypeError):
                self._queue.put(Entry(**json.loads(path.read_text("utf-8"))))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._leaving = threading.Event()
        self._thread.start()

    def keep(self, entry: Entry) -> None:
        """Queue a flight."""
        self._queue.put(entry)

    def stop(self) -> None:
        """End the thread when all flights are stored, or left to the next server."""
        self._leaving.set()
        self._queue.put(None)
        self._thread.join(60.0)

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            while True:
                try:
                    row = self._flights.keep(entry)
                except Exception as why:  # any error of a store: retried
                    with suppress(Exception):
                        self._trouble(f"The flight of {entry.name} is not in the list yet. {wrong(why)[1]}")
                    self._put_by(entry)
                    if self._leaving.wait(AGAIN_S):
                        break
                    continue
                with suppress(Exception):  # stored, whether the pages are notified or not
                    self._on_stored(row)
                with suppress(OSError):
                    self._path(entry).unlink(missing_ok=True)
                break

    def _path(self, entry: Entry) -> Path:
        return self._waiting / f"{entry.hash}.json"

    def _put_by(self, entry: Entry) -> None:
        """Write the entry to disk, once. Where that fails too, storing is only retried."""
        if not self._path(entry).exists():
            with suppress(Exception), files.replacing(self._path(entry)) as part:
                part.write_text(as_json(asdict(entry)), "utf-8")


def wrong(why: Exception) -> tuple[int, str]:
    """(status code, sentence) for an error. Paths and other details go to the operator, on standard error."""
    if os.environ.get("ROTORWATCH_DEBUG"):
        import traceback

        traceback.print_exception(why)
    with suppress(OSError, ValueError, AttributeError):  # standard error may be closed
        text = files.public(files.printable(f"{type(why).__name__}: {why}"))
        print(f"rotorwatch: {text}", file=sys.stderr, flush=True)
    mine = f"Internal error of rotorwatch ({type(why).__name__}); please report it with the server's output."
    causes: tuple[tuple[Any, int, str], ...] = (
        ((StoreFull, OSError), 507, "The server's disk is full or not writable; free some space."),
        (StoreError, 503, "The list of flights cannot be read or written; check the server's store."),
        (WorkerError, 503, "The diagnosis process is not running; try again."),
        (RotorwatchError, 503, str(why)),  # on a flight's content, not its location
    )
    return next(((code, text) for kind, code, text in causes if isinstance(why, kind)), (500, mine))


def _listed(row: dict[str, Any]) -> dict[str, Any]:
    return {name: row.get(name) for name in SHOWN}
