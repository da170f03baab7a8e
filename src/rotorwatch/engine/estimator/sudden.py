"""Fast comparison for rotors that are suddenly gone: from the gyro, the commands and the load factor, sample by sample.

The bank compares ticks of 50 ms and waits for two; a rotor that loses more than half of its thrust turns the vehicle far beyond any noise
within 30 ms. In steps of 5 ms, the angular rate over an age h, less what it would have been without a change, is for each axis

    x = D rate - g D S,    D z = z(t) - z(t - h) - h / H (z(t - h) - z(t - h - H))        H = REFERENCE steps

S is the time integral of the commanded torque behind a motor's lag, g [rad/s^2 per hover thrust] is learned by least squares from D rate
and D S, and the variance of x for each age and axis in flight. A loss l of rotor i since t - h gives x = -g B_i T_i l h (Willsky and
Jones, IEEE TAC 21(1), 1976, for a jump of known direction). It is announced when, at SAME steps in a row,

    x is far beyond its noise (BEYOND), of a size that rotor i has (LEAST to MOST of its thrust), and within ANGLE of its direction, as of
    no rotor of another arm; it grew in all three parts of h, as an impulse does not; the commands did not ask for it; and the load factor
    changed as if that thrust were missing.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Mask, Real, Reals, Small, Struct, Time, array, isnan, local, real, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator.estimator_sizes import ROTORS
from rotorwatch.engine.estimator.plant import GAIN, ONE_ARM, PER_AXIS, Plant
from rotorwatch.engine.intake.craft import PITCH, ROLL, THRUST, Vehicle

STEP_S = 0.005
AGES = (6, 9, 12, 18)  # steps since the onset
AGE_COUNT = 4
REFERENCE = 20  # steps before the onset, over which the rate would have gone on
PLACES_KEPT = 40  # AGES[-1] + REFERENCE + 1, and one more
LEARN_AGE = 1  # index of the age at which g is learned
LEARN_S, NOISE_S, UNIT_S, THRUST_S = 20.0, 10.0, 5.0, 0.1  # memories of g, noise, hover command, thrust before the onset
MOTOR_LAG_S = 0.03
READY_S = 4.0  # of flight before the first judgement
STALE_S = 0.03  # commands older than this say nothing of the present ones
CLIP = 25.0  # times its variance at which the square of x is clipped
BEYOND = 12.0  # standard deviations
LEAST, MOST = 0.4, 1.5  # of the rotor's thrust, where g is known
EXCITED = 9.0  # variances of x that a command must exceed for g to be learned from it: in calm air feedback from gusts biases g
ANGLE = 0.2  # tangent of the angle between x and the rotor's direction
PART = 0.08  # of x in each third of h, at least
ASKED = 0.25  # of x that a changed command explains, at most
LOAD_G = 0.1  # g by which the load factor may differ, on top of half the expected change and three standard deviations
SLOW = 3.0  # rad/s of roll and pitch rate: above, the vehicle tumbles
SAME = 2
REST_S = 2.0  # after an alarm


class Sudden(Struct):
    """State of the fast comparison, and its last alarm."""

    rate = array(REAL, PLACES_KEPT, 3)  # rad/s, mean of each step, ring
    asked = array(REAL, PLACES_KEPT, 3)  # increment of S in each step
    load = array(REAL, PLACES_KEPT)  # g
    newest: int = 0
    filled: int = 0
    total = array(REAL, 3)  # sum of the step in progress
    load_total: Real = 0.0
    count: int = 0
    load_count: int = 0
    begin: Time = -LASTS
    step: Real = STEP_S  # s, mean length of a step
    wrench = array(REAL, 3)  # commanded torque behind the motors' lag
    thrust = array(REAL, ROTORS)  # of each rotor before the onset, hover thrusts
    unit: Real = 0.0  # mean command at hover, share of full thrust
    prior = array(REAL, 3)  # g before take-off
    spread = array(REAL, 3)  # its relative variance
    both = array(REAL, 3)  # sums of D rate D S, and of (D S)^2
    own = array(REAL, 3)
    gain = array(REAL, 3)  # g
    wrong = array(REAL, 3)  # its relative standard deviation
    variance = array(REAL, AGE_COUNT, 3)
    load_variance = array(REAL, AGE_COUNT)
    flown: Real = 0.0  # s, up to READY_S
    rotor: Small = -1  # candidate
    same: Small = 0  # steps in a row
    rest: Real = 0.0  # s
    onset: Time = -LASTS  # of the last alarm, s
    named: Small = -1  # its rotor
    mates: Mask = 0  # other rotors of that arm

    def begin_with(self, p: Plant) -> None:
        """Set the priors before the first sample."""
        for a in range(3):
            mean = p.mean[a * PER_AXIS + GAIN]
            self.prior[a] = 1.0 / max(mean, 1e-6)
            self.spread[a] = p.variance[a * PER_AXIS + GAIN][a * PER_AXIS + GAIN] / max(mean * mean, 1e-12)
            self.gain[a] = self.prior[a]
            self.wrong[a] = sqrt(self.spread[a])
            for k in range(AGE_COUNT):
                self.variance[k][a] = 1e-4
        for k in range(AGE_COUNT):
            self.load_variance[k] = 1e-3

    def accel(self, z: Real) -> None:
        """Specific force down, m/s^2."""
        if not isnan(z):
            self.load_total -= z / G0
            self.load_count += 1

    def gyro(self, v: Vehicle, time: Time, x: Reals, thrust: Reals, commanded: Time, flies: bool) -> bool:
        """Add a sample of the angular rate, rad/s; thrust: commanded shares of full thrust, `commanded` s; flies: in the air and assessed.
        True: an alarm."""
        if isnan(x[0]) or isnan(x[1]) or isnan(x[2]):
            return False
        if time - self.begin > 2.0 * STEP_S + 1e-4 or time < self.begin:
            self._restart(time)
        for a in range(3):
            self.total[a] += x[a]
        self.count += 1
        length = time - self.begin
        if length < STEP_S - 1e-4:
            return False
        self._close(v, real(length), thrust, time - commanded <= STALE_S)
        self.begin = time
        if not flies or self.filled < PLACES_KEPT:
            self.flown = self.flown if flies else 0.0
            self.same = 0
            return False
        return self._judge(v, time)

    def _restart(self, time: Time) -> None:
        self.filled = 0
        self.begin = time
        self._empty()

    def _empty(self) -> None:
        self.count = 0
        self.load_total = 0.0
        self.load_count = 0
        for a in range(3):
            self.total[a] = 0.0

    def _close(self, v: Vehicle, length: Real, thrust: Reals, fresh: bool) -> None:
        """Finish a step of `length` s."""
        mean: Real = 0.0
        for k in range(v.rotors):
            mean += thrust[k] / real(v.rotors)
        if self.unit <= 0.0:
            self.unit = mean
        self.unit += (mean - self.unit) * (length / UNIT_S)
        unit = max(self.unit, 0.02)
        last = self.newest
        self.newest = (self.newest + 1) % PLACES_KEPT
        self.step += 0.1 * (length - self.step)
        for k in range(v.rotors):
            self.thrust[k] += (thrust[k] / unit - self.thrust[k]) * (length / (THRUST_S + length))
        for a in range(3):
            torque: Real = 0.0
            for k in range(v.rotors):
                torque += v.effectiveness[a][k] * thrust[k] / unit
            self.wrench[a] += (torque - self.wrench[a]) * (length / (MOTOR_LAG_S + length))
            self.asked[self.newest][a] = self.wrench[a] * length
            self.rate[self.newest][a] = self.total[a] / real(self.count)
        self.load[self.newest] = self.load_total / real(self.load_count) if self.load_count > 0 else self.load[last]
        self.filled = min(self.filled + 1, PLACES_KEPT) if fresh else 0
        self._empty()

    def _judge(self, v: Vehicle, time: Time) -> bool:
        """Judge the newest step, and learn from it."""
        share = self.step / NOISE_S
        turned = local(REAL, 3)
        asked = local(REAL, 3)
        x = local(REAL, 3)
        found = -1
        self.flown = min(self.flown + self.step, READY_S)
        self.rest = max(self.rest - self.step, 0.0)
        for k in range(AGE_COUNT):
            age = AGES[k]
            self._differ(age, turned, asked)
            beyond: Real = 0.0
            quiet = True
            for a in range(3):
                x[a] = turned[a] - self.gain[a] * asked[a]
                square = x[a] * x[a]
                if a < 2:
                    beyond += square / self.variance[k][a]
                quiet = quiet and square < CLIP * self.variance[k][a]
            lifted = self._lifted(age)
            if beyond > BEYOND * BEYOND and found < 0 and self.flown >= READY_S and self.rest <= 0.0:
                found = self._rotor(v, k, x, asked, lifted)
            for a in range(3):
                square = min(x[a] * x[a], CLIP * self.variance[k][a])
                self.variance[k][a] = max(self.variance[k][a] + (square - self.variance[k][a]) * share, 1e-6)
            square = min(lifted * lifted, CLIP * self.load_variance[k])
            self.load_variance[k] = max(self.load_variance[k] + (square - self.load_variance[k]) * share, 1e-6)
            if k == LEARN_AGE and quiet:
                self._learn(turned, asked)
        self.same = self.same + 1 if found >= 0 and found == self.rotor else 1 if found >= 0 else 0
        self.rotor = found
        if self.same < SAME:
            return False
        self.same = 0
        self.rest = REST_S
        self.onset = time - real(AGES[0]) * self.step
        self.named = found
        self.mates = 0
        for j in range(v.rotors):
            if j != found and _one_arm(v, found, j):
                self.mates |= 1 << j
        return True

    def _place(self, back: int) -> int:
        return (self.newest + PLACES_KEPT - back) % PLACES_KEPT

    def _differ(self, age: int, turned: Reals, asked: Reals) -> None:
        """D of the rate and of S."""
        now = self.rate[self._place(0)]
        onset = self.rate[self._place(age)]
        before = self.rate[self._place(age + REFERENCE)]
        share = real(age) / real(REFERENCE)
        for a in range(3):
            turned[a] = now[a] - onset[a] - share * (onset[a] - before[a])
            asked[a] = 0.0
        for back in range(age):
            for a in range(3):
                asked[a] += self.asked[self._place(back)][a]
        for back in range(age, age + REFERENCE):
            for a in range(3):
                asked[a] -= share * self.asked[self._place(back)][a]

    def _lifted(self, age: int) -> Real:
        """Change of the load factor: the last two thirds of the age against the reference."""
        now: Real = 0.0
        before: Real = 0.0
        count = age - age // 3
        for back in range(count):
            now += self.load[self._place(back)]
        for back in range(age, age + REFERENCE):
            before += self.load[self._place(back)]
        return now / real(count) - before / real(REFERENCE)

    def _learn(self, turned: Reals, asked: Reals) -> None:
        """Least squares of the rate on the integral of the commanded torque, with the prior as so many samples as its spread is worth."""
        for a in range(3):
            effect = self.gain[a] * asked[a]
            if effect * effect > EXCITED * self.variance[LEARN_AGE][a]:
                self.both[a] += turned[a] * asked[a] - self.both[a] * (self.step / LEARN_S)
                self.own[a] += asked[a] * asked[a] - self.own[a] * (self.step / LEARN_S)
            # Overlapping differences: AGES[LEARN_AGE] of them tell as much as one.
            weight = real(AGES[LEARN_AGE]) * self.variance[LEARN_AGE][a] / (self.spread[a] * self.prior[a] * self.prior[a])
            self.gain[a] = (self.both[a] + weight * self.prior[a]) / (self.own[a] + weight)
            self.gain[a] = min(max(self.gain[a], 0.2 * self.prior[a]), 5.0 * self.prior[a])
            self.wrong[a] = sqrt(self.spread[a] * weight / (self.own[a] + weight))

    def _rotor(self, v: Vehicle, k: int, x: Reals, asked: Reals, lifted: Real) -> int:
        """The rotor whose loss x shows, -1 for none."""
        age = AGES[k]
        h = real(age) * self.step
        roll = x[ROLL] / (self.gain[ROLL] * h)
        pitch = x[PITCH] / (self.gain[PITCH] * h)
        best = -1
        least: Real = ANGLE
        size: Real = 0.0
        for i in range(v.rotors):
            r = -v.effectiveness[ROLL][i]
            q = -v.effectiveness[PITCH][i]
            along = r * roll + q * pitch
            across = abs(r * pitch - q * roll)
            if along > 0.0 and across < least * along:
                least = across / along
                best = i
                size = along / (r * r + q * q)
        if best < 0:
            return -1
        loss = size / max(self.thrust[best], 0.3)
        wrong = max(self.wrong[ROLL], self.wrong[PITCH])
        if (
            loss < LEAST / (1.0 + 1.5 * wrong)
            or loss > MOST * (1.0 + 3.0 * wrong)
            or max(abs(self.rate[self._place(age)][ROLL]), abs(self.rate[self._place(age)][PITCH])) > SLOW
        ):
            return -1
        r = -v.effectiveness[ROLL][best]
        q = -v.effectiveness[PITCH][best]
        square = (r * r + q * q) * size
        if (r * asked[ROLL] + q * asked[PITCH]) / h > ASKED * square:
            return -1
        if not self._grew(age, r / self.gain[ROLL], q / self.gain[PITCH], square * h):
            return -1
        missing = size / real(v.rotors)
        spread = LOAD_G + 0.5 * missing + 3.0 * sqrt(self.load_variance[k])
        return best if abs(lifted + missing) < spread else -1

    def _grew(self, age: int, roll: Real, pitch: Real, whole: Real) -> bool:
        """Whether each third of the age has its part of the change `whole` along (roll, pitch)."""
        third = age // 3
        drift = local(REAL, 3)
        for a in range(3):
            drift[a] = (self.rate[self._place(age)][a] - self.rate[self._place(age + REFERENCE)][a]) * (real(third) / real(REFERENCE))
        for part in range(3):
            end = self.rate[self._place(part * third)]
            start = self.rate[self._place(part * third + third)]
            grown = roll * (end[ROLL] - start[ROLL] - drift[ROLL]) + pitch * (end[PITCH] - start[PITCH] - drift[PITCH])
            if grown < PART * whole:
                return False
        return True


def _one_arm(v: Vehicle, i: int, j: int) -> bool:
    roll = abs(v.effectiveness[ROLL][i] / v.effectiveness[THRUST][i] - v.effectiveness[ROLL][j] / v.effectiveness[THRUST][j])
    pitch = abs(v.effectiveness[PITCH][i] / v.effectiveness[THRUST][i] - v.effectiveness[PITCH][j] / v.effectiveness[THRUST][j])
    return max(roll, pitch) < ONE_ARM
