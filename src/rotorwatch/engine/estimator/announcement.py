"""When a fault is announced, when a change is taken as explained without one, and when noise may be learned.

A fault is announced when the Shiryaev-Roberts statistic, the evidence of all faults at any onset, passes a threshold. Without a fault its
mean time to do so is at least the threshold (in ticks, over the sum of prior weights; Pollak, Ann. Statist. 13, 1985): the stated
false-alarm rate is the threshold. Evidence only ranks the given hypotheses, so the fault must also be ten times (CLEAR) likelier than
any disturbance, at two ticks in a row; thrust has to be missing, and it is either certain (CERTAIN_NATS) or at an onset within the bank's
reach with commands that went its way (plausibility.py).
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Real, Struct, exp, log, real
from rotorwatch.engine.estimator.bank import Bank
from rotorwatch.engine.estimator.evidence import Best, Evidence
from rotorwatch.engine.estimator.hypotheses import CLEAR, ONE_THRUST, PAIR, pair_count, weight_of
from rotorwatch.engine.estimator.noise import MEMORY_S
from rotorwatch.engine.estimator.plant import USUAL_S, Plant
from rotorwatch.engine.estimator.plausibility import Plausible
from rotorwatch.engine.events.decisions import CERTAIN_NATS, FALSE_ALARM_PERIOD_S

# Of the statistic's own false alarms - as rare, on surrogates of real noise, as its threshold says - odds and plausibility
# let pass at most this share: none of 6 there, and 1 of 81 with a threshold 4 nats lower.
GATES = 0.15
TICKS = 2  # in a row for which all conditions hold
EDGE = 0.9  # of the bank's reach
ABSORB_S = 1.0


class Alarm(Struct):
    """How near an announcement is."""

    limit: Real = 0.0  # nats that a fault needs
    suspicious: Real = 0.0  # ... from which on no noise is learned
    above: int = 0  # ticks over the limit in a row
    sure_s: Real = 0.0  # s for which something has been certain, yet unannounced
    frozen: Real = 0.0  # s of suspicion in which no noise was learned
    alarm: bool = False  # a fault is announced
    absorbed: bool = False  # something that certainly happened is explained without
    statistic: Real = 0.0  # above 0, a fault is more likely than promised
    possible: bool = False  # the likeliest fault may be true

    def begin(self, p: Plant) -> None:
        """Nothing suspected."""
        self.limit = threshold(p, GATES * FALSE_ALARM_PERIOD_S)
        self.suspicious = threshold(p, 1.0) + log(MEMORY_S)

    def decide(self, p: Plant, found: Evidence, best: Best, bank: Bank, may: Plausible, judge: bool, pushed: bool) -> None:
        """One tick. best: the likeliest fault; may: may it be true; pushed: something outside pushes the vehicle sideways."""
        # Something else may have happened as well. Of a pair, which is rare by its prior, that is not asked.
        weak = found.asked.weak
        other = found.other if best.kind == PAIR else either(found.other, found.far)
        self.statistic = min(found.fault - self.limit, found.fault - other - CLEAR)
        # The most probable onset at the edge of the bank speaks of a drift that began before it, and a command that went the other way
        # against a rotor: neither where no disturbance comes near one rotor, for manoeuvres swing commands by more. Two rotors fit the
        # drift of thrust of a vehicle that begins to sink. However strong evidence is, thrust has to be missing: the ground and a hand are
        # in no model.
        sure = self.statistic > CERTAIN_NATS and best.kind != PAIR and best.gives <= 0.0
        self.possible = may.missing and not pushed and ((may.asked and best.since < EDGE * bank.reach) or sure)
        self.above = self.above + 1 if judge and self.statistic > 0.0 and self.possible else 0
        self.alarm = self.above >= TICKS
        # What certainly happened is explained, whatever it was; where nothing is known to be wrong, only what is no fault.
        certain = max(found.other, found.fault) > CERTAIN_NATS and (found.other > found.fault + CLEAR or weak)
        self.sure_s = self.sure_s + p.dt if judge and not self.alarm and certain else 0.0
        self.absorbed = self.sure_s >= ABSORB_S
        if self.absorbed:
            self.sure_s = 0.0
        if self.alarm:
            self.above = 0

    def quiet(self, p: Plant, found: Evidence) -> bool:
        """Noise is not learned while there is more evidence than chance would bring in its memory, but not for ever: whether it may be
        learned at this tick."""
        suspicious = found.fault > self.suspicious
        self.frozen = min(self.frozen + p.dt if suspicious else max(self.frozen - p.dt, 0.0), 2.0 * USUAL_S)
        return not suspicious or self.frozen > USUAL_S


def threshold(p: Plant, period: Real) -> Real:
    """Log of the Shiryaev-Roberts threshold: the mean time to a false alarm, in ticks, is at least its value over the sum
    of the fault hypotheses' prior weights (about the number of rotors), as far as the noise is what the model says. period: that
    time in s."""
    weight = real(p.rotors) * (1.0 + weight_of(ONE_THRUST)) + real(pair_count(p.rotors)) * weight_of(PAIR)
    return log(period / p.dt * weight)


def either(a: Real, b: Real) -> Real:
    """Log of the sum of two numbers that are known by their logs."""
    return max(a, b) + log(1.0 + exp(-abs(a - b)))
