"""Outputs that oscillate: a control loop that swings by itself, its axis, its frequency and the gain to lower.

The outputs' shares of their range, projected on each axis of the mixer, swing by x(t) = a sin(2 pi f t) for as long as a loop has too much
gain; manoeuvres and gusts are spread over many frequencies. A window of WINDOW_S counts where a band of +-WIDTH around the largest line has
PURE of the power of the outputs and of the angular rate alike, and the outputs swing by SWINGS or more. A window of aggressive flight has
up to 0.85, a limit cycle 0.96 and more.

Outputs are often logged at 10 Hz, far below 2 f: both signals then show an alias of f,

    f_seen = |f - k F|,     F: rate of the log, k: integer,

and f is the lowest frequency that both explain; where none does, it is not one oscillation. Below ASKED_HZ the setpoint must not swing
itself: pilots and position loops are no faster.

The gain: with u = P e + D de/dt the derivative dominates where 2 pi f D, behind its filter, exceeds P, else P; below twice the bandwidth of
the attitude loop, of K rad/s, its gain K is too high. ArduPilot's tuning guide lowers the gain of the oscillating axis in the same order
(https://ardupilot.org/copter/docs/tuning-process-instructions.html).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rotorwatch.answer import ledger
from rotorwatch.answer.traces import angles
from rotorwatch.answer.wording import percent
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import OSCILLATES, Kind, Weight, Words, register
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.witness import Events, Stage, View, Witness

SOURCE = Source("oscillation", 16)
AXES = ("roll", "pitch", "yaw")
WINDOW_S, STEP_S, EDGE_S = 4.0, 2.0, 3.0  # s; after a take-off and before a landing nothing is looked at
WIDTH, PURE = 0.12, 0.9
SWINGS = 0.1  # of the range, peak to peak: 80 to 100 us
SLOWEST_BIN = 2  # of a window: slower is its drift
LEAST_HZ, MOST_HZ, FASTEST_HZ = 1.0, 40.0, 200.0  # frequencies reported: slower is flying; rate to which signals are thinned
WINDOWS, LEAST_SAMPLES = 3, 12  # at least; of a window
BIN = 1.0 / WINDOW_S
ASKED_HZ, ASKED = 3.0, 0.3
register(
    Kind(
        23, OSCILLATES, "outputs oscillate", "the outputs swing at one frequency: a control gain is too high", Weight.NOTICE,
        brief="outputs oscillate", headline=Words("{Why}."),
        advice=Words("Look for loose arms and motors; then lower the named gain by a quarter at a time."),
    )
)  # fmt: skip
# Of an autopilot, each axis: rate P, rate D, the filter of D [Hz], the attitude loop's gain [1/s].
GAINS = {
    "ardupilot": [(f"ATC_RAT_{a}_P", f"ATC_RAT_{a}_D", f"ATC_RAT_{a}_FLTD", f"ATC_ANG_{a}_P") for a in ("RLL", "PIT", "YAW")],
    "px4": [(f"MC_{a}RATE_P", f"MC_{a}RATE_D", "IMU_DGYRO_CUTOFF", f"MC_{a}_P") for a in ("ROLL", "PITCH", "YAW")],
}


class Line(NamedTuple):
    """The largest line of each window and axis. start (w,) s; frequency (w, 3) Hz; pure (w, 3): share of the power near it; swing (w, 3):
    peak to peak; rate: of the samples [Hz]."""

    start: np.ndarray
    frequency: np.ndarray
    pure: np.ndarray
    swing: np.ndarray
    rate: float

    @property
    def clear(self) -> np.ndarray:
        """(w, 3) bool: windows in which outputs swing at one frequency."""
        return (self.pure >= PURE) & (self.swing >= SWINGS)


def lines(time: np.ndarray, values: np.ndarray, rate: float, span: tuple[float, float]) -> Line | None:
    """Of a signal (m, k) at about `rate` Hz in one flight; None where it is too short or has gaps."""
    rate = min(rate, FASTEST_HZ)
    n, step = round(WINDOW_S * rate), max(1, round(STEP_S * rate))
    grid = np.arange(span[0], span[1], 1.0 / rate)
    if n < LEAST_SAMPLES or grid.size < n or not time.size:
        return None
    even = np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    starts = np.arange(0, grid.size - n + 1, step)
    ends = np.searchsorted(time, grid[starts] + WINDOW_S)
    starts = starts[ends - np.searchsorted(time, grid[starts]) > 0.7 * n * min(1.0, rate / FASTEST_HZ * 10.0)]
    if not starts.size:
        return None
    x = np.lib.stride_tricks.sliding_window_view(even, n, axis=0)[starts]
    ramp = np.arange(n) - 0.5 * (n - 1)
    x = x - x.mean(axis=2, keepdims=True)
    x = x - (x @ ramp / (ramp @ ramp))[..., None] * ramp
    power = np.abs(np.fft.rfft(x * np.hanning(n), axis=2)) ** 2
    power[..., :SLOWEST_BIN] = 0.0
    bins = np.arange(power.shape[2])
    low = np.minimum(np.floor((1.0 - WIDTH) * bins), bins - 2).clip(0).astype(int)
    high = np.minimum(np.maximum(np.ceil((1.0 + WIDTH) * bins), bins + 2), bins[-1]).astype(int) + 1
    total = np.concatenate([np.zeros((*power.shape[:2], 1)), np.cumsum(power, axis=2)], axis=2)
    best = np.argmax(power, axis=2)[..., None]
    band = np.take_along_axis(total, high[best], 2) - np.take_along_axis(total, low[best], 2)
    pure = (band[..., 0] / np.maximum(total[..., -1], 1e-30)).clip(0.0, 1.0)
    swing = 2.0 * np.sqrt(2.0 * (x**2).mean(axis=2) * pure)
    return Line(grid[starts], best[..., 0] * BIN, pure, swing, rate)


def frequency(seen: float, rate: float, other: float, other_rate: float) -> float | None:
    """The lowest frequency [Hz] that two logs of these rates show as `seen` and `other`; None where there is none of a control loop."""
    aliases = sorted(abs(k * other_rate + sign * other) for k in range(int(MOST_HZ / other_rate) + 2) for sign in (-1.0, 1.0))
    f = next((f for f in aliases if abs(abs(f - round(f / rate) * rate) - seen) <= 1.5 * BIN), math.inf)
    return f if LEAST_HZ <= f <= MOST_HZ else None


def _demand(motors: Signal, vehicle: Vehicle) -> np.ndarray:
    """(m, 3) the outputs' shares of their range, projected on each axis: 1 for an axis whose outermost rotors go to their limits."""
    curve, B = vehicle.curve, vehicle.effectiveness()[:3]
    share = ((motors.values - curve.u_min) / (curve.u_max - curve.u_min)).clip(-0.2, 1.2)
    pattern = B / np.maximum(np.abs(B).max(axis=1, keepdims=True), 1e-9)
    return (share - share.mean(axis=0)) @ pattern.T / np.maximum((pattern**2).sum(axis=1), 1e-9)  # a tricopter has no yaw


