"""UTC of second 0 of a log, from the times of its GPS or ground station."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import numpy as np

from rotorwatch.base.arrays import median

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=timezone.utc)
WEEK_S = 604_800.0
# GPS time has no leap seconds: lead over UTC in s from that day on (IERS Bulletin C).
LEAP = (
    (datetime(2006, 1, 1, tzinfo=timezone.utc), 14),
    (datetime(2009, 1, 1, tzinfo=timezone.utc), 15),
    (datetime(2012, 7, 1, tzinfo=timezone.utc), 16),
    (datetime(2015, 7, 1, tzinfo=timezone.utc), 17),
    (datetime(2017, 1, 1, tzinfo=timezone.utc), 18),
)
EARLIEST, LATEST = (datetime(2008, 1, 1, tzinfo=timezone.utc).timestamp(), datetime(2100, 1, 1, tzinfo=timezone.utc).timestamp())
AGREE_S = 2.0  # most samples must agree on the start within this


def of_gps(week, milliseconds) -> np.ndarray:
    """(n,) s since 1970 UTC from GPS week and ms of that week."""
    since = np.asarray(week, float) * WEEK_S + np.asarray(milliseconds, float) * 1e-3
    unix = GPS_EPOCH.timestamp() + since
    return unix - np.select([unix >= day.timestamp() + leap for day, leap in reversed(LEAP)], [n for _, n in reversed(LEAP)], 13)


def start(time, unix) -> str | None:
    """UTC of second 0, ISO 8601 to the millisecond, from samples of log time [s] and UTC [s since 1970]; None when they disagree or give an
    impossible day."""
    time, unix = np.asarray(time, float), np.asarray(unix, float)
    fine = np.isfinite(time) & np.isfinite(unix) & (unix > EARLIEST) & (unix < LATEST)
    if not fine.any():
        return None
    offset = unix[fine] - time[fine]
    middle = float(median(offset))
    if np.mean(np.abs(offset - middle) < AGREE_S) < 0.5:
        return None
    return stamp(middle)


def stamp(unix: float) -> str:
    """s since 1970 -> '2026-11-22T14:03:27.120Z'."""
    moment = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=unix)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
