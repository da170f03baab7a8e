"""Means over blocks of time of the ticks of a current flight: a limited number of blocks, whatever the length of the flight."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Reals, Struct, Time, array, copy, real, reset
from rotorwatch.engine.drift.drift_sizes import BLOCKS
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS

BLOCK_S = 2.0  # length of a block at least


class Block(Struct):
    """Ticks of one block. z, thrust: means; scatter: variance of z about its mean."""

    z = array(REAL, 3)
    scatter = array(REAL, 3)
    thrust = array(REAL, ROTORS)
    count: int = 0

    def add(self, v: Vehicle, z: Reals, thrust: Reals) -> None:
        """Add a tick."""
        self.count += 1
        each = 1.0 / real(self.count)
        for a in range(3):
            off = z[a] - self.z[a]
            self.z[a] += off * each
            self.scatter[a] += (off * (z[a] - self.z[a]) - self.scatter[a]) * each
        for k in range(v.rotors):
            self.thrust[k] += (thrust[k] - self.thrust[k]) * each

    def join(self, v: Vehicle, other: Block) -> None:
        """Merge another block."""
        if other.count == 0:
            return
        self.count += other.count
        share = real(other.count) / real(self.count)
        for a in range(3):
            off = other.z[a] - self.z[a]
            self.z[a] += off * share
            self.scatter[a] += (other.scatter[a] - self.scatter[a]) * share + off * off * share * (1.0 - share)
        for k in range(v.rotors):
            self.thrust[k] += (other.thrust[k] - self.thrust[k]) * share


class Blocks(Struct):
    """Consecutive blocks since the first tick; some may be empty."""

    all = array(Block, BLOCKS)
    start: Time = LASTS  # of the first tick, s; LASTS before
    last: Time = -LASTS  # of the last one
    length: Time = BLOCK_S  # of a block

    def add(self, v: Vehicle, time: Time, z: Reals, thrust: Reals) -> None:
        """Add a tick, in time order."""
        if self.start >= LASTS:
            self.start = time
        while time - self.start >= self.length * BLOCKS:
            self._halve(v)
        self.last = time
        self.all[int((time - self.start) / self.length)].add(v, z, thrust)

    def _halve(self, v: Vehicle) -> None:
        """Join the blocks in pairs."""
        for i in range(BLOCKS // 2):
            if i > 0:
                copy(self.all[i], self.all[2 * i])
            self.all[i].join(v, self.all[2 * i + 1])
        for i in range(BLOCKS // 2, BLOCKS):
            reset(self.all[i])
        self.length *= 2.0
