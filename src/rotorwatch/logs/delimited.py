"""Comma-separated numbers -> named float columns. Shared by the readers of tables."""

from __future__ import annotations

import csv
import io
import re

import numpy as np

from rotorwatch.errors import LogError

_EMPTY = re.compile(rb"(?:(?<=,)(?=[,\r\n])|(?<=\n)(?=,)|(?<=,)\Z)")
_MOST_COLUMNS = 2000


def header(head: bytes) -> list[str]:
    """Column names in the first line of a text table; [] when it is no such table."""
    line = bytes(head).partition(b"\n")[0]
    try:
        text = line.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        return []
    if not text.isprintable() or "," not in text:
        return []
    return [c.strip().strip('"') for c in text.split(",")]


def numbers(data, notes, name="") -> dict[str, np.ndarray]:
    """Columns of a text table by name. Empty cells and what is no number become NaN; notes says how many lines it hit.

    Raises LogError without a header line, with doubled names, or without any line of numbers.
    """
    data = bytes(data).rstrip(b"\0")
    names = header(data[: 1 << 16])
    where = f"{name}: " if name else ""
    if not names or len(names) > _MOST_COLUMNS:
        raise LogError(f"{where}the first line is no list of column names separated by commas")
    if len(set(names)) < len(names):
        raise LogError(f"{where}column {next(n for n in names if names.count(n) > 1)} is there twice")
    body = data.partition(b"\n")[2]
    if not body.strip():
        raise LogError(f"{where}the table has no line of numbers")
    try:
        filled = io.BytesIO(_EMPTY.sub(b"nan", body))
        rows = np.loadtxt(filled, delimiter=",", ndmin=2, comments=None, encoding="ascii")
        if rows.shape[1] != len(names):
            raise ValueError
    except ValueError:
        rows = _line_by_line(body, len(names), notes, where)
    if not rows.size:
        raise LogError(f"{where}the table has no line of numbers")
    return {n: rows[:, i] for i, n in enumerate(names)}


def _line_by_line(body: bytes, width: int, notes, where: str) -> np.ndarray:
    """Slower than loadtxt, but takes damage: a wrong number of cells drops the line, a wrong cell becomes NaN."""
    rows, dropped, cells = [], 0, 0
    lines = io.StringIO(body.decode("utf-8", "replace").replace("\0", ""), newline="")
    for line in csv.reader(lines):
        if not line:
            continue
        if len(line) != width:
            dropped += 1
            continue
        row = []
        for cell in line:
            try:
                row.append(float(cell) if cell else np.nan)
            except ValueError:
                row.append(np.nan)
                cells += 1
        rows.append(row)
    if dropped:
        notes.append(f"{where}{dropped} line{'s' if dropped > 1 else ''} with a wrong number of cells dropped")
    if cells:
        notes.append(f"{where}{cells} cell{'s' if cells > 1 else ''} without a number ignored")
    return np.array(rows, float).reshape(-1, width)
