"""Batch calls for many samples: of a whole log, or received on a link since the last call.

A sample is a kind, a time and its numbers: `values` from index `at` on; NaN if unknown. Samples of equal times are in the order of kinds.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, LASTS, REAL, Flags, Ints, Real, Reals, Struct, Time, Times, array, isnan, local, sqrt
from rotorwatch.engine.events.changes import Change, Changes
from rotorwatch.engine.events.events import Event, Report, main_event
from rotorwatch.engine.events.losses import Losses
from rotorwatch.engine.events.records import Found, Records
from rotorwatch.engine.events.words import Words, severity
from rotorwatch.engine.intake.airborne import Airborne
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.deviations import Deviations, Override
from rotorwatch.engine.intake.front import ACCEL, ATTITUDE, CONTROL, GYRO, OUTPUTS, STATE, THRUSTS, VELOCITY, VOLTAGE
from rotorwatch.engine.intake.mixer import CONTROLS, Comparison, Mixer
from rotorwatch.engine.intake.sense import Plan, Sense, Sensed
from rotorwatch.engine.intake.sizes import ROTORS
from rotorwatch.engine.intake.ticks import HOVER_LEARN_S, Made, Ticks


class Done(Struct):
    """Progress of a call: samples processed, rows made, and the last battery voltage as a share of full."""

    samples: int = 0
    rows: int = 0
    battery: Real = 1.0


def fly(a: Airborne, v: Vehicle, n: int, kind: Ints, time: Times, at: Ints, values: Reals) -> None:
    """Feed n samples of outputs, motion and states to the detection of flights."""
    output = local(REAL, ROTORS)
    known = local(FLAG, ROTORS)
    for i in range(n):
        x = values[at[i]]
        y = values[at[i] + 1]
        z = values[at[i] + 2]
        valid = not (isnan(x) or isnan(y) or isnan(z))
        if kind[i] == OUTPUTS:
            for k in range(v.rotors):
                output[k] = values[at[i] + k]
                known[k] = not isnan(output[k])
            a.outputs(v, time[i], output, known)
        elif kind[i] == GYRO:
            a.gyro(time[i], x, y, z, valid)
        elif kind[i] == ACCEL:
            a.accel(time[i], x, y, z, valid)
        elif kind[i] == VELOCITY:
            a.velocity(time[i], -z, sqrt(x * x + y * y))
        elif kind[i] == STATE:
            a.state(time[i], int(x), int(y))


def wait(a: Airborne, until: Time) -> None:
    """Signal that all samples up to `until` s have arrived."""
    a.walk(until, True)


def cut(
    s: Sense,
    v: Vehicle,
    p: Plan,
    begin: int,
    n: int,
    kind: Ints,
    time: Times,
    at: Ints,
    values: Reals,
    rows: list[Sensed],
    room: int,
    done: Done,
) -> None:
    """Resample thrusts and motion of the samples `begin` to n - 1 into ticks, at most `room` of them, in `rows`."""
    thrust = local(REAL, ROTORS)
    done.rows = 0
    for i in range(begin, n):
        while s.ready(p, time[i]):
            if done.rows == room:
                done.samples = i
                return
            s.measure(v, p, rows[done.rows])
            done.rows += 1
        x = values[at[i]]
        y = values[at[i] + 1]
        z = values[at[i] + 2]
        if kind[i] == THRUSTS:
            known = True
            for k in range(v.rotors):
                thrust[k] = values[at[i] + k]
                known = known and not isnan(thrust[k])
            s.thrust(v, p, time[i], thrust, known)
        elif kind[i] == VELOCITY:
            s.moves(time[i], x, y, z)
        elif kind[i] == ATTITUDE:
            s.attitude(time[i], x, y, z, values[at[i] + 3])
        elif not (isnan(x) or isnan(y) or isnan(z)):
            if kind[i] == GYRO:
                s.gyros.add(time[i], x, y, z)
            elif kind[i] == ACCEL:
                s.accel(time[i], x, y, z)
    done.samples = n


def rest(s: Sense, v: Vehicle, p: Plan, rows: list[Sensed], room: int) -> int:
    """Write the ticks still pending at the end of a log into `rows`; return their number."""
    count = 0
    while count < room and s.ready(p, LASTS):
        s.measure(v, p, rows[count])
        count += 1
    return count


def assemble(t: Ticks, v: Vehicle, p: Plan, n: int, rows: list[Sensed], lifted: Times, start: Times, made: list[Made]) -> None:
    """Convert n rows to the estimator's inputs. lifted, start (n,): start time of the last flight begun by each row, and of the flight
    that contains it; LASTS if there is none. The hover thrust is learned from the rows of a flight's first HOVER_LEARN_S."""
    flight: Time = -LASTS
    ahead = 0
    for i in range(n):
        if lifted[i] < LASTS and (lifted[i] < flight or lifted[i] > flight):
            flight = lifted[i]
            while ahead < n and rows[ahead].when < flight + HOVER_LEARN_S:
                if rows[ahead].when >= flight:
                    t.learn_hover_thrust(v, rows[ahead], flight)
                ahead += 1
        t.assemble(v, p, rows[i], start[i], made[i])


