"""From samples to ticks: commands and measured motion of each tick. A tick uses nothing measured after it.

Pairs the commands sent during one tick length with the motion they caused a motor lag later:

    commands   mean of the rotor thrusts in (t - dt - a, t - a],     a = lag + dt / 2
    motion     over a window of length dt centred a lag after them
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (  # fmt: skip
    LASTS,
    NAN,
    REAL,
    TIME,
    Real,
    Reals,
    Struct,
    Time,
    Times,
    array,
    embedded,
    floor,
    isnan,
    local,
    real,
    reset,
)
from rotorwatch.base.physics import G0
from rotorwatch.engine.intake.airborne import GAP_S
from rotorwatch.engine.intake.contact import Vibration
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import LEVELS, MOTION_SAMPLES, ROTORS, WAITING

SIDE_S = 0.5  # averaging time of side forces: they change as slowly as speed and wind, and vibration is stronger
BEFORE_S = 0.5  # reference time for vibration
LATE_S = 0.9  # motion that is this late is not awaited, where it is sampled often enough: less than the second after lift-off
NO_COMMAND_S = 0.2  # after a tick: no command in it
SUM_S = 1e-9  # rounding of two sums of the same times: a tick must not wait for the next sample because of it
FRESH_S = 1.0  # velocity and attitude older than this, or apart by more, give no airspeed
MOST_AXIAL = 30.0  # m/s: a larger value is wrong
MOST_TICKS = 1e9  # limit of tick numbers in 32 bits: a larger clock jump is not followed


class Plan(Struct):
    """Division of a flight into ticks, fixed by its sampling rates. Constant: may be stored in flash."""

    dt: Time = 0.05  # s, length of a tick
    lag: Time = 0.02  # s, delay of motion behind commands
    phase: Time = 0.0  # s, offset of the ticks' ends; 0 except for commands as slow as ticks
    ready: Time = 8.0  # s after lift-off that are not evaluated
    gyro_half: Time = 0.025  # s, half of the time over which it is averaged
    accel_half: Time = 0.025
    gyro_least: int = 1  # samples in that time, below which it is unknown
    accel_least: int = 1
    side_least: int = 1  # the same of half a second of the accelerometer
    late: Time = LATE_S  # s, motion that is this late is not awaited
    before: int = 10  # ticks in half a second
    hover: Real = 0.0  # a gyro is present
    gyro: bool = False  # an accelerometer is present
    accel: bool = False
    rebuilt: bool = False  # thrusts come from the rate controller's output, which is sampled faster than the outputs


class Sensed(Struct):
    """A tick as measured, in the air or not."""

    time: Time = 0.0  # s, when the whole tick is known
    when: Time = 0.0  # s, mean time of its commands
    number: int = 0  # from the first command on; some are left out in a long gap
    share = array(REAL, ROTORS)  # mean share of full thrust
    rate = array(REAL, 3)  # angular rate, rad/s
    rate_dot = array(REAL, 3)  # angular acceleration, rad/s^2
    load: Real = 1.0  # specific force up over g
    push = array(REAL, 2)  # specific force forward and right, of this tick, m/s^2
    side = array(REAL, 2)  # the same over half a second; 0 where not known
    shake: Real = 0.0  # vibration so far, m/s^2
    level: Real = 1.0  # cosine of the tilt, 1 where it is not known
    axial: Real = NAN  # speed along the thrust axis, m/s, positive when climbing along it; NaN if unknown
    some: bool = False  # commands were received
    rate_ok: bool = True
    load_ok: bool = False


class Samples(Struct):
    """The last samples of a vector, interpolated linearly."""

    time = array(TIME, MOTION_SAMPLES)
    x = array(REAL, MOTION_SAMPLES)
    y = array(REAL, MOTION_SAMPLES)
    z = array(REAL, MOTION_SAMPLES)
    start: Time = LASTS  # time of the very first sample
    first: int = 0
    count: int = 0

    def place(self, k: int) -> int:
        """Index of sample k, the oldest being 0."""
        return (self.first + k) % MOTION_SAMPLES

    def newest(self) -> Time:
        """Time of the last sample."""
        return self.time[self.place(self.count - 1)] if self.count > 0 else -LASTS

    def add(self, time: Time, x: Real, y: Real, z: Real) -> bool:
        """Add a sample; False and ignored unless its time increases."""
        if self.count > 0 and not time > self.newest():
            return False
        if self.start >= LASTS:
            self.start = time
        if self.count == MOTION_SAMPLES:
            self.first = (self.first + 1) % MOTION_SAMPLES
            self.count -= 1
        at = self.place(self.count)
        self.time[at] = time
        self.x[at] = x
        self.y[at] = y
        self.z[at] = z
        self.count += 1
        return True

    def at_or_after(self, time: Time) -> int:
        """First sample at or after `time`; their number if there is none."""
        low = 0
        high = self.count
        while low < high:
            middle = low + (high - low) // 2
            if self.time[self.place(middle)] < time:
                low = middle + 1
            else:
                high = middle
        return low

    def area(self, begin: Time, end: Time, total: Times) -> None:
        """Integral of the three columns between two times; zero before the first and after the last sample."""
        total[0] = 0.0
        total[1] = 0.0
        total[2] = 0.0
        for k in range(max(0, self.at_or_after(begin) - 1), self.count - 1):
            i = self.place(k)
            j = self.place(k + 1)
            if self.time[i] >= end:
                break
            a = max(begin, self.time[i])
            b = min(end, self.time[j])
            if a < b:
                middle = (0.5 * (a + b) - self.time[i]) / (self.time[j] - self.time[i])
                total[0] += (b - a) * (self.x[i] + middle * (self.x[j] - self.x[i]))
                total[1] += (b - a) * (self.y[i] + middle * (self.y[j] - self.y[i]))
                total[2] += (b - a) * (self.z[i] + middle * (self.z[j] - self.z[i]))

    def covers(self, begin: Time, end: Time, least: int) -> bool:
        """Return whether at least so many samples cover the interval."""
        if self.count < 2 or begin < self.start or end > self.newest() + SUM_S:
            return False
        last = self.at_or_after(end)
        if last < self.count and self.time[self.place(last)] <= end:
            last += 1
        return last - self.at_or_after(begin) >= least


class Levels(Struct):
    """Recent attitudes: cosine of the tilt, and speed along the thrust axis."""

    time = array(TIME, LEVELS)
    level = array(REAL, LEVELS)
    axial = array(REAL, LEVELS)
    first: int = 0
    count: int = 0

    def add(self, time: Time, level: Real, axial: Real) -> None:
        """Add an attitude; ignored unless its time increases."""
        if self.count > 0 and not time > self.time[(self.first + self.count - 1) % LEVELS]:
            return
        if self.count == LEVELS:
            self.first = (self.first + 1) % LEVELS
            self.count -= 1
        at = (self.first + self.count) % LEVELS
        self.time[at] = time
        self.level[at] = level
        self.axial[at] = axial
        self.count += 1

    def find(self, time: Time) -> int:
        """Index of the last one known at `time`, or else of the first; -1 without any."""
        for k in range(self.count - 1, -1, -1):
            i = (self.first + k) % LEVELS
            if self.time[i] <= time or k == 0:
                return i
        return -1


class Bin(Struct):
    """Commands of one tick."""

    when: Time = 0.0  # s, sum since the end of the first tick
    total = array(REAL, ROTORS)
    number: int = -1
    count: int = 0


class Sense(Struct):
    """Divide the samples of one vehicle into ticks as they arrive, in time order."""

    gyros = embedded(Samples)
    accels = embedded(Samples)
    levels = embedded(Levels)
    velocity = array(REAL, 3)  # last velocity, north, east, down, m/s; NaN if unknown
    moved: Time = -LASTS  # s, when that was
    bins = array(Bin, WAITING)  # by number of the tick
    origin: Time = 0.0  # s, end of tick 0
    vibration = embedded(Vibration)
    before = array(TIME, 3)  # sum of the accelerometer over the half second before the next sample of the vibration
    fed: int = 0  # stored samples already used for the vibration
    tail: int = 0  # start of that half second
    next: int = 0  # number of the next tick
    last: int = -1  # number of the last tick with complete commands, -1: none
    commanded: int = 0  # number of the last tick that commands have completed
    gap_from: int = -1  # ticks left out
    gap_to: int = -1
    begun: bool = False

    def thrust(self, v: Vehicle, p: Plan, time: Time, thrust: Reals, ok: bool) -> None:
        """Add thrusts commanded at `time` s, shares of full thrust; ok: all are known."""
        if not self.begun:
            self.begun = True
            self.origin = floor((time - p.phase) / p.dt) * p.dt + p.phase + 0.5 * p.dt
        if abs(time - self.origin) >= MOST_TICKS * p.dt:
            return
        at = max(int((time - self.origin) / p.dt), self.commanded)
        if ok:
            for k in range(max(0, at - 1), at + 2):
                end = self.origin + p.dt * k
                if end - p.dt < time <= end and k >= self.next:
                    one = self.bins[k % WAITING]
                    if one.number != k:
                        reset(one)
                        one.number = k
                    for i in range(v.rotors):
                        one.total[i] += thrust[i]
                    one.when += time - self.origin
                    one.count += 1
        if self.last >= 0 and at - self.commanded > 2 * _gap(p):  # a longer gap holds no flight
            self.gap_from = self.commanded + _gap(p)
            self.gap_to = at - _gap(p)
            if self.next >= self.gap_from:
                self.next = self.gap_to
            self.last = at
        else:
            self.last = max(self.last, at)  # the first tick contains the first command
        self.commanded = at

    def accel(self, time: Time, x: Real, y: Real, z: Real) -> None:
        """Specific force, m/s^2."""
        if self.accels.count == MOTION_SAMPLES:
            oldest = self.accels.place(0)
            self._shake(self.accels.time[oldest] + BEFORE_S)  # process everything that needs the sample to be removed
            if self.tail == 0:
                self._forget(oldest)
                self.tail = 1
            if self.accels.add(time, x, y, z):
                self.fed -= 1
                self.tail -= 1
        else:
            self.accels.add(time, x, y, z)

    def moves(self, time: Time, north: Real, east: Real, down: Real) -> None:
        """Velocity, m/s; NaN: unknown."""
        self.velocity[0] = north
        self.velocity[1] = east
        self.velocity[2] = down
        self.moved = time

    def attitude(self, time: Time, w: Real, x: Real, y: Real, z: Real) -> None:
        """Attitude quaternion, body to world, scalar first; NaN: unknown."""
        if isnan(x) or isnan(y):
            return
        level = 1.0 - 2.0 * (x * x + y * y)
        across = self.velocity[0] * 2.0 * (x * z + w * y) + self.velocity[1] * 2.0 * (y * z - w * x)
        axial = -(across + self.velocity[2] * level)
        known = abs(time - self.moved) <= FRESH_S and abs(axial) <= MOST_AXIAL
        self.levels.add(time, level, axial if known else NAN)

    def ready(self, p: Plan, now: Time) -> bool:
        """Return whether the next tick can be made at `now` s. Late motion is awaited for a limited time and number of ticks."""
        if not self.begun:
            return False
        quiet = NO_COMMAND_S
        while self.last < self.commanded + _gap(p) - 1 and self.next > self.last and self._end(p) + quiet < now < 1e8:
            self.last += 1
        if self.next > self.last:
            return False
        motion = self._end(p) + p.lag
        if self.last + 1 - self.next >= WAITING - 1 or now > motion + 0.5 * p.dt + p.late:
            return True
        if p.gyro and self.gyros.newest() + SUM_S < motion + p.gyro_half:
            return False
        return not p.accel or self.accels.newest() + SUM_S >= motion + max(p.accel_half, 0.5 * p.dt)

    def measure(self, v: Vehicle, p: Plan, out: Sensed) -> None:
        """Make the next tick."""
        end = self._end(p)
        half = 0.5 * p.dt
        one = self.bins[self.next % WAITING]
        reset(out)
        out.number = self.next
        out.time = end + p.lag + half
        out.when = end - half
        if one.number == self.next and one.count > 0:
            out.some = True
            out.when = self.origin + one.when / float(one.count)
            for i in range(v.rotors):
                out.share[i] = one.total[i] / real(one.count)
        centre = out.when + p.lag
        if p.gyro:
            self._turn(p, centre, out)
        if p.accel:
            self._push(p, centre, out)
        k = self.levels.find(out.time)
        if k >= 0:
            out.level = self.levels.level[k]
            out.axial = self.levels.axial[k] if abs(out.time - self.levels.time[k]) <= FRESH_S else NAN
        self.next += 1
        if self.next == self.gap_from:
            self.next = self.gap_to
            self.gap_from = -1

    def _turn(self, p: Plan, centre: Time, out: Sensed) -> None:
        """Angular rate and its slope: the difference of two short means around the ends, which averages the noise of single samples."""
        total = local(TIME, 3)
        first = local(TIME, 3)
        last = local(TIME, 3)
        begin = centre - p.gyro_half
        stop = centre + p.gyro_half
        part = 0.25 * p.gyro_half
        self.gyros.area(begin, stop, total)
        self.gyros.area(begin, begin + part, first)
        self.gyros.area(stop - part, stop, last)
        for c in range(3):
            out.rate[c] = real(total[c] / (stop - begin))
            out.rate_dot[c] = real((last[c] - first[c]) / part / (2.0 * p.gyro_half - part))
        out.rate_ok = self.gyros.covers(begin, stop, p.gyro_least)

    def _push(self, p: Plan, centre: Time, out: Sensed) -> None:
        """Specific force and vibration."""
        total = local(TIME, 3)
        begin = centre - p.accel_half
        stop = centre + p.accel_half
        late = centre + 0.5 * p.dt
        self._shake(centre - 0.5 * p.dt)
        out.shake = self.vibration.rms()
        self.accels.area(begin, stop, total)
        out.push[0] = real(total[0] / (stop - begin))
        out.push[1] = real(total[1] / (stop - begin))
        out.load = real(-total[2] / (stop - begin) / G0)
        out.load_ok = self.accels.covers(begin, stop, p.accel_least)
        if self.accels.covers(late - SIDE_S, late, p.side_least):
            self.accels.area(late - SIDE_S, late, total)
            out.side[0] = real(total[0] / SIDE_S)
            out.side[1] = real(total[1] / SIDE_S)

    def _shake(self, until: Time) -> None:
        """Update the vibration up to a time, as far as samples have arrived."""
        while self.fed < self.accels.count:
            k = self.accels.place(self.fed)
            if self.accels.time[k] > until:
                return
            while self.tail < self.fed and self.accels.time[self.accels.place(self.tail)] < self.accels.time[k] - BEFORE_S:
                self._forget(self.accels.place(self.tail))
                self.tail += 1
            if self.tail == self.fed:  # empty sums are exactly zero, whatever the rounding
                self.before[0] = 0.0
                self.before[1] = 0.0
                self.before[2] = 0.0
            count = self.fed - self.tail
            self.vibration.sample(self.accels.x[k], self.accels.y[k], self.accels.z[k], self.before, count)
            self.before[0] += self.accels.x[k]
            self.before[1] += self.accels.y[k]
            self.before[2] += self.accels.z[k]
            self.fed += 1

    def _forget(self, k: int) -> None:
        self.before[0] -= self.accels.x[k]
        self.before[1] -= self.accels.y[k]
        self.before[2] -= self.accels.z[k]

    def _end(self, p: Plan) -> Time:
        """Latest time of a command that counts in the next tick."""
        return self.origin + p.dt * self.next


def _gap(p: Plan) -> int:
    """Number of ticks made after the last command and before the next one of a long gap."""
    return int(GAP_S / p.dt + 0.5)
