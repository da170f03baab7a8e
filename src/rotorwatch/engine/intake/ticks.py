"""From the measurements of a tick, and whether the vehicle flew, to the estimator's input.

Units: thrusts in hover thrusts of one rotor (the mean command that carries the weight is 1), found from the first second in the air and
then kept for that flight. All frames body FRD.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, LASTS, NAN, REAL, Real, Struct, Time, array, embedded, real
from rotorwatch.base.medians import median
from rotorwatch.engine.intake.contact import Contact, Shove, Touch
from rotorwatch.engine.intake.craft import THRUST, YAW, Vehicle
from rotorwatch.engine.intake.sense import Plan, Sensed
from rotorwatch.engine.intake.sizes import ROTORS, SETTLING

GROUND, LEARN, ASSESS = 0, 1, 2
AGAIN = 2  # in place of a restart: the trim is learned again, known losses stay

HOVER_LEARN_S = 1.0  # after lift-off: the first second gives the hover command and is not evaluated
TUMBLE_S = 0.3  # of tumbling, after which a vehicle does not hover again in this flight
UPSET_RATE = 6.0  # rad/s of roll or pitch rate: the vehicle tumbles, the hover model no longer applies
UPSET_LEVEL = 0.42261826174069944  # cosine of 65 degrees
# Mean command in hover thrusts below which the vehicle falls or has landed: the balance of its rotors is not informative.
CARRIES = 0.3
CONTROLLED_SHARE, CONTROLLED_RATE = 0.9, 2.0  # of full thrust, and rad/s: below both a vehicle is under control
LEAST_HOVER = 0.02
LEAST_SEEN = 0.5  # share of the blind time after lift-off in which commands must be known; evaluation waits for that


class Made(Struct):
    """A tick as the estimator's input."""

    time: Time = 0.0  # s, when the whole tick was known
    when: Time = 0.0  # s, mean time of its commands
    start: Time = LASTS  # s, start of the flight; LASTS on the ground
    thrust = array(REAL, ROTORS)  # hover thrusts
    wrench = array(REAL, 4)  # commanded roll, pitch, yaw torque and thrust, hover thrusts of one rotor
    rate = array(REAL, 3)  # rad/s
    rate_dot = array(REAL, 3)  # rad/s^2
    load: Real = 1.0  # specific force up over g
    side = array(REAL, 2)  # m/s^2 forward and right, mean of half a second
    axial: Real = NAN  # m/s along the thrust axis, positive when climbing along it; NaN if unknown
    hover: Real = 1.0  # hover thrust: mean share of full thrust per rotor per unit of thrust
    valid = array(FLAG, 4)  # valid components of the wrench
    mode: int = GROUND
    restart: bool = False  # first tick of a flight
    upset: bool = False  # the vehicle tumbles, or has tumbled in this flight
    some: bool = False  # commands were received
    touch = embedded(Touch)

    def ground(self) -> None:
        """Set the tick to on the ground."""
        self.start = LASTS
        self.mode = GROUND
        self.upset = False
        self.touch.is_new = False
        for a in range(4):
            self.valid[a] = False


