"""ESC telemetry in PX4's topic esc_status: which of its reports is which rotor's.

    esc[i].esc_rpm (negative: backwards), esc_voltage V, esc_current A, esc_temperature degC    as far as the driver knows them, else 0
    esc[i].actuator_function         101 is motor 1                                     1.13 and later
    esc[i].esc_address               number of the ESC on its bus, from 0 or 1          before: reports are in this order
    esc_online_flags                 bit i: esc[i] was heard of lately

https://docs.px4.io/main/en/msg_docs/EscStatus.html and EscReport.html
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rotorwatch.flight import Signal
from rotorwatch.logs import esc_columns, px4_outputs

MOST = 12
FIELDS = {"speed": "esc_rpm", "current": "esc_current", "voltage": "esc_voltage", "temperature": "esc_temperature"}


def read(time: np.ndarray, table: Mapping[str, np.ndarray], count: int, notes: list[str]) -> Signal | None:
    """The signal `esc` of one esc_status topic; None where it says nothing. time (m,) s; count: rotors, 0 where not known."""
    escs = [i for i in range(MOST) if f"esc[{i}].esc_rpm" in table]
    if not escs or not time.size:
        return None
    place = _places(table, escs)
    order = [place[k] for k in sorted(place)][: count or MOST]
    online = None
    if "esc_online_flags" in table and np.asarray(table["esc_online_flags"]).any():
        flags = np.asarray(table["esc_online_flags"]).astype(np.int64)
        online = np.stack([(flags >> i) & 1 for i in order], axis=1) > 0
    return esc_columns.numbered(time, table, "esc[{}].", FIELDS, order, "esc_status", notes, online)


def _places(table: Mapping[str, np.ndarray], escs: list[int]) -> dict[int, int]:
    """Rotor, from 0 -> index of its report: by function, else by address, else as they come."""
    place = {}
    for i in escs:
        functions = np.asarray(table.get(f"esc[{i}].actuator_function", [0])).astype(int)
        motors = functions[(functions >= px4_outputs.MOTOR_1) & (functions <= px4_outputs.MOTOR_12)]
        if motors.size:
            place.setdefault(int(np.bincount(motors).argmax()) - px4_outputs.MOTOR_1, i)
    if place:
        return place
    used = int(np.max(table["esc_count"])) if "esc_count" in table and np.size(table["esc_count"]) else 0
    escs = escs[:used] if 0 < used < len(escs) else escs
    addresses = [int(np.median(np.asarray(table.get(f"esc[{i}].esc_address", [0])))) for i in escs]
    if sorted(addresses) in (list(range(len(escs))), list(range(1, len(escs) + 1))):
        return {address - min(addresses): i for address, i in zip(addresses, escs)}
    return dict(enumerate(escs))
