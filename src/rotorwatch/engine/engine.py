"""From a vehicle's samples to its events: the front end, the estimator, and the records of its results, joined.

    sample -> front end -> tick -> estimator -> losses, falls, contacts, trim -> events -> changes of the events

Feed the samples of all kinds together in time order; a sample of time t implies that all older ones have arrived. `step` then advances by
a tick as long as there is a certain one. A flight controller needs only `sample` and `poll`; a computer feeds many samples in one call
and keeps the ticks (`feed`). Both do the same in the same order.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, Real, Reals, Small, Struct, Time, array, copy, embedded, local, real
from rotorwatch.engine.drift.many import SLICES
from rotorwatch.engine.drift.trim import Trim
from rotorwatch.engine.drift.weighing import IDLE
from rotorwatch.engine.estimator.estimator import Estimator, Result
from rotorwatch.engine.estimator.hypotheses import hypothesis_count
from rotorwatch.engine.estimator.plant import Inputs, Plant
from rotorwatch.engine.events.changes import Change, Changes
from rotorwatch.engine.events.events import AMBIGUOUS, HEALTHY, LOSS, Event, Report, main_event, verdict
from rotorwatch.engine.events.losses import Losses
from rotorwatch.engine.events.records import Found, Records
from rotorwatch.engine.events.reliance import Reliance
from rotorwatch.engine.intake.craft import PITCH, ROLL, Vehicle
from rotorwatch.engine.intake.deviations import Override
from rotorwatch.engine.intake.front import Front
from rotorwatch.engine.intake.sense import Plan
from rotorwatch.engine.intake.sizes import EVENTS, LISTED, OVERRIDES, PLACES, QUEUE, RECORDS
from rotorwatch.engine.intake.ticks import ASSESS, CARRIES, Made
from rotorwatch.engine.spin.turning import Spin
from rotorwatch.flight.kinds import SUREST

PACE = 3.0  # ticks processed in pieces during the length of one
FINAL_S = 60.0  # an event that ended longer ago is not withdrawn


class Room(Struct):
    """Scratch memory for listing events; nothing in it is kept but, until the next poll, the withdrawn events in place of the losses."""

    records = embedded(Records)
    losses = array(Event, LISTED)
    overrides = array(Override, OVERRIDES)


class Engine(Struct):
    """Engine of one vehicle: samples to events. v, p, e of all methods: the vehicle, the division of its flight into ticks, and the
    estimator's knowledge before take-off."""

    front = embedded(Front)
    estimator = embedded(Estimator)
    losses = embedded(Losses)
    report = embedded(Report)
    trim = embedded(Trim)
    spin = embedded(Spin)
    changes = embedded(Changes)
    reliance = embedded(Reliance)  # as of the last poll
    made = embedded(Made)  # the last tick, as measured
    out = embedded(Result)  # the estimator's output for it
    events = array(Event, EVENTS)  # events at the last poll
    fresh = array(Change, 2 * EVENTS)
    room = embedded(Room)
    # End of the current or last flight, as only later samples show; LASTS: none known.
    fell: Time = LASTS
    tick = embedded(Made)  # the tick in progress: like `made`, but on the ground after a fall
    now = embedded(Inputs)  # the same as the estimator's input
    due: Time = 0.0  # ticks that may be processed by now, in pieces
    underway: bool = False  # a tick is being processed in pieces
    count: Small = 0  # of events
    landed: bool = False  # the flight has ended, and its last ticks wait
    assessed: bool = False  # a tick has been evaluated

    def begin(self, e: Plant) -> None:
        """Before the first sample."""
        self.estimator.begin(e)

    def push(self, v: Vehicle, p: Plan, kind: int, time: Time, x: Reals) -> None:
        """Add a sample and leave its work to `work`, to be called until it returns False. Waiting ticks are processed at PACE times the
        tick rate, so that the backlog after a landing or an uncertain landing never occupies the processor for one call or a short time.
        The rate is unlimited only when the next flight has begun before the backlog of the last one is processed."""
        if time > self.front.now:
            self.due = min(self.due + PACE / p.dt * (time - self.front.now), 1.0)
        self.take(v, p, kind, time, x)

    def work(self, v: Vehicle, p: Plan, e: Plant) -> bool:
        """Do a piece of the due work, in the order of `step` and `trim.work`; False where there is none."""
        if self.underway:
            self.underway = self.estimator.part(e, self.now, self.out)
            if not self.underway:
                self._write(v, p)
            return True
        if self.trim.part(v) != IDLE or self._spun(v, p):
            return True
        if self.due < 1.0 and not (self.landed and self.front.start < LASTS):
            return False
        self.underway = self._next(v, p)
        if self.underway:
            self.due = max(self.due - 1.0, 0.0)
        return self.underway

    def sample(self, v: Vehicle, p: Plan, e: Plant, kind: int, time: Time, x: Reals) -> None:
        """Add a sample and do the work that it makes due."""
        self.push(v, p, kind, time, x)
        while self.work(v, p, e):
            pass

    def finish(self, v: Vehicle, p: Plan, e: Plant, time: Time) -> None:
        """The end: all samples up to `time` s have arrived, and no more will."""
        while self.work(v, p, e):
            pass
        self.end(v, p, time)
        while self.step(v, p, e):
            self.trim.work(v, SLICES)
        self.trim.finish(v)

    def take(self, v: Vehicle, p: Plan, kind: int, time: Time, x: Reals) -> None:
        """Take a sample of a kind (`Front`); x: its numbers, NaN where unknown."""
        was = self.front.start
        self.front.sample(v, p, kind, time, x)
        self._look(was)
        while self.spin.seen < self.front.taken:
            last = self.front.first + self.front.count + self.spin.seen - self.front.taken
            self.spin.tick(p.dt, self.front.queue[(last + QUEUE) % QUEUE], self.front.start)

    def end(self, v: Vehicle, p: Plan, time: Time) -> None:
        """No sample comes after `time` s."""
        was = self.front.start
        self.front.finish(v, p, time)
        self._look(was)

    def step(self, v: Vehicle, p: Plan, e: Plant) -> bool:
        """Process the next certain tick by the estimator and record it; False where there is none."""
        while self._spun(v, p):
            pass
        if not self._next(v, p):
            return False
        self.estimator.step(e, self.now, self.out)
        self._write(v, p)
        return True

    def _next(self, v: Vehicle, p: Plan) -> bool:
        """Take the next certain tick; False where there is none."""
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

    def _spun(self, v: Vehicle, p: Plan) -> bool:
        """Do a piece of the due work on a spin; False where there is none."""
        return self.spin.part(v, p.dt, self.front.queue, self.front.first + self.front.count, self.front.ticks.hover)

    def poll(self, v: Vehicle) -> int:
        """List the events and, in `fresh`, their changes since the last poll; return the number of changes."""
        flies = self.front.start < LASTS or self.landed
        room = self.room
        lost = self.losses.losses(v, flies, room.records, room.losses)
        for i in range(lost):
            room.losses[i].source = i
        lost = self.trim.growth.join(room.losses, lost, RECORDS)
        overridden = 0
        if self.front.doubting:  # it may have landed, and outputs leave the mixer on the ground
            overridden = self.front.sure[0].found(v, room.overrides)
        else:
            overridden = self.front.deviations.found(v, room.overrides)
        reached = 0
        for i in range(overridden):  # ticks that still wait may show that the vehicle fell before
            if room.overrides[i].onset <= self.report.now:
                copy(room.overrides[reached], room.overrides[i])
                reached += 1
        count = self.report.events(v, room.losses, lost, room.overrides, reached, self.events)
        count = self.spin.join(self.events, count, EVENTS)
        self.count = self.trim.mount.put(self.events, count, EVENTS)
        for i in range(self.count):
            if self.events[i].kind == LOSS:
                self.events[i].probability = min(self.events[i].probability, SUREST)
        self.reliance.look(v, self.events, self.count, self.front.start, self.front.newest)
        final = self.front.newest - FINAL_S
        return self.changes.look(self.events, self.count, self.front.newest, final, -1, False, room.losses, self.fresh)

    def main(self) -> int:
        """Index of the most severe event of the last poll; -1 without one."""
        return main_event(self.events, self.count)

    def verdict(self) -> int:
        """NOT_ASSESSED, HEALTHY, FAULT or AMBIGUOUS, by the events at the last poll. Not evaluated is not healthy, nor is a spin; a loss
        that seems to grow is ambiguous until it is certain."""
        reported = verdict(self.events, self.count, self.assessed and self.front.air.unseen == 0 and not self.spin.spun)
        return AMBIGUOUS if reported == HEALTHY and self.trim.growth.count > 0 and self.trim.growth.grew else reported

    def _write(self, v: Vehicle, p: Plan) -> None:
        """Record the tick and the estimator's output."""
        tick = self.tick
        found = Found()
        _find(v, self.out, found)
        self.losses.write(v, tick.time, tick.when, tick.mode, tick.restart, found)
        self.report.tick(tick.time, tick.start, tick.upset)
        if tick.touch.is_new:
            self.report.contact(tick.touch.time, tick.touch.push, tick.touch.size)
        self.assessed = self.assessed or tick.mode == ASSESS
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
        """Return whether the flight that began at `was` has ended."""
        self.landed = self.landed or (was < LASTS and (self.front.start < was or self.front.start > was))


def _tell(v: Vehicle, made: Made, now: Inputs) -> None:
    """Convert a tick to the estimator's input."""
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
    now.climb(made.axial)
    now.mode = made.mode
    now.restart = made.restart or made.touch.hit
    now.hop = made.restart and not made.touch.hit


def _find(v: Vehicle, out: Result, found: Found) -> None:
    """Convert the estimator's output to the input of the loss records."""
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
