"""When a flight was in the air, from its motor commands, motion and the autopilot's own words.

Strictly causal: a walk over 20 Hz ticks that only looks back, so that a log cut at t gives the same intervals cut at t.
Two exceptions, both about ends: an interval's end is put where the landing or the fall began to show, up to `CONFIRM_S`
before it was sure; and an interval that still lasts ends with the log.

Why not simply the autopilot's "landed" flag: it clears when the throttle rises, seconds before the vehicle leaves the
ground, is set seconds after touch-down, and many logs lack it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.flight import Flight, Signal

TICK_S = 0.05
GAP_S = 4.0
"""For so long the last motor command is held. After a longer gap (a link that is cut, a busy disk, a damaged file) the first command after
it says whether the vehicle flew on: learned anew after it, a loss from before or in it would count as healthy."""
MOST_GAP_S = 60.0
"""A longer gap always ends a flight: a landing, another load and another take-off fit into it."""
CONFIRM_S = 4.5
"""The end of an interval is certain at most this long after it, mostly within 1.5 s."""

_G = 9.80665
_IDLE_S = 2.0  # time constant of the idle command seen on the ground
_HOVER_S = 5.0  # time constant of the usual command in the air
_RISE = 0.08  # command above idle, share of the range, below which nothing flies
_HIGH, _HIGH_RISE = 0.25, 0.10  # command, and its rise above idle, that by themselves mean flight once they last
_HIGH_S, _HIGH_BLIND_S = 5.0, 1.0  # ... this long, with and without a velocity that could tell
_CLIMB, _SPEED = 0.25, 1.0  # m/s
_SINKING = 1.0  # m/s down: the ground is not there yet, however little the rotors are asked for
_HEIGHT = 0.2  # m gained since the command became high
_LOW = 0.65  # part of the way from idle to hover below which the rotors do not carry the vehicle
_LOW_S = 1.5
_FALLING = 0.75 * _G  # specific force below which a vehicle with idle motors falls and has not landed
_LYING_S = 1.0
_BLOW = 1.2 * _G  # lateral specific force, or half of it downwards, that rotors cannot make: the ground's
_BLOW_S = 3.0  # a blow so long before the end of a flight was the touch-down or the crash
_WINDOW_S = 0.5
_DOWN = (("landed", True), ("armed", False))  # words that say it is on the ground


@dataclass(frozen=True)
class Senses:
    """What is known at one tick. NaN: not known.

    command: mean motor command, share of its range. climb: m/s up. speed: horizontal, m/s. force: magnitude of the
    specific force, m/s^2; upward: its part along the rotors' thrust; turning: rad/s; all means over half a second.
    struck: a specific force, just now, that rotors cannot make. landed, armed: the autopilot's last word, or None.
    """

    command: float
    climb: float = np.nan
    speed: float = np.nan
    force: float = np.nan
    upward: float = np.nan
    turning: float = np.nan
    struck: bool = False
    landed: bool | None = None
    armed: bool | None = None


class Monitor:
    """Follows one vehicle tick by tick: `step` says whether it flies. `since`: when the present state began, s.

    Start: the command is well above idle and the vehicle climbs or moves; or the command is high for long.
    End: the command stays low while the vehicle neither falls nor sinks fast, at once where the autopilot says landed or disarmed; or
    something other than the rotors carries the vehicle: it lies on the ground tilted or upside down.
    """

    def __init__(self):
        self.flying, self.since = False, -np.inf
        self.idle: float | None = None
        self.floor, self.hover = 0.0, 0.0
        self.drift, self.height = 0.0, 0.0
        self.high_since = self.low_since = self.lying_since = None
        self.first_blow = self.last_blow = -np.inf

    def step(self, time: float, now: Senses) -> bool:
        """Take one tick; returns whether the vehicle is in the air."""
        # In the air, specific force is what the rotors push: along -z. Lying still on anything but the feet, it is not.
        lying = abs(now.force - _G) < 2.0 and now.upward < 0.7 * now.force and now.turning < 0.5
        self.lying_since = _since(self.lying_since, lying, time)
        (self._in_the_air if self.flying else self._on_the_ground)(time, now)
        return self.flying

    def goes_on(self, command: float) -> bool:
        """Does the vehicle still fly after a gap, by the first command after it? What lasted before the gap begins anew."""
        self.low_since = self.lying_since = None
        return self.flying and not self._little(command)

    def _little(self, command: float) -> bool:
        """Is it too little to carry a vehicle that flies?"""
        return command < self.floor + _LOW * (self.hover - self.floor)

    def _on_the_ground(self, time, now):
        floor = 0.0 if self.idle is None else self.idle
        high = now.command > max(_HIGH, floor + _HIGH_RISE)
        self.high_since = _since(self.high_since, high, time)
        climb = now.climb - self.drift if np.isfinite(now.climb) else 0.0
        self.height = self.height + TICK_S * climb if high else 0.0
        if self._lifted(time, now, climb):
            self.flying, self.since = True, time
            self.floor, self.hover = floor, max(now.command, floor + _HIGH_RISE)
            self.idle = floor
            self.low_since = None
            self.first_blow = self.last_blow = -np.inf
            return
        if not high:
            self.idle = now.command if self.idle is None else _blend(self.idle, now.command, _IDLE_S)
            if now.command < self.idle + _RISE and np.isfinite(now.climb):
                self.drift = _blend(self.drift, now.climb, _IDLE_S)

    def _lifted(self, time, now, climb) -> bool:
        high_for = 0.0 if self.high_since is None else time - self.high_since
        if self.lying_since is not None:
            return False
        if self.idle is None:  # the log starts with running motors: in the middle of a flight
            return high_for >= TICK_S
        if now.landed is True or now.armed is False:  # a stale word is overruled only by a plain climb
            return self.height > 5 * _HEIGHT
        if now.command < self.idle + _RISE:
            return False
        if climb > _CLIMB or self.height > _HEIGHT or now.speed > _SPEED + 2 * abs(self.drift):
            return True
        return high_for >= (_HIGH_S if np.isfinite(now.climb) else _HIGH_BLIND_S)

    def _in_the_air(self, time, now):
        low = self._little(now.command)
        self.low_since = _since(self.low_since, low and not now.climb < -_SINKING, time)
        if not low:
            self.hover = _blend(self.hover, now.command, _HOVER_S)
        if now.struck:
            self.first_blow = time if time - self.last_blow > 1.0 else self.first_blow
            self.last_blow = time
        end = None
        if low and (now.landed is True or now.armed is False):
            end = time if self.low_since is None else self.low_since
        elif self.low_since is not None and not now.force < _FALLING and time - self.low_since >= _LOW_S:
            end = self.low_since
        elif self.lying_since is not None and time - self.lying_since >= _LYING_S:
            end = self.lying_since - _WINDOW_S
        if end is not None:
            if end - self.last_blow <= _BLOW_S:
                end = min(end, self.first_blow)
            self.flying, self.since = False, max(end, self.since)
            self.high_since, self.height = None, 0.0


def _since(before, true: bool, time: float):
    """When a condition that is now `true` became so; None when it is not."""
    return (time if before is None else before) if true else None


def _blend(old: float, new: float, constant: float) -> float:
    """First-order low pass with the given time constant, s."""
    return old + TICK_S / constant * (new - old)


def airborne(flight: Flight) -> tuple[tuple[float, float], ...]:
    """Intervals (start s, end s) in the air, in time order; empty without motor commands.

    flight: needs `motors`; landings, velocity and position are used where the log has them.
    A flight that the log does not see end, ends with the last motor command. Starts are when lift-off is certain, late
    rather than early (a few tenths of a second); ends are where the landing or crash began to show.
    """
    if not flight.has("motors"):
        return ()
    time, command = commands(flight)
    if time.size < 2:
        return ()
    follow = Airborne()
    follow.on(flight, time, command, max(flight.duration, float(time[-1])))
    return follow.intervals()


def gaps(flight: Flight, air) -> tuple[tuple[float, float], ...]:
    """(start s, end s) of each gap of more than `GAP_S` in the motor commands within an interval in the air."""
    if not air:
        return ()
    time, _ = commands(flight)
    long = np.flatnonzero(np.diff(time) > GAP_S)
    found = [(float(time[k]), float(time[k + 1])) for k in long]
    return tuple((a, b) for a, b in found if any(start <= a and b <= end for start, end in air))


class Airborne:
    """When one vehicle was in the air, as its samples come. `now`: time up to which that is known [s]."""

    def __init__(self):
        self.now = -np.inf
        self.closed: list[tuple[float, float]] = []
        self._monitor, self._start, self._tick = Monitor(), None, None
        self._start: float | None
        self._last = -np.inf  # the last motor command

    def intervals(self) -> tuple[tuple[float, float], ...]:
        """As `airborne` gives them: one that still lasts ends with the last motor command."""
        return (*self.closed, *self._open())

    def spans(self) -> tuple[tuple[float, float], ...]:
        """The same, but one that still lasts has no end."""
        return (*self.closed, *([(self._start, np.inf)] if self._start is not None else []))

    def _open(self) -> list[tuple[float, float]]:
        return [(self._start, self._last)] if self._start is not None and self._last > self._start else []

    def on(self, flight: Flight, time: np.ndarray, command: np.ndarray, until: float) -> None:
        """Go on to `until` s. time, command (n,): motor commands up to then, from the last one before `now` on. flight: all that was
        logged, or a window of it that reaches two seconds further back."""
        pieces = np.split(np.arange(time.size), np.flatnonzero(np.diff(time) > GAP_S) + 1)
        for number, piece in enumerate(pieces, 1):
            when, what = time[piece], command[piece]
            if self._tick is None and when[-1] <= self._last:
                continue  # a stretch that is over
            if self._tick is None:
                self._resume(flight, float(when[0]), float(what[0]))
            self._last = max(self._last, float(when[-1]))
            # Past the last command, too: many logs stop with the motors, and say "landed" just after.
            held = self._last + GAP_S
            self._walk(flight, when, what, until if number == len(pieces) and until <= held else held)
            if number < len(pieces) or until > held:
                self._tick = None
        if until > self._last + MOST_GAP_S:
            self._end()
        self.now = max(self.now, until)

    def _resume(self, flight, time: float, command: float) -> None:
        """The first command after a gap: the flight goes on, or has ended with the last command before it."""
        over = time - self._last > MOST_GAP_S or not self._monitor.goes_on(command)
        if over or any(self._last < m.time <= time and (m.kind, m.value > 0.5) in _DOWN for m in flight.messages):
            self._end()

    def _end(self) -> None:
        """The flight ended with the last command."""
        self.closed += self._open()
        self._monitor, self._start = Monitor(), None

    def _walk(self, flight, time, command, end: float) -> None:
        """Go on within one stretch of motor commands without a long gap."""
        first = np.ceil(time[0] / TICK_S) if self._tick is None else self._tick
        numbers = np.arange(first, np.floor(end / TICK_S) + 1)
        if not numbers.size:
            return
        self._tick = numbers[-1] + 1
        ticks = numbers * TICK_S
        force, upward, turning, struck = _carried(flight, ticks)
        climb, speed = _motion(flight, ticks)
        landed, armed = (_state(flight, kind, ticks) for kind in ("landed", "armed"))
        held = command[np.clip(np.searchsorted(time, ticks, side="right") - 1, 0, None)]
        columns = (a.tolist() for a in (held, climb, speed, force, upward, turning))
        monitor = self._monitor
        for t, senses in zip(ticks.tolist(), zip(*columns, struck, landed, armed)):
            flying = monitor.step(t, Senses(*senses))
            if flying and self._start is None:
                self._start = t
            elif not flying and self._start is not None:
                if min(monitor.since, self._last) > self._start:
                    self.closed.append((self._start, min(monitor.since, self._last)))
                self._start = None


def commands(flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s at which motor commands are known, and the commands as shares of their range (n,)."""
    motors = flight["motors"]
    known = np.asarray(motors.valid).any(axis=1)
    return motors.time[known], _command(flight)[known]


