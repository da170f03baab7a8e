"""The whole front end: samples of one vehicle in, ticks that are certain out.

Feed every sample in the order of its time, of all kinds together; feeding a sample of time t says that all older ones have come. After
each, call `next` until it returns False. Ticks that may still turn out to lie on the ground (a descent on little thrust, a knock) wait
until that is known, up to some seconds.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, LASTS, REAL, Real, Reals, Struct, Time, array, copy, embedded, isnan, local, sqrt
from rotorwatch.engine.intake.airborne import Airborne
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.deviations import Deviations
from rotorwatch.engine.intake.mixer import Comparison, Mixer, curve
from rotorwatch.engine.intake.sense import Plan, Sense, Sensed
from rotorwatch.engine.intake.sizes import QUEUE, ROTORS
from rotorwatch.engine.intake.ticks import HOVER_LEARN_S, Made, Ticks

# Kinds of samples; those of equal times come in this order. VELOCITY: north, east, down; SPEED: climb rate and horizontal speed alone;
# STATE: landed, armed; VOLTAGE: as a share of full; THRUSTS: what `sense` takes without outputs (whole.cut).
VOLTAGE, OUTPUTS, CONTROL, GYRO, ACCEL, VELOCITY, STATE, ATTITUDE, THRUSTS, RATES, SPEED = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10)

HELD_S = 0.15
"""Outputs older than this are not what is commanded now, where the rate controller asks for something else in between."""

_LYING_S, _BLOW_S = 0.5, 3.0  # of airborne: by how much an end may lie before what showed it


class Front(Struct):
    """One vehicle, from its samples to its ticks."""

    air = embedded(Airborne)
    mixer = embedded(Mixer)
    deviations = embedded(Deviations)
    sure = array(Deviations, 1)  # as they were when the doubt about the landing began
    sense = embedded(Sense)
    ticks = embedded(Ticks)
    queue = array(Sensed, QUEUE)  # ring
    first: int = 0
    count: int = 0
    certain: int = 0  # of the queue: so many are certain, whatever comes
    start: Time = LASTS  # of the flight that goes on, LASTS on the ground
    before_start: Time = LASTS  # of the flight before
    before_end: Time = -LASTS
    compared: Time = LASTS  # first comparison and first outputs since the doubt began, LASTS without
    logged: Time = LASTS
    newest: Time = -LASTS  # mean time of the commands of the last tick that came
    now: Time = -LASTS
    thrust = array(REAL, ROTORS)  # the last outputs as shares of full thrust
    known = array(FLAG, ROTORS)  # which of these outputs were valid
    output_time: Time = -LASTS  # of these outputs
    battery: Real = 1.0  # voltage as a share of full
    doubting: bool = False

    def sample(self, v: Vehicle, p: Plan, kind: int, time: Time, x: Reals) -> None:
        """One sample of any kind; NaN: not known. x: as many numbers as the kind has."""
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
        """Outputs to the motors; NaN: not known."""
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
        """What the rate controller demands of the mixer: roll, pitch, yaw, throttle; NaN: not known."""
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
        """Angular rate, body FRD, rad/s; NaN: not known."""
        valid = not (isnan(x) or isnan(y) or isnan(z))
        self.air.gyro(time, x, y, z, valid)
        self._advance(v, p, time)
        if valid:
            self.sense.gyros.add(time, x, y, z)

    def rates(self, v: Vehicle, p: Plan, time: Time, x: Real, y: Real, z: Real) -> None:
        """Angular rate where there is no gyro: from the attitude, slow."""
        self._advance(v, p, time)
        if not (isnan(x) or isnan(y) or isnan(z)):
            self.sense.gyros.add(time, x, y, z)

    def accel(self, v: Vehicle, p: Plan, time: Time, x: Real, y: Real, z: Real) -> None:
        """Specific force, body FRD, m/s^2, -9.8 along z at rest; NaN: not known."""
        valid = not (isnan(x) or isnan(y) or isnan(z))
        self.air.accel(time, x, y, z, valid)
        self._advance(v, p, time)
        if valid:
            self.sense.accel(time, x, y, z)

    def velocity(self, v: Vehicle, p: Plan, time: Time, north: Real, east: Real, down: Real) -> None:
        """Velocity, m/s; NaN: not known."""
        self.sense.moves(time, north, east, down)
        self.speed(v, p, time, -down, sqrt(north * north + east * east))

    def speed(self, v: Vehicle, p: Plan, time: Time, climb: Real, speed: Real) -> None:
        """Climb rate and horizontal speed, m/s, where nothing says in which direction; NaN: not known."""
        self.air.velocity(time, climb, speed)
        self._advance(v, p, time)

    def state(self, v: Vehicle, p: Plan, time: Time, landed: int, armed: int) -> None:
        """The autopilot says that it has landed, or is armed: 1 or 0; -1: nothing new."""
        self.air.state(time, landed, armed)
        self._advance(v, p, time)

    def attitude(self, v: Vehicle, p: Plan, time: Time, w: Real, x: Real, y: Real, z: Real) -> None:
        """Attitude quaternion, body to world, scalar first; NaN: not known."""
        self._advance(v, p, time)
        self.sense.attitude(time, w, x, y, z)

    def voltage(self, v: Vehicle, p: Plan, time: Time, ratio: Real) -> None:
        """Battery voltage as a share of full, filtered."""
        self._advance(v, p, time)
        if not isnan(ratio):
            self.battery = ratio

    def finish(self, v: Vehicle, p: Plan, time: Time) -> None:
        """The end of a log: all samples up to `time` s have come, and no more will. A flight lasts as long as there are outputs."""
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
        """The oldest tick of which it is known whether it lies in the air; False where there is none."""
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
        """Whether the oldest tick cannot turn out to lie on the ground."""
        if self.start >= LASTS:
            return True
        row = self.queue[self.first]
        if row.when > self.start and (row.when > self._uncertain_from() or row.when > self.air.last):
            return False
        # What carries the vehicle is learned from all ticks of the first second.
        return not (row.time >= self.start and self.newest < self.start + HOVER_LEARN_S)

    def _uncertain_from(self) -> Time:
        """The earliest moment at which the flight that goes on may still turn out to have ended; LASTS: none, it flies."""
        if self.air.start >= LASTS:
            return LASTS
        begin = min(self.air.low_since, self.air.rest_since)
        begin = min(begin, LASTS if self.air.lying_since >= LASTS else self.air.lying_since - _LYING_S)
        if min(begin, self.now) - self.air.last_blow <= _BLOW_S:  # an end soon after a blow is put where that was
            begin = min(begin, self.air.first_blow)
        return begin

    def _flight_of(self, row: Sensed) -> Time:
        """Start of the flight in which a tick lies, LASTS on the ground."""
        if self.start < LASTS and row.time >= self.start + HOVER_LEARN_S:
            return self.start
        if self.before_start < LASTS and row.time >= self.before_start + HOVER_LEARN_S and row.when <= self.before_end:
            return self.before_start
        return LASTS

    def _advance(self, v: Vehicle, p: Plan, now: Time) -> None:
        """After a sample of time `now` has reached the gate."""
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
        """The flight that went on has ended at `end` s: the ticks that wait are certain now."""
        self.before_start = self.start
        self.before_end = end
        self.start = LASTS
        self.certain = self.count
        if self.doubting:
            copy(self.deviations, self.sure[0])
            self.deviations.landed(self.compared, self.logged)
        self.doubting = False

    def _take_rows(self, v: Vehicle, p: Plan) -> None:
        """Ticks that have become known, into the queue; while some of a flight that ended wait there, none of the next one: what carries
        the vehicle is learned of one flight at a time."""
        while self.count < QUEUE and not (self.certain > 0 and self.start < LASTS) and self.sense.ready(p, self.now):
            row = self.queue[(self.first + self.count) % QUEUE]
            self.sense.measure(v, p, row)
            self.count += 1
            self.newest = row.when
            if self.start < LASTS and self.start <= row.when < self.start + HOVER_LEARN_S:
                self.ticks.learn_hover_thrust(v, row, self.start)

    def _aloft(self, time: Time) -> bool:
        return time >= self.start or self.before_start <= time < self.before_end

    def _compare(self, v: Vehicle, one: Comparison) -> None:
        self.deviations.compared(v, one, self._aloft(one.time))
        self.compared = min(self.compared, one.time)
