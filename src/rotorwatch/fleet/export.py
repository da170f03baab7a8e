"""The store as Parquet files: flights, aircraft, rotors and services, a row each."""

from __future__ import annotations

from pathlib import Path

from rotorwatch import files, optional
from rotorwatch.fleet.store import Store

PART = 10_000


def export(store: Store, folder: str | Path) -> list[Path]:
    """Write FOLDER/flights.parquet, aircraft.parquet, rotors.parquet and services.parquet, each in one step; returns the paths."""
    pa, pq = (optional.library(name, "A Parquet file") for name in ("pyarrow", "pyarrow.parquet"))
    folder = files.folder(folder, "--out")
    name, text, whole, real = pa.field, pa.string(), pa.int64(), pa.float64()
    kinds = {
        "flights": pa.schema(
            [
                *(
                    name(k, text)
                    for k in (
                        "hash",
                        "name",
                        "path",
                        "aircraft",
                        "aircraft_name",
                        "identity",
                        "utc",
                        "autopilot",
                        "firmware",
                    )
                ),
                *(name(k, text) for k in ("frame", "build", "verdict", "headline", "version")),
                *(name(k, whole) for k in ("ordinal", "size", "clock_us", "count", "rotors")),
                *(name(k, real) for k in ("duration_s", "airborne_s")),
            ]
        ),
        "aircraft": pa.schema(
            [
                *(name(k, text) for k in ("key", "name", "frame", "build", "firmware", "first", "last", "headline")),
                *(name(k, whole) for k in ("flights", "rotors")),
                *(name(k, real) for k in ("airborne_s", "worst")),
            ]
        ),
        "rotors": pa.schema(
            [
                *(name(k, text) for k in ("aircraft", "aircraft_name", "status", "outlook")),
                name("rotor", whole),
                name("named", pa.bool_()),
                *(name(k, real) for k in ("loss", "loss_low", "loss_high", "evidence", "loss_per_hour", "hours_left")),
                *(name(k, real) for k in ("hours_left_low", "hours_left_high")),
            ]
        ),
        "services": pa.schema(
            [
                *(name(k, text) for k in ("aircraft", "what", "utc")),
                *(name(k, whole) for k in ("number", "rotor", "after")),
            ]
        ),
    }
    aircraft = store.aircraft()
    made = []
    for table, schema in kinds.items():
        path = folder / f"{table}.parquet"
        with files.replacing(path) as hidden, pq.ParquetWriter(hidden, schema) as out:
            for rows in _parts(store, table, aircraft):
                out.write_table(pa.Table.from_pylist([{k: r.get(k) for k in schema.names} for r in rows], schema))
        made.append(path)
    return made


def _parts(store: Store, table: str, aircraft: list[dict]):
    if table == "flights":
        for start in range(0, store.count(), PART):
            yield store.flights(limit=PART, offset=start, newest_first=False)
    elif table == "aircraft":
        yield [a | {k: (a["standing"] or {}).get(k) for k in ("headline", "worst")} for a in aircraft]
    elif table == "services":
        yield store.services()
    else:
        yield [_rotor(a, r) for a in aircraft for r in (a["standing"] or {}).get("rotors", ())]


def _rotor(a: dict, r: dict) -> dict:
    outlook = r["prognosis"] or {}
    low, high = outlook.get("hours_left_interval") or (None, None)
    more = {
        "loss_low": r["interval"][0],
        "loss_high": r["interval"][1],
        "outlook": outlook.get("word"),
        "hours_left_low": low,
    }
    return r | outlook | more | {"hours_left_high": high, "aircraft": a["key"], "aircraft_name": a["name"]}