def _command(flight: Flight) -> np.ndarray:
    """(n,) command of the rotors as a share of its range, a rough one where the log does not tell.

    Root mean square: thrust grows with the square, and rotors that fly on beside one that rests carry the vehicle all the same.
    """
    motors, (low, high) = flight["motors"], output_range(flight)
    valid = np.asarray(motors.valid)
    share = np.where(valid, np.clip((motors.values - low) / max(high - low, 1e-6), 0.0, 1.0), 0.0)
    return np.sqrt((share**2).sum(axis=1) / np.maximum(valid.sum(axis=1), 1))


def output_range(flight: Flight) -> tuple[float, float]:
    """Ends of the outputs' range as the autopilot counts it, in their unit."""
    if flight["motors"].unit != "us":
        return 0.0, 1.0
    low = flight.facts.get("pwm_min") or flight.parameters.get("MOT_PWM_MIN") or 1000.0
    return low, flight.facts.get("pwm_max") or flight.parameters.get("MOT_PWM_MAX") or 2000.0


def _motion(flight, ticks) -> tuple[np.ndarray, np.ndarray]:
    """Climb rate and horizontal speed at the ticks, m/s; NaN where there is none fresher than a second."""
    if not flight.has("velocity"):
        return np.full(ticks.size, np.nan), np.full(ticks.size, np.nan)
    velocity = flight["velocity"]
    value = np.where(velocity.valid, velocity.values, np.nan)
    climb, speed = -value[:, 2], np.hypot(value[:, 0], value[:, 1])
    return _latest(velocity, climb, ticks), _latest(velocity, speed, ticks)


