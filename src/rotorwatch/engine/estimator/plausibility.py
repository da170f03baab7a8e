"""Plausibility tests before a loss is announced: the controller must command more of that rotor, and its lost thrust must be missing.

Evidence ranks the explanations; these tests check whether the best one is physically possible.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LANES, REAL, Real, Struct, array, exp, local, one, real, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator.bank import Slots
from rotorwatch.engine.estimator.estimator_sizes import ROTORS
from rotorwatch.engine.estimator.evidence import Best
from rotorwatch.engine.estimator.hypotheses import NONE, RECOVERY
from rotorwatch.engine.estimator.kalman import Branch
from rotorwatch.engine.estimator.model_error import AT_LIMIT, BELOW_LIMIT, Seen
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import ANSWER_S, THRUST, USUAL_S, Inputs, Plant
from rotorwatch.engine.events.carried import LANDS
from rotorwatch.engine.events.losses import CANCELS

# Both tests tolerate a standard deviation of this flight's disturbances, and at least the slack in calm air.
DEMAND_SHARE, DEMAND_SLACK = 0.25, 0.05
MISSING_SLACK = 0.15  # hover thrusts of one rotor
# Share of a rotor's thrust that air from below adds for each m/s: 0.4 of hover thrust over induced velocity, which is 4 m/s and more.
INFLOW = 0.1
# Lower limit of a command in divisions, hover thrusts; share of the mean command below which the controller has cut a rotor.
LEAST_THRUST, CUT_SHARE = 0.1, 0.5
LIMIT_S = 2.0  # time constant with which a rotor's saturation is forgotten


class Missing(Struct):
    """Commanded thrust that the accelerometer does not see, hover thrusts of one rotor."""

    fast: Real = 0.0  # over ANSWER_S
    slow: Real = 0.0  # over USUAL_S
    usual: Real = 0.0  # slow, one tick ago
    heave: Real = 0.0  # largest recent deviation of the load factor from 1
    rose: Real = 0.0  # the same, above 1 only
    climb: Real = 0.0  # vertical speed from recent acceleration, m/s
    stands: bool = False  # the ground carries a part of the vehicle: it is commanded clearly less and does not sink
    limit = array(REAL, ROTORS)  # share of its thrust that a saturated rotor may recently have lacked

    def follow(self, p: Plant, now: Inputs, lacking: Real) -> None:
        """Update with one tick. lacking: commanded thrust minus load factor times its gain."""
        valid = now.valid[THRUST]
        up = now.load / real(p.rotors) - 1.0 if valid else 0.0
        left = exp(-p.dt / USUAL_S)
        missing = lacking if valid else self.slow
        self.usual = self.slow
        if now.restart:
            self.fast = missing
            self.slow = missing
            self.heave = abs(up)
            self.rose = up
            self.climb = 0.0
        else:
            self.fast += (missing - self.fast) * min(p.dt / ANSWER_S, 1.0)
            self.slow += (missing - self.slow) * (p.dt / USUAL_S)
            self.heave = max(abs(up), self.heave * left)
            self.rose = max(up, self.rose * left)
            self.climb = self.climb * left + up * G0 * p.dt
        self.stands = valid and now.still and self.fast - self.usual < (LANDS - 1.0) * real(p.rotors)
        kept = 0.0 if now.restart else exp(-p.dt / LIMIT_S)
        for i in range(p.rotors):
            share = now.thrust[i] / now.full
            near = min(max((share - BELOW_LIMIT) / (AT_LIMIT - BELOW_LIMIT), 0.0), 1.0)
            lacks = near * (1.0 - BELOW_LIMIT / max(share, BELOW_LIMIT))
            self.limit[i] = max(lacks, self.limit[i] * kept)

    def air(self, p: Plant) -> Real:
        """Thrust, in hover thrusts of one rotor, that air from below adds to all rotors together when the vehicle has begun to sink;
        negative in a climb."""
        return -INFLOW * real(p.rotors) * self.climb


class Coupling(Struct):
    """raises[i][j]: rise of rotor i's command above the mean of all by a loss of rotor j, relative to the rise by its own loss.

    A controller compensates for the missing wrench B x with the least change of thrusts, B' (B B')^-1 B x. For opposite rotors the coupling
    is set to 0, so each must rise by itself; if both lose the same, neither does, and only steady flight shows it (opposite.py)."""

    raises = array(REAL, ROTORS, ROTORS)

    def begin(self, p: Plant) -> None:
        """Compute the coupling from the vehicle's B."""
        n = p.rotors
        A = local(REAL, 4, 4)
        y = local(REAL, 4, ROTORS)
        for a in range(4):
            for i in range(n):
                y[a][i] = p.effect[a][i]
            for b in range(4):
                for i in range(n):
                    A[a][b] += p.effect[a][i] * p.effect[b][i]
            A[a][a] += 1e-6  # rotors of a tricopter make no yaw
        # Eliminated axis by axis, B' A^-1 B is a sum of squares.
        for i in range(n):
            for j in range(n):
                self.raises[i][j] = -1.0 / real(n)
        for a in range(4):
            for i in range(n):
                for j in range(n):
                    self.raises[i][j] += y[a][i] * y[a][j] / A[a][a]
            for b in range(a + 1, 4):
                share = A[b][a] / A[a][a]
                for c in range(a + 1, 4):
                    A[b][c] -= share * A[a][c]
                for i in range(n):
                    y[b][i] -= share * y[a][i]
        for i in range(n):
            own = max(self.raises[i][i], 1e-9)
            for j in range(n):
                self.raises[i][j] = 0.0 if torque_free(p, i, j) else self.raises[i][j] / own


