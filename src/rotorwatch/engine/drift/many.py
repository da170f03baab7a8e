"""Many ticks in one call, and their result: for callers with the ticks of a flight as a table."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, Flags, Ints, Reals, Time, Times, local
from rotorwatch.engine.drift.outcome import Growth
from rotorwatch.engine.drift.trim import Trim
from rotorwatch.engine.events.events import Event
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS

SLICES = 1000  # more than can be due after one tick


def pass_on(t: Trim, v: Vehicle, dt: Time, n: int, time: Times, mode: Ints, usable: Flags, lacking: Reals, thrust: Reals) -> None:
    """Process n ticks of dt s; lacking (n, 3), thrust (n, rotors), row by row."""
    lacks = local(REAL, 3)
    commanded = local(REAL, ROTORS)
    for i in range(n):
        for a in range(3):
            lacks[a] = lacking[3 * i + a]
        for k in range(v.rotors):
            commanded[k] = thrust[v.rotors * i + k]
        t.tick(v, dt, time[i], mode[i], usable[i], lacks, commanded)
        t.work(v, SLICES)


def settle(t: Trim, v: Vehicle) -> None:
    """Finish the analysis: no ticks follow."""
    t.finish(v)


def with_growth(g: Growth, losses: list[Event], count: int, room: int) -> int:
    """Merge a growing loss into these losses (`Growth.join`); return their number."""
    return g.join(losses, count, room)
