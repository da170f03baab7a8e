"""ESC telemetry as a Signal, for the readers of all log formats.

Columns speed1 .. speedN [rad/s], current1 .. [A], voltage1 .. [V], temperature1 .. [degC, of the ESC], N rotors in the autopilot's order.
Quantities that an ESC does not measure are invalid, and so are rows in which it did not report: values are never held.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.flight import Signal
from rotorwatch.logs import series

QUANTITIES = ("speed", "current", "voltage", "temperature")
UNIT = "rad/s,A,V,degC"
RPM = 2.0 * np.pi / 60.0
"""rad/s of a revolution per minute."""
KELVIN = 273.15

# Values outside are damage; unmeasured ones are often sent as 0 V, or a temperature of -273 or 0 degC at 0 V.
LIMITS = {"speed": (0.0, 20_000.0), "current": (-200.0, 1000.0), "voltage": (0.5, 200.0), "temperature": (-60.0, 300.0)}


def build(time, measured: dict[str, np.ndarray], rotors: Sequence[int], source: str, notes: list[str], valid=None):
    """The Signal `esc` from rows in which all ESCs report together; None when no speed or current in it is usable.

    time (m,) s; measured: quantity -> (m, N) in the units above, speeds of either sign; those left out are not measured. rotors: their
    numbers. valid (m, N) bool: where an ESC reported. notes: sentences that this appends to."""
    shape = (len(time), len(rotors))
    blocks, masks, wild = [], [], 0
    for quantity in QUANTITIES:
        values = np.asarray(measured.get(quantity, np.full(shape, np.nan)), np.float64).reshape(shape)
        values = np.abs(values) if quantity == "speed" else values
        low, high = LIMITS[quantity]
        with np.errstate(invalid="ignore"):
            fine = np.isfinite(values) & (values >= low) & (values <= high)
            # 0 V is no measurement, not damage.
            wild += int(np.count_nonzero(np.isfinite(values) & ~fine & (np.abs(values) > high)))
        blocks.append(np.where(fine, values, np.nan))
        masks.append(fine if valid is None else fine & valid)
    if wild:
        notes.append(series.Impossible(wild, f"{source}: {wild} impossible value{'s' if wild > 1 else ''} ignored"))
    mask = np.concatenate(masks, axis=1)
    if not mask[:, : 2 * shape[1]].any():
        return None
    return series.build(time, np.concatenate(blocks, axis=1), names(rotors), UNIT, "", source, np.inf, notes, mask)


def numbered(time, table, prefix: str, fields: dict[str, str], order: Sequence[int], source, notes, valid=None):
    """`build` from a table with a field of each quantity for each ESC, speeds in revolutions per minute.

    prefix: of a field's name, "esc[{}]." of "esc[2].esc_rpm"; fields: quantity -> the rest of it; order: the ESCs, rotor after rotor."""
    measured = {quantity: series.stacked(table, [f"{prefix.format(k)}{field}" for k in order]) for quantity, field in fields.items()}
    measured["speed"] = measured["speed"] * RPM
    # A driver without a quantity leaves it 0 for all.
    for quantity in ("current", "temperature"):
        if not np.nan_to_num(measured[quantity]).any():
            del measured[quantity]
    return build(time, measured, range(1, len(order) + 1), source, notes, valid)


def names(rotors: Sequence[int]) -> tuple[str, ...]:
    """Columns of the telemetry of these rotors."""
    return tuple(f"{quantity}{rotor}" for quantity in QUANTITIES for rotor in rotors)


def together(reports: Sequence[tuple[np.ndarray, dict[str, np.ndarray]] | None], rotors, source, notes) -> Signal | None:
    """`build` from ESCs that report one after the other: for each rotor (time (m,) s, quantity -> (m,)) in order of time, or None.

    Rows are the reports of the ESC that reports most; another's report goes into the row nearest in time, within the interval between
    rows."""
    reporting = [r for r in reports if r is not None and len(r[0])]
    if not reporting:
        return None
    base = max(reporting, key=lambda r: len(r[0]))[0]
    middle = 0.5 * (base[1:] + base[:-1])
    spacing = float(median(np.diff(base))) if len(base) > 1 else 1.0
    measured = {quantity: np.full((len(base), len(reports)), np.nan) for quantity in QUANTITIES}
    for column, report in enumerate(reports):
        if report is None or not len(report[0]):
            continue
        time, values = report
        row = np.searchsorted(middle, time)
        near = np.abs(base[row] - time) <= spacing
        for quantity, series_ in values.items():
            measured[quantity][row[near], column] = series_[near]
    return build(base, measured, rotors, source, notes)
