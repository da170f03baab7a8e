"""Many samples in one call: of a whole log, or as received on a link.

A sample is its kind, its time and its numbers: `values` from `at` on. NaN: unknown. Samples of equal times come in the order of kinds.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Ints, Reals, Struct, Time, Times, copy, local
from rotorwatch.engine.drift.many import SLICES
from rotorwatch.engine.engine import Engine
from rotorwatch.engine.estimator.estimator import Result
from rotorwatch.engine.estimator.plant import Plant, set_plant
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sense import Plan
from rotorwatch.engine.intake.sizes import ROTORS
from rotorwatch.engine.intake.ticks import Made


class Fed(Struct):
    """Progress of a call: samples taken, ticks made."""

    samples: int = 0
    ticks: int = 0


def begin(g: Engine, e: Plant) -> None:
    """Complete the estimator's knowledge before take-off, and prepare for the first sample."""
    set_plant(e)
    g.begin(e)


def feed(
    g: Engine,
    v: Vehicle,
    p: Plan,
    e: Plant,
    first: int,
    n: int,
    kind: Ints,
    time: Times,
    at: Ints,
    values: Reals,
    made: list[Made],
    out: list[Result],
    room: int,
    fed: Fed,
) -> None:
    """Take the samples from `first` to n, and return the ticks that they make certain with the estimator's outputs, as far as there is
    room; if not enough, call again from fed.samples on."""
    x = local(REAL, ROTORS)
    fed.ticks = 0
    fed.samples = first
    for i in range(first, n):
        _go_on(g, v, p, e, made, out, room, fed)
        if fed.ticks == room:
            return
        for k in range(ROTORS):
            x[k] = values[at[i] + k]
        g.take(v, p, kind[i], time[i], x)
        fed.samples = i + 1
    _go_on(g, v, p, e, made, out, room, fed)


def finish(g: Engine, v: Vehicle, p: Plan, e: Plant, time: Time, made: list[Made], out: list[Result], room: int, fed: Fed) -> None:
    """The end at `time` s: return the remaining ticks, as far as there is room; call again with LASTS until there are none."""
    fed.ticks = 0
    if time < LASTS:
        g.end(v, p, time)
    _go_on(g, v, p, e, made, out, room, fed)
    if fed.ticks < room:
        g.trim.finish(v)


def _go_on(g: Engine, v: Vehicle, p: Plan, e: Plant, made: list[Made], out: list[Result], room: int, fed: Fed) -> None:
    """Process the certain ticks."""
    while fed.ticks < room and g.step(v, p, e):
        copy(made[fed.ticks], g.made)
        copy(out[fed.ticks], g.out)
        g.trim.work(v, SLICES)
        fed.ticks += 1
