"""Ticks in which the ground carries a part of the vehicle: the definition of `engine.motion.ground_contact`."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import NAN, REAL, Flags, Ints, Real, Reals, Time, Times, isnan, local, real
from rotorwatch.base.medians import median
from rotorwatch.engine.intake.sizes import ROTORS
from rotorwatch.engine.intake.ticks import ASSESS, GROUND

LIFTED, LANDS = 0.95, 0.92  # of the usual thrust per load: carried by the rotors alone; no more
MEAN_S, BEFORE_S = 0.5, 0.7  # of the mean; a first leg touches so long before it shows
LIFTS_S, LANDS_S = 6.0, 15.0  # s within which a flight begins and ends on the ground
USUAL_S = 20.0  # of assessed flight next to that
STILL = 0.5  # m/s along the thrust axis, above which it is not on the ground
STANDS = 0.6  # of the usual hover command, below which all of a flight is on the ground: no vehicle drops so much weight
MOSTLY = 0.7  # share of the ticks from a first contact to the end that the ground carries


def on_ground(
    n: int,
    rotors: int,
    dt: Time,
    time: Times,
    thrust: Reals,
    load: Reals,
    valid: Flags,
    mode: Ints,
    restart: Flags,
    hover: Reals,
    axial: Reals,
    air_effect: Real,
    flights: int,
    starts: Times,
    ends: Times,
    carried: Reals,
    some: Reals,
    rows: Ints,
    found: Flags,
) -> None:
    """found (n,): of n ticks of dt s, with thrust (n, rotors), whether the load factor is valid (n,), and the speed along the thrust axis,
    NaN where unknown. air_effect: share of thrust per m/s of climb; starts, ends (flights,): of each flight [s]. carried (n, 2), some, rows
    (n,): scratch."""
    ordered = local(REAL, ROTORS)
    count = 0
    for i in range(n):
        found[i] = False
        # All rotors together, and the middle one of them, which does not change where a weak rotor is commanded more.
        total = 0.0
        for k in range(rotors):
            ordered[k] = thrust[i * rotors + k]
            total += ordered[k]
        climb = 0.0 if isnan(axial[i]) else axial[i]
        known = valid[i] and not isnan(load[i])
        carried[2 * i] = (total / real(rotors) - air_effect * climb) / max(load[i], 0.3) if known else NAN
        carried[2 * i + 1] = (median(ordered, rotors) - air_effect * climb) / max(load[i], 0.3) if known else NAN
        if mode[i] == ASSESS and not isnan(carried[2 * i]):
            rows[count] = i
            count += 1
    if count == 0:
        return
    usual = _usual(carried, rows, 0, count, 0, some)
    middle = _usual(carried, rows, 0, count, 1, some)
    for i in range(count):
        some[i] = hover[rows[i]]
    stands = STANDS * median(some, count)
    first = 0
    while first < n:
        last = first + 1
        while last < n and not restart[last]:
            last += 1
        if restart[first]:
            _hop(first, last, dt, mode, axial, carried, usual, middle, some, rows, found)
        first = last
    for j in range(flights):
        most: Real = -1.0
        for i in range(n):
            if starts[j] <= time[i] <= ends[j]:
                most = max(most, hover[i])
        for i in range(n):
            if 0.0 <= most < stands and starts[j] <= time[i] <= ends[j]:
                found[i] = True


def _hop(
    first: int,
    last: int,
    dt: Time,
    mode: Ints,
    axial: Reals,
    carried: Reals,
    usual: Real,
    middle: Real,
    some: Reals,
    rows: Ints,
    found: Flags,
) -> None:
    """The same of one flight, of ticks from first to last, exclusive. usual, middle: of all flights, where this one was not assessed."""
    width = max(1, _ticks(MEAN_S, dt))
    count = _ticks(USUAL_S, dt)
    assessed = 0
    for i in range(first, last):
        if mode[i] == ASSESS and not isnan(carried[2 * i]):
            rows[assessed] = i
            assessed += 1
    begins = usual
    begins_middle = middle
    ends = usual
    ends_middle = middle
    if assessed > 0:
        part = min(count, assessed)
        begins = _usual(carried, rows, 0, part, 0, some)
        begins_middle = _usual(carried, rows, 0, part, 1, some)
        ends = _usual(carried, rows, assessed - part, assessed, 0, some)
        ends_middle = _usual(carried, rows, assessed - part, assessed, 1, some)
    m = 0
    for i in range(first, last):
        if mode[i] > GROUND and not isnan(carried[2 * i]):
            rows[m] = i
            m += 1
    lifts = 0
    while lifts < min(m, _ticks(LIFTS_S, dt)) and _less(axial, carried, rows, m, lifts, width, LIFTED * begins, LIFTED * begins_middle):
        lifts += 1
    if lifts > 0:
        for i in range(min(m, lifts + width)):
            found[rows[i]] = True
    many = min(m, _ticks(LANDS_S, dt))
    lands = 0
    contact = -1
    for k in range(many):
        at = m - 1 - k
        here = _less(axial, carried, rows, m, at, width, LANDS * ends, LIFTED * ends_middle)
        if k == 0 and not here:
            return
        if here:
            lands += 1
            if real(lands) >= MOSTLY * real(k + 1):
                contact = at
    if contact >= 0:
        for i in range(max(0, contact - _ticks(BEFORE_S, dt)), m):
            found[rows[i]] = True


def _less(axial: Reals, carried: Reals, rows: Ints, m: int, i: int, width: int, most: Real, middle: Real) -> bool:
    """Whether less is carried around the i-th of m ticks, and it does not move along the thrust axis."""
    total = 0.0
    other = 0.0
    for k in range(width):
        j = rows[min(max(i - width // 2 + k, 0), m - 1)]
        total += carried[2 * j]
        other += carried[2 * j + 1]
    climb = 0.0 if isnan(axial[rows[i]]) else axial[rows[i]]
    return total / real(width) < most and other / real(width) < middle and abs(climb) <= STILL


def _ticks(seconds: Time, dt: Time) -> int:
    """The number of ticks in so many seconds, the nearest whole one, the lower of two."""
    return int(seconds / dt + 0.499)


def _usual(carried: Reals, rows: Ints, first: int, last: int, column: int, some: Reals) -> Real:
    """Median of what is carried in the rows from first to last, exclusive."""
    for i in range(first, last):
        some[i - first] = carried[2 * rows[i] + column]
    return median(some, last - first)
