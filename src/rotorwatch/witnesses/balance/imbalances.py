"""The imbalance of each rotor of a flight: from the orders of its windows to one figure with its interval.

An unbalance U = m e [kg m] of a rotor pulls the vehicle of mass M with the force U w^2, which turns with the rotor. A rigid vehicle answers
on two axes with the acceleration U w^2 / M; a frame that bends answers on other axes and with another gain. The figure is

    U / M = sqrt(sum over the axes of the squared amplitudes / 2) / w^2       [1e-6 m = g mm per kg of the vehicle]

the specific unbalance of ISO 21940-11, of the whole vehicle: it needs no mass, and compares across vehicles. Of a gyro it is the angular
acceleration over w^2 [1e-6 rad], which compares between the rotors and the flights of one vehicle alone.

A figure is the mean square over the windows in which the rotor turns near its usual speed (a frame's resonance changes the gain with speed)
and can be distinguished from the others. Windows that are noisier than usual weigh less, and a square beyond FAR times the usual one counts
as that: a knock is no unbalance. (A median would be too low where noise is as large as the tone: the squares are skewed.) The interval is
that of the mean, for so many independent windows as the correlation of neighbours leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.allocation import Spans, within
from rotorwatch.flight import Flight
from rotorwatch.stats.nonnegative import best_total
from rotorwatch.witnesses.balance import hearing, orders, tones
from rotorwatch.witnesses.balance.hearing import Channel
from rotorwatch.witnesses.balance.orders import Windows

APART = 4.0  # largest inflation of the variance with which a window tells a rotor from the others
USUAL = 0.15  # of its usual speed, within which a rotor's windows are compared
LEAST_WINDOWS = 10
FAR = 4.0
BLADES = (2, 3)
MICRO = 1e6
TRIAL = 20  # windows that show how long they must be, how many blades pass in a turn, and whether the poles are right
LONGER, MOSTLY = (1.0, 2.0, 4.0, 8.0), 0.5  # lengths of windows that are tried; share in which the rotor that is least apart must be
COHERENT = 3  # of these, where speeds are predicted from commands: in longer windows their angle drifts away
ALIKE = 0.5  # correlation of two tones from which they are hardly ever apart
GRID_S, LATE_S, LEAST_GRID = 0.1, 0.03, 50  # for the comparison of speeds with commands; of a motor behind its command
EXCHANGED_FIT, EXCHANGED_BETTER = 0.6, 0.3
POLES_OF, USUAL_POLES = ("motor_poles", "SERVO_BLH_POLES", "MOT_POLE_COUNT"), 14.0
POLES = (8.0, 10.0, 12.0, 14.0, 18.0, 22.0, 24.0, 28.0)
CLEAR, BETTER = 2.0, 4.0  # power of a tone over its noise from which it is there; times as strong as at the logged speed


class Figure(NamedTuple):
    """A rotor's imbalance in the unit of its channel. value: with its 95 % interval low to high, 0 where not heard. windows: number.
    speed: usual, rad/s. noise: the figure that noise alone makes in one window. blades: the same of the blades' passing. together: numbers
    of the rotors that it belongs to, from 1: more than one where their speeds are too alike."""

    value: float
    low: float
    high: float
    windows: int
    speed: float
    noise: float
    blades: float
    together: tuple[int, ...]


class Heard(NamedTuple):
    """What a flight's sensor hears of R rotors. figures: one each, None of a rotor with too few windows. windows: all of them; used (W, R):
    which of them count for a rotor. orders: those that were fitted, the first is once per turn. rate_hz: of the samples. doubts: why
    nothing is concluded from the speeds, a sentence each; then there are no figures. measured: the speeds are logged ones."""

    channel: Channel
    figures: tuple[Figure | None, ...]
    windows: Windows
    used: np.ndarray
    orders: tuple[int, ...]
    rate_hz: float
    doubts: tuple[str, ...] = ()
    measured: bool = True

    def to_dict(self) -> list[dict[str, Any] | None]:
        """`rotors[].imbalance` of the answer."""
        return [None if f is None else fields(f, self.channel.unit) for f in self.figures]


def fields(f: Figure, unit: str) -> dict[str, Any]:
    """A figure as the answer holds it."""
    return {
        "value": round(f.value, 4), "interval": [round(f.low, 4), round(f.high, 4)], "unit": unit, "windows": f.windows,
        "speed_rad_s": round(f.speed, 1), "blade_passing": round(f.blades, 4), "together": list(f.together),
    }  # fmt: skip


def listen(flight: Flight, rotors: int, air: Spans) -> Heard | None:
    """The imbalance of each rotor in the flights `air` ((start, end), ...) s; None where the log cannot hear."""
    if not air or hearing.deaf(flight, rotors) is not None:
        return None
    reported, usual, sure = hearing.speeds(flight, rotors), np.zeros(rotors), np.ones(rotors, bool)
    channel = hearing.open_channel(flight)
    if reported is not None:
        turning = reported[2] & (reported[1] > orders.STANDING) & within(reported[0], air)[:, None]
        if not turning.any(axis=0).all():
            return None
        usual = np.array([float(median(reported[1][turning[:, k], k])) for k in range(rotors)])
        channel = hearing.channel(flight, float(median(usual)) / (2.0 * np.pi))
    if channel is None:
        return None
    rows = within(channel.signal.time, air) & channel.signal.whole
    time, values = channel.signal.time[rows], channel.signal.values[rows]
    if reported is not None:
        speed = orders.at(time, *reported)
    else:
        sent = hearing.commands(flight, rotors)
        followed = None if sent is None else tones.follow(time, values, *sent)
        if followed is None or not followed.sure.any():
            return None
        speed, sure = followed
        usual = np.median(speed, axis=0)

    def trial(factor: float, blades: int, window_s: float) -> Windows | None:
        return orders.fit(time, values, factor * speed, channel.exponent, (1, blades), window_s, TRIAL)

    if (chosen := _chosen(trial, usual, sure, LONGER if reported is not None else LONGER[:COHERENT])) is None:
        return None
    kept, window_s = chosen

    def fitted(of: np.ndarray) -> Heard | None:
        windows = orders.fit(time, values, of, channel.exponent, kept, window_s)
        return None if windows is None else heard(channel, windows, kept, channel.signal.rate_hz)

    found = fitted(speed)
    if found is None:
        return None
    if reported is None:
        return found._replace(figures=tuple(f if s else None for f, s in zip(found.figures, sure)), used=found.used & sure, measured=False)
    poles = _other_poles(flight, found, lambda factor: trial(factor, kept[1], window_s))
    doubts = tuple(filter(None, (_exchanged(flight, *reported, air), poles)))
    if doubts:
        return found._replace(figures=(None,) * rotors, doubts=doubts)
    if (groups := _alike(found)) == [(k,) for k in range(rotors)]:
        return found
    first = np.zeros(rotors, bool)
    first[[group[0] for group in groups]] = True
    merged = fitted(np.where(first | np.isnan(speed), speed, 0.0))  # one tone for the rotors of a group, in the same windows
    if merged is None:
        return found
    return _joined(found, merged, groups)


def _chosen(
    trial: Callable[[float, int, float], Windows | None], usual: np.ndarray, sure: np.ndarray, longer: Sequence[float]
) -> tuple[tuple[int, int], float] | None:
    """(orders, length s of the windows) that suit rotors of usual speeds (R,), by fits of a few windows, `longer` times as long as
    usual; None where none is whole. sure (R,): the rotors that are to be distinguished."""
    shortest = max(orders.WINDOW_S, orders.TURNS * 2.0 * np.pi / float(usual.min()))
    tried: list[tuple[float, float, Windows]] = []
    for factor in longer:
        if (w := trial(1.0, BLADES[0], shortest * factor)) is not None:
            tried.append((_apart(w, sure), shortest * factor, w))
            if tried[-1][0] > MOSTLY:
                break
    if not tried:
        return None
    _, window_s, first = max(tried, key=lambda one: one[0])
    others = ((k, trial(1.0, k, window_s)) for k in BLADES[1:])
    fits = [(float(median(w.left)), k) for k, w in ((BLADES[0], first), *others) if w is not None]
    return (1, min(fits)[1]), window_s


def _joined(found: Heard, merged: Heard, groups: Sequence[tuple[int, ...]]) -> Heard:
    """What is heard, with the rotors of each group (from 0) as one: what `merged` heard at the first of them."""
    figures, used, own = list(found.figures), found.used.copy(), found.windows
    for group in groups:
        if len(group) == 1:
            continue
        first, figure = group[0], merged.figures[group[0]]
        for k in group:
            figures[k] = None if figure is None else _shared(figure, group)
            used[:, k] = merged.used[:, first] & (k == first)
        for name in ("power", "noise", "phase", "inflation"):
            getattr(own, name)[:, :, first] = getattr(merged.windows, name)[:, :, first]
    return found._replace(figures=tuple(figures), used=used)


def heard(channel: Channel, windows: Windows, kept: tuple[int, ...], rate_hz: float) -> Heard:
    """The figures of a flight from its windows."""
    rotors = windows.speed.shape[1]
    near = np.zeros(windows.speed.shape, bool)
    for k in range(rotors):
        turning = windows.speed[:, k] > 0.0
        if turning.any():
            usual = float(median(windows.speed[turning, k]))
            near[:, k] = turning & (np.abs(windows.speed[:, k] / usual - 1.0) < USUAL)
    used = near & (windows.inflation[:, 0] < APART)
    found = [_figure(channel, windows, used[:, k], k) for k in range(rotors)]
    signal = channel.signal  # an answer does not keep its samples
    none = signal.with_arrays(np.zeros(0), np.zeros((0, signal.values.shape[1])), np.zeros((0, signal.values.shape[1]), bool))
    return Heard(channel._replace(signal=none), tuple(found), windows, used, kept, rate_hz)


def _shared(figure: Figure, group: tuple[int, ...]) -> Figure:
    """The figure of each rotor of a group (from 0) that vibrate as one: the root mean square of theirs, as their phases drift."""
    share = len(group) ** -0.5
    value, low, high, noise, blades = (share * v for v in (figure.value, figure.low, figure.high, figure.noise, figure.blades))
    return figure._replace(value=value, low=low, high=high, noise=noise, blades=blades, together=tuple(r + 1 for r in group))


def _alike(found: Heard) -> list[tuple[int, ...]]:
    """The rotors (from 0) in groups: one that is hardly ever apart from another is in its group."""
    n = len(found.figures)
    group = list(range(n))
    turning = (found.windows.speed > 0.0).all(axis=1)
    for k in range(n):
        if found.figures[k] is None and turning.any():
            beside = np.median(found.windows.alike[turning, k], axis=0)
            if beside.max() > ALIKE:
                one, other = sorted((group[k], group[int(np.argmax(beside))]))
                group = [one if g == other else g for g in group]
    return [tuple(k for k in range(n) if group[k] == g) for g in sorted(set(group))]


def _apart(windows: Windows, sure: np.ndarray) -> float:
    """The share of windows in which the rotor (of these) that is least often apart from the others is."""
    turning = windows.speed > 0.0
    return float(((windows.inflation[:, 0] < APART) & turning).sum(axis=0)[sure].min() / max(int(turning.all(axis=1).sum()), 1))


def _exchanged(flight: Flight, time: np.ndarray, speed: np.ndarray, valid: np.ndarray, air: Spans) -> str:
    """A sentence where the speeds follow other rotors' commands than their own; empty where they do not."""
    n = speed.shape[1]
    if not flight.has("motors") or flight["motors"].values.shape[1] != n or n < 3:
        return ""
    motors = flight["motors"]
    grid = np.arange(max(time[0], motors.time[0]), min(time[-1], motors.time[-1]), GRID_S)
    inside = within(grid, air)
    if inside.sum() < LEAST_GRID:
        return ""
    rows = motors.whole
    turned = np.stack([np.interp(grid, time[valid[:, k]], speed[valid[:, k], k]) for k in range(n)], axis=1)
    sent = np.stack([np.interp(grid - LATE_S, motors.time[rows], motors.values[rows, k]) for k in range(n)], axis=1)
    steps = [np.diff(v, axis=0)[inside[1:]] for v in (turned, sent)]
    a, b = (s - s.mean(axis=1, keepdims=True) for s in steps)
    length = np.sqrt(np.outer(np.square(a).sum(axis=0), np.square(b).sum(axis=0)))
    fits = a.T @ b / np.maximum(length, 1e-12)
    ours, best = float(np.trace(fits)) / n, best_total(fits) / n
    if best > EXCHANGED_FIT and best > ours + EXCHANGED_BETTER:
        return "Rotor speeds follow other rotors' commands better than their own: which rotor is out of balance is not assessed."
    return ""


