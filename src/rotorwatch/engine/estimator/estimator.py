"""The default diagnoser: a Kalman filter, a bank of jump detectors on its innovations, and competing explanations.

The step below is the method, in the order of docs/methods/default.md; each part has its own file. The filter (kalman.py) runs on the wrench
balance (plant.py) with the losses theta of already announced rotors in its state. For every onset time in a bank (bank.py) the exact
effect of a unit jump on the innovations is propagated, so that each tick has the likelihood ratio of any jump at any of these times, with
its most probable size (hypotheses.py, evidence.py). When a fault is announced (announcement.py, plausibility.py) the most likely causes
become a few explanations, each with its own filter (posterior.py); the best of them leads.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, LANES, REAL, Real, Struct, array, embedded, local, real, sqrt
from rotorwatch.engine.estimator.announcement import Alarm
from rotorwatch.engine.estimator.bank import Bank, Observed
from rotorwatch.engine.estimator.estimator_sizes import HYPOTHESES, PLACES, ROTORS, SLOTS
from rotorwatch.engine.estimator.evidence import Best, Evidence
from rotorwatch.engine.estimator.hypotheses import hypothesis_count
from rotorwatch.engine.estimator.kalman import Measured
from rotorwatch.engine.estimator.model_error import ERROR_TICKS, Memory, Seen, given, shows_air, unknown_damping
from rotorwatch.engine.estimator.noise import WHITE, Noise
from rotorwatch.engine.estimator.opposite import PARTS, TURNING, Opposite
from rotorwatch.engine.estimator.plant import (
    AIR,
    B1,
    B2,
    B3,
    LOAD_GAIN,
    PER_AXIS,
    THETA,
    THRUST,
    YAW,
    YAW_GAIN,
    Inputs,
    Plant,
    Rows,
    bend,
    dot,
    entry,
    rows,
)
from rotorwatch.engine.estimator.plausibility import Coupling, Missing, Plausible
from rotorwatch.engine.estimator.posterior import Branches, lives
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.intake.ticks import ASSESS, GROUND

LEAST_USUAL = 0.1  # hover thrusts
# Stages of a tick: predict all filters (AHEAD) and the bank (SHIFTED); update the filters (MEASURED) and the bank (OBSERVED); weigh the
# explanations; evaluate the evidence of each onset (ASKED); decide; create explanations (BORN); learn noise and fill the result (FILLED).
AHEAD, SHIFTED, MEASURED, OBSERVED, WEIGHED, ASKED, DECIDED, BORN, FILLED = 0, 1, 2, 3, 4, 5, 6, 7, 8
PIECE = 2  # packs of the bank processed in one part of a tick


class Result(Struct):
    """Result of one tick. The leader is the first explanation; entries of explanations without a share are meaningless."""

    theta = array(REAL, ROTORS)  # loss, 0 healthy to 1 dead
    theta_sd = array(REAL, ROTORS)
    innovation = array(REAL, 4)
    innovation_var = array(REAL, 4)
    log_odds = array(REAL, HYPOTHESES)
    probability = array(REAL, HYPOTHESES)  # among faults
    statistic: Real = 0.0  # nats above the announcement limits; above 0 a fault is evident enough to announce
    best: int = 0  # hypothesis of the likeliest fault
    onset: Real = 0.0  # ticks since its onset
    announced: bool = False  # explanations were made at this tick
    plausible: bool = False  # the likeliest fault is plausible
    pushed: bool = False  # an external force pushes the vehicle sideways
    onsets = array(REAL, PLACES)  # ticks since the last jump of a rotor in each explanation
    active = array(FLAG, PLACES, ROTORS)  # weak rotors of each
    each = array(REAL, PLACES, ROTORS)  # their losses
    share = array(REAL, PLACES)  # probability of each
    gives = array(REAL, ROTORS)  # thrust of the leader's rotors that follow no command, 0 of others
    detectable = array(REAL, ROTORS)  # standard deviation with which a loss would be measured now
    biases = array(REAL, 4)  # disturbances, including the differences between rotors as built


class Estimator(Struct):
    """The complete state of the estimator."""

    branches = embedded(Branches)
    noise = embedded(Noise)
    bank = embedded(Bank)
    memory = embedded(Memory)
    missing = embedded(Missing)
    alarm = embedded(Alarm)
    opposite = embedded(Opposite)
    may = embedded(Plausible)
    coupling = embedded(Coupling)
    evidence = embedded(Evidence)  # of this tick
    seen = embedded(Seen)
    rows = embedded(Rows)
    measured = embedded(Measured)
    observed = embedded(Observed)
    best = embedded(Best)
    usual: Real = 1.0  # recent mean thrust, without this tick
    calm = array(REAL, 4)  # weight of this tick's evidence, below 1 in gusts that the noise model lacks
    unsure: Real = 1.0  # factor by which error variances exceed those of the noise model
    left = array(REAL, 4)  # residuals including the biases, from which the noise is learned
    trust = array(REAL, 4)  # weight of each in that, 0 to 1
    stage: int = AHEAD  # of this tick
    place: int = 0  # progress within the stage
    chosen: bool = False  # this tick makes new explanations

    def begin(self, p: Plant) -> None:
        """Initialise before the first tick."""
        self.branches.begin(p)
        self.noise.begin(p)
        self.bank.begin(p)
        self.memory.begin(p)
        self.alarm.begin(p)
        self.coupling.begin(p)

    def step(self, p: Plant, now: Inputs, out: Result) -> None:
        """Process one tick."""
        while self.part(p, now, out):
            pass

    def part(self, p: Plant, now: Inputs, out: Result) -> bool:
        """Process one of the many, about equally long parts of a tick. Call it with the same inputs until it returns False, when the tick
        is done."""
        assess = now.mode == ASSESS
        flying = now.mode > GROUND
        first = self.place
        last = min(first + PIECE, SLOTS // LANES)
        size = PLACES
        self.place += 1
        if self.stage == AHEAD:
            self._ahead(p, now, flying, first)
        elif self.stage == SHIFTED:
            self.bank.advance(p, assess, now.restart, self.memory.thrust, first, last)
            self.place = last
            size = SLOTS // LANES
        elif self.stage == MEASURED:
            if first == 0:
                self.look(p, now, flying)
            if lives(self.branches.all[first]):
                self.branches.all[first].update(p, self.rows, self.measured, self.seen.gain_share)
        elif self.stage == OBSERVED:
            self._observe(p, first, last)
            self.place = last
            size = SLOTS // LANES
        elif self.stage == WEIGHED:
            self._weigh(p, now, assess, out)
            size = 1
        elif self.stage == ASKED:
            self.evidence.look(p, self.bank, first, last)
            self.place = last
            size = SLOTS // LANES
        elif self.stage == DECIDED:
            if first == 0:
                self._decide(p, now, assess, out)
            elif first <= PARTS:
                self._suspect(p, now, assess, out, first - 1)
            else:
                self._choose(p, out)
            size = PARTS + 2
        elif self.stage == BORN:
            if self.chosen:
                if first % 2 == 0:
                    self.branches.jump(p, self.bank, self.evidence, first // 2)
                else:
                    self.branches.born(p, self.bank, first // 2)
                if first == 2 * PLACES - 1:
                    self.bank.forget()
            size = 2 * PLACES if self.chosen else 1
        else:
            self._learn(p, now, flying)
            self._tell(p, now, out)
            size = 1
        if self.place < size:
            return True
        self.place = 0
        self.stage = self.stage + 1 if self.stage < FILLED else AHEAD
        return self.stage > AHEAD

    def _ahead(self, p: Plant, now: Inputs, flying: bool, k: int) -> None:
        """Predict the filter of explanation k by one tick."""
        if k == 0:
            for i in range(PLACES):
                one = self.branches.all[i]
                if now.hop:
                    one.hop(p)
                if now.restart:
                    one.open(p)
            if now.restart:
                self.branches.alone()
        if lives(self.branches.all[k]):
            self.branches.all[k].predict(p, self.noise, self.memory.unsure(), flying)

    def _observe(self, p: Plant, first: int, last: int) -> None:
        """Update the packs `first` to `last` - 1 of the leader's bank with the measurement."""
        leader = self.branches.all[0]
        if first == 0:
            self.observed.by(p, self.rows, leader, self.calm, self.measured.counts)
        for k in range(first, last):
            if self.bank.packs[k].used():
                self.bank.packs[k].observe(p, self.rows, leader, self.observed)

    def _weigh(self, p: Plant, now: Inputs, assess: bool, out: Result) -> None:
        """Weigh the explanations by this tick's innovations, and set up the hypotheses for the leader's bank."""
        leader = self.branches.all[0]
        self.memory.remember(p, leader.innovation, leader.S, self.measured.counts)
        for a in range(4):
            out.innovation[a] = leader.innovation[a]
            out.innovation_var[a] = leader.S[a]
        self.branches.weigh(p, self.calm, self.measured.counts, assess)
        if self.branches.lead():
            self.bank.forget()
        found = self.evidence
        found.yaw_error = max(leader.P[entry(YAW_GAIN, YAW_GAIN)], 1e-12)
        found.damping_error = unknown_damping(p, leader.s)
        found.ask(p, leader, self.noise, self.seen.thrust, self.rows.drag, self.missing.air(p), self.memory.outside(p), now.full)

    def _decide(self, p: Plant, now: Inputs, assess: bool, out: Result) -> None:
        """Sum the evidence of all onsets and decide whether to announce a fault."""
        leader = self.branches.all[0]
        found = self.evidence
        found.gather(p)
        found.pick(p, self.bank, found.first, self.best)
        slots = self.bank.packs[self.best.slot // LANES]
        self.may.assess(p, self.best, slots, now, self.seen, self.missing, leader, self.noise, self.coupling)
        out.pushed = self.memory.outside(p) > 0.0
        self.alarm.decide(p, found, self.best, self.bank, self.may, assess, out.pushed)

    def _suspect(self, p: Plant, now: Inputs, assess: bool, out: Result, part: int) -> None:
        """Test whether opposite rotors share a loss, a part of it."""
        found = self.evidence
        steady = assess and not out.pushed and not self.alarm.alarm and abs(now.rate[YAW]) < TURNING
        self.opposite.suspect(p, self.bank, found, self.missing, self.alarm, steady and not found.asked.weak, part)

    def _choose(self, p: Plant, out: Result) -> None:
        """Choose the explanations that follow from this tick."""
        found = self.evidence
        shared = self.opposite.pair >= 0
        out.best = self.opposite.pair if shared else found.first
        out.announced = self.alarm.alarm or shared or (self.alarm.absorbed and found.asked.weak)
        for i in range(p.rotors):
            out.detectable[i] = found.detectable(i)
        self.chosen = self.alarm.alarm or shared or self.alarm.absorbed
        if self.chosen:
            self.branches.choose(p, found, out.best, self.alarm.alarm or shared, shared)

    def _learn(self, p: Plant, now: Inputs, flying: bool) -> None:
        """Learn the noise while no fault is suspected."""
        learns = local(FLAG, 4)
        quiet = self.alarm.quiet(p, self.evidence)
        for a in range(4):
            learns[a] = now.valid[a] and quiet and flying
        self.noise.step(p, self.left, learns, self.trust)

    def look(self, p: Plant, now: Inputs, flying: bool) -> None:
        """Determine how far to trust this tick's inputs and the model, and build the measurement with its variance R."""
        n = p.rotors
        leader = self.branches.all[0]
        self.usual = max(given(p, now, leader.s) if now.restart else self.memory.collective, LEAST_USUAL)
        rows(p, now, now.thrust, now.forward, now.right, leader.s, self.rows)
        lost = local(REAL, 4)
        for a in range(4):
            for i in range(n):
                lost[a] += self.rows.h[a][THETA + i] * leader.s[THETA + i]
        seen = self.seen
        self.memory.weigh_inputs(p, now, leader.s, lost, self.noise, flying, seen)
        seen.gain_share[AIR] = shows_air(now.axial) if flying else 0.0
        m = self.measured
        self.memory.variance(p, now, seen, leader.s, self.usual, self.noise, m.R)
        wrench = now.wrench[THRUST] if now.valid[THRUST] else 0.0
        air = real(n) * now.axial * leader.s[AIR]
        self.missing.follow(p, now, wrench - now.load * leader.s[LOAD_GAIN] - air)

        rows(p, now, seen.thrust, seen.forward, seen.right, leader.s, self.rows)
        dragged = 0.0
        missing_drag = 0.0
        for i in range(n):
            dragged += self.rows.drag[i]
            missing_drag += self.rows.drag[i] * leader.s[THETA + i]
        for a in range(4):
            m.y[a] = now.wrench[a] if now.valid[a] else 0.0
            m.counts[a] = now.valid[a] and flying
            m.R[a] += self.noise.v[WHITE][a]
        m.y[YAW] += dragged
        m.R[YAW] += ERROR_TICKS * missing_drag * missing_drag
        self.unsure = self.memory.unsure()
        for a in range(4):  # the residual for the noise includes the biases
            x = a * PER_AXIS
            biases = leader.s[x + B1] + leader.s[x + B2] + leader.s[x + B3]
            self.calm[a] = self.memory.calm(a)
            self.left[a] = m.y[a] - dot(self.rows.h[a], leader.s, a, THETA + p.rotors) + biases
            self.trust[a] = self.noise.v[WHITE][a] / m.R[a]

    def _tell(self, p: Plant, now: Inputs, out: Result) -> None:
        n = p.rotors
        leader = self.branches.all[0]
        count = hypothesis_count(n)
        for h in range(count):
            out.log_odds[h] = self.evidence.odds[h]
            out.probability[h] = self.evidence.probability[h]
        out.statistic = self.alarm.statistic
        out.plausible = self.alarm.possible
        out.onset = self.best.since
        self.branches.shares(out.share)
        for k in range(PLACES):
            one = self.branches.all[k]
            out.onsets[k] = one.onset
            for i in range(n):
                out.active[k][i] = one.active[i]
                out.each[k][i] = min(max(one.s[THETA + i], 0.0), 1.0) if one.active[i] else 0.0
        # P assumes the noise model, so scale it where innovations have been larger or more persistent. The smallest loss within an alike
        # pair may belong to any other such pair instead.
        alike = 1.0
        for i in range(n):
            if leader.alike[i]:
                alike = min(alike, out.each[0][i])
        # Uncertainty of the thrust curve adds to that of a loss, in proportion to the extra thrust that the rotor is commanded and still
        # gives.
        more = local(REAL, ROTORS)
        bends = local(REAL, ROTORS)
        commanded = real(n) * self.usual  # the mean that is commanded, from the mean that is given
        gives = real(n)
        for i in range(n):
            commanded += out.each[0][i] * self.memory.trim[i]
            gives -= out.each[0][i]
        for i in range(n):
            more[i] = max(commanded / max(gives, 1.0) + self.memory.trim[i], self.usual)
        bend(p, now, more, self.usual, bends)
        for i in range(n):
            out.theta[i] = out.each[0][i]
            variance = leader.variance[i]
            if leader.alike[i]:
                variance += alike / WITHIN_95 * (alike / WITHIN_95)
            if leader.active[i]:
                bent = (1.0 - out.theta[i]) * bends[i] / more[i]
                variance += self.unsure * leader.P[entry(THETA + i, THETA + i)]
                variance += bent * bent
            out.theta_sd[i] = sqrt(max(variance, 0.0))
            out.gives[i] = leader.gives[i] if leader.active[i] else 0.0
        for a in range(4):
            x = a * PER_AXIS
            out.biases[a] = leader.s[x + B1] + leader.s[x + B2] + leader.s[x + B3]
            for i in range(n):
                if not leader.active[i]:
                    out.biases[a] += self.rows.h[a][THETA + i] * leader.s[THETA + i]
