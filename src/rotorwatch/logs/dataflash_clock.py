"""A common clock for all records of a DataFlash log: damaged time stamps rejected, backward jumps removed.

Records of different types are logged slightly out of order, so small steps back are normal; large ones are not.

ArduCopter 3.0 and 3.1 wrote no time stamps but the GPS receiver's own (`rebuilt`): records written once a loop give the pace, and the GPS
clock gives the length of a loop over spans of some seconds. A GPS record is written up to a tenth of a second after its time, which must
not stretch or compress the records between two of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.logs.dataflash_binary import amount
from rotorwatch.logs.series import Impossible, wrong_gap

STEP_BACK_US = 0.5e6  # larger steps back are not due to record order
GAP_US = 0.4e6  # where stamps are in doubt, a silence this long starts a new stretch; less than a step back, so that a
# stamp that is ahead of its time never counts as the end of the stretch before it
LONG_GAP_US = 600e6  # a gap this long makes stamps doubtful
EDGE_RECORDS = 5  # up to so many records beyond a gap at an end of the log are rejected
RESET_PRICE = 20.0  # records that a clock reset must explain to be accepted
GAP_PRICE = 0.5  # below 1: a lone stamp in order with the others is accepted
DAY_US = 86400e6
LOOK_BACK = 64  # stretches of garbage in a row that can be skipped
PACED = ("IMU", "ATT", "MOT", "CTUN")  # written at a steady rate
GPS_COLUMNS = ("Time", "TimeMS")  # ms of the GPS week: 3.0, 3.1
SPAN_S = 5.0  # between two places where the GPS clock is used
GAP_S = 2.0  # a longer step of the GPS clock is damage or a lost fix, not time between two records
PIECE = 1 << 20  # records processed at a time
LOOP_S = 0.1  # MOT and CTUN are written ten times a second


class Clock(NamedTuple):
    """time: (n,) s since the first record, for every record. good: (n,) False where the stamp is garbage.

    start_us: boot time of the first record. jumps: times [s] where the log's clock was set back. Records without a
    stamp have the time of the last stamped record before them."""

    time: np.ndarray
    good: np.ndarray
    start_us: float
    end: float
    jumps: tuple[float, ...]
    warnings: tuple[str, ...]

    def of(self, records: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`time` and `good` of these records."""
        return self.time[records], self.good[records]


