"""The trim of a flight that goes on, tick by tick, since its last take-off or knock; and what is told of it.

It is looked at every LOOK_S while the vehicle is judged, and where judging ends: on the ground, after a knock, at the end of a log. A
look is worked off in slices, one after each tick of 0.05 s, so that no tick keeps the processor for all of it. What a look has shown
holds until the next one shows enough.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Real, Reals, Small, Struct, Time, embedded, local, reset
from rotorwatch.engine.drift.outcome import Growth, Mount
from rotorwatch.engine.drift.stretch import Stretch
from rotorwatch.engine.drift.time_blocks import Blocks
from rotorwatch.engine.drift.weighing import ENDS, GOES_ON, IDLE, Weighing
from rotorwatch.engine.estimator.plant import USUAL_S
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.ticks import JUDGE

LOOK_S = 30.0  # between two looks
SLICES_HZ = 20.0  # slices in a second of flight: a look takes 16 s


class Trim(Struct):
    """One vehicle. every: s between two looks; LASTS where nobody asks before judging ends. looks: so many have been worked off."""

    blocks = embedded(Blocks)
    stretch = embedded(Stretch)
    weighing = embedded(Weighing)
    growth = embedded(Growth)
    mount = embedded(Mount)
    turned: Real = 0.0  # log-odds of that
    every: Time = LOOK_S
    begin: Time = LASTS  # since when the vehicle has been judged, s; LASTS where it is not
    looked: Time = -LASTS  # last tick of the last look
    due: Time = 0.0  # work that is due, slices
    looks: int = 0
    busy: bool = False  # a look is worked off
    wanted: bool = False  # the blocks as they are now are to be looked at
    each: Time = 0.0  # slices in a tick
    piece: Small = 0  # of what concludes a look

    def tick(self, v: Vehicle, dt: Time, time: Time, mode: int, usable: bool, lacking: Reals, thrust: Reals) -> None:
        """One more tick of dt s, in their order, on the ground as well. usable: what it lacks counts; lacking: b + B T theta on roll, pitch
        and yaw; thrust: T."""
        if mode != JUDGE:
            self.close()
            self.begin = LASTS
        elif self.begin >= LASTS:
            self.begin = time
            reset(self.blocks)
        if usable and mode == JUDGE and time >= self.begin + USUAL_S:
            self._add(v, time, lacking, thrust)
        self.each = SLICES_HZ * dt
        self.due = self.due + self.each if self.busy else 0.0

    def work(self, v: Vehicle, most: int) -> None:
        """The slices that are due by the ticks so far, at most so many."""
        left = most
        while left > 0:
            done = self.part(v)
            if done == IDLE:
                return
            left -= 1 if done == ENDS else 0

    def part(self, v: Vehicle) -> int:
        """A piece of the slices that are due by the ticks so far: IDLE, GOES_ON or, of each its last one, ENDS."""
        if self.wanted:
            self._look(v)
            return GOES_ON
        if not self.busy or self.due < 1.0:
            return IDLE
        done = self._slice(v)
        self.due -= 1.0 if done == ENDS else 0.0
        return done

    def step(self, v: Vehicle) -> bool:
        """A slice of the work, due or not; whether there is more."""
        if self.wanted:
            self._look(v)
        if self.busy:
            while self._slice(v) == GOES_ON:
                pass
        return self.busy

    def _slice(self, v: Vehicle) -> int:
        """A piece of a slice, or of what follows on the last one."""
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
        """The blocks as they are now, if there are enough of them."""
        self.wanted = False
        if self.stretch.take(v, self.blocks):
            self.due = self.each
            self.looked = self.blocks.last
            self.weighing.begin(self.stretch)
            self.piece = 0
            self.busy = True

    def close(self) -> None:
        """Judging ends, for now: look at all of it."""
        if self.begin < LASTS and self.blocks.start < LASTS and self.blocks.last > self.looked:
            self.wanted = True

    def finish(self, v: Vehicle) -> None:
        """All that is left to look at, at once."""
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
