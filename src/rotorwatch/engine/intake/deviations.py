"""Mixer deviations: outputs that do not follow the mixer, because they are stuck at a value, off, or driven by something else.

Two methods: compare each output with the mixer's demand (`Deviations.compared`), or examine outputs alone (`Deviations.logged`): one that
is off, or does not move while all others fly and move. Loss of effectiveness never shows here: only commands are compared.

An output at rest is compared with the others: a sample in which every output repeats the one before carries no information. A log that
missed some samples repeats the last ones.

Sample by sample; times do not decrease. Causal: an override's `detected` is when an observer in flight would have known.
"""

from __future__ import annotations

from math import inf

from rotorwatch.base.compiling.structs import (  # fmt: skip
    FLAG,
    LASTS,
    NAN,
    REAL,
    TIME,
    Flags,
    Real,
    Reals,
    Struct,
    Time,
    array,
    copy,
    isnan,
    local,
    real,
    reset,
    sqrt,
)
from rotorwatch.base.medians import median
from rotorwatch.engine.intake.craft import PITCH, ROLL, Vehicle
from rotorwatch.engine.intake.mixer import FLYING, NOISE_SD, PART, Comparison
from rotorwatch.engine.intake.sizes import OVERRIDES, RECENT, ROTORS

STUCK, OFF, OVERRIDDEN = 0, 1, 2
BY_MIXER, NOT_MOVING, BELOW_MINIMUM, AT_MINIMUM, WAYS = 0, 1, 2, 3, 4

_PART_STILL = 0.015  # of full thrust; as PART, for an output that does not move at all
_PROVEN = 20  # comparisons that a mixer must have passed before an output can be accused by it
_SHARES_OF_YAW = 11  # 0, 0.1 to 1: share of the yaw that a mixer at its limits may give up
_UNEXPLAINED = 0.25  # share of the differences between outputs that a trusted mixer may leave unexplained
_AGREEING = 0.7  # share of the other outputs that must agree on the common deviation before one can be accused
_CONFIRM_S, _CONFIRM_SAMPLES = 0.25, 3  # duration for which an output must differ
_STUCK_S = 1.0  # an output that does not move for this long while it should have, whatever limits the others, is stuck
_SILENT_S = 0.5  # an output that does not move for this long while all others do is stuck
_STEPS = 4.0  # steps of the outputs' resolution that the others must move while one is at rest
_BACK_S = 0.5  # an output must follow again for this long before its override ends


class Override(Struct):
    """A period in which an output did not follow the mixer."""

    onset: Time = 0.0  # s
    detected: Time = 0.0  # s
    end: Time = LASTS  # s, LASTS while in progress
    output: Real = 0.0  # output when noticed, in the outputs' unit
    demanded: Real = -1.0  # share of full thrust that the mixer demanded then; negative where unknown
    got: Real = 0.0  # thrust of the output then, by the curve assumed by the mixer
    rotor: int = 0  # from 0
    kind: int = OVERRIDDEN  # STUCK, OFF or OVERRIDDEN
    way: int = BY_MIXER  # detection method
    shared: bool = False  # another output left the mixer and returned at the same samples: the log is wrong, not a rotor


class Rest(Struct):
    """A value that may have become steady."""

    since: Time = LASTS
    anchor: Real = inf

    def update(self, time: Time, value: Real, tolerance: Real) -> Time:
        """Time since which the value has stayed within `tolerance` of where it became steady."""
        if abs(value - self.anchor) > tolerance:
            self.anchor = value
            self.since = time
        return self.since

    def wait(self, time: Time, seconds: Time) -> None:
        """Exclude these seconds up to `time`."""
        self.since = min(self.since + seconds, time)


class Run(Struct):
    """Consecutive samples that may become an override, or are one."""

    onset: Time = LASTS  # LASTS: none
    well: Time = LASTS  # time since which the output has been normal during an override
    low: Real = 0.0  # output in these samples
    high: Real = 0.0
    count: int = 0  # number of these samples, as far as it matters
    place: int = -1  # place of the override, -1 without


