"""Trust in commands and motion: which states the filter may learn from them, and the momentary error of its model.

In closed loop the commands react to the noise, with four consequences. From small motion the filter would learn the controller's gains
instead of the vehicle's. A loss must not be regressed on a rotor's own jitter. Gains, damping, thrust curve and lag are wrong by some share
of what they multiply, which belongs in the measurement noise. And accelerometer noise must not count as side force: noise in a regressor
biases its coefficient towards 0 (errors in variables).
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import REAL, Flags, Real, Reals, Struct, array, local, real, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator.estimator_sizes import ROTORS, STATES
from rotorwatch.engine.estimator.noise import CLIP, DRIFT, FAST, SLOW, WHITE, Noise
from rotorwatch.engine.estimator.plant import (
    ANSWER_S,
    B1,
    B2,
    B3,
    BURST_S,
    DAMPING,
    DAMPING_RATE,
    DAMPING_RATE_SD,
    GAIN,
    GAIN_MEAN,
    PER_AXIS,
    TAU,
    THETA,
    THRUST,
    USUAL_S,
    Inputs,
    Plant,
    bend,
)

GARROTE = 2.5  # times its calm level (as amplitude) that motion must exceed to stand out
MOST = 6.0  # times its calm level at which a square is clipped when the level is learned
LEVEL_MEMORY_S = 10.0
# Share by which the motion model may be wrong momentarily, per axis and for damping, and the duration of such an error in ticks.
GAIN_ERROR, DAMPING_ERROR = (0.0, 0.0, 0.35, 0.15), 0.3
ERROR_TICKS = 4.0
LAG_ERROR_S = 0.015
# 1 / (m/s) by which the effect of axial air speed may differ from the learned one: rotors lose more in a climb than they gain in a descent.
AIR_ERROR = 0.01
# m/s along the thrust axis above which speed shows the effect of air: slower motion is caused by gusts, whose air flows the other way.
STILL = 0.5
# Rotors that sink into their own wake give unsteady thrust, independently of each other, from WASH_SINK [m/s] (a quarter of the induced
# velocity) on; from twice that speed on the standard deviation is the share WASH.
WASH, WASH_SINK = 0.1, 1.0
LASTING_MEMORY_S = 30.0
GUST_SHARE, LEAST_GAIN = 2.0, 0.3
FAR, FAR_ERROR = 0.3, 0.5
SIDE_FORCE = 0.2  # g: a side force that changes by more within seconds is external
# Shares of full thrust: up to BELOW_LIMIT a rotor gives its commanded thrust; above AT_LIMIT it is saturated and may give only
# BELOW_LIMIT, because batteries sag, and speed controllers and simulated motors saturate early.
BELOW_LIMIT, AT_LIMIT = 0.6, 0.9
# Initial calm levels (squares): angular acceleration of about 0.3 rad/s^2, rate of 0.05 rad/s, side force of 0.3 m/s^2, thrust of 0.05
# hover thrusts.
CALM_TURN, CALM_RATE, CALM_SIDE, CALM_THRUST = 0.09, 0.0025, 0.09, 0.0025


class Seen(Struct):
    """Denoised inputs of a tick, and how informative they are."""

    thrust = array(REAL, ROTORS)  # commands without the rotors' own jitter
    forward: Real = 0.0  # side force without noise
    right: Real = 0.0
    gain_share = array(REAL, STATES)  # share of the Kalman gain that each state gets
    far: Real = 0.0  # distance from hover beyond FAR, hover thrusts
    part = array(REAL, ROTORS)  # commanded thrust above the mean of all
    trim = array(REAL, ROTORS)  # its mean over USUAL_S


class Memory(Struct):
    """Running statistics of motion, commands, forces and innovations in this flight."""

    turn_level = array(REAL, 3)  # calm variance of angular accelerations
    rate_level = array(REAL, 3)  # calm variance of angular rates
    thrust = array(REAL, ROTORS)  # each rotor's thrust minus the mean of all, averaged over ANSWER_S
    thrust_level = array(REAL, ROTORS)  # its calm variance
    trim = array(REAL, ROTORS)  # the same as thrust, averaged over USUAL_S
    collective: Real = 1.0  # mean thrust that the rotors give, over USUAL_S
    side = array(REAL, 2)  # last side force, forward and right, m/s^2
    push = array(REAL, 2)  # its mean over ANSWER_S
    usual_push = array(REAL, 2)  # its mean over USUAL_S
    lately = array(REAL, 2)  # largest recent square of push, decaying with ANSWER_S
    side_level = array(REAL, 2)  # variance of its changes from tick to tick
    wrench = array(REAL, 4)  # the last valid one
    burst = array(REAL, 4)  # mean square of the normalised innovations over BURST_S
    lasting = array(REAL, 4)  # the same for their running means over TAU[1], over LASTING_MEMORY_S
    innovation_mean = array(REAL, 4)

    def begin(self, p: Plant) -> None:
        """Set the initial levels."""
        for a in range(3):
            self.turn_level[a] = CALM_TURN
            self.rate_level[a] = CALM_RATE
        for a in range(2):
            self.side_level[a] = CALM_SIDE
        for i in range(p.rotors):
            self.thrust_level[i] = CALM_THRUST
        for a in range(4):
            self.burst[a] = 1.0
            self.lasting[a] = 1.0

    def weigh_inputs(self, p: Plant, now: Inputs, s: Reals, lost: Reals, noise: Noise, flying: bool, seen: Seen) -> None:
        """Weigh one tick's inputs against the running statistics. s: state; lost (4,): part of the wrench that the known losses
        take."""
        n = p.rotors
        # A tick without commands (a gap in the log, an interrupted link) does not change the statistics.
        past = p.dt if now.valid[0] else 0.0
        fade = past / LEVEL_MEMORY_S if flying else 0.0
        for r in range(THETA + n):
            seen.gain_share[r] = 1.0
        self._motion(p, now, s, lost, noise, fade, seen)
        self._thrusts(p, now, past, 0.0 if now.restart else fade, seen)
        self._side_force(now, past, 0.0 if now.restart else fade, seen)
        # Punch-outs, drops and knocks: far from hover the lag is uncertain.
        collective = given(p, now, s)
        usual = collective if now.restart else self.collective
        seen.far = max(abs(collective - usual) - FAR, 0.0) + max(abs(now.load / real(n) - 1.0) - FAR, 0.0)
        self.collective = usual + (collective - usual) * (past / USUAL_S)
        for a in range(4):
            if now.restart:
                self.burst[a] = 1.0
                self.innovation_mean[a] = 0.0

    def _motion(self, p: Plant, now: Inputs, s: Reals, lost: Reals, noise: Noise, fade: Real, seen: Seen) -> None:
        for a in range(3):
            turn = now.turn[a] * now.turn[a]
            rate = now.rate[a] * now.rate[a]
            # Below the calm level, angular motion is gyro noise that the rate controller reacts to: the filter would learn the
            # controller's gains instead of the vehicle's. It learns only from motion that stands out (nonnegative garrote).
            turns = stands_out(self.turn_level[a], turn)
            rates = stands_out(self.rate_level[a], rate)
            # Motion caused by gusts does not show the vehicle's parameters: the wrench that it needs must exceed that of gusts.
            x = a * PER_AXIS
            gain = max(s[x + GAIN], LEAST_GAIN * real(p.rotors) * GAIN_MEAN[a])
            gusts = GUST_SHARE * GUST_SHARE * (noise.v[FAST][a] + noise.v[SLOW][a] + noise.v[DRIFT][a] * TAU[1])
            turn_needs = gain * now.turn[a]
            rate_needs = DAMPING_RATE * gain * now.rate[a]
            turns = min(turns, max(0.0, 1.0 - gusts / max(turn_needs * turn_needs, 1e-12)))
            rates = min(rates, max(0.0, 1.0 - gusts / max(rate_needs * rate_needs, 1e-12)))
            # Uncommanded motion comes from a gust or a fault: motion counts only as far as the rotors have caused it.
            need = turn_needs + rate_needs
            made = (now.wrench[a] if now.valid[a] else 0.0) - lost[a] - (s[x + B1] + s[x + B2] + s[x + B3])
            share = min(max(made * need / max(need * need, 1e-12), 0.0), 1.0)
            seen.gain_share[x + GAIN] = turns * share
            seen.gain_share[x + DAMPING] = rates * share
            self.turn_level[a] += fade * (min(turn, MOST * self.turn_level[a]) - self.turn_level[a])
            self.rate_level[a] += fade * (min(rate, MOST * self.rate_level[a]) - self.rate_level[a])

    def _thrusts(self, p: Plant, now: Inputs, past: Real, fade: Real, seen: Seen) -> None:
        """Remove each rotor's jitter from its commanded thrust. A loss is proportional to the rotor's thrust, but a disturbance that the
        controller counteracts through rotor i would correlate with that rotor's own command and look like its loss. The collective part
        is common to all rotors and passes unchanged; the torque part is smoothed unless it stands out."""
        collective = _mean(p, now)
        share = min(past / ANSWER_S, 1.0)
        for i in range(p.rotors):
            part = now.thrust[i] - collective
            before = part if now.restart else self.thrust[i]
            trim = part if now.restart else self.trim[i]
            away = part - before
            clear = stands_out(self.thrust_level[i], away * away) * away
            seen.thrust[i] = max(collective + before + clear, 0.0)
            seen.part[i] = seen.thrust[i] - collective
            seen.trim[i] = self.trim[i]
            self.thrust_level[i] += fade * (min(away * away, MOST * self.thrust_level[i]) - self.thrust_level[i])
            self.thrust[i] = before + away * share
            self.trim[i] = trim + (part - trim) * (past / USUAL_S)

    def _side_force(self, now: Inputs, past: Real, fade: Real, seen: Seen) -> None:
        """Use a side force only while its mean stands out of what white noise with the variance of its tick-to-tick changes would leave
        there. The threshold is 0.2 m/s^2 at first, and less as the flight's own changes become known."""
        share = min(past / ANSWER_S, 1.0)
        for k in range(2):
            side = now.forward if k == 0 else now.right
            push = side if now.restart else self.push[k]
            push += (side - push) * share
            self.lately[k] = max(push * push, self.lately[k] * (1.0 - share))  # so a change of sign does not reset it
            felt = side * stands_out(0.5 * share * self.side_level[k], self.lately[k])
            if k == 0:
                seen.forward = felt
            else:
                seen.right = felt
            change = 0.5 * (side - self.side[k]) * (side - self.side[k])
            self.side_level[k] += fade * (min(change, MOST * self.side_level[k]) - self.side_level[k])
            self.side[k] = side if now.valid[0] else self.side[k]
            self.push[k] = push
            self.usual_push[k] += (push - self.usual_push[k]) * (1.0 if now.restart else past / USUAL_S)

    def variance(self, p: Plant, now: Inputs, seen: Seen, s: Reals, usual: Real, noise: Noise, out: Reals) -> None:
        """Variance (4,) of the model's error at this tick, into out; store the wrench for the next tick. usual: recent mean thrust."""
        n = p.rotors
        bends = local(REAL, ROTORS)
        bend(p, now, seen.thrust, usual, bends)
        square = local(REAL, ROTORS)
        for i in range(n):
            missing = seen.thrust[i] - BELOW_LIMIT * now.full if seen.thrust[i] > AT_LIMIT * now.full else 0.0
            wash = WASH * min(max(-now.axial / WASH_SINK - 1.0, 0.0), 1.0) * seen.thrust[i]
            square[i] = missing * missing + wash * wash
        far = FAR_ERROR * real(n) * seen.far
        for a in range(4):
            motion = now.load - real(n) if a == THRUST else now.turn[a]
            gained = GAIN_ERROR[a] * s[a * PER_AXIS + GAIN] * motion
            damped = DAMPING_ERROR * s[a * PER_AXIS + DAMPING] * (0.0 if a == THRUST else now.rate[a])
            air = AIR_ERROR * real(n) * now.axial if a == THRUST else 0.0
            wrench = now.wrench[a] if now.valid[a] else 0.0
            late = LAG_ERROR_S / p.dt * max(abs(wrench - self.wrench[a]) - 4.0 * sqrt(noise.v[WHITE][a]), 0.0)
            total = gained * gained + damped * damped + far * far + air * air + late * late
            bent = 0.0
            for i in range(n):
                total += p.effect[a][i] * p.effect[a][i] * square[i]
                bent += p.effect[a][i] * bends[i]
            out[a] = ERROR_TICKS * total + bent * bent
            if now.valid[a]:
                self.wrench[a] = now.wrench[a]

    def calm(self, axis: int) -> Real:
        """Weight of this tick's evidence on an axis: below 1 while innovations exceed the noise model (gusts come in bursts)."""
        return 1.0 / max(max(self.burst[axis], self.lasting[axis]), 1.0)

    def unsure(self) -> Real:
        """Factor, at least 1, by which error variances exceed those of the noise model; mean of all axes."""
        total = 0.0
        for a in range(4):
            total += max(max(self.burst[a], self.lasting[a]), 1.0)
        return 0.25 * total

    def remember(self, p: Plant, innovation: Reals, variance: Reals, counts: Flags) -> None:
        """Add one tick's innovations, where the axis is valid (counts)."""
        for a in range(4):
            if counts[a]:
                size = innovation[a] / sqrt(variance[a])
                self.burst[a] += p.dt / BURST_S * (min(size * size, CLIP) - self.burst[a])
                self.innovation_mean[a] += p.dt / TAU[1] * (size - self.innovation_mean[a])
                # White innovations would give a mean over TAU[1] this variance.
                mean = self.innovation_mean[a]
                lasting = min(mean * mean * (2.0 * TAU[1] / p.dt - 1.0), CLIP)
                self.lasting[a] += p.dt / LASTING_MEMORY_S * (lasting - self.lasting[a])

    def outside(self, p: Plant) -> Real:
        """Torque, in hover thrusts, that an external side force may cause: an obstacle, a tether, a hand or the ground push at a lever arm
        similar to that of the rotors."""
        x = self.push[0] - self.usual_push[0]
        y = self.push[1] - self.usual_push[1]
        return real(p.rotors) * max(sqrt(x * x + y * y) / G0 - SIDE_FORCE, 0.0)


