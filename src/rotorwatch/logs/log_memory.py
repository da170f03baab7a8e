"""A Flight from arrays or a data frame in memory, with the column names of docs/readers.md; and comma-separated numbers as named columns,
for the readers of tables."""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Callable, Mapping

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message
from rotorwatch.logs import esc_columns, series

_AXES = "xyz"
_RAD = np.pi / 180

# Signal: the columns it may be given in (all of them, in this order) and their factor to SI.
_GROUPS = {
    "control": [(("control_roll", "control_pitch", "control_yaw", "control_thrust"), 1.0)],
    "gyro": [(tuple(f"gyro_{a}_{u}" for a in _AXES), k) for u, k in (("rad_s", 1.0), ("deg_s", _RAD))],
    "rates": [(tuple(f"rates_{a}_{u}" for a in _AXES), k) for u, k in (("rad_s", 1.0), ("deg_s", _RAD))],
    "accel": [(tuple(f"accel_{a}_{u}" for a in _AXES), k) for u, k in (("m_s2", 1.0), ("g", G0))],
    "attitude": [
        (("q_w", "q_x", "q_y", "q_z"), 1.0),
        (("roll_rad", "pitch_rad", "yaw_rad"), 1.0),
        (("roll_deg", "pitch_deg", "yaw_deg"), _RAD),
    ],
    "velocity": [(tuple(f"velocity_{a}_m_s" for a in "ned"), 1.0)],
    "position": [(tuple(f"position_{a}_m" for a in "ned"), 1.0)],
    "throttle": [(("throttle",), 1.0)],
    "battery": [(("voltage_V", "current_A"), 1.0), (("voltage_V",), 1.0)],
    "lift": [(("lift_max", "voltage_ratio", "lift_limit"), 1.0)],
}
_NUMBERED = re.compile(
    r"(motor_(?P<motor>\d{1,2})(?P<us>_us)?|rpm_(?P<speed>\d{1,2})|esc_current_(?P<current>\d{1,2})_A"
    r"|esc_voltage_(?P<voltage>\d{1,2})_V|esc_temperature_(?P<temperature>\d{1,2})_degC)"
)
_STATES = ("armed", "landed")
_MOST_ROTORS = 16
_EMPTY = ((b",,", b",nan,"), (b",,", b",nan,"), (b",\n", b",nan\n"), (b",\r", b",nan\r"), (b"\n,", b"\nnan,"))
"""Empty cells, and what is read instead; of three commas in a row the first turn sees two."""
_MOST_COLUMNS = 2000
_KNOWN = {"time_s", *_STATES, *(c for ways in _GROUPS.values() for way, _ in ways for c in way)}


def known_column(name: str) -> bool:
    """True for a column name that a table may have."""
    return name in _KNOWN or _NUMBERED.fullmatch(name) is not None


def check_names(names) -> None:
    """Raise a LogError that names what is wrong with a table's column names."""
    if "time_s" not in names:
        raise LogError(f"a table needs a column time_s; found {_list(names)}")
    unknown = [n for n in names if not known_column(n)]
    if unknown:
        raise LogError(f"unknown column {_list(unknown)}; docs/readers.md lists the names, units are part of them")


def from_arrays(columns, *, parameters: Mapping[str, float] | None = None, name: str = "", autopilot: str = "") -> Flight:
    """Build a Flight from columns with the names of docs/readers.md.

    columns: a mapping of names to equally long sequences, or a pandas or polars data frame. NaN means no sample.
    Signals of different rates share one table: one that is empty in most rows is taken at the rows where it has values.
    parameters: the autopilot's, by their names (MOT_THST_EXPO, CA_ROTOR0_PX ...).

    Raises LogError naming the columns that are unknown, incomplete or of the wrong kind."""
    table = _arrays(columns)
    notes: list[str] = []
    time = table.pop("time_s")
    if not np.isfinite(time).any():
        raise LogError("column time_s holds no numbers")
    start = float(time[series.steady(time)[0]])
    time = time - start
    signals = {}
    for kind, ways in _GROUPS.items():
        signal = _group(kind, ways, time, table, notes)
        if signal is not None:
            signals[kind] = signal
    signals |= _rotors(time, table, notes)
    if not signals:
        raise LogError("no signal is in this table; it needs at least motor_1 .. motor_N and gyro_x_rad_s .. gyro_z_rad_s")
    messages = _messages(time, table)
    return Flight(
        format="arrays",
        autopilot=autopilot,
        signals=signals,
        duration=series.end_of(signals),
        parameters={k: float(v) for k, v in (parameters or {}).items() if not k.startswith("SIM_")},
        messages=tuple(messages),
        warnings=tuple(notes),
        name=name,
        start_us=round(start * 1e6) if abs(start) < 1e12 else 0,
    )


