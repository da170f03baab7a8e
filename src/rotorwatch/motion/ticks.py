"""From a log's uneven samples to the diagnoser's ticks: one causal, uniform table of commands and motion.

A tick at time t uses nothing measured after t. It pairs the commands sent during one tick length with the motion they
caused a motor lag later:

    commands   mean of the rotor thrusts in (t - dt - a, t - a],     a = lag + dt / 2
    motion     over the window of length dt centred a lag after them

Units: thrusts in hover thrusts of one rotor (the mean command that carries the weight is 1), found from the first second
in the air and then kept for that hop. All frames body FRD.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.motion import allocation
from rotorwatch.motion.contact import G0, Contact, Shaken, look_back, struck, vibration

LAG_S = 0.02
SIDE_S = 0.5  # side forces are averaged over: they change as slowly as speed and wind, and vibration is louder
GAP_S = 4.0  # without any command: of a longer gap only so much at either end makes ticks
SETTLE_S = 1.0  # after lift-off: the first second gives the hover command and is not judged
UPSET_RATE = 6.0  # rad/s of roll or pitch rate: the vehicle tumbles, hover physics is over
UPSET_TILT = np.cos(np.radians(65.0))
CONTROLLED_SHARE, CONTROLLED_RATE = 0.9, 2.0  # of full thrust, and rad/s: below both a vehicle is under control

# s in the air before anything is judged; the same where healthy flights have told the noise.
READY_S, READY_KNOWN_S = 8.0, 3.0

GROUND, LEARN, JUDGE = 0, 1, 2
AGAIN = 2  # in the place of a restart: the trim is learned afresh, what is known to be lost stays


@dataclass(frozen=True)
class Ticks:
    """T ticks of an n-rotor flight.

    time (T,) s, when everything in the tick was known. command_time (T,) s, mean time of the commands in it.
    thrust (T, n); wrench (T, 4) = B thrust; rate, rate_dot (T, 3) rad/s, rad/s^2; load (T,) specific force up / g0;
    valid (T, 4) bool; mode (T,) GROUND, LEARN or JUDGE; restart (T,) bool, first tick of a hop; dt s; hover (T,) mean share of full thrust
    per rotor that one unit of thrust stands for; side (T, 2): specific force forward and right [m/s^2], mean of the last SIDE_S, or None
    where nothing measures it. contact (T,) bool: something outside pushed the vehicle, and for `ready_s` after it its trim is learned
    afresh (None: no contact); contacts: what and when. seen (T,) bool: a tick with commands in it, else thrust is 0.
    """

    time: np.ndarray
    command_time: np.ndarray
    thrust: np.ndarray
    wrench: np.ndarray
    rate: np.ndarray
    rate_dot: np.ndarray
    load: np.ndarray
    valid: np.ndarray
    mode: np.ndarray
    restart: np.ndarray
    hover: np.ndarray
    dt: float
    upset: np.ndarray
    notes: tuple[str, ...] = ()
    side: np.ndarray | None = None
    contact: np.ndarray | None = None
    contacts: tuple[Contact, ...] = ()
    seen: np.ndarray | None = None

    def part(self, keep: np.ndarray) -> Ticks:
        """The ticks `keep` (T,) bool."""
        return replace(self, **{k: v[keep] for k, v in vars(self).items() if isinstance(v, np.ndarray)})


def joined(parts: Sequence[Ticks]) -> Ticks:
    """Ticks that follow each other, in one table. What one of the parts does not have, the whole has not, but for contacts."""
    columns = {}
    for name, last in vars(parts[-1]).items():
        values = [getattr(p, name) for p in parts]
        if name == "contact" and any(v is not None for v in values):
            values = [np.zeros(len(p.time), bool) if p.contact is None else p.contact for p in parts]
        array = all(isinstance(v, np.ndarray) for v in values)
        columns[name] = np.concatenate(values) if array else None if isinstance(last, np.ndarray) else last
    return Ticks(**columns)


# Ticks in s, and the rate of commands in Hz from which on nearly all of them hold one.
LENGTHS = ((0.05, 19.0), (0.1, 8.0), (0.2, 4.5), (0.5, 1.8), (1.0, 0.0))
TICKS_S = tuple(length for length, _ in LENGTHS)
SHORTEST_S = (
    0.2  # a snapshot of the commands is compared with motion over so long, or with a sample and a half of the gyro
)
EARLIEST_TICKS = 2  # that an announcement takes: default/announcement.py
READY_TICKS = 30  # from which the noise is learned


def tick_length(rate_hz: float) -> float:
    """Length of a tick in s for commands at that rate: 0.05 s from 19 Hz on, 1 s for the slowest."""
    return next(length for length, least in LENGTHS if rate_hz >= least)


def slow(rate_hz: float, dt: float, ready_s: float) -> str:
    """What cannot be seen at slow ticks, a sentence; empty where they are not slow."""
    if dt <= SHORTEST_S / 2.0:
        return ""
    return (
        f"motor outputs at {rate_hz:.1f} Hz are judged every {dt:g} s, after {ready_s:.0f} s of learning: a loss is announced when it "
        f"shows in {EARLIEST_TICKS} of these, {EARLIEST_TICKS * dt:g} s; one that ends sooner is not seen, and a small one may stay unseen"
    )


def ready_after(ready_s: float, dt: float) -> float:
    """Blind time in s after lift-off: as asked for, but long enough to learn the noise at slow ticks."""
    return max(ready_s, READY_TICKS * dt)


def _filled(at: np.ndarray, most: int, first: int = 0) -> np.ndarray:
    """The ticks `at` (non-decreasing) and those between them and from `first` on, but of each gap only the first and last `most`.

    Nothing is known of the rest of a longer gap, and days of it cost nothing.
    """
    at = np.maximum(at, first)
    if at[-1] - first <= 2 * most:
        return np.arange(first, at[-1] + 1)
    gaps = np.flatnonzero(np.diff(at) > 2 * most)
    begin = np.r_[first, at[gaps + 1] - most]
    end = np.r_[at[gaps] + most, at[-1] + 1]
    return np.concatenate([np.arange(a, b) for a, b in zip(begin, end)])


def _known(signal: Signal) -> tuple[np.ndarray, np.ndarray]:
    """(time, values) of the samples of which all is known."""
    if signal.valid.all():  # the rule
        return signal.time, signal.values
    ok = signal.valid.all(axis=1)
    return signal.time[ok], signal.values[ok]


def _bin_mean(signal: Signal, edges_lo: np.ndarray, edges_hi: np.ndarray):
    """Mean of valid samples with lo < time <= hi, their mean time and whether there is any: (T, k), (T,), (T,)."""
    time, values = _known(signal)
    total, when = np.zeros((time.size + 1, values.shape[1])), np.zeros(time.size + 1)
    np.cumsum(values, axis=0, out=total[1:])
    np.cumsum(time, out=when[1:])
    lo, hi = time.searchsorted(edges_lo, "right"), time.searchsorted(edges_hi, "right")
    count = hi - lo
    some = count > 0
    safe = np.maximum(count, 1)
    return (total[hi] - total[lo]) / safe[:, None], (when[hi] - when[lo]) / safe, some


def _period(signal: Signal) -> float:
    """Usual time between two samples that are known, s; NaN with fewer than two."""
    time = signal.time[signal.valid.all(axis=1)]
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan


def samples_in(half: float, period: float) -> int:
    """How many samples a window of twice `half` s needs at least, of a signal with so many s between two; NaN: not known."""
    return max(1, int(half / period * 0.8)) if period > 0.0 else 1


class _Course:
    """A signal between its samples, as straight lines: for means over many windows of it."""

    def __init__(self, signal: Signal, period: float | None = None):
        """period: usual time between two samples [s]; None: what this piece of the signal shows. known: `_known` of it."""
        self.known = time, values = _known(signal)
        step = time[1:] - time[:-1]
        if not (step > 0).all():
            keep = np.concatenate([[True], step > 0])
            time, values = time[keep], values[keep]
            step = time[1:] - time[:-1]
        self._time, self._values, self._step = time, values, step
        self._integral = np.zeros(values.shape)
        np.cumsum(0.5 * (values[1:] + values[:-1]) * step[:, None], axis=0, out=self._integral[1:])
        self._period = _period(signal) if period is None else period

    def over(self, centre: np.ndarray, half: float, slope: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean (T, k) and slope (T, k; 0 unless asked for) over [centre - half, centre + half], and whether there are enough samples
        in it (T,).

        The mean comes from the exact integral of the linear interpolation. The slope is the difference of two short means
        around the ends, which keeps single-sample noise out when the signal is much faster than the window.
        """
        time, values, count = self._time, self._values, centre.size
        shape = (count, values.shape[1])
        if time.size < 2:
            return np.zeros(shape), np.zeros(shape), np.zeros(count, bool)
        end = half * 0.25
        lo, hi = centre - half, centre + half
        t = np.concatenate([lo, hi, lo + end, hi - end] if slope else [lo, hi])
        after = time.searchsorted(t, "right")
        i = np.minimum(np.maximum(after - 1, 0), time.size - 2)
        width = self._step[i][:, None]
        s = np.minimum(np.maximum((t - time[i])[:, None] / width, 0.0), 1.0)
        left = values[i]
        area = self._integral[i] + width * (left * s + 0.5 * (values[i + 1] - left) * s * s)
        first, stop = area[:count], area[count : 2 * count]
        middle = (stop - first) / (hi - lo)[:, None]
        rise = np.zeros(shape)
        if slope:
            start, last = area[2 * count : 3 * count], area[3 * count :]
            rise = ((stop - last) / (hi - (hi - end))[:, None] - (start - first) / ((lo + end) - lo)[:, None]) / (
                2.0 * half - end
            )
        gap = after[count : 2 * count] - time.searchsorted(lo, "left")
        least = samples_in(half, self._period)
        covered = (lo >= time[0]) & (hi <= time[-1] + 1e-9) & (gap >= least)
        return middle, rise, covered


