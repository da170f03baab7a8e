"""The estimator over many ticks in one call."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Flags, Reals, real
from rotorwatch.engine.estimator.estimator import Estimator, Result
from rotorwatch.engine.estimator.plant import Inputs, Plant, set_plant
from rotorwatch.engine.intake.ticks import AGAIN


def run(p: Plant, e: Estimator, count: int, u: Reals, y: Reals, valid: Flags, out: list[Result]) -> None:
    """Run `count` ticks. u: a row of rotors + 15 numbers per tick, as `engine.bindings.program.inputs` lays them out; y, valid: 4 per tick
    (wrench); out: a result per tick."""
    now = Inputs()
    n = p.rotors
    for t in range(count):
        first = t * (n + 15)
        take(p, u, first, now)
        now.mode = int(u[first + n + 13])
        now.restart = u[first + n + 14] > 0.5
        now.hop = now.restart and u[first + n + 14] < real(AGAIN) - 0.5
        for a in range(4):
            now.wrench[a] = y[4 * t + a]
            now.valid[a] = valid[4 * t + a]
        e.step(p, now, out[t])


def take(p: Plant, u: Reals, first: int, now: Inputs) -> None:
    """Read the commands and motion of one tick from table u, starting at index `first`."""
    n = p.rotors
    for i in range(n):
        now.thrust[i] = u[first + i]
    first += n
    for a in range(3):
        now.turn[a] = u[first + a]
        now.rate[a] = u[first + 4 + a]
    now.load = u[first + 3]
    now.forward = u[first + 7]
    now.right = u[first + 8]
    now.full = u[first + 9]
    now.expo = u[first + 10]
    now.expo_sd = u[first + 11]
    now.climb(u[first + 12])


def begin(p: Plant, e: Estimator) -> None:
    """Complete the plant and initialise the estimator for the first tick."""
    set_plant(p)
    e.begin(p)
