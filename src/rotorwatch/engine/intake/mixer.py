"""From outputs and the rate controller's output to rotor thrusts.

Outputs u are often logged slowly (ArduPilot: 10 Hz), the rate controller's output c = (roll, pitch, yaw, throttle) often fast. The
autopilot turns c into thrust demands with its mixer M and its gain g (air density),

    t = g M c,        m(u) = t        with m the thrust curve assumed by the autopilot (battery compensation included),

so that the slow m(u) verifies and scales a fast rebuilt t, from which u and the thrust f(u) follow. ArduPilot's m is f; PX4 often assumes
a straight line (THR_MDL_FAC 0) that no motor follows: Vehicle.mixer_expo. The gain is learned in flight, or all factors of an unknown
mixer.

Samples of both come in time order; at equal times outputs first. battery: voltage as a share of full, filtered; 1 where it is not
measured. All thrusts are shares of full thrust. A value at time s uses nothing after s.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (  # fmt: skip
    FLAG,
    LASTS,
    REAL,
    TIME,
    Flags,
    Real,
    Reals,
    Struct,
    Time,
    array,
    copy,
    exp,
    local,
    real,
    sqrt,
)
from rotorwatch.engine.intake.craft import PITCH, ROLL, YAW, Vehicle
from rotorwatch.engine.intake.sizes import PENDING, ROTORS

THROTTLE, CONTROLS = 3, 4

PART = 0.05
"""Share of full thrust by which rebuilt thrust and that of the outputs may differ before the rebuilt one is not valid."""
FLYING = 0.05
"""Share of full thrust above which a rotor's thrust is large enough for a comparison."""
NOISE_SD = 0.004
"""Share of full thrust: rounding to 1 us, and changes of the demand between the controller's samples and those of the outputs."""

_GAIN_MEMORY_S = 20.0  # air density changes with height, slowly
_PAIR_WITHIN_S = 0.15  # outputs further than this from any sample of the rate controller are not compared
_TOGETHER_S = 0.002  # at equal rates outputs come within 1 ms of their rate controller's sample: no need to wait for the next one
_FRESH_S = 0.5  # validity of rebuilt thrust after a comparison


class Comparison(Struct):
    """Comparison of one sample of outputs with the mixer's demand, in shares of full thrust."""

    time: Time = 0.0  # s, of the outputs
    known: Time = 0.0  # s, when the surrounding samples of the rate controller had arrived
    thrust = array(REAL, ROTORS)  # of the outputs, by the curve assumed by the mixer
    demanded = array(REAL, ROTORS)  # by the mixer, as if outputs had no limits
    yaw = array(REAL, ROTORS)  # yaw part of `demanded`
    least = array(REAL, ROTORS)  # demand without those parts of roll, pitch and yaw that add to it
    most = array(REAL, ROTORS)  # ... that take from it
    deviation = array(REAL, ROTORS)  # thrust minus what is demanded, within the limits
    output = array(REAL, ROTORS)  # in the outputs' unit
    top: Real = 0.0  # thrust of u_max
    gain: Real = 1.0  # of the mixer, estimated after this sample
    yaw_granted: bool = False  # the mixer grants the whole yaw demand


class OutputSample(Struct):
    """Outputs waiting for the rate controller's next sample."""

    time: Time = 0.0
    output = array(REAL, ROTORS)
    battery: Real = 0.0


class ControlSample(Struct):
    """A sample of the rate controller: roll, pitch, yaw, throttle."""

    time: Time = 0.0
    value = array(REAL, CONTROLS)


