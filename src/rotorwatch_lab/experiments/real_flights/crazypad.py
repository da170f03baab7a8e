"""CrazyPAD: a Crazyflie 2.1 hovering with whole, cut and taped propellers, and with weights (motor_data, 25 s each).

Folders name the propellers and how much is cut from each blade (47 mm long). Each flight is assessed against the normal flights of the same
vehicle (E8 or E9). Two vehicles' logs in cut_propeller_M3_2mm and .._3mm are of another kind, by mistake, and are left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TAPED = {"tape_on_propeller_M1_M3_M4": (1, 3, 4), "tape_on_propeller_M1_M3": (1, 3), "tape_on_propeller_M3_M4": (3, 4),
         "tape_on_propeller_M3": (3,)}  # fmt: skip
BLADE_MM = 47.0
CUTS, CUT = re.compile(r"[mM](\d)((?:_[\d.]+(?:mm|мм))+)"), re.compile(r"_([\d.]+)")


def flights(checkout: Path, out: Path) -> Iterator[dict[str, Any]]:
    """Rows of all flights; nothing is converted."""
    folder = checkout / "data" / "motor_data"
    normal = sorted((folder / "normal_flight").iterdir())
    for source in sorted(folder.glob("*/E?_log??")):
        case, vehicle = source.parent.name, source.name[:2]
        if not source.read_bytes()[:4000].count(b"motor.m1"):
            continue
        others = [str(p) for p in normal if p.name.startswith(vehicle) and p != source]
        yield {"path": str(source), "baseline": ";".join(others)} | _known(case)


def _known(case: str) -> dict[str, Any]:
    if case in TAPED:
        rotors = TAPED[case]
        return {"rotor": "+".join(map(str, rotors)), "onset_s": 0.0, "group": f"tape on {len(rotors)} propellers"}
    cuts = {int(m[1]): [float(x) for x in CUT.findall(m[2])] for m in CUTS.finditer(case)}
    if not cuts:
        return {"group": "weights" if "weight" in case else "whole propellers"}
    deepest = max(mm for of_rotor in cuts.values() for mm in of_rotor if mm < BLADE_MM / 2.0)  # the last one is what is left of the blade
    depth = "up to 1 mm" if deepest <= 1.0 else "1.5 to 2 mm" if deepest <= 2.0 else "2.5 to 3 mm" if deepest <= 3.0 else "3.5 or 4 mm"
    rotors = "+".join(map(str, sorted(cuts)))
    return {"rotor": rotors, "onset_s": 0.0, "group": f"{depth} of a blade cut, {'two rotors' if len(cuts) > 1 else 'one rotor'}"}
