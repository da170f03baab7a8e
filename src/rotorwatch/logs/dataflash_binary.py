"""Binary DataFlash records to tables, without a Python step per record.

A binary log is a chain of records: bytes A3 95, a type number, then the fields named by that type's FMT record, packed
and little-endian. All header candidates are found at once; the chain "position + length = next position" is checked at
once; Python steps in only where it breaks: at header bytes inside a payload and at damaged places. Fields are gathered
through overlapping one-byte-stride views of the file, so only the wanted records are ever copied.
"""

from __future__ import annotations

import mmap
import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.logs.series import Impossible

HEADER = b"\xa3\x95"
SDLOG2 = re.compile(rb"\xa3\x95\x80..(ATTC|ATSP|OUT0)", re.DOTALL)  # definitions that only PX4 made
FMT_TYPE = 128
FMT_LENGTH = 89
MOST_FORMATS = 4096  # distinct definitions; a vehicle's log has about 250, and several logs may be joined
SPAN = 1 << 22  # bytes of the file processed, and held in memory, at a time
RARE = 0.01  # share of all records below which a type is rare
FOUND, CHAINED, SCANNED = 0.1, 0.2, 0.3  # progress when headers are found, chained and scanned

# Format character -> (numpy type, divisor); the characters of ArduPilot's Logger. `M` is a flight mode number.
_TYPES = "i1 u1 <i2 <u2 <i4 <u4 <i8 <u8 <f2 <f4 <f8 S4 S16 S64 u1 <i2 <u2 <i4 <u4 <i4".split()
_DIVISORS = {**dict.fromkeys("cCeE", 1e2), "L": 1e7}
CODES: dict[str, tuple[Any, float | None]] = {"a": (("<i2", (32,)), None)}
_NAME = re.compile(r"[A-Za-z0-9_]{1,4}")
CODES |= {code: (kind, _DIVISORS.get(code)) for code, kind in zip("bBhHiIqQgfdnNZMcCeEL", _TYPES, strict=True)}
_SIZES = {code: np.dtype(kind).itemsize for code, (kind, _) in CODES.items()}


@dataclass(frozen=True)
class Format:
    """The content of one FMT record: a type number's name, record length [bytes], field codes and column names."""

    type: int
    name: str
    length: int
    codes: str
    columns: tuple[str, ...]

    @cached_property
    def dtype(self) -> np.dtype:
        """The whole record with its header; `formats`/`offsets` leave the padding that a longer record has."""
        plain = [np.dtype(CODES[c][0]) for c in self.codes]
        offsets = 3 + np.cumsum([0] + [d.itemsize for d in plain])
        places = [int(o) for o in offsets[:-1]]
        return np.dtype({"names": list(self.columns), "formats": plain, "offsets": places, "itemsize": self.length})

    @property
    def stamp(self) -> str:
        """'TimeUS' or 'TimeMS' where the record starts with its boot time, else ''.

        Only the first field counts: the TimeMS further on in old GPS records is a time of week."""
        first = self.columns[0] if self.columns else ""
        return first if first in ("TimeUS", "TimeMS") and self.codes[0] in "QIqi" else ""


@lru_cache(maxsize=1024)  # logs of one folder have the same ones
def make_format(type_: int, length: int, name: str, codes: str, columns: str, check_length: bool = True) -> Format | None:
    """A Format from the fields of a FMT record, or None where they contradict each other (a damaged record)."""
    if not _NAME.fullmatch(name) or any(c not in CODES for c in codes):
        return None
    size = 3 + sum(_SIZES[c] for c in codes)
    names = [c.strip() for c in columns.split(",")] if columns else []
    if (check_length and not size <= length <= 255) or len(names) > len(codes) or not all(n.isascii() for n in names):
        return None
    names += [f"_{k}" for k in range(len(names), len(codes))]  # the 64 characters for names can run out
    if len(set(names)) != len(names) or "" in names:
        return None
    return Format(type_, name, length, codes, tuple(names))


@dataclass(frozen=True)
class Table:
    """All wanted records of one message name.

    record: (n,) running number in the file. columns: name -> (n,) values. codes: name -> format character."""

    name: str
    record: np.ndarray
    columns: dict[str, np.ndarray]
    codes: dict[str, str]

    def __len__(self):
        return self.record.size

    def __contains__(self, column: str) -> bool:
        return column in self.columns

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def numbers(self, wanted: Sequence[str]) -> Numbers | None:
        """These columns as one array; None without any of them."""
        values = np.full((len(self), len(wanted)), np.nan)
        for k, column in enumerate(wanted):
            if column in self and self[column].ndim == 1 and self[column].dtype.kind in "iuf":
                values[:, k] = self[column]
        return Numbers(self.record, values, self.codes) if any(c in self for c in wanted) else None


