"""Answers as Parquet: flights, ticks, losses and events of any number of logs in four files of one schema, for DuckDB, pandas and Polars.

docs/parquet.md describes the columns. `log` is the key of all four: the log's full path, or its address.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.base import files, optional
from rotorwatch.flight.diagnosis import EVENT, Diagnosis, Trace
from rotorwatch.logs.parquet_pages import OWN

ROWS = 100_000  # of a table that are written at once

_AXES = ("roll", "pitch", "yaw")
# Columns of a tick that are parts of an array of the trace: name of the array -> their names.
_PARTS = {
    "residual": [f"residual_{axis}" for axis in (*_AXES, "thrust")],
    "residual_sd": [f"residual_sd_{axis}" for axis in (*_AXES, "thrust")],
    "attitude": [f"{axis}_deg" for axis in _AXES],
    "wanted": [f"wanted_{axis}_deg" for axis in _AXES],
    "rates": [f"{axis}_rate_deg_s" for axis in _AXES],
    "rates_wanted": [f"wanted_{axis}_rate_deg_s" for axis in _AXES],
    "position": ["north_m", "east_m", "down_m"],
    "ground_speed": ["ground_speed_m_s"],
    "battery": ["voltage_V", "current_A"],
    "vibration": [f"vibration_{axis}_m_s2" for axis in "xyz"],
}
# Table -> column -> its type, as pyarrow names it; [] for a list.
SCHEMAS: dict[str, dict[str, str]] = {
    "flights": {
        **dict.fromkeys("log name verdict headline reason autopilot firmware frame utc_start estimator error".split(), "string"),
        **dict.fromkeys("duration_s airborne_s".split(), "double"),
        **{"rotors": "int32", "main_event": "int32", "rotor_status": "string[]"},
        **dict.fromkeys("rotor_loss rotor_loss_low rotor_loss_high".split(), "float[]"),
    },
    "ticks": {
        **{"log": "string", "time_s": "double", "assessed": "bool"},
        **{name: "float" for names in _PARTS.values() for name in names},
    },
    "losses": {
        **{"log": "string", "time_s": "double", "rotor": "int32"},
        **dict.fromkeys("loss loss_low loss_high command evidence".split(), "float"),
    },
    "events": {
        **{"log": "string", "event": "int32", "kind": "string", "rotors": "int32[]", "alternatives": "int32[][]"},
        **dict.fromkeys("onset_s detected_s end_s".split(), "double"),
        **{"loss": "float[]", "loss_low": "float[]", "loss_high": "float[]", "probability": "double", "reason": "string", "more": "string"},
    },
}  # fmt: skip


def library() -> Any:
    """pyarrow. Raises ConfigError where it is missing."""
    return optional.library("pyarrow", "A Parquet file")


def schema(table: str) -> Any:
    """pyarrow's schema of a table."""
    pa = library()

    def kind(name: str) -> Any:
        return pa.list_(kind(name.removesuffix("[]"))) if name.endswith("[]") else pa.type_for_alias(name)

    return pa.schema({name: kind(of) for name, of in SCHEMAS[table].items()}, {OWN: "1"})


def tables(diagnosis: Diagnosis, log: str) -> dict[str, Any]:
    """Table -> pyarrow's Table of one diagnosis. log: its key. Without a trace there are no ticks and no losses."""
    answer = diagnosis.to_dict()
    flight, rotors = answer["flight"], answer["rotors"]
    lost = {"rotor_loss": [r["loss"] for r in rotors], "rotor_status": [r["status"] for r in rotors]}
    lost |= {f"rotor_{name}": values for name, values in _bounds([r["interval"] for r in rotors]).items()}
    air = sum(end - start for start, end in flight.get("hops") or ())
    row = {**flight, **answer, **lost, "log": log, "name": flight.get("name"), "airborne_s": air, "rotors": len(rotors)}
    found = {"flights": _rows("flights", [row]), "events": _rows("events", [_event(k, e, log) for k, e in enumerate(answer["events"])])}
    if diagnosis.trace is not None:
        found |= {"ticks": _ticks(diagnosis.trace, log), "losses": _losses(diagnosis.trace, log)}
    return found


def failed(log: str, sentence: str) -> dict[str, Any]:
    """The tables of a log without an answer: its row of flights."""
    return {"flights": _rows("flights", [{"log": log, "name": log.rpartition("/")[2], "error": sentence}])}


def _bounds(intervals: list) -> dict[str, list]:
    return {"loss_low": [low for low, _ in intervals], "loss_high": [high for _, high in intervals]}