def _other_poles(flight: Flight, found: Heard, trial: Callable[[float], Windows | None]) -> str:
    """A sentence where the tones are at another multiple of the logged speeds, as with a wrong number of poles; empty where not."""

    def strengths(w: Windows | None) -> list[float]:
        if w is None:
            return []
        fine = w.inflation[:, 0] < APART
        return [
            float(w.power[fine[:, k], 0, k].mean() / w.noise[fine[:, k], 0, k].mean())
            for k in range(fine.shape[1])
            if fine[:, k].sum() >= LEAST_WINDOWS
        ]

    there = max(strengths(found.windows), default=np.inf)  # of the rotors that are heard apart; without one nothing is known
    if there > CLEAR:
        return ""

    def strength(other: float) -> float:
        parts = strengths(trial(poles / other))
        return float(median(np.array(parts))) if parts else 0.0

    poles = next((p for name in POLES_OF if (p := flight.parameters.get(name, 0.0)) > 0.0), USUAL_POLES)
    tried = [(strength(other), other) for other in POLES if other != poles]
    best, other = max(tried)
    if best < CLEAR or best < BETTER * there:
        return ""
    return (
        f"The once-per-turn vibration is at {poles / other:.3g} times the logged rotor speeds, as if the motors had {other:.0f} poles, not "
        f"{poles:.0f}: set the number of poles right; the rotors' balance is not assessed."
    )


