"""Parquet files, opened only where they unpack to no more than a log may: their unpacked size is in the headers of their pages.

The file's footer is not enough: a page of some kB may declare 2 GB, and the reader allocates it.
https://parquet.apache.org/docs/file-format/data-pages/ and Thrift's compact protocol, in which the headers are encoded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rotorwatch.errors import LogError
from rotorwatch.logs import container

OWN, END = "rotorwatch.answers", 1 << 16  # a key in the files of `report/parquet_tables.py`, and the bytes at a file's end that hold it
DAMAGED = "this Parquet table is damaged or has non-numeric columns"
_UNPACKED, _PACKED = 2, 3  # fields of a page's head
_INTEGERS, _STRUCT = (4, 5, 6), 12
_DEEPEST = 10


class Damaged(ValueError):
    """A page's header is missing where one has to be."""


@contextmanager
def opened(data, check: Callable[[Sequence[str]], None] = lambda names: None):
    """The file in these bytes, as pyarrow's ParquetFile. check: called with the names of its columns before anything large is decoded.
    Raises LogError where it is damaged, then or while it is read, or unpacks to too much."""
    import pyarrow
    import pyarrow.parquet

    try:
        file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(memoryview(data)))
        check(file.schema_arrow.names)
        most = container.most(len(data))
        if unfolded(data, file.metadata, most) > most:
            raise container.too_much(most)
        yield file
    except (pyarrow.ArrowException, Damaged) as error:
        raise LogError(DAMAGED) from error


def is_answer(path: Path) -> bool:
    """True for a table of answers, which is no log."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - END, 0))
        return OWN.encode() in file.read(END)


def is_number(kind: Any) -> bool:
    """True for a column of that type, of pyarrow; texts and lists are of any length."""
    import pyarrow.types as types

    return any(of(kind) for of in (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null))


def unfolded(data, metadata, most: int) -> int:
    """Bytes of all pages and of all values as numbers of 8 bytes, whichever is more; counting ends beyond `most`. data: the whole file;
    metadata: pyarrow's of it. Raises Damaged."""
    values = pages = 0
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            values += max(column.num_values, 0)
            start = column.data_page_offset
            if column.has_dictionary_page and 0 < column.dictionary_page_offset < start:
                start = column.dictionary_page_offset
            end = start + column.total_compressed_size
            if not 0 < start <= end <= len(data):
                raise Damaged
            while start < end and max(pages, 8 * values) <= most:
                unpacked, packed, start = _head(data, start)
                pages, start = pages + unpacked, start + packed
    return max(pages, 8 * values)


def _head(data, at: int) -> tuple[int, int, int]:
    """(bytes of the page unpacked, bytes of it packed, the first of them)."""
    try:
        fields, at = _fields(data, at, 0)
        unpacked, packed = fields[_UNPACKED], fields[_PACKED]
    except (IndexError, KeyError):
        raise Damaged from None
    if unpacked < 0 or packed < 0:
        raise Damaged
    return unpacked, packed, at


def _fields(data, at: int, depth: int) -> tuple[dict[int, int], int]:
    """(number -> value of the whole numbers in the structure that begins here, byte after it)."""
    fields: dict[int, int] = {}
    number = 0
    if depth > _DEEPEST:
        raise Damaged
    while head := data[at]:
        kind, step = head & 15, head >> 4
        at += 1
        if step:
            number += step
        else:
            number, at = _integer(data, at)
        if kind in _INTEGERS:
            fields[number], at = _integer(data, at)
        else:
            at = _after(data, at, kind, depth)
    return fields, at + 1


def _integer(data, at: int) -> tuple[int, int]:
    """A zigzag-encoded integer, the lowest seven bits first."""
    value, at = _count(data, at)
    return (value >> 1) ^ -(value & 1), at


def _count(data, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
    raise Damaged


def _after(data, at: int, kind: int, depth: int) -> int:
    """The byte after a value that is no integer. Headers have booleans, texts and structures; anything else is damage."""
    if kind in (1, 2):  # true and false
        return at
    if kind == 8:
        size, at = _count(data, at)
        return at + size
    if kind == _STRUCT:
        return _fields(data, at, depth + 1)[1]
    raise Damaged
