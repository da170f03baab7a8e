"""Analysis of the trim of a current flight, tick by tick, since its last take-off or knock, and its results.

The trim is evaluated every LOOK_S while the vehicle is in evaluated flight, and where that ends: on the ground, after a knock, at the end
of a log. A look is computed in slices, one after each tick of 0.05 s, to bound the processor time of a tick. The result of a look holds
until a later one has enough evidence.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Real, Reals, Small, Struct, Time, embedded, local, reset
from rotorwatch.engine.drift.outcome import Growth, Mount
from rotorwatch.engine.drift.stretch import Stretch
from rotorwatch.engine.drift.time_blocks import Blocks
from rotorwatch.engine.drift.weighing import ENDS, GOES_ON, IDLE, Weighing
from rotorwatch.engine.estimator.plant import USUAL_S
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.ticks import ASSESS

LOOK_S = 30.0  # between two looks
SLICES_HZ = 20.0  # slices in a second of flight: a look takes 16 s


class Trim(Struct):
    """Trim analysis of one vehicle. every: s between two looks; LASTS: only at the end. looks: number of completed looks."""

    blocks = embedded(Blocks)
    stretch = embedded(Stretch)
    weighing = embedded(Weighing)
    growth = embedded(Growth)
    mount = embedded(Mount)
    turned: Real = 0.0  # log-odds of `mount`
    every: Time = LOOK_S
    begin: Time = LASTS  # start of evaluated flight, s; LASTS outside
    looked: Time = -LASTS  # last tick of the last look
    due: Time = 0.0  # work that is due, slices
    looks: int = 0
    busy: bool = False  # a look is in progress
    wanted: bool = False  # a look at the present blocks is requested
    each: Time = 0.0  # slices in a tick
    piece: Small = 0  # progress of the conclusion of a look

    def tick(self, v: Vehicle, dt: Time, time: Time, mode: int, usable: bool, lacking: Reals, thrust: Reals) -> None:
        """Add a tick of dt s, in order, on the ground as well. usable: its residual counts; lacking: b + B T theta on roll, pitch and
        yaw; thrust: T."""
        if mode != ASSESS:
            self.close()
            self.begin = LASTS
        elif self.begin >= LASTS:
            self.begin = time
            reset(self.blocks)
        if usable and mode == ASSESS and time >= self.begin + USUAL_S:
            self._add(v, time, lacking, thrust)
        self.each = SLICES_HZ * dt
        self.due = self.due + self.each if self.busy else 0.0

    def work(self, v: Vehicle, most: int) -> None:
        """Compute the slices due by the ticks so far, at most so many."""
        left = most
        while left > 0:
            done = self.part(v)
            if done == IDLE:
                return
            left -= 1 if done == ENDS else 0

    def part(self, v: Vehicle) -> int:
        """Compute a piece of the due slices: IDLE, GOES_ON or, for the last piece of a slice, ENDS."""
        if self.wanted:
            self._look(v)
            return GOES_ON
        if not self.busy or self.due < 1.0:
            return IDLE
        done = self._slice(v)
        self.due -= 1.0 if done == ENDS else 0.0
        return done

    def step(self, v: Vehicle) -> bool:
        """Compute a slice, due or not; return whether there is more."""
        if self.wanted:
            self._look(v)
        if self.busy:
            while self._slice(v) == GOES_ON:
                pass
        return self.busy

    def _slice(self, v: Vehicle) -> int:
        """Compute a piece of a slice, or of the conclusion after the last one."""
        done = self.weighing.part(v, self.stretch)
        if done != IDLE:
            return done
        at = int(self.piece)
        self.piece += 1
        if at < v.rotors:
            self.weighing.sum(v, at)
            return GOES_ON
        if at == v.rotors:
            self.turned = self.mount.find(v, self.stretch, self.weighing)
            return GOES_ON
        self.growth.find(v, self.stretch, self.weighing, self.turned)
        self.busy = False
        self.looks += 1
        return IDLE

    def _look(self, v: Vehicle) -> None:
        """Begin a look at the present blocks, if there are enough of them."""
        self.wanted = False
        if self.stretch.take(v, self.blocks):
            self.due = self.each
            self.looked = self.blocks.last
            self.weighing.begin(self.stretch)
            self.piece = 0
            self.busy = True

    def close(self) -> None:
        """Evaluated flight ends for now: request a look at all of it."""
        if self.begin < LASTS and self.blocks.start < LASTS and self.blocks.last > self.looked:
            self.wanted = True

    def finish(self, v: Vehicle) -> None:
        """Complete all pending looks at once."""
        self.close()
        while self.step(v):
            pass

    def _add(self, v: Vehicle, time: Time, lacking: Reals, thrust: Reals) -> None:
        z = local(REAL, 3)
        mean = 0.0
        for k in range(v.rotors):
            mean += thrust[k] / v.rotors
        if not mean > 0.0:
            return
        for a in range(3):
            z[a] = lacking[a] / mean
        self.blocks.add(v, time, z, thrust)
        if not self.busy and time - max(self.looked, self.blocks.start) >= self.every:
            self.wanted = True