def _learned_again(contact, restart, thrust, hover, rate, fresh, before: float) -> np.ndarray:
    """(T,) ticks of controlled flight since the last contact of the hop, infinite without one. A vehicle that spins or has outputs
    near their limits is not what its trim can be learned from. before: the same at the tick before the first."""
    if not contact.any() and before == np.inf:  # the rule
        return np.full(len(contact), np.inf)
    controlled = (
        fresh
        & ((thrust * hover[:, None]).max(axis=1) < CONTROLLED_SHARE)
        & (np.abs(rate).max(axis=1) < CONTROLLED_RATE)
    )
    since = np.cumsum(controlled)
    last, hop = (np.maximum.accumulate(np.where(x, np.arange(len(since)), -1)) for x in (contact, restart))
    earlier = np.where(hop < 0, before + since, np.inf)
    return np.where((last >= hop) & (last >= 0), since - since[np.maximum(last, 0)], earlier)


def _span(motion: Signal, commands: Signal, dt: float) -> float:
    """Half of the time over which a signal is averaged for a tick: the tick, but less where its commands are one snapshot."""
    if dt <= SHORTEST_S or commands.rate_hz > 1.5 / dt:
        return 0.5 * dt
    return 0.5 * min(dt, max(SHORTEST_S, 1.5 / max(motion.rate_hz, 1e-3)))


