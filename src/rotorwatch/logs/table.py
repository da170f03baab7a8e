"""CSV and Parquet tables in our own column names; docs/readers.md lists them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import container, log_memory, parquet_pages

FORMAT = "CSV or Parquet table"
COMMON_ENDINGS = (".csv", ".parquet")

_PARQUET = b"PAR1"
_NO_NUMBERS = "this Parquet table is damaged or has non-numeric columns"


def sniff(head: bytes, name: str) -> bool:
    """True for Parquet, for text whose first line has a column time_s, and for .csv and .parquet names."""
    if name:
        return name.lower().endswith(COMMON_ENDINGS)
    return head.startswith(_PARQUET) or "time_s" in log_memory.header(head)


def read(data, name: str, progress=None) -> Flight:
    """Read one table. Raises LogError naming what is unknown or missing, or when Parquet needs pyarrow installed."""
    notes: list[str] = []
    parquet = bytes(data[:4]) == _PARQUET
    columns = _parquet(data) if parquet else log_memory.numbers(data, notes)
    flight = log_memory.from_arrays(columns, name=name)
    return replace(flight, format="Parquet" if parquet else "CSV", warnings=(*notes, *flight.warnings))


def _parquet(data) -> dict[str, np.ndarray]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise LogError("Parquet needs pyarrow, which is not installed: pip install pyarrow") from None
    try:
        file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(memoryview(data)))
        log_memory.check_names(file.schema_arrow.names)  # before anything large is decoded
        most = container.most(len(data))
        if parquet_pages.unfolded(data, file.metadata, most) > most:
            raise container.too_much(most)
        if not all(_is_number(pyarrow.types, column.type) for column in file.schema_arrow):
            raise LogError(_NO_NUMBERS)
        # One after the other: a column is there twice while it is converted.
        return {n: file.read(columns=[n])[n].cast(pyarrow.float64()).to_numpy() for n in file.schema_arrow.names}
    except (pyarrow.ArrowException, parquet_pages.Damaged) as error:
        raise LogError(_NO_NUMBERS) from error


def _is_number(types, kind) -> bool:
    """Texts and lists are of any length."""
    return any(of(kind) for of in (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null))
