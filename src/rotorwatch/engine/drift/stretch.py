"""Blocks of the trim at the time of one look."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, SMALL, Real, Small, Struct, Time, array, local, real
from rotorwatch.base.medians import median
from rotorwatch.engine.drift.drift_sizes import BLOCKS, STEADY
from rotorwatch.engine.drift.time_blocks import Blocks
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS

LEAST_S = 30.0  # of flight; less is not evaluated
LEAST = 16  # blocks; with fewer, the random walk cannot be estimated
FULL = 0.5  # required share of the ticks of the fullest block
SMOOTH = 5  # blocks
LEVEL = 3  # row of the level in `steady`


class Stretch(Struct):
    """N blocks. z: lacking torque, on roll, pitch and yaw; share: thrusts over their mean; white: variance of white noise relative to the
    smallest; steady: regressors without any explanation: transient torques, and a level."""

    at = array(SMALL, BLOCKS)  # numbers of the blocks
    z = array(REAL, 3, BLOCKS)
    share = array(REAL, ROTORS, BLOCKS)
    white = array(REAL, BLOCKS)
    steady = array(REAL, STEADY, BLOCKS)
    start: Time = 0.0  # of the block 0, s
    last: Time = 0.0  # of the last tick
    length: Time = 1.0  # of a block, s
    count: Small = 0

    def take(self, v: Vehicle, blocks: Blocks) -> bool:
        """Copy these blocks; False without a copy where there are too few."""
        most = 0
        for i in range(BLOCKS):
            most = max(most, blocks.all[i].count)
        some = 0
        for i in range(BLOCKS):
            if blocks.all[i].count > 0 and real(blocks.all[i].count) >= FULL * real(most):
                some += 1
        if some < LEAST or blocks.last - blocks.start < LEAST_S:
            return False
        self.start = blocks.start
        self.last = blocks.last
        self.length = blocks.length
        self.count = 0
        for i in range(BLOCKS):
            block = blocks.all[i]
            if block.count > 0 and real(block.count) >= FULL * real(most):
                mean: Real = 0.0
                for k in range(v.rotors):
                    mean += block.thrust[k] / real(v.rotors)
                place = int(self.count)
                self.at[place] = i
                for a in range(3):
                    self.z[a][place] = block.z[a]
                    self.steady[a][place] = block.scatter[a]  # scatter of the block, read and overwritten below
                for k in range(v.rotors):
                    self.share[k][place] = block.thrust[k] / mean
                self.count += 1
        scatter = local(REAL, BLOCKS)
        for j in range(self.count):
            self.white[j] = 1.0
            self.steady[LEVEL][j] = 1.0
        for a in range(3):
            for j in range(self.count):
                scatter[j] = self.steady[a][j]
            usual = max(median(scatter, self.count), 1e-12)
            for j in range(self.count):
                self.white[j] = max(self.white[j], self.steady[a][j] / usual)
            self._moves(v, a)
        return True

    def time(self, place: Real) -> Time:
        """The middle of a block, s."""
        return self.start + self.length * (place + 0.5)

    def _moves(self, v: Vehicle, axis: int) -> None:
        """Commanded torques on an axis, less a local straight line: the transient ones."""
        torque = local(REAL, BLOCKS)
        for j in range(self.count):
            torque[j] = 0.0
            for k in range(v.rotors):
                torque[j] += self.share[k][j] * v.effectiveness[axis][k]
        for j in range(self.count):
            m0: Real = 0.0
            m1: Real = 0.0
            m2: Real = 0.0
            t0: Real = 0.0
            t1: Real = 0.0
            for i in range(max(0, j - SMOOTH), min(int(self.count), j + SMOOTH + 1)):
                apart = real(self.at[i] - self.at[j])
                if abs(apart) <= SMOOTH:
                    m0 += 1.0
                    m1 += apart
                    m2 += apart * apart
                    t0 += torque[i]
                    t1 += torque[i] * apart
            self.steady[axis][j] = torque[j] - (m2 * t0 - m1 * t1) / max(m0 * m2 - m1 * m1, 1e-9)