class Mixed(Struct):
    """Rotor thrusts computed from one sample of the rate controller; ok: they are valid."""

    time: Time = 0.0
    thrust = array(REAL, ROTORS)
    ok = array(FLAG, ROTORS)


def mix(
    m: Mixer, v: Vehicle, n: int, kind: Ints, time: Times, at: Ints, values: Reals, found: list[Comparison], made: list[Mixed], done: Done
) -> None:
    """Process n samples of outputs, rate controller and voltage. found: comparisons of outputs with the mixer, at most as many as samples
    of outputs; made: thrust of each sample of the rate controller. done: their numbers (rows, samples)."""
    numbers = local(REAL, ROTORS)
    done.rows = 0
    done.samples = 0
    for i in range(n):
        count = v.rotors if kind[i] == OUTPUTS else CONTROLS
        known = True
        for k in range(count):
            numbers[k] = values[at[i] + k]
            known = known and not isnan(numbers[k])
        if kind[i] == VOLTAGE:
            done.battery = numbers[0]
        elif kind[i] == OUTPUTS:
            done.rows += m.outputs(v, time[i], numbers, known, done.battery, found[done.rows])
        elif kind[i] == CONTROL:
            while m.control(v, time[i], numbers, known, found[done.rows]):
                done.rows += 1
            one = made[done.samples]
            one.time = time[i]
            m.thrust(v, time[i], numbers, known, done.battery, one.thrust, one.ok)
            done.samples += 1


def overrides(d: Deviations, v: Vehicle, found: list[Override]) -> int:
    """Write the outputs that have not followed the mixer so far into `found`; return their number."""
    return d.found(v, found)


def announce(s: Losses, v: Vehicle, n: int, time: Times, when: Times, mode: Ints, restart: Flags, found: list[Found]) -> None:
    """Process the estimator's results of n ticks."""
    for i in range(n):
        s.write(v, time[i], when[i], mode[i], restart[i], found[i])


def losses(s: Losses, v: Vehicle, flies: bool, out: list[Event]) -> int:
    """Write the losses so far into `out`; return their number."""
    room = Records()
    return s.losses(v, flies, room, out)


def follow(
    r: Report,
    n: int,
    time: Times,
    upset: Flags,
    dt: Time,
    flights: int,
    starts: Times,
    ends: Times,
    contacts: int,
    hit: Times,
    push: Ints,
    size: Reals,
    final: bool,
) -> None:
    """Process n ticks of dt s. starts, ends (flights,): all flights so far, s, end LASTS while one continues; hit, push, size (contacts,):
    new contacts; final: no ticks follow these."""
    k = 0
    j = 0
    while k < flights and ends[k] <= r.end:
        k += 1
    for i in range(n):
        while k < flights and time[i] > ends[k] + dt:
            r.landed(ends[k])
            k += 1
        aloft = k < flights and starts[k] <= time[i]
        r.tick(time[i], starts[k] if aloft else LASTS, upset[i])
        while j < contacts and hit[j] <= time[i]:
            if aloft and hit[j] >= starts[k]:
                r.contact(hit[j], push[j], size[j])
            j += 1
    while final and k < flights and ends[k] < LASTS:
        r.landed(ends[k])
        k += 1


def events(r: Report, v: Vehicle, losses: list[Event], n: int, overridden: list[Override], m: int, out: list[Event]) -> int:
    """Write all events from n losses, m overrides and the contacts into `out`; return their number."""
    return r.events(v, losses, n, overridden, m, out)


def changes(
    c: Changes, found: list[Event], count: int, final: Time, refined: int, every: bool, withdrawn: list[Event], out: list[Change]
) -> int:
    """Write the changes of the events since the last call into `out`; return their number."""
    return c.look(found, count, LASTS, final, refined, every, withdrawn, out)


def in_words(found: list[Event], withdrawn: bool, what: str, w: Words) -> int:
    """Write the text of the first event into w; return its severity."""
    w.event(found[0], withdrawn, what)
    return severity(found[0], withdrawn)


def most_important(found: list[Event], count: int) -> int:
    """Index of the most important event, -1 if there is none."""
    return main_event(found, count)
