"""When a vehicle spins and flies on, and the events of that.

A vehicle without a rotor can still hold its thrust axis and its place if it gives up its heading (Mueller and D'Andrea, ICRA 2014). Such a
spin is no fall: upright, without sinking fast, carried by its rotors. Which of them are off is assessed from the controlled flight before
on:
the ticks of the last seconds are still in the queue, and are worked off a few at a time.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, Real, Small, Struct, Time, copy, embedded, isnan
from rotorwatch.engine.events.decisions import SAME_S
from rotorwatch.engine.events.events import CONTACT, LOSS, OUTPUT_OVERRIDE, Event, put
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sense import Sensed
from rotorwatch.engine.intake.sizes import QUEUE
from rotorwatch.engine.intake.ticks import HOVER_LEARN_S
from rotorwatch.engine.spin.rotors_off import RotorsOff, WentOff

SPUN, SPUN_S = 10.0, 2.0  # rad/s of yaw, for so long
TURNS = 3.0  # rad/s: it may begin to spin, which takes some a few seconds
PAUSE_S = 1.0  # shorter pauses do not end a spin
SLOWEST_S = 0.2  # ticks: slower ones are no averages
RECOVERS_S = 5.0  # after a spin, in which rotors come back
CARRIES = (0.5, 1.7)  # g along the thrust axis, mean: rotors carry the vehicle; asked only where the velocity is unknown
SINKS_M_S = 2.0  # down, mean: faster is a fall
UPRIGHT = 0.5  # cosine of the tilt, mean
OFF = 0.4  # the motion shows a rotor on or off: one that lost half of its thrust is nearer to off, one that lost 30 % to on
EARLIER_S = 3.0  # a partial loss of the rotor that then stops
SAME_ONSET_S = 0.4  # of an announcement: the ticks around it tell the onset better, later ones that of a total loss after a partial one
SOON_S = 0.1  # before an onset: its accuracy
CATCHES_UP = 8  # ticks worked off in the time of one


class Spin(Struct):
    """The spin of the current or last flight. since, until: of it [s]; off: rotors off since before it. watched: False where departures
    are assessed with what was commanded instead (case/departures.py)."""

    off = embedded(RotorsOff)
    since: Time = LASTS
    until: Time = -LASTS
    turned: Time = -LASTS  # when it turned last
    flight: Time = LASTS  # start of the flight that `off` is of
    level: Time = 0.0  # sums over the ticks of the spin: cosine of the tilt, load factor, speed up along the thrust axis
    load: Time = 0.0
    climb: Time = 0.0
    ticks: int = 0
    moved: int = 0  # ticks with a known speed
    seen: int = 0  # ticks so far
    passed: int = 0  # of this flight, not followed
    behind: Small = 0  # ticks to be worked off, of those in the queue, where the last ones stay for some seconds
    due: Small = 0  # of these, worked off by now
    follows: bool = False
    spun: bool = False  # it has spun for long in this flight, whatever the reason
    watched: bool = True

    def tick(self, dt: Time, row: Sensed, start: Time) -> None:
        """Notice a tick of dt s as it comes into the queue. start: of the flight, LASTS on the ground."""
        turning = abs(row.rate[2]) if row.rate_ok else 0.0
        self.seen += 1
        if start >= LASTS:
            self.follows = False
            self.behind = 0
            self.passed = 0
        elif self.follows:
            self.behind = min(self.behind + 1, QUEUE)
            self.turned = row.time if turning > TURNS else self.turned
            self.follows = row.time - self.turned <= RECOVERS_S
        elif row.time >= start + HOVER_LEARN_S:
            self.passed += 1
            if start < self.flight or start > self.flight:  # a new one: what was off before is another matter
                self.off.landed(self.until)
                self.spun = False
            if turning > TURNS and row.load_ok and dt <= SLOWEST_S and self.watched:
                self._begin(start)
                self.turned = row.time
        if self.follows and turning > SPUN:
            if row.time - self.until > PAUSE_S and self.until - self.since < SPUN_S:
                self.since = row.time
                self.level = 0.0
                self.load = 0.0
                self.climb = 0.0
                self.ticks = 0
                self.moved = 0
            self.until = row.time
            self.level += row.level
            self.load += row.load
            self.ticks += 1
            if not isnan(row.axial):
                self.climb += row.axial
                self.moved += 1
            self.spun = self.spun or self._turns()
        self.due = min(self.due + CATCHES_UP, self.behind)

    def _begin(self, start: Time) -> None:
        """Follow the ticks from those before on."""
        self.follows = True
        self.behind = min(self.passed, 3 * QUEUE // 4)
        self.passed = 0
        if start < self.flight or start > self.flight:
            self.flight = start
            self.until = -LASTS
            self.off.begin()

    def part(self, v: Vehicle, dt: Time, rows: list[Sensed], end: int, hover: Real) -> bool:
        """Do a piece of the due work; False where there is none. rows, end: the queue, and the place after its last tick; hover: mean
        share of full thrust that carries the vehicle."""
        if self.due <= 0:
            return False
        if self.off.part(v, dt, rows[(end + QUEUE - self.behind) % QUEUE], hover):
            self.behind -= 1
            self.due -= 1
        return True

    def join(self, events: list[Event], count: int, room: int) -> int:
        """Merge the rotors that went off in a spin into the events; return their number. The balance at any attitude and rate replaces
        what assumes hover, from the first of them on; an announcement of the same rotor stays, as the earlier one."""
        many = 0
        while many < self.off.count and self.off.all[many].detected <= self.until:  # what follows a spin may be the ground
            many += 1
        if many == 0 or self.off.blind or not self._turns() or not self._flies():
            return count
        begun = LASTS
        reported = 0
        left = 0
        for k in range(many):
            begun = min(begun, self.off.all[k].onset)
        for i in range(count):
            e = events[i]
            place = self._announced(e, reported, many)
            jerked = e.kind == CONTACT and begun - SOON_S < e.onset <= self.until  # a rotor that stops jerks the vehicle
            replaced = (e.kind == LOSS or e.kind == OUTPUT_OVERRIDE) and e.onset > begun - SAME_S and place < 0
            if not jerked and not replaced:
                if left != i:
                    copy(events[left], e)
                if place >= 0:
                    reported |= 1 << place
                    _stops(events[left], self.off.all[place])
                left += 1
        for k in range(many):
            if (reported & (1 << k)) == 0:
                one = Event()
                one.onset = self.off.all[k].onset
                one.detected = self.off.all[k].detected
                one.end = self.off.all[k].end
                one.loss[0] = 1.0
                one.lower[0] = OFF
                one.upper[0] = 1.0
                one.probability = self.off.all[k].probability
                one.rotors = 1 << int(self.off.all[k].rotor)
                left = put(events, left, room, one)
        return left

    def _turns(self) -> bool:
        """Whether it has spun for long."""
        return self.until - self.since >= SPUN_S

    def _flies(self) -> bool:
        """Whether rotors carry the vehicle, upright and without falling, as far as that is known."""
        n = float(self.ticks)
        if self.moved > 0:
            if -self.climb > SINKS_M_S * float(self.moved):
                return False
        elif not CARRIES[0] * n < self.load < CARRIES[1] * n:
            return False
        return self.level >= UPRIGHT * n

    def _announced(self, e: Event, reported: int, many: int) -> int:
        """Index of the rotor off, of the first `many`, that a loss has announced, as it went off, or before it stopped for good; -1 if
        none. Only the first time that a rotor went off counts."""
        if e.kind != LOSS or e.alternative_count > 0:
            return -1
        for k in range(many):
            if e.rotors == 1 << int(self.off.all[k].rotor) and (reported & (1 << k)) == 0:
                ahead = e.onset - self.off.all[k].onset
                return k if -EARLIER_S < ahead < SAME_S else -1
        return -1


def _stops(e: Event, off: WentOff) -> None:
    """Refine an announcement."""
    if abs(off.onset - e.onset) < SAME_ONSET_S:
        e.onset = off.onset
    e.upper[0] = 1.0
    e.end = off.end
