"""Raw sensors in DataFlash logs.

    ACC, GYR   TimeUS I SampleUS AccX.. or GyrX..     each sample of the sensor (LOG_BITMASK bit 19, INS_RAW_LOG_OPT), m/s^2, rad/s
    ISBH       TimeUS N type instance mul smp_cnt SampleUS smp_rate    header of a batch (INS_LOG_BAT_MASK): accelerometer 0 or gyro 1
    ISBD       TimeUS N seqno x y z                                    32 samples of batch N, times mul

Of several instances that with the most samples is taken: they are not mixed. Field lists: https://ardupilot.org/copter/docs/logmessages.html
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rotorwatch.flight import Signal
from rotorwatch.logs import raw_sensors

CHUNK = 32  # samples of an ISBD record
MOST_HZ = 100_000.0


def read(log, instance: Callable, table: Callable) -> dict[str, Signal]:
    """raw_accel and raw_gyro, as far as the log has them.

    log: with `counts` and `table`. instance(message, columns), table(message, columns, where): (time, values, codes) or None."""
    found: dict[str, Signal] = {}
    for kind, message, axes in (("raw_accel", "ACC", "Acc"), ("raw_gyro", "GYR", "Gyr")):
        rows = instance(message, ("TimeUS", "SampleUS", f"{axes}X", f"{axes}Y", f"{axes}Z")) if log.counts.get(message) else None
        if rows is not None:
            time, values = rows[0], rows[1]
            late = np.nan_to_num((values[:, 1] - values[:, 0]) * 1e-6)  # the record is written after the sample
            signal = raw_sensors.build(kind, time + np.where(np.abs(late) < 1.0, late, 0.0), values[:, 2:], message)
            if signal is not None:
                found[kind] = signal
    if log.counts.get("ISBH") and log.counts.get("ISBD"):
        for kind, signal in _batches(log, table).items():
            found.setdefault(kind, signal)
    return found


def _batches(log, table: Callable) -> dict[str, Signal]:
    """The same of batches."""
    rows = table("ISBH", ("N", "type", "instance", "mul", "TimeUS", "SampleUS", "smp_rate"), None)
    data = log.table("ISBD", ("N", "seqno", "x", "y", "z"))
    if rows is None or data is None or not {"N", "seqno", "x", "y", "z"} <= set(data.columns):
        return {}
    time, (number, what, sensor, scale, stamp, sample, rate) = rows[0], rows[1].T
    whole = np.isfinite(rows[1]).all(axis=1) & (scale > 0.0) & (rate > 1.0) & (rate < MOST_HZ)
    samples = np.stack([np.asarray(data[axis], float) for axis in "xyz"], axis=2)  # (records, 32, 3)
    batch, place = np.asarray(data["N"], float), np.asarray(data["seqno"], float)
    found: dict[str, Signal] = {}
    for kind, code in (("raw_accel", 0), ("raw_gyro", 1)):
        mine = np.flatnonzero(whole & (what == code))
        if not mine.size:
            continue
        numbers, counts = np.unique(sensor[mine], return_counts=True)
        mine = mine[sensor[mine] == numbers[np.argmax(counts)]]
        order = mine[np.argsort(number[mine], kind="stable")]
        at = np.clip(np.searchsorted(number[order], batch), 0, order.size - 1)
        records = np.flatnonzero((number[order[at]] == batch) & (place >= 0))
        head = order[at[records]]
        begin = time[head] + (sample[head] - stamp[head]) * 1e-6 + place[records] * CHUNK / rate[head]
        count = np.full(records.size, CHUNK)
        times, row, _ = raw_sensors.spread(begin, 1.0 / rate[head], count, first=True)
        values = samples[records].reshape(-1, 3) / scale[head][row, None]
        signal = raw_sensors.build(kind, times, values, "ISBD")
        if signal is not None:
            found[kind] = signal
    return found