class Deviations(Struct):
    """The overrides of one vehicle, updated with each sample."""

    runs = array(Run, WAYS, ROTORS)
    still = array(Rest, ROTORS)  # rest of each output in the comparisons, but for rounding
    rest = array(Rest, ROTORS)  # the same, exactly
    alone = array(Rest, ROTORS)  # rest of each output in all samples
    asked = array(TIME, ROTORS)  # when the mixer last asked something of each, as far as it was compared; 0 before
    last: Time = -LASTS  # time of the last comparison
    last_logged: Time = -LASTS  # ... and of the last outputs
    step: Real = inf  # smallest change of an output so far: its resolution
    tilt = array(REAL, ROTORS)  # demand on each rotor for roll and pitch, at that time
    tilt_at_rest = array(REAL, ROTORS, ROTORS)  # ... of all, when the output of each came to rest
    power: Time = 0.0  # sum of the squares of the largest deviations of comparisons that fitted
    unexplained: Time = 0.0  # ... of the differences between outputs that were not as demanded
    differences: Time = 0.0  # ... of all differences between outputs
    fitted: int = 0  # number of comparisons that fitted
    assessed: int = 0  # number that could have
    recent_time = array(TIME, RECENT)
    recent = array(REAL, RECENT, ROTORS)  # thrusts of the last half second
    recent_first: int = 0
    recent_count: int = 0
    overrides = array(Override, OVERRIDES)
    overrides_count: int = 0
    forgotten: int = 0  # overrides without a free place, or whose place was reused

    def compared(self, v: Vehicle, c: Comparison, airborne: bool) -> None:
        """Process a comparison. airborne: the vehicle flew then.

        An output counts when it differs by more than 0.05 of full thrust (and six times the usual difference) for 0.25 s while no rotor
        is near its limits. Limits explain neither an output below its minimum nor one that rests while it should move against the others.
        """
        low = v.u_min
        span = v.u_max - v.u_min
        interior = local(FLAG, ROTORS)
        known = local(FLAG, ROTORS)
        deviation = local(REAL, ROTORS)
        ordered = local(REAL, ROTORS)
        tilt = local(REAL, ROTORS)
        rest = local(TIME, ROTORS)
        mean_demanded: Real = 0.0
        mean_thrust: Real = 0.0
        repeated = True
        inside = 0
        for k in range(v.rotors):
            interior[k] = low + 0.01 * span < c.output[k] < low + 0.99 * span
            inside += 1 if interior[k] else 0
            # An output that does not move at all; at a limit, and in calm air, others rest as well.
            rest[k] = self.rest[k].update(c.time, c.output[k], 1e-9)
            repeated = repeated and rest[k] < c.time
        if repeated and inside > 1:
            for k in range(v.rotors):
                self.rest[k].wait(c.time, c.time - self.last)
                self.still[k].wait(c.time, c.time - self.last)
            self.last = max(self.last, c.time)
            return
        for k in range(v.rotors):
            if c.demanded[k] > PART * c.top:
                self.asked[k] = c.time
            ordered[k] = c.thrust[k]
            mean_demanded += c.demanded[k]
            mean_thrust += c.thrust[k]
        mean_demanded /= real(v.rotors)
        mean_thrust /= real(v.rotors)
        flying = airborne and median(ordered, v.rotors) > FLYING
        _single(v.rotors, c, interior, deviation, known)
        fits = flying
        whole = True
        largest: Time = 0.0
        unexplained: Time = 0.0
        differences: Time = 0.0
        for k in range(v.rotors):
            if c.output[k] >= low + 0.99 * span:  # a mixer at its limits demands full thrust
                deviation[k] = 0.0
                known[k] = True
            whole = whole and known[k]
            fits = fits and known[k] and abs(deviation[k]) < PART
            own: Time = c.demanded[k] - mean_demanded
            tilt[k] = real(own) - c.yaw[k]
            got: Time = c.thrust[k] - mean_thrust
            missing = got - own
            unexplained += missing * missing
            differences += got * got + NOISE_SD * NOISE_SD
            if known[k]:
                size: Time = deviation[k]
                largest = max(largest, size * size)
        # Test how well the mixer has explained the outputs so far; a mixer that never did gives no evidence about single outputs. Nor
        # does one with the right throttle but another scale of roll, pitch and yaw: it fits as well while nothing turns.
        proven = self.fitted >= _PROVEN and float(self.fitted) > 0.7 * float(self.assessed)
        proven = proven and self.unexplained < _UNEXPLAINED * self.differences
        usual = real(6.0 * sqrt(self.power / float(max(self.fitted, 1))))
        limit = max(PART, usual)
        still_limit = max(_PART_STILL, usual)
        if flying and whole:
            self.assessed += 1
        if fits:
            self.fitted += 1
            self.power += largest
            self.unexplained += unexplained
            self.differences += differences
        if c.time > self.last:
            self.last = c.time
            for k in range(v.rotors):
                self.tilt[k] = tilt[k]
        for k in range(v.rotors):
            still = self.still[k].update(c.time, c.output[k], span / 400.0)
            frozen = c.time - still > 0.5 and interior[k]
            off = c.output[k] < low - 0.01 * span and c.demanded[k] > 2.0 * FLYING
            # At a limit the mixer takes any excess from all other outputs and gives up yaw, and in calm air they may rest: an output is
            # stuck if it does not move at all while it should have moved against them. An output at a constant distance from a limited
            # one rests with it.
            if rest[k] >= c.time:
                for j in range(v.rotors):
                    self.tilt_at_rest[k][j] = self.tilt[j]
            moved = abs(tilt[k] - self.tilt_at_rest[k][k]) > PART
            for j in range(v.rotors):
                apart = tilt[k] - tilt[j] - (self.tilt_at_rest[k][k] - self.tilt_at_rest[k][j])
                moved = moved and (interior[j] or abs(apart) > PART)
            dead = c.time - rest[k] > _STUCK_S and interior[k] and moved and abs(c.deviation[k]) > limit
            wrong = known[k] and (abs(deviation[k]) > limit or (frozen and abs(deviation[k]) > still_limit))
            wrong = proven and flying and (wrong or off or dead)
            back = (abs(c.deviation[k]) < PART and not frozen) or not flying
            place = self._follow(BY_MIXER, k, c.time, wrong, back, c.output[k], _CONFIRM_S, _CONFIRM_SAMPLES)
            if place >= 0:
                run = self.runs[BY_MIXER][k]
                one = self.overrides[place]
                one.detected = c.known
                one.demanded = min(max(c.demanded[k], 0.0), c.top)
                one.got = c.thrust[k]
                if run.high <= low + span / 400.0:
                    one.kind = OFF
                elif run.high - run.low <= span / 400.0 and interior[k]:
                    one.kind = STUCK
                    one.onset = min(still, one.onset)

    def logged(self, v: Vehicle, time: Time, output: Reals, thrust: Reals, valid: bool, airborne: bool) -> None:
        """Process a sample of outputs and their thrusts. valid: all of them are."""
        low = v.u_min
        span = v.u_max - v.u_min
        inside = airborne and valid
        still = local(TIME, ROTORS)
        resting = local(FLAG, ROTORS)
        moved = local(REAL, ROTORS)
        self._remember(v.rotors, time, thrust, valid)
        some = False
        repeated = valid
        between_limits = 0
        for k in range(v.rotors):
            step = abs(output[k] - self.alone[k].anchor)
            if valid and step > 1e-9:
                self.step = min(self.step, step)
            still[k] = self.alone[k].update(time, output[k], 1e-9)
            repeated = repeated and still[k] < time
            between_limits += 1 if low + 0.01 * span < output[k] < low + 0.99 * span else 0
        if repeated and between_limits > 1:
            for k in range(v.rotors):
                self.alone[k].wait(time, time - self.last_logged)
                still[k] = self.alone[k].since
        self.last_logged = max(self.last_logged, time)
        for k in range(v.rotors):
            resting[k] = inside and time - still[k] > _SILENT_S
            some = some or resting[k]
        for k in range(v.rotors):
            moved[k] = self._moved(k) if some else 0.0
        for k in range(v.rotors):
            others = local(REAL, ROTORS)
            count = 0
            moving = some
            between = True
            for j in range(v.rotors):
                if j != k:
                    others[count] = thrust[j]
                    count += 1
                    moving = moving and moved[j] > max(0.03, _STEPS * self.step / span)
                    between = between and FLYING < thrust[j] < 0.99
            interior = low + 0.02 * span < output[k] < low + 0.98 * span
            # Below the minimum: no mixer demands that. At the minimum, where outputs have nothing below it: no quad flies on with a rotor
            # at rest and the others off their limits (with more rotors, one opposite a dead one rests), unless the mixer asked for that.
            flown = inside and median(others, count) > 2.0 * FLYING
            above = output[k] > low + 0.01 * span or not inside
            below = flown and output[k] < low - 0.01 * span
            idle = v.rotors == 4 and v.rests_at_minimum and flown and between and output[k] <= low + 0.002 * span
            idle = idle and time - still[k] > 1.0 and not self.asked[k] < still[k] < self.last
            stuck = resting[k] and interior and moving
            again = time - still[k] < 0.2 or not inside
            at = self._follow(NOT_MOVING, k, time, stuck, again, output[k], 0.0, 1)
            if at >= 0:
                self.overrides[at].kind = STUCK
                self.overrides[at].onset = still[k]
            at = self._follow(BELOW_MINIMUM, k, time, below, above, output[k], 0.3, 3)
            if at >= 0:
                self.overrides[at].kind = OFF
            at = self._follow(AT_MINIMUM, k, time, idle, above, output[k], 0.0, 1)
            if at >= 0:
                self.overrides[at].kind = OFF
                self.overrides[at].onset = still[k]

    def landed(self, compared: Time, logged: Time) -> None:
        """Correct for samples that turn out to be on the ground.

        compared, logged: times of the first comparison and of the first outputs among these, LASTS without. Overrides in progress then
        end there, as if the landing had been known.
        """
        for way in range(WAYS):
            since = compared if way == BY_MIXER else logged
            for k in range(ROTORS):
                run = self.runs[way][k]
                if since < LASTS:
                    if run.place < 0:
                        run.onset = LASTS
                    else:
                        run.well = min(run.well, since)

    def found(self, v: Vehicle, out: list[Override]) -> int:
        """Write the overrides so far to `out`, which has room for OVERRIDES, in the order in which they were noticed; return their
        number."""
        for i in range(self.overrides_count):
            j = i
            while j > 0 and _before(self.overrides[i], out[j - 1]):
                copy(out[j], out[j - 1])
                j -= 1
            copy(out[j], self.overrides[i])
        distinct = 0
        for i in range(self.overrides_count):  # of those of one rotor that overlap in time, the first
            hidden = False
            for h in range(distinct):
                hidden = hidden or (out[h].rotor == out[i].rotor and out[i].onset < out[h].end)
            if not hidden:
                copy(out[distinct], out[i])
                distinct += 1
        reported = 0
        for i in range(distinct):
            if not self._balances(v, out[i]):
                copy(out[reported], out[i])
                out[reported].shared = self._together(out[i])
                reported += 1
        return reported

    def _balances(self, v: Vehicle, one: Override) -> bool:
        """Return whether an output rests only because the opposite one has been lost: the remaining rotors balance its torque that way."""
        if one.kind != OFF or one.demanded >= 0.0:
            return False
        for i in range(self.overrides_count):
            o = self.overrides[i]
            roll = v.effectiveness[ROLL][o.rotor] + v.effectiveness[ROLL][one.rotor]
            pitch = v.effectiveness[PITCH][o.rotor] + v.effectiveness[PITCH][one.rotor]
            if o.onset < one.onset < o.end and abs(roll) < 0.1 and abs(pitch) < 0.1:
                return True
        return False

    def _together(self, one: Override) -> bool:
        """Return whether another output left the mixer and returned to it at the same samples. A fault of one rotor affects one output."""
        for i in range(self.overrides_count):
            o = self.overrides[i]
            apart = o.onset < one.onset or one.onset < o.onset or o.end < one.end or one.end < o.end
            if o.rotor != one.rotor and not apart and o.way == BY_MIXER and one.way == BY_MIXER:
                return True
        return False

    def _room(self) -> int:
        """Place for an override: the first free one, or that of the one that ended first; -1 where all are in progress."""
        if self.overrides_count < OVERRIDES:
            self.overrides_count += 1
            return self.overrides_count - 1
        self.forgotten += 1
        oldest = -1
        end: Time = LASTS
        for i in range(OVERRIDES):
            if self.overrides[i].end < end:
                oldest = i
                end = self.overrides[i].end
        return oldest

    def _follow(self, way: int, k: int, time: Time, wrong: bool, back: bool, output: Real, hold_s: Time, samples: int) -> int:
        """Process a sample of one detection method: whether the output is wrong, and whether it is normal.

        An override is confirmed after hold_s and `samples` in a row, and ends after _BACK_S of normal output. Returns its place when it
        is confirmed at this sample, else -1.
        """
        run = self.runs[way][k]
        confirmed = -1
        for _turn in range(2):  # the sample that ends an override may begin another
            if run.place < 0:
                if not wrong:
                    run.onset = LASTS
                    return confirmed
                if run.onset >= LASTS:
                    run.onset = time
                    run.count = 0
                    run.low = output
                    run.high = output
                run.count = min(run.count + 1, samples)
                run.low = min(run.low, output)
                run.high = max(run.high, output)
                if time - run.onset < hold_s or run.count < samples:
                    return confirmed
                run.place = self._room()
                if run.place < 0:
                    return confirmed
                confirmed = run.place
                run.well = LASTS
                one = self.overrides[confirmed]
                reset(one)
                one.onset = run.onset
                one.detected = time
                one.output = output
                one.rotor = k
                one.way = way
            run.well = LASTS if not back else min(run.well, time)
            if run.well >= LASTS or time - run.well < _BACK_S:
                return confirmed
            self.overrides[run.place].end = run.well
            run.place = -1
            run.onset = LASTS
        return confirmed

    def _remember(self, rotors: int, time: Time, thrust: Reals, valid: bool) -> None:
        """Store the thrusts of the last _SILENT_S."""
        while self.recent_count > 0 and (self.recent_time[self.recent_first] < time - _SILENT_S or self.recent_count == RECENT):
            self.recent_first = (self.recent_first + 1) % RECENT
            self.recent_count -= 1
        at = (self.recent_first + self.recent_count) % RECENT
        self.recent_time[at] = time
        for k in range(rotors):
            self.recent[at][k] = thrust[k] if valid else NAN
        self.recent_count += 1

    def _moved(self, k: int) -> Real:
        """Range of the thrust of rotor k over the stored samples, without the most extreme one.

        In calm air an output may rest: the others rest as well, but for one damaged record. A moving output differs in more than one
        sample.
        """
        lowest: Real = inf
        low: Real = inf  # the next most extreme one
        highest: Real = -inf
        high: Real = -inf
        known = 0
        for i in range(self.recent_count):
            value = self.recent[(self.recent_first + i) % RECENT][k]
            if not isnan(value):
                known += 1
                low = min(low, max(lowest, value))
                lowest = min(lowest, value)
                high = max(high, min(highest, value))
                highest = max(highest, value)
        return min(highest - low, high - lowest) if known > 2 else 0.0


