"""PX4's actuator outputs of the rotors, in their order and unit.

Each output driver publishes an instance of `actuator_outputs`, without its name. Pulses are logged in us, simulated outputs as shares (0..1
or -1..1), UAVCAN as the counts of its raw command (uavcan.equipment.esc.RawCommand, 14 bit and sign: 8191 is full) and DShot as counts of
its throttle field (1999 is full).

Two publishers in one instance: an experimental controller that bypasses the mixer publishes its outputs next to the autopilot's own; both
are logged under the same name, alternate, and read as one series they make outputs jump. A sample belongs to the series whose last value it
is nearer to (`tracks`, `flown`).

Also the rotor of each report in the topic esc_status (`escs`):

    esc[i].esc_rpm (negative: backwards), esc_voltage V, esc_current A, esc_temperature degC    as far as the driver knows them, else 0
    esc[i].actuator_function         101 is motor 1                                     1.13 and later
    esc[i].esc_address               number of the ESC on its bus, from 0 or 1          before: reports are in this order
    esc_online_flags                 bit i: esc[i] reported recently

https://docs.px4.io/main/en/msg_docs/EscStatus.html and EscReport.html

Logs before 1.13 may hold the rate controller's output without actuator outputs. Those of a quad are computed (`mixed`), exact within half a
microsecond wherever both are logged, except for outputs at their limits, which the mixer moves together.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.arrays import median, unique
from rotorwatch.flight import Signal
from rotorwatch.flight.output_functions import MOTOR_1, MOTOR_12, in_order, motor_outputs
from rotorwatch.logs import esc_columns

CAN, PWM = "UAVCAN_EC", "PWM_MAIN"
CAN_FULL, DSHOT_FULL = 8191.0, 1999.0
TIMERS, DSHOT_TIMERS = 16, (-5, -4, -3, -2)  # PWM_MAIN_TIMn of DShot 150, 300, 600 and 1200
PULSES_US = (800.0, 2500.0)  # pulses of a driven motor
NO_COMMAND = 65535.0  # drivers that take counts log this while disarmed
MOVING, MOVING_US = 0.01, 100.0  # of full command, and in us: an output that moves less need not be a rotor's
LEAST_VALUES = 10  # rotors move through many values, servos and spare outputs step between a few
THERE_AND_BACK = 20  # jumps away and back within three samples that indicate two publishers
ALTERNATION = 4.0  # how many times nearer a sample has to be to the one before last than to the last
AT_REST = 0.1  # of two series, one that moves this much less than the other did not drive the motors
MOST_ESCS = 12
ESC_FIELDS = {"speed": "esc_rpm", "current": "esc_current", "voltage": "esc_voltage", "temperature": "esc_temperature"}

QUAD_X = np.array([[-1.0, 1, 1, 1], [1, -1, 1, 1], [1, 1, -1, 1], [-1, -1, -1, 1]]) * [0.5**0.5, 0.5**0.5, 1.0, 1.0]
QUAD_PLUS = np.array([[-1.0, 0, 1, 1], [1, 0, 1, 1], [0, 1, -1, 1], [0, -1, -1, 1]])
"""Rows: rotors in PX4's order; columns: roll, pitch, yaw, throttle. Mixer files quad_x.main.mix and quad_+.main.mix, geometries in
src/lib/mixer of PX4 before 1.13."""
QUADS_X = (1001, 3010)  # SYS_AUTOSTART of simulated quads, beside the thousands 4 (X) and 5 (plus)


class Reading(NamedTuple):
    """An instance read as rotors: values (n, rotors) in us or shares, swing as a share of full, facts on limits.

    named: the log's output functions name these outputs as motors. outputs: of each rotor, from 1."""

    values: np.ndarray
    unit: str
    swing: float
    named: bool
    facts: Mapping = MappingProxyType({})
    note: str = ""
    outputs: tuple[int, ...] = ()


def read(values: np.ndarray, parameters, count: int) -> Reading | None:
    """The rotors among the outputs of one instance, values (n, k); None when there are none.

    count: rotors of the vehicle, 0 where the log does not say."""
    values = np.where(values == NO_COMMAND, 0.0, values)
    functions = motor_outputs(parameters)
    for driver, outputs in functions.items():
        picked = [n - 1 for n in in_order(outputs)]
        if picked and max(picked) < values.shape[1]:
            reading = _scaled(values[:, picked], picked, driver, parameters)
            if reading is not None:
                return reading
    can = set(functions) == {CAN} or (not functions and parameters.get("UAVCAN_ENABLE", 0) >= 3)
    driver = CAN if can and not parameters.get("DSHOT_CONFIG", 0) > 0 else ""
    if 0 < count <= values.shape[1]:
        picked = list(range(count))
        reading = _scaled(values[:, picked], picked, driver, parameters)
        if reading is not None:
            return reading
    moving = [k for k in range(values.shape[1]) if _moves(values[:, k])]
    moving = [k for k in moving if _scaled(values[:, [k]], [k], driver, parameters, moving=True)]
    return _scaled(values[:, moving], moving, driver, parameters) if moving else None