def claims(flight: Flight, vehicle: Vehicle, air: Spans, until: float) -> Iterator[Event]:
    """At most one notice: of the axis that swings most, up to `until` s."""
    gyro = flight.angular_rate()
    if gyro is None:
        return
    motors, gyro, found = flight["motors"].wholes(), gyro.wholes(), []
    demand, spans = _demand(motors, vehicle), [(start + EDGE_S, min(end - EDGE_S, until)) for start, end in air]
    swinging = [(span, one) for span in spans if (one := lines(motors.time, demand, motors.rate_hz, span)) is not None]
    if max(sum((one.clear.sum(axis=0) for _, one in swinging), np.zeros(3))) < WINDOWS:
        return  # the usual flight: the rates need not be looked at
    for span, outputs in swinging:
        moves = lines(gyro.time, gyro.values[:, :3], gyro.rate_hz, span)
        if moves is None:
            continue
        for w, axis in zip(*np.nonzero(outputs.clear)):
            at = int(np.argmin(np.abs(moves.start - outputs.start[w])))
            seen, felt = float(outputs.frequency[w, axis]), float(moves.frequency[at, axis])
            f = frequency(seen, outputs.rate, felt, moves.rate) if moves.pure[at, axis] >= PURE else None
            if f is not None and not (f <= ASKED_HZ and _asked(flight, float(outputs.start[w]), int(axis), f)):
                found.append((int(axis), float(outputs.start[w]), f, float(outputs.swing[w, axis])))
    of_axis = [[one for one in found if one[0] == axis] for axis in range(3)]
    best = max(of_axis, key=lambda some: (len(some) >= WINDOWS) * max((one[3] for one in some), default=0.0))
    if len(best) >= WINDOWS:
        yield _claim(flight, best)


