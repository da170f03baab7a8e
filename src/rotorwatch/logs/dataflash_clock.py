"""One clock for all records of a DataFlash log: garbage time stamps rejected, backward jumps taken out.

Records of different types are logged slightly out of order, so small steps back are normal; large ones are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.logs.dataflash_binary import amount
from rotorwatch.logs.series import wrong_gap

STEP_BACK_US = 0.5e6  # larger steps back are no matter of record order
GAP_US = 0.4e6  # where stamps are in doubt, a silence this long starts a new stretch; less than a step back, so that a
# stamp that is ahead of its time never counts as the end of the stretch before it
LONG_GAP_US = 600e6  # a silence this long puts stamps in doubt
EDGE_RECORDS = 5  # no more records than these before or after a gap at an end of the log are not believed
RESET_PRICE = 20.0  # records a clock reset must explain before it is believed
GAP_PRICE = 0.5  # below 1: a lone stamp that fits the order of the others is believed
DAY_US = 86400e6
LOOK_BACK = 64  # stretches of garbage in a row that can be skipped


@dataclass(frozen=True)
class Clock:
    """time: (n,) s since the first record, for every record. good: (n,) False where the stamp is garbage.

    start_us: boot time of the first record. jumps: times [s] where the log's clock was set back. Records without a
    stamp have the time of the last stamped record before them.
    """

    time: np.ndarray
    good: np.ndarray
    start_us: float
    end: float
    jumps: tuple[float, ...]
    warnings: tuple[str, ...]


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
        us, kept, resets = _repaired(us, steps)
        good[timed[~kept]] = False
        timed, us = timed[kept], us[kept]
        if garbage := int((~kept).sum()):
            warnings.append(f"{amount(garbage, 'record')} with an impossible time stamp dropped.")
    else:
        resets = []
    start = float(us.min())
    jumps = [(at - start) / 1e6 for at, _ in resets]
    if resets:
        size, when = f"{resets[0][1] / 1e6:.1f} s", f"{jumps[0]:.1f} s"
        more = f" (and {amount(len(jumps) - 1, 'more time')})" if len(jumps) > 1 else ""
        warnings.append(f"The log's clock jumps back by {size} at {when}{more}; later times are shifted to follow on.")
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
    after paying for each gap and, dearly, for each step back; what is not on it is garbage.
    """
    cuts = np.flatnonzero((steps < -STEP_BACK_US) | (steps > GAP_US)) + 1
    first, stop = np.concatenate([[0], cuts]), np.concatenate([cuts, [us.size]])
    count = (stop - first).astype(float)
    start, end = us[first], us[stop - 1]
    m = first.size
    best, previous = count.copy(), np.full(m, -1)
    top = -1  # best chain among those too long ago to look at one by one
    for k in range(1, m):
        low = max(k - LOOK_BACK, 0)
        if low and (top < 0 or best[low - 1] > best[top]):
            top = low - 1
        ahead = start[k] - end[low:k]
        score = best[low:k] - np.where(
            ahead < -STEP_BACK_US,
            RESET_PRICE,
            np.where(ahead > DAY_US, RESET_PRICE, np.where(ahead > GAP_US, GAP_PRICE, 0)),
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
    kept = np.zeros(us.size, bool)
    fixed = us.copy()
    resets: list[tuple[float, float]] = []
    shift = 0.0
    for before, k in zip([-1, *chain[:-1]], chain, strict=True):
        if before >= 0 and start[k] - end[before] < -STEP_BACK_US:
            shift += end[before] - start[k]
            resets.append((start[k] + shift, end[before] - start[k]))
        fixed[first[k] : stop[k]] += shift
        kept[first[k] : stop[k]] = True
    return fixed, kept, resets
