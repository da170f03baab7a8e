"""Knocks: forces and torques on the vehicle that its rotors cannot produce, whatever their condition.

Rotors push along the body's axis and turn it by differences of thrust. A sideways force that begins within a tick, a lift that was not
commanded, or an angular acceleration beyond what the commands and the loss of any two rotors explain comes from outside: another vehicle,
an obstacle, the ground. The consequences - tumbling, saturated outputs, a bent arm - must not be read as the loss of a rotor.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, LASTS, REAL, Real, Reals, Struct, Time, Times, array, local, real, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS, TICKS_BEFORE

TURNED, PUSHED_SIDEWAYS, PUSHED_UP = 0, 1, 2

SIDEWAYS, UPWARD = 0.5, 0.8  # g, relative to the half second before; drag and gusts change by less than 0.2 g in a tick
SHAKES = 2.5  # ... and this multiple of the vibration: sampled slowly, it can look like a steady push
# Hover thrusts per rad/s^2 and rotor that a small vehicle (arms of 5 cm) needs in roll, pitch and yaw: no vehicle needs less.
LEAST_GAIN = (0.0015, 0.0015, 0.03)
TURNS = 5.0  # rad/s^2, in the same tick or the one before: an impact also turns the vehicle, vibration does not
TOGETHER_S = 1.0  # knocks within this time are one


class Vibration(Struct):
    """Deviation of the specific force from its mean over the half second before, from the first sample to now."""

    total: Time = 0.0  # (m/s^2)^2: a sum over the whole flight, which would stop growing in single precision
    count: int = 0

    def sample(self, x: Real, y: Real, z: Real, total: Times, count: int) -> None:
        """Add a sample, m/s^2; total [3] and count: of the samples in the half second before it. Contributions of knocks are clipped."""
        square: Time = 0.0
        if count > 0:
            dx = float(x) - total[0] / float(count)
            dy = float(y) - total[1] / float(count)
            dz = float(z) - total[2] / float(count)
            square = dx * dx + dy * dy + dz * dz
        self.total += min(square, G0 * G0)
        if self.count < 2000000000:
            self.count += 1

    def rms(self) -> Real:
        """Root mean square so far, m/s^2."""
        return real(sqrt(self.total / float(self.count))) if self.count > 0 else 0.0


class Shove(Struct):
    """Commands and motion of one tick, as tested for a knock."""

    time: Time = 0.0
    thrust = array(REAL, ROTORS)  # commanded, hover thrusts
    torque = array(REAL, 3)  # commanded roll, pitch and yaw, hover thrusts: effectiveness times thrust
    rate_dot = array(REAL, 3)  # angular acceleration, rad/s^2
    forward: Real = 0.0  # specific force, mean of this tick alone, m/s^2
    right: Real = 0.0
    load: Real = 0.0  # specific force up over g
    shake: Real = 0.0  # vibration at the beginning of the tick, m/s^2
    fresh: bool = False  # in the air, with all of these known
    accelerometer: bool = False  # forward, right, load and shake are known


class Touch(Struct):
    """A contact, and the part of one tick in it."""

    time: Time = 0.0  # of its first tick
    size: Real = 0.0  # g, or hover thrusts of one rotor where it turned the vehicle; its largest tick so far
    push: int = TURNED
    hit: bool = False  # an external force or torque acted in this tick
    is_new: bool = False  # a new contact, or one larger than known before


class Contact(Struct):
    """Detect contacts from the ticks of one vehicle, on the ground as well."""

    hit: Time = -LASTS  # time of the last tick with a knock
    last = array(Touch, 1)
    before = array(REAL, TICKS_BEFORE, 4)  # side force, load, load less mean thrust of the previous ticks; 0 where not fresh
    fresh = array(FLAG, TICKS_BEFORE)
    turning: Real = 0.0  # rad/s^2, of the tick before
    recent = array(REAL, ROTORS)  # recent thrust: motors that are cut still turn
    next: int = 0

    def tick(self, v: Vehicle, x: Shove, back: int, found: Touch) -> None:
        """Process a tick. back: number of ticks in half a second, the reference; found: the tick's part in a contact."""
        sizes = local(REAL, 3)
        limits = local(REAL, 3)
        mean: Real = 0.0
        turning: Real = 0.0
        best = TURNED
        last = self.last[0]
        for axis in range(3):
            turning = max(turning, abs(x.rate_dot[axis]))
        turns = max(turning, self.turning) > TURNS
        self.turning = turning
        for k in range(v.rotors):
            mean += x.thrust[k] / real(v.rotors)
            self.recent[k] = max(x.thrust[k], self.recent[k] * (1.0 - 2.0 / real(max(back, 2))))
        usable = x.fresh and x.accelerometer
        for k in range(back):
            usable = usable and self.fresh[k]
        limits[PUSHED_SIDEWAYS] = max(SIDEWAYS, SHAKES * x.shake / G0)
        limits[PUSHED_UP] = max(UPWARD, SHAKES * x.shake / G0)
        if x.fresh and turns:
            sizes[TURNED] = _unexplained(v, x, self.recent)
        if usable and turns:
            forward = self._change(x.forward, 0, back)
            right = self._change(x.right, 1, back)
            sizes[PUSHED_SIDEWAYS] = sqrt(forward * forward + right * right) / G0
            # More lift than before, unless the motors were cut and still turn.
            sizes[PUSHED_UP] = min(self._change(x.load, 2, back), self._change(x.load - mean, 3, back))
        if x.accelerometer:
            for kind in range(1, 3):
                if sizes[kind] - limits[kind] > sizes[best] - limits[best]:
                    best = kind
        measured = x.fresh and x.accelerometer
        row = self.before[self.next]
        row[0] = x.forward if measured else 0.0
        row[1] = x.right if measured else 0.0
        row[2] = x.load if measured else 0.0
        row[3] = x.load - mean if measured else 0.0
        self.fresh[self.next] = x.fresh
        self.next = (self.next + 1) % back

        found.hit = sizes[best] - limits[best] > 0.0
        found.is_new = False
        if not found.hit:
            return
        same = (best == TURNED) == (last.push == TURNED)
        if x.time - self.hit > TOGETHER_S:
            last.time = x.time
            found.is_new = True
        if found.is_new or (same and sizes[best] > last.size):
            last.size = sizes[best]
            last.push = best
            found.is_new = True
        self.hit = x.time
        found.time = last.time
        found.size = last.size
        found.push = last.push

    def _change(self, value: Real, column: int, back: int) -> Real:
        """Difference of a value from the mean of the previous ticks, all of them fresh."""
        total: Real = 0.0
        for k in range(back):
            total += self.before[k][column]
        return value - total / real(back)


def _unexplained(v: Vehicle, x: Shove, recent: Reals) -> Real:
    """Smallest torque that the motion requires beyond the torque commanded in its direction and the loss of any two rotors.

    recent: recent thrusts, at least the present ones. Commands against the motion count for nothing: they may come a tick early.
    """
    most: Real = -1e30
    first: Real = 0.0
    second: Real = 0.0
    for axis in range(3):
        turn = x.rate_dot[axis]
        commanded = x.torque[axis] if turn > 0.0 else -x.torque[axis] if turn < 0.0 else 0.0
        most = max(most, LEAST_GAIN[axis] * real(v.rotors) * abs(turn) - max(commanded, 0.0))
    for k in range(v.rotors):
        if recent[k] > first:
            second = first
            first = recent[k]
        elif recent[k] > second:
            second = recent[k]
    return most - (first + second)
