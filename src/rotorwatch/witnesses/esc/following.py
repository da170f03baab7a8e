"""Rotors whose measured speed leaves what their command asks for, within samples: speeds and commands at 20 Hz and more.

A motor's speed follows its command with a lag. With q the root of the commanded thrust behind a first-order lag tau,

    W_k = a_k + b_k q_k + c_k q_k^2 + e_k,        tau dq/dt = sqrt(f(u)) - q

a, b, c of each rotor and one tau of LAGS_S are fitted to the flight so far by weighted least squares; a Gaussian prior keeps a and c small,
so that a hover does not extrapolate at will. The innovation is r = log(W_k / predicted) less the median of the others, which a sagging
battery moves alike. Its standard deviation is that of the fit, of its extrapolation, and of the lag: a rotor that is slowed by drag alone,
or speeds up without its propeller, has another, so that the part of a commanded change that is still to come is not known:

    sd^2 = (s_k / W)^2 (1 + x' P x) + (b_k / W)^2 (difference of q between lags)^2 + that of the others' median + MODEL^2

A rotor that is not driven slows down by its propeller's drag; one that lost its propeller speeds up at once, by the voltage that the
current no longer takes: 5 to 30 % in hover (M. Drela, First-Order DC Electric Motor Model, MIT 2007). A rotor has left when reports in a
row are off by SIGMAS and more, on one side, until their number times the least of them is TOGETHER. The first of them is the onset, the
last the time of certainty. Values that are repeated to the last bit, gaps, old commands, and rotors commanded to idle are no evidence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.answer.wording import percent, seconds
from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import Spans, hold, within
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOST
from rotorwatch.witnesses.esc.changed import probability_of
from rotorwatch.witnesses.esc.telemetry import Binned

TICK_S, GAP_S = 0.01, 0.05  # faster reports are thinned: two of them know nothing new of a rotor; after a longer interval it begins anew
LAGS_S = np.array([0.0, 0.01, 0.02, 0.03, 0.045, 0.07, 0.1])
SLOWEST = slice(2, None)  # of these, the lags that a rotor may have for a moment
FIT_S, LEARNS_S, SETTLES_S, MEMORY_S = 0.5, 1.5, 1.0, 30.0  # between fits; before the first; after a gap; of a fit
NOISE, ROOM = 0.01, 0.3  # of the usual speed: noise of a report, and standard deviation of a and c
LEAST_NOISE, MODEL = 0.003, 0.005  # of the speed
MEDIAN = 0.5 * np.pi  # variance of a median of as many values, over that of their mean
OUTSIDE = 4.0  # sd: reports beyond count for less (Cauchy's tail)
SIGMAS, TOGETHER = 5.0, 15.0  # of each report, of at least two in a row; their number times the least of them
DOWN, UP = 0.1, 0.05  # of the logarithm of the speed, at least
DRIVEN, OTHERS_TURN = 0.7, 0.4  # of the root of its usual command; of what is predicted
FOLLOWS, FOLLOWED_S, MOSTLY = 3.0, 0.5, 0.8  # sd, time and share in which a rotor must have followed before it leaves
RETURNED, RETURNS_S = 0.5, 0.3  # share of the reports of so long in which a rotor that left follows again

BEFORE_S, LEAVES_S = 1.0, 0.15  # uncertainty of an onset by the motion; in which a speed leaves after a loss
STOPPED, AT_ONCE_S = 0.5, 0.3  # of its predicted speed; between the onsets of one loss


class Fit(NamedTuple):
    """lag: index in LAGS_S; coefficients (n, 3) with covariance (n, 3, 3) for a noise of 1; noise (n,) rad/s."""

    lag: int
    coefficients: np.ndarray
    covariance: np.ndarray
    noise: np.ndarray


class Departure(NamedTuple):
    """A rotor (from 0) that does not follow its command since `onset`, certain at `certain` [s]. ratio: of its speed to the predicted one,
    the last that is known; sigmas: the least of the reports that made it certain."""

    rotor: int
    onset: float
    certain: float
    ratio: float
    sigmas: float


class Follower:
    """The rotors of one vehicle, fed with reports in order of time. size: their number. gone: rotor (from 0) -> its departure, of those
    that have not returned."""

    def __init__(self, n: int):
        self.size = n
        self.gone: dict[int, Departure] = {}
        self._q: np.ndarray | None = None  # (lags, n)
        self._last, self._fitted, self._begun = -np.inf, -np.inf, np.inf
        self._speed = np.full(n, np.nan)
        shape = (len(LAGS_S), n, 3)
        self._gram, self._moment = np.zeros((*shape, 3)), np.zeros(shape)
        self._square, self._weight, self._count, self._roots = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        self._fit: Fit | None = None
        self._learned = 0.0  # s
        self._follows = np.zeros(n)  # share of the reports of about FOLLOWED_S that were as predicted
        self._run, self._sign, self._first, self._least = np.zeros(n, int), np.zeros(n, int), np.zeros(n), np.zeros(n)
        # s since a rotor left, up to RETURNS_S, in which it could be known to follow, and in which it did; r when it left
        self._after, self._size = np.zeros((n, 2)), np.zeros(n)

    def add(self, time: np.ndarray, speed: np.ndarray, thrust: np.ndarray, fresh: np.ndarray) -> list[Departure]:
        """The rotors that leave in so many reports. time (m,) s; speed (m, n) rad/s, NaN where unknown; thrust (m, n): commanded, share of
        full; fresh (m,) bool: the command is young."""
        rows, last = [], self._last
        for k, t in enumerate(time.tolist()):
            if t - last >= 0.9 * TICK_S:
                rows.append(k)
                last = t
        time, speed, thrust, fresh = (v[rows] for v in (time, speed, thrust, fresh))
        left, start, gaps = [], 0, 1 + np.flatnonzero(np.diff(time) > GAP_S)
        while start < len(time):
            end = max(start + 1, int(np.searchsorted(time, max(self._fitted, time[start]) + FIT_S)))
            end = min([end, *gaps[gaps > start]])
            left += self._block(*(v[start:end] for v in (time, speed, np.sqrt(np.maximum(thrust, 0.0)), fresh)))
            start = end
        return left

    def _block(self, time, speed, root, fresh) -> list[Departure]:
        since = np.diff(time, prepend=self._last)
        before = np.concatenate([self._speed[None], speed[:-1]])
        known = np.isfinite(speed) & fresh[:, None]
        moved = (speed != before) | (speed == 0.0)
        self._speed = speed[-1]
        q = self._lagged(since, root)
        self._last, seconds = float(time[-1]), float(np.minimum(since, GAP_S).sum())
        if since[0] > GAP_S:
            self._begun, self._run[:] = time[0], 0
        x = np.stack([np.ones_like(q), q, q * q], axis=3)
        spread = np.ptp(q[:, SLOWEST], axis=1)
        w = np.where(known, np.maximum(speed, 1.0), 1.0)
        weight = known / (1.0 + (self._slope() * spread / w / NOISE) ** 2)
        left = []
        if self._fit is not None:
            predicted, up, down = self._predicted(x, q)
            there = known & ~np.isin(np.arange(known.shape[1]), list(self.gone))
            r = np.log(w / predicted)
            r = np.where(known, r - _others(np.where(there, r, np.nan)), 0.0)
            common = _others(np.where(there, np.maximum(up, down), np.nan)) ** 2 / (r.shape[1] - 1)
            sd = np.sqrt(np.where(r > 0.0, up, down) ** 2 + MEDIAN * common)
            usual = self._roots / np.maximum(self._count, 1.0)
            turning = known & (speed > OTHERS_TURN * predicted)
            fine = known & moved & (root > DRIVEN * usual) & (turning.sum(axis=1, keepdims=True) - turning >= 2)
            left = self._assessed(time, seconds, r, sd, fine)
            weight = weight * np.minimum(1.0, (OUTSIDE * sd / np.maximum(np.abs(r), 1e-9)) ** 2)
        weight[:, list(self.gone)] = 0.0
        if time[-1] - self._begun > SETTLES_S:
            self._learn(x, w, weight, known, root, seconds)
        if time[-1] - self._fitted > FIT_S and self._learned > LEARNS_S:
            self._fitted = float(time[-1])
            self._refit()
        return left

    def _lagged(self, since: np.ndarray, root: np.ndarray) -> np.ndarray:
        """(m, lags, n) the roots (m, n) behind each lag."""
        keep = np.exp(-since[:, None] / np.maximum(LAGS_S, 1e-6))[..., None]
        out = np.empty((len(since), len(LAGS_S), root.shape[1]))
        q = self._q
        for k in range(len(since)):
            q = np.repeat(root[:1], len(LAGS_S), axis=0) if q is None or since[k] > GAP_S else root[k] + keep[k] * (q - root[k])
            out[k] = q
        self._q = q
        return out

    def _predicted(self, x, q) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(speeds (m, n) predicted, standard deviations (m, n) of the logarithm of a speed above and of one below)."""
        assert self._fit is not None
        lag, theta, covariance, noise = self._fit
        x = x[:, lag]
        predicted = np.maximum((x * theta).sum(axis=2), 1.0)
        extra = np.einsum("mnp,npq,mnq->mn", x, covariance, x)
        variance, near = (noise / predicted) ** 2 * (1.0 + extra) + MODEL**2, q[:, max(lag - 1, 0) : lag + 2]
        up = np.maximum(near.max(axis=1), q[:, -1]) - q[:, lag]  # slowed down by drag alone
        down = q[:, lag] - near.min(axis=1)
        up, down = (np.sqrt(variance + (self._slope() * step / predicted) ** 2) for step in (up, down))
        return predicted, up, down

    def _slope(self) -> np.ndarray:
        """(n,) speed for each root of thrust."""
        return np.sqrt(self._square / np.maximum(self._gram[0, :, 1, 1], 1e-12))

    def _assessed(self, time, seconds, r, sd, fine) -> list[Departure]:
        out = fine & (np.abs(r) > SIGMAS * sd) & (np.abs(r) > np.where(r < 0.0, DOWN, UP))
        left = []
        if out.any() or self._run.any() or self.gone:
            for row in zip(time.tolist(), r, sd, fine, out):
                left += self._report(*row, seconds / len(time))
        new = 1.0 - np.exp(-fine.mean(axis=0) * seconds / FOLLOWED_S)
        self._follows += new * ((fine & (np.abs(r) < FOLLOWS * sd)).sum(axis=0) / np.maximum(fine.sum(axis=0), 1) - self._follows)
        return left

    def _report(self, time: float, r, sd, fine, out, seconds: float) -> Iterator[Departure]:
        sign, sigmas = np.sign(r).astype(int), np.abs(r) / sd
        again = out & (self._run > 0) & (sign == self._sign)
        self._first, self._least = np.where(again, self._first, time), np.where(again, np.minimum(self._least, sigmas), sigmas)
        self._run, self._sign = np.where(again, self._run + 1, out), sign
        for k in np.flatnonzero(fine).tolist():
            known = self.gone.get(k)
            if known is not None:
                self.gone[k] = known._replace(ratio=float(np.exp(r[k])))
                size = abs(self._size[k])
                self._after[k] += (sd[k] < size / FOLLOWS) * seconds, (sd[k] < size / FOLLOWS and abs(r[k]) < 0.5 * size) * seconds
                if self._after[k, 0] > RETURNS_S:
                    if self._after[k, 1] > RETURNED * self._after[k, 0]:
                        del self.gone[k]
                    self._after[k] = 0.0
            elif self._run[k] >= 2 and self._run[k] * self._least[k] >= TOGETHER and self._follows[k] > MOSTLY:
                self._after[k], self._size[k] = 0.0, r[k]
                self.gone[k] = Departure(k, float(self._first[k]), time, float(np.exp(r[k])), float(self._least[k]))
                yield self.gone[k]

    def _learn(self, x, w, weight, known, root, seconds) -> None:
        self._learned += seconds
        fade = np.exp(-seconds / MEMORY_S)
        for total in (self._gram, self._moment, self._square, self._weight, self._count, self._roots):
            total *= fade
        weighted = weight[:, None, :, None] * x
        self._gram += np.einsum("mlnp,mlnq->lnpq", weighted, x)
        self._moment += np.einsum("mlnp,mn->lnp", weighted, w)
        self._square += (weight * w * w).sum(axis=0)
        self._weight += weight.sum(axis=0)
        used = known & (weight > 0.0)
        self._count += used.sum(axis=0)
        self._roots += np.where(used, root, 0.0).sum(axis=0)

    def _refit(self) -> None:
        total = np.maximum(self._weight, 1e-9)
        usual = np.sqrt(self._square / total)
        prior = np.zeros((usual.size, 3, 3))
        prior[:, 0, 0], prior[:, 1, 1] = (NOISE / ROOM) ** 2, 1e-9
        prior[:, 2, 2] = prior[:, 0, 0] * (self._gram[0, :, 1, 1] / total) ** 2 + 1e-9
        covariance = np.linalg.inv(self._gram + prior)
        theta = np.einsum("lnpq,lnq->lnp", covariance, self._moment)
        rest = self._square - 2.0 * np.einsum("lnp,lnp->ln", theta, self._moment) + np.einsum("lnp,lnpq,lnq->ln", theta, self._gram, theta)
        lag = int(np.argmin((rest / np.maximum(self._square, 1e-9)).sum(axis=1)))
        noise = np.maximum(np.sqrt(np.maximum(rest[lag], 0.0) / total), LEAST_NOISE * usual)
        self._fit = Fit(lag, theta[lag], covariance[lag], noise)