def best(instances: Iterable[tuple[str, Any]], parameters, count: int) -> tuple[str, np.ndarray, Reading] | None:
    """(source, time, reading) of the instance that drives rotors; None when none does. instances: source -> (time, outputs) or None."""
    readings = [
        (source, data[0], reading)
        for source, data in instances
        if data is not None and (reading := read(data[1], parameters, count)) is not None
    ]
    return max(readings, key=lambda one: (one[2].named, one[2].swing), default=None)


def _moves(column: np.ndarray) -> bool:
    fine = column[np.isfinite(column)]
    return fine.size > 0 and (unique(fine).size >= LEAST_VALUES or float(np.abs(fine).max()) <= 1.01)


def _scaled(values, picked, driver, parameters, moving=False) -> Reading | None:
    """The picked outputs as pulses or shares, whichever their values and the log's parameters allow; None when neither.

    moving: only when all of them move as rotors do."""
    reading = _in_unit(values, picked, driver, parameters, moving)
    return None if reading is None else reading._replace(outputs=tuple(k + 1 for k in picked))


def _in_unit(values, picked, driver, parameters, moving) -> Reading | None:
    low, top = _extremes(values)
    if not np.isfinite(top).all():
        return None
    named = bool(driver) and f"{driver}_FUNC{picked[0] + 1}" in parameters
    if (np.abs(top) <= 1.01).all() and (low >= -1.01).all():
        return _shares(values, low, top, named)
    start = _extremes(np.where(values == 0.0, np.nan, values))[0]  # 0 is no pulse at all
    if driver != CAN and (start >= PULSES_US[0]).all() and (top <= PULSES_US[1]).all():
        swing = top - low
        if moving and swing.min() <= MOVING_US:
            return None
        return Reading(values, "us", float(swing.mean()) / 1e3, named, pulse_limits(parameters, driver or PWM, picked))
    if (top > CAN_FULL).any() or (low < 0.0).any() or (top < 2.0).any():
        return None
    return _counts(values, low, top, picked, driver, parameters, named)


def _shares(values, low, top, named) -> Reading | None:
    swing = top - low
    if swing.max() <= MOVING:
        return None
    if low.min() < -0.05:  # old HIL and lock-step SITL drivers
        return Reading((values + 1.0) / 2.0, "1", float(swing.mean()) / 2.0, named, {"motors_scaled": "-1..1"})
    return Reading(values, "1", float(swing.mean()), named)


def _counts(values, low, top, picked, driver, parameters, named) -> Reading | None:
    """Counts of a UAVCAN or DShot command as shares of full; UAVCAN_EC_MINn and MAXn count where logged."""
    can = driver == CAN or top.max() > DSHOT_FULL
    least, most = _can_range(parameters, picked) if can else (np.zeros(len(picked)), np.full(len(picked), DSHOT_FULL))
    span = most - least
    if ((top - low) < MOVING * span).all():
        return None
    bus = "UAVCAN" if can else "DShot"
    note = f"actuator_outputs are {bus} counts; {most.max():.0f} was taken as full command"
    shares = np.maximum((values - least) / span, 0.0)
    return Reading(shares, "1", float(((top - low) / span).mean()), named, {"motors_scaled": bus}, note)


def _can_range(parameters, picked) -> tuple[np.ndarray, np.ndarray]:
    """(k,) least and most counts of UAVCAN outputs, from 0."""
    ends = (("MIN", 0.0), ("MAX", CAN_FULL))
    least, most = np.array([[parameters.get(f"{CAN}_{end}{k + 1}", d) for k in picked] for end, d in ends], float)
    return (least, most) if (least < most).all() else (np.zeros(len(picked)), np.full(len(picked), CAN_FULL))


def count_range(parameters, driver: str, picked) -> tuple[np.ndarray, np.ndarray] | None:
    """(k,) least and most counts of a driver's outputs, from 0, as far as its parameters say that it takes counts; None for pulses."""
    if driver == CAN:
        return _can_range(parameters, picked)
    if any(parameters.get(f"{driver}_TIM{k}", 0) in DSHOT_TIMERS for k in range(TIMERS)):
        return np.zeros(len(picked)), np.full(len(picked), DSHOT_FULL)
    return None


def _extremes(values) -> tuple[np.ndarray, np.ndarray]:
    """(k,) low and high end of each column's finite values, one value in 200 left out for damage; NaN without any."""
    ends = np.full((2, values.shape[1]), np.nan)
    for k in range(values.shape[1]):
        fine = np.sort(values[np.isfinite(values[:, k]), k])
        if fine.size:
            out = fine.size // 200
            ends[:, k] = fine[out], fine[fine.size - 1 - out]
    return ends[0], ends[1]