def given(p: Plant, now: Inputs, s: Reals) -> Real:
    """Mean thrust that the rotors give, with the losses of the state s: beside a weak rotor less than is commanded."""
    total = 0.0
    for i in range(p.rotors):
        total += now.thrust[i] * (1.0 - min(max(s[THETA + i], 0.0), 1.0))
    return total / real(p.rotors)


def _mean(p: Plant, now: Inputs) -> Real:
    total = 0.0
    for i in range(p.rotors):
        total += now.thrust[i]
    return total / real(p.rotors)


def stands_out(level: Real, square: Real) -> Real:
    """Share, 0 to 1, by which a signal with this square stands out of its calm level (nonnegative garrote)."""
    return max(0.0, 1.0 - GARROTE * GARROTE * level / max(square, 1e-12))


def shows_air(axial: Real) -> Real:
    """Share, 0 to 1, of the gain with which AIR is learned at a speed along the thrust axis [m/s]."""
    return max(0.0, 1.0 - STILL * STILL / max(axial * axial, 1e-12))


def unknown_damping(p: Plant, s: Reals) -> Real:
    """Variance of the excess of the true roll and pitch damping over the state's: up to two prior standard deviations above the mean."""
    gain = max(0.5 * (s[GAIN] + s[PER_AXIS + GAIN]), LEAST_GAIN * real(p.rotors) * GAIN_MEAN[0])
    most = (DAMPING_RATE + 2.0 * DAMPING_RATE_SD) * gain  # light vehicles with long arms
    return most * most