class Numbers(NamedTuple):
    """Wanted columns of n records. values: (n, columns), NaN where the log has no such numbers; record, codes as of `Table`."""

    record: np.ndarray
    values: np.ndarray
    codes: dict[str, str]


class BinaryLog:
    """The records of a binary DataFlash log.

    data: anything with the buffer protocol. progress: called with the share done (0..1).
    counts: records per message name. warnings: sentences on damage. record_count: intact records."""

    preamble: tuple[str, ...] = ()  # only text logs have one

    def __init__(self, data, progress: Callable[[float], None] | None = None):
        self._data, self._bytes = data, np.frombuffer(data, np.uint8)
        # There is a record in every 50 bytes or so: the width of positions decides how much memory is used.
        self._index = np.int32 if self._bytes.size < 2**31 - 1024 else np.int64
        self.warnings: list[str] = []
        candidates, types = self._header_candidates(progress)
        self._formats = self._read_formats(candidates[types == FMT_TYPE])
        lengths = self._record_lengths(candidates, types)
        known = lengths > 0
        candidates, types, lengths = candidates[known], types[known], lengths[known]
        lengths += candidates
        keep = self._chain(candidates, lengths)
        if progress:
            progress(CHAINED)
        del lengths
        self._at = candidates[keep]
        # The chain shows which FMT headers belong to records; the others were payload.
        bad_at = np.array(self._bad_formats, self._index)
        place = np.searchsorted(self._at, bad_at)
        if bad := int((self._at[place[place < self._at.size]] == bad_at[place < self._at.size]).sum()):
            self.warnings.append(f"{amount(bad, 'damaged message definition')} (FMT) ignored.")
        self._types = types[keep]
        self.record_count = self._at.size
        self._progress, self._read = progress, 0  # bytes of records
        # Records of rare types are listed here; those of the few others are searched for when read.
        self._count = np.bincount(self._types, minlength=256)
        rare = np.flatnonzero((self._count <= RARE * self.record_count)[self._types])
        self._rare = rare[np.argsort(self._types[rare], kind="stable")].astype(self._index)

    # -- finding records -------------------------------------------------------------------------------------------

    def _header_candidates(self, progress) -> tuple[np.ndarray, np.ndarray]:
        """Positions of A3 95 with a type byte after it, and that byte; some lie inside payloads."""
        positions, types = [np.zeros(0, self._index)], [np.zeros(0, np.uint8)]
        end = self._bytes.size - 2
        for start in range(0, max(end, 0), SPAN):
            at = np.flatnonzero(self._bytes[start : min(start + SPAN, end)] == HEADER[0]) + start
            at = at[self._bytes[at + 1] == HEADER[1]].astype(self._index)
            positions.append(at)
            types.append(self._bytes[at + 2])
            self._release()
            if progress:
                progress(FOUND * min(1.0, (start + SPAN) / end))
        return np.concatenate(positions), np.concatenate(types)

    def _read_formats(self, positions: np.ndarray) -> dict[int, list[tuple[int, Format]]]:
        """Type number -> [(position from which it holds, Format)]; more than one where a log redefines a type."""
        fmt = Format(FMT_TYPE, "FMT", FMT_LENGTH, "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))
        formats = {FMT_TYPE: [(0, fmt)]}
        known: dict[bytes, Format | None] = {}
        self._bad_formats: list[int] = []
        for at in positions.tolist():
            row = self._bytes[at + 3 : at + FMT_LENGTH].tobytes()
            if len(row) < FMT_LENGTH - 3:
                continue
            if row not in known:
                name, codes, columns = (_text(row[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
                known[row] = make_format(row[0], row[1], name, codes, columns)
            new = known[row]
            if new is None or (new.type == FMT_TYPE and new != fmt):
                self._bad_formats.append(at)
                continue
            versions = formats.setdefault(new.type, [])
            if not versions:
                versions.append((0, new))
            elif versions[-1][1] != new:
                versions.append((at, new))
        if sum(new is not None for new in known.values()) > MOST_FORMATS:
            raise LogError(f"this log defines more than {MOST_FORMATS} kinds of messages, which no flight log does")
        return formats

    def _record_lengths(self, positions: np.ndarray, types: np.ndarray) -> np.ndarray:
        """Declared length of each candidate, 0 for unknown types."""
        table = np.zeros(256, self._index)
        for type_, versions in self._formats.items():
            table[type_] = versions[0][1].length
        lengths = table[types]
        for type_, versions in self._formats.items():
            if len(versions) > 1:
                since, length = np.array([(since, version.length) for since, version in versions], self._index).T
                of_type = np.flatnonzero(types == type_)
                lengths[of_type] = length[np.searchsorted(since, positions[of_type], "right") - 1]
        return lengths

    def _chain(self, at: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Mask of the candidates that are records: each starts where the one before it ends.

        Where the chain breaks, candidates inside the record before are payload, if a header follows that record. Otherwise something is
        damaged: the record before stays only if the following bytes look like half a header, and the chain resumes at the next candidate
        that is itself followed by a header (or overlaps none that is)."""
        size, n = self._bytes.size, at.size
        keep = end <= size
        if n == 0:
            self._note_damage(0, 0, 0, size)
            return keep
        starts, ends = at.data, end.data
        tail = size - _zero_tail(self._bytes)

        def confirmed(k: int) -> bool:
            """Is candidate k followed by a header, the end or the empty tail of the file?"""
            stop = ends[k]
            if stop == size or tail <= stop < size:
                return True
            j = bisect_left(starts, stop, k + 1, n)
            return j < n and starts[j] == stop

        def first_confirmed(k: int) -> int:
            """From k on: the first candidate to trust after a damaged place."""
            while k < n and not confirmed(k):
                inner = k + 1
                while inner < n and starts[inner] < ends[k] and not confirmed(inner):
                    inner += 1
                if inner == n or starts[inner] >= ends[k]:
                    return k
                k = inner
            return k

        unknown = 0
        damages = int(starts[0] > 0)
        cursor = first_confirmed(0) if damages else 0
        keep[:cursor] = False
        broken = np.flatnonzero(np.append(end[:-1] != at[1:], True))
        for b in broken.data:
            if b < cursor:
                continue
            stop = ends[b]
            following = bisect_left(starts, stop, b + 1, n)
            if following < n and starts[following] == stop:  # header bytes inside b's payload
                keep[b + 1 : following] = False
                cursor = following
                continue
            if stop >= tail:  # b ends the log, whole or cut; headers inside it are payload unless a chain starts there
                inner = b + 1
                while stop > size and inner < n and not confirmed(inner):
                    inner += 1
                cursor = inner if stop > size else n
                keep[b + 1 : cursor] = False
                continue
            damages += 1
            inner = b + 1
            while inner < following and not confirmed(inner):
                inner += 1
            lead = bytes(self._bytes[stop : stop + 2])
            unknown += lead == HEADER
            if inner < following or (lead[:1] != HEADER[:1] and lead[1:] != HEADER[1:]):
                keep[b] = False  # it overlaps a record, or has a wrong length: its type byte is damaged
            cursor = inner if inner < following else first_confirmed(following)
            keep[b + 1 : cursor] = False
        used = int((end[keep] - at[keep]).sum())
        self._note_damage(damages, unknown, used, tail)
        return keep

    def _note_damage(self, damages: int, unknown: int, used: int, tail: int) -> None:
        size = self._bytes.size
        if size - tail >= 256:
            self.warnings.append(f"The last {size - tail} bytes of the file are empty; they were ignored.")
        # With no damage, all that is left over before the empty tail is the start of a record that was never finished.
        # (Its last fields may be zeros of the record itself, hence no count of bytes.)
        if damages:
            lost = max(size - used - (size - tail), 0)
            text = f"The log is damaged in {amount(damages, 'place')}; {lost} bytes were skipped."
            self.warnings.append(Impossible(damages, text))
        elif tail - used > 2:
            self.warnings.append("The log ends inside a record; the incomplete record was dropped.")
        if unknown:
            self.warnings.append(f"{amount(unknown, 'record')} of unknown type skipped.")

    def _release(self) -> None:
        """Release the processed pages of a mapped file from memory; they are loaded again on access."""
        if isinstance(self._data, mmap.mmap) and hasattr(self._data, "madvise"):
            self._data.madvise(mmap.MADV_DONTNEED)

    # -- reading columns -------------------------------------------------------------------------------------------

    @cached_property
    def counts(self) -> dict[str, int]:
        """Records per message name."""
        counts: dict[str, int] = {}
        for type_, versions in self._formats.items():
            if len(versions) == 1:
                sizes = [(versions[0][1], int(self._count[type_]))]
            else:
                sizes = [(fmt, records.size) for _, fmt, records in self._versions_of(type_)]
            for fmt, size in sizes:
                if size:
                    counts[fmt.name] = counts.get(fmt.name, 0) + size
        return counts

    def _versions(self, name: str | None = None) -> list[tuple[int, Format, np.ndarray]]:
        """(type, Format, record numbers in order) for each definition of `name` (all names if None)."""
        wanted = self._formats if name is None else self._named.get(name, ())
        versions = [each for type_ in wanted for each in self._versions_of(type_)]
        return [each for each in versions if name in (None, each[1].name)]

    @cached_property
    def _named(self) -> dict[str, list[int]]:
        """Name -> types that are ever called so."""
        named: dict[str, list[int]] = {}
        for type_, versions in self._formats.items():
            for name in dict.fromkeys(fmt.name for _, fmt in versions):
                named.setdefault(name, []).append(type_)
        return named

    def _versions_of(self, type_: int) -> list[tuple[int, Format, np.ndarray]]:
        """The versions of one type, which may be redefined any number of times; identical definitions are merged."""
        versions, records = self._formats[type_], self._records(type_)
        limits = np.searchsorted(self._at[records], [since for since, _ in versions[1:]]) if versions[1:] else []
        pieces: dict[Format, list[np.ndarray]] = {}
        for (_, fmt), piece in zip(versions, np.split(records, limits), strict=True):
            pieces.setdefault(fmt, []).append(piece)
        return [(type_, fmt, np.concatenate(p) if p[1:] else p[0]) for fmt, p in pieces.items()]

    def _records(self, type_: int) -> np.ndarray:
        """Numbers of the records of a type, in order."""
        if self._count[type_] > RARE * self.record_count:
            return np.flatnonzero(self._types == type_).astype(self._index)
        start, stop = np.searchsorted(self._types[self._rare], [type_, type_ + 1])
        return self._rare[start:stop]

    def _items(self, at: np.ndarray, dtype: np.dtype) -> Iterator[tuple[slice, np.ndarray]]:
        """(which, `dtype` items there) of places in the file, in order, in blocks of SPAN bytes: never all bytes at once, and the memory of
        a block is released before the next."""
        view = np.ndarray((max(self._bytes.size - dtype.itemsize + 1, 0),), f"V{dtype.itemsize}", buffer=self._bytes, strides=(1,))
        start = 0
        while start < at.size:
            some = at[start : start + SPAN // 3]
            end = some.dtype.type(min(int(some[0]) + SPAN, np.iinfo(some.dtype).max))
            some = some[: int(np.searchsorted(some, end))]
            yield slice(start, start + some.size), view[some].view(dtype)
            self._release()
            start += some.size
            self._read += some.size * dtype.itemsize
            if self._progress:
                self._progress(SCANNED + (1.0 - SCANNED) * min(1.0, self._read / self._bytes.size))

    @cached_property
    def _stamped(self) -> tuple[dict, np.ndarray, dict]:
        """Time stamps of records: (type of the number, factor to us) -> an index from 1; that index for each type, 0 for none; and for
        types whose definitions differ in it, (places from which they hold, that index)."""
        kinds: dict[tuple[np.dtype, float], int] = {}
        first, changes = np.zeros(256, np.uint8), {}
        for type_, versions in self._formats.items():
            stamps = [
                kinds.setdefault((fmt.dtype[fmt.stamp], 1.0 if fmt.stamp == "TimeUS" else 1e3), len(kinds) + 1) if fmt.stamp else 0
                for _, fmt in versions
            ]
            first[type_] = stamps[0]
            if len(set(stamps)) > 1:
                changes[type_] = np.array([since for since, _ in versions]), np.array(stamps, np.uint8)
        return kinds, first, changes

    def stamps(self, records: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Boot time in us of these records, by default all, NaN for those that carry none."""
        kinds, first, changes = self._stamped
        types, at = self._types[records], self._at[records]
        kind, times = first[types], np.full(types.size, np.nan)
        for type_, (since, places) in changes.items():
            rows = np.flatnonzero(types == type_)
            kind[rows] = places[np.searchsorted(since, at[rows], "right") - 1]
        for (dtype, factor), number in kinds.items():
            rows = np.flatnonzero(kind == number)
            for part, stamps in self._items(at[rows] + 3, dtype):
                times[rows[part]] = stamps * factor
        return times

    def spans(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """First byte, byte after the last, bytes of the time stamp (0: none), and whether it is a definition (FMT), of every record."""
        length, stamp = np.zeros(self.record_count, np.int64), np.zeros(self.record_count, np.int64)
        definition = np.zeros(self.record_count, bool)
        for type_, fmt, records in self._versions():
            length[records], definition[records] = fmt.length, type_ == FMT_TYPE
            stamp[records] = fmt.dtype[fmt.stamp].itemsize if fmt.stamp else 0
        start = self._at.astype(np.int64)
        return start, start + length, stamp, definition

    def columns(self, name: str) -> tuple[str, ...]:
        """Column names of message `name` over all its definitions; empty when the log has no such records."""
        return tuple(dict.fromkeys(c for _, f, records in self._versions(name) if records.size for c in f.columns))

    def table(self, name: str, wanted: Iterable[str] | None = None, where: tuple[str, int] | None = None) -> Table | None:
        """Columns of all records called `name`, scaled as their format characters say; None when there are none.

        wanted: columns to read, those the log lacks are left out (None: all). where: (column, value) keeps only the
        records of one sensor instance. Numbers keep their type unless scaled; text is bytes without trailing zeros."""
        parts = []
        for fmt, records in self._chosen(name, where):
            names = fmt.columns if wanted is None else [c for c in wanted if c in fmt.columns]
            columns: dict[str, np.ndarray] = {}
            for part, rows in self._items(self._at[records], fmt.dtype):
                for column in names:
                    some = _scaled(rows[column], fmt.codes[fmt.columns.index(column)])
                    if not part.start:
                        columns[column] = np.empty((records.size, *some.shape[1:]), some.dtype)
                    columns[column][part] = some
            parts.append((fmt, records, columns))
        if not parts:
            return None
        if len(parts) == 1:
            fmt, records, columns = parts[0]
            return Table(name, records, columns, dict(zip(fmt.columns, fmt.codes, strict=True)))
        # A redefined message: only the columns that all its definitions share, back in file order.
        shared = [c for c in parts[0][2] if all(c in p[2] for p in parts)]
        records = np.concatenate([p[1] for p in parts])
        order = np.argsort(records)
        merged = {c: np.concatenate([p[2][c] for p in parts])[order] for c in shared}
        return Table(name, records[order], merged, dict(zip(parts[0][0].columns, parts[0][0].codes, strict=True)))

    def numbers(self, name: str, wanted: Sequence[str], where: tuple[str, int] | None = None) -> Numbers | None:
        """`table` with numeric columns as one array, which is all that is kept."""
        chosen = self._chosen(name, where)
        if len(chosen) != 1 or not any(c in chosen[0][0].columns for c in wanted):
            table = self.table(name, wanted, where)
            return None if table is None else table.numbers(wanted)
        (fmt, records), codes = chosen[0], dict(zip(*(chosen[0][0].columns, chosen[0][0].codes), strict=True))
        values = np.full((records.size, len(wanted)), np.nan)
        held = [(k, c) for k, c in enumerate(wanted) if c in codes and not fmt.dtype[c].shape and fmt.dtype[c].kind in "iuf"]
        for part, rows in self._items(self._at[records], fmt.dtype):
            for k, column in held:
                values[part, k] = _scaled(rows[column], codes[column])
        return Numbers(records, values, codes)

    def _chosen(self, name: str, where: tuple[str, int] | None) -> list[tuple[Format, np.ndarray]]:
        """(Format, record numbers) of the records called `name`, `where` as of `table`; a definition that has none is left out."""
        chosen = []
        for _, fmt, records in self._versions(name):
            if where and where[0] in fmt.columns:
                field, offset = fmt.dtype.fields[where[0]][:2]  # type: ignore[index]
                if field.kind in "iuf":
                    blocks = self._items(self._at[records] + offset, field)
                    records = np.concatenate([records[:0], *(records[part][x == where[1]] for part, x in blocks)])
            if records.size:
                chosen.append((fmt, records))
        return chosen


def amount(number: int, noun: str) -> str:
    """'1 record', '2 records'."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _scaled(values: np.ndarray, code: str) -> np.ndarray:
    divisor = CODES[code][1]
    return values if divisor is None else values / divisor


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("latin-1")


def _zero_tail(data: np.ndarray) -> int:
    """Number of zero bytes at the end of the file."""
    stop, step = data.size, 256
    while stop > 0:
        start, step = max(stop - step, 0), min(16 * step, SPAN)
        used = np.flatnonzero(data[start:stop])
        if used.size:
            return int(data.size - (start + used[-1] + 1))
        stop = start
    return int(data.size)
