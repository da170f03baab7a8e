"""From raw columns to a Signal: canonical columns and units, non-decreasing time, implausible values masked.

Shared by the readers; knows nothing about any file format.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import pairwise

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.flight import Message, Signal

"""Standard gravity, m/s^2."""

EARTH_M, EARTH_E2 = 6_378_137.0, 6.69437999e-3
"""WGS 84: equatorial radius, and the square of the eccentricity."""

LARGEST = np.finfo(np.float64).max


class Impossible(str):
    """A warning that only damage explains: values, time stamps and file positions that no vehicle and no autopilot can have produced.
    number: of these."""

    number: int

    def __new__(cls, number: int, text: str) -> Impossible:
        one = super().__new__(cls, text)
        one.number = number
        return one


DAY_S = 86_400.0
"""A gap longer than this is a damaged time stamp, not a pause between two flights."""

FEW, END_GAPS = 5, 20.0
"""So few samples beyond a gap of so many typical intervals at an end of a signal may have damaged time stamps."""
LEAST_GAP_S, LONG_GAP_S, BIT_WITHIN_S = 4.0, 600.0, 0.2

# name: columns, unit, frame, largest plausible absolute value.
SHAPES = {
    "control": (("roll", "pitch", "yaw", "thrust"), "1", "FRD", 10.0),
    "gyro": (("x", "y", "z"), "rad/s", "FRD", 100.0),
    "rates": (("x", "y", "z"), "rad/s", "FRD", 100.0),
    "rates_wanted": (("x", "y", "z"), "rad/s", "FRD", 100.0),
    "accel": (("x", "y", "z"), "m/s^2", "FRD", 1000.0),
    "raw_accel": (("x", "y", "z"), "m/s^2", "FRD", 1000.0),
    "raw_gyro": (("x", "y", "z"), "rad/s", "FRD", 100.0),
    "attitude": (("w", "x", "y", "z"), "1", "FRD->NED", 1.1),
    "attitude_wanted": (("w", "x", "y", "z"), "1", "FRD->NED", 1.1),
    "velocity": (("n", "e", "d"), "m/s", "NED", 300.0),
    "position": (("n", "e", "d"), "m", "NED", 1e6),
    "throttle": (("out",), "1", "", 2.0),
    "battery": (("voltage", "current"), "V,A", "", 5000.0),
    "gps": (("n", "e", "d", "speed"), "m,m,m,m/s", "NED", 1e6),
    "baro": (("up",), "m", "", 1e5),
    "lift": (("lift_max", "voltage_ratio", "limit"), "1", "", 100.0),
    "vibration": (("level",), "m/s^2", "", np.inf),
    "clipping": (("count",), "1", "", np.inf),
    "innovations": (("velocity", "position", "height", "compass"), "1", "", np.inf),
}
MOTORS = {"us": 3000.0, "1": 1.5}
"""The same of motor commands, by their unit."""


def signal(name, time, values, source, notes, valid=None) -> Signal | None:
    """The Signal `name` of SHAPES from time (n,) s and values (n, k); None when no usable sample is left.

    valid: (n,) or (n, k) bool or None. Implausible values become invalid; damaged time stamps are dropped; both are reported in `notes`, a
    list of sentences that this appends to."""
    columns, unit, frame, limit = SHAPES[name]
    return build(time, values, columns, unit, frame, source, limit, notes, valid)


def motors(time, values, unit, source, notes, valid=None) -> Signal | None:
    """The Signal `motors`: values (n, rotors) in us or in shares of full command (unit "1")."""
    values = np.asarray(values, float)
    columns = tuple(f"r{k + 1}" for k in range(values.shape[1]))
    return build(time, values, columns, unit, "", source, MOTORS[unit], notes, valid)


def floats(values) -> np.ndarray:
    """The values as float64. A damaged 32-bit float may be a signalling NaN, which becomes a regular NaN without a warning."""
    with np.errstate(invalid="ignore"):
        return np.asarray(values, np.float64)


def build(time, values, columns, unit, frame, source, limit, notes, valid=None) -> Signal | None:
    """A Signal with any columns; see `signal`. limit: largest plausible absolute value, of all columns or of each."""
    time, values = floats(time), floats(values)
    if values.ndim == 1:
        values = values[:, None]
    with np.errstate(invalid="ignore"):
        fine = np.abs(values) <= np.minimum(limit, LARGEST)
        wild = 0 if fine.all() else int(np.count_nonzero(np.isfinite(values) & ~fine))
    if wild:
        notes.append(Impossible(wild, f"{source}: {wild} impossible value{'s' if wild > 1 else ''} ignored"))
    if valid is not None:
        valid = np.asarray(valid, bool)
        fine &= valid[:, None] if valid.ndim == 1 else valid
    keep = steady(time)
    if keep.size < time.size:
        lost = f"{time.size - keep.size} of {time.size} samples"
        notes.append(f"{source}: {lost} dropped because their time is impossible or runs backwards")
    if keep.size == 0 or not fine[keep].any():
        return None
    if keep.size == time.size and fine.all():
        return Signal(time, values, columns, unit, frame, source, fine)
    return Signal(time[keep], np.where(fine, values, 0.0)[keep], columns, unit, frame, source, fine[keep])


def steady(time: np.ndarray) -> np.ndarray:
    """Indices of the most samples that form non-decreasing times without a gap of more than a day.

    The longest non-decreasing subsequence, so that a single wild stamp costs one sample, not all that follow it. Order does not help at
    either end: there a few samples beyond a gap are rejected (`within_ends`)."""
    step = time[1:] - time[:-1]
    if ((step >= 0.0) & (step <= DAY_S)).all() and np.isfinite(time[:1]).all():  # the usual case; NaN fails
        return np.arange(time.size)[within_ends(time)]
    index = np.flatnonzero(np.isfinite(time))
    t = time[index]
    if t.size > 1 and (np.diff(t) < 0).any():
        index = index[_longest_rise(t)]
        t = time[index]
    gaps = np.flatnonzero(np.diff(t) > DAY_S) + 1
    if gaps.size:
        pieces = np.split(np.arange(t.size), gaps)
        index = index[max(pieces, key=len)]
    return index[within_ends(time[index])]


def within_ends(t: np.ndarray) -> slice:
    """Slice of non-decreasing times t [s] without up to `FEW` samples beyond a `wrong_gap` at either end."""
    if t.size < 4 * FEW:
        return slice(None)
    steps = np.diff(t)
    usual = END_GAPS * float(median(steps))
    first = [k for k in range(FEW) if steps[k] > usual and wrong_gap(steps[k])]
    last = [k for k in range(t.size - 1 - FEW, t.size - 1) if steps[k] > usual and wrong_gap(steps[k])]
    return slice(first[-1] + 1 if first else 0, last[0] + 1 if last else t.size)


def wrong_gap(gap_s: float) -> bool:
    """True if a gap before the last few stamps of a log, or after the first, is more likely damage than a real gap.

    It is when it is long, or when one bit of a stamp in us, ms or decimal digits makes it: one wrong bit in the last stamp makes minutes or
    days of flight. Logs that are closed long after the last sample, with a few records more, are common: their gap is of any length."""
    if not gap_s > LEAST_GAP_S:
        return False
    if gap_s > LONG_GAP_S:
        return True
    binary = [unit * 2.0 ** round(np.log2(gap_s / unit)) for unit in (1e-6, 1e-3)]
    power = 10.0 ** np.floor(np.log10(gap_s) + 1e-3)
    return any(abs(gap_s - bit) < BIT_WITHIN_S for bit in (*binary, *(power * k for k in (1, 2, 4, 8, 10))))


def _longest_rise(t: np.ndarray) -> np.ndarray:
    """Indices of a longest non-decreasing subsequence of t (patience sorting, O(n log n))."""
    tails: list[float] = []
    ends: list[int] = []
    before = np.full(t.size, -1)
    for i, value in enumerate(t.tolist()):
        k = bisect_right(tails, value)
        if k == len(tails):
            tails.append(value)
            ends.append(i)
        else:
            tails[k], ends[k] = value, i
        if k:
            before[i] = ends[k - 1]
    chain = np.empty(len(ends), int)
    i = ends[-1]
    for k in range(len(ends) - 1, -1, -1):
        chain[k] = i
        i = before[i]
    return chain


def quaternion(roll, pitch, yaw) -> np.ndarray:
    """(n, 4) scalar-first quaternion body FRD -> world NED from roll, pitch, yaw in rad (order yaw, pitch, roll)."""
    with np.errstate(invalid="ignore"):  # damaged angles
        half = [np.asarray(a) / 2 for a in (roll, pitch, yaw)]
        cr, cp, cy = map(np.cos, half)
        sr, sp, sy = map(np.sin, half)
    return np.stack(
        [cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy], axis=-1
    )


def unit_quaternion(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions (n, 4) scaled to length 1, and (n,) bool: True where they were quaternions (length 0.9 .. 1.1)."""
    q = floats(q)
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.sqrt(np.sum(q * q, axis=1))
        fine = np.abs(length - 1) < 0.1
    return np.where(fine[:, None], q / np.where(fine, length, 1.0)[:, None], 0.0), fine