def _others(values: np.ndarray) -> np.ndarray:
    """(m, n) the median over the other columns of values (m, n), NaN left out; 0 where there is none."""
    n = values.shape[1]
    out = np.zeros_like(values)
    rows = np.arange(len(values))
    for k in range(n):
        rest = np.sort(np.delete(values, k, axis=1), axis=1)  # NaN last
        count = np.isfinite(rest).sum(axis=1)
        middle = 0.5 * (rest[rows, np.maximum(count - 1, 0) // 2] + rest[rows, np.minimum(count // 2, n - 2)])
        out[:, k] = np.where(count > 0, middle, 0.0)
    return out


def departures(bins: Binned, sent: np.ndarray, air: Spans) -> list[Departure]:
    """The rotors that have left what their commands ask for by the end of a flight, in order of time; none where telemetry or commands are
    too slow. sent (k,): times of the commands [s]."""
    intervals = [np.diff(v) for v in (bins.report_time, sent)]
    if any(not len(v) or float(median(v)) > GAP_S for v in intervals):
        return []
    time, follower, out = bins.report_time, Follower(bins.commanded.shape[1]), []
    age = time - hold(sent, sent, time, before=-np.inf)
    speed = np.where(bins.speed_known, bins.speed, np.nan)
    for span in air:
        rows = within(time, (span,))
        left = follower.add(time[rows], speed[rows], bins.commanded[rows], age[rows] < GAP_S)
        stayed = (follower.gone.get(d.rotor) for d in left)
        out += [now for d, now in zip(left, stayed) if now is not None and now.onset == d.onset]
        follower.gone.clear()
    return out


def sooner(event: Event, left: Sequence[Departure]) -> Event:
    """A loss, of thrust or control, with the time at which a speed has shown it, where that is earlier, and its rotor, where the motion
    leaves that open, or has taken one that turns as commanded for one that has stopped at that time."""
    near = [d for d in left if event.onset_s - BEFORE_S < d.onset < event.detected_s]
    if not near or not (event.means.weakens or event.kind == LOST) or len(event.rotors) != 1:
        return event
    first = min(near, key=lambda d: d.certain)
    who, named = first.rotor + 1, event.rotors[0]
    stands = first.ratio < STOPPED and abs(event.onset_s - first.onset) < AT_ONCE_S and all(d.rotor + 1 != named for d in near)
    if first.certain > event.detected_s or not (who in event.suspects or stands):
        return event
    reported = f"from {seconds(first.onset)} on the ESC of rotor {who} shows a speed {in_words(first)}"
    if who not in event.suspects:
        reported += f", while rotor {named} turns as commanded"
    more = (
        {}
        if (who,) == event.rotors and not event.alternatives
        else {"rotors": (who,), "alternatives": (), "probability": probability_of(first.sigmas)}
    )
    reason = f"{event.reason.removesuffix('.')}; {reported}"
    if event.kind == LOST:  # which comes later
        return replace(event, reason=reason, **more) if more else event
    onset = min(max(event.onset_s, first.onset - LEAVES_S), first.onset)
    return replace(event, onset_s=onset, detected_s=first.certain, reason=reason, **more)


def in_words(left: Departure) -> str:
    """How far a speed is from its command: '40 % below what its command asks for'."""
    return f"{percent(abs(left.ratio - 1.0))} {'below' if left.ratio < 1.0 else 'above'} what its command asks for"
