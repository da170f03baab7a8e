"""Many ticks in one call, and what is told of them: for whoever has the ticks of a flight as a table."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, Flags, Ints, Reals, Time, Times, local
from rotorwatch.engine.drift.outcome import Growth
from rotorwatch.engine.drift.trim import Trim
from rotorwatch.engine.events.events import Event
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS

SLICES = 1000  # after one tick: all that are due


def pass_on(t: Trim, v: Vehicle, dt: Time, n: int, time: Times, mode: Ints, usable: Flags, lacking: Reals, thrust: Reals) -> None:
    """n ticks of dt s; lacking (n, 3), thrust (n, rotors), row by row."""
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
    """No ticks come after these."""
    t.finish(v)


def with_growth(g: Growth, losses: list[Event], count: int, room: int) -> int:
    """These losses with what has grown (`Growth.join`); how many."""
    return g.join(losses, count, room)
