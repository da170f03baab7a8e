"""Data types of losses: the estimator's result of a tick, the record of a loss, all records, and the estimates over time."""

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
from rotorwatch.base.medians import ranked
from rotorwatch.engine.intake.sizes import HYPOTHESES, PAIRS, PLACES, RECORDS, ROTORS, TOGETHER

ESTIMATES = 16  # number of evenly spaced estimates from which the size of a loss that is over is computed


class Found(Struct):
    """The estimator's result of a tick. H hypotheses: rotors, pairs 0+1, 0+2 ..., recoveries, rotors that ignore their command,
    disturbances."""

    theta = array(REAL, ROTORS)  # loss, 0 healthy to 1 dead
    theta_sd = array(REAL, ROTORS)  # its standard deviation
    active = array(FLAG, PLACES, ROTORS)  # weak rotors of every explanation, the leader first
    share = array(REAL, PLACES)  # probability of every explanation
    gives = array(REAL, ROTORS)  # hover thrusts of the leader's stuck rotors, 0 for others
    onsets = array(REAL, PLACES)  # ticks since the last jump of a rotor in each explanation
    probability = array(REAL, HYPOTHESES)  # used at announcements only
    announced: bool = False  # explanations were made at this tick


class Record(Struct):
    """A loss of rotors that failed together and, if they recovered, recovered together. Times in s."""

    onset: Time = 0.0
    detected: Time = 0.0
    end: Time = LASTS  # LASTS while it lasts
    loss = array(REAL, TOGETHER)  # set once the loss is over
    sd = array(REAL, TOGETHER)  # set once the loss is over
    share = array(REAL, PLACES)  # probability of each of `sets`
    sets = array(MASK, PLACES)  # sets of rotors that may have failed, including the record's own
    count: Small = 0  # of `sets`
    rotors: Mask = 0
    hiding: Mask = 0  # rotors of which one may have failed together with `hider`; the data do not show which
    hider: Small = 0
    gives: Real = 0.0  # hover thrusts that its rotor gives whatever it is commanded, 0 if it follows
    hidden = array(FLAG, PAIRS)  # pairs that the data alone, without priors, do not rule out against rotor `hider`
    recovered: bool = False  # it ended in the air: its rotors work again

    def only(self, rotors: int) -> None:
        """Restrict the record to these rotors, without alternatives."""
        self.rotors = rotors
        self.sets[0] = rotors
        self.share[0] = 1.0
        self.count = 1
        self.hiding = 0
        for k in range(PAIRS):
            self.hidden[k] = False


class Records(Struct):
    """Records of all losses, in the order in which they were added."""

    all = array(Record, RECORDS)
    of = array(SMALL, ROTORS, fill=-1)  # index of each weak rotor's record, -1 if none
    count: Small = 0
    forgotten: int = 0  # number of records removed for lack of room

    def add(self) -> int:
        """Add an empty record and return its index. If there is no room, remove the loss that ended first, else the oldest."""
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
        """Remove the record at index `removed`."""
        for i in range(removed, self.count - 1):
            copy(self.all[i], self.all[i + 1])
        self.count -= 1
        for k in range(ROTORS):
            self.of[k] = _after_removal(self.of[k], removed)


class ExplanationState(Struct):
    """Explanations after a tick; active[0] is the leader's set of rotors."""

    found: Time = 0.0  # s, since when this set has led
    share = array(REAL, PLACES)
    onset: int = 0  # tick of the leader's last jump
    gives: Real = 0.0  # as in Record, largest of the leader's rotors
    active = array(MASK, PLACES)


class Course(Struct):
    """Evenly spaced estimates of one rotor's loss."""

    tick = array(INT, ESTIMATES)
    theta = array(REAL, ESTIMATES)
    sd = array(REAL, ESTIMATES)
    seen: int = 0  # assessed ticks so far
    step: int = 1  # ticks between stored estimates
    count: Small = 0

    def add(self, tick: int, theta: Real, sd: Real) -> None:
        """Add an assessed tick; when full, keep every other estimate and double the spacing."""
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
        """Index of the median estimate (the lower one of an even number) up to the tick `last`; -1 if there is none."""
        some = local(REAL, ESTIMATES)
        count = 0
        for i in range(self.count):
            if i == 0 or self.tick[i] <= last:
                some[count] = self.theta[i]
                count += 1
        middle = ranked(some, count, (count - 1) // 2) if count > 0 else 0.0
        for i in range(count):
            if not (self.theta[i] < middle or self.theta[i] > middle):
                return i
        return -1


class Onset(Struct):
    """Onset of an explanation."""

    time: Time = 0.0  # s, mean time of the commands of that tick
    tick: int = 0
    before: int = 0  # the last tick before `time`


def _after_removal(place: int, removed: int) -> int:
    return -1 if place == removed else place - 1 if place > removed else place
