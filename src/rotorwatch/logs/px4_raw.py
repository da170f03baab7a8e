"""Raw sensors in PX4's topics.

    sensor_accel_fifo, sensor_gyro_fifo   blocks of up to 32 samples dt us apart, the last at timestamp_sample, in counts of `scale`
    sensor_accel, sensor_gyro             each the mean of `samples` samples of the sensor

Message definitions: https://docs.px4.io/main/en/msg_docs/
"""

from __future__ import annotations

import numpy as np

from rotorwatch.flight import Signal
from rotorwatch.logs import raw_sensors, series

TOPICS = ("sensor_accel_fifo", "sensor_gyro_fifo", "sensor_accel", "sensor_gyro")
MOST = 32  # samples of a block


def signals(topics) -> dict[str, Signal]:
    """raw_accel and raw_gyro, as far as there are any. topics: px4_topics.Topics."""
    found = {}
    for kind in ("accel", "gyro"):
        signal = _blocks(topics, kind) or _means(topics, kind)
        if signal is not None:
            found[f"raw_{kind}"] = signal
    return found


def _sampled(time: np.ndarray, table) -> np.ndarray:
    """Times [s] at which the samples were taken."""
    if "timestamp_sample" not in table:
        return time
    early = (np.asarray(table["timestamp"]).astype(np.int64) - np.asarray(table["timestamp_sample"]).astype(np.int64)) * 1e-6
    return time - np.where((early >= 0.0) & (early < 1.0), early, 0.0)


def _blocks(topics, kind: str) -> Signal | None:
    name = f"sensor_{kind}_fifo"
    data = topics.table(name, "dt", "scale", "samples", "x[0]", "y[0]", "z[0]")
    if data is None or not data[0].size:
        return None
    time, table = data
    step, scale, count = (np.asarray(table[field], float) for field in ("dt", "scale", "samples"))
    fine = np.isfinite(step) & (step > 0.0) & (step < 1e5) & np.isfinite(scale) & (count >= 1) & (count <= MOST)
    rows = np.flatnonzero(fine)
    if not rows.size:
        return None
    end = _sampled(time, table)[rows]
    times, row, place = raw_sensors.spread(end, step[rows] * 1e-6, count[rows].astype(int))
    values = np.empty((times.size, 3))
    for k, axis in enumerate("xyz"):
        for at in range(MOST):
            here = place == at
            if here.any() and f"{axis}[{at}]" in table:
                values[here, k] = np.asarray(table[f"{axis}[{at}]"], float)[rows[row[here]]]
    return raw_sensors.build(f"raw_{kind}", times, values * scale[rows[row], None], name)


def _means(topics, kind: str) -> Signal | None:
    name = f"sensor_{kind}"
    data = topics.table(name, "x", "y", "z")
    if data is None:
        return None
    time, table = data
    return raw_sensors.build(f"raw_{kind}", _sampled(time, table), series.stacked(table, "xyz"), name)
