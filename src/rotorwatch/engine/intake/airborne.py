"""Detect when the vehicle is in the air, from motor commands, motion and the autopilot's reported state.

Steps of 0.05 s that use only past samples. A flight ends where the landing or the fall began to show, up to CONFIRM_S before that is
certain. The autopilot's "landed" alone does not suffice: it clears when the throttle rises, seconds before the vehicle leaves the ground,
is set seconds after touch-down, and is missing from many logs.
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
"""The last motor command is held for this long. After a longer gap (a lost link, a busy disk, a damaged file) the first command after it
shows whether the vehicle flew on: the trim must not be learned again after the gap, or a loss from before or during it would count as
healthy."""
MOST_GAP_S = 60.0
"""A longer gap always ends a flight: it leaves time for a landing, another load and another take-off."""
CONFIRM_S = 4.5
"""The end of a flight is certain at most this long after it, usually within 1.5 s."""

_IDLE_S = 2.0  # time constant of the idle command seen on the ground
_HOVER_S = 5.0  # time constant of the usual command in the air
_RISE = 0.08  # command above idle, share of the range, below which nothing flies
_HIGH, _HIGH_RISE = 0.25, 0.10  # command, and its rise above idle, that alone mean flight if they last
_HIGH_S, _HIGH_BLIND_S = 5.0, 1.0  # ... this long, with and without a velocity measurement
# A vehicle with far more thrust than weight hovers below all these. It is airborne when it climbs on more than its command at rest.
_ABOVE, _LEAST = 1.3, 0.02  # multiple of the command at rest, and share of the range, that count as more
_REST_S_UP = 10.0  # time constant of a rise of the command at rest; it falls at once
_CLIMB, _SPEED = 0.25, 1.0  # m/s
_SINKING = 1.0  # m/s down: faster means not yet on the ground, however low the command
_HEIGHT = 0.2  # m gained since the command became high
_LOW = 0.65  # fraction of the way from idle to hover below which the rotors do not carry the vehicle
_LOW_S = 1.5
_CARRIED = 0.9  # the same: a vehicle at rest below this stands on the ground
_SETTLING, _RESTING = 0.25, 0.15  # m/s: descent at the end of a landing, roughly on the ground
_REST_S = 3.0  # s of rest after a descent, beyond which the vehicle hovers
_FALLING = 0.75 * G0  # specific force below which a vehicle with idle motors is falling, not landed
_LYING_S = 1.0
_STILL = 0.5  # rad/s: faster rotation excludes resting on the ground
_BLOW = 1.2 * G0  # lateral specific force, or half of it downwards, beyond what rotors can produce: from the ground
LEVER_M = 0.05  # of an accelerometer from the axis of a spin: its centripetal force is no blow
BLOW_S = 3.0  # a shock this long before the end of a flight was the touch-down or the crash
_WINDOW_S = 0.5
_FRESH_S = 1.0  # age beyond which a measurement is unknown


class HalfSecond(Struct):
    """Magnitude and component along the rotors' thrust of a vector's samples over half a second; NaN for invalid samples."""

    time = array(TIME, HALF_SECOND)
    size = array(REAL, HALF_SECOND)
    upward = array(REAL, HALF_SECOND)
    first: int = 0
    count: int = 0

    def add(self, time: Time, size: Real, upward: Real) -> None:
        """Add a sample."""
        while self.count > 0 and (self.time[self.first] < time - _WINDOW_S or self.count == HALF_SECOND):
            self.first = (self.first + 1) % HALF_SECOND
            self.count -= 1
        at = (self.first + self.count) % HALF_SECOND
        self.time[at] = time
        self.size[at] = size
        self.upward[at] = upward
        self.count += 1

    def known(self, time: Time) -> bool:
        """Return whether the newest sample is at most one second old."""
        return self.count > 0 and time - self.time[(self.first + self.count - 1) % HALF_SECOND] <= _FRESH_S

    def mean(self, time: Time, upward: bool) -> Real:
        """Return the mean of the valid samples, of the magnitude or the component along thrust; NaN if none is valid or all are old."""
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
    """A completed flight, s."""

    start: Time = 0.0
    end: Time = 0.0


class Senses(Struct):
    """Measurements at one tick; NaN: unknown."""

    command: Real = 0.0  # root mean square of the motor commands, share of their range
    climb: Real = 0.0  # m/s up
    speed: Real = 0.0  # m/s, horizontal
    force: Real = 0.0  # m/s^2, magnitude of the specific force, mean of half a second
    upward: Real = 0.0  # m/s^2, its component along the rotors' thrust, likewise
    turning: Real = 0.0  # rad/s, magnitude of the angular rate, likewise
    struck: bool = False  # a specific force, in this tick, that rotors cannot produce


class Airborne(Struct):
    """Detect the flights of one vehicle from its samples in time order.

    A flight starts when the command is well above idle and the vehicle climbs or moves, when it keeps climbing on more than its command
    at rest, or when the command is high for long. It ends when the command stays low while the vehicle neither falls nor sinks fast nor
    turns; at once when the autopilot reports landed or disarmed; or when something other than the rotors carries the vehicle: it lies on
    the ground tilted or upside down. If the vehicle had come to rest from a descent just before, it stood on the ground since then,
    however long its rotors kept pushing.
    """

    force = embedded(HalfSecond)
    turning = embedded(HalfSecond)
    tick: Time = 0.0  # number of the next tick
    velocity_time: Time = -LASTS
    blow: Time = -LASTS  # last force that rotors cannot produce
    spin: Real = 0.0  # (rad/s)^2, of the last angular rate
    last: Time = -LASTS  # time of the last command
    climb: Real = 0.0
    speed: Real = 0.0
    command: Real = 0.0
    landed: int = -1  # the autopilot's last report: 1 or 0, -1 before the first
    armed: int = -1
    walking: bool = False  # commands have been received
    down: bool = False  # since the last command the autopilot has reported that it is on the ground
    since: Time = -LASTS  # when the present state began
    high_since: Time = LASTS  # LASTS: not at present
    raised_since: Time = LASTS
    gained: Real = 0.0  # m, gained since then
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
    rest: Real = 0.0  # smallest recent command
    drift_at_rest: Real = 0.0
    climbed: Real = 0.0  # m, of a continuing climb on more than the command at rest
    idle_known: bool = False
    flying: bool = False
    stands: bool = False  # on the ground since the last flight, with the rotors pushing
    start: Time = LASTS  # start of the current flight, LASTS on the ground
    flights = array(Span, FLIGHTS)  # completed flights
    ended: int = 0  # number of completed flights
    seen = array(TIME, ROTORS)  # when each output was last known
    unseen: Mask = 0  # outputs unknown for longer than a gap, in the current or last flight

    def outputs(self, v: Vehicle, time: Time, output: Reals, valid: Flags) -> None:
        """Add motor outputs at `time` s.

        The command is their root mean square: thrust grows with the square, and if one rotor is at rest the others still carry the
        vehicle.
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
        most = _BLOW + LEVER_M * self.spin
        if valid and (x * x + y * y > most * most or z > most - _BLOW / 2.0):
            self.blow = time

    def gyro(self, time: Time, x: Real, y: Real, z: Real, valid: bool) -> None:
        """Angular rate, body FRD, rad/s."""
        self.walk(time, False)
        self.turning.add(time, sqrt(x * x + y * y + z * z) if valid else NAN, 0.0)
        self.spin = x * x + y * y + z * z if valid else 0.0

    def velocity(self, time: Time, climb: Real, speed: Real) -> None:
        """Climb rate and horizontal speed, m/s; NaN: unknown."""
        self.walk(time, False)
        self.velocity_time = time
        self.climb = climb
        self.speed = speed

    def state(self, time: Time, landed: int, armed: int) -> None:
        """Landed and armed as reported by the autopilot: 1 or 0; -1: unchanged."""
        self.walk(time, False)
        self.down = self.down or landed == 1 or armed == 0
        if landed >= 0:
            self.landed = landed
        if armed >= 0:
            self.armed = armed

    def walk(self, time: Time, inclusive: bool) -> None:
        """Process all complete ticks, once all samples before `time` s have arrived, or up to it."""
        if not self.walking and self.last > -LASTS and time > self.last + MOST_GAP_S:
            self._end_flight()
        while self.walking:
            now = self.tick * TICK_S
            if now > self.last + GAP_S:  # the last command is held for this long
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
        """No more samples will come: a flight in progress ends with the last command."""
        if self.start < LASTS:
            self._store(self.last)

    def end_of(self, i: int) -> Time:
        """Return the end of completed flight i: where its end began to show, and not after the last command."""
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
        # In the air, specific force comes from the rotors, along -z. On the ground it does not, unless the vehicle stands on its feet.
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
        # Where climb is not measured, a vehicle that turns after its rotors pushed has left the ground, even if they idle now.
        turns = self.high_since < LASTS and isnan(now.climb) and now.turning > _STILL
        rests = abs(now.climb) < _RESTING and not now.speed > _SETTLING
        self.stands = self.stands and rests and not self._less(now.command, _LOW)
        self.high_since = _lasting(self.high_since, (high or turns) and not self.stands, time)
        self.height = self.height + TICK_S * climb if high else 0.0
        self.rest = min(now.command, _blend(self.rest, now.command, _REST_S_UP)) if self.idle_known else now.command
        above = now.command > _ABOVE * self.rest + _LEAST
        # The idle command follows a throttle that is raised slowly up to the hover; the smallest command does not.
        raised = (above or self.raised_since < LASTS) and now.command > _HIGH and not self.stands
        raised = raised and self.landed != 1 and self.armed != 0
        self.raised_since = _lasting(self.raised_since, raised, time)
        plain = 0.0 if isnan(now.climb) else now.climb - self.drift_at_rest
        self.gained = self.gained + TICK_S * plain if raised else 0.0
        self.climbed = self.climbed + TICK_S * plain if above and plain > _CLIMB else 0.0
        if not above and not isnan(now.climb):
            self.drift_at_rest = _blend(self.drift_at_rest, now.climb, _IDLE_S)
        lifted = self._lifted(time, now, climb, above)
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

    def _lifted(self, time: Time, now: Senses, climb: Real, above: bool) -> bool:
        high_for = time - self.high_since if self.high_since < LASTS else 0.0
        if self.lying_since < LASTS:
            return False
        if not self.idle_known:  # the log begins with running motors: in mid-flight
            return high_for >= TICK_S
        if self.landed == 1 or self.armed == 0:  # only a clear climb overrides an old report
            return self.height > 5.0 * _HEIGHT
        if now.command < self.idle + _RISE:
            return False
        # A command by which it has just landed does not lift it, whatever the velocity says.
        if (climb > _CLIMB and above) or self.height > _HEIGHT or now.speed > _SPEED + 2.0 * abs(self.drift):
            return True
        return high_for >= (_HIGH_BLIND_S if isnan(now.climb) else _HIGH_S)

    def _climbs_away(self) -> bool:
        """Return whether it climbs away, however low the command; farther where the autopilot does not report that it is in the air."""
        said = self.landed == 0 and self.armed != 0
        return self.lying_since >= LASTS and self.climbed > (_HEIGHT if said else 5.0 * _HEIGHT)

    def _hovers_low(self, time: Time, now: Senses) -> bool:
        """Return whether the command has long been far above the smallest one, however slowly it was raised, with some height where
        known."""
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
        if end - self.last_blow <= BLOW_S:
            end = min(end, self.first_blow)
        self.flying = False
        self.since = max(end, self.since)
        self.high_since = LASTS
        self.raised_since = LASTS
        self.height = 0.0
        self.rest = now.command
        self.climbed = 0.0

    def _rests(self, time: Time, now: Senses) -> None:
        """Time since which the vehicle has neither climbed nor sunk nor moved after a descent, for _REST_S at most: beyond that it
        hovers."""
        if now.climb < -_SETTLING:
            self.sank = time
        if not (abs(now.climb) < _RESTING and not now.speed > _SETTLING):
            self.rest_since = LASTS
        elif self.rest_since >= LASTS and time - self.sank <= _WINDOW_S:
            self.rest_since = time
        elif not self._less(now.command, _CARRIED) and time - self.rest_since > _REST_S:
            self.rest_since = LASTS

    def _less(self, command: Real, share: Real) -> bool:
        """Return whether the command is below this fraction of the way from idle to hover."""
        return command < self.floor + share * (self.hover - self.floor)

    def _continues(self, time: Time) -> bool:
        """Return whether the first command after a gap shows that the vehicle still flies. Conditions timed before the gap start again."""
        self.low_since = LASTS
        self.rest_since = LASTS
        self.lying_since = LASTS
        if time - self.last > MOST_GAP_S or self.down:
            return False
        return self.flying and not self._less(self.command, _LOW)

    def _store(self, end: Time) -> None:
        """Store a completed flight."""
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
        """End the flight at the last command and discard what was learned of it."""
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
    """Time since which a condition has held continuously; LASTS if it does not hold now."""
    return LASTS if not holds else before if before < LASTS else time


def _blend(old: Real, new: Real, constant: Real) -> Real:
    """First-order low pass with the given time constant, s."""
    return old + TICK_S / constant * (new - old)
