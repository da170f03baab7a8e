"""Division of a flight into ticks, by the rates of its signals [Hz]."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Real, Time

# Lengths of ticks [s], and for each the rate of commands above which nearly all ticks hold one.
TICKS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
LEAST_HZ = (19.0, 8.0, 4.5, 1.8, 0.0)
LENGTHS = 5
# A single sample of the commands is compared with motion over this long, or over a sample and a half of the gyro.
SHORTEST_S = 0.2
READY_TICKS = 30  # ticks needed to learn the noise
# s in the air before evaluation; the same where the noise is known from healthy flights.
READY_S, READY_KNOWN_S = 8.0, 3.0
LAG_S = 0.02
LATE_PERIODS = 1.5  # of slow motion: shortest wait of a tick


def tick_length(rate_hz: Real) -> Time:
    """Length of a tick in s for commands at that rate: 0.05 s from 19 Hz on, 1 s for the slowest."""
    for k in range(LENGTHS):
        if rate_hz >= LEAST_HZ[k]:
            return TICKS_S[k]
    return TICKS_S[LENGTHS - 1]


def ready_after(ready_s: Time, dt: Time) -> Time:
    """Blind time in s after lift-off: as requested, but long enough to learn the noise at slow ticks."""
    return max(ready_s, READY_TICKS * dt)


def ready_within(ready_s: Time, longest: Time) -> Time:
    """Blind time in s after lift-off of a whole log: at most half of its longest flight [s], so that a short one is evaluated too, but long
    enough to learn the noise."""
    return min(ready_s, max(0.5 * longest, READY_KNOWN_S))


def half_averaged(dt: Time, command_hz: Real, motion_hz: Real) -> Time:
    """Half of the averaging time of a motion signal for a tick [s]: the tick, but less where its commands are one sample."""
    if dt <= SHORTEST_S or command_hz > 1.5 / dt:
        return 0.5 * dt
    return 0.5 * min(dt, max(SHORTEST_S, 1.5 / max(motion_hz, 1e-3)))


def samples_in(half: Time, period: Time) -> int:
    """Samples that a window of twice `half` s needs at least, of a signal with so many s between two; NaN: unknown."""
    if period > 0.0:
        return max(1, int(half / period * 0.8))
    return 1
