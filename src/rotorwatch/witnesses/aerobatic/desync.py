"""Motors that lose step (desync): commanded up, they give no thrust for 30 to 500 ms, and recover. Events `desync`.

In windows of 4 ms each axis, and each motor speed that is logged, follows its command with a lag (innovation.py). Where rotor i gives
nothing from s to e, the innovation is

    z = - theta answer * (drive_i inside [s, e)) / scale + noise,      theta about 1, noise Student's t

in all channels at once: its direction must be the rotor's, its size the command's, its shape the command's shape. A matched filter over
(rotor, start, length) finds candidates; each gets its exact log likelihood ratio, with theta marginalized by its prior and the roughness of
the air at that time estimated from the axes. With noise as modelled, exp of that ratio has mean 1 in a healthy flight, so a threshold of
log(windows in ten hours x rotors x lengths) is exceeded at most once in ten hours (bounds of Markov and Boole).

A knock pushes in any direction: a separate size for each axis must not explain much more. A dead or weak motor is no desync: the rotor must
work before and after. A desync with less than 100 ms of commanded thrust counts only where the motor's speed shows it or where it recurs: a
motor takes that long from rest to full thrust.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.answer.ledger import explained
from rotorwatch.answer.wording import said
from rotorwatch.engine.estimator.hypotheses import CLEAR
from rotorwatch.engine.events.decisions import FALSE_ALARM_PERIOD_S
from rotorwatch.engine.intake.craft import YAW
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import DESYNC, LOST
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.aerobatic.innovation import DOF, LAGS, Channel, channels

CRASH_S = 0.3  # before control is lost, and before a rotor is lost: what happens belongs to that
MOST = 0.5  # of a rotor's thrust


def _falls(claim: Event, known: Event) -> bool:
    if known.kind == LOST:
        return claim.detected_s >= known.onset_s - CRASH_S
    gone = known.means.weakens and max(known.loss, default=0.0) > MOST and claim.rotors[0] in known.rotors
    return gone and known.onset_s - CRASH_S < claim.onset_s < (known.end_s or np.inf)


SOURCE = Source("lost steps", 9, _falls)

SHORTEST_S, LONGEST_S = 0.025, 0.65  # 30 to 500 ms, with the uncertainty of both ends
LENGTHS_S = 0.03 * 10.0 ** (0.1 * np.arange(15))  # 30 to 750 ms: longer ones are searched for, to be ruled out
SCREEN = 9.0  # nats: peaks of the matched filter below are ignored
REFINED = 20.0  # nats that moves of single windows may add to the best start and length on a line
ALONG, POINTS = 8, 16  # windows by which a short one's ends are moved at least; moves each way of a longer one's
SIZES = np.linspace(-1.2, 2.4, 19)  # theta
LEAST_SIZE, MOST_SIZE = 0.5, 1.4
ROUGHER = (1.0, 1.4, 2.0, 2.8)  # times the scale within a second: propwash lasts less
SLOWER_S = (0.0, 0.015, 0.03)  # than a commanded change of speed
UNEVEN = 0.3  # of the ratio: gain allowed to separate sizes of roll and pitch; gains are known to about 20 %
RETURNS_S = (0.15, 0.3)  # after its end: interval in which the motor must have recovered
AROUND_S, LEFT = 0.3, 0.5  # s before and after; the rotor lacks less than this share there
IDLE = 0.03  # share of full thrust below which a motor gives almost nothing
KNOCK_S = 0.1  # s: without its speed, a shorter single one may be a spin-up from idle, or a knock
APART_S = 0.06  # closer ones are merged


class Desync(NamedTuple):
    """A desync of rotor `rotor` (from 0), from start to end [s]. ratio: log likelihood ratio, above the threshold; size: share of the
    command; commanded: time for which the motor was commanded above idle [s]; others: rotors that explain it as well."""

    rotor: int
    start: float
    end: float
    ratio: float
    size: float
    commanded: float
    others: tuple[int, ...] = ()


class Ratios(NamedTuple):
    """Log likelihood ratios of a desync against none. each (cases, channels, SIZES): a case is one of SLOWER_S with one of ROUGHER; weight
    (cases,): log probability of the case where there is no desync."""

    each: np.ndarray
    weight: np.ndarray


def find(flight: Flight, vehicle: Vehicle, air: Spans, known: tuple[Event, ...] = ()) -> tuple[Event, ...]:
    """The events `desync` of a flight, one a motor. known: other events, which may explain some (answer/ledger.py)."""
    seen = channels(flight, vehicle, air)
    if not seen:
        return ()
    desyncs = [d for d in search(seen) if not explained(_claim(d), known)]
    return events(desyncs, any(c.rotor is not None for c in seen))


def _claim(d: Desync) -> Event:
    return Event(DESYNC, (d.rotor + 1,), d.start, d.end, d.end, (), (), 1.0, source=SOURCE)


def events(found: list[Desync], rpm: bool) -> tuple[Event, ...]:
    """An event for each motor, or for each set of motors that the log cannot distinguish. rpm: whether speeds are logged."""
    sets: dict[tuple[int, ...], list[Desync]] = {}
    sure = {d.rotor for d in found if not d.others}
    for d in found:  # a motor with one certain desync explains the ambiguous ones
        again = [r for r in (d.rotor, *d.others) if r in sure]
        d = d._replace(rotor=again[0], others=()) if d.others and len(again) == 1 else d
        sets.setdefault(tuple(sorted((d.rotor, *d.others))), []).append(d)
    return tuple(sorted((_event(who, group, rpm) for who, group in sets.items()), key=lambda e: e.detected_s))


def _event(who: tuple[int, ...], group: list[Desync], rpm: bool) -> Event:
    group = sorted(group, key=lambda d: d.start)
    first, last = group[0], group[-1]
    rotor = max(who, key=lambda r: sum(d.ratio for d in group if d.rotor == r))
    length = [d.end - d.start for d in group]
    extra = {"times": [d.start for d in group], "durations": length, "count": len(group), "rpm": rpm, "live": False}
    p = 1.0 / len(who) if len(who) > 1 else 1.0 - float(np.exp(-min(30.0, CLEAR + first.ratio)))
    others = tuple((r + 1,) for r in who if r != rotor)
    event = Event(DESYNC, (rotor + 1,), first.start, first.end, last.end, (), (), p, others, "", extra, SOURCE)
    fell = ", and its speed fell" if rpm else ""
    gave = f": it was commanded up and gave no thrust for {_span(length)}{fell}"
    return replace(event, reason=said("{motors} desynced {times} at {at}", event) + gave)


def _span(length: list[float]) -> str:
    low, high = (10 * round(100 * x) for x in (min(length), max(length)))
    return f"{low} ms" if low == high else f"{low} to {high} ms"


def search(seen: list[Channel]) -> list[Desync]:
    """All desyncs in the channels of a flight, in order of time."""
    dt = seen[0].width
    lengths = np.unique(np.maximum(2, np.round(LENGTHS_S / dt).astype(int)))
    rotors = [i for i in range(seen[0].drive.shape[1])]
    limit = float(np.log(FALSE_ALARM_PERIOD_S / dt * len(rotors) * len(lengths)))
    desyncs: list[Desync] = []
    for i in rotors:
        for start, length in _peaks(seen, i, lengths, dt):
            best = _evaluated(seen, i, start, length, lengths, rotors, limit)
            if best is not None:
                desyncs.append(best)
    separate: list[Desync] = []
    for d in sorted(desyncs, key=lambda d: -d.ratio):
        if all(d.start > k.end + APART_S or d.end < k.start - APART_S for k in separate):
            separate.append(d)
    spun = {c.rotor for c in seen}
    long = KNOCK_S - 2.0 * dt  # both ends are uncertain by one window
    often = {d.rotor for d in separate if d.commanded > long or sum(e.rotor == d.rotor for e in separate) > 1}
    return sorted((d for d in separate if d.rotor in spun or d.rotor in often), key=lambda d: d.start)


def _peaks(seen: list[Channel], i: int, lengths: np.ndarray, dt: float) -> list[tuple[int, int]]:
    """(start, length) windows at which the matched filter for rotor i peaks, largest first, none near a larger one."""
    K = len(seen[0].left)
    moment, shared = np.zeros(K), np.zeros((LAGS, K))
    for c in seen:
        if c.rotor is not None and c.rotor != i:
            continue
        pull = np.clip(c.left, -3.0, 3.0) / c.scale
        back = np.zeros(K)
        for lag, b in enumerate(c.answer):
            back[: K - lag] -= b * pull[lag:]
        moment += c.drive[:, i] * back
        commanded = c.drive[:, i] / c.scale
        for d in range(LAGS):
            r = float(c.answer[: LAGS - d] @ c.answer[d:])
            shared[d, : K - d] += (1.0 if d == 0 else 2.0) * r * commanded[: K - d] * commanded[d:]
    M = np.concatenate([[0.0], np.cumsum(moment)])
    S = np.concatenate([np.zeros((LAGS, 1)), np.cumsum(shared, axis=1)], axis=1)
    score, which = np.zeros(K), np.zeros(K, int)
    for length in lengths[lengths + LAGS < K]:
        stop = K - length
        m = M[length : length + stop] - M[:stop]
        info = sum(S[d, length - d : length - d + stop] - S[d, :stop] for d in range(min(LAGS, length)))
        value = np.where(m > 0.0, 0.5 * m**2 / np.maximum(info, 1e-9), 0.0)
        value[info < SCREEN] = 0.0  # too little thrust commanded to detect its absence
        value[~seen[0].flies[:stop] | ~seen[0].flies[length : length + stop]] = 0.0
        better = value > score[:stop]
        score[:stop][better], which[:stop][better] = value[better], length
    out: list[tuple[int, int]] = []
    taken = np.zeros(K, bool)
    for k in np.argsort(-score):
        if score[k] < SCREEN:
            break
        if not taken[k]:
            out.append((int(k), int(which[k])))
            near = max(int(APART_S / dt), int(which[k]) // 2)
            taken[max(0, k - near) : k + near] = True
    return out


def _evaluated(seen: list[Channel], i: int, start: int, length: int, lengths: np.ndarray, rotors: list[int], limit: float) -> Desync | None:
    """The desync of rotor i near (start, length); None where the evidence is not sufficient."""
    dt = seen[0].width
    start, length = _refined(seen, i, start, length, lengths, limit - REFINED)
    if not SHORTEST_S <= length * dt <= LONGEST_S:
        return None
    inside = slice(start, start + length)
    if seen[0].thrust[inside, i].mean() < IDLE or not seen[0].flies[inside].all():
        return None
    ratios = _ratios(seen, i, start, length)
    ratio = _marginal(ratios)
    if ratio < limit:
        return None
    each = ratios.each[int(np.argmax(_by_case(ratios)))]
    firm = np.delete(each, YAW, axis=0)
    together = firm.sum(axis=0)
    size = float(SIZES[np.argmax(together)])
    turning = each[:YAW]  # a separate size of a speed channel is no sign of a knock
    uneven = turning.max(axis=1).sum() - turning.sum(axis=0).max()
    if not LEAST_SIZE - 1e-9 <= size <= MOST_SIZE + 1e-9 or uneven > UNEVEN * firm.max(axis=1).sum():
        return None
    if _weak_around(seen, i, start, length) or not _returns(seen, i, start, length):
        return None
    others = []
    for j in rotors:
        if j != i:
            other = _marginal(_ratios(seen, j, start, length))
            if other > ratio:
                return None
            if other > ratio - CLEAR:
                others.append(j)
    time = seen[0].time
    commanded = float((seen[0].thrust[inside, i] > IDLE).sum() * dt)
    return Desync(i, float(time[start]), float(time[start] + length * dt), ratio - limit, size, commanded, tuple(others))


def _refined(seen: list[Channel], i: int, start: int, length: int, lengths: np.ndarray, least: float) -> tuple[int, int]:
    """The most likely start and length near these, in windows; (0, 0) where no refinement can reach `least`.

    First the start, then the end, over half the length and over all of `lengths`: a falling speed makes the likelihood a narrow ridge, and
    its peak may be a part of a desync, or more than it. Then both by ever smaller steps."""

    @functools.cache  # steps come by the same places again
    def value(s: int, n: int) -> float:
        possible = s >= 0 and n >= 2 and s + n + LAGS < len(seen[0].left)
        return _marginal(_ratios(seen, i, s, n, rougher=(1.0,))) if possible else -np.inf

    reach = max(ALONG, length // 2)
    step = max(1, reach // POINTS)
    tried = {*range(length - (reach // step) * step, length + reach + 1, step), *lengths.tolist()}
    end = start + length
    best, start, length = max((value(end - n, n), end - n, n) for n in tried)
    best, length = max((value(start, n), n) for n in tried)
    if best < least:
        return 0, 0
    while step >= 1:
        for ds, dl in ((-step, step), (step, -step), (0, step), (0, -step), (-step, 0), (step, 0)):
            if (moved := value(start + ds, length + dl)) > best + 1e-9:
                best, start, length = moved, start + ds, length + dl
                break
        else:
            step //= 2
    return start, length


def _ratios(seen: list[Channel], i: int, start: int, length: int, until: int | None = None, rougher: tuple[float, ...] = ROUGHER) -> Ratios:
    """Likelihood ratios of a desync of rotor i from its start until the last response, or `until`. rougher: factors on the scale of the
    noise."""
    each = np.zeros((len(SLOWER_S), len(rougher), len(seen), len(SIZES)))
    none = np.zeros(len(rougher))
    kernels = _kernels(seen[0].width)
    for k, c in enumerate(seen):
        if c.rotor is not None and c.rotor != i:
            continue
        stop = min(start + length + LAGS + len(kernels[-1]) - 2, len(c.left)) if until is None else until
        z, scale = c.left[start:stop], c.scale[start:stop]
        answer = np.convolve(c.drive[start : start + length, i], c.answer)
        times = rougher if c.rotor is None else (1.0,)  # air does not turn motors
        without = np.array([_likelihood(z, r) for r in times])
        none += without
        missed = np.zeros((len(kernels), 1, len(z)))
        for m, kernel in enumerate(kernels):
            s = np.convolve(answer, kernel)[: len(z)]
            missed[m, 0, : len(s)] = s
        left = z + SIZES[:, None] * (missed / scale)
        each[:, :, k] = np.stack([_likelihood(left, r) for r in times], axis=1) - without[:, None]
    weight = none - np.logaddexp.reduce(none) - np.log(len(SLOWER_S))
    return Ratios(each.reshape(-1, *each.shape[2:]), np.tile(weight, len(SLOWER_S)))


def _likelihood(z: np.ndarray, times: float) -> np.ndarray:
    """Log likelihood of innovations z (..., K) in units of their scale, by Student's t of `times` that width."""
    wide = z * z
    wide *= 1.0 / (times * times * DOF)
    wide += 1.0  # log1p would be several times slower, for digits that do not matter
    return -0.5 * (DOF + 1.0) * np.log(wide, out=wide).sum(axis=-1) - z.shape[-1] * np.log(times)