def _rows(table: str, rows: list[Mapping[str, Any]]) -> Any:
    return library().Table.from_pylist([{name: row.get(name) for name in SCHEMAS[table]} for row in rows], schema(table))


def _event(number: int, event: Mapping[str, Any], log: str) -> dict[str, Any]:
    more = {name: value for name, value in event.items() if name not in EVENT}
    return {**event, **_bounds(event["interval"]), "log": log, "event": number, "more": json.dumps(more) if more else None}


def _columns(table: str, columns: Mapping[str, Any], count: int) -> Any:
    """The table of these columns; numbers that are not finite, and columns that are not there, are null."""
    pa, of = library(), schema(table)
    arrays = []
    for field in of:
        values = columns.get(field.name)
        if values is None:
            arrays.append(pa.nulls(count, field.type))
        elif isinstance(values, str):
            arrays.append(pa.array([values], field.type).take(pa.array(np.zeros(count, np.int64))))
        else:
            values = np.asarray(values)
            mask = ~np.isfinite(values) if values.dtype.kind == "f" else None
            arrays.append(pa.array(values, field.type, mask=mask))
    return pa.Table.from_arrays(arrays, schema=of)


def _ticks(trace: Trace, log: str) -> Any:
    time = trace.time
    assessed = np.zeros(time.size, bool)
    for start, end in trace.airborne:
        assessed |= (time >= start) & (time <= end)
    for start, end, _ in trace.blind:
        assessed &= ~((time >= start) & (time < end))
    columns: dict[str, Any] = {"log": log, "time_s": time, "assessed": assessed}
    for name, parts in _PARTS.items():
        values = getattr(trace, name)
        if values is not None:
            columns |= dict(zip(parts, values.reshape(time.size, -1).T))
    return _columns("ticks", columns, time.size)


def _losses(trace: Trace, log: str) -> Any:
    """A row for each tick and rotor, rotor by rotor."""
    ticks, rotors = trace.loss.shape
    nothing = np.full(ticks, np.nan)
    columns = {
        "log": log,
        "time_s": np.tile(trace.time, rotors),
        "rotor": np.repeat(np.arange(1, rotors + 1), ticks),
        **{"loss": trace.loss.T.ravel(), "loss_low": trace.lower.T.ravel(), "loss_high": trace.upper.T.ravel()},
        "command": trace.command.T.ravel(),
        "evidence": np.concatenate([trace.evidence.get(f"rotor {k + 1}", nothing) for k in range(rotors)] or [nothing]),
    }  # fmt: skip
    return _columns("losses", columns, ticks * rotors)


class Writer:
    """FOLDER/flights.parquet, ticks.parquet, losses.parquet and events.parquet, which appear when it is closed."""

    def __init__(self, folder: str | os.PathLike, what: str = "--parquet"):
        """what: the option, for errors. Raises ConfigError where files cannot be written there, or pyarrow is missing."""
        pq = optional.library("pyarrow.parquet", "A Parquet file")
        self.folder = files.folder(folder, what)
        self._stack, self._files = ExitStack(), {}
        self._waiting: dict[str, list[Any]] = {table: [] for table in SCHEMAS}
        for table in SCHEMAS:
            hidden = self._stack.enter_context(files.replacing(self.folder / f"{table}.parquet"))
            self._files[table] = self._stack.enter_context(pq.ParquetWriter(hidden, schema(table), compression="zstd"))

    @property
    def paths(self) -> list[Path]:
        """The files, complete once it is closed."""
        return [self.folder / f"{table}.parquet" for table in SCHEMAS]

    def add(self, found: Mapping[str, Any]) -> None:
        """Add the tables of a log."""
        for name, table in found.items():
            self._waiting[name].append(table)
            if sum(one.num_rows for one in self._waiting[name]) >= ROWS:
                self._write(name)

    def _write(self, name: str) -> None:
        tables_, self._waiting[name] = self._waiting[name], []
        if any(one.num_rows for one in tables_):
            self._files[name].write_table(library().concat_tables(tables_).combine_chunks())

    def close(self) -> None:
        """Finish the files."""
        with self._stack:
            for name in self._waiting:
                self._write(name)

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *why: Any) -> None:
        self.close()  # also after an interruption: what was assessed by then is there


def write(diagnosis: Diagnosis, folder: str | os.PathLike) -> list[Path]:
    """Write the four files of one diagnosis; returns their paths. Raises ConfigError."""
    with Writer(folder, "to_parquet") as out:
        out.add(tables(diagnosis, str(diagnosis.flight.get("name") or "")))
    return out.paths