def _before(a: Override, b: Override) -> bool:
    """Return whether a was noticed before b."""
    if a.detected < b.detected or b.detected < a.detected:
        return a.detected < b.detected
    return a.rotor < b.rotor or (a.rotor == b.rotor and a.way < b.way)


def _single(rotors: int, c: Comparison, interior: Flags, deviation: Reals, known: Flags) -> None:
    """Deviation of each output from the mixer on its own; known: whether it can be evaluated.

    Where the demand cannot be met, a mixer gives up throttle, for all outputs alike, and a share of yaw. Outputs explained by this are
    not faulty, nor are outputs that all deviate by the same amount (a gain). The remaining deviation of an output is that under the share
    of yaw that suits it best, among those under which the others agree. Where even throttle and yaw do not suffice, each mixer gives up
    tilt in its own way: no output is accused. Nor need a mixer raise the throttle for tilt (PX4 without airmode, ArduPilot by the share of
    throttle and attitude): where roll and pitch take an output below zero, any part of each axis may be given up. interior: away from the
    limits.
    """
    other = local(REAL, ROTORS)
    agreed = local(FLAG, ROTORS)
    least = c.demanded[0]
    most = c.demanded[0]
    tilted: Real = 0.0
    _against_others(rotors, c, 0.0, interior, deviation, known)
    for k in range(rotors):
        least = min(least, c.demanded[k])
        most = max(most, c.demanded[k])
        tilted = min(tilted, c.demanded[k] - c.yaw[k])
    if not most - least < 0.97 * c.top:
        for k in range(rotors):
            known[k] = False
        return
    if not (c.yaw_granted and least >= 0.0 and most <= c.top):  # beyond its limits any mixer may give up the yaw it grants within them
        for i in range(1, _SHARES_OF_YAW):
            _against_others(rotors, c, real(i) * 0.1, interior, other, agreed)
            for k in range(rotors):
                if agreed[k] and not (known[k] and abs(other[k]) > abs(deviation[k])):
                    deviation[k] = other[k]
                    known[k] = True
    for k in range(rotors):
        if tilted < 0.0 and abs(deviation[k]) > PART and c.least[k] - PART < c.thrust[k] < c.most[k] + PART:
            known[k] = False


def _against_others(rotors: int, c: Comparison, share: Real, interior: Flags, deviation: Reals, agreed: Flags) -> None:
    """Deviation of each output from the demand and from the deviation common to the others, within the limits; agreed: whether these
    agree.

    share: of the yaw that is given up.
    """
    demanded = local(REAL, ROTORS)
    differences = local(REAL, ROTORS)
    rest = local(REAL, ROTORS)
    for k in range(rotors):
        demanded[k] = c.demanded[k] - share * c.yaw[k]
        differences[k] = c.thrust[k] - demanded[k]
    for k in range(rotors):
        count = 0
        agree = 0
        for j in range(rotors):
            if j != k and interior[j]:
                rest[count] = differences[j]
                count += 1
        deviation[k] = 0.0
        agreed[k] = False
        if count >= 2:
            common = median(rest, count)
            for j in range(rotors):
                off = c.thrust[j] - min(max(demanded[j] + common, 0.0), c.top)
                if j == k:
                    deviation[k] = off
                elif abs(off) < PART:
                    agree += 1
            agreed[k] = real(agree) > _AGREEING * real(rotors - 1)