def changes(time, state) -> list[tuple[float, float]]:
    """(time, value) of the first sample and of each one that differs from the sample before."""
    state = floats(state)
    if state.size == 0:
        return []
    at = np.r_[0, np.flatnonzero(state[1:] != state[:-1]) + 1]
    return [(float(time[i]), float(state[i])) for i in at]


WORDS = {"armed": ("disarmed", "armed"), "landed": ("in the air", "landed")}


def states(kind: str, time, state) -> list[Message]:
    """Messages of a state that is on or off, `armed` or `landed`: the first sample's, and one for each change."""
    return [Message(t, kind, WORDS[kind][int(v)], v) for t, v in changes(time, np.asarray(state) != 0)]


def rises(time, state) -> list[tuple[float, float]]:
    """(time, value) of each sample at which a state leaves 0; a state that never was 0 shows no event."""
    changes_ = changes(time, state)
    return [after for before, after in pairwise(changes_) if before[1] == 0.0 and np.isfinite(after[1])]


def stacked(table, fields) -> np.ndarray:
    """(n, k) floats: the given fields of a table, NaN for those that it lacks."""
    none = np.full(len(next(iter(table.values()))), np.nan)
    return np.stack([floats(table.get(f, none)) for f in fields], axis=1)


def gps(time, degrees, altitude, speed, fixed, source) -> Signal | None:
    """The Signal `gps` from latitude and longitude [degrees] (n, 2), altitude [m] and ground speed [m/s], (n,) each, NaN where unknown.

    fixed (n,) bool: while there was a fix. Positions are metres from the first one, so that no signal discloses the location on earth.
    Damage is dropped without a note: no verdict depends on this signal."""
    degrees, fixed = np.asarray(degrees, float), np.asarray(fixed, bool)
    with np.errstate(invalid="ignore"):
        fixed = fixed & (np.abs(degrees) <= [90.0, 180.0]).all(axis=1) & degrees.any(axis=1)
    if not fixed.any():
        return None
    first = int(np.argmax(fixed))
    sine, cosine = np.sin(np.radians(degrees[first, 0])), np.cos(np.radians(degrees[first, 0]))
    across = EARTH_M / np.sqrt(1.0 - EARTH_E2 * sine**2)  # radii of curvature, to the east and to the north
    along = across * (1.0 - EARTH_E2) / (1.0 - EARTH_E2 * sine**2)
    off = np.radians((degrees - degrees[first] + 180.0) % 360.0 - 180.0) * [along, across * cosine]
    values = np.column_stack([off, altitude[first] - altitude, speed])
    return signal("gps", time, np.where(fixed[:, None], values, np.nan), source, [])


def voltage_and_current(values: np.ndarray) -> np.ndarray:
    """(n, 2) bool: which of a battery's values (n, 2) were measured; autopilots log 0 V and -1 A for those that were not."""
    return np.column_stack([values[:, 0] > 0, values[:, 1] >= 0])


def fastest(*candidates: Signal | None) -> Signal | None:
    """The candidate with the highest rate; within 10 % the earlier one in the list wins."""
    best = None
    for signal in candidates:
        if signal is not None and (best is None or signal.rate_hz > 1.1 * best.rate_hz):
            best = signal
    return best


SHOWN = ("gps", "baro", "vibration", "clipping", "innovations", "raw_accel", "raw_gyro")
"""Signals that no rotor's thrust is assessed by: a log of them alone holds no flight, and they do not prolong one."""


def end_of(signals) -> float:
    """Time of the last sample of any signal that is used beyond display, s; 0 without signals."""
    return max((float(s.time[-1]) for name, s in signals.items() if len(s) and name not in SHOWN), default=0.0)
