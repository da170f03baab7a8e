"""The store as Parquet files: flights, aircraft, rotors and services, a row each."""

from __future__ import annotations

from pathlib import Path

from rotorwatch.base import files, optional
from rotorwatch.fleet.store import Store

PART = 10_000


# Columns of each table: texts; whole numbers; real numbers.
COLUMNS = {
    "flights": (
        "hash name path aircraft aircraft_name identity utc autopilot firmware frame build verdict headline version",
        "ordinal size clock_us count rotors",
        "duration_s airborne_s loss onset_s",
    ),
    "aircraft": ("key name frame build firmware first last headline", "flights rotors", "airborne_s worst"),
    "rotors": (
        "aircraft aircraft_name status outlook",
        "rotor named",
        "loss loss_low loss_high evidence loss_per_hour hours_left hours_left_low hours_left_high",
    ),
    "services": ("aircraft what utc", "number rotor after", ""),
}


def export(store: Store, folder: str | Path) -> list[Path]:
    """Write FOLDER/flights.parquet, aircraft.parquet, rotors.parquet and services.parquet, each in one step; returns the paths."""
    pa, pq = (optional.library(name, "A Parquet file") for name in ("pyarrow", "pyarrow.parquet"))
    folder = files.folder(folder, "--out")
    kinds = pa.string(), pa.int64(), pa.float64()
    aircraft = store.aircraft()
    paths = []
    for table, columns in COLUMNS.items():
        fields = {name: kind for kind, names in zip(kinds, columns) for name in names.split()}
        schema = pa.schema(fields | ({"named": pa.bool_()} if "named" in fields else {}))
        path = folder / f"{table}.parquet"
        with files.replacing(path) as hidden, pq.ParquetWriter(hidden, schema) as out:
            for rows in _parts(store, table, aircraft):
                out.write_table(pa.Table.from_pylist([{k: r.get(k) for k in schema.names} for r in rows], schema))
        paths.append(path)
    return paths


def _parts(store: Store, table: str, aircraft: list[dict]):
    if table == "flights":
        for start in range(0, store.count(), PART):
            yield store.flights("date", PART, start)
    elif table == "aircraft":
        yield [a | {k: (a["standing"] or {}).get(k) for k in ("headline", "worst")} for a in aircraft]
    elif table == "services":
        yield store.services()
    else:
        yield [_rotor(a, r) for a in aircraft for r in (a["standing"] or {}).get("rotors", ())]


def _rotor(a: dict, r: dict) -> dict:
    outlook = r["prognosis"] or {}
    extra = {"outlook": outlook.get("word"), "aircraft": a["key"], "aircraft_name": a["name"]}
    extra |= dict(zip(("loss_low", "loss_high"), r["interval"]))
    return r | outlook | extra | dict(zip(("hours_left_low", "hours_left_high"), outlook.get("hours_left_interval") or ()))