class Ticks(Struct):
    """State carried from tick to tick."""

    contact = embedded(Contact)
    flight: Time = LASTS  # s, start of the flight whose first second is in progress; LASTS without
    hop: Time = -LASTS  # s, start of the flight of the last tick
    settling = array(REAL, SETTLING)  # share of full thrust over load factor
    hover: Real = 1.0  # share of full thrust at hover
    flown: int = 0  # ticks with commands in this flight
    learned: int = -1  # ticks of controlled flight since the last contact of this flight, -1 without one
    hover_samples: int = 0
    tumbling: int = 0  # consecutive ticks
    tumbled: bool = False  # the vehicle has tumbled in this flight: the rest is a fall
    begun: bool = False

    def learn_hover_thrust(self, v: Vehicle, row: Sensed, start: Time) -> None:
        """Learn the hover thrust before the first tick of a flight is made, from every row with start <= when < start + 1 s, in order."""
        if self.flight < start or self.flight > start:
            self.flight = start
            self.hover_samples = 0
        total: Real = 0.0
        for k in range(v.rotors):
            total += row.share[k]
        if not row.some or not total > 0.0 or not start <= row.when < start + HOVER_LEARN_S or self.hover_samples == SETTLING:
            return
        load = max(0.5, min(2.0, row.load)) if row.load_ok else 1.0
        self.settling[self.hover_samples] = total / real(v.rotors) / load
        self.hover_samples += 1

    def assemble(self, v: Vehicle, p: Plan, row: Sensed, start: Time, out: Made) -> None:
        """Make a tick from a row, in order, on the ground too. start: of its flight (time >= start + 1 s and when <= its end), else
        LASTS."""
        begins = start < self.hop or start > self.hop
        # A flight in whose first second nothing is commanded begins with its first commands.
        inside = start < LASTS and (row.some or not begins or self.hover_samples > 0)
        if not self.begun and p.hover > 0.0:
            self.hover = p.hover
        self.begun = True
        out.time = row.time
        out.when = row.when
        out.start = start
        out.some = row.some
        out.restart = inside and begins
        if (self.flight <= row.time and (self.hover_samples > 0 or inside)) or (
            self.flight > row.time and out.restart and self.hover_samples == 0
        ):
            self._learn_hover(v, p, row)
        if out.restart:
            self.hop = start
            self.tumbled = False
            self.tumbling = 0
            self.learned = -1
            self.flown = 0
            self.hover_samples = 0
        self.flown += 1 if inside and row.some else 0
        # Nothing is learned from ticks without commands; many logs miss single ones.
        ready = row.time >= start + p.ready and self.flown >= int(LEAST_SEEN * (p.ready - HOVER_LEARN_S) / p.dt)
        out.mode = GROUND if not inside else ASSESS if ready else LEARN
        self._tumble(p, row, inside, out)

        turns = False
        most: Real = 0.0
        out.hover = self.hover
        for a in range(4):
            out.wrench[a] = 0.0
        for k in range(v.rotors):
            out.thrust[k] = row.share[k] / self.hover
            most = max(most, row.share[k])
            turns = turns or abs(v.effectiveness[YAW][k]) > 0.0
            for a in range(4):
                out.wrench[a] += v.effectiveness[a][k] * out.thrust[k]
        fresh = row.some and row.rate_ok and (row.load_ok or not p.accel) and inside
        self._touch(v, p, row, fresh, out)

        fastest = max(abs(row.rate[0]), max(abs(row.rate[1]), abs(row.rate[2])))
        # The trim cannot be learned while the vehicle spins or has outputs near their limits.
        if out.touch.hit:
            self.learned = 0
        elif self.learned >= 0 and fresh and most < CONTROLLED_SHARE and fastest < CONTROLLED_RATE:
            self.learned += 1
        if out.mode == ASSESS and 0 <= self.learned < int(p.ready / p.dt + 0.5):
            out.mode = LEARN

        assessed = row.some and inside and not out.upset and not out.touch.hit
        for a in range(3):
            out.valid[a] = assessed and row.rate_ok
            out.rate[a] = row.rate[a]
            out.rate_dot[a] = row.rate_dot[a]
        out.valid[YAW] = out.valid[YAW] and turns  # rotors that make no yaw torque explain none: a servo yaws a tricopter
        out.valid[THRUST] = assessed and row.load_ok
        out.load = row.load
        out.axial = row.axial
        out.side[0] = row.side[0]
        out.side[1] = row.side[1]

    def _learn_hover(self, v: Vehicle, p: Plan, row: Sensed) -> None:
        """Set the hover thrust for a new flight."""
        level = p.hover
        if not level > 0.0 and self.hover_samples > 0:
            level = median(self.settling, self.hover_samples)
        if not level > 0.0:  # no command in its first second
            for k in range(v.rotors):
                self.settling[k] = row.share[k]
            level = median(self.settling, v.rotors)
        self.hover = max(level, LEAST_HOVER)
        self.flight = LASTS

    def _tumble(self, p: Plan, row: Sensed, inside: bool, out: Made) -> None:
        """Detect tumbling. After it the vehicle does not hover again in this flight: the rest is a fall, not evidence."""
        width = max(2, int(TUMBLE_S / p.dt + 0.5))
        upset = max(abs(row.rate[0]), abs(row.rate[1])) > UPSET_RATE or row.level < UPSET_LEVEL
        self.tumbling = min(self.tumbling + 1, width) if inside and upset else 0
        self.tumbled = self.tumbled or self.tumbling >= width
        out.upset = upset or (self.tumbled and inside)

    def _touch(self, v: Vehicle, p: Plan, row: Sensed, fresh: bool, out: Made) -> None:
        """Return whether an external force or torque acted on the vehicle."""
        shove = Shove()
        shove.time = row.time
        for k in range(v.rotors):
            shove.thrust[k] = out.thrust[k]
        for a in range(3):
            shove.torque[a] = out.wrench[a]
            shove.rate_dot[a] = row.rate_dot[a]
        shove.forward = row.push[0]
        shove.right = row.push[1]
        shove.load = row.load
        shove.shake = row.shake
        shove.fresh = fresh
        shove.accelerometer = p.accel
        self.contact.tick(v, shove, p.before, out.touch)