class Mixer(Struct):
    """Compare outputs with the rate controller's, learn the mixer's gain, and rebuild thrusts."""

    pending = array(OutputSample, PENDING)
    first: int = 0
    waiting: int = 0  # number of waiting outputs
    controller = array(ControlSample, 2)  # the last two, the newer second
    controls: int = 0  # number of these
    time: Time = -LASTS  # time of the last comparison
    usable: Time = -LASTS  # time of the last one used to learn the gain
    product: Real = 0.0  # exponentially forgetting means: thrust times demand
    power: Real = 0.0  # ... demand squared
    gain: Real = 1.0
    weights = array(TIME, CONTROLS + 1, ROTORS)  # of an unknown mixer: (roll, pitch, yaw, throttle, 1) -> thrust
    spread = array(TIME, CONTROLS + 1, CONTROLS + 1)  # covariance of a rotor's weights
    good = array(FLAG, ROTORS)  # the last comparison fitted
    confirmed = array(FLAG, ROTORS)  # ... and the one before

    def outputs(self, v: Vehicle, time: Time, output: Reals, valid: bool, battery: Real, out: Comparison) -> int:
        """Add outputs at `time` s. Return the number of comparisons in `out`, 0 or 1."""
        if not valid:
            return 0
        at = self.controls - 1
        while at >= 0 and not self.controller[at].time < time:
            at -= 1
        if at >= 0 and time - self.controller[at].time < _TOGETHER_S:
            self._compare(v, time, time, output, battery, self.controller[at].value, out)
            return 1
        if at < 0:
            return 0
        if self.waiting == PENDING:
            self.first = (self.first + 1) % PENDING
            self.waiting -= 1
        last = self.pending[(self.first + self.waiting) % PENDING]
        last.time = time
        last.battery = battery
        for k in range(v.rotors):
            last.output[k] = output[k]
        self.waiting += 1
        return 0

    def control(self, v: Vehicle, time: Time, control: Reals, valid: bool, out: Comparison) -> bool:
        """Add the rate controller's output at `time` s; call again until it returns False. Where it is True, `out` is a comparison."""
        if not valid:
            return False
        between = local(REAL, CONTROLS)
        while self.waiting > 0:
            waits = self.pending[self.first]
            self.first = (self.first + 1) % PENDING
            self.waiting -= 1
            before = self.controller[self.controls - 1]
            close = time - waits.time < _TOGETHER_S
            if time - waits.time < _PAIR_WITHIN_S and (close or waits.time - before.time < _PAIR_WITHIN_S):
                share = 1.0 if close else real((waits.time - before.time) / (time - before.time))
                for c in range(CONTROLS):
                    between[c] = control[c] if close else (1.0 - share) * before.value[c] + share * control[c]
                known = max(time, waits.time)
                self._compare(v, waits.time, known, waits.output, waits.battery, between, out)
                return True
        self.first = 0
        if self.controls == 2:
            copy(self.controller[0], self.controller[1])
        else:
            self.controls += 1
        newest = self.controller[self.controls - 1]
        newest.time = time
        for c in range(CONTROLS):
            newest.value[c] = control[c]
        return False

    def thrust(self, v: Vehicle, time: Time, control: Reals, valid: bool, battery: Real, thrust: Reals, valid_thrust: Flags) -> bool:
        """Thrusts for the rate controller's output, after `control` of that sample. Return whether any of them is valid.

        valid_thrust: of each rotor; where False, the last outputs are better: at limits, with more yaw than the mixer grants, and where a
        rotor's last outputs differed (thrust boost, spool-up, an overridden output).
        """
        top = _share(v, v.mixer_expo, v.u_max, battery)
        inside = valid and time - self.time < _FRESH_S and _grants_yaw(v, control)
        some = False
        for k in range(v.rotors):
            demanded = self._demanded(v, control, k)
            drive = _drive(v.mixer_expo, min(max(demanded, 0.0), 1.0))
            inside = inside and 0.005 < demanded < 0.99 * top
            thrust[k] = (1.0 - v.expo) * drive + v.expo * drive * drive
        for k in range(v.rotors):
            valid_thrust[k] = inside and self.confirmed[k]
            some = some or valid_thrust[k]
        return some

    def _compare(self, v: Vehicle, time: Time, known: Time, output: Reals, battery: Real, control: Reals, c: Comparison) -> None:
        """Compare outputs with the rate controller's output of the same time."""
        first = self.time <= -LASTS
        if first:
            self._begin(v)
        c.time = time
        c.known = known
        c.top = _share(v, v.mixer_expo, v.u_max, battery)
        c.yaw_granted = _grants_yaw(v, control)
        for k in range(v.rotors):
            c.output[k] = output[k]
            c.thrust[k] = _share(v, v.mixer_expo, output[k], battery)
        # Each sample is evaluated with the earlier estimate; the first one with its own.
        if not first:
            self._deviations(v, control, c)
        if v.mixer_known:
            self._learn_gain(v, time, control, c.thrust)
        else:
            self._learn_mixer(v, control, c.thrust, c.top)
        if first:
            self._deviations(v, control, c)
        for k in range(v.rotors):
            good = abs(c.deviation[k]) < PART
            self.confirmed[k] = good and self.good[k]
            self.good[k] = good
        self.time = time
        c.gain = self.gain

    def _deviations(self, v: Vehicle, control: Reals, c: Comparison) -> None:
        """Compute the demand of the mixer, by its present estimate, and the deviation of the outputs from it."""
        for k in range(v.rotors):
            c.demanded[k] = self._demanded(v, control, k)
            c.least[k] = c.demanded[k]
            c.most[k] = c.demanded[k]
            for axis in range(3):
                part = control[axis] * (self.gain * v.mixer[k][axis] if v.mixer_known else real(self.weights[axis][k]))
                c.least[k] -= max(part, 0.0)
                c.most[k] -= min(part, 0.0)
                if axis == YAW:
                    c.yaw[k] = part
            c.deviation[k] = c.thrust[k] - min(max(c.demanded[k], 0.0), c.top)

    def _demanded(self, v: Vehicle, control: Reals, k: int) -> Real:
        """Thrust demanded of a rotor by the present estimate of the mixer."""
        if v.mixer_known:
            return self.gain * _mixed(v, control, k)
        total = self.weights[CONTROLS][k]
        for c in range(CONTROLS):
            total += control[c] * self.weights[c][k]
        return real(total)

    def _begin(self, v: Vehicle) -> None:
        """Initialize an unknown mixer: throttle alone, for all rotors alike."""
        for k in range(v.rotors):
            self.weights[THROTTLE][k] = 1.0
        for c in range(CONTROLS + 1):
            self.spread[c][c] = 1.0

    def _learn_gain(self, v: Vehicle, time: Time, control: Reals, thrust: Reals) -> None:
        """Learn a common gain, by a forgetting average over samples whose own gain explains all rotors: none limited, none overridden."""
        demand = local(REAL, ROTORS)
        power: Real = 0.0
        product: Real = 0.0
        least = thrust[0]
        for k in range(v.rotors):
            demand[k] = _mixed(v, control, k)
            power += demand[k] * demand[k]
            product += thrust[k] * demand[k]
            least = min(least, thrust[k])
        own = product / max(power, 1e-12)
        gap: Real = 0.0
        for k in range(v.rotors):
            gap = max(gap, abs(thrust[k] - own * demand[k]))
        if not (least > FLYING and gap < PART and 0.6 < own < 1.7):
            return
        fade = real(exp((self.usable - time) / _GAIN_MEMORY_S))
        self.product = self.product * fade + product
        self.power = self.power * fade + power
        self.usable = time
        self.gain = self.product / self.power

    def _learn_mixer(self, v: Vehicle, control: Reals, thrust: Reals, top: Real) -> None:
        """Learn all factors, by recursive least squares of the thrusts on the rate controller's output."""
        inputs = local(TIME, CONTROLS + 1)
        along = local(TIME, CONTROLS + 1)
        for k in range(v.rotors):
            if not FLYING < thrust[k] < 0.95 * top:
                return
        for c in range(CONTROLS):
            inputs[c] = control[c]
        inputs[CONTROLS] = 1.0
        size: Time = NOISE_SD * NOISE_SD
        for c in range(CONTROLS + 1):
            for d in range(CONTROLS + 1):
                along[c] += self.spread[c][d] * inputs[d]
            size += inputs[c] * along[c]
        for k in range(v.rotors):
            residual: Time = thrust[k]
            for c in range(CONTROLS + 1):
                residual -= inputs[c] * self.weights[c][k]
            for c in range(CONTROLS + 1):
                self.weights[c][k] += along[c] / size * residual
        for c in range(CONTROLS + 1):
            for d in range(CONTROLS + 1):
                self.spread[c][d] -= along[c] / size * along[d]