def pulse_limits(parameters, driver: str, picked) -> dict:
    """facts pwm_min and pwm_max in us: of the driver's outputs `picked`, from 0 (PWM_MAIN_MINn, 1.13+), PWM_MAIN_MIN (1.11+), PWM_MIN
    (older), as logged."""
    facts = {}
    for fact, word in (("pwm_min", "MIN"), ("pwm_max", "MAX")):
        each = [parameters.get(f"{driver}_{word}{k + 1}", 0) for k in picked]
        usable = [v for v in (*each, parameters.get(f"{PWM}_{word}", 0), parameters.get(f"PWM_{word}", 0)) if v > 0]
        if usable:
            facts[fact] = float(usable[0])
    return facts


def tracks(values: np.ndarray, step: float) -> list[np.ndarray]:
    """Indices of the samples of each publisher in values (n, k), in order; a single one where they do not alternate.

    step: a change from sample to sample below which nothing is a jump, in the unit of the values."""
    everything = [np.arange(len(values))]
    if len(values) < 3 * THERE_AND_BACK or not np.isfinite(values).all():
        return everything
    jump = np.abs(np.diff(values, axis=0)).max(axis=1)
    across = np.abs(values[2:] - values[:-2]).max(axis=1)
    lone = (np.minimum(jump[1:], jump[:-1]) > np.maximum(ALTERNATION * across, step)).nonzero()[0] + 1
    if lone.size < THERE_AND_BACK:
        return everything
    rows = values.tolist()
    last = [rows[lone[0] - 1], rows[lone[0]]]
    member = np.zeros(len(rows), bool)
    for i, row in enumerate(rows):
        near, far = (max(abs(a - b) for a, b in zip(row, other)) for other in last)
        member[i] = far < near
        last[int(member[i])] = row
    series = [np.flatnonzero(~member), np.flatnonzero(member)]
    return series if min(len(f) for f in series) >= THERE_AND_BACK else everything


def flown(values: np.ndarray, found: list[np.ndarray]) -> np.ndarray | None:
    """The one of two series that moves while the other rests: the motors' actual commands. None when both move."""
    if len(found) == 1:
        return found[0]
    moves = [float(median(np.abs(np.diff(values[i], axis=0)).max(axis=1))) for i in found]
    return found[int(np.argmax(moves))] if min(moves) <= AT_REST * max(moves) else None


def escs(time: np.ndarray, table: Mapping[str, np.ndarray], count: int, notes: list[str]) -> Signal | None:
    """The signal `esc` of one esc_status topic; None without data. time (m,) s; count: rotors, 0 where unknown."""
    there = [i for i in range(MOST_ESCS) if f"esc[{i}].esc_rpm" in table]
    if not there or not time.size:
        return None
    place = _places(table, there)
    order = [place[k] for k in sorted(place)][: count or MOST_ESCS]
    online = None
    if "esc_online_flags" in table and np.asarray(table["esc_online_flags"]).any():
        flags = np.asarray(table["esc_online_flags"]).astype(np.int64)
        online = np.stack([(flags >> i) & 1 for i in order], axis=1) > 0
    return esc_columns.numbered(time, table, "esc[{}].", ESC_FIELDS, order, "esc_status", notes, online)


def _places(table: Mapping[str, np.ndarray], escs: list[int]) -> dict[int, int]:
    """Rotor, from 0 -> index of its report: by function, else by address, else as they come."""
    place = {}
    for i in escs:
        functions = np.asarray(table.get(f"esc[{i}].actuator_function", [0])).astype(int)
        motors = functions[(functions >= MOTOR_1) & (functions <= MOTOR_12)]
        if motors.size:
            place.setdefault(int(np.bincount(motors).argmax()) - MOTOR_1, i)
    if place:
        return place
    used = int(np.max(table["esc_count"])) if "esc_count" in table and np.size(table["esc_count"]) else 0
    escs = escs[:used] if 0 < used < len(escs) else escs
    addresses = [int(median(np.asarray(table.get(f"esc[{i}].esc_address", [0])))) for i in escs]
    if sorted(addresses) in (list(range(len(escs))), list(range(1, len(escs) + 1))):
        return {address - min(addresses): i for address, i in zip(addresses, escs)}
    return dict(enumerate(escs))


def mixed(control: np.ndarray, parameters: Mapping[str, float]) -> np.ndarray | None:
    """Outputs (n, 4), shares of their range, that PX4 before 1.13 made of its rate controller's output on a quad.

    control: (n, 4), roll, pitch, yaw -1 to 1 and throttle 0 to 1. None where SYS_AUTOSTART names no quad of X or plus shape.

        y = M c, cut to 0..1;    u = y,  or with f = THR_MDL_FAC > 0 the solution of  (1 - f) u + f u^2 = y"""
    start, f = (int(parameters.get("SYS_AUTOSTART", 0)), float(parameters.get("THR_MDL_FAC", 0.0)))
    mixer = QUAD_X if start // 1000 == 4 or start in QUADS_X else QUAD_PLUS if start // 1000 == 5 else None
    if mixer is None:
        return None
    y = np.clip(control @ mixer.T, 0.0, 1.0)
    return y if not 0.0 < f <= 1.0 else (np.sqrt((1.0 - f) ** 2 + 4.0 * f * y) - (1.0 - f)) / (2.0 * f)
