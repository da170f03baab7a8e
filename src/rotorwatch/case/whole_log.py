"""A log through the engine: a link that is over, with its samples in one piece and its flights known in advance."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from rotorwatch.case.estimated import Estimated
from rotorwatch.engine.diagnoser import Written
from rotorwatch.engine.driver import fly
from rotorwatch.engine.motion import tick_table
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import READY_KNOWN_S, READY_S
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.aerobatic import assess as aerobatic

AEROBATIC = (
    "the vehicle does not hover in this flight: it is assessed by its angular motion over seconds, so a loss is detected later than in "
    "hover (docs/aerobatic.md)"
)
NOT_COMPARED = (
    "flights of a vehicle that does not hover are not compared with healthy ones: the balance of its rotors follows its maneuvers, "
    "so damage present at take-off is not assessed"
)


class Flown(NamedTuple):
    """written: the engine's records; estimated: the outputs of the method that assesses by default; both None where no commands are known
    in the air. dynamics: gains and noise that healthy flights have shown, None where they do not fit this log. ready_s: after take-off, in
    which trim and noise are learned. hovers: False where only angular motion is evaluated. assumptions: sentences."""

    written: Written | None
    estimated: Estimated | None
    dynamics: dict | None
    ready_s: float
    hovers: bool
    assumptions: tuple[str, ...]


def flown(flight: Flight, vehicle: Vehicle, air: Spans, progress: Callable[[float], object] | None = None) -> Flown:
    """Feed the engine with a log. air: ((start, end), ...) s of each flight, cut at impacts; progress: called with the finished share."""
    known, assumptions = vehicle.identified or {}, []
    dynamics = known.get("dynamics")
    if flight.has("motors") and dynamics and dynamics.get("dt") != tick_table.length_of(flight):
        assumptions.append(
            f"the healthy flights were logged at another rate (assessed every {dynamics.get('dt', 0):.2f} s): their noise does not "
            "apply to this flight, which learns its own for as long as without them"
        )
        dynamics = None
    # Without a gyro every swing at take-off looks like a missing torque: no short blind time then.
    turns, moves = flight.has("gyro"), flight.angular_rate() is not None
    ready_s = READY_KNOWN_S if dynamics and turns else READY_S
    ready_s = tick_table.ready_of(ready_s, air) if turns else ready_s
    reported = fly(flight, vehicle, air, ready_s, dynamics, progress) if moves else None
    written, done = (None, None) if reported is None else (reported[0], Estimated(reported[1].table, reported[1].out, written=reported[0]))
    hovers = not aerobatic.applies(flight, None if done is None else done.table)
    ready_s = tick_table.ready_after(ready_s, 0.0 if done is None else done.table.dt)
    if done is not None and not hovers:
        done = Estimated(*aerobatic.estimate(flight, vehicle, air, done.table))
    if not hovers:
        assumptions += [AEROBATIC, NOT_COMPARED]
    elif not known:
        assumptions.append(
            f"the flight's first {ready_s:.0f} s in the air are its trim: damage present at take-off is assessed by what healthy "
            "vehicles of any build need, and better with --baseline or --vehicle"
        )
    assumptions += done.table.notes if done is not None else ()
    return Flown(written, done, dynamics, ready_s, hovers, tuple(assumptions))
