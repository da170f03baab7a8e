"""Messages logged by the simulated autopilots (logged.toml): signals, rates and definitions; and records in order of time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rotorwatch.base import files

LOGGED, _ = files.toml(Path(__file__).with_suffix(".toml"), "table of messages")


def in_order(tables: Sequence[tuple[np.ndarray, np.ndarray]], single: Sequence[tuple[int, bytes]]) -> bytearray:
    """Records as they follow each other in a file: by their stamps; of equal ones those of an earlier table first, single ones last.

    tables: of each kind of record the stamps (m,) and the records (m,), an array whose items are their bytes. single: (stamp, bytes) of
    records that are one of their kind.
    """
    alone = [(np.array([stamp]), np.array([data], f"V{len(data)}")) for stamp, data in single]
    parts = [(stamps, records) for stamps, records in (*tables, *alone) if len(records)]
    if not parts:
        return bytearray()
    sizes = np.concatenate([np.full(len(records), records.dtype.itemsize) for _, records in parts])
    order = np.argsort(np.concatenate([stamps for stamps, _ in parts]), kind="stable")
    begins = np.empty(len(order), int)
    ends = np.cumsum(sizes[order])
    begins[order] = ends - sizes[order]
    whole, written = bytearray(int(ends[-1])), 0
    for _, records in parts:
        kind = np.dtype(f"V{records.dtype.itemsize}")
        # Places that overlap, one for each byte that a record may begin at.
        places = np.ndarray(len(whole) - kind.itemsize + 1, kind, buffer=whole, strides=(1,))
        places[begins[written : written + len(records)]] = records.view(kind)
        written += len(records)
    return whole