@dataclass(frozen=True)
class Plan:
    """How a flight is cut into ticks: what its sampling rates decide, once for all of it.

    dt: length of a tick; ready_s: blind time after lift-off; lag_s; first: end of the first tick [all s]. gyro: signal that tells angular
    rates, or None. accel: the log has one. half: signal -> half of the time it is averaged over; period: signal -> usual time between
    samples [s]. notes: sentences on what the log lacks.
    """

    dt: float
    ready_s: float
    lag_s: float
    first: float
    gyro: str | None
    accel: bool
    half: dict[str, float]
    period: dict[str, float]
    notes: tuple[str, ...]

    def numbers(self, time: np.ndarray, last: int = -1) -> np.ndarray:
        """Running numbers of the ticks that commands at `time` (non-decreasing, s) complete, after the tick `last`."""
        at = ((time - self.first) / self.dt).astype(np.int64)
        if last < 0:
            return _filled(at, round(GAP_S / self.dt))
        filled = _filled(np.concatenate([[last], np.maximum(at, last)]), round(GAP_S / self.dt), last)
        return filled[filled > last]

    def ends(self, numbers: np.ndarray) -> np.ndarray:
        """Time at which the last command counts, of ticks by their numbers."""
        return self.first + self.dt * numbers


def plan(flight: Flight, thrust: Signal, ready_s: float, lag_s: float = LAG_S, dt: float | None = None) -> Plan:
    """The plan of a flight with these commands; see `make`."""
    dt = tick_length(thrust.rate_hz) if dt is None else dt
    ready_s, half = ready_after(ready_s, dt), dt / 2.0
    notes = []
    if limit := slow(thrust.rate_hz, dt, ready_s):
        notes.append(limit)
    # Slow commands are snapshots: put them in the middle of their ticks so that jitter never empties one.
    turns = np.exp(2j * np.pi * thrust.time[:64] / dt)  # the first seconds decide, so that a longer log changes nothing
    phase = float(np.angle(turns.mean()) / (2.0 * np.pi) % 1.0 * dt) if thrust.rate_hz < 1.5 / dt else 0.0
    gyro = "gyro" if flight.has("gyro") else "rates" if flight.has("rates") else None
    if gyro is None:
        notes.append("no angular rate in the log: torque is judged from commands alone, as in steady hover")
    if not flight.has("accel"):
        notes.append("no accelerometer in the log: thrust is not judged, only torque")
    motion = [name for name in (gyro, "accel" if flight.has("accel") else None) if name]
    return Plan(
        dt, ready_s, lag_s, float(np.floor((thrust.time[0] - phase) / dt) * dt + phase + half), gyro, flight.has("accel"),
        {name: _span(flight[name], thrust, dt) for name in motion}, {name: _period(flight[name]) for name in motion}, tuple(notes),
    )  # fmt: skip