@functools.cache
def _kernels(width: float) -> tuple[np.ndarray, ...]:
    """Spin-down and spin-up of a motor that lost step, relative to a commanded change: slower by each of SLOWER_S."""
    out = []
    for slower in SLOWER_S:
        x = np.exp(-np.arange(max(1, round(3.0 * slower / width))) * width / max(slower, 1e-9))
        out.append(x / x.sum())
    return tuple(out)


def _log_prior(middle: float, sd: float) -> np.ndarray:
    x = np.where(SIZES < -1e-9, -np.inf, -0.5 * ((SIZES - middle) / sd) ** 2)
    return x - np.log(np.exp(x).sum())


_OF_ALL, _OF_YAW = _log_prior(0.9, 0.25), _log_prior(0.8, 0.5)


def _marginal(ratios: Ratios) -> float:
    """Log likelihood ratio, marginalized over shape, roughness and sizes."""
    return float(np.logaddexp.reduce(_by_case(ratios)))


def _by_case(ratios: Ratios) -> np.ndarray:
    """(cases,) log likelihood ratios. Yaw has a size of its own, as motors that lose step jerk."""
    each = ratios.each
    firm = each[:, [k for k in range(each.shape[1]) if k != YAW]].sum(axis=1)
    of_yaw = np.logaddexp.reduce(each[:, YAW] + _OF_YAW, axis=-1)
    return np.logaddexp.reduce(firm + _OF_ALL, axis=-1) + of_yaw + ratios.weight


def _weak_around(seen: list[Channel], i: int, start: int, length: int) -> bool:
    """True if the rotor lacks much thrust before or after as well."""
    around = int(AROUND_S / seen[0].width)
    for first, count in ((start - around - LAGS, around), (start + length + LAGS // 2, around)):
        first, count = max(first, 0), min(count, len(seen[0].left) - LAGS - first)
        if count < 5:
            return True
        ratio = _ratios(seen, i, first, count, rougher=(1.0,)).each[0].sum(axis=0)
        if SIZES[np.argmax(ratio)] > LEFT and ratio.max() > SCREEN:
            return True
    return False


def _returns(seen: list[Channel], i: int, start: int, length: int) -> bool:
    """True if the rotor recovered, rather than giving no thrust from then on."""
    for later in RETURNS_S:
        until = start + length + round(later / seen[0].width)
        if until >= len(seen[0].left):
            return False
        back = _marginal(_ratios(seen, i, start, length, until))
        if _marginal(_ratios(seen, i, start, until - start, until)) > back - CLEAR:
            return False
    return True
