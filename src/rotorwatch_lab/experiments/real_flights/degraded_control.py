"""RflyBUAA's flights of a 250 mm quadrotor that goes on spinning with one to three rotors switched off, by controllers of its own.

What flew is the thrust that these demand (`tdes` of `unknown_logger`, N, 10 Hz, clockwise from the front right): the logged outputs stand
still. Of the flights whose controller does not know of the loss two switches are logged: `loe`, the effectiveness of rotor 1 in its middle
position, and 0 in its last, with which further rotors are off, as the position of `ch7` says; which ones is in the authors' notes on each
flight (exp_readulog_20221026.m, ..._20221027.m) and in their figures' legends (exp_readulog_hovering.m).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch_lab.experiments.real_flights import tables

FULL_N = 8.5  # full thrust of a rotor
LOST = 0.5  # effectiveness below which a rotor counts as switched off
FLOWN = 0.3  # share of hover's demand above which the vehicle flies
SHORTEST_S = 5.0  # of flight before it
# Rotors off beside rotor 1 with `loe` at 0, by the position of `ch7`: the neighbour, the opposite one, or both; of logs until and from
# CHANGED on, when the firmware's gains changed, too.
NEIGHBOUR, OPPOSITE = "4", "2"
MIDDLE, LAST = 1300, 1700  # us, from which `ch7` is in that position
CHANGED = "2022-10-26-23-45"
TOGETHER_S = 1.0  # rotors switched off within it are one fault
ORDER = (0, 2, 3, 1)  # of the demands, as PX4 counts rotors


def flights(checkout: Path, out: Path) -> Iterator[dict[str, Any]]:
    """Converts the flights of a checkout with a demand; yields rows for `evaluate` of those whose truth is logged."""
    vehicle = out / "vehicle.toml"
    tables.quad_x(vehicle, "h250", expo=0.0, u_min=0.0, u_max=1.0)
    folder = checkout / "ExperimentalData" / "Unknown"
    for source in sorted(folder.rglob("*.ulg")):
        target = out / ("_".join(source.relative_to(folder).parts).removesuffix(".ulg") + ".csv")
        for fault in convert(source, target):
            yield {"path": str(target), "vehicle": str(vehicle), "group": "rotors switched off"} | fault


def convert(source: Path, target: Path) -> list[dict[str, Any]]:
    """Write a flight as a table that `rotorwatch.read` understands; returns its faults, in order, none where the log does not tell when
    rotor 1 is switched off."""
    from pyulog import ULog

    try:
        log = {d.name: d.data for d in ULog(str(source)).data_list if d.multi_id == 0}
    except Exception:  # logs that break off
        return []
    demand = log.get("unknown_logger")
    if demand is None or "sensor_combined" not in log or "vehicle_attitude" not in log or "loe" not in demand:
        return []
    start = min(int(d["timestamp"][0]) for d in (demand, log["sensor_combined"]))
    clock = (demand["timestamp"].astype(np.int64) - start) / 1e6
    thrust = np.column_stack([demand[f"tdes[{k}]"] for k in ORDER]).astype(float) / FULL_N
    gone = np.flatnonzero((demand["loe"] < LOST) & (thrust.sum(axis=1) > FLOWN))
    before = np.flatnonzero((demand["loe"] >= LOST) & (thrust.sum(axis=1) > FLOWN))
    if not gone.size or not before.size or before[0] > gone[0] or clock[gone[0]] - clock[before[0]] < SHORTEST_S:
        return []
    sensors = log["sensor_combined"]
    time = (sensors["timestamp"].astype(np.int64) - start) / 1e6
    columns = {f"motor_{k + 1}": _rows(time, clock, thrust[:, k]) for k in range(4)}
    for name, key, unit in (("gyro", "gyro_rad", "rad_s"), ("accel", "accelerometer_m_s2", "m_s2")):
        columns |= tables.vector(name, np.column_stack([sensors[f"{key}[{k}]"] for k in range(3)]).astype(float), unit=unit)
    attitude = log["vehicle_attitude"]
    seen = (attitude["timestamp"].astype(np.int64) - start) / 1e6
    columns |= tables.quaternion(np.column_stack([_rows(time, seen, np.asarray(attitude[f"q[{k}]"], float)) for k in range(4)]))
    if (place := log.get("vehicle_local_position")) is not None:
        seen = (place["timestamp"].astype(np.int64) - start) / 1e6
        for name, keys, unit in (("velocity", ("vx", "vy", "vz"), "m_s"), ("position", "xyz", "m")):
            values = np.column_stack([_rows(time, seen, np.asarray(place[key], float)) for key in keys])
            columns |= tables.vector(name, values, "ned", unit)
    tables.write(target, columns, time)
    return faults(clock, demand["loe"], demand["ch7"], source.stem >= f"{source.stem.rpartition('_')[0]}_{CHANGED}")


def faults(clock: np.ndarray, loe: np.ndarray, ch7: np.ndarray, changed: bool) -> list[dict[str, Any]]:
    """The faults, by the positions of the switches (K,) at times (K,) s; those that begin together as one."""
    more = loe < 0.1
    neighbour = (ch7 < MIDDLE) | (ch7 > LAST) if changed else ch7 > LAST
    opposite = ch7 > MIDDLE if changed else (ch7 > MIDDLE) & (ch7 < LAST)
    found: list[dict[str, Any]] = []
    for rotor, off in (("1", loe < LOST), (NEIGHBOUR, more & neighbour), (OPPOSITE, more & opposite)):
        if not off.any():
            continue
        first = int(np.argmax(off))
        back = np.flatnonzero(~off[first:])
        end = float(clock[first + back[0]]) if back.size else None
        found.append({"rotor": rotor, "onset_s": float(clock[first]), "size": 1.0, "end_s": end})
    found.sort(key=lambda fault: fault["onset_s"])
    apart: list[dict[str, Any]] = []
    for fault in found:
        if apart and fault["onset_s"] - apart[-1]["onset_s"] < TOGETHER_S:
            apart[-1]["rotor"] += "+" + fault["rotor"]
        else:
            apart.append(fault)
    return apart


def _rows(time: np.ndarray, clock: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(T,) the values at the first row at or after each of their times; NaN elsewhere."""
    out = np.full(time.shape, np.nan)
    at, inside = np.searchsorted(time, clock), (clock >= time[0]) & (clock <= time[-1])
    out[at[inside]] = values[inside]
    return out
