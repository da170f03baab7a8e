"""ESC telemetry in DataFlash logs: the rotor of each record, and its units.

    ESC   Instance RPM RawRPM Volt Curr Temp CTot MotTemp Err     Copter 4.2 and later: rpm, V, A, degC; an ESC that does not
                                                                  report speeds has NaN there
    ESC   Instance RPM Volt Curr Temp CTot MotTemp                Copter 4.0 and 4.1
    ESC1, ESC2 ..  RPM Volt Curr Temp CTot                        Copter 3.6
    CESC  Id ECnt Voltage Curr Temp RPM Pow                       Copter 3.6 to 4.0, ESCs on UAVCAN: temperature in K

The instance counts servo outputs from 0. ESCs on CAN buses and on outputs counted separately begin with 0 as well: when none of the rotors'
outputs has an instance, and there are as many instances as rotors, they are the rotors in order. ESCX (duty cycles and status flags of some
makes) holds neither speed nor current and is not read.
Field lists: the LoggerMessage comments in AP_ESC_Telem/LogStructure.h of each release, and
https://ardupilot.org/copter/docs/logmessages.html
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import numpy as np

from rotorwatch.flight import Signal
from rotorwatch.logs import esc_columns

FIELDS = {"speed": "RPM", "current": "Curr", "voltage": "Volt", "temperature": "Temp"}
CAN_FIELDS = {**FIELDS, "voltage": "Voltage"}
INSTANCES = ("Instance", "I", "Id")
BY_NUMBER = "ESC telemetry does not name the motors' outputs; its first instance was taken to be rotor 1, and so on."


def read(log, table: Callable, outputs: Mapping[int, int], notes: list[str]) -> Signal | None:
    """The signal `esc`; None where the log has none of these records.

    log: with `counts` and `columns`. table(message, columns, where): (time, values, codes) or None. outputs: rotor -> servo output, from 1.
    """
    message = next((m for m in ("ESC", "CESC") if log.counts.get(m)), None)
    if message is None:
        numbers = [int(m[3:]) for m in log.counts if re.fullmatch(r"ESC\d{1,2}", m) and log.counts[m]]

        def report(output):
            return table(f"ESC{output}", tuple(FIELDS.values()), None)

        fields, source = FIELDS, "ESC1 .."
    else:
        column = next((c for c in INSTANCES if c in log.columns(message)), None)
        if column is None:
            return None
        rows = table(message, (column,), None)
        if rows is None:
            return None
        instances = rows[1][np.isfinite(rows[1])]
        counted = np.bincount(np.clip(instances, 0, 255).astype(int))
        # A damaged instance number occurs in a record or two.
        numbers = [int(k) + 1 for k in np.flatnonzero(counted > max(1, 0.01 * counted.max(initial=0)))]
        fields, source = (CAN_FIELDS if message == "CESC" else FIELDS), message

        def report(output):
            return table(message, tuple(fields.values()), (column, output - 1))

    rotors = sorted(outputs)
    where = {rotor: outputs[rotor] for rotor in rotors}
    if not set(numbers) & set(where.values()) and len(numbers) == len(rotors) and numbers:
        where = dict(zip(rotors, sorted(numbers)))
        notes.append(BY_NUMBER)
    reports = [_report(report(where[rotor]), fields, message == "CESC") for rotor in rotors]
    return esc_columns.together(reports, rotors, source, notes)


def _report(rows, fields: Mapping[str, str], kelvin: bool):
    """(time, quantity -> values) of one ESC."""
    if rows is None:
        return None
    time, values, _ = rows
    quantities = {quantity: values[:, k] for k, quantity in enumerate(fields)}
    quantities["speed"] = quantities["speed"] * esc_columns.RPM
    if kelvin:
        quantities["temperature"] = quantities["temperature"] - esc_columns.KELVIN
    return time, quantities
