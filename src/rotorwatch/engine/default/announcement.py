"""When a fault is announced, when a change is taken as explained without one, and when noise may be learned.

A fault is announced when the Shiryaev-Roberts statistic, the evidence of all faults at any onset, passes a threshold. Without a fault its
mean time to do so is at least the threshold (in ticks, over the sum of prior weights; Pollak, Ann. Statist. 13, 1985): the stated
false-alarm rate is the threshold. Evidence only ranks the given hypotheses, so the fault must also be ten times (CLEAR) likelier than
any disturbance, at two ticks in a row; thrust has to be missing, and it is either certain (CERTAIN_NATS) or at an onset within the bank's
reach with commands that went its way (plausibility.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array
from rotorwatch.engine.default import bank, hypotheses, noise, plant
from rotorwatch.engine.default.evidence import Evidence, Jump
from rotorwatch.engine.default.hypotheses import Hypotheses
from rotorwatch.engine.default.plausibility import Plausible
from rotorwatch.engine.estimator.announcement import ABSORB_S, CERTAIN_NATS, EDGE, FALSE_ALARM_PERIOD_S, GATES, TICKS


class AlarmState(NamedTuple):
    """above: ticks over the threshold in a row. sure_s: seconds for which something has been certain, yet unannounced; frozen: seconds of
    suspicion in which no noise was learned."""

    above: Array
    sure_s: Array
    frozen: Array


class AlarmDecision(NamedTuple):
    """alarm: a fault is announced. absorbed: something that certainly happened is explained without. statistic: above 0, a fault is
    more likely than promised; possible: the likeliest one may be true."""

    alarm: Array
    absorbed: Array
    statistic: Array
    possible: Array


def init() -> AlarmState:
    """Nothing suspected."""
    return AlarmState(np.int32(0), np.float64(0), np.float64(0))


def threshold(hyp: Hypotheses, dt, period_s: float | None = None):
    """Log of the Shiryaev-Roberts threshold: the mean time to a false alarm, in ticks, is at least its value over the sum
    of the fault hypotheses' prior weights (about the number of rotors), as far as the noise is what the model says. period_s: that
    time in s; None: as promised, gates included."""
    period_s = GATES * FALSE_ALARM_PERIOD_S if period_s is None else period_s
    new = hyp.fault & ~hyp.well
    return plant.arrays(dt).log(period_s / dt * hyp.weight[new].sum())


def decide(
    state: AlarmState, found: Evidence, best: Jump, onsets: bank.Jumps, limit, possible: Plausible, weak, judge, dt
) -> tuple[AlarmState, AlarmDecision]:
    """One tick. best: jump of the likeliest fault; limit: its `threshold`; possible: may it be true; judge, weak: is the flight judged, is
    a rotor known to be weak."""
    import jax.numpy as jnp

    # Beside a weak rotor the vehicle moves as it has not before, and one more rotor's direction may be met by chance. Of a first loss the
    # flight's own disturbances alone are tested: with larger ones a rotor that is lost in wind went unannounced until the vehicle fell.
    again = weak & (best.rotors.sum() < 2)
    other = jnp.where(again, jnp.logaddexp(found.other, found.far), found.other)
    statistic = jnp.minimum(found.fault - limit, found.fault - other - hypotheses.CLEAR)
    # The most probable onset at the edge of the bank speaks of a drift that began before it, and a command that went the other way against
    # a rotor: neither where no disturbance comes near one rotor, for manoeuvres swing commands by more. Two rotors fit the drift of thrust
    # of a vehicle that begins to sink. However strong evidence is, thrust has to be missing: the ground and a hand are in no model.
    sure = (statistic > CERTAIN_NATS) & (best.rotors.sum() < 2) & (best.gives <= 0.0)
    possible = possible.missing & ((possible.asked & (best.since < EDGE * onsets.reach)) | sure)
    above = jnp.where(judge & (statistic > 0.0) & possible, state.above + 1, 0)
    alarm = above >= TICKS
    # What certainly happened is explained, whatever it was; where nothing is known to be wrong, only what is no fault.
    certain = jnp.maximum(found.other, found.fault) > CERTAIN_NATS
    certain &= (found.other > found.fault + hypotheses.CLEAR) | weak
    sure_s = jnp.where(judge & ~alarm & certain, state.sure_s + dt, 0.0)
    absorbed = sure_s >= ABSORB_S
    above = jnp.where(alarm, 0, above).astype(jnp.int32)
    return AlarmState(above, jnp.where(absorbed, 0.0, sure_s), state.frozen), AlarmDecision(
        alarm, absorbed, statistic, possible
    )


def suspicion(state: AlarmState, found: Evidence, hyp: Hypotheses, dt) -> tuple[AlarmState, Array]:
    """Noise is not learned while there is more evidence than chance would bring in its memory, but not for ever: whether it may be learned
    at this tick."""
    import jax.numpy as jnp

    suspicious = found.fault > threshold(hyp, dt, 1.0) + jnp.log(noise.MEMORY_S)
    frozen = jnp.where(suspicious, state.frozen + dt, jnp.maximum(state.frozen - dt, 0.0))
    return state._replace(frozen=jnp.minimum(frozen, 2.0 * plant.USUAL_S)), ~suspicious | (frozen > plant.USUAL_S)
