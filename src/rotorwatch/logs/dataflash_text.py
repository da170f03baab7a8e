"""The text form of DataFlash logs (`.log`), as ground stations write it: one record a line, fields already scaled.

    FMT, 131, 43, IMU, IffffffIIf, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,ErrG,ErrA,Temp
    IMU, 12046, 0.0009, 0.0005, -0.0004, -0.07, -0.63, -9.55, 0, 0, 25.5

It offers the same tables as `dataflash_binary.BinaryLog`.
"""

from __future__ import annotations

import json
import re
from array import array
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from rotorwatch.logs.dataflash_binary import Format, Numbers, Table, amount, make_format

TEXT_CODES = "nNZ"
FIRST_LINE = re.compile(rb"^[ \t]*FMT[ \t]*,[ \t]*128[ \t]*,[ \t]*89[ \t]*,", re.MULTILINE)

# Names of numbers: Copter's flight modes, which ground stations write into text logs; AP_Logger's events (EV.Id) and
# error sources (ERR.Subsys) relevant here; reasons of disarming (ARM.Method, AP_Arming::Method).
MODES, EVENTS, ERRORS, METHODS = (
    {int(number): name for number, name in table.items()}
    for table in json.loads(Path(__file__).with_name("dataflash_numbers.json").read_text("utf-8")).values()
)
PREAMBLE = 20  # lines
MODE_NUMBERS = {name.replace("_", ""): float(number) for number, name in MODES.items()}


class TextLog:
    """The records of a text DataFlash log; see `dataflash_binary.BinaryLog` for the members."""

    def __init__(self, data, progress: Callable[[float], None] | None = None):
        self._data = data = bytes(data)
        self._formats: dict[str, Format] = {}
        self._starts: dict[str, array] = {}  # of each record's fields, after the name
        self._records: dict[str, array] = {}
        self.warnings: list[str] = []
        self.preamble: list[str] = []  # lines of the ground station before the first record: the firmware's name
        self.record_count = 0
        bad = lines = 0
        start, size = 0, len(data)
        while start < size:
            end = data.find(b"\n", start)
            end = size if end < 0 else end
            comma = data.find(b",", start, end)
            name = data[start:comma].strip().decode("latin-1") if comma >= 0 else ""
            at, start = start, end + 1
            lines += 1
            if progress and not lines & 0x3FFFF:
                progress(0.5 * start / size)
            if name == "FMT":
                fmt = _parse_format(data[comma + 1 : end])
                if fmt is None:
                    bad += 1
                    continue
                self._formats[fmt.name] = fmt
            elif name not in self._formats:
                # Ground stations write a few lines first; later ones are damage.
                bad += comma >= 0 and bool(self._formats)
                if not self._formats and len(self.preamble) < PREAMBLE:
                    self.preamble.append(data[at:end].decode("latin-1").strip())
                continue
            self._starts.setdefault(name, array("q")).append(comma + 1)
            self._records.setdefault(name, array("q")).append(self.record_count)
            self.record_count += 1
        self._progress, self._read = progress, 0  # records
        if bad:
            self.warnings.append(f"{amount(bad, 'line')} damaged or of unknown type skipped.")

    def _fields(self, name: str):
        """The text after the name of each record called `name`."""
        for start in self._starts.get(name, ()):
            end = self._data.find(b"\n", start)
            yield self._data[start : end if end >= 0 else len(self._data)]

    @property
    def counts(self) -> dict[str, int]:
        """Records per message name."""
        return {name: len(starts) for name, starts in self._starts.items()}

    def columns(self, name: str) -> tuple[str, ...]:
        """Column names of message `name`; empty when the log has no such records."""
        return self._formats[name].columns if name in self._formats and self._starts.get(name) else ()

    def stamps(self, records: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Boot time in us of these records, by default all, NaN for those that carry none."""
        return self._stamps[records]

    @cached_property
    def _stamps(self) -> np.ndarray:
        times = np.full(self.record_count, np.nan)
        for name in self._starts:
            fmt = self._formats.get(name)
            if name != "FMT" and fmt is not None and fmt.stamp:
                raw = np.array([_number(line.partition(b",")[0]) for line in self._fields(name)])
                times[self._records[name]] = raw if fmt.stamp == "TimeUS" else raw * 1e3
        times[~np.isfinite(times)] = np.nan
        return times

    def numbers(self, name: str, wanted: Sequence[str], where: tuple[str, int] | None = None) -> Numbers | None:
        """`table` with numeric columns as one array."""
        table = self.table(name, wanted, where)
        return None if table is None else table.numbers(wanted)

    def table(self, name: str, wanted: Iterable[str] | None = None, where: tuple[str, int] | None = None) -> Table | None:
        """Columns of all records called `name`; None when there are none. See `BinaryLog.table`.

        Numbers are float64, NaN where a field is missing or not a number."""
        fmt = self._formats.get(name)
        if fmt is None or not self._starts.get(name):
            return None
        width = len(fmt.columns)
        rows = [line.split(b",", width - 1) for line in self._fields(name)]  # the last field may hold commas: a text
        records = np.array(self._records[name])
        self._read += records.size
        if self._progress:
            self._progress(0.5 + 0.5 * min(1.0, self._read / self.record_count))
        if where and where[0] in fmt.columns:
            k = fmt.columns.index(where[0])
            chosen = [len(row) > k and _number(row[k]) == where[1] for row in rows]
            rows = [row for row, take in zip(rows, chosen, strict=True) if take]
            records = records[chosen]
        if not rows:
            return None
        columns: dict[str, np.ndarray] = {}
        for column in fmt.columns if wanted is None else wanted:
            if column not in fmt.columns:
                continue
            k = fmt.columns.index(column)
            cells = [row[k].strip() if k < len(row) else b"" for row in rows]
            if fmt.codes[k] in TEXT_CODES:
                columns[column] = np.array(cells, dtype="S64")
            else:
                columns[column] = np.array([_number(cell) for cell in cells], float)
        return Table(name, records, columns, dict(zip(fmt.columns, fmt.codes, strict=True)))


def _parse_format(rest: bytes) -> Format | None:
    cells = [cell.strip() for cell in rest.decode("latin-1").split(",", 4)]
    if len(cells) < 5 or not (cells[0].isdigit() and cells[1].isdigit()):
        return None
    columns = ",".join(c.strip() for c in cells[4].split(","))
    # Lengths in text logs are not used, and some writers get them wrong.
    return make_format(int(cells[0]), int(cells[1]), cells[2], cells[3], columns, check_length=False)


def _number(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return MODE_NUMBERS.get(cell.strip().decode("latin-1").upper().replace("_", ""), np.nan)
