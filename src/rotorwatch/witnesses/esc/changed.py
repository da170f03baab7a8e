"""Motors that become slow or draw more current in flight though no loss of thrust was found, and propellers that become light.

A bearing draws more current long before it costs thrust. A propeller without its tip draws less at the same speed, which shows in gusts
that mask its loss of thrust.

The residual of the laws of ratios.py is averaged, rotor by rotor, over blocks of BLOCK_S. A change at block j is the difference of the
means after and before it, in units of its standard deviation, which comes from the changes between successive blocks (a step is in one of
them only, and does not move their median). It counts when it is large, lasts, is SIGMAS times its noise, and stands out of the changes of
the other rotors at that time: fast flight loads front and rear differently, and that is no motor fault.

Only changes count. Offsets at take-off stay: current sensors of ESCs differ by more than bearings do.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.answer.wording import interval, percent, rotors, seconds
from rotorwatch.base.arrays import median
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import HIGH, LOW, SLOW
from rotorwatch.witnesses.esc import causes as evidence
from rotorwatch.witnesses.esc import ratios
from rotorwatch.witnesses.esc.telemetry import BIN_S, Binned


def _weak(claim: Event, known: Event) -> bool:
    return claim.means.weakens and known.means.weakens and not {*claim.rotors}.isdisjoint(known.rotors)


CHANGED = Source("esc: changed", 8, _weak)

BLOCK_S = 5.0
BEFORE, AFTER = 3, 2  # blocks that a change needs on each side
SIGMAS = 6.0
STANDS_OUT = 3.0  # times the largest change of any other rotor
# Least change of thrust by speed, or of current; standard deviation of random drift of the level; direction.
LEAST = {SLOW: 0.03, HIGH: 0.15, LOW: 0.1}
DRIFT = {SLOW: 0.004, HIGH: 0.015, LOW: 0.015}
SIGN = {SLOW: -1.0, HIGH: 1.0, LOW: -1.0}
HOLDS = 0.5  # share of the change that every block after it must show
LARGE = 0.25  # share of thrust: a larger change is a loss, or wrong telemetry
FOLLOWS = 0.5  # of the apparent rise of an unchanged current: below, the current follows the speed


def examine(bins: Binned, usable: np.ndarray) -> tuple[tuple[Event, ...], list[str]]:
    """(events of kind SLOW, HIGH, LOW and, where much is lost, LOSS; warnings).

    usable (T, n) bool: bins of regular flight without any loss by commands and motion. A large fall of speed should have shown there: where
    the current falls with it, two sensors agree, and it is a loss that was missed; otherwise the speed is not believed."""
    out, warnings, wrong = [], [], set()
    y, x = ratios.log_power(bins), np.log(bins.thrust)
    turning = bins.known & (bins.power > 0.0)
    z = np.log(np.maximum(bins.current, 1e-3))
    drawing = turning & bins.current_known & (bins.current > 0.0)
    speed, current = (y, x, turning & usable, ratios.SPEED_POWER), (z, 0.5 * y, drawing & usable, ratios.CURRENT_POWER)
    for kind, law in ((SLOW, speed), (HIGH, current), (LOW, current)):
        for rotor, onset, announced, change, sd in changes(bins.time, *law, kind):
            size = float(abs(np.expm1(change)))
            ends = (max(abs(change) + s * WITHIN_95 * sd, 0.0) for s in (-1.0, 1.0))
            bounds = tuple(float(abs(np.expm1(SIGN[kind] * end))) for end in ends)
            if kind == SLOW and bounds[0] > LARGE:
                if _follows(bins.time, current, rotor - 1, onset, announced, change):
                    out.append(lost_speed(rotor, onset, announced, size, bounds))
                else:
                    wrong.add(rotor)
                    warnings.append(
                        f"The ESC of {rotors([rotor])} reports a speed that gives {percent(size)} less thrust since {seconds(onset)}, but "
                        "neither its current nor the vehicle's motion confirms it: the speed is not used."
                    )
            elif rotor not in wrong:
                out.append(_notice(kind, rotor, onset, announced, size, bounds, probability_of(change / sd)))
    return tuple(out), warnings


def _notice(kind: str, rotor: int, onset: float, announced: float, size: float, bounds, sure: float) -> Event:
    who, much = rotors([rotor]), f"{percent(size)} ({interval(*bounds)})"
    phrases = {
        SLOW: f"the speed of {who} gives {much} less thrust than commanded",
        HIGH: f"{who} draws {much} more current at the same speed than before",
        LOW: f"{who} draws {much} less current at the same speed than before",
    }[kind]
    reason = f"since {seconds(onset)} {phrases}, unlike the other rotors; commands and motion show no loss"
    extra = {"change": size, "change_interval": bounds}
    return Event(kind, (rotor,), onset, announced, None, (), (), sure, (), reason, extra, CHANGED)


def lost_speed(rotor: int, onset: float, announced: float, size: float, bounds) -> Event:
    """A loss shown by speed and current, but not by commands and motion."""
    sentence = (
        f"since {seconds(onset)} its speed gives {percent(size)} less thrust than commanded, and its current fell with it; commands and "
        "motion alone do not show it; "
    )
    parts = {"speed": (size, *bounds), "propeller": (0.0, 0.0, 1.0)}
    causes, source = (0.0, 0.95, 0.02, 0.03), CHANGED
    return evidence.loss(rotor, onset, announced, (size, *bounds), causes, parts, sentence, 1.0 - size, source=source)


def _follows(time, law, k: int, onset: float, announced: float, change: float) -> bool:
    """True if the current of rotor k (from 0) fell with its speed at `onset`, by the data up to `announced`; False without currents.

    change: of log W^2. By the law, a current that stays the same looks like one that rises by -change times half the law's power."""
    y, x, known, prior = law
    part = time <= announced
    law_of_current = ratios.learn(y[part], x[part], known[part], prior)
    rest, there = ratios.residual(law_of_current, y[part], x[part], known[part])
    before, after = (there[:, k] & side for side in (time[part] < onset, time[part] > onset))
    if not law_of_current.known[k] or not before.any() or not after.any():
        return False
    rise = float(rest[after, k].mean() - rest[before, k].mean())
    return abs(rise) < FOLLOWS * 0.5 * law_of_current.power * abs(change)


