"""Lone values in a table of samples: a definition (docs/one-definition.md) of the rule that `plausible` states.

Tables have n rows in the order of their times, and `width` columns, row by row.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import NAN, REAL, Flags, Ints, Real, Reals, Time, Times, isnan, local, real
from rotorwatch.base.medians import median, ranked

SCALES = 8.0
AGREE = 3.0
BEFORE = 24  # samples before, for the roughness of the signal
AHEAD = 7  # samples on each side, for the roughness here; the nearest two share the value in question
FAR = 6.0  # typical intervals; a neighbour further away is not used
TINY = 1e-12


def lone(
    n: int, width: int, time: Times, x: Reals, valid: Flags, floor: Real, alike: bool, near: Times, rough: Reals, at: Ints, size: Reals
) -> None:
    """size (n, width): the deviation of each lone value, relative to the limit for lone values; 0 for all others. alike: columns have the
    same roughness; near (width,): largest distance of a neighbour in each [s]. rough (n, width), at (n,): scratch."""
    for i in range(n * width):
        rough[i] = 0.0
        size[i] = 0.0
    for c in range(width):
        m = _known(n, width, c, valid, at)
        if m > 2 * AHEAD:
            for j in range(1, m - 1):
                rough[at[j] * width + c] = abs(_off(width, c, time, x, at[j - 1], at[j], at[j + 1]))
    if alike:
        for i in range(n):
            total = 0.0
            moving = 0
            for c in range(width):
                total += rough[i * width + c]
                if rough[i * width + c] > 0.0:
                    moving += 1
            for c in range(width):
                rough[i * width + c] = max(rough[i * width + c], total / real(max(moving, 1)))
    for c in range(width):
        m = _known(n, width, c, valid, at)
        if m > 2 * AHEAD:
            for j in range(1, m - 1):
                alone = _alone(width, c, time, x, rough, floor, near[c], m, at, j, 1, 1)
                size[at[j] * width + c] = max(size[at[j] * width + c], alone)
                # Two in a row: the first is compared with the samples one before and two after it, the second the other way round.
                if j < m - 2:
                    alone = _alone(width, c, time, x, rough, floor, near[c], m, at, j, 1, 2)
                    if alone > 0.0:
                        alone = min(alone, _alone(width, c, time, x, rough, floor, near[c], m, at, j + 1, 2, 1))
                        size[at[j] * width + c] = max(size[at[j] * width + c], alone)
                        size[at[j + 1] * width + c] = max(size[at[j + 1] * width + c], alone)


def support(
    n: int,
    width: int,
    time: Times,
    x: Reals,
    valid: Flags,
    size: Reals,
    floor: Real,
    count: int,
    rows: Ints,
    own: Ints,
    calm: Reals,
    rough: Reals,
    jumps: Reals,
) -> None:
    """jumps (count,): at least the jump of each sample rows (count,) in any column but own (count,), in the unit of `size`: against the
    line between its neighbours, where those are valid and not lone themselves. calm, rough (n, width): scratch."""
    for c in range(width):
        _calm(n, width, c, time, x, valid, size, calm)
        for i in range(n):
            inner = 0 < i < n - 1
            rough[i * width + c] = _off(width, c, time, calm, i - 1, i, i + 1) if inner else 0.0
    for k in range(count):
        row = rows[k]
        for c in range(width):
            place = row * width + c
            if c != own[k] and not isnan(calm[place]):
                off = rough[place]
                if valid[place]:
                    off += x[place] - calm[place]
                usual = max(_around(width, c, rough, n, row), _before(width, c, rough, n, row))
                jumps[k] = max(jumps[k], abs(off) / max(SCALES * usual, max(floor, TINY)))


def _known(n: int, width: int, c: int, valid: Flags, at: Ints) -> int:
    """The rows with a valid value in a column, into at; their number."""
    m = 0
    for i in range(n):
        if valid[i * width + c]:
            at[m] = i
            m += 1
    return m


def _off(width: int, c: int, time: Times, x: Reals, first: int, middle: int, last: int) -> Real:
    """Residual of a sample against the line between two others."""
    share = min(max((time[middle] - time[first]) / max(time[last] - time[first], 1e-9), 0.0), 1.0)
    step = x[last * width + c] - x[first * width + c]
    return x[middle * width + c] - x[first * width + c] - step * share


def _alone(
    width: int, c: int, time: Times, x: Reals, rough: Reals, floor: Real, near: Time, m: int, at: Ints, j: int, before: int, after: int
) -> Real:
    """Deviation of the j-th valid sample of a column from the line between those so many samples before and after; 0: it is not lone."""
    first = at[j - before]
    middle = at[j]
    last = at[j + after]
    off = abs(_off(width, c, time, x, first, middle, last))
    if not (off > floor and off > AGREE * abs(x[last * width + c] - x[first * width + c])):
        return 0.0
    if not (time[middle] - time[first] <= near * real(before) and time[last] - time[middle] <= near * real(after)):
        return 0.0
    least = max(floor, TINY)
    around = _around_valid(width, c, rough, m, at, j)
    if not off > max(SCALES * around, least):
        return 0.0
    alone = off / max(SCALES * max(around, _before_valid(width, c, rough, m, at, j)), least)
    return alone if alone > 1.0 else 0.0


def _place(n: int, i: int, offset: int) -> int:
    """The sample at an offset, mirrored where there is none: the first and the last one have no residual."""
    j = i + offset
    if j < 1 or j > n - 2:
        j = i - offset
    return min(max(j, 1), n - 2)


def _around_valid(width: int, c: int, rough: Reals, m: int, at: Ints, j: int) -> Real:
    """Usual residual around the j-th valid sample."""
    some = local(REAL, 2 * (AHEAD - 2))
    for k in range(AHEAD - 2):
        some[k] = rough[at[_place(m, j, k - AHEAD)] * width + c]
        some[AHEAD - 2 + k] = rough[at[_place(m, j, k + 3)] * width + c]
    return ranked(some, 2 * (AHEAD - 2), AHEAD - 2)


def _before_valid(width: int, c: int, rough: Reals, m: int, at: Ints, j: int) -> Real:
    """Usual residual before it."""
    some = local(REAL, BEFORE - 2)
    for k in range(BEFORE - 2):
        some[k] = rough[at[_place(m, j, k - BEFORE)] * width + c]
    return median(some, BEFORE - 2)


def _around(width: int, c: int, rough: Reals, n: int, i: int) -> Real:
    """Usual residual around a sample of a column without gaps, of either sign."""
    some = local(REAL, 2 * (AHEAD - 2))
    for k in range(AHEAD - 2):
        some[k] = abs(rough[_place(n, i, k - AHEAD) * width + c])
        some[AHEAD - 2 + k] = abs(rough[_place(n, i, k + 3) * width + c])
    return ranked(some, 2 * (AHEAD - 2), AHEAD - 2)


def _before(width: int, c: int, rough: Reals, n: int, i: int) -> Real:
    """Usual residual before it."""
    some = local(REAL, BEFORE - 2)
    for k in range(BEFORE - 2):
        some[k] = abs(rough[_place(n, i, k - BEFORE) * width + c])
    return median(some, BEFORE - 2)


def _calm(n: int, width: int, c: int, time: Times, x: Reals, valid: Flags, size: Reals, calm: Reals) -> None:
    """A column with its invalid and lone values replaced by the line between their neighbours; NaN without any."""
    last = -1
    for i in range(n):
        if valid[i * width + c] and size[i * width + c] == 0.0:
            calm[i * width + c] = x[i * width + c]
            for j in range(last + 1, i):
                calm[j * width + c] = x[i * width + c]
                if last >= 0:
                    slope = (x[i * width + c] - x[last * width + c]) / max(time[i] - time[last], 1e-9)
                    calm[j * width + c] = slope * (time[j] - time[last]) + x[last * width + c]
            last = i
    for j in range(last + 1, n):
        calm[j * width + c] = x[last * width + c] if last >= 0 else NAN
