"""Tables that blackbox_decode made of Blackbox logs: a line for each main frame, names and units in the first one.

They lack the header. So the gyro is taken as deg/s where no unit is named, as Betaflight logs it; outputs as DShot values or as pulses by
their size; and the accelerometer is used where the table gives it in g or m/s^2 (--unit-acceleration).
"""

from __future__ import annotations

import re

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import log_memory, series
from rotorwatch.logs.blackbox import assembly
from rotorwatch.logs.blackbox.header import Header

FORMAT = "Blackbox CSV"

TIMES = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
TURNS = {"raw": 1.0, "deg/s": 1.0, "rad/s": float(np.degrees(1.0))}
FORCES = {"g": 1.0, "m/s/s": 1.0 / G0, "m/s2": 1.0 / G0}
VOLTS, AMPERES = {"V": 100.0, "mV": 0.1}, {"A": 100.0, "mA": 0.1}


def sniff(head: bytes, name: str) -> bool:
    """True where the first line names the columns of main frames; never by name."""
    names = {re.sub(r" \(.*\)$", "", column) for column in log_memory.header(head)}
    return {"loopIteration", "time"} <= names and bool(names & {"gyroADC[0]", "motor[0]"})


def read(data, name: str, progress=None) -> Flight:
    """Read a table. Raises LogError without a column of time, or without lines of numbers."""
    notes: list[str] = []
    named = [re.fullmatch(r"(.*?)(?: \((.*)\))?", column) for column in log_memory.header(bytes(data[: 1 << 16]))]
    units = {m[1]: m[2] or "raw" for m in named if m is not None}
    raw = log_memory.numbers(data, notes, wanted=lambda column: assembly.used(re.sub(r" \(.*\)$", "", column)))
    table = {re.sub(r" \(.*\)$", "", column): values for column, values in raw.items()}
    if "time" not in table or units["time"] not in TIMES:
        raise LogError(f"{name}: this table of blackbox_decode has no time in us or s")
    time = table.pop("time") * TIMES[units["time"]]
    if not np.isfinite(time).any():
        raise LogError(f"{name}: this table of blackbox_decode has no times")
    start = float(time[series.steady(time)[0]])
    settings = {"gyro_scale": "0x3f800000", "acc_1G": "1000", "vbatcellvoltage": "330,350,430", "currentSensor": ""}
    for column in list(table):
        unit, kind = units[column], column.partition("[")[0]
        factor = 1.0
        if kind in ("gyroADC", "gyroUnfilt", "gyroRaw"):
            factor = TURNS.get(unit)
        elif kind in ("accSmooth", "accUnfiltered"):
            factor = FORCES.get(unit, 0.0) * 1000.0
        elif column in ("vbat", "vbatLatest"):
            factor = VOLTS.get(unit)
        elif column in ("amperage", "amperageLatest"):
            factor = AMPERES.get(unit)
        if not factor:
            del table[column]
            if column.endswith(("[0]", "Latest", "vbat", "amperage")):
                notes.append(f"{kind} is left out: the table does not give its unit, {unit} is not known.")
        else:
            table[column] = table[column] * factor
    notes.append("This is a table of blackbox_decode without the log's header: give the log itself, which has more data.")
    columns = assembly.Columns(table, time - start, Header(0, settings), notes)
    flown = assembly.assembled(columns, FORMAT, name, start_us=round(start * 1e6))
    return Flight(**{**vars(flown), "parameters": {}, "autopilot": "Betaflight", "warnings": tuple(notes)})