@dataclass(frozen=True)
class Sensed:
    """What was commanded and measured in T ticks, whether in the air or not: a tick needs no other, and nothing logged after it.

    time, when (T,) s as in `Ticks`; share (T, n): mean share of full thrust; some (T,) bool: commands in it; rate, rate_dot, load, side as
    in `Ticks`; push (T, 2): side force of the tick alone; rate_ok, load_ok (T,) bool; shake (T,): vibration so far [m/s^2]; level (T,):
    cosine of the tilt. push, side and shake are None without an accelerometer.
    """

    time: np.ndarray
    when: np.ndarray
    share: np.ndarray
    some: np.ndarray
    rate: np.ndarray
    rate_dot: np.ndarray
    rate_ok: np.ndarray
    load: np.ndarray
    load_ok: np.ndarray
    level: np.ndarray
    push: np.ndarray | None = None
    side: np.ndarray | None = None
    shake: np.ndarray | None = None

    def __len__(self):
        return len(self.time)

    def __getitem__(self, part: slice) -> Sensed:
        columns: list[Any] = [None if x is None else x[part] for x in vars(self).values()]
        return Sensed(*columns)

    def __add__(self, later: Sensed) -> Sensed:
        pairs = zip(vars(self).values(), vars(later).values())
        columns: list[Any] = [None if a is None or b is None else np.concatenate([a, b]) for a, b in pairs]
        return Sensed(*columns)