def torque_free(p: Plant, i: int, j: int) -> bool:
    """Whether equal losses of these two rotors cause no roll or pitch torque."""
    return abs(p.effect[0][i] + p.effect[0][j]) < CANCELS and abs(p.effect[1][i] + p.effect[1][j]) < CANCELS


class Plausible(Struct):
    """Result of the plausibility tests for the likeliest jump."""

    asked: bool = False  # the commands moved in the direction that it demands
    missing: bool = False  # its thrust is missing, and saturation does not explain that

    def assess(
        self,
        p: Plant,
        best: Best,
        slots: Slots,
        now: Inputs,
        seen: Seen,
        missing: Missing,
        leader: Branch,
        noise: Noise,
        coupling: Coupling,
    ) -> None:
        """Test the likeliest fault `best`, found in `slots`, at this tick."""
        n = p.rotors
        lane = best.slot % LANES
        since = best.since * p.dt
        # Simultaneous losses of two rotors are rare and get only the tolerance of calm air.
        two = best.other >= 0 and abs(best.other_size) > 0.0 and abs(best.size) > 0.0
        rough = 0.0 if two else noise.spread(0) + noise.spread(1) + noise.spread(2)
        swing = max(DEMAND_SLACK, sqrt(rough) / real(n))
        # A controller commands more of a rotor that gives less, and less of one that gives more; a candidate whose command moved the other
        # way is rejected. With two rotors the geometry (coupling) reduces the demanded rise.
        largest = 0.0
        lost = 0.0
        commanded = 0.0
        mean = 0.0
        asked = True
        fits = True
        jump = local(REAL, ROTORS)
        for i in range(n):
            mean += seen.thrust[i] / real(n)
            # For a stuck rotor the difference between its thrust and its command counts.
            jump[i] = best.size_of(i)
            if jump[i] > 0.0:
                jump[i] -= best.gives / max(seen.thrust[i], LEAST_THRUST)
        for i in range(n):
            if i == best.rotor or i == best.other:
                commanded += seen.thrust[i]
            largest = max(largest, abs(jump[i]))
            lost += min(max(jump[i], 0.0), 1.0) * seen.thrust[i]
            demanded = 0.0
            for j in range(n):
                demanded += coupling.raises[i][j] * (jump[j] * seen.thrust[j])
            # A manoeuvre swings commands about their trim, so compare with the command at the onset as well.
            if jump[i] > 0.0:
                asked = asked and seen.part[i] - min(seen.trim[i], one(slots.before[i], lane)) > DEMAND_SHARE * demanded - swing
            if jump[i] < 0.0 and not leader.active[i]:
                asked = asked and seen.part[i] - max(seen.trim[i], one(slots.before[i], lane)) < DEMAND_SHARE * demanded + swing
            # Saturation of the rotor must not explain the loss.
            if jump[i] > 0.0 and not leader.active[i]:
                fits = fits and jump[i] > missing.limit[i]
        fits = fits and largest > NONE
        # The lost thrust must be missing from the total, as far as the average over ANSWER_S can show it by now and air from below does not
        # replace it.
        below = 0.0 if two else max(missing.air(p), 0.0)
        slack = max(MISSING_SLACK, 0.0 if two else sqrt(noise.spread(THRUST))) + below
        lost *= 1.0 - exp(-since / ANSWER_S)
        if now.valid[THRUST] and lost > 0.0:
            fits = fits and missing.fast - missing.usual > DEMAND_SHARE * lost - slack
        # A short push from below looks like a rotor that gives more thrust; with a rotor really stuck the controller cuts its command and
        # keeps it cut.
        if best.gives > 0.0:
            fits = fits and since >= 0.5 * ANSWER_S and commanded < CUT_SHARE * mean
        self.asked = asked
        # The end of a loss needs less thrust as well.
        self.missing = fits and (best.kind == RECOVERY or not missing.stands)