def curve(v: Vehicle, output: Real, battery: Real) -> Real:
    """Thrust f(u) of an output, share of full."""
    return _share(v, v.expo, output, battery)


def _share(v: Vehicle, expo: Real, output: Real, battery: Real) -> Real:
    """The same for a thrust curve of any expo."""
    a = min(max((output - v.u_min) / (v.u_max - v.u_min), 0.0), 1.0) * battery
    return (1.0 - expo) * a + expo * a * a


def _drive(expo: Real, thrust: Real) -> Real:
    """Inverse of the thrust curve: the share of the output's range, times battery, that gives `thrust`, 0 or more."""
    if expo < 1e-6 or thrust <= 0.0:
        return thrust
    straight = 1.0 - expo
    # The usual (root - straight) / (2 expo) loses digits where expo is small.
    return 2.0 * thrust / (sqrt(straight * straight + 4.0 * expo * thrust) + straight)


def _mixed(v: Vehicle, control: Reals, k: int) -> Real:
    """Thrust of a rotor by a known mixer of gain 1."""
    total: Real = 0.0
    for c in range(CONTROLS):
        total += control[c] * v.mixer[k][c]
    return total


def _grants_yaw(v: Vehicle, control: Reals) -> bool:
    """Return whether the mixer grants the whole yaw demand.

    ArduPilot limits yaw last: to the room that roll and pitch leave every rotor around a throttle of at most 0.5, but never below its
    headroom.
    """
    yaw = abs(control[YAW])
    least: Real = 0.0  # room of the most limited rotor
    if not v.mixer_known:
        return yaw < v.yaw_headroom
    bounded = False
    for k in range(v.rotors):
        factor = v.mixer[k][YAW]
        if abs(factor) > 1e-9:
            tilt = control[ROLL] * v.mixer[k][ROLL] + control[PITCH] * v.mixer[k][PITCH]
            level = min(max(control[THROTTLE], 0.0), 0.5) + tilt
            room = (1.0 - level if control[YAW] * factor > 0.0 else level) / abs(factor)
            least = min(least, room) if bounded else room
            bounded = True
    return not bounded or yaw < max(v.yaw_headroom, 0.95 * least)