def sense(flight: Flight, thrust: Signal, hi: np.ndarray, plan: Plan, shaken: Shaken | None = None) -> Sensed:
    """The ticks that end at `hi` (T,) s. flight, thrust: all of a flight, or a window of it that reaches two seconds further back than the
    ticks, and then what was shaken before it, which this goes on with."""
    dt, half, count = plan.dt, plan.dt / 2.0, hi.size
    time = hi + plan.lag_s + half
    mean, when, some = _bin_mean(thrust, hi - dt, hi)
    when = np.where(some, when, hi - half)
    centre = when + plan.lag_s
    zeros3 = np.zeros((count, 3))

    rate, rate_dot, gyro_ok = zeros3, zeros3, np.ones(count, bool)
    if plan.gyro:
        turning = _Course(flight[plan.gyro], plan.period[plan.gyro])
        rate, rate_dot, gyro_ok = turning.over(centre, plan.half[plan.gyro])
    side = push = shake = None
    load, accel_ok = np.ones(count), np.zeros(count, bool)
    if plan.accel:
        accel = flight["accel"]
        course = _Course(accel, plan.period["accel"])
        force, _, accel_ok = course.over(centre, plan.half["accel"], slope=False)
        load, push = -force[:, 2] / G0, force[:, :2]
        shake = vibration(*course.known, centre - half, shaken)
        side, _, side_ok = course.over(centre + half - 0.5 * SIDE_S, 0.5 * SIDE_S, slope=False)
        side = np.where(side_ok[:, None], side[:, :2], 0.0)
    level = np.ones(count)
    if "attitude" in flight.signals and len(flight["attitude"]):
        q = flight["attitude"]
        i = np.minimum(np.maximum(q.time.searchsorted(time, "right") - 1, 0), len(q) - 1)
        _, x, y, _ = q.values[i].T
        level = 1.0 - 2.0 * (x * x + y * y)
    return Sensed(time, when, mean, some, rate, rate_dot, gyro_ok, load, accel_ok, level, push, side, shake)


@dataclass(frozen=True)
class Past:
    """What ticks leave to those that follow. hop: start of the hop the last one was in [s]; hover: its share of full thrust in hover; gone:
    the vehicle has tumbled in it; learned: `_learned_again`. upset (w,), recent: raw rows of the last ticks (for `struck`); contacts
    so far, and the time of the last."""

    hop: float
    hover: float
    gone: bool
    learned: float
    upset: np.ndarray
    recent: tuple
    contacts: tuple[Contact, ...]
    hit: float


def observe(flight: Flight, vehicle: Vehicle, air, ready_s: float) -> Ticks | None:
    """Ticks of a flight, or None when it shows no motor commands in the air."""
    if not flight.has("motors") or not air:
        return None
    thrust = allocation.rotor_thrusts(flight, vehicle)
    if len(thrust) < 20:
        return None
    return make(flight, thrust, vehicle.effectiveness(), air, ready_s, hover=known_hover(vehicle))


def known_hover(vehicle: Vehicle) -> float | None:
    """Share of full thrust that carries the vehicle, where healthy flights have told."""
    return (vehicle.identified or {}).get("hover")


def make(
    flight: Flight,
    thrust: Signal,
    B: np.ndarray,
    airborne: tuple[tuple[float, float], ...],
    ready_s: float,
    lag_s: float = LAG_S,
    hover: float | None = None,
    dt: float | None = None,
) -> Ticks:
    """Ticks of one flight. thrust: share of full thrust per rotor over time; B (4, n); ready_s: blind time after lift-off.

    hover: share of full thrust that carries the vehicle, when a vehicle file or baseline knows it.
    """
    how = plan(flight, thrust, ready_s, lag_s, dt)
    seen = sense(flight, thrust, how.ends(how.numbers(thrust.time)), how)
    return assemble(seen, how, B, airborne, hover)[0]


