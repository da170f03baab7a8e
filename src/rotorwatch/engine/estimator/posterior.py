"""Competing explanations of the flight so far, each with its weak rotors, their losses and its own filter.

A jump found in the innovations has several possible causes: this rotor or its neighbour, two rotors, a disturbance. Each becomes a
branch: a set of weak rotors with its own filter state s = [x; theta], covariance P and log weight. All branches filter the same
measurements; a branch's weight grows by the log-likelihood of its innovations nu with variances S (a bank of Kalman filters; D. T.
Magill, IEEE Trans. Automatic Control 10 (1965) 434-439),

    log w_b += g sum_a c_a [ -log S_a / 2 - nu_a^2 / (2 S_a) ],       g = TEMPER exp(-age / BURST_S)

c_a: weight of evidence, lower in gusts that the noise model lacks (model_error.py). g: evidence loses weight with the age of an
explanation, as the data at the change distinguish the causes and later data mainly reflect model errors. The branch in place 0 leads: the
jump bank runs on its innovations, and the bank's findings become branches of it, each with its jump applied exactly to state, covariance
and cross-covariance.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (
    FLAG,
    INT,
    LANES,
    REAL,
    Flags,
    Real,
    Reals,
    Struct,
    array,
    copy,
    embedded,
    exp,
    isnan,
    local,
    log,
    one,
    sqrt,
)
from rotorwatch.engine.estimator.announcement import either
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Bank, Slots
from rotorwatch.engine.estimator.estimator_sizes import DIRECTIONS, HYPOTHESES, PLACES, ROTORS, STATES
from rotorwatch.engine.estimator.evidence import Best, Evidence, Shift
from rotorwatch.engine.estimator.hypotheses import (
    CLEAR,
    DISTURBANCE_COUNT,
    NONE,
    NOTHING,
    RECOVERY,
    hypothesis_count,
    other_rotor_of,
    rotor_of,
)
from rotorwatch.engine.estimator.kalman import Branch, swap
from rotorwatch.engine.estimator.opposite import contested
from rotorwatch.engine.estimator.plant import BUILT_SD, BURST_S, THETA, USUAL_S, Plant, entry
from rotorwatch.engine.events.losses import YOUNG_S

TEMPER = 0.3
OUT = -7.0  # log weight relative to the leader's at which a branch is dropped, once it is YOUNG_S old
ALIKE = -CLEAR  # lower bound of that weight for a pair indistinguishable from the leading one
NEVER = -1e3
OLD_S = 1e3  # initial age


class Branches(Struct):
    """The explanations, the leader first; weight NEVER marks an empty place."""

    all = array(Branch, PLACES)
    age: Real = OLD_S  # s since the explanations were made
    parent = embedded(Branch)  # parent of new explanations; workspace for swaps
    which = array(INT, PLACES)  # hypothesis chosen for each place
    start = array(REAL, PLACES)  # and its initial log weight
    best = embedded(Best)
    shift = embedded(Shift)

    def begin(self, p: Plant) -> None:
        """Start with a single explanation without weak rotors."""
        self.all[0].begin(p)
        for k in range(1, PLACES):
            self.all[k].weight = NEVER

    def alone(self) -> None:
        """Drop all explanations but the leader."""
        self.all[0].weight = 0.0
        for k in range(1, PLACES):
            self.all[k].weight = NEVER

    def weigh(self, p: Plant, calm: Reals, counts: Flags, assess: bool) -> None:
        """Update the weights by one tick's innovations. calm (4,): weight of evidence; counts (4,): the axis is valid."""
        share = TEMPER * exp(-self.age / BURST_S) if assess else 0.0
        leading = 0.0
        alike = _any_alike(p, self.all[0])
        for k in range(PLACES):
            one = self.all[k]
            one.onset += 1.0
            if not lives(one):
                continue
            fit = 0.0
            for a in range(4):
                if counts[a]:
                    fit += calm[a] * (-0.5 * log(one.S[a]) - 0.5 * one.innovation[a] * one.innovation[a] / one.S[a])
            weight = one.weight + share * fit
            if k == 0:
                leading = weight
            weight -= leading
            # Differences between rotors in hover are too uncertain to drop one of several pairs that look the same.
            if alike and _any_alike(p, one):
                weight = max(weight, ALIKE)
            # Yaw and thrust distinguish a pair from the rotor between them, but respond more slowly than the axes that announced it, so
            # keep young explanations. Drop one whose numbers have overflowed.
            stays = (weight > OUT or self.age < YOUNG_S) and not isnan(weight) and abs(weight) < -NEVER
            one.weight = weight if stays else NEVER
        self.age += p.dt

    def lead(self) -> bool:
        """Move the best explanation to place 0 if it is clearly better; return whether the leader has changed."""
        best = 0
        for k in range(1, PLACES):
            if self.all[k].weight > self.all[best].weight:
                best = k
        changed = self.all[best].weight > CLEAR
        if changed:
            swap(self.all[0], self.all[best], self.parent)
        leading = self.all[0].weight
        for k in range(PLACES):
            if lives(self.all[k]):
                self.all[k].weight -= leading
        return changed

    def shares(self, out: Reals) -> None:
        """Probability (PLACES,) of each remaining explanation."""
        total = 0.0
        for k in range(PLACES):
            out[k] = exp(self.all[k].weight)
            total += out[k]
        for k in range(PLACES):
            out[k] /= total

    def choose(self, p: Plant, found: Evidence, first: int, alarm: bool, shared: bool) -> None:
        """Choose the likeliest disturbance and the likeliest faults as new branches of the leader (made by `born`). Hypothesis `first`
        leads if it is announced (alarm), else the disturbance. shared: it is one of several pairs that look alike."""
        n = p.rotors
        count = hypothesis_count(n)
        faults = count - DISTURBANCE_COUNT
        odds = local(REAL, HYPOTHESES)
        left = local(REAL, HYPOTHESES)
        _contest(p, found, first, shared, odds)
        for h in range(faults):
            left[h] = odds[h]
        none = faults
        for h in range(faults, count):
            if odds[h] > odds[none]:
                none = h
        which = local(INT, PLACES)
        weight = local(REAL, PLACES)
        chosen = first
        for place in range(PLACES - 1):
            which[place] = chosen
            weight[place] = odds[chosen]
            if chosen < faults:
                left[chosen] = NEVER * 1e3
            # Faults that add a rotor to `first` explain nearly the same data: reserve the last fault for one without it.
            if place == PLACES - 3:
                for other in range(faults):
                    if _holds(n, other, first):
                        left[other] = NEVER * 1e3
            chosen = _most(left, faults)
        which[PLACES - 1] = none
        weight[PLACES - 1] = either(found.other, found.far)
        considered = alarm or found.asked.weak
        leading = weight[0] if alarm else weight[PLACES - 1]
        copy(self.parent, self.all[0])
        for k in range(PLACES):
            turned = k if alarm else PLACES - 1 - k
            chosen = which[turned]
            # The first place leads; limit the initial advantage of the others.
            one = min(weight[turned] - leading, CLEAR)
            # An announcement has already tested the odds against disturbances; do not test them again. Without one, and without a weak
            # rotor, only a disturbance may lead.
            barred = chosen == none if alarm else chosen != none and not considered
            # A fault that adds a rotor to `first` must be likely enough from the start.
            barred = barred or (chosen < faults and _holds(n, chosen, first) and one <= OUT)
            self.which[k] = chosen
            self.start[k] = NEVER if barred else one
        if considered:
            self.age = 0.0

    def jump(self, p: Plant, bank: Bank, found: Evidence, k: int) -> None:
        """Size the jump of the explanation chosen for place k, which `born` then makes."""
        found.pick(p, bank, int(self.which[k]), self.best)
        found.shift(p, bank, self.best, self.shift)

    def born(self, p: Plant, bank: Bank, k: int) -> None:
        """Make the explanation chosen for place k: the parent with the jump of that hypothesis, identical to a filter augmented by this
        jump."""
        n = p.rotors
        h = int(self.which[k])
        out = self.all[k]
        best = self.best
        copy(out, self.parent)
        out.weight = self.start[k]
        if bank.age(best.slot) >= 0.0:
            _add(p, bank.packs[best.slot // LANES], best.slot % LANES, self.shift, out)
        off = local(FLAG, ROTORS)
        any_off = False
        for i in range(n):
            mine = i == best.rotor or i == best.other
            sd = sqrt(max(out.P[entry(THETA + i, THETA + i)], 0.0))
            taken_back = best.size_of(i) < 0.0 and out.s[THETA + i] < max(NONE, 2.0 * sd)
            off[i] = mine and (best.kind == RECOVERY or taken_back)
            any_off = any_off or off[i]
        for i in range(n):
            if off[i]:
                _well(p, i, out)
        for i in range(n):
            if i == best.rotor or i == best.other:
                out.active[i] = not off[i]
                out.learning[i] = 0.0 if off[i] else USUAL_S
                out.variance[i] = 0.0 if off[i] else out.variance[i]
                out.mean[i] = out.s[THETA + i]
                out.gives[i] = 0.0 if off[i] else best.gives
                out.alike[i] = out.alike[i] or contested(p, h)
                out.onset = best.since
        if any_off:
            for i in range(n):
                out.alike[i] = False


def lives(one: Branch) -> bool:
    """Whether a place holds an explanation."""
    return one.weight > 0.5 * NEVER


def _any_alike(p: Plant, one: Branch) -> bool:
    for i in range(p.rotors):
        if one.alike[i]:
            return True
    return False


def _holds(n: int, h: int, first: int) -> bool:
    """Whether hypothesis h includes all rotors of `first`."""
    rotor = rotor_of(n, first)
    other = other_rotor_of(n, first)
    mine = rotor_of(n, h)
    mine_other = other_rotor_of(n, h)
    return (rotor == mine or rotor == mine_other) and (other < 0 or other == mine or other == mine_other)


def _most(odds: Reals, count: int) -> int:
    best = 0
    for h in range(count):
        if odds[h] > odds[best]:
            best = h
    return best


def _contest(p: Plant, found: Evidence, first: int, shared: bool, odds: Reals) -> None:
    """Log odds for `choose`. If `first` is a pair of opposite rotors, raise the other such pairs to within CLEAR of it; if shared, exclude
    all else."""
    alike = contested(p, first)
    for h in range(hypothesis_count(p.rotors)):
        odds[h] = found.odds[h]
        if alike and contested(p, h):
            odds[h] = max(odds[h], found.odds[first] + ALIKE)
        elif shared:
            odds[h] = 2.0 * NOTHING


def _add(p: Plant, slots: Slots, lane: int, shift: Shift, out: Branch) -> None:
    """Apply a jump: s + M size, P + M cov M'."""
    directions = FIRST_LOSS + p.rotors
    states = THETA + p.rotors
    half = local(REAL, DIRECTIONS)
    for r in range(states):
        row = slots.M[r]
        for e in range(directions):
            out.s[r] += one(row[e], lane) * shift.size[e]
            half[e] = 0.0
            for d in range(directions):
                half[e] += one(row[d], lane) * shift.cov[d][e]
        first = entry(r, 0)
        for c in range(r + 1):
            other = slots.M[c]
            for d in range(directions):
                out.P[first + c] += half[d] * one(other[d], lane)


def _well(p: Plant, i: int, out: Branch) -> None:
    """Rotor i has recovered: condition state and covariance on a loss of 0 with standard deviation BUILT_SD."""
    states = THETA + p.rotors
    column = local(REAL, STATES)
    for r in range(states):
        column[r] = out.P[entry(r, THETA + i)]
    variance = max(column[THETA + i], 1e-12) + BUILT_SD * BUILT_SD
    share = out.s[THETA + i] / variance
    for r in range(states):
        out.s[r] -= column[r] * share
        first = entry(r, 0)
        for c in range(r + 1):
            out.P[first + c] -= column[r] * column[c] / variance
