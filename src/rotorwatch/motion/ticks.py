"""From a log's uneven samples to the diagnoser's ticks: one causal, uniform table of commands and motion.

A tick at time t uses nothing measured after t. It pairs the commands sent during one tick length with the motion they
caused a motor lag later:

    commands   mean of the rotor thrusts in (t - dt - a, t - a],     a = lag + dt / 2
    motion     over the window of length dt centred a lag after them

Units: thrusts in hover thrusts of one rotor (the mean command that carries the weight is 1), found from the first second
in the air and then kept for that hop. All frames body FRD.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.motion import allocation
from rotorwatch.motion.contact import G0, Contact, struck, vibration

LAG_S = 0.02
SIDE_S = 0.5  # side forces are averaged over: they change as slowly as speed and wind, and vibration is louder
GAP_S = 2.0  # without any command: a flight ends there, see airborne.py
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


# Ticks in s, and the rate of commands in Hz from which on nearly all of them hold one.
LENGTHS = ((0.05, 19.0), (0.1, 8.0), (0.2, 4.5), (0.5, 1.8), (1.0, 0.0))
SHORTEST_S = (
    0.2  # a snapshot of the commands is compared with motion over so long, or with a sample and a half of the gyro
)
READY_TICKS = 30  # from which the noise is learned


def tick_length(rate_hz: float) -> float:
    """Length of a tick in s for commands at that rate: 0.05 s from 19 Hz on, 1 s for the slowest."""
    return next(length for length, least in LENGTHS if rate_hz >= least)


def ready_after(ready_s: float, dt: float) -> float:
    """Blind time in s after lift-off: as asked for, but long enough to learn the noise at slow ticks."""
    return max(ready_s, READY_TICKS * dt)


def _filled(at: np.ndarray, most: int) -> np.ndarray:
    """The ticks `at` (non-decreasing) and those between them, but of each gap only the first and last `most`.

    Nothing flies in a longer gap, and days of it cost nothing.
    """
    at = np.maximum(at, 0)
    gaps = np.flatnonzero(np.diff(at) > 2 * most)
    begin = np.r_[0, at[gaps + 1] - most]
    end = np.r_[at[gaps] + most, at[-1] + 1]
    return np.concatenate([np.arange(a, b) for a, b in zip(begin, end)])


def _bin_mean(signal: Signal, edges_lo: np.ndarray, edges_hi: np.ndarray):
    """Mean of valid samples with lo < time <= hi, their mean time and whether there is any: (T, k), (T,), (T,)."""
    ok = signal.valid.all(axis=1)
    time, values = signal.time[ok], signal.values[ok]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    when = np.concatenate([[0.0], np.cumsum(time)])
    lo, hi = np.searchsorted(time, edges_lo, "right"), np.searchsorted(time, edges_hi, "right")
    count = hi - lo
    some = count > 0
    safe = np.maximum(count, 1)
    return (total[hi] - total[lo]) / safe[:, None], (when[hi] - when[lo]) / safe, some


def _window(signal: Signal, centre: np.ndarray, half: float):
    """Mean (T, k) and slope (T, k) of a signal over [centre - half, centre + half], linear between samples; and coverage.

    The mean comes from the exact integral of the linear interpolation. The slope is the difference of two short means
    around the ends, which keeps single-sample noise out when the signal is much faster than the window.
    """
    ok = signal.valid.all(axis=1)
    time, values = signal.time[ok], signal.values[ok]
    if time.size < 2:
        shape = (centre.size, signal.values.shape[1])
        return np.zeros(shape), np.zeros(shape), np.zeros(centre.size, bool)
    keep = np.concatenate([[True], np.diff(time) > 0])
    time, values = time[keep], values[keep]
    step = np.diff(time)[:, None]
    integral = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]) * step, axis=0)]
    )

    def area(t):
        i = np.clip(np.searchsorted(time, t, "right") - 1, 0, time.size - 2)
        s = np.clip((t - time[i]) / (time[i + 1] - time[i]), 0.0, 1.0)[:, None]
        width = (time[i + 1] - time[i])[:, None]
        return integral[i] + width * (values[i] * s + 0.5 * (values[i + 1] - values[i]) * s * s)

    def mean(a, b):
        return (area(b) - area(a)) / (b - a)[:, None]

    end = half * 0.25
    lo, hi = centre - half, centre + half
    middle = mean(lo, hi)
    slope = (mean(hi - end, hi) - mean(lo, lo + end)) / (2.0 * half - end)
    gap = np.searchsorted(time, hi, "right") - np.searchsorted(time, lo, "left")
    period = float(np.median(np.diff(time)))
    covered = (lo >= time[0]) & (hi <= time[-1] + 1e-9) & (gap >= max(1, int(half / period * 0.8)))
    return middle, slope, covered


def _learning_again(contact, restart, thrust, hover, rate, fresh, count: int) -> np.ndarray:
    """(T,) bool: fewer than `count` ticks of controlled flight since the last contact of the hop. A vehicle that spins or has outputs
    near their limits is not what its trim can be learned from."""
    controlled = (
        fresh
        & ((thrust * hover[:, None]).max(axis=1) < CONTROLLED_SHARE)
        & (np.abs(rate).max(axis=1) < CONTROLLED_RATE)
    )
    since = np.cumsum(controlled)
    last = np.maximum.accumulate(np.where(contact, np.arange(len(since)), -1))
    hop = np.maximum.accumulate(np.where(restart, np.arange(len(since)), 0))
    return (last >= hop) & (last >= 0) & (since - since[np.maximum(last, 0)] < count)


def _span(motion: Signal, commands: Signal, dt: float) -> float:
    """Half of the time over which a signal is averaged for a tick: the tick, but less where its commands are one snapshot."""
    if dt <= SHORTEST_S or commands.rate_hz > 1.5 / dt:
        return 0.5 * dt
    return 0.5 * min(dt, max(SHORTEST_S, 1.5 / max(motion.rate_hz, 1e-3)))


def observe(flight: Flight, vehicle: Vehicle, air, ready_s: float) -> Ticks | None:
    """Ticks of a flight, or None when it shows no motor commands in the air."""
    if not flight.has("motors") or not air:
        return None
    thrust = allocation.rotor_thrusts(flight, vehicle)
    if len(thrust) < 20:
        return None
    hover = (vehicle.identified or {}).get("hover")
    return make(flight, thrust, vehicle.effectiveness(), air, ready_s, hover=hover)


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
    dt = tick_length(thrust.rate_hz) if dt is None else dt
    ready_s, half = ready_after(ready_s, dt), dt / 2.0
    notes = []
    if dt > SHORTEST_S / 2.0:
        notes.append(
            f"motor outputs at {thrust.rate_hz:.1f} Hz are judged every {dt:g} s, after {ready_s:.0f} s of learning: losses are found "
            "late, and short or small ones not at all"
        )
    # Slow commands are snapshots: put them in the middle of their ticks so that jitter never empties one.
    turns = np.exp(2j * np.pi * thrust.time[:64] / dt)  # the first seconds decide, so that a longer log changes nothing
    phase = float(np.angle(turns.mean()) / (2.0 * np.pi) % 1.0 * dt) if thrust.rate_hz < 1.5 / dt else 0.0
    first = np.floor((thrust.time[0] - phase) / dt) * dt + phase + half
    hi = first + dt * _filled(((thrust.time - first) / dt).astype(np.int64), round(GAP_S / dt))
    count = hi.size
    time = hi + lag_s + half
    mean, when, some = _bin_mean(thrust, hi - dt, hi)
    when = np.where(some, when, hi - half)
    centre = when + lag_s
    zeros3 = np.zeros((count, 3))
    gyro_name = "gyro" if flight.has("gyro") else "rates" if flight.has("rates") else None
    if gyro_name:
        rate, rate_dot, gyro_ok = _window(flight[gyro_name], centre, _span(flight[gyro_name], thrust, dt))
    else:
        rate, rate_dot, gyro_ok = zeros3, zeros3, np.ones(count, bool)
        notes.append("no angular rate in the log: torque is judged from commands alone, as in steady hover")
    if flight.has("accel"):
        force, _, accel_ok = _window(flight["accel"], centre, _span(flight["accel"], thrust, dt))
        load, push = -force[:, 2] / G0, force[:, :2]
        whole = flight["accel"].valid.all(axis=1)
        shake = vibration(flight["accel"].time[whole], flight["accel"].values[whole], centre - half)
        side, _, side_ok = _window(flight["accel"], centre + half - 0.5 * SIDE_S, 0.5 * SIDE_S)
        side = np.where(side_ok[:, None], side[:, :2], 0.0)
    else:
        side = push = shake = None
        load, accel_ok = np.ones(count), np.zeros(count, bool)
        notes.append("no accelerometer in the log: thrust is not judged, only torque")

    valid = np.empty((count, 4), bool)
    valid[:, :3] = (some & gyro_ok)[:, None]
    valid[:, 2] &= bool(
        np.abs(B[2]).max() > 0.0
    )  # rotors that make no yaw torque explain none: a servo yaws a tricopter
    valid[:, 3] = some & accel_ok
    mode = np.zeros(count, np.int32)
    restart = np.zeros(count, bool)
    scale = np.full(count, hover or 1.0)
    tilt = np.ones(count)
    if flight.has("attitude"):
        q = flight["attitude"]
        i = np.clip(np.searchsorted(q.time, time, "right") - 1, 0, len(q) - 1)
        _, x, y, _ = q.values[i].T
        tilt = 1.0 - 2.0 * (x * x + y * y)
    upset = (np.abs(rate[:, :2]).max(axis=1, initial=0.0) > UPSET_RATE) | (tilt < UPSET_TILT)
    for start, end in airborne:
        inside = (time >= start + SETTLE_S) & (when <= end)
        if not inside.any():
            continue
        settle = (when >= start) & (when < start + SETTLE_S) & some & (mean.sum(axis=1) > 0)
        if hover is None:
            first_load = np.where(accel_ok[settle], np.clip(load[settle], 0.5, 2.0), 1.0)
            level = (
                float(np.median(mean[settle].mean(axis=1) / first_load))
                if settle.any()
                else float(np.median(mean[inside][:10]))
            )
        else:
            level = hover
        scale[time >= start] = max(level, 0.02)
        mode[inside] = np.where(time[inside] >= start + ready_s, JUDGE, LEARN)
        restart[np.flatnonzero(inside)[0]] = True
        # Once tumbling, never hovering again in this hop: what follows is a fall, not evidence.
        fall = np.flatnonzero(inside & upset)
        if fall.size:
            since = (time >= time[fall[0]]) & inside
            long_upset = (
                np.convolve(upset & inside, np.ones(max(2, round(0.3 / dt))), "full")[:count]
                >= max(2, round(0.3 / dt)) - 0.5
            )
            begin = np.flatnonzero(long_upset & since)
            if begin.size:
                gone = (np.arange(count) >= begin[0]) & inside
                upset = upset | gone
    thrust_units = mean / scale[:, None]
    wrench = thrust_units @ B.T
    fresh = some & gyro_ok & (accel_ok | (push is None)) & (mode > GROUND)
    contact, contacts = struck(time, push, load, shake, thrust_units, wrench[:, :3], rate_dot, fresh, dt)
    mode[(mode == JUDGE) & _learning_again(contact, restart, thrust_units, scale, rate, fresh, round(ready_s / dt))] = (
        LEARN
    )
    valid &= (~upset & ~contact & (mode > GROUND))[:, None]
    return Ticks(
        time,
        when,
        thrust_units,
        wrench,
        rate,
        rate_dot,
        load,
        valid,
        mode,
        restart,
        scale,
        dt,
        upset,
        tuple(notes),
        side,
        contact,
        contacts,
        some,
    )
