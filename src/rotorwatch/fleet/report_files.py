"""The reports of flights: files in a folder next to the store. A flight and its report stay consistent across interruptions."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rotorwatch.errors import StoreError

ASIDE = ".deleted"  # ending of a report whose flight is being deleted


class Reports:
    """The reports of a store. place: the store's file, or for a database without one the file that a local store would have.

    known: whether the store holds a flight, by hash. The folder is created on the first write."""

    def __init__(self, place: Path, known: Callable[[str], bool]):
        self.folder = place.parent / f"{place.stem}-pages"
        self._known = known

    def path(self, hash: str) -> Path:
        """The path of a flight's report, whether it exists or not."""
        return self.folder / f"{hash}.html"

    @contextmanager
    def removed(self, hash: str) -> Iterator[None]:
        """Context in which the flight is deleted. Its report is set aside before, and removed or restored afterwards according to the
        flight; after a kill in between, `settle` does so when the store is next opened. Raises StoreError where the report cannot be
        moved."""
        aside = self.folder / f"{hash}{ASIDE}"
        try:
            with suppress(FileNotFoundError):
                os.replace(self.path(hash), aside)
        except OSError as why:
            raise StoreError(f"The report {self.path(hash)} cannot be removed ({why.strerror or why}).") from None
        try:
            yield
        finally:
            self._settle(aside)

    def settle(self) -> None:
        """Finish deletions that were killed."""
        with suppress(OSError):
            for name in os.listdir(self.folder):
                if name.endswith(ASIDE):
                    self._settle(self.folder / name)

    def _settle(self, aside: Path) -> None:
        """Finish one deletion; where store or disk fail, all stays for the next time."""
        page = self.path(aside.stem)
        with suppress(StoreError, OSError):
            if not self._known(aside.stem):
                aside.unlink(missing_ok=True)  # first: another program that opens the store may be restoring it
                page.unlink(missing_ok=True)
            elif page.exists():  # assessed again since
                aside.unlink(missing_ok=True)
            elif aside.exists():
                os.replace(aside, page)
