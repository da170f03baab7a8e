"""One vehicle, from its samples to its events: the front end, the estimator, and what is written down of them, joined.

    sample -> front end -> tick -> estimator -> losses, falls, contacts, trim -> events -> what is new about them

Feed every sample in the order of time, of all kinds together; feeding one of time t says that all older ones have come. `step` then goes
on by a tick as long as there is one that is certain. A flight controller calls `sample` and `poll`, which is all of it; a computer feeds
many samples in one call and keeps the ticks (`feed`). Both do the same in the same order.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Real, Reals, Small, Struct, Time, array, copy, embedded, isnan, local, real
from rotorwatch.engine.drift.many import SLICES
from rotorwatch.engine.drift.trim import Trim
from rotorwatch.engine.drift.weighing import IDLE
from rotorwatch.engine.estimator.estimator import Estimator, Result
from rotorwatch.engine.estimator.hypotheses import hypothesis_count
from rotorwatch.engine.estimator.plant import Inputs, Plant
from rotorwatch.engine.events.changes import Change, Changes
from rotorwatch.engine.events.events import Event, Report, main_event, verdict
from rotorwatch.engine.events.losses import Losses
from rotorwatch.engine.events.records import Found, Records
from rotorwatch.engine.intake.craft import PITCH, ROLL, Vehicle
from rotorwatch.engine.intake.deviations import Override
from rotorwatch.engine.intake.front import Front
from rotorwatch.engine.intake.sense import Plan
from rotorwatch.engine.intake.sizes import EVENTS, OVERRIDES, PLACES, RECORDS
from rotorwatch.engine.intake.ticks import CARRIES, JUDGE, Made

PACE = 3.0  # ticks that are worked off in pieces in the length of one
FINAL_S = 60.0  # what ended so long ago is not withdrawn any more


class Room(Struct):
    """To list events in: nothing in it outlives that."""

    records = embedded(Records)
    losses = array(Event, RECORDS)
    overrides = array(Override, OVERRIDES)


class Engine(Struct):
    """One vehicle, from its samples to its events. v, p, e of all methods: the vehicle, how its flight is cut into ticks, and what the
    estimator knows of it before take-off."""

    front = embedded(Front)
    estimator = embedded(Estimator)
    losses = embedded(Losses)
    report = embedded(Report)
    trim = embedded(Trim)
    changes = embedded(Changes)
    made = embedded(Made)  # the last tick, as it was measured
    out = embedded(Result)  # what the estimator made of it
    events = array(Event, EVENTS)  # at the last poll
    withdrawn = array(Event, EVENTS)  # since the poll before
    fresh = array(Change, 2 * EVENTS)
    room = embedded(Room)
    # The flight that goes on, or was the last, ended at this time, as only what comes after it shows; LASTS: nothing shows that.
    fell: Time = LASTS
    tick = embedded(Made)  # the one that is under way: as `made`, but on the ground where it fell
    now = embedded(Inputs)  # the same, as the estimator takes it
    due: Time = 0.0  # ticks that may be worked off by now, in pieces
    underway: bool = False  # a tick is worked off in pieces
    count: Small = 0  # of events
    landed: bool = False  # the flight is over, and its last ticks wait
    judged: bool = False  # a tick has been judged

    def begin(self, e: Plant) -> None:
        """Before the first sample."""
        self.estimator.begin(e)

    def push(self, v: Vehicle, p: Plan, kind: int, time: Time, x: Reals) -> None:
        """One sample, whose work is to be done in pieces, by `work` until that is False. What waited is worked off PACE times as fast as
        ticks come, so that no call, nor any short time, is kept busy by all that have waited, at a landing or after a doubt. Only where
        the next flight has begun before all of the last one is worked off is there no limit."""
        if time > self.front.now:
            self.due = min(self.due + PACE / p.dt * (time - self.front.now), 1.0)
        self.take(v, p, kind, time, x)

    def work(self, v: Vehicle, p: Plan, e: Plant) -> bool:
        """A piece of the work that is due, in the order in which `step` and `trim.work` do it; False where there is none."""
        if self.underway:
            self.underway = self.estimator.part(e, self.now, self.out)
            if not self.underway:
                self._write(v, p)
            return True
        if self.trim.part(v) != IDLE:
            return True
        if self.due < 1.0 and not (self.landed and self.front.start < LASTS):
            return False
        self.underway = self._next(v, p)
        if self.underway:
            self.due = max(self.due - 1.0, 0.0)
        return self.underway

    def sample(self, v: Vehicle, p: Plan, e: Plant, kind: int, time: Time, x: Reals) -> None:
        """One sample, and the work that is due by it."""
        self.push(v, p, kind, time, x)
        while self.work(v, p, e):
            pass

    def finish(self, v: Vehicle, p: Plan, e: Plant, time: Time) -> None:
        """The end: all samples up to `time` s have come, and no more will."""
        while self.work(v, p, e):
            pass
        self.end(v, p, time)
        while self.step(v, p, e):
            self.trim.work(v, SLICES)
        self.trim.finish(v)

    def take(self, v: Vehicle, p: Plan, kind: int, time: Time, x: Reals) -> None:
        """One sample of a kind (`Front`); x: its numbers, NaN where they are not known."""
        was = self.front.start
        self.front.sample(v, p, kind, time, x)
        self._look(was)

    def end(self, v: Vehicle, p: Plan, time: Time) -> None:
        """No sample comes after `time` s."""
        was = self.front.start
        self.front.finish(v, p, time)
        self._look(was)

    def step(self, v: Vehicle, p: Plan, e: Plant) -> bool:
        """The next tick that is certain, through the estimator and into the books; False where there is none."""
        if not self._next(v, p):
            return False
        self.estimator.step(e, self.now, self.out)
        self._write(v, p)
        return True

    def _next(self, v: Vehicle, p: Plan) -> bool:
        """Take the next tick that is certain; False where there is none."""
        if self.landed and self.front.certain == 0:
            fell = self.front.before_start <= self.fell < self.front.before_end
            self.report.landed(self.fell if fell else self.front.before_end)
            self.landed = False
        if not self.front.next(v, p, self.made):
            return False
        copy(self.tick, self.made)
        if self.tick.start <= self.fell < self.tick.when:
            self.tick.ground()
        _tell(v, self.tick, self.now)
        return True

    def poll(self, v: Vehicle) -> int:
        """List the events, and what is new about them since the last poll, in `fresh`; how much."""
        flies = self.front.start < LASTS or self.landed
        room = self.room
        lost = self.losses.losses(v, flies, room.records, room.losses)
        for i in range(lost):
            room.losses[i].source = i
        lost = self.trim.growth.join(room.losses, lost, RECORDS)
        overridden = self.front.deviations.found(v, room.overrides)
        count = self.report.events(v, room.losses, lost, room.overrides, overridden, self.events)
        self.count = self.trim.mount.put(self.events, count, EVENTS)
        final = self.front.newest - FINAL_S
        return self.changes.look(self.events, self.count, final, -1, False, self.withdrawn, self.fresh)

    def main(self) -> int:
        """Place of the event that matters most, of those at the last poll; -1 without one."""
        return main_event(self.events, self.count)

    def verdict(self) -> int:
        """NOT_JUDGED, HEALTHY, FAULT or AMBIGUOUS, by the events at the last poll. What is not seen is not healthy."""
        return verdict(self.events, self.count, self.judged and self.front.air.unseen == 0)

    def _write(self, v: Vehicle, p: Plan) -> None:
        """Write the tick down, and what the estimator made of it."""
        tick = self.tick
        found = Found()
        _find(v, self.out, found)
        self.losses.write(v, tick.time, tick.when, tick.mode, tick.restart, found)
        self.report.tick(tick.time, tick.start, tick.upset)
        if tick.touch.is_new:
            self.report.contact(tick.touch.time, tick.touch.push, tick.touch.size)
        self.judged = self.judged or tick.mode == JUDGE
        lacking = local(REAL, 3)
        for a in range(3):
            lacking[a] = self.out.biases[a]
            for k in range(v.rotors):
                lacking[a] += v.effectiveness[a][k] * tick.thrust[k] * self.out.theta[k]
        total: Real = 0.0
        for k in range(v.rotors):
            total += tick.thrust[k]
        usable = tick.valid[ROLL] and tick.valid[PITCH] and not tick.upset and total > CARRIES * real(v.rotors)
        self.trim.tick(v, p.dt, tick.time, tick.mode, usable, lacking, tick.thrust)

    def _look(self, was: Time) -> None:
        """Whether the flight that had begun at `was` is over."""
        self.landed = self.landed or (was < LASTS and (self.front.start < was or self.front.start > was))


def _tell(v: Vehicle, made: Made, now: Inputs) -> None:
    """A tick as the estimator takes it."""
    for i in range(v.rotors):
        now.thrust[i] = made.thrust[i]
    for a in range(3):
        now.turn[a] = made.rate_dot[a]
        now.rate[a] = made.rate[a]
    for a in range(4):
        now.wrench[a] = made.wrench[a]
        now.valid[a] = made.valid[a]
    now.load = made.load * real(v.rotors)
    now.forward = made.side[0]
    now.right = made.side[1]
    now.full = 1.0 / made.hover
    now.expo = v.expo
    now.expo_sd = v.expo_sd
    now.axial = 0.0 if isnan(made.axial) else made.axial
    now.mode = made.mode
    now.restart = made.restart or made.touch.hit
    now.hop = made.restart and not made.touch.hit


def _find(v: Vehicle, out: Result, found: Found) -> None:
    """What the estimator made of a tick, as losses are written down from it."""
    for k in range(v.rotors):
        found.theta[k] = out.theta[k]
        found.theta_sd[k] = out.theta_sd[k]
        found.gives[k] = out.gives[k]
    for p in range(PLACES):
        found.share[p] = out.share[p]
        found.onsets[p] = out.onsets[p]
        for k in range(v.rotors):
            found.active[p][k] = out.active[p][k]
    for h in range(hypothesis_count(v.rotors)):
        found.probability[h] = out.probability[h]
    found.announced = out.announced