def _arrays(columns) -> dict[str, np.ndarray]:
    """Columns as float arrays of one length, names checked."""
    names = [str(n) for n in (columns.columns if hasattr(columns, "columns") else columns)]
    check_names(names)
    table = {}
    for name in names:
        try:
            table[name] = np.array(columns[name], dtype=np.float64)
        except (TypeError, ValueError):
            raise LogError(f"column {name} holds something other than numbers") from None
    if len({a.shape for a in table.values()}) > 1 or table["time_s"].ndim != 1:
        raise LogError("the columns of a table must be one-dimensional and of one length")
    return table


def _list(names, most=5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _rows(values: np.ndarray) -> np.ndarray:
    """Indices of the rows that are samples: all, unless most are empty, when the signal was logged more slowly than the table."""
    filled = np.asarray(np.isfinite(values).any(axis=1))
    return filled if filled.mean() < 0.5 else np.ones(filled.size, bool)


def _group(kind, ways, time, table, notes):
    """A signal from the columns in any of its forms; a LogError names those missing from an incomplete set."""
    for names, scale in ways:
        if all(n in table for n in names):
            values = np.stack([table[n] for n in names], axis=1) * scale
            if kind == "attitude":
                values = series.unit_quaternion(values)[0] if len(names) == 4 else series.quaternion(*values.T)
                values[~np.isfinite(np.stack([table[n] for n in names], axis=1)).all(axis=1)] = np.nan
            elif kind == "battery" and len(names) == 1:
                values = np.column_stack([values, np.full(time.size, np.nan)])
            rows = _rows(values)
            return series.signal(kind, time[rows], values[rows], names[0] + " ..", notes)
    for names, _ in ways:
        present = [n for n in names if n in table]
        if present:
            raise LogError(f"column {_list([n for n in names if n not in table])} is missing next to {_list(present)}")
    return None


def _rotors(time, table, notes) -> dict:
    """The numbered columns: motors and ESC telemetry."""
    numbered: dict[str, dict[int, str]] = {"motor": {}, **{quantity: {} for quantity in esc_columns.QUANTITIES}}
    for name in table:
        match = _NUMBERED.fullmatch(name)
        if match:
            what = next(k for k in numbered if match[k])
            if int(match[what]) in numbered[what]:
                raise LogError(f"columns {numbered[what][int(match[what])]} and {name} are the same rotor")
            numbered[what][int(match[what])] = name
    for names in numbered.values():
        if names and (sorted(names) != list(range(1, len(names) + 1)) or len(names) > _MOST_ROTORS):
            raise LogError(f"columns {_list(list(names.values()))} are not numbered 1, 2, 3 without gaps")
    signals = {}
    names = [numbered["motor"][k] for k in sorted(numbered["motor"])]
    if names:
        values = np.stack([table[n] for n in names], axis=1)
        in_us = [n.endswith("_us") for n in names]
        if len(set(in_us)) > 1:
            raise LogError("motor columns must all end in _us or none of them")
        # Shares of full command never pass 1.5, pulses never fall below 500 us while driven.
        if not in_us[0] and np.nanmax(values, initial=0.0) > 100:
            notes.append("motor_1 .. are taken as us because of their size; name them motor_1_us .. to say so")
            in_us = [True]
        rows = _rows(values)
        signals["motors"] = series.motors(time[rows], values[rows], "us" if in_us[0] else "1", names[0] + " ..", notes)
    if numbered["speed"]:
        count = range(1, len(numbered["speed"]) + 1)
        none = np.full(time.size, np.nan)
        measured = {
            quantity: np.stack([table.get(numbered[quantity].get(k, ""), none) for k in count], axis=1)
            for quantity in esc_columns.QUANTITIES
        }
        measured["speed"] = measured["speed"] * esc_columns.RPM
        rows = _rows(measured["speed"])
        measured = {quantity: values[rows] for quantity, values in measured.items()}
        signals["esc"] = esc_columns.build(time[rows], measured, count, "rpm_1 ..", notes)
    return {k: v for k, v in signals.items() if v is not None}


def _messages(time, table) -> list[Message]:
    """State changes from the columns armed and landed (0 or 1)."""
    out = []
    for kind in _STATES:
        if kind in table:
            known = np.isfinite(table[kind]) & np.isfinite(time)
            out += series.states(kind, time[known], table[kind][known] > 0.5)
    return sorted(out, key=lambda m: m.time)


def header(head: bytes) -> list[str]:
    """Column names in the first line of a text table; [] when it is no such table."""
    line = bytes(head).partition(b"\n")[0]
    try:
        text = line.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        return []
    if not text.isprintable() or "," not in text:
        return []
    return [c.strip().strip('"') for c in text.split(",")]


def numbers(data, notes, name="", wanted: Callable[[str], bool] = lambda column: True) -> dict[str, np.ndarray]:
    """Columns of a text table by name. Empty cells and text become NaN; notes get the number of affected lines. wanted: whether a column of
    that name is used; others may hold anything.

    Raises LogError without a header line, with doubled names, or without any line of numbers."""
    data = bytes(data).rstrip(b"\0")
    names = header(data[: 1 << 16])
    where = f"{name}: " if name else ""
    used = [k for k, column in enumerate(names) if wanted(column)]
    if not names or len(names) > _MOST_COLUMNS or not used:
        raise LogError(f"{where}the first line is not a comma-separated list of column names")
    if len(set(names)) < len(names):
        raise LogError(f"{where}column {next(n for n in names if names.count(n) > 1)} appears twice")
    body = data.partition(b"\n")[2]
    if not body.strip():
        raise LogError(f"{where}the table has no numeric line")
    try:
        full = body
        for empty, filled in _EMPTY:
            full = full.replace(empty, filled)
        filled = io.BytesIO(full + b"nan" if full.endswith(b",") else full)
        del full
        if len(used) < len(names):
            rows = np.loadtxt(filled, delimiter=",", ndmin=2, comments=None, encoding="ascii", usecols=used)
        else:
            rows = np.loadtxt(filled, delimiter=",", ndmin=2, comments=None, encoding="ascii")
        if rows.shape[1] != len(used):
            raise ValueError
    except ValueError:
        rows = _line_by_line(body, len(names), used, notes, where)
    if not rows.size:
        raise LogError(f"{where}the table has no numeric line")
    return {names[column]: rows[:, k] for k, column in enumerate(used)}


def _line_by_line(body: bytes, width: int, used: list[int], notes, where: str) -> np.ndarray:
    """Slower than loadtxt, but tolerates damage: a wrong number of cells drops the line, a wrong cell becomes NaN."""
    rows, dropped, cells = array("d"), 0, 0
    lines = io.TextIOWrapper(io.BytesIO(body.replace(b"\0", b"")), "utf-8", "replace", newline="")
    for line in csv.reader(lines):
        if not line:
            continue
        if len(line) != width:
            dropped += 1
            continue
        for cell in (line[k] for k in used):
            try:
                rows.append(float(cell) if cell else np.nan)
            except ValueError:
                rows.append(np.nan)
                cells += 1
    if dropped:
        notes.append(f"{where}{dropped} line{'s' if dropped > 1 else ''} with a wrong number of cells dropped")
    if cells:
        notes.append(f"{where}{cells} cell{'s' if cells > 1 else ''} without a number ignored")
    return np.array(rows, float).reshape(-1, len(used))
