"""Decides at each tick whether to announce a fault, whether a change is explained without one, and whether to learn noise.

A fault is announced when the Shiryaev-Roberts statistic, the evidence of all faults at any onset, passes a threshold. Without a fault its
mean time to do so is at least the threshold (in ticks, over the sum of prior weights; Pollak, Ann. Statist. 13, 1985): the stated
false-alarm rate is the threshold. Evidence only ranks the given hypotheses, so the fault must also be ten times (CLEAR) likelier than
any disturbance, at two ticks in a row; a recovery for RECOVERS_S. Thrust must also be missing, and the fault must either be certain
(CERTAIN_NATS) or have its onset within the bank's reach and commands that moved in the direction it demands (plausibility.py).
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Real, Struct, exp, log, real
from rotorwatch.engine.estimator.bank import Bank
from rotorwatch.engine.estimator.evidence import Best, Evidence
from rotorwatch.engine.estimator.hypotheses import CLEAR, ONE_THRUST, PAIR, RECOVERY, pair_count, weight_of
from rotorwatch.engine.estimator.noise import MEMORY_S
from rotorwatch.engine.estimator.plant import ANSWER_S, BURST_S, USUAL_S, Plant
from rotorwatch.engine.estimator.plausibility import Plausible
from rotorwatch.engine.events.decisions import CERTAIN_NATS, FALSE_ALARM_PERIOD_S

# On surrogates of real noise the statistic's false alarms are as rare as its threshold states, and the odds and plausibility tests let at
# most this share of them pass: none of 6, and 1 of 81 with a threshold 4 nats lower. In 2335 healthy flights of the open world (29.8 h,
# benchmarks/gates.py, seeds 4977 and 6211) what no hypothesis holds passes the threshold in 710, and the tests let 68 of these pass (9.6 %,
# 95 % interval 7.5 to 12.0), 75 of 1025 with 4 nats less; a factor of 1, a threshold 1.9 nats higher, would still let 65 pass.
GATES = 0.15
TICKS = 2  # in a row for which all conditions hold
RECOVERS_S = ANSWER_S  # for which they hold for a recovery that is not certain: a manoeuvre's quick commands look like one until answered
EDGE = 0.9  # of the bank's reach
ABSORB_S = 1.0


class Alarm(Struct):
    """State of the announcement test."""

    limit: Real = 0.0  # nats of evidence that a fault needs
    suspicious: Real = 0.0  # nats above which no noise is learned
    above: int = 0  # ticks over the limit in a row
    sure_s: Real = 0.0  # s for which something has been certain, yet unannounced
    frozen: Real = 0.0  # s of suspicion in which no noise was learned
    alarm: bool = False  # a fault is announced
    absorbed: bool = False  # a change that certainly happened is explained without a fault
    statistic: Real = 0.0  # nats above the announcement limits; above 0 a fault is evident enough to announce
    possible: bool = False  # the likeliest fault is plausible

    def begin(self, p: Plant) -> None:
        """Set the limits before the first tick."""
        self.limit = threshold(p, GATES * FALSE_ALARM_PERIOD_S)
        self.suspicious = threshold(p, 1.0) + log(MEMORY_S)

    def decide(self, p: Plant, found: Evidence, best: Best, bank: Bank, may: Plausible, assess: bool, pushed: bool) -> None:
        """Decide for one tick. best: the likeliest fault; may: its plausibility; assess: this tick is in flight and assessed; pushed: an
        external force pushes the vehicle sideways."""
        # An unusually large disturbance also competes, except with a pair, whose prior is low already.
        weak = found.asked.weak
        other = found.other if best.kind == PAIR else either(found.other, found.far)
        self.statistic = min(found.fault - self.limit, found.fault - other - CLEAR)
        # An onset at the edge of the bank points to a drift that began earlier, and a command that moved the wrong way contradicts a loss.
        # Neither counts when no disturbance comes near a single rotor, because manoeuvres swing commands by more. Pairs get no such
        # exception: they fit the thrust drift of a vehicle that begins to sink. However strong the evidence, thrust must be missing: no
        # model includes the ground or a hand that holds the vehicle.
        sure = self.statistic > CERTAIN_NATS and best.kind != PAIR and best.gives <= 0.0
        self.possible = may.missing and not pushed and ((may.asked and best.since < EDGE * bank.reach) or sure)
        self.above = self.above + 1 if assess and self.statistic > 0.0 and self.possible else 0
        lasts = RECOVERS_S if best.kind == RECOVERY and not sure else 0.0
        self.alarm = real(self.above) > max(lasts / p.dt, real(TICKS)) - 0.5
        # A certain change is absorbed, whatever its cause, once a rotor is known to be weak; before that only if it is no fault.
        certain = max(found.other, found.fault) > CERTAIN_NATS and (found.other > found.fault + CLEAR or weak)
        self.sure_s = self.sure_s + p.dt if assess and not self.alarm and certain else 0.0
        # The end of a loss, at first, is commands that fall faster than the motors follow, which no recovery explains but any disturbance.
        self.absorbed = self.sure_s >= (BURST_S if weak and best.kind == RECOVERY else ABSORB_S)
        if self.absorbed:
            self.sure_s = 0.0
        if self.alarm:
            self.above = 0

    def quiet(self, p: Plant, found: Evidence) -> bool:
        """Whether noise may be learned at this tick: not while evidence exceeds what chance would bring within the noise memory, but such a
        pause does not last for ever."""
        suspicious = found.fault > self.suspicious
        self.frozen = min(self.frozen + p.dt if suspicious else max(self.frozen - p.dt, 0.0), 2.0 * USUAL_S)
        return not suspicious or self.frozen > USUAL_S


def threshold(p: Plant, period: Real) -> Real:
    """Log of the Shiryaev-Roberts threshold for a mean time to false alarm of `period` s. In ticks, that time is at least the threshold
    over the sum of the fault hypotheses' prior weights (about the number of rotors), if the noise follows the model."""
    weight = real(p.rotors) * (1.0 + weight_of(ONE_THRUST)) + real(pair_count(p.rotors)) * weight_of(PAIR)
    return log(period / p.dt * weight)


def either(a: Real, b: Real) -> Real:
    """log(exp(a) + exp(b))."""
    return max(a, b) + log(1.0 + exp(-abs(a - b)))