def _figure(channel: Channel, windows: Windows, used: np.ndarray, k: int) -> Figure | None:
    count = int(used.sum())
    if count < LEAST_WINDOWS:
        return None
    hz = windows.speed[used, k] / (2.0 * np.pi)
    back = 0.5 / channel.left(hz) ** 2  # half of the sum over the axes, with what the filters took off
    value, low, high = map(_root, mean(windows.power[used, 0, k] * back, windows.noise[used, 0, k] * back))
    blades = _root(float(median(windows.power[used, 1, k] * 0.5)))
    noise = _root(float(median(windows.noise[used, 0, k] * back)))
    return Figure(value, low, high, count, float(median(windows.speed[used, k])), noise, blades, (k + 1,))


def _root(square: float) -> float:
    return MICRO * float(np.sqrt(max(square, 0.0)))


def mean(squares: np.ndarray, noise: np.ndarray) -> tuple[float, float, float]:
    """The mean of squared amplitudes (n,) without their noise (n,), and its 95 % interval."""
    usual = max(float(median(squares)), 0.0)
    far = FAR * max(usual, float(median(noise)))
    squares = np.minimum(squares, far)
    weight = 1.0 / np.maximum(np.maximum(noise, float(median(noise))) + usual, 1e-30) ** 2
    weight /= weight.sum()
    centre = float(weight @ squares)
    sd = float(np.sqrt(np.square(weight * (squares - centre)).sum() / independence(squares)))
    return centre, centre - WITHIN_95 * sd, centre + WITHIN_95 * sd


