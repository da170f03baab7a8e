"""Tests whether a sudden shift is a loss shared by a pair of opposite rotors instead of a disturbance.

Torques of opposite rotors cancel in roll and pitch. The remaining shift in thrust (and yaw) could also come from the battery, payload or a
gust, but those do not act within one tick. Motion does not show which pair it is or how its rotors share the loss, so the hypothesis is one
loss nu common to both rotors of a pair. With C (q, q) and z (q,) of the bank and d = e_i + e_j, its log Bayes factor against "no jump" is
that of a single rotor with information d'C d and vector d'z (hypotheses.py). This has one parameter, like the step of an axis; a second one
would cost evidence without being observable.

The test needs steady flight: climbs, drops and turns change the inflow of all rotors.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LANES, Real, Struct, exp, log, one, real
from rotorwatch.engine.estimator.announcement import Alarm, either
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Bank, Window
from rotorwatch.engine.estimator.estimator_sizes import SLOTS
from rotorwatch.engine.estimator.evidence import Evidence
from rotorwatch.engine.estimator.hypotheses import CLEAR, LOSS_WIDTH, NONE, PAIR, SMALL_WIDTH, kind_of, other_rotor_of, rotor_of
from rotorwatch.engine.estimator.plant import ANSWER_S, USUAL_S, Plant
from rotorwatch.engine.estimator.plausibility import Missing, torque_free

# Yaw rate [rad/s] above which yaw drag is too uncertain for the test; deviation of the load factor from 1, beyond the reduction by the loss
# itself (a loss never lifts a vehicle).
TURNING, HEAVING = 0.15, 0.2
PARTS = 4  # of the bank, one after the other: no piece of a tick takes long
LEAST_ROTORS = 6  # yaw distinguishes the pairs of a quadrotor, so the fault hypotheses suffice there


class Opposite(Struct):
    """A suspected pair."""

    lasted: Real = 0.0  # s for which a pair has been suspected
    pair: int = -1  # its hypothesis at the tick that confirms it, else -1
    onset: Real = 0.0  # ticks ago
    loss: Real = 0.0  # of each of its rotors
    # Of this tick's likeliest pair so far: its evidence in nats, its hypothesis, -1 without one, ticks since its onset.
    best: Real = 0.0
    likeliest: int = -1
    age: Real = 0.0
    before: Real = 0.0  # `lasted` at the tick before

    def suspect(self, p: Plant, bank: Bank, found: Evidence, missing: Missing, alarm: Alarm, calm: bool, part: int) -> None:
        """Test one tick, in PARTS; confirm a pair that is suspected for ANSWER_S. calm: steady flight without turns, announcements or weak
        rotors."""
        if part == 0:
            self.before = self.lasted
            self.lasted = 0.0
            self.pair = -1
            self.best = alarm.limit
            self.likeliest = -1
        if not calm or p.rotors < LEAST_ROTORS:
            return
        for k in range(part * (SLOTS // LANES) // PARTS, (part + 1) * (SLOTS // LANES) // PARTS):
            pack = bank.packs[k]
            if pack.gradual or not pack.used():
                continue
            found.window.reduce(p, pack, found.yaw_error, found.damping_error)
            for lane in range(LANES):
                if one(pack.age, lane) < 0.0:
                    continue
                h = p.rotors
                for i in range(p.rotors):
                    for j in range(i + 1, p.rotors):
                        # Weights are at most 1, so nats alone exclude most pairs.
                        if torque_free(p, i, j) and _nats(found.window, lane, i, j, LOSS_WIDTH) > self.best:
                            loss = _shared(found.window, lane, i, j, LOSS_WIDTH)
                            factor = either(_fit(found.window, lane, i, j, SMALL_WIDTH), _fit(found.window, lane, i, j, LOSS_WIDTH)) - log(
                                2.0
                            )
                            if loss > NONE and factor > self.best:
                                self.best = factor
                                self.likeliest = h
                                self.age = one(pack.age, lane)
                                self.loss = loss
                        h += 1
        if part < PARTS - 1 or self.likeliest < 0:
            return
        forgotten = exp(self.age * p.dt / USUAL_S)  # decay of the heave statistics since the onset
        steady = missing.heave * forgotten < HEAVING + 2.0 * self.loss / real(p.rotors) and missing.rose * forgotten < HEAVING
        disturbed = max(found.disturbed(p, False) - 2.0 * CLEAR, found.disturbed(p, True))
        if steady and self.best > disturbed:
            self.lasted = self.before + p.dt
            if self.lasted >= ANSWER_S and self.before < ANSWER_S:
                self.pair = self.likeliest
                self.onset = self.age + 1.0


def contested(p: Plant, h: int) -> bool:
    """Whether hypothesis h is a pair of opposite rotors on a vehicle with several such pairs."""
    if p.rotors < LEAST_ROTORS or kind_of(p.rotors, h) != PAIR:
        return False
    return torque_free(p, rotor_of(p.rotors, h), other_rotor_of(p.rotors, h))


def _shared(w: Window, lane: int, i: int, j: int, width: Real) -> Real:
    """Most probable loss, 0 to 1, common to both rotors, with a prior standard deviation of `width`."""
    score = one(w.z[FIRST_LOSS + i], lane) + one(w.z[FIRST_LOSS + j], lane)
    return min(max(score / (_information(w, lane, i, j) + 1.0 / (width * width)), 0.0), 1.0)


def _nats(w: Window, lane: int, i: int, j: int, width: Real) -> Real:
    """Exponent of the Bayes factor of that loss."""
    size = _shared(w, lane, i, j, width)
    left = _information(w, lane, i, j) + 1.0 / (width * width)
    score = one(w.z[FIRST_LOSS + i], lane) + one(w.z[FIRST_LOSS + j], lane)
    return score * size - 0.5 * left * size * size


def _fit(w: Window, lane: int, i: int, j: int, width: Real) -> Real:
    """Log Bayes factor of that loss."""
    return _nats(w, lane, i, j, width) - 0.5 * log(_information(w, lane, i, j) * width * width + 1.0)


def _information(w: Window, lane: int, i: int, j: int) -> Real:
    a = FIRST_LOSS + i
    b = FIRST_LOSS + j
    return one(w.C[a][a], lane) + one(w.C[b][b], lane) + 2.0 * one(w.C[a][b], lane)