def probability_of(sigmas: float) -> float:
    """Probability that a change of so many standard deviations is real, with a prior of one change in a thousand flights."""
    odds = 1e-3 * np.exp(min(0.5 * sigmas**2, 600.0) - 2.0 * np.log(1.0 + abs(sigmas)))
    return float(odds / (1.0 + odds))


def changes(time, y, x, known, prior, kind: str) -> list[tuple[int, float, float, float, float]]:
    """(rotor from 1, onset s, announced s, change, sd) of every rotor whose law changed for good, in the direction of `kind`.

    y, x, known (T, n): the law's bins at `time` (T,). Causal: a change is announced at the end of the first block with which it counts."""
    if not len(time):
        return []
    n, width = y.shape[1], round(BLOCK_S / BIN_S)
    count = len(time) // width
    changed: dict[int, tuple[float, float, float, float]] = {}
    for last in range(BEFORE + AFTER, count + 1):
        part = slice(0, last * width)
        law = ratios.learn(y[part], x[part], known[part], prior)
        rest, there = ratios.residual(law, y[part], x[part], known[part])
        blocks, full = _blocks(rest, there, width)
        loads, _ = _blocks(x[part], there, width)
        for k in range(n):
            if k + 1 not in changed and (change := _changed(blocks, full, loads, law.power_sd, k, kind)) is not None:
                split, size, sd = change
                onset = _onset(rest[:, k], there[:, k], split * width, width)
                changed[k + 1] = (float(time[onset]), float(time[last * width - 1]), size, sd)
    return [(k, *changed[k]) for k in sorted(changed)]


def _blocks(rest, there, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Means (m, n) of each block of bins, and whether at least half of it is there."""
    m, n = len(rest) // width, rest.shape[1]
    shape = (m, width, n)
    values, ok = rest[: m * width].reshape(shape), there[: m * width].reshape(shape)
    number = ok.sum(axis=1)
    return np.where(ok, values, 0.0).sum(axis=1) / np.maximum(number, 1), number >= 0.5 * width


def _onset(rest, there, split: int, width: int) -> int:
    """Bin at which the level changes, within a block of the bin `split`: the split that leaves the smallest squares."""
    at = np.flatnonzero(there)
    v = rest[at]
    total, number = np.cumsum(v), np.arange(1, v.size + 1)
    near = np.flatnonzero((at >= split - width) & (at <= split + width) & (number < v.size))
    if not near.size:
        return split
    gain = total[near - 1] ** 2 / near + (total[-1] - total[near - 1]) ** 2 / (v.size - near)
    return int(at[near[int(np.argmax(gain))]])


def _changed(blocks, full, loads, power_sd: float, k: int, kind: str) -> tuple[int, float, float] | None:
    """(block at which it changed, change, sd) of rotor k at the end of these blocks; None where it has not.

    loads (m, n): x of the law in each block, whose change stretches it by power_sd."""
    at = np.flatnonzero(full[:, k])
    if at.size < BEFORE + AFTER:
        return None
    v = blocks[at, k]
    u = loads[at, k] - median(np.delete(loads[at], k, axis=1), axis=1)
    steps = np.diff(v)
    scatter = max(float(median(np.abs(steps))) / (0.6745 * np.sqrt(2.0)), 1e-4)
    best = None
    for j in range(BEFORE, at.size - AFTER + 1):
        size = float(v[j:].mean() - v[:j].mean())
        reach = float(u[j:].mean() - u[:j].mean())
        sd = float(np.sqrt(scatter**2 * (1.0 / j + 1.0 / (at.size - j)) + DRIFT[kind] ** 2 + (power_sd * reach) ** 2))
        if best is None or abs(size) / sd > abs(best[1]) / best[2]:
            best = j, size, sd
    if best is None:
        return None
    j, size, sd = best
    if size * SIGN[kind] < LEAST[kind] or abs(size) < SIGMAS * sd:
        return None
    if np.any((v[j:] - v[:j].mean()) / size < HOLDS):
        return None
    split = int(at[j])
    for i in range(blocks.shape[1]):
        before, after = full[:split, i], full[split:, i]
        if i != k and before.any() and after.any():
            other = blocks[split:, i][after].mean() - blocks[:split, i][before].mean()
            if abs(size) < STANDS_OUT * abs(other):
                return None
    return split, size, sd
