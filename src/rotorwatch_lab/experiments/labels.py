"""Lists of labelled flights: a CSV with a row for each fault, and one for each healthy flight.

    path          the log, relative to the list's folder; FILE#2 for the second session of a Blackbox file
    rotor         its broken rotors, as the autopilot counts, from 1 (3, or 1+4 for a pair); empty: the flight is healthy
    onset_s       when it broke, in s from the log's first record; 0: from take-off
    size          lost share of thrust of each of these rotors, 0 to 1; empty where nobody knows
    end_s         when it was whole again; empty: never
    vehicle       a vehicle file, relative to the list's folder; empty: as the log says
    baseline      healthy flights of the same build, relative to it, with ; between them
    label_source  how the label is known

A flight with several faults has a row for each; one may begin while another lasts. A folder stands for its labels.csv; without one, for
its logs, of which nothing is known.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rotorwatch import logs
from rotorwatch.base import files
from rotorwatch.errors import ConfigError

COLUMNS = ("path", "rotor", "onset_s", "size", "end_s", "vehicle", "baseline", "label_source")
NUMBERS = ("onset_s", "size", "end_s")
MOST = 100_000_000  # bytes of a list


class Fault(NamedTuple):
    """A fault. rotors: from 1; onset_s, end_s: s from the log's first record (0: from take-off; None: it lasts); size: None if unknown."""

    rotors: tuple[int, ...]
    onset_s: float
    size: float | None = None
    end_s: float | None = None


class Labelled(NamedTuple):
    """A flight and what is known of it. name: its path in the list. faults: in time order, none of a healthy flight. vehicle, baseline: as
    for `diagnose`. known: False where nobody says whether it is healthy. detector: another one to be run on it (`rivals`)."""

    name: str
    path: str
    faults: tuple[Fault, ...] = ()
    vehicle: str | None = None
    baseline: tuple[str, ...] = ()
    label_source: str = ""
    known: bool = True
    detector: str = ""


LIST = "labels.csv"  # of a folder


def read(path: str | os.PathLike) -> list[Labelled]:
    """The flights of a list. Raises ConfigError, one sentence, for a list or a row that is not as the module says."""
    files.no_address(path)
    if os.path.isdir(path) and not os.path.exists(os.path.join(path, LIST)):
        return _folder(Path(path))
    path = os.path.join(path, LIST) if os.path.isdir(path) else path
    try:
        if os.path.getsize(path) > MOST:
            raise ConfigError(f"{path} is too long for a list of flights.")
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file.") from None
    except (OSError, UnicodeDecodeError, ValueError):
        raise ConfigError(f"{path} is not a list of flights: give a CSV file with the columns {', '.join(COLUMNS)}.") from None
    apart = max(",;\t", key=text.partition("\n")[0].count)  # a spreadsheet where numbers have a comma puts ; between cells
    rows = csv.DictReader(io.StringIO(text, newline=""), restkey="", skipinitialspace=True, delimiter=apart)
    names = [(name or "").strip() for name in rows.fieldnames or ()]
    if "path" not in names:
        raise ConfigError(f"{path} is not a list of flights: it has no column path; known columns are {', '.join(COLUMNS)}.")
    if unknown := [name for name in names if name not in COLUMNS]:
        raise ConfigError(f"{path} has an unknown column {unknown[0]!r}; known columns are {', '.join(COLUMNS)}.")
    rows.fieldnames = names
    try:
        return labelled(_numbered(rows), str(path), Path(path).parent)
    except csv.Error as why:
        raise ConfigError(f"{path}: {why}.") from None


def _folder(folder: Path) -> list[Labelled]:
    """The logs below a folder, by their endings. Raises ConfigError where there is none."""
    names = logs.named()
    found = sorted(p for p in folder.rglob("*") if p.is_file() and names.search(p.name))
    if not found:
        raise ConfigError(f"{folder} holds neither {LIST} nor a flight log.")
    return [Labelled(p.relative_to(folder).as_posix(), str(p), known=False) for p in found]


def _numbered(rows: csv.DictReader) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """(name for a sentence, row) of every row that is not empty."""
    for row in rows:
        if any(isinstance(v, str) and v.strip() for v in row.values()):
            if rows.reader.dialect.delimiter != ",":
                row |= {key: row[key].replace(",", ".") for key in NUMBERS if row.get(key)}
            yield f"line {rows.line_num}", row


def labelled(rows: Iterable[tuple[str, Mapping[str, Any]]], name: str, folder: Path) -> list[Labelled]:
    """The flights of rows with some of COLUMNS as keys. name: of the list, for sentences; folder: that paths are relative to."""
    flights: dict[str, Labelled] = {}
    for place, row in rows:
        where = f"{name}, {place}"
        if "" in row:
            raise ConfigError(f"{where} has more cells than the first line.")
        cell = {key: str(row.get(key) if row.get(key) is not None else "").strip() for key in COLUMNS}
        if not cell["path"]:
            raise ConfigError(f"{where} has no path.")
        path = str(folder / cell["path"])
        fault = _fault(cell, where)
        new = Labelled(
            cell["path"], path, (fault,) if fault else (), str(folder / cell["vehicle"]) if cell["vehicle"] else None,
            tuple(str(folder / part.strip()) for part in cell["baseline"].split(";") if part.strip()), cell["label_source"],
        )  # fmt: skip
        if (old := flights.get(path)) is not None:
            new = _joined(old, new, where)
        flights[path] = new
    if not flights:
        raise ConfigError(f"{name} lists no flight.")
    return list(flights.values())


def _joined(old: Labelled, new: Labelled, where: str) -> Labelled:
    """A flight with one more fault."""
    if not old.faults or not new.faults:
        raise ConfigError(f"{where} names {new.path} again; only a flight with several faults has several rows.")
    if (new.vehicle, new.baseline) != (old.vehicle, old.baseline):
        raise ConfigError(f"{where}: {new.path} has another vehicle or baseline than in its row above.")
    faults = tuple(sorted(old.faults + new.faults, key=lambda f: f.onset_s))
    return old._replace(faults=faults)


def _fault(cell: Mapping[str, str], where: str) -> Fault | None:
    if not cell["rotor"]:
        if extra := next((key for key in NUMBERS if cell[key]), None):
            raise ConfigError(f"{where} has a value for {extra} but no rotor: name it, or leave both empty for a healthy flight.")
        return None
    rotors = re.split(r"\s*[+;]\s*|\s+", cell["rotor"])
    if not all(r.isascii() and r.isdigit() and 1 <= int(r) <= 32 for r in rotors):
        raise ConfigError(f"{where}: rotor {cell['rotor']!r}: give numbers from 1, with + between those of a pair.")
    if not cell["onset_s"]:
        raise ConfigError(f"{where} has no onset_s; give 0 where the rotor was weak from take-off.")
    onset = _number(cell, "onset_s", where)
    size = _number(cell, "size", where) if cell["size"] else None
    end = _number(cell, "end_s", where) if cell["end_s"] else None
    if size is not None and size > 1.0:
        raise ConfigError(f"{where}: size {cell['size']}: give the lost share of thrust, from 0 to 1.")
    if end is not None and end <= onset:
        raise ConfigError(f"{where}: end_s {cell['end_s']} is not after onset_s {cell['onset_s']}.")
    return Fault(tuple(sorted({int(r) for r in rotors})), onset, size, end)


def _number(cell: Mapping[str, str], key: str, where: str) -> float:
    try:
        value = float(cell[key])
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise ConfigError(f"{where}: {key} {cell[key]!r}: give a number, 0 or more.")
    return value
