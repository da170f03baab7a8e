"""A quadrotor X on ArduCopter 4.1.3 with one propeller cut by 5 to 25 mm, hovering and flying straight lines; three flights each.

The rotor is not named: that the mean output of rotor 1 rises with the depth of the cut says which one. Each flight is assessed twice:
alone, and against the flights with good propellers of the same kind (a good one against the other two).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

FOLDER = "dist/prototype-set-1/flight data_quadcopter"


def flights(checkout: Path, out: Path) -> Iterator[dict[str, Any]]:
    """Rows of all flights; nothing is converted."""
    for source in sorted((checkout / FOLDER).glob("*/*/*.BIN")):
        kind, cut = source.parent.parent.name.lower(), source.parent.name.split()[0]
        good = [str(p) for p in sorted(source.parent.parent.glob("good*/*.BIN")) if p != source]
        known = {} if cut == "good" else {"rotor": "1", "onset_s": 0.0}
        name = f"{'whole propellers' if cut == 'good' else f'{cut} mm cut'}, {kind}"
        yield {"path": str(source), "group": name} | known
        yield {"path": str(source), "baseline": ";".join(good), "group": f"{name}, against healthy flights"} | known
