"""Logs of the Acme autopilot, which does not exist: text, one record a line, its kind first.

ACMELOG 1
M,t_us,m1..m4            outputs of the motors in per cent
I,t_us,p,q,r,ax,ay,az    body rates in deg/s, specific force in g; axes forward, right, down
A,t_us,w,x,y,z           attitude: quaternion, body to world (north, east, down)
V,t_us,n,e,d             velocity in m/s; P likewise: position in m
"""

from __future__ import annotations

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Signal

FORMAT = "Acme log"

HEAD = b"ACMELOG 1\n"
# kind: name of the signal, its columns among those of the record, factors to SI, unit and frame as in `rotorwatch.flight`
G = 9.80665
RECORDS = {
    "M": [("motors", slice(0, 4), ("r1", "r2", "r3", "r4"), 0.01, "1", "")],
    "I": [("gyro", slice(0, 3), ("x", "y", "z"), np.pi / 180, "rad/s", "FRD"), ("accel", slice(3, 6), ("x", "y", "z"), G, "m/s^2", "FRD")],
    "A": [("attitude", slice(0, 4), ("w", "x", "y", "z"), 1.0, "1", "FRD->NED")],
    "V": [("velocity", slice(0, 3), ("n", "e", "d"), 1.0, "m/s", "NED")],
    "P": [("position", slice(0, 3), ("n", "e", "d"), 1.0, "m", "NED")],
}
LENGTH = {kind: 1 + max(part[1].stop for part in parts) for kind, parts in RECORDS.items()}


def sniff(head: bytes, name: str) -> bool:
    """True for the first line that every Acme log has; by its name alone a file is not taken."""
    return not name and head.startswith(HEAD)


def read(data, name: str, progress=None) -> Flight:
    """Read one log. data: bytes or a memory map. Lines that cannot be read are counted in a warning, never guessed.

    Raises LogError when no line is left.
    """
    rows: dict[str, list[list[float]]] = {kind: [] for kind in RECORDS}
    lines = bytes(data)[len(HEAD) :].decode("ascii", "replace").splitlines()
    bad = 0
    for k, line in enumerate(lines):
        kind, *fields = line.split(",")
        try:
            numbers = [float(field) for field in fields]
        except ValueError:
            numbers = []
        if kind in rows and len(numbers) == LENGTH[kind] and np.isfinite(numbers[0]):
            rows[kind].append(numbers)
        else:
            bad += 1
        if progress is not None and k % 10_000 == 0:
            progress(k / len(lines))
    tables = {kind: np.array(found) for kind, found in rows.items() if found}
    if not tables:
        raise LogError("this Acme log holds no records")
    start = min(table[:, 0].min() for table in tables.values())
    end = max(table[:, 0].max() for table in tables.values())
    signals = {}
    for kind, table in tables.items():
        table = table[np.argsort(table[:, 0], kind="stable")]
        time = (table[:, 0] - start) * 1e-6
        for label, part, columns, factor, unit, frame in RECORDS[kind]:
            signals[label] = Signal(time, factor * table[:, 1:][:, part], columns, unit, frame, source=kind)
    warnings = (f"{bad} of {len(lines)} lines could not be read and are left out.",) if bad else ()
    return Flight(
        format=FORMAT, autopilot="Acme", signals=signals, duration=(end - start) * 1e-6, vehicle_type="quadrotor",
        warnings=warnings,
    )  # fmt: skip
