"""When the vehicle is in the air, from motor commands, motion and the autopilot's own words.

A walk over ticks of 0.05 s that only looks back. A flight ends where the landing or the fall began to show, up to CONFIRM_S before that
is certain. Why not simply the autopilot's "landed": it clears when the throttle rises, seconds before the vehicle leaves the ground, is
set seconds after touch-down, and many logs lack it.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (  # fmt: skip
    LASTS,
    NAN,
    REAL,
    TIME,
    Flags,
    Mask,
    Real,
    Reals,
    Struct,
    Time,
    array,
    embedded,
    floor,
    isnan,
    real,
    sqrt,
)
from rotorwatch.base.physics import G0
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import FLIGHTS, HALF_SECOND, ROTORS

TICK_S = 0.05
GAP_S = 4.0
"""For so long the last motor command is held. After a longer gap (a link that is cut, a busy disk, a damaged file) the first command after
it says whether the vehicle flew on: learned anew after it, a loss from before or in it would count as healthy."""
MOST_GAP_S = 60.0
"""A longer gap always ends a flight: a landing, another load and another take-off fit into it."""
CONFIRM_S = 4.5
"""The end of a flight is certain at most this long after it, mostly within 1.5 s."""

_IDLE_S = 2.0  # time constant of the idle command seen on the ground
_HOVER_S = 5.0  # time constant of the usual command in the air
_RISE = 0.08  # command above idle, share of the range, below which nothing flies
_HIGH, _HIGH_RISE = 0.25, 0.10  # command, and its rise above idle, that by themselves mean flight once they last
_HIGH_S, _HIGH_BLIND_S = 5.0, 1.0  # ... this long, with and without a velocity that could tell
# A vehicle with much more thrust than weight hovers on less than all these. It has left the ground when it climbs on more than it rests on.
_ABOVE, _LEAST = 1.3, 0.02  # times the command at rest, and share of the range, beyond which it is more
_REST_S_UP = 10.0  # time constant with which the command at rest may rise; it falls at once
_CLIMB, _SPEED = 0.25, 1.0  # m/s
_SINKING = 1.0  # m/s down: the ground is not there yet, however little the rotors are commanded
_HEIGHT = 0.2  # m gained since the command became high
_LOW = 0.65  # part of the way from idle to hover below which the rotors do not carry the vehicle
_LOW_S = 1.5
_CARRIED = 0.9  # the same: a vehicle that rests on less than that stands on the ground
_SETTLING, _RESTING = 0.25, 0.15  # m/s: down at the end of a landing, more or less on the ground
_REST_S = 3.0  # s that a vehicle may rest after it sank before it hovers
_FALLING = 0.75 * G0  # specific force below which a vehicle with idle motors falls and has not landed
_LYING_S = 1.0
_STILL = 0.5  # rad/s: what turns faster does not stand or lie on the ground
_BLOW = 1.2 * G0  # lateral specific force, or half of it downwards, that rotors cannot make: the ground's
_BLOW_S = 3.0  # a blow so long before the end of a flight was the touch-down or the crash
_WINDOW_S = 0.5
_FRESH_S = 1.0  # a measurement that is older is not known


class HalfSecond(Struct):
    """Magnitudes of a vector's samples in half a second, and their part along the rotors' thrust; NaN where a sample is not valid."""

    time = array(TIME, HALF_SECOND)
    size = array(REAL, HALF_SECOND)
    upward = array(REAL, HALF_SECOND)
    first: int = 0
    count: int = 0

    def add(self, time: Time, size: Real, upward: Real) -> None:
        """One more sample."""
        while self.count > 0 and (self.time[self.first] < time - _WINDOW_S or self.count == HALF_SECOND):
            self.first = (self.first + 1) % HALF_SECOND
            self.count -= 1
        at = (self.first + self.count) % HALF_SECOND
        self.time[at] = time
        self.size[at] = size
        self.upward[at] = upward
        self.count += 1

    def known(self, time: Time) -> bool:
        """Whether the newest sample is no older than a second."""
        return self.count > 0 and time - self.time[(self.first + self.count - 1) % HALF_SECOND] <= _FRESH_S

    def mean(self, time: Time, upward: bool) -> Real:
        """Mean of the valid ones, of the magnitude or its upward part; NaN where there is none, or all are old."""
        if not self.known(time):
            return NAN
        total: Real = 0.0
        valid = 0
        for i in range(self.count):
            at = (self.first + i) % HALF_SECOND
            if not isnan(self.size[at]):
                total += self.upward[at] if upward else self.size[at]
                valid += 1
        return total / real(valid) if valid > 0 else NAN


class Span(Struct):
    """A flight that is over, s."""

    start: Time = 0.0
    end: Time = 0.0


class Senses(Struct):
    """What is known at one tick; NaN: not known."""

    command: Real = 0.0  # root mean square of the motor commands, share of their range
    climb: Real = 0.0  # m/s up
    speed: Real = 0.0  # m/s, horizontal
    force: Real = 0.0  # m/s^2, magnitude of the specific force, mean of half a second
    upward: Real = 0.0  # m/s^2, its part along the rotors' thrust, the same
    turning: Real = 0.0  # rad/s, magnitude of the angular rate, the same
    struck: bool = False  # a specific force, just now, that rotors cannot make


class Airborne(Struct):
    """Follows one vehicle, sample by sample in the order of time.

    A flight starts when the command is well above idle and the vehicle climbs or moves, when it goes on to climb on more than it rested
    on, or when the command is high for long. It ends when
    the command stays low while the vehicle neither falls nor sinks fast nor turns, at once where the autopilot says landed or disarmed;
    or when something other than the rotors carries the vehicle: it lies on the ground tilted or upside down. A vehicle that had come to
    rest from sinking just before that stood on the ground since then, however long its rotors pushed on.
    """

    force = embedded(HalfSecond)
    turning = embedded(HalfSecond)
    tick: Time = 0.0  # number of the next tick
    velocity_time: Time = -LASTS
    blow: Time = -LASTS  # the last force that rotors cannot make
    last: Time = -LASTS  # time of the last command
    climb: Real = 0.0
    speed: Real = 0.0
    command: Real = 0.0
    landed: int = -1  # the autopilot's last word: 1 or 0, -1 before the first
    armed: int = -1
    walking: bool = False  # there are commands
    down: bool = False  # the autopilot has reported since the last command that it is on the ground
    since: Time = -LASTS  # when the present state began
    high_since: Time = LASTS  # LASTS: not so
    raised_since: Time = LASTS
    gained: Real = 0.0  # m, since then
    low_since: Time = LASTS
    lying_since: Time = LASTS
    sank: Time = -LASTS
    rest_since: Time = LASTS
    first_blow: Time = -LASTS
    last_blow: Time = -LASTS
    idle: Real = 0.0
    floor: Real = 0.0
    hover: Real = 0.0
    drift: Real = 0.0
    height: Real = 0.0
    rest: Real = 0.0  # least command of late
    drift_at_rest: Real = 0.0
    climbed: Real = 0.0  # m, of a climb that goes on, on more than that
    idle_known: bool = False
    flying: bool = False
    stands: bool = False  # on the ground since the last flight, its rotors pushing
    start: Time = LASTS  # of the flight that goes on, LASTS on the ground
    flights = array(Span, FLIGHTS)  # that are over
    ended: int = 0  # how many these are
    seen = array(TIME, ROTORS)  # when each output was known last
    unseen: Mask = 0  # outputs that are not known for longer than a gap, in the flight that goes on or was the last

    def outputs(self, v: Vehicle, time: Time, output: Reals, valid: Flags) -> None:
        """Motor outputs at `time` s.

        The command is their root mean square: thrust grows with the square, and rotors that fly on beside one that rests carry the
        vehicle all the same.
        """
        total: Real = 0.0
        count = 0
        unseen: Mask = 0
        self.walk(time, False)
        for k in range(v.rotors):
            if valid[k]:
                share = (output[k] - v.output_low) / (v.output_high - v.output_low)
                share = max(0.0, min(1.0, share))
                total += share * share
                count += 1
                self.seen[k] = time
            elif time - max(self.seen[k], self.start) > GAP_S:
                unseen |= 1 << k
        if count == 0:
            return
        if self.start < LASTS:
            self.unseen = unseen
        self.command = sqrt(total / real(count))
        if not self.walking:
            if self.last > -LASTS and not self._continues(time):
                self._end_flight()
            self.walking = True
            self.tick = -floor(-time / TICK_S)
        self.last = time
        self.down = False

    def accel(self, time: Time, x: Real, y: Real, z: Real, valid: bool) -> None:
        """Specific force, body FRD, m/s^2."""
        self.walk(time, False)
        self.force.add(time, sqrt(x * x + y * y + z * z) if valid else NAN, -z if valid else NAN)
        if valid and (x * x + y * y > _BLOW * _BLOW or z > _BLOW / 2.0):
            self.blow = time

    def gyro(self, time: Time, x: Real, y: Real, z: Real, valid: bool) -> None:
        """Angular rate, body FRD, rad/s."""
        self.walk(time, False)
        self.turning.add(time, sqrt(x * x + y * y + z * z) if valid else NAN, 0.0)

    def velocity(self, time: Time, climb: Real, speed: Real) -> None:
        """Climb rate and horizontal speed, m/s; NaN: not known."""
        self.walk(time, False)
        self.velocity_time = time
        self.climb = climb
        self.speed = speed

    def state(self, time: Time, landed: int, armed: int) -> None:
        """The autopilot says that it has landed, or is armed: 1 or 0; -1: as before."""
        self.walk(time, False)
        self.down = self.down or landed == 1 or armed == 0
        if landed >= 0:
            self.landed = landed
        if armed >= 0:
            self.armed = armed

    def walk(self, time: Time, inclusive: bool) -> None:
        """All samples before `time` s have come, or up to it: go over the ticks of which all is known."""
        if not self.walking and self.last > -LASTS and time > self.last + MOST_GAP_S:
            self._end_flight()
        while self.walking:
            now = self.tick * TICK_S
            if now > self.last + GAP_S:  # the last command is held for so long
                if time > self.last + GAP_S:
                    self.walking = False
                    if time > self.last + MOST_GAP_S:
                        self._end_flight()
                return
            if now > time or (not inclusive and now >= time):
                return
            self._step(now)
            self.tick += 1.0

    def close(self) -> None:
        """No sample comes any more: a flight that lasts ends with the last command."""
        if self.start < LASTS:
            self._store(self.last)

    def end_of(self, i: int) -> Time:
        """When flight i of those that are over ended: where its end began to show, and not after the last command."""
        return min(self.flights[i].end, self.last)

    def _step(self, time: Time) -> None:
        now = Senses()
        moving = time - self.velocity_time <= _FRESH_S
        now.command = self.command
        now.climb = self.climb if moving else NAN
        now.speed = self.speed if moving else NAN
        now.force = self.force.mean(time, False)
        now.upward = self.force.mean(time, True)
        now.turning = self.turning.mean(time, False)
        now.struck = time - TICK_S < self.blow <= time
        # In the air, specific force is what the rotors push: along -z. Lying still on anything but the feet, it is not.
        lying = abs(now.force - G0) < 2.0 and now.upward < 0.7 * now.force and now.turning < _STILL
        self.lying_since = _lasting(self.lying_since, lying, time)
        if self.flying:
            self._in_the_air(time, now)
        else:
            self._on_the_ground(time, now)
        if self.flying and self.start >= LASTS:
            self.start = time
        elif not self.flying and self.start < LASTS:
            self._store(self.since)

    def _on_the_ground(self, time: Time, now: Senses) -> None:
        ground = self.idle if self.idle_known else 0.0
        high = now.command > max(_HIGH, ground + _HIGH_RISE)
        climb = 0.0 if isnan(now.climb) else now.climb - self.drift
        # Where nothing measures the climb, a vehicle that turns after its rotors pushed has left the ground, idle as they may be now.
        turns = self.high_since < LASTS and isnan(now.climb) and now.turning > _STILL
        rests = abs(now.climb) < _RESTING and not now.speed > _SETTLING
        self.stands = self.stands and rests and not self._less(now.command, _LOW)
        self.high_since = _lasting(self.high_since, (high or turns) and not self.stands, time)
        self.height = self.height + TICK_S * climb if high else 0.0
        self.rest = min(now.command, _blend(self.rest, now.command, _REST_S_UP)) if self.idle_known else now.command
        above = now.command > _ABOVE * self.rest + _LEAST
        # The idle command follows a throttle that is raised slowly up to the hover; the least one does not.
        raised = (above or self.raised_since < LASTS) and now.command > _HIGH and not self.stands
        raised = raised and self.landed != 1 and self.armed != 0
        self.raised_since = _lasting(self.raised_since, raised, time)
        plain = 0.0 if isnan(now.climb) else now.climb - self.drift_at_rest
        self.gained = self.gained + TICK_S * plain if raised else 0.0
        self.climbed = self.climbed + TICK_S * plain if above and plain > _CLIMB else 0.0
        if not above and not isnan(now.climb):
            self.drift_at_rest = _blend(self.drift_at_rest, now.climb, _IDLE_S)
        lifted = self._lifted(time, now, climb)
        if lifted or self._climbs_away() or self._hovers_low(time, now):
            self.flying = True
            self.since = time
            self.floor = ground if lifted else self.rest
            self.hover = max(now.command, ground + _HIGH_RISE) if lifted else now.command
            self.idle = self.floor
            self.idle_known = True
            self.low_since = LASTS
            self.rest_since = LASTS
            self.sank = -LASTS
            self.first_blow = -LASTS
            self.last_blow = -LASTS
        elif not high:
            self.idle = _blend(self.idle, now.command, _IDLE_S) if self.idle_known else now.command
            self.idle_known = True
            if now.command < self.idle + _RISE and not isnan(now.climb):
                self.drift = _blend(self.drift, now.climb, _IDLE_S)

    def _lifted(self, time: Time, now: Senses, climb: Real) -> bool:
        high_for = time - self.high_since if self.high_since < LASTS else 0.0
        if self.lying_since < LASTS:
            return False
        if not self.idle_known:  # it begins with running motors: in the middle of a flight
            return high_for >= TICK_S
        if self.landed == 1 or self.armed == 0:  # a stale word is overruled only by a plain climb
            return self.height > 5.0 * _HEIGHT
        if now.command < self.idle + _RISE:
            return False
        if climb > _CLIMB or self.height > _HEIGHT or now.speed > _SPEED + 2.0 * abs(self.drift):
            return True
        return high_for >= (_HIGH_BLIND_S if isnan(now.climb) else _HIGH_S)

    def _climbs_away(self) -> bool:
        """However little is commanded; farther where the autopilot does not say that it is in the air."""
        said = self.landed == 0 and self.armed != 0
        return self.lying_since >= LASTS and self.climbed > (_HEIGHT if said else 5.0 * _HEIGHT)

    def _hovers_low(self, time: Time, now: Senses) -> bool:
        """Far more than the least command for long, however slowly it was raised; and some height, where that is known."""
        raised = self.raised_since < LASTS and time - self.raised_since >= _HIGH_S
        return self.idle_known and self.lying_since >= LASTS and raised and (isnan(now.climb) or self.gained > 2.0 * _HEIGHT)

    def _in_the_air(self, time: Time, now: Senses) -> None:
        low = self._less(now.command, _LOW)
        end = LASTS
        # Pilots fly rolls and dives with idle motors.
        grounded = low and not now.climb < -_SINKING and not now.turning > _STILL
        self.low_since = _lasting(self.low_since, grounded, time)
        if not low and self.rest_since >= LASTS:
            self.hover = _blend(self.hover, now.command, _HOVER_S)
        self._rests(time, now)
        if now.struck:
            if time - self.last_blow > 1.0:
                self.first_blow = time
            self.last_blow = time
        if low and (self.landed == 1 or self.armed == 0):
            end = self.low_since if self.low_since < LASTS else time
        elif self.low_since < LASTS and not now.force < _FALLING and time - self.low_since >= _LOW_S:
            end = self.low_since
        elif self.lying_since < LASTS and time - self.lying_since >= _LYING_S:
            end = self.lying_since - _WINDOW_S
        elif self.rest_since < LASTS and time - self.rest_since >= _REST_S and self._less(now.command, _CARRIED):
            end = self.rest_since
            self.stands = True
        if end >= LASTS:
            return
        end = min(end, self.rest_since)
        if end - self.last_blow <= _BLOW_S:
            end = min(end, self.first_blow)
        self.flying = False
        self.since = max(end, self.since)
        self.high_since = LASTS
        self.raised_since = LASTS
        self.height = 0.0
        self.rest = now.command
        self.climbed = 0.0

    def _rests(self, time: Time, now: Senses) -> None:
        """Since when the vehicle has neither climbed nor sunk nor moved after it sank, for _REST_S at most: longer, it hovers."""
        if now.climb < -_SETTLING:
            self.sank = time
        if not (abs(now.climb) < _RESTING and not now.speed > _SETTLING):
            self.rest_since = LASTS
        elif self.rest_since >= LASTS and time - self.sank <= _WINDOW_S:
            self.rest_since = time
        elif not self._less(now.command, _CARRIED) and time - self.rest_since > _REST_S:
            self.rest_since = LASTS

    def _less(self, command: Real, share: Real) -> bool:
        """Is it less than this part of the way from idle to hover?"""
        return command < self.floor + share * (self.hover - self.floor)

    def _continues(self, time: Time) -> bool:
        """Does the vehicle still fly after a gap, by the first command after it? What lasted before the gap begins anew."""
        self.low_since = LASTS
        self.rest_since = LASTS
        self.lying_since = LASTS
        if time - self.last > MOST_GAP_S or self.down:
            return False
        return self.flying and not self._less(self.command, _LOW)

    def _store(self, end: Time) -> None:
        """A flight is over."""
        if min(end, self.last) > self.start:
            if self.ended == FLIGHTS:
                for i in range(FLIGHTS - 1):
                    self.flights[i].start = self.flights[i + 1].start
                    self.flights[i].end = self.flights[i + 1].end
                self.ended -= 1
            self.flights[self.ended].start = self.start
            self.flights[self.ended].end = end
            self.ended += 1
        self.start = LASTS

    def _end_flight(self) -> None:
        """The flight ended with the last command; what was learned of it goes."""
        self.close()
        self.since = -LASTS
        self.first_blow = -LASTS
        self.last_blow = -LASTS
        self.high_since = LASTS
        self.raised_since = LASTS
        self.low_since = LASTS
        self.rest_since = LASTS
        self.sank = -LASTS
        self.lying_since = LASTS
        self.idle = 0.0
        self.floor = 0.0
        self.hover = 0.0
        self.drift = 0.0
        self.height = 0.0
        self.rest = 0.0
        self.drift_at_rest = 0.0
        self.climbed = 0.0
        self.idle_known = False
        self.flying = False
        self.stands = False


def _lasting(before: Time, holds: bool, time: Time) -> Time:
    """Since when a condition has held that now `holds`; LASTS when it does not."""
    return LASTS if not holds else before if before < LASTS else time


def _blend(old: Real, new: Real, constant: Real) -> Real:
    """First-order low pass with the given time constant, s."""
    return old + TICK_S / constant * (new - old)
