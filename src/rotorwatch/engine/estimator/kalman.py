"""The Kalman filter of one explanation: the plant's state x and the losses theta of its weak rotors.

    s = [x; theta],   s <- A s,   P <- A P A' + Q            Q: noise.py; theta walks while it is refined
    nu = y_a - h_a s,   S = h_a P h_a' + R_a,   s <- s + K nu          axis by axis, as R is diagonal

K is the Kalman gain times the share that each state may learn (model_error.py); the covariance update holds for any gain (Joseph):

    P <- (I - K h) P (I - K h)' + K R K'  =  P - K g' - g K',    g = P h' - S K / 2

A loss is refined for USUAL_S, then fixed, so that model errors cannot erode it.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, REAL, Real, Reals, Struct, array, copy, local, real, sqrt
from rotorwatch.engine.estimator.estimator_sizes import PRODUCTS, ROTORS, STATES
from rotorwatch.engine.estimator.noise import DRIFT, FAST, SLOW, Noise
from rotorwatch.engine.estimator.plant import AIR, B1, B2, B3, BUILT_SD, PER_AXIS, SIDEWAYS, THETA, Plant, Rows, entry

# A loss is not fixed while it still moves: while it differs from its mean over MOVING_S by more than its standard deviation.
MOVING_S = 2.0
THETA_WALK = 0.02 * 0.02  # 1/s, while it is refined
OUTLIER = 6.0  # standard deviations at which an innovation is limited, by a larger S


class Measured(Struct):
    """Measured wrench of a tick."""

    y = array(REAL, 4)
    R = array(REAL, 4)  # variance of its noise
    counts = array(FLAG, 4)  # the axis is valid


class Branch(Struct):
    """An explanation: a set of weak rotors with its own filter."""

    s = array(REAL, STATES)
    P = array(REAL, PRODUCTS)  # lower triangle, row by row
    weight: Real = 0.0  # log weight, 0 for the leader
    onset: Real = 0.0  # ticks since the last jump of a rotor
    active = array(FLAG, ROTORS)  # weak rotors
    alike = array(FLAG, ROTORS)  # in a pair that other pairs are indistinguishable from
    learning = array(REAL, ROTORS)  # s for which their losses are still refined
    variance = array(REAL, ROTORS)  # of the losses, once fixed
    mean = array(REAL, ROTORS)  # of the losses, over MOVING_S
    gives = array(REAL, ROTORS)  # thrust of rotors that ignore their command, 0 for others
    gain = array(REAL, 4, STATES)  # of the last tick, axis by axis
    innovation = array(REAL, 4)
    S = array(REAL, 4)  # variance of the innovation

    def weak(self, p: Plant) -> bool:
        """Whether any rotor is weak."""
        for i in range(p.rotors):
            if self.active[i]:
                return True
        return False

    def begin(self, p: Plant) -> None:
        """Initialise before the first tick: no rotor is weak; rotors differ as built, about the mean of all."""
        n = p.rotors
        for r in range(THETA):
            self.s[r] = p.mean[r]
            for c in range(r + 1):
                self.P[entry(r, c)] = p.variance[r][c]
        for i in range(n):
            for j in range(i + 1):
                own = 1.0 if i == j else 0.0
                self.P[entry(THETA + i, THETA + j)] = BUILT_SD * BUILT_SD * (own - 1.0 / real(n))

    def hop(self, p: Plant) -> None:
        """Start a new hop: keep the vehicle's parameters and the differences between healthy rotors; forget biases and weak rotors."""
        for a in range(4):
            self.forget(p, a * PER_AXIS + B1)
            self.forget(p, a * PER_AXIS + B2)
            self.forget(p, a * PER_AXIS + B3)
        for i in range(p.rotors):
            if self.active[i]:
                self.forget(p, THETA + i)
                self.P[entry(THETA + i, THETA + i)] = BUILT_SD * BUILT_SD
            self.active[i] = False
            self.alike[i] = False
            self.learning[i] = 0.0
            self.variance[i] = 0.0

    def forget(self, p: Plant, r: int) -> None:
        self.s[r] = 0.0
        for c in range(THETA + p.rotors):
            self.P[entry(r, c)] = 0.0

    def open(self, p: Plant) -> None:
        """Widen the biases by their prior variance, after a contact or at a new hop."""
        for a in range(4):
            for b in range(a * PER_AXIS + B1, a * PER_AXIS + B3 + 1):
                for d in range(4):
                    for c in range(d * PER_AXIS + B1, min(d * PER_AXIS + B3, b) + 1):
                        self.P[entry(b, c)] += p.variance[b][c]

    def predict(self, p: Plant, noise: Noise, unsure: Real, flying: bool) -> None:
        """Predict by one tick. unsure: factor by which error variances exceed those of the noise model. A loss that has been refined long
        enough is fixed and its variance stored; a rotor whose loss turns out below BUILT_SD is no longer weak."""
        n = p.rotors
        for i in range(n):
            theta = self.s[THETA + i]
            mean = self.mean[i] + (theta - self.mean[i]) * (p.dt / MOVING_S)
            variance = unsure * self.P[entry(THETA + i, THETA + i)]
            finished = self.learning[i] > 0.0 and self.learning[i] <= p.dt
            moving = finished and abs(theta - mean) > sqrt(max(variance, 0.0))
            self.mean[i] = mean
            self.learning[i] = MOVING_S if moving else max(self.learning[i] - p.dt, 0.0)
            if finished and not moving:
                for r in range(THETA + n):
                    self.P[entry(THETA + i, r)] = 0.0
                self.variance[i] = variance
                if theta < BUILT_SD:
                    self.variance[i] = 0.0
                    self.active[i] = False
        for r in range(SIDEWAYS):
            if p.decay[r] < 1.0:
                self.s[r] *= p.decay[r]
        for r in range(THETA + n):
            first = entry(r, 0)
            for c in range(min(r + 1, SIDEWAYS)):
                self.P[first + c] *= p.decay[r] * p.decay[c]
        if flying:  # process noise that keeps b1 and b2 stationary and lets b3 walk
            for a in range(4):
                b = a * PER_AXIS
                self.P[entry(b + B1, b + B1)] += noise.v[FAST][a] * (1.0 - p.left[0] * p.left[0])
                self.P[entry(b + B2, b + B2)] += noise.v[SLOW][a] * (1.0 - p.left[1] * p.left[1])
                self.P[entry(b + B3, b + B3)] += noise.v[DRIFT][a] * p.dt
        for i in range(n):
            if self.learning[i] > 0.0:
                self.P[entry(THETA + i, THETA + i)] += THETA_WALK * p.dt

    def update(self, p: Plant, rows: Rows, m: Measured, gain_share: Reals) -> None:
        """Update with one tick's wrench. gain_share: share of the Kalman gain that each state gets."""
        for a in range(4):
            self._axis(p, a, rows.h[a], m, gain_share, self.gain[a])

    def _axis(self, p: Plant, a: int, h: Reals, m: Measured, gain_share: Reals, K: Reals) -> None:
        states = THETA + p.rotors
        Ph = local(REAL, STATES)
        g = local(REAL, STATES)
        nu = m.y[a]
        S = m.R[a]
        for part in range(2):
            first = a * PER_AXIS if part == 0 else SIDEWAYS
            last = min(first + PER_AXIS, SIDEWAYS) if part == 0 else states
            for r in range(first, last):
                weight = h[r]
                place = entry(r, 0)
                for c in range(r + 1):
                    Ph[c] += weight * self.P[place + c]
                for c in range(r + 1, states):
                    Ph[c] += weight * self.P[entry(c, r)]
                nu -= weight * self.s[r]
        for part in range(2):
            first = a * PER_AXIS if part == 0 else SIDEWAYS
            last = min(first + PER_AXIS, SIDEWAYS) if part == 0 else states
            for r in range(first, last):
                S += h[r] * Ph[r]
        S = max(S, nu * nu / (OUTLIER * OUTLIER))
        self.S[a] = S
        self.innovation[a] = nu if m.counts[a] else 0.0
        if not m.counts[a]:
            for r in range(states):
                K[r] = 0.0
            return
        for r in range(states):
            K[r] = Ph[r] / S * gain_share[r]
        # Air takes thrust, it gives none; the bank sees this through the gain.
        if self.s[AIR] + K[AIR] * nu < 0.0:
            K[AIR] = -self.s[AIR] / nu
        for r in range(states):
            self.s[r] += K[r] * nu
            g[r] = Ph[r] - 0.5 * S * K[r]
        for r in range(states):
            at = entry(r, 0)
            mine = K[r]
            half = g[r]
            for c in range(r + 1):
                self.P[at + c] -= mine * g[c] + half * K[c]


def swap(a: Branch, b: Branch, room: Branch) -> None:
    """Swap two explanations. room: workspace."""
    copy(room, a)
    copy(a, b)
    copy(b, room)