def independence(series: np.ndarray) -> float:
    """Share of independent samples of a series (n,), by its correlation from one to the next: (1 - r) / (1 + r), r not below 0."""
    ranks = np.argsort(np.argsort(series)).astype(float)
    ranks -= ranks.mean()
    total = float(ranks @ ranks)
    r = float(ranks[1:] @ ranks[:-1]) / total if total > 0.0 else 0.0
    r = min(max(r, 0.0), 0.9)
    return (1.0 - r) / (1.0 + r)


def stored(name: str, found: Heard) -> dict[str, Any]:
    """A flight's figures for a vehicle file: plain numbers."""
    return {
        "name": name,
        "unit": found.channel.unit,
        "value": [0.0 if f is None else f.value for f in found.figures],
        "windows": [0 if f is None or len(f.together) > 1 else f.windows for f in found.figures],
    }


def history(rows: Sequence[Mapping[str, Any]], unit: str, rotors: int) -> list[np.ndarray]:
    """For each rotor its figures in earlier flights, in this unit, of flights that heard it."""
    found: list[list[float]] = [[] for _ in range(rotors)]
    for row in rows:
        values, counts = row.get("value", ()), row.get("windows", ())
        if row.get("unit") == unit and len(values) == len(counts) == rotors:
            for k in range(rotors):
                if counts[k] >= LEAST_WINDOWS:
                    found[k].append(float(values[k]))
    return [np.array(values) for values in found]
