"""The whole front end: samples of one vehicle in, certain ticks out.

Feed the samples of all kinds together in time order; a sample of time t implies that all older ones have arrived. After each, call `next`
until it returns False. Ticks that may still turn out to be on the ground (a descent on little thrust, a knock) wait until that is known,
up to some seconds.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, LASTS, REAL, Real, Reals, Struct, Time, array, copy, embedded, isnan, local, sqrt
from rotorwatch.engine.intake.airborne import BLOW_S, Airborne
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.deviations import Deviations
from rotorwatch.engine.intake.mixer import Comparison, Mixer, curve
from rotorwatch.engine.intake.sense import Plan, Sense, Sensed
from rotorwatch.engine.intake.sizes import QUEUE, ROTORS
from rotorwatch.engine.intake.ticks import HOVER_LEARN_S, Made, Ticks

# Kinds of samples; those of equal times come in this order. VELOCITY: north, east, down; SPEED: climb rate and horizontal speed alone;
# STATE: landed, armed; VOLTAGE: as a share of full; THRUSTS: input of `sense` without outputs (whole.cut).
VOLTAGE, OUTPUTS, CONTROL, GYRO, ACCEL, VELOCITY, STATE, ATTITUDE, THRUSTS, RATES, SPEED = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10)

HELD_S = 0.15
"""Outputs older than this are not the present command where the rate controller has demanded something else since."""

_LYING_S = 0.5  # how far an end may lie before the evidence of it


class Front(Struct):
    """Front end of one vehicle: its samples to its ticks."""

    air = embedded(Airborne)
    mixer = embedded(Mixer)
    deviations = embedded(Deviations)
    sure = array(Deviations, 1)  # overrides as they were when the landing became uncertain
    sense = embedded(Sense)
    ticks = embedded(Ticks)
    queue = array(Sensed, QUEUE)  # ring
    first: int = 0
    count: int = 0
    certain: int = 0  # number of ticks in the queue that are certain in any case
    taken: int = 0  # ticks that came into the queue so far
    start: Time = LASTS  # start of the current flight, LASTS on the ground
    before_start: Time = LASTS  # of the previous flight
    before_end: Time = -LASTS
    compared: Time = LASTS  # first comparison and first outputs since the landing became uncertain, LASTS without
    logged: Time = LASTS
    newest: Time = -LASTS  # mean time of the commands of the last tick received
    now: Time = -LASTS
    thrust = array(REAL, ROTORS)  # the last outputs as shares of full thrust
    known = array(FLAG, ROTORS)  # which of these outputs were valid
    output_time: Time = -LASTS  # of these outputs
    battery: Real = 1.0  # voltage as a share of full
    doubting: bool = False

    def sample(self, v: Vehicle, p: Plan, kind: int, time: Time, x: Reals) -> None:
        """Add a sample of any kind; NaN: unknown. x: as many numbers as the kind has."""
        if kind == OUTPUTS:
            self.outputs(v, p, time, x)
        elif kind == CONTROL:
            self.control(v, p, time, x)
        elif kind == GYRO:
            self.gyro(v, p, time, x[0], x[1], x[2])
        elif kind == RATES:
            self.rates(v, p, time, x[0], x[1], x[2])
        elif kind == ACCEL:
            self.accel(v, p, time, x[0], x[1], x[2])
        elif kind == VELOCITY:
            self.velocity(v, p, time, x[0], x[1], x[2])
        elif kind == SPEED:
            self.speed(v, p, time, x[0], x[1])
        elif kind == STATE:
            self.state(v, p, time, int(x[0]), int(x[1]))
        elif kind == ATTITUDE:
            self.attitude(v, p, time, x[0], x[1], x[2], x[3])
        elif kind == VOLTAGE:
            self.voltage(v, p, time, x[0])

    def outputs(self, v: Vehicle, p: Plan, time: Time, output: Reals) -> None:
        """Outputs to the motors; NaN: unknown."""
        one = Comparison()
        all_known = True
        for k in range(v.rotors):
            self.known[k] = not isnan(output[k])
            all_known = all_known and self.known[k]
        self.air.outputs(v, time, output, self.known)
        self._advance(v, p, time)
        for k in range(v.rotors):
            self.thrust[k] = curve(v, output[k], self.battery)
        if self.mixer.outputs(v, time, output, all_known, self.battery, one) > 0:
            self._compare(v, one)
        self.deviations.logged(v, time, output, self.thrust, all_known, self._aloft(time))
        self.logged = min(self.logged, time)
        self.output_time = time
        if not p.rebuilt:
            self.sense.thrust(v, p, time, self.thrust, all_known)

    def control(self, v: Vehicle, p: Plan, time: Time, demand: Reals) -> None:
        """Demand of the rate controller on the mixer: roll, pitch, yaw, throttle; NaN: unknown."""
        thrust = local(REAL, ROTORS)
        valid_thrust = local(FLAG, ROTORS)
        valid = not (isnan(demand[0]) or isnan(demand[1]) or isnan(demand[2]) or isnan(demand[3]))
        self._advance(v, p, time)
        one = Comparison()
        while self.mixer.control(v, time, demand, valid, one):
            self._compare(v, one)
        if not p.rebuilt:
            return
        all_known = True
        held = time - self.output_time < HELD_S
        self.mixer.thrust(v, time, demand, valid, self.battery, thrust, valid_thrust)
        for k in range(v.rotors):
            if not valid_thrust[k]:
                thrust[k] = self.thrust[k]
            all_known = all_known and (valid_thrust[k] or (held and self.known[k]))
        self.sense.thrust(v, p, time, thrust, all_known)

    def gyro(self, v: Vehicle, p: Plan, time: Time, x: Real, y: Real, z: Real) -> None:
        """Angular rate, body FRD, rad/s; NaN: unknown."""
        valid = not (isnan(x) or isnan(y) or isnan(z))
        self.air.gyro(time, x, y, z, valid)
        self._advance(v, p, time)
        if valid:
            self.sense.gyros.add(time, x, y, z)

    def rates(self, v: Vehicle, p: Plan, time: Time, x: Real, y: Real, z: Real) -> None:
        """Angular rate derived from the attitude, slow, where there is no gyro."""
        self._advance(v, p, time)
        if not (isnan(x) or isnan(y) or isnan(z)):
            self.sense.gyros.add(time, x, y, z)

    def accel(self, v: Vehicle, p: Plan, time: Time, x: Real, y: Real, z: Real) -> None:
        """Specific force, body FRD, m/s^2, -9.8 along z at rest; NaN: unknown."""
        valid = not (isnan(x) or isnan(y) or isnan(z))
        self.air.accel(time, x, y, z, valid)
        self._advance(v, p, time)
        if valid:
            self.sense.accel(time, x, y, z)

    def velocity(self, v: Vehicle, p: Plan, time: Time, north: Real, east: Real, down: Real) -> None:
        """Velocity, m/s; NaN: unknown."""
        self.sense.moves(time, north, east, down)
        self.speed(v, p, time, -down, sqrt(north * north + east * east))

    def speed(self, v: Vehicle, p: Plan, time: Time, climb: Real, speed: Real) -> None:
        """Climb rate and horizontal speed, m/s, where the direction is unknown; NaN: unknown."""
        self.air.velocity(time, climb, speed)
        self._advance(v, p, time)

    def state(self, v: Vehicle, p: Plan, time: Time, landed: int, armed: int) -> None:
        """Landed and armed as reported by the autopilot: 1 or 0; -1: unchanged."""
        self.air.state(time, landed, armed)
        self._advance(v, p, time)

    def attitude(self, v: Vehicle, p: Plan, time: Time, w: Real, x: Real, y: Real, z: Real) -> None:
        """Attitude quaternion, body to world, scalar first; NaN: unknown."""
        self._advance(v, p, time)
        self.sense.attitude(time, w, x, y, z)

    def voltage(self, v: Vehicle, p: Plan, time: Time, ratio: Real) -> None:
        """Battery voltage as a share of full, filtered."""
        self._advance(v, p, time)
        if not isnan(ratio):
            self.battery = ratio

    def finish(self, v: Vehicle, p: Plan, time: Time) -> None:
        """End of a log: all samples up to `time` s have arrived, and no more will. A flight lasts as long as there are outputs."""
        self.air.walk(time, True)
        self._landed_or_lifted()
        self.doubting = False
        self.now = LASTS
        self._take_rows(v, p)
        if self.start < LASTS:
            self.air.close()
            self._landed(self.air.last)
        self.certain = self.count

    def next(self, v: Vehicle, p: Plan, out: Made) -> bool:
        """Take the oldest tick that is certainly in the air or on the ground; False where there is none."""
        self._take_rows(v, p)
        if self.count == 0 or not (self.certain > 0 or self.count == QUEUE or self._clear()):
            return False
        row = self.queue[self.first]
        self.ticks.assemble(v, p, row, self._flight_of(row), out)
        self.first = (self.first + 1) % QUEUE
        self.count -= 1
        self.certain = max(0, self.certain - 1)
        return True

    def _clear(self) -> bool:
        """Return whether the oldest tick cannot turn out to be on the ground."""
        if self.start >= LASTS:
            return True
        row = self.queue[self.first]
        if row.when > self.start and (row.when > self._uncertain_from() or row.when > self.air.last):
            return False
        # The hover thrust is learned from all ticks of the first second.
        return not (row.time >= self.start and self.newest < self.start + HOVER_LEARN_S)

    def _uncertain_from(self) -> Time:
        """Earliest time at which the current flight may still turn out to have ended; LASTS: none, it flies."""
        if self.air.start >= LASTS:
            return LASTS
        begin = min(self.air.low_since, self.air.rest_since)
        begin = min(begin, LASTS if self.air.lying_since >= LASTS else self.air.lying_since - _LYING_S)
        if min(begin, self.now) - self.air.last_blow <= BLOW_S:  # an end soon after a shock is moved to the shock
            begin = min(begin, self.air.first_blow)
        return begin

    def _flight_of(self, row: Sensed) -> Time:
        """Start of the flight that contains a tick, LASTS on the ground."""
        if self.start < LASTS and row.time >= self.start + HOVER_LEARN_S:
            return self.start
        if self.before_start < LASTS and row.time >= self.before_start + HOVER_LEARN_S and row.when <= self.before_end:
            return self.before_start
        return LASTS

    def _advance(self, v: Vehicle, p: Plan, now: Time) -> None:
        """Update after `airborne` has processed a sample of time `now`."""
        self.now = now
        self._landed_or_lifted()
        if self._uncertain_from() < LASTS:
            if not self.doubting:
                copy(self.sure[0], self.deviations)
                self.compared = LASTS
                self.logged = LASTS
            self.doubting = True
        else:
            self.doubting = False
        self._take_rows(v, p)

    def _landed_or_lifted(self) -> None:
        if self.air.start < self.start or self.air.start > self.start:
            if self.start < LASTS:
                same_flight = self.air.ended > 0 and self.air.flights[self.air.ended - 1].start <= self.start
                self._landed(self.air.end_of(self.air.ended - 1) if same_flight else self.start)
            self.start = self.air.start

    def _landed(self, end: Time) -> None:
        """The current flight has ended at `end` s: the waiting ticks are certain now."""
        self.before_start = self.start
        self.before_end = end
        self.start = LASTS
        self.certain = self.count
        if self.doubting:
            copy(self.deviations, self.sure[0])
            self.deviations.landed(self.compared, self.logged)
        self.doubting = False

    def _take_rows(self, v: Vehicle, p: Plan) -> None:
        """Move completed ticks into the queue; while ticks of an ended flight wait there, take none of the next one: hover thrust is
        learned for one flight at a time."""
        while self.count < QUEUE and not (self.certain > 0 and self.start < LASTS) and self.sense.ready(p, self.now):
            row = self.queue[(self.first + self.count) % QUEUE]
            self.sense.measure(v, p, row)
            self.count += 1
            self.taken += 1
            self.newest = row.when
            if self.start < LASTS and self.start <= row.when < self.start + HOVER_LEARN_S:
                self.ticks.learn_hover_thrust(v, row, self.start)

    def _aloft(self, time: Time) -> bool:
        return time >= self.start or self.before_start <= time < self.before_end

    def _compare(self, v: Vehicle, one: Comparison) -> None:
        self.deviations.compared(v, one, self._aloft(one.time))
        self.compared = min(self.compared, one.time)
