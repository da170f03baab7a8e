"""Rotors that go off in a vehicle that spins and flies on, one after the other or at once, and come back, tick by tick."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, SMALL, TIME, Mask, Real, Small, Struct, Time, array, copy, embedded, real, reset
from rotorwatch.engine.events.decisions import CERTAIN
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sense import Sensed
from rotorwatch.engine.intake.sizes import MISFITS, ROTORS, SETS, WENT_OFF
from rotorwatch.engine.spin.subsets import AVERAGE_S, CURVES, PARTS, Subsets

WORKED_S = 1.5  # of controlled flight in which no rotor is off, to compare with
# Standard deviations, root mean square over a second: beyond, even the likeliest set does not explain the motion, and none is named.
FITS, FITS_S = 1.7, 1.0
SURE_TICKS = 2  # one after the other
SHOWS_S = 2.0  # after its onset, a rotor off is certain
GROWS = 2.0  # nats a second, at least, of the odds of a rotor that went off: chance makes less over seconds
BACK_S = 1.0  # a rotor that gives thrust again for this long has come back
STARTS = -1  # the piece before the first tick
IDLE, IDLE_S = 0.3, 0.5  # mean demand in hover thrusts, and for how long: it has landed, or falls


class WentOff(Struct):
    """A rotor (from 0) that went off. end: when it came back; LASTS while it is off."""

    onset: Time = 0.0
    detected: Time = 0.0
    end: Time = LASTS
    probability: Real = 0.0
    rotor: Small = 0


class RotorsOff(Struct):
    """The chain over sets of rotors, and the rotors that went off, `count` of them, in the order of their detection. blind: one was off
    before all were seen to work, so that none is named; idle: the rotors carry nothing."""

    chain = embedded(Subsets)
    all = array(WentOff, WENT_OFF)
    count: Small = 0
    squares = array(REAL, MISFITS)  # of the misfit, ring
    odds = array(REAL, SETS)  # log odds of each set to `base`, so far
    least = array(REAL, 2, SETS)  # their minimum in this SHOWS_S and in the one before
    since = array(REAL, 2, SETS)  # the tick from which they have grown since that minimum: s after `begun`
    back = array(TIME, ROTORS, fill=LASTS)  # since when a rotor that was off is on
    sure = array(SMALL, ROTORS)  # ticks for which it is certainly off
    now: Mask = 0  # rotors that are off
    changed: Time = -LASTS  # when that changed
    base: Small = 0  # index of the set that the others are compared with: that of an average ago
    begun: Time = LASTS  # first tick
    turned: Time = -LASTS  # begin of this SHOWS_S
    idled: Time = 0.0
    seen: int = 0
    piece: Small = 0  # of a tick
    blind: bool = False
    idle: bool = False

    def begin(self) -> None:
        """Start with all rotors on."""
        reset(self)
        self.piece = STARTS

    def follow(self, v: Vehicle, dt: Time, row: Sensed, hover: Real) -> None:
        """Take in a tick of dt s. hover: mean share of full thrust that carries the vehicle."""
        while not self.part(v, dt, row, hover):
            pass

    def part(self, v: Vehicle, dt: Time, row: Sensed, hover: Real) -> bool:
        """Do a piece of that; True after the last one."""
        if self.piece == STARTS:
            self.chain.begin(v, dt)
            self.piece = 0
            return False
        if self.piece == 0:
            if not (row.some and row.rate_ok and row.load_ok) or self.idle:
                return True
            mean: Real = 0.0
            for i in range(v.rotors):
                mean += row.share[i] / hover / real(v.rotors)
            self.idled = self.idled + dt if mean < IDLE else 0.0
            self.idle = self.idled > IDLE_S
            if self.idle:
                return True
            self.begun = min(self.begun, row.time)
            if self.chain.take(v, row, hover):
                self.piece = 1
            return self.piece == 0
        if self.piece <= PARTS * CURVES:
            self.chain.part(v, (self.piece - 1) // PARTS, (self.piece - 1) % PARTS)
            self.piece += 1
            return False
        self.chain.conclude()
        self.piece = 0
        self._conclude(v, dt, row.time)
        return True

    def landed(self, time: Time) -> None:
        """No rotor is off any more, as far as it is known."""
        for k in range(self.count):
            self.all[k].end = min(self.all[k].end, time)
        self.now = 0

    def _conclude(self, v: Vehicle, dt: Time, time: Time) -> None:
        lasts = min(max(int(FITS_S / dt + 0.5), 1), MISFITS)
        self.squares[self.seen % lasts] = self.chain.misfit * self.chain.misfit
        self.seen += 1
        total: Real = 0.0
        for k in range(lasts):
            total += self.squares[k]
        fits = total <= FITS * FITS * real(lasts)
        self._compare(dt, time)
        fresh = 0
        for i in range(v.rotors):
            p = self.chain.is_off(i)
            if (self.now & (1 << i)) == 0:
                self.sure[i] = self.sure[i] + 1 if p >= CERTAIN and fits else 0
                fresh |= 1 << i if self.sure[i] == SURE_TICKS else 0
            else:
                self._watch(i, p, p < 1.0 - CERTAIN and fits, dt, time)
        if fresh == 0:
            return
        self.now |= fresh
        self.changed = time
        for i in range(v.rotors):
            if (fresh & (1 << i)) != 0:
                self._add(i, time)

    def _compare(self, dt: Time, time: Time) -> None:
        """Sum the log odds of every set to the base, less GROWS: those of rotors that go off are least at the onset (Page 1954)."""
        fresh = time - self.changed >= AVERAGE_S and self.chain.off[self.base] != self.now
        if fresh:
            self.base = max(self.chain.index(self.now), 0)
        turns = time - self.turned >= SHOWS_S
        if turns:
            self.turned = time
        for h in range(self.chain.count):
            if turns or fresh:
                self.least[1][h] = self.least[0][h]
                self.since[1][h] = self.since[0][h]
            if fresh:
                self.odds[h] = 0.0
                self.least[1][h] = LASTS
            if turns or fresh or self.odds[h] < self.least[0][h]:
                self.least[0][h] = self.odds[h]
                self.since[0][h] = real(time - self.begun)
            self.odds[h] += self.chain.likelihood[h] - self.chain.likelihood[self.base] - GROWS * real(dt)

    def _watch(self, rotor: int, p: Real, on: bool, dt: Time, time: Time) -> None:
        """A rotor that is off: it may have come back."""
        place = self.count - 1
        while place > 0 and self.all[place].rotor != rotor:
            place -= 1
        one = self.all[place]
        one.probability = max(one.probability, p)
        self.back[rotor] = LASTS if not on else min(self.back[rotor], time)
        if time - self.back[rotor] >= BACK_S - 1.5 * dt:
            one.end = self.back[rotor]
            self.now &= ~(1 << rotor)
            self.changed = time
            self.sure[rotor] = 0
            self.back[rotor] = LASTS

    def _add(self, rotor: int, time: Time) -> None:
        """Add a rotor that is certainly off. Of rotors that go off together each is compared with the set of them all."""
        if self.count == WENT_OFF:
            for k in range(WENT_OFF - 1):
                copy(self.all[k], self.all[k + 1])
            self.count -= 1
        one = self.all[self.count]
        self.count += 1
        place = max(self.chain.index(self.now), 0)
        one.rotor = rotor
        one.detected = time
        before = 1 if self.least[1][place] < self.least[0][place] else 0
        one.onset = self.begun + self.since[before][place] - 0.5 * AVERAGE_S
        one.end = LASTS
        one.probability = self.chain.is_off(rotor)
        self.blind = self.blind or one.onset < self.begun + WORKED_S
