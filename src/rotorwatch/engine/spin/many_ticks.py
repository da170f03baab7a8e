"""Many ticks in one call, for callers with the ticks of a flight as a table."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Real, Time
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sense import Sensed
from rotorwatch.engine.spin.rotors_off import RotorsOff


def begin(s: RotorsOff) -> None:
    """Start with all rotors on."""
    s.begin()


def follow(s: RotorsOff, v: Vehicle, dt: Time, hover: Real, n: int, rows: list[Sensed], after: Time, until: Time) -> None:
    """Take in those of n ticks of dt s that are later than `after`, up to `until` s. hover: mean share of full thrust that carries the
    vehicle."""
    for k in range(n):
        if after < rows[k].time <= until:
            s.follow(v, dt, rows[k], hover)
