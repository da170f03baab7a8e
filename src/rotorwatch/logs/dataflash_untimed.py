"""A clock for logs without time stamps: ArduCopter 3.0 and 3.1 wrote none but the GPS receiver's own.

Records written once a loop keep the pace, the GPS clock says over spans of some seconds how long a loop was: a GPS record
is written up to a tenth of a second after its time, which must not stretch and squeeze what lies between two of them.
"""

from __future__ import annotations

import numpy as np

PACED = ("IMU", "ATT", "MOT", "CTUN")  # written at a steady rate
GPS_COLUMNS = ("Time", "TimeMS")  # ms of the GPS week: 3.0, 3.1
SPAN_S = 5.0  # between two places where the GPS clock is believed
GAP_S = 2.0  # a longer step of the GPS clock is damage or a lost fix, not time between two records
LOOP_S = 0.1  # MOT and CTUN are written ten times a second


def stamps(log) -> tuple[np.ndarray, str]:
    """((n,) us of each record, a sentence on where the times are from); NaN and an empty text when nothing keeps time."""
    n = log.record_count
    paced = {name: table.record for name in PACED if (table := log.table(name, ())) is not None and len(table) > 1}
    if not paced:
        return np.full(n, np.nan), ""
    beat = max(paced.values(), key=len)
    beats = np.interp(np.arange(n), beat, np.arange(beat.size))
    # Before the first and after the last beat records follow each other as fast as they do between.
    per_record = (beat.size - 1) / max(int(beat[-1] - beat[0]), 1)
    beats[: beat[0]] = (np.arange(beat[0]) - beat[0]) * per_record
    beats[beat[-1] :] = beat.size - 1 + (np.arange(beat[-1], n) - beat[-1]) * per_record
    at, time, source = _anchors(log, paced)
    if at is None or time[-1] <= time[0]:
        return np.full(n, np.nan), ""
    marks = np.r_[0, np.flatnonzero(np.diff(np.floor((time - time[0]) / SPAN_S)) > 0) + 1, time.size - 1]
    marks = np.unique(marks)
    places, times = beats[at[marks]], time[marks]
    rising = np.r_[True, np.diff(places) > 0]
    places, times = places[rising], times[rising]
    if places.size < 2:
        return np.full(n, np.nan), ""
    rate = (times[-1] - times[0]) / (places[-1] - places[0])
    seconds = np.interp(beats, places, times)
    seconds = np.where(beats < places[0], times[0] + (beats - places[0]) * rate, seconds)
    seconds = np.where(beats > places[-1], times[-1] + (beats - places[-1]) * rate, seconds)
    return (seconds - seconds[0]) * 1e6, f"This firmware logs no times; they were rebuilt from {source}."


def _anchors(log, paced) -> tuple[np.ndarray | None, np.ndarray, str]:
    """(record numbers, their times in s, what they are): GPS records, else those of the ten-times-a-second loop."""
    gps = log.table("GPS", GPS_COLUMNS)
    column = next((c for c in GPS_COLUMNS if gps is not None and c in gps and gps[c].dtype.kind in "iuf"), None)
    if gps is not None and column is not None and len(gps) > 10:
        steps = np.diff(gps[column].astype(float)) / 1e3
        real = (steps > 0) & (steps < GAP_S)
        if real.sum() > len(steps) / 2:
            usual = float(np.median(steps[real]))
            return (
                gps.record,
                np.r_[0.0, np.cumsum(np.where(real, steps, usual))],
                "the GPS clock and the order of records",
            )
    loop = next((paced[name] for name in ("MOT", "CTUN") if name in paced), None)
    if loop is None:
        return None, np.zeros(0), ""
    return loop, np.arange(loop.size) * LOOP_S, "the ten records a second that it writes"
