"""Constants of the default method, from constants.toml: unit, meaning, and the value that disables its part."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rotorwatch.base import files


class Constant(NamedTuple):
    """A constant. off: None where it cannot be left out."""

    unit: str
    meaning: str
    off: float | None = None


TABLE: dict[str, Constant] = {
    f"{part}.{name}": Constant(**row)
    for part, rows in files.toml(Path(__file__).with_suffix(".toml"), "table of constants")[0].items()
    for name, row in rows.items()
}
