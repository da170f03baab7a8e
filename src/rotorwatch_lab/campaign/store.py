"""A campaign's folder: finished parts, and the table of all flights.

    DIR/plan.toml           the plan, as it was
    DIR/campaign.json       version, width of batches and what steps the default estimator: what results depend on
    DIR/parts/*.parquet     finished parts, written under another name and then renamed: a part is there whole or not at all
    DIR/flights.parquet     all parts, in order of flights
    DIR/summary.json, DIR/index.html

A part is named by cell, batch and the places in the batch that it holds, so that what is missing follows from a folder listing.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rotorwatch.base import optional
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.campaign.score import COLUMNS

PART = re.compile(r"(\d{2})-(\d{5})-(\d{4})-(\d{4})\.parquet")


class Work(NamedTuple):
    """Places first..last-1 of batch `batch` in cell `cell`."""

    cell: int
    batch: int
    first: int
    last: int

    @property
    def name(self) -> str:
        """The part's file name."""
        return f"{self.cell:02d}-{self.batch:05d}-{self.first:04d}-{self.last:04d}.parquet"

    def flights(self, cells: int, width: int) -> tuple[int, ...]:
        """The numbers of its flights."""
        return tuple(self.cell + cells * (self.batch * width + place) for place in range(self.first, self.last))


def parquet() -> Any:
    """pyarrow with its parquet module. Raises ConfigError where it is not installed."""
    optional.library("pyarrow.parquet", "A campaign, which keeps its results as Parquet,")
    import pyarrow

    return pyarrow


class Folder:
    """Results of a campaign. columns: name -> (kind, meaning) of its table."""

    def __init__(self, path: str | os.PathLike, columns: Mapping[str, tuple[str, str]] = COLUMNS):
        self.path, self.columns = Path(path), columns
        self.parts = self.path / "parts"

    def open(self, plan: Plan, width: int, version: str, engine: str) -> int:
        """Make the folder, or check that it is of the same plan; returns the width of its batches. Raises ConfigError."""
        parquet()
        _make(self.parts)
        about, plan_file = self.path / "campaign.json", self.path / "plan.toml"
        if not about.exists():
            if any(self.parts.iterdir()):
                raise ConfigError(f"{self.path} holds parts of an unknown campaign; give another folder.")
            _write(plan_file, plan.text.encode())
            _write(about, json.dumps({"version": version, "width": width, "engine": engine}).encode())
            return width
        known = _known(about)
        if not plan_file.is_file() or plan_file.read_bytes() != plan.text.encode():
            raise ConfigError(f"{self.path} holds results of another plan (its plan.toml); give another folder.")
        if known["version"] != version:
            raise ConfigError(f"{self.path} was begun with rotorwatch {known['version']}, this is {version}; give another folder.")
        if known["engine"] != engine:
            raise ConfigError(
                f"{self.path} was begun with {known['engine']} code, here is {engine}, whose last digits differ: set "
                f"ROTORWATCH_BACKEND={known['engine']} where a C compiler is, or give another folder."
            )
        return known["width"]

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold an exclusive lock on the folder; it is released when the process ends. Raises ConfigError."""
        _make(self.path)
        with open(self.path / ".lock", "w") as file:
            try:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except ImportError:  # no such locks on this system: two campaigns in one folder would only waste time
                pass
            except OSError as error:
                raise ConfigError(f"Another campaign is running in {self.path}.") from error
            yield

    def missing(self, flights: int, cells: int, width: int) -> list[Work]:
        """The work that remains for flights 0..flights-1, cells in turn."""
        done: dict[tuple[int, int], int] = {}
        for path in self.parts.iterdir():
            if path.name.startswith("."):
                path.unlink(missing_ok=True)  # begun and never finished
            elif match := PART.fullmatch(path.name):
                cell, batch, _, last = map(int, match.groups())
                done[cell, batch] = max(done.get((cell, batch), 0), last)
        work = []
        for batch in range(-(-flights // (cells * width))):
            for cell in range(cells):
                places = min(width, max(0, -(-(flights - cell) // cells) - batch * width))
                have = done.get((cell, batch), 0)
                if have < places:
                    work.append(Work(cell, batch, have, places))
        return work

    def write(self, work: Work, rows: Sequence[dict]) -> None:
        """Store a finished part."""
        pa = parquet()
        schema = pa.schema([(name, getattr(pa, _TYPES[kind])()) for name, (kind, _) in self.columns.items()])
        table = pa.Table.from_pylist(list(rows), schema=schema)
        hidden = self.parts / f".{work.name}.{os.getpid()}"
        pa.parquet.write_table(table, hidden)
        with open(hidden, "rb") as file:
            os.fsync(file.fileno())
        os.replace(hidden, self.parts / work.name)

    def table(self, flights: int | None = None) -> Any:
        """All finished flights as a pyarrow table, in order; those below `flights` only."""
        pa = parquet()
        paths = sorted(path for path in self.parts.glob("*.parquet") if PART.fullmatch(path.name))
        if not paths:
            raise ConfigError(f"{self.path} holds no finished part of a campaign.")
        table = pa.concat_tables([_part(path) for path in paths])
        table = table.sort_by([("flight", "ascending"), ("method", "ascending")])
        if flights is not None:
            table = table.filter(pa.compute.less(table["flight"], flights))
        return table

    def finish(self, table: Any, summary: dict) -> None:
        """Write the whole table and its summary."""
        pa = parquet()
        hidden = self.path / ".flights.parquet"
        pa.parquet.write_table(table, hidden)
        os.replace(hidden, self.path / "flights.parquet")
        _write(self.path / "summary.json", (json.dumps(summary, indent=1, allow_nan=False) + "\n").encode())


def _make(folder: Path) -> None:
    """Create a folder if it does not exist. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"Cannot make the folder {folder}: {error.strerror or error}.") from error


def _known(about: Path) -> dict[str, Any]:
    """The contents of campaign.json. Raises ConfigError."""
    try:
        known = json.loads(about.read_bytes())
        return {"version": str(known["version"]), "width": int(known["width"]), "engine": str(known.get("engine", "jax"))}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{about} is damaged; give another folder.") from error


def _part(path: Path) -> Any:
    """A finished part. Raises ConfigError."""
    pa = parquet()
    try:
        return pa.parquet.read_table(path)
    except pa.ArrowException as error:
        raise ConfigError(f"{path} is damaged; delete it and run the command again.") from error


_TYPES = {"int64": "int64", "string": "string", "double": "float64", "bool": "bool_"}


def _write(path: Path, data: bytes) -> None:
    hidden = path.with_name(f".{path.name}.{os.getpid()}")
    hidden.write_bytes(data)
    os.replace(hidden, path)
