"""Outliers that are damage of the log, not of the vehicle: lone values far from their neighbours.

A log's framing can be intact and a value in it wrong: one bit of one output is enough for a false fault. The motion of a vehicle leaves
more than one sample: a step stays, a ramp goes on, an oscillation comes back. So a sample x_i (or two in a row) is compared with the
samples around it:

    r_i = x_i - (the line between the samples before and after, at t_i),      D_i = the difference of these two

It is `lone` when |r_i| > 3 D_i, the neighbours agree with each other and not with it, and |r_i| > SCALES s_i, with s_i the median |r| of
the samples before, or of those on both sides, whichever is larger. Nothing later than `AHEAD` samples counts. Of white noise one value in
15,000 is lone by this, of smooth signals none.

A knock, a stick input or a gust leaves a single sample, too, in a slow log, but never in one column alone: all motors respond, several axes
shake. So a lone value is damage only when nothing else in its record, and none of the signals that are coupled with it, jumps at the same
time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base import medians
from rotorwatch.base.arrays import median
from rotorwatch.base.compiling.running import Definition
from rotorwatch.flight import Flight, Signal
from rotorwatch.logs import esc_columns, lone_values, series
from rotorwatch.logs.lone_values import BEFORE, FAR
from rotorwatch.logs.series import Impossible

LONE = Definition("lone", (medians, lone_values), (), ["base/medians.py", "logs/lone_values.py"])
JUMPS = 0.4  # share of the limit for lone values beyond which another value jumps with it
ALONE = 0.125  # ... and the same as a share of the lone value's deviation
ALONE_IN_AXIS = 0.33  # ... among motors, which share every error of roll, pitch, yaw and thrust
HABIT = 0.05  # share of a signal's values beyond which it is not damage but the signal's nature
FITTED, FIT_EVERY = 512, 64  # samples for the fit of the mixer's matrix, and its interval
PARTNER_S = 0.1  # a command further than this from any output of the controller is not compared
PIECE, MARGIN = 1 << 15, 64  # samples processed at a time; margin on each side
NAMED = 3  # times that a sentence lists
# Share and number of lone values of a signal beyond which chance does not explain them; and number of impossible ones beside them
HEAVY, LEAST_HEAVY = 0.002, 5

# The least |r| that could affect a diagnosis, in the unit of the signal. Other signals are not checked.
# In this order: the outputs are compared with a cleaned control signal.
FLOORS = {
    "control": 0.01,
    "motors": 0.006,  # of the range; 6 us
    "gyro": 0.05,
    "rates": 0.05,
    "accel": 0.5,
    "attitude": 0.1,
    "velocity": 1.0,
    "battery": 0.1,
    "lift": 0.01,
    "esc": 30.0,
}
COUPLED = ("motors", "control", "gyro", "rates", "accel")


def checked(flight: Flight, progress: Callable[[float], object] | None = None) -> Flight:
    """The flight with impossible values and lone ones marked invalid, named in its warnings and counted in facts["damage"]; `checked`.

    facts["damage"]: {signal: share of its values that were lone}, only of signals that had any. Lone values of a flight that has been
    checked before are left alone. progress: called with the finished share, 0..1."""
    flight = possible(flight)
    if flight.checked:
        return flight
    flight = replace(_once(flight), checked=True)
    signals, warnings, shares, heavy = dict(flight.signals), [], {}, []
    if "motors" in signals:
        signals["motors"], record_notes = _whole_records(signals["motors"])
        warnings += record_notes
    known = {name: signals[name] for name in FLOORS if name in signals}
    tell, sizes = progress or (lambda share: None), {}
    for done, (name, s) in enumerate(known.items(), 1):
        sizes[name] = _size(s.time, s.values, s.valid, _floor(name, s), name == "motors")
        tell(0.7 * done / len(known))
    for done, (name, signal) in enumerate(known.items()):
        tell(0.7 + 0.3 * done / len(known))
        wrong = _unsupported(name, signals, sizes)
        if name == "motors" and "control" in signals:
            wrong |= _beyond_mixer(signals, wrong)
        if name == "battery":
            wrong[:, 1:] = False  # current jumps in normal flight
        count = int(np.count_nonzero(wrong))
        share = count / max(int(np.count_nonzero(signal.valid)), 1)
        if not count or share > HABIT:
            continue
        signals[name], shares[name] = replace(signal, valid=signal.valid & ~wrong), share
        each = "value that does" if count == 1 else "values that do"
        warnings.append(f"{name} ({signal.source}): {count} {each} not fit the neighbouring values ignored.")
        if count >= LEAST_HEAVY and share > HEAVY:
            heavy.append(name)
    # Tumbling, tuning and desyncs cause jolts as well: only impossible values prove damage of the log.
    impossible = sum(warning.number for warning in flight.warnings if isinstance(warning, Impossible))
    if heavy and impossible >= LEAST_HEAVY:
        warnings.append(
            f"This log is damaged: {impossible} of its records or values are impossible, and too many of {', '.join(heavy)} do not fit "
            "the neighbouring values for this to be chance. Copy the log from the autopilot again."
        )
    if not shares and not warnings and not impossible:
        return flight
    facts = {**flight.facts, "damage": shares} if shares else flight.facts
    return replace(flight, signals=signals, warnings=(*map(str, flight.warnings), *warnings), facts=facts)


def _once(flight: Flight) -> Flight:
    """The flight without samples that repeat the one before, including its time, in signals where that is frequent: a bridge or a merge of
    files has written records twice. Sampling rates and standard errors would count them twice."""
    signals, often = dict(flight.signals), []
    for name, signal in signals.items():
        again = np.zeros(len(signal), bool)
        again[1:] = signal.time[1:] == signal.time[:-1]
        if np.count_nonzero(again) <= HABIT * len(signal):
            continue
        again[1:] &= (signal.values[1:] == signal.values[:-1]).all(axis=1)
        if np.count_nonzero(again) > HABIT * len(signal):
            keep = ~again
            signals[name] = signal.with_arrays(signal.time[keep], signal.values[keep], signal.valid[keep])
            often.append(name)
    if not set(often) & set(COUPLED):  # counts and levels may be constant
        return flight
    warning = f"The log has duplicate records, with the same time and values ({', '.join(often)}): each was taken once."
    messages = tuple(m for k, m in enumerate(flight.messages) if not k or m != flight.messages[k - 1])
    return replace(flight, signals=signals, messages=messages, warnings=(*flight.warnings, warning))


def possible(flight: Flight) -> Flight:
    """The flight without values that no sensor or autopilot can mean and with non-decreasing time, as file readers return it, with
    warnings. A signal with nothing left is dropped."""
    signals, notes = dict(flight.signals), list[str]()
    for name, signal in flight.signals.items():
        limit = _limit(name, signal)
        if len(signal) and np.isfinite(signal.time).all() and (signal.time[1:] >= signal.time[:-1]).all():
            most, parts = np.minimum(limit, series.LARGEST), range(0, len(signal), PIECE)
            if all((np.abs(signal.values[k : k + PIECE]) <= most).all() for k in parts):
                continue
        source = signal.source or name
        one = series.build(signal.time, signal.values, signal.columns, signal.unit, signal.frame, source, limit, notes, signal.valid)
        signals.pop(name)
        if one is not None:
            signals[name] = one
    if not notes and len(signals) == len(flight.signals):
        return flight
    end = flight.duration if np.isfinite(flight.duration) else series.end_of(signals)
    return replace(flight, signals=signals, duration=end, warnings=(*flight.warnings, *notes))


def _limit(name: str, signal: Signal):
    """The largest plausible absolute value, of all columns or of each."""
    if name == "esc":
        return np.array([max(map(abs, esc_columns.LIMITS.get(c.rstrip("0123456789"), (np.inf,)))) for c in signal.columns])
    return series.MOTORS.get(signal.unit, np.inf) if name == "motors" else series.SHAPES.get(name, (np.inf,))[-1]


def _whole_records(motors: Signal) -> tuple[Signal, list[str]]:
    """The outputs without lone records in which most of them are no command (0: off, or impossible); and a warning.

    Rotors that stop take longer, and outputs that are switched off stay off."""
    valid = motors.valid
    if len(motors) < 3 or valid.shape[1] < 2:
        return motors, []
    broken = np.asarray(2 * valid.sum(axis=1) <= valid.shape[1])
    whole = np.asarray(valid.all(axis=1))
    at = np.flatnonzero(broken[1:-1] & whole[:-2] & whole[2:]) + 1
    at = at[motors.time[at + 1] - motors.time[at - 1] < FAR * max(float(median(np.diff(motors.time))), 1e-6)]
    if not at.size or at.size > HABIT * len(motors):
        return motors, []
    cleaned = valid.copy()
    cleaned[at] = False
    when = ", ".join(f"{t:.1f} s" for t in motors.time[at[:NAMED]]) + (" and later" if at.size > NAMED else "")
    what = "record in which most outputs are" if at.size == 1 else "records in which most outputs are"
    return replace(motors, valid=cleaned), [f"motors ({motors.source}): {at.size} {what} no command dropped, at {when}."]


def _unsupported(name: str, signals: Mapping[str, Signal], sizes: Mapping[str, Lone]) -> np.ndarray:
    """(n, k) bool: lone values of a signal without a jump in any coupled signal. sizes: `_size` of every signal."""
    signal, size = signals[name], sizes[name]
    rows, columns, off = size
    if not rows.size or name == "attitude":  # one wrong angle changes the whole quaternion
        return size.marked(signal.values.shape)
    support = np.zeros(rows.size)
    for other in {name, *(COUPLED if name in COUPLED else ())} & signals.keys():
        partner = signals[other]
        if other != name and (partner.unit, partner.source) == (signal.unit, signal.source):
            continue  # the same numbers by another name
        at = rows if other == name else _nearest(partner.time, signal.time[rows])
        skip = columns if other == name else np.full(rows.size, -1)
        jumps = _support(partner.time, partner.values, partner.valid, sizes[other], _floor(other, partner), at, skip)
        support = np.maximum(support, jumps)
    return size.part(support < np.maximum(JUMPS, off * ALONE)).marked(signal.values.shape)


def _beyond_mixer(signals: Mapping[str, Signal], already: np.ndarray) -> np.ndarray:
    """(n, k) bool: motor commands that are lone in the part that the rate controller's output does not explain.

    In a turbulent flight the commands are rough, but the mixer makes all of them from the same four numbers: commands = W (roll, pitch,
    yaw, thrust, thrust^2, 1), W by least squares for each `FIT_EVERY` samples and the `FITTED` before them (without them, W is not yet
    known for a manoeuvre's first occurrence)."""
    motors, control = signals["motors"], signals["control"]
    control = control.wholes()
    if len(control) < FIT_EVERY or len(motors) < FIT_EVERY:
        return np.zeros_like(already)
    when = control.time
    regressors = np.stack([np.interp(motors.time, when, c) for c in control.values.T], axis=1)
    regressors = np.column_stack([regressors, regressors[:, 3] ** 2, np.ones(len(motors))])
    near = np.abs(when[_nearest(when, motors.time)] - motors.time) < PARTNER_S
    known = near[:, None] & motors.valid & ~already
    rest = motors.values.copy()
    for start in range(0, len(motors), FIT_EVERY):
        block, first = slice(start, start + FIT_EVERY), max(0, start - FITTED)
        rows = np.flatnonzero(known[first : block.stop].all(axis=1)) + first
        weights = np.linalg.lstsq(regressors[rows], motors.values[rows], rcond=1e-6)[0]
        rest[block] -= regressors[block] @ weights
    return _without_others(motors.time, rest, known, _floor("motors", motors))


def _without_others(time, values, valid, floor: float) -> np.ndarray:
    """(n, k) bool: lone values in rows where no other column jumps nearly as far, as all do that one axis moves."""
    size = _size(time, values, valid, floor)
    support = _support(time, values, valid, size, floor, size.rows, size.columns)
    return size.part(support < np.maximum(JUMPS, size.sizes * ALONE_IN_AXIS)).marked(values.shape)


def lone(time, values, floor: float, valid=None) -> np.ndarray:
    """(n, k) bool: values (n, k) at times (n,) that fit neither the samples before nor those after; see above.

    floor: the least deviation that counts. valid: (n, k) bool, the values to check (default: all that are finite)."""
    values = np.asarray(values, float)
    return _size(np.asarray(time, float), values, np.isfinite(values) if valid is None else valid, floor).marked(values.shape)


class Lone(NamedTuple):
    """Lone values: their rows and columns (m,), in the order of rows, and the deviation of each, relative to the limit for lone values."""

    rows: np.ndarray
    columns: np.ndarray
    sizes: np.ndarray

    def part(self, keep: np.ndarray) -> Lone:
        """Those that are kept (m,) bool."""
        return Lone(self.rows[keep], self.columns[keep], self.sizes[keep])

    def marked(self, shape: tuple[int, ...]) -> np.ndarray:
        """A table of that shape, True where a value is lone."""
        mask = np.zeros(shape, bool)
        mask[self.rows, self.columns] = True
        return mask


def _size(time, values, valid, floor: float, alike: bool = False) -> Lone:
    """The lone ones of values (n, k).

    alike: columns have the same roughness, as motor commands of one mixer do. A constant one (a motor at idle) does not show its roughness
    in motion, so at least the mean of the moving ones is taken."""
    time, values, valid = np.ascontiguousarray(time, float), np.ascontiguousarray(values, float), np.ascontiguousarray(valid, bool)
    whole = bool(valid.all())
    near = np.array([_near(time if whole else time[column]) for column in (valid[:, :1] if whole else valid).T])
    near = np.ascontiguousarray(np.broadcast_to(near, valid.shape[1]))
    if len(time) <= PIECE or not whole:
        return _size_of(time, values, valid, floor, alike, near)
    parts = []
    for start in range(0, len(time), PIECE):
        first = max(start - MARGIN, 0)
        part = slice(first, start + PIECE + MARGIN)
        piece = _size_of(time[part], values[part], valid[part], floor, alike, near)
        inner = piece.part((piece.rows >= start - first) & (piece.rows < start - first + PIECE))
        parts.append(inner._replace(rows=inner.rows + first))
    return Lone(*map(np.concatenate, zip(*parts, strict=True)))


def _near(time: np.ndarray) -> float:
    """Largest distance of a neighbour [s]."""
    return FAR * max(float(median(np.diff(time))), 1e-6) if len(time) > 1 else 0.0


def _size_of(time, values, valid, floor: float, alike: bool, near: np.ndarray) -> Lone:
    """The same of a part of a table. near (k,): of all of it."""
    size, at = np.empty(values.shape), np.empty(len(time), np.int32)
    LONE.call(lone_values.lone, *values.shape, time, values, valid, floor, alike, near, np.empty(values.shape), at, size)
    rows, columns = np.nonzero(size)
    return Lone(rows, columns, size[rows, columns])


def _support(time, values, valid, size: Lone, floor: float, at, own) -> np.ndarray:
    """Jump of the samples `at` in any column but `own`, in the unit of `_size`: against the line between their neighbours where those are
    valid and not lone themselves; invalid values do not jump."""
    if not at.size:
        return np.zeros(0)
    # Only the surroundings of the samples are used; `_scale` reaches furthest.
    if len(time) > PIECE:
        rows = _around_them(valid, size, at)
        there = np.isin(size.rows, rows)
        size = Lone(np.searchsorted(rows, size.rows[there]), size.columns[there], size.sizes[there])
        time, values, valid, at = time[rows], values[rows], valid[rows], np.searchsorted(rows, at)
    marked, jumps = np.zeros(values.shape), np.zeros(at.size)
    marked[size.rows, size.columns] = size.sizes
    tables = [np.ascontiguousarray(x, kind) for x, kind in ((time, float), (values, float), (valid, bool))]
    wanted = at.size, at.astype(np.int32), np.broadcast_to(own, at.shape).astype(np.int32)
    LONE.call(lone_values.support, *values.shape, *tables, marked, floor, *wanted, np.empty(values.shape), np.empty(values.shape), jumps)
    return jumps


def _around_them(valid: np.ndarray, size: Lone, at: np.ndarray) -> np.ndarray:
    """(m,) rows around the samples `at`, in order: enough that in each stretch the first and the last row are valid in every column and not
    lone, or the table ends there."""
    calm = np.asarray(valid.all(axis=1))
    calm[size.rows] = False
    n, reach = len(valid), BEFORE + 2
    while True:
        starts, stops = np.maximum(at - reach, 0), np.minimum(at + reach + 1, n)
        apart = starts[1:] > stops[:-1]
        starts, stops = starts[np.append(True, apart)], stops[np.append(apart, True)]
        if (calm[starts] | (starts == 0)).all() and (calm[stops - 1] | (stops == n)).all():
            lengths = stops - starts
            return np.arange(lengths.sum()) + np.repeat(starts - np.cumsum(lengths) + lengths, lengths)
        reach *= 2


def _nearest(time: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index of the sample nearest to each wanted time."""
    if time.size < 2:
        return np.zeros(wanted.shape, int)
    after = np.clip(np.searchsorted(time, wanted), 1, time.size - 1)
    return after - (wanted <= 0.5 * (time[after] + time[after - 1]))


def _floor(name: str, signal: Signal) -> float:
    return 1e3 * FLOORS[name] if name == "motors" and signal.unit == "us" else FLOORS[name]