def _asked(flight: Flight, start: float, axis: int, f: float) -> bool:
    """True if the setpoint of the attitude swings as well, or is unknown."""
    time = start + np.arange(0.0, WINDOW_S, 0.1)
    flown, wanted = (angles(flight, name, time) for name in ("attitude", "attitude_wanted"))
    if flown is None or wanted is None:
        return True
    wave = np.exp(-2j * np.pi * f * time) * np.hanning(time.size)
    sizes = [abs(wave @ np.nan_to_num(one[:, axis] - np.nanmean(one[:, axis]))) for one in (wanted, flown)]
    return bool(sizes[0] > ASKED * sizes[1])


def gain(flight: Flight, axis: int, f: float) -> str:
    """The parameter to lower, with its value; in words where the log has none."""
    names = next((names[axis] for maker, names in GAINS.items() if maker in flight.autopilot.lower()), None)
    known = flight.parameters if names else {}
    p, d, cut, outer = (known.get(name, math.nan) for name in names or ("",) * 4)
    if 2.0 * math.pi * f < 2.0 * outer:
        return f"{names[3]} (it is {outer:g})" if names else ""
    if not (p > 0.0 and d >= 0.0):
        return f"the rate gains of {AXES[axis]}: D first, then P"
    filtered = 1.0 / math.hypot(1.0, f / cut) if cut > 0.0 else 1.0
    name, value = (names[1], d) if 2.0 * math.pi * f * d * filtered > p else (names[0], p)  # pyright: ignore[reportOptionalSubscript]
    return f"{name} (it is {value:g})"


def _claim(flight: Flight, found: list[tuple[int, float, float, float]]) -> Event:
    axis, f, swing = found[0][0], float(np.median([one[2] for one in found])), float(np.median([one[3] for one in found]))
    start, end, lower = found[0][1], found[-1][1] + WINDOW_S, gain(flight, found[0][0], f)
    lasts = STEP_S * (len(found) - 1) + WINDOW_S
    reason = (
        f"the outputs swing by {percent(swing)} of their range at {f:.1f} Hz in {AXES[axis]}, for {lasts:.0f} s: the control oscillates; "
        f"lower {lower}"
    )
    extra = {"axis": AXES[axis], "frequency_hz": round(f, 2), "swing": round(swing, 3), "seconds": lasts, "gain": lower.partition(" (")[0]}
    return Event(OSCILLATES, (), start, end, None, (), (), 1.0, (), reason, extra, SOURCE)


def _hear(view: View, events: Events) -> Events:
    if not view.hovers or not view.air:
        return events
    return ledger.joined(events, tuple(claims(view.flight, view.vehicle, view.air, ledger.undisturbed(events, view.open))))


WITNESSES = (Witness("oscillation", Stage.SETUP, 20, _hear, needs=("motors",)),)