class SteadyClock(NamedTuple):
    """The clock of a log without damaged stamps, which are read on demand.

    stamps: of record numbers, us. bare: numbers of the records without a stamp, in order. start_us, end, jumps, warnings as of `Clock`."""

    stamps: Callable[[np.ndarray], np.ndarray]
    bare: np.ndarray
    start_us: float
    end: float
    jumps: tuple[float, ...] = ()
    warnings: tuple[str, ...] = ()

    def of(self, records: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same as `Clock.of`."""
        us = self.stamps(records)
        if (rows := np.flatnonzero(np.isnan(us))).size:
            begins = np.diff(self.bare, prepend=-2) > 1  # of those without a stamp in a row the first, and the record before it
            before = (self.bare[begins] - 1)[np.cumsum(begins) - 1][np.searchsorted(self.bare, records[rows])]
            us[rows] = np.where(before < 0, self.start_us, self.stamps(np.maximum(before, 0)))
        us -= self.start_us
        us /= 1e6
        return us, np.broadcast_to(np.True_, us.shape)


def clock_of(log) -> tuple[Clock | SteadyClock, str]:
    """(the clock of a log, a sentence on the source of its times if not its own)."""
    least, most, last, first = np.inf, -np.inf, np.zeros(0), np.zeros(0)
    bare, doubt = [], False
    for start in range(0, log.record_count, PIECE):
        us = log.stamps(slice(start, start + PIECE))
        missing = np.isnan(us)
        bare.append(np.flatnonzero(missing) + start)
        us = us[~missing] if bare[-1].size else us
        steps = np.diff(us, prepend=last[-1:])
        doubt = doubt or bool(((steps < -STEP_BACK_US) | (steps > LONG_GAP_US)).any())
        if us.size:
            least, most = min(least, float(us.min())), max(most, float(us.max()))
            first = first if first.size > EDGE_RECORDS else np.r_[first, us[: EDGE_RECORDS + 1]]
            last = np.r_[last, us[-EDGE_RECORDS - 1 :]][-EDGE_RECORDS - 1 :]
        del us, steps
    if not last.size:
        stamps, source = rebuilt(log)
        return make_clock(stamps), source
    ends = np.r_[np.diff(first[: EDGE_RECORDS + 1]), np.diff(last)]
    if doubt or any(wrong_gap(step * 1e-6) for step in ends):
        return make_clock(log.stamps()), ""
    return SteadyClock(log.stamps, np.concatenate(bare), least, float(most - least) / 1e6), ""


def make_clock(stamps: np.ndarray) -> Clock:
    """The clock of a log. stamps: (n,) us in file order, NaN where a record carries no time."""
    timed = np.flatnonzero(np.isfinite(stamps))
    if not timed.size:
        zero = np.zeros(stamps.size)
        return Clock(zero, np.ones(stamps.size, bool), 0.0, 0.0, (), ())
    us = stamps[timed]
    steps = np.diff(us)
    warnings: list[str] = []
    good = np.ones(stamps.size, bool)
    ends = np.r_[steps[:EDGE_RECORDS], steps[-EDGE_RECORDS:]]
    if ((steps < -STEP_BACK_US) | (steps > LONG_GAP_US)).any() or any(wrong_gap(step * 1e-6) for step in ends):
        us, intact, resets = _repaired(us, steps)
        good[timed[~intact]] = False
        timed, us = timed[intact], us[intact]
        if garbage := int((~intact).sum()):
            text = f"{amount(garbage, 'record')} with an impossible time stamp dropped."
            warnings.append(Impossible(garbage, text))
    else:
        resets = []
    start = float(us.min())
    jumps = [(at - start) / 1e6 for at, _ in resets]
    if resets:
        size, when = f"{resets[0][1] / 1e6:.1f} s", f"{jumps[0]:.1f} s"
        also = f" (and {amount(len(jumps) - 1, 'more time')})" if len(jumps) > 1 else ""
        warnings.append(f"The log's clock jumps back by {size} at {when}{also}; later times are shifted to be continuous.")
    # Carry the last stamp forward to records without one; those before the first stamp belong to the start.
    last = np.zeros(stamps.size, np.int32 if stamps.size < 2**31 else np.int64)
    last[timed] = np.arange(timed.size, dtype=last.dtype)
    np.maximum.accumulate(last, out=last)
    time = (us[last] - start) / 1e6
    time[: timed[0]] = 0.0
    return Clock(time, good, start, float(us.max() - start) / 1e6, tuple(jumps), tuple(warnings))


def _repaired(us: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[tuple[float, float]]]:
    """(stamps with resets taken out, kept mask, [(corrected stamp, size) of each reset]).

    The stamps fall into stretches without large steps. The best chain of stretches is the one that keeps most records
    after paying for each gap and, dearly, for each step back; what is not on it is garbage."""
    cuts = np.flatnonzero((steps < -STEP_BACK_US) | (steps > GAP_US)) + 1
    first, stop = np.concatenate([[0], cuts]), np.concatenate([cuts, [us.size]])
    count = (stop - first).astype(float)
    start, end = us[first], us[stop - 1]
    m = first.size
    best, previous = count.copy(), np.full(m, -1)
    top = -1  # best chain among those beyond LOOK_BACK
    for k in range(1, m):
        low = max(k - LOOK_BACK, 0)
        if low and (top < 0 or best[low - 1] > best[top]):
            top = low - 1
        ahead = start[k] - end[low:k]
        score = best[low:k] - np.where(
            ahead < -STEP_BACK_US, RESET_PRICE, np.where(ahead > DAY_US, RESET_PRICE, np.where(ahead > GAP_US, GAP_PRICE, 0))
        )
        j = int(np.argmax(score))
        gain, source = float(score[j]), low + j
        if top >= 0 and best[top] - RESET_PRICE > gain:
            gain, source = best[top] - RESET_PRICE, top
        if gain > 0:
            best[k] += gain
            previous[k] = source
    chain = [int(np.argmax(best))]
    while previous[chain[-1]] >= 0:
        chain.append(int(previous[chain[-1]]))
    chain.reverse()
    # A few records beyond such a gap at either end are more likely damaged than flown.
    while len(chain) > 1 and count[chain[-1]] <= EDGE_RECORDS and wrong_gap((start[chain[-1]] - end[chain[-2]]) * 1e-6):
        chain.pop()
    while len(chain) > 1 and count[chain[0]] <= EDGE_RECORDS and wrong_gap((start[chain[1]] - end[chain[0]]) * 1e-6):
        chain.pop(0)
    intact = np.zeros(us.size, bool)
    fixed = us.copy()
    resets: list[tuple[float, float]] = []
    shift = 0.0
    for before, k in zip([-1, *chain[:-1]], chain, strict=True):
        if before >= 0 and start[k] - end[before] < -STEP_BACK_US:
            shift += end[before] - start[k]
            resets.append((start[k] + shift, end[before] - start[k]))
        fixed[first[k] : stop[k]] += shift
        intact[first[k] : stop[k]] = True
    return fixed, intact, resets


def rebuilt(log) -> tuple[np.ndarray, str]:
    """((n,) us of each record, a sentence on the source of the times); NaN and an empty text when nothing gives times."""
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
    """(record numbers, their times in s, a description): GPS records, else those of the ten-times-a-second loop."""
    gps = log.table("GPS", GPS_COLUMNS)
    column = next((c for c in GPS_COLUMNS if gps is not None and c in gps and gps[c].dtype.kind in "iuf"), None)
    if gps is not None and column is not None and len(gps) > 10:
        steps = np.diff(gps[column].astype(float)) / 1e3
        real = (steps > 0) & (steps < GAP_S)
        if real.sum() > len(steps) / 2:
            usual = float(median(steps[real]))
            return (gps.record, np.r_[0.0, np.cumsum(np.where(real, steps, usual))], "the GPS clock and the order of records")
    loop = next((paced[name] for name in ("MOT", "CTUN") if name in paced), None)
    if loop is None:
        return None, np.zeros(0), ""
    return loop, np.arange(loop.size) * LOOP_S, "its rate of ten records a second"