def _carried(flight, ticks):
    """Specific force (magnitude, part along the thrust), angular rate, means over _WINDOW_S; and blows at the ticks."""
    force = upward = turning = np.full(ticks.size, np.nan)
    struck = [False] * ticks.size
    if flight.has("accel"):
        accel = flight["accel"]
        x, y, z = accel.values.T
        force = _latest(accel, _trailing(accel, np.linalg.norm(accel.values, axis=1)), ticks)
        upward = _latest(accel, _trailing(accel, -z), ticks)
        blows = accel.time[((np.hypot(x, y) > _BLOW) | (z > _BLOW / 2)) & np.asarray(accel.valid).all(axis=1)]
        struck = (np.searchsorted(blows, ticks, "right") > np.searchsorted(blows, ticks - TICK_S, "right")).tolist()
    if flight.has("gyro"):
        gyro = flight["gyro"]
        turning = _latest(gyro, _trailing(gyro, np.linalg.norm(gyro.values, axis=1)), ticks)
    return force, upward, turning, struck


def _trailing(signal: Signal, value: np.ndarray) -> np.ndarray:
    """Mean over the last _WINDOW_S before each sample, over samples that are valid; NaN without one."""
    good = np.asarray(signal.valid).all(axis=1)
    first = np.searchsorted(signal.time, signal.time - _WINDOW_S)
    total, count = (np.r_[0.0, np.cumsum(x)] for x in (np.where(good, value, 0.0), good))
    after = np.arange(1, value.size + 1)
    samples = count[after] - count[first]
    return np.where(samples > 0, (total[after] - total[first]) / np.maximum(samples, 1), np.nan)


def _latest(signal: Signal, value, ticks, most_s=1.0) -> np.ndarray:
    """The value at or before each tick; NaN when that is older than most_s."""
    at = np.searchsorted(signal.time, ticks, side="right") - 1
    fresh = (at >= 0) & (ticks - signal.time[np.clip(at, 0, None)] <= most_s)
    return np.where(fresh, value[np.clip(at, 0, None)], np.nan)


def _state(flight, kind, ticks) -> list[bool | None]:
    """The autopilot's last word of one kind at each tick, None before the first."""
    words = [(m.time, m.value > 0.5) for m in flight.messages if m.kind == kind]
    at = np.searchsorted([t for t, _ in words], ticks, side="right")
    return [words[i - 1][1] if i else None for i in at.tolist()]