def assemble(
    seen: Sensed,
    plan: Plan,
    B: np.ndarray,
    airborne: tuple[tuple[float, float], ...],
    hover: float | None = None,
    past: Past | None = None,
) -> tuple[Ticks, Past]:
    """Ticks from what was sensed in them and when the vehicle was in the air; in one piece, or piece by piece with the past of each.

    A piece must not end in the first second of a hop: what carries the vehicle is learned from all of it.
    """
    dt, time, when, some, mean, rate = plan.dt, seen.time, seen.when, seen.some, seen.share, seen.rate
    count, width = len(seen), max(2, round(0.3 / dt))
    if past is None:
        past = Past(-np.inf, hover or 1.0, False, np.inf, np.zeros(width - 1, bool), (), (), -np.inf)
    valid = np.empty((count, 4), bool)
    valid[:, :3] = (some & seen.rate_ok)[:, None]
    valid[:, 2] &= bool(
        np.abs(B[2]).max() > 0.0
    )  # rotors that make no yaw torque explain none: a servo yaws a tricopter
    valid[:, 3] = some & seen.load_ok
    mode = np.zeros(count, np.int32)
    restart = np.zeros(count, bool)
    scale = np.full(count, past.hover)
    upset = (np.abs(rate[:, :2]).max(axis=1, initial=0.0) > UPSET_RATE) | (seen.level < UPSET_TILT)
    hop, gone, tumbling = past.hop, past.gone, np.concatenate([past.upset, np.zeros(count, bool)])
    for start, end in airborne:
        inside = (time >= start + SETTLE_S) & (when <= end)
        if not inside.any():
            continue
        level = past.hover
        if start != hop:
            hop, gone = start, False
            level = hover if hover is not None else _hover(seen, inside, start)
            restart[np.flatnonzero(inside)[0]] = True
            tumbling[: width - 1] = False
        scale[time >= start] = max(level, 0.02)
        mode[inside] = np.where(time[inside] >= start + plan.ready_s, JUDGE, LEARN)
        # Once tumbling, never hovering again in this hop: what follows is a fall, not evidence.
        tumbling[width - 1 :] = upset & inside
        if gone:
            upset = upset | inside
            continue
        if not tumbling.any():
            continue
        long_upset = np.convolve(tumbling, np.ones(width), "full")[width - 1 : width - 1 + count] >= width - 0.5
        begin = np.flatnonzero(long_upset & inside)
        first = begin[0] if begin.size else count
        gone = first < count
        upset = upset | ((np.arange(count) >= first) & inside)
    units = mean / scale[:, None]
    wrench = units @ B.T
    fresh = some & seen.rate_ok & (seen.load_ok | (seen.push is None)) & (mode > GROUND)
    rows: tuple[Any, ...] = (time, seen.push, seen.load, seen.shake, units, wrench[:, :3], seen.rate_dot, fresh)
    if past.recent:
        rows = tuple(None if b is None else np.concatenate([a, b]) for a, b in zip(past.recent, rows))
    known = len(rows[0]) - count
    contact, contacts, hit = struck(*rows, dt=dt, known=known, before=past.contacts, last=past.hit)
    learned = _learned_again(contact, restart, units, scale, rate, fresh, past.learned)
    mode[(mode == JUDGE) & (learned < round(plan.ready_s / dt))] = LEARN
    valid &= (~upset & ~contact & (mode > GROUND))[:, None]
    side = seen.side
    table = Ticks(
        time, when, units, wrench, rate, seen.rate_dot, seen.load, valid, mode, restart, scale, dt, upset,
        plan.notes, side, contact, contacts, some,
    )  # fmt: skip
    if not count:
        return table, past
    recent = tuple(None if x is None else x[-(look_back(dt) + 1) :] for x in rows)
    return table, Past(
        hop, float(scale[-1]), gone, float(learned[-1]), tumbling[count:], recent, contacts, hit
    )  # fmt: skip


def _hover(seen: Sensed, inside: np.ndarray, start: float) -> float:
    """Share of full thrust that carries the vehicle, from the first second after `start`."""
    settle = (seen.when >= start) & (seen.when < start + SETTLE_S) & seen.some & (seen.share.sum(axis=1) > 0)
    if not settle.any():
        return float(np.median(seen.share[inside][:10]))
    load = np.where(seen.load_ok[settle], np.clip(seen.load[settle], 0.5, 2.0), 1.0)
    return float(np.median(seen.share[settle].mean(axis=1) / load))
