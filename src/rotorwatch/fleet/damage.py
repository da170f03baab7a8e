"""Search for damage of a store after an unforeseen error: SQLite takes any value in any column."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from typing import Any

import sqlalchemy as sa

from rotorwatch.errors import ConfigError
from rotorwatch.fleet import tables
from rotorwatch.flight.diagnosis import Diagnosis

TYPES = {sa.Text: str, sa.Integer: int, sa.BigInteger: int, sa.Float: (int, float)}


def _answer(text: str) -> None:
    with suppress(ConfigError):  # of another version, which is no damage
        Diagnosis.from_dict(json.loads(text)).to_dict()


def _standing(text: str) -> None:
    json.loads(text)["headline"].split()


def _trim(text: str) -> None:
    if table := json.loads(text):
        table["doubt"]


# Texts that hold JSON: the function that raises for a damaged one.
JSON = {"diagnosis": _answer, "trim": _trim, "standing": _standing, "points": lambda text: list(json.loads(text))}


def found(connection: Any) -> str:
    """Location of an impossible value, as "table flights, row 12ab.., airborne_s"; empty where all is intact."""
    for table in tables.metadata.sorted_tables:
        names = ", ".join(f'"{column.name}"' for column in table.columns)
        for row in connection.exec_driver_sql(f'SELECT {names} FROM "{table.name}"'):
            for column, value in zip(table.columns, row):
                if not _sound(column, value):
                    return f"table {table.name}, row {str(row[0])[:12]}, {column.name}"
    return ""


def _sound(column: Any, value: Any) -> bool:
    if value is None:
        return bool(column.nullable)
    if not isinstance(value, TYPES.get(type(column.type), object)):
        return False
    if isinstance(value, float) and not math.isfinite(value):
        return False
    try:
        JSON.get(column.name, str)(value)
    except (ValueError, TypeError, KeyError, AttributeError, IndexError):
        return False
    return True
