"""The constants of the default method: of each its unit, what it means, and the value that leaves its part out (constants.toml)."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rotorwatch.base import files


class Constant(NamedTuple):
    """One line of the table. off: None where leaving it out means nothing."""

    unit: str
    meaning: str
    off: float | None = None


TABLE: dict[str, Constant] = {
    f"{part}.{name}": Constant(**row)
    for part, rows in files.toml(Path(__file__).with_suffix(".toml"), "table of constants")[0].items()
    for name, row in rows.items()
}
