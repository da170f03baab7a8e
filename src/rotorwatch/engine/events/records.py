"""What losses are written down in: what the estimator found in a tick, one loss, all of them, and how estimates went."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (
    FLAG,
    INT,
    LASTS,
    MASK,
    REAL,
    SMALL,
    Mask,
    Real,
    Small,
    Struct,
    Time,
    array,
    copy,
    local,
    reset,
)
from rotorwatch.engine.intake.sizes import HYPOTHESES, PAIRS, PLACES, RECORDS, ROTORS, TOGETHER

ESTIMATES = 16  # evenly spaced, that say what a loss was that is over


class Found(Struct):
    """What the estimator made of a tick. H hypotheses: rotors, pairs 0+1, 0+2 ..., recoveries, rotors that
    follow no command, disturbances."""

    theta = array(REAL, ROTORS)  # loss, 0 healthy to 1 dead
    theta_sd = array(REAL, ROTORS)  # its standard deviation
    active = array(FLAG, PLACES, ROTORS)  # weak rotors of every explanation, the leader first
    share = array(REAL, PLACES)  # probability of every explanation
    gives = array(REAL, ROTORS)  # hover thrusts of the leader's rotors that follow no command, 0 of others
    onsets = array(REAL, PLACES)  # ticks since the last jump of a rotor in each
    probability = array(REAL, HYPOTHESES)  # read where something is announced
    announced: bool = False  # explanations were made at this tick


class Record(Struct):
    """One loss of rotors that failed together and, as far as they did, ended together."""

    onset: Time = 0.0
    detected: Time = 0.0
    end: Time = LASTS  # LASTS while it lasts
    loss = array(REAL, TOGETHER)  # of one that is over
    sd = array(REAL, TOGETHER)  # of one that is over
    share = array(REAL, PLACES)  # probability of each of `sets`
    sets = array(MASK, PLACES)  # that may have failed, the record's own among them
    count: Small = 0  # of `sets`
    rotors: Mask = 0
    hiding: Mask = 0  # each of these may have failed together with rotor `hider`: the data do not show which
    hider: Small = 0
    gives: Real = 0.0  # hover thrusts that its rotor gives whatever it is commanded, 0 where it follows
    hidden = array(FLAG, PAIRS)  # pairs that the data alone prefer to rotor `hider`
    recovered: bool = False  # it ended in the air: its rotors work again

    def only(self, rotors: int) -> None:
        """It is of these rotors, and of no others."""
        self.rotors = rotors
        self.sets[0] = rotors
        self.share[0] = 1.0
        self.count = 1
        self.hiding = 0
        for k in range(PAIRS):
            self.hidden[k] = False


class Records(Struct):
    """All losses, in the order in which they were written down."""

    all = array(Record, RECORDS)
    of = array(SMALL, ROTORS, fill=-1)  # record of each weak rotor, -1 without
    count: Small = 0
    forgotten: int = 0  # records that found no room

    def add(self) -> int:
        """Room for one more: where there is none, that of the loss that ended first, else the oldest."""
        if self.count >= RECORDS:
            least = -1
            for i in range(self.count):
                if self.all[i].end < LASTS and (least < 0 or self.all[i].end < self.all[least].end):
                    least = i
            self.remove(max(least, 0))
            self.forgotten += 1
        reset(self.all[self.count])
        self.count += 1
        return self.count - 1

    def remove(self, removed: int) -> None:
        """Forget one."""
        for i in range(removed, self.count - 1):
            copy(self.all[i], self.all[i + 1])
        self.count -= 1
        for k in range(ROTORS):
            self.of[k] = _after_removal(self.of[k], removed)


class ExplanationState(Struct):
    """Explanations as they were after a tick; active[0] is the leader's set of rotors."""

    found: Time = 0.0  # s, since when this set leads
    share = array(REAL, PLACES)
    onset: int = 0  # tick of the leader's last jump
    gives: Real = 0.0  # as in Record, of the leader's rotors the most
    active = array(MASK, PLACES)


class Course(Struct):
    """Estimates of one rotor, evenly spaced."""

    tick = array(INT, ESTIMATES)
    theta = array(REAL, ESTIMATES)
    sd = array(REAL, ESTIMATES)
    seen: int = 0  # judged ticks so far
    step: int = 1  # from one that is kept to the next
    count: Small = 0

    def add(self, tick: int, theta: Real, sd: Real) -> None:
        """One more judged tick."""
        if self.seen % self.step == 0:
            if self.count == ESTIMATES:
                for i in range(ESTIMATES // 2):
                    self.tick[i] = self.tick[2 * i]
                    self.theta[i] = self.theta[2 * i]
                    self.sd[i] = self.sd[2 * i]
                self.count = ESTIMATES // 2
                self.step *= 2
            self.tick[self.count] = tick
            self.theta[self.count] = theta
            self.sd[self.count] = sd
            self.count += 1
        self.seen += 1

    def middle(self, last: int) -> int:
        """Place of the median estimate (of two, the smaller) up to the tick `last`; -1 without any."""
        ordered = local(REAL, ESTIMATES)
        count = 0
        for i in range(self.count):
            if i == 0 or self.tick[i] <= last:
                j = count
                while j > 0 and ordered[j - 1] > self.theta[i]:
                    ordered[j] = ordered[j - 1]
                    j -= 1
                ordered[j] = self.theta[i]
                count += 1
        for i in range(count):
            if not (self.theta[i] < ordered[(count - 1) // 2] or self.theta[i] > ordered[(count - 1) // 2]):
                return i
        return -1


class Onset(Struct):
    """When an explanation may have begun."""

    time: Time = 0.0  # s, mean time of the commands of that tick
    tick: int = 0
    before: int = 0  # the last tick before `time`


def _after_removal(place: int, removed: int) -> int:
    return -1 if place == removed else place - 1 if place > removed else place
