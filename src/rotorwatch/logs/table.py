"""CSV and Parquet tables in our own column names; docs/readers.md lists them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import log_memory, parquet_pages

FORMAT = "CSV or Parquet table"
COMMON_ENDINGS = (".csv", ".parquet")

_PARQUET = b"PAR1"


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
    with parquet_pages.opened(data, log_memory.check_names) as file:
        if not all(parquet_pages.is_number(column.type) for column in file.schema_arrow):
            raise LogError(parquet_pages.DAMAGED)
        # One after the other: a column is there twice while it is converted.
        return {n: file.read(columns=[n])[n].cast("double").to_numpy() for n in file.schema_arrow.names}
