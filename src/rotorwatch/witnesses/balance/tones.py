"""Rotor speeds where a log has none: from the commands, by a gain, a curve and a lag that make the tones sharpest.

    log w_r(t) = g_r + d(t) + c log(u_r * h)(t)

u_r: command of rotor r behind a first-order lag h, c: the curve (of commands to speeds, about hover), g_r: gains of the rotors, which
differ by SPREAD (17 flights of one quadrotor: 0.9 %; motors of one make: 1 to 2 %), d: what all share (the battery), a line between knots.

1. A scan of the common gain: in windows of TURNS turns the power at u_r^c, over its floor, of all rotors together.
2. The rotors' gains, one after the other, the clearest first: the gain at which a rotor's tone explains most of what is left when the
   others are fitted and taken off (RELAX: Li and Stoica, "Efficient mixed-spectrum estimation with applications to target feature
   extraction", IEEE Trans. Signal Processing 44 (1996) 281-295). A tone's evidence in a window is -log(1 - share of the energy).
3. In each window the offset of each tone from its prediction; a regression of these on gains, knots, log u and its derivative corrects all
   gains, d, c and the lag at once (a Gauss-Newton step). 2 and 3 repeat, in longer windows.

A tone is a rotor's where the command of no other rotor predicts it as well, at any gain: a paired t test over the windows. A rotor whose
tone is another's as well, or does not stand out, is not heard.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.witnesses.balance import orders

LEAST_S = 6.0  # of flight: gains, curve and lag are not known from less
LEAST_COMMANDS_HZ = 20.0
TURNS = 40.0  # of a window: speeds that are 2 % apart have tones of their own
SHORTEST_S = 0.15
FROM_HZ, TO_HZ, STEP_HZ = 30.0, 460.0, 2.5
LEAST_WINDOWS, MOST = 10, 100
CURVE, LAG_S, RATE_HZ = 0.65, 0.04, 200.0  # to begin with; of the filtered commands
CURVES, LAGS_S = (0.3, 1.1), (0.003, 0.12)
SPREAD = 0.015
OUTSIDE = 3.0  # of these
KNOT_S = 12.0
SAGS = (0.0, -0.04, -0.08, 0.04)  # of d over the flight, to begin with
FLOOR = 15  # steps of the scan on each side
CLEAR = 0.2  # logarithm of a line's power over its floor, mean of the rotors: noise alone stays below
STAGES = ((1.0, 0.06), (2.0, 0.04), (2.0, 0.03))  # length of the windows, range of the gains' offsets
TURNED = 2  # repetitions of 2 and 3 in each
NEAR, MISSES = 0.02, 0.008  # offsets of windows; their standard deviation
LEAST_COMMAND = 0.02
BLOCKS = 25  # of a demodulated window
PER_WINDOW = 5.0  # times the evidence of a window, against the spread of the gains
RIDGE = 1e-3
APART_SD = 3.0


class Followed(NamedTuple):
    """speed (n, R): rad/s at the samples' times. sure (R,): whether the tone at this speed is the rotor's."""

    speed: np.ndarray
    sure: np.ndarray


class _Windows(NamedTuple):
    """rows (W, n) of samples; values (W, n, 3) without motion; middle (W,) s; taper (n,); turned (blocks,): times of BLOCKS blocks about
    the middle; block: samples of each; knots (W, K): shares of the knots of d; offsets (E,): of gains."""

    rows: np.ndarray
    values: np.ndarray
    middle: np.ndarray
    taper: np.ndarray
    turned: np.ndarray
    block: int
    knots: np.ndarray
    offsets: np.ndarray


def follow(time: np.ndarray, values: np.ndarray, sent: np.ndarray, commands: np.ndarray) -> Followed | None:
    """The rotors' speeds from commands (m, R), shares of full command at times (m,) s, and a sensor's values (n, 3) at times (n,); None
    where the flight is too short, the commands are too slow, or no tones stand out."""
    if time.size < 2 or sent.size < 2 or time[-1] - time[0] < LEAST_S:
        return None
    if 1.0 / float(median(np.diff(sent))) < LEAST_COMMANDS_HZ:
        return None
    return _Search(time, values, sent, commands).followed()


class _Search:
    """The state of the search. hz: the common gain, as turns a second at the mean of log u; gains (R,), common (K,): g and d; log (m, R):
    log u behind the lag, at the times `grid`."""

    def __init__(self, time: np.ndarray, values: np.ndarray, sent: np.ndarray, commands: np.ndarray) -> None:
        self.time, self.values = time, values
        self.grid = np.arange(max(sent[0], time[0] - 1.0), time[-1] + 1.0 / RATE_HZ, 1.0 / RATE_HZ)
        logs = np.log(np.maximum(commands, LEAST_COMMAND))
        self.sent = np.stack([np.interp(self.grid, sent, column) for column in logs.T], axis=1)
        self.mean = float(self.sent.mean())
        self.rotors = commands.shape[1]
        self.gains = np.zeros(self.rotors)
        self.knots = np.linspace(time[0], time[-1], max(2, int((time[-1] - time[0]) / KNOT_S) + 1))
        self.common = np.zeros(self.knots.size)
        self.curve = CURVE
        self.delayed(LAG_S)

    def delayed(self, lag: float) -> None:
        """Sets the lag, and log u behind it."""
        self.lag = float(np.clip(lag, *LAGS_S))
        kernel = np.exp(-np.arange(0.0, 6.0 * self.lag, 1.0 / RATE_HZ) / self.lag)
        kernel /= kernel.sum()
        padded = np.concatenate([np.repeat(self.sent[:1], kernel.size - 1, axis=0), self.sent])
        self.log = np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1) - self.mean

    def at(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(.., R) values (m, R) at the times of the filtered commands, at `time` (..,)."""
        return np.stack([np.interp(time, self.grid, column) for column in values.T], axis=-1)

    def followed(self) -> Followed | None:
        w = self.windows(SHORTEST_S)
        if w is None:
            return None
        if self.scan(w) < CLEAR * self.rotors:
            return None
        for stage, (times, span) in enumerate(STAGES):
            w = self.windows(times * max(SHORTEST_S, TURNS / self.hz), span)
            if w is None:
                return None
            if stage == 0:
                self.gather(w)
            for _ in range(TURNED):
                self.settle(w)
                self.regress(w)
        d = np.interp(self.time, self.knots, self.common)[:, None]
        speed = 2.0 * np.pi * self.hz * np.exp(self.curve * self.at(self.time, self.log) + self.gains + d)
        usual = np.abs(self.gains - np.median(self.gains)) < OUTSIDE * SPREAD
        return Followed(speed, usual & self.distinguished(w._replace(offsets=self.steps(w, 0.08))))

    def steps(self, w: _Windows, span: float) -> np.ndarray:
        """Offsets of gains in quarters of what a window resolves."""
        step = 0.25 / (self.hz * float(self.time[w.rows[0, -1]] - self.time[w.rows[0, 0]]))
        return np.arange(-round(span / step), round(span / step) + 1) * step

    def windows(self, length_s: float, span: float = 0.0) -> _Windows | None:
        count = length_s / float(median(np.diff(self.time)))
        rows = orders.windows(self.time, np.zeros((self.time.size, 1)), length_s, round(count / 2.1))
        if len(rows) < LEAST_WINDOWS:
            return None
        rows = rows[:: -(-len(rows) // MOST)]
        n = rows.shape[1]
        t = self.time[rows]
        motion = np.vander(np.linspace(-1.0, 1.0, n), 6)
        y = self.values[rows]
        y = (y - motion @ (np.linalg.pinv(motion) @ y)).astype(np.float32)
        block = max(1, n // BLOCKS)
        turned = (t - t[:, n // 2, None])[:, : n // block * block].mean(axis=0).reshape(-1, block).mean(axis=1)
        knots = np.maximum(0.0, 1.0 - np.abs(t[:, n // 2, None] - self.knots) / (self.knots[1] - self.knots[0]))
        w = _Windows(rows, y, t[:, n // 2], np.hanning(n).astype(np.float32), turned, block, knots, np.zeros(1))
        return w._replace(offsets=self.steps(w, span)) if span else w

    def tones(self, w: _Windows, hz: float = 0.0) -> np.ndarray:
        """(W, n, R) exp(-j angle) of the rotors as predicted, the angle from the middle of each window."""
        t = self.time[w.rows]
        speed = (hz or self.hz) * np.exp(self.curve * self.at(t, self.log) + self.gains + (w.knots @ self.common)[:, None, None])
        turns = np.zeros_like(speed)
        np.cumsum(0.5 * (speed[:, 1:] + speed[:, :-1]) * np.diff(t, axis=1)[..., None], axis=1, out=turns[:, 1:])
        angle = (2.0 * np.pi * np.remainder(turns - turns[:, t.shape[1] // 2, None], 1.0)).astype(np.float32)
        tones = np.empty(angle.shape, np.complex64)
        tones.real, tones.imag = np.cos(angle), -np.sin(angle)
        return tones

    def scan(self, w: _Windows) -> float:
        """Finds the common gain, and how it falls over the flight; its score, the sum over the rotors of log(line / floor)."""
        every = np.arange(FROM_HZ, TO_HZ, STEP_HZ)
        turn, step = (self.tones(w, hz) for hz in (FROM_HZ, STEP_HZ))
        turn *= w.taper[:, None]
        y = w.values.transpose(0, 2, 1).astype(np.complex64)
        power = np.empty((every.size, len(w.rows), self.rotors), np.float32)
        for k in range(every.size):
            found = y @ turn
            power[k] = (np.square(found.real) + np.square(found.imag)).sum(axis=1)
            turn *= step
        beside = np.pad(power.mean(axis=1), ((FLOOR, FLOOR), (0, 0)), mode="edge")
        floor = np.stack([np.median(beside[k : k + 2 * FLOOR + 1], axis=0) for k in range(every.size)])
        at = (w.middle - self.time[0]) / (self.time[-1] - self.time[0]) - 0.5
        best = -np.inf
        for sag in SAGS:
            place = (every[:, None] * np.exp(sag * at) - FROM_HZ) / STEP_HZ
            low = np.clip(place.astype(int), 0, every.size - 2)
            share = np.clip(place - low, 0.0, 1.0)[..., None]
            rows = np.arange(len(at))
            line = ((1.0 - share) * power[low, rows] + share * power[low + 1, rows]).mean(axis=1)
            score = np.log(line / floor).sum(axis=1)
            if score.max() > best:
                best, self.hz = float(score.max()), float(every[int(np.argmax(score))])
                self.common = sag * np.linspace(-0.5, 0.5, self.knots.size)
        return best

    def evidence(self, w: _Windows, tones: np.ndarray, by: list[int], others: list[int]) -> np.ndarray:
        """(by, W, E) -log(1 - share) of what is left without the tones of `others`, for the tones that the commands of `by` predict, at
        the offsets."""
        rest = w.values
        if others:
            X = np.concatenate([np.real(tones[:, :, others]), np.imag(tones[:, :, others])], axis=2)
            gram = X.transpose(0, 2, 1) @ X + RIDGE * X.shape[1] * np.eye(X.shape[2], dtype=np.float32)
            rest = rest - X @ np.linalg.solve(gram, X.transpose(0, 2, 1) @ rest)
        rest = rest * w.taper[:, None]
        whole = np.square(rest).sum(axis=(1, 2))[:, None]
        turn = np.exp((-2j * np.pi) * np.outer(w.offsets * self.hz, w.turned)).astype(np.complex64)
        gain = 2.0 * float(np.square(w.taper).sum()) / float(w.taper.sum()) ** 2
        blocks = (len(rest), w.turned.size, w.block, -1)
        rest = rest[:, : w.turned.size * w.block].reshape(blocks)
        out = []
        for k in by:
            turned = np.ascontiguousarray(tones[:, : w.turned.size * w.block, k]).view(np.float32).reshape(blocks)
            slow = turned.transpose(0, 1, 3, 2) @ rest  # (W, blocks, 2, 3): with cosine and minus sine
            share = turn @ (slow[:, :, 0] + 1j * slow[:, :, 1])
            share = gain * (np.square(share.real) + np.square(share.imag)).sum(axis=2) / np.maximum(whole, 1e-12)
            out.append(-np.log1p(-np.minimum(share, 0.98)))
        return np.array(out)

    def total(self, w: _Windows, tones: np.ndarray, k: int, others: list[int]) -> np.ndarray:
        """(E,) evidence for the offsets of rotor k's gain, with what is known of gains."""
        prior = 0.5 * np.square((self.gains[k] + w.offsets - np.median(self.gains)) / SPREAD)
        return PER_WINDOW * self.evidence(w, tones, [k], others)[0].sum(axis=0) - prior

    def gather(self, w: _Windows) -> None:
        """First gains: of what is left, the rotor with the clearest tone, until all have one."""
        there: list[int] = []
        tones = self.tones(w)
        while len(there) < self.rotors:
            left = [k for k in range(self.rotors) if k not in there]
            scores = [self.total(w, tones, k, there) for k in left]
            one = int(np.argmax([s.max() - np.median(s) for s in scores]))
            self.gains[left[one]] += w.offsets[int(np.argmax(scores[one]))]
            there.append(left[one])
            tones = self.tones(w)

    def settle(self, w: _Windows) -> None:
        """Each gain to where its tone explains most of what the others leave, the largest improvement first."""
        tones, middle = self.tones(w), w.offsets.size // 2
        everyone = range(self.rotors)

        def score(k: int) -> np.ndarray:
            return self.total(w, tones, k, [j for j in everyone if j != k])

        scores = [score(k) for k in everyone]
        moved = False
        for k in np.argsort([s[middle] - s.max() for s in scores]):
            best = int(np.argmax(score(int(k)) if moved else scores[k]))
            self.gains[k] += w.offsets[best]
            if abs(best - middle) > 1:
                moved, tones = True, self.tones(w)

    def regress(self, w: _Windows) -> None:
        """All of the model by the offsets of its tones in the windows."""
        tones, everyone = self.tones(w), range(self.rotors)
        near = w._replace(offsets=w.offsets[np.abs(w.offsets) <= NEAR])
        likely = np.stack([self.evidence(near, tones, [k], [j for j in everyone if j != k])[0] for k in everyone], axis=1)
        best = np.argmax(4.0 * PER_WINDOW * likely - 0.5 * np.square(near.offsets / MISSES), axis=2)
        off, shares = near.offsets[best].ravel(), 1.0 - np.exp(-np.take_along_axis(likely, best[..., None], axis=2)[..., 0].ravel())
        weight = np.where(shares > 16.0 / w.rows.shape[1], np.minimum(shares, 0.3), 0.0)
        if not weight.any():
            return
        t = self.time[w.rows]
        W, logs = len(t), self.at(t, self.log).mean(axis=1)
        slopes = (self.at(t[:, 0], self.log) - self.at(t[:, -1], self.log)) / (t[:, -1:] - t[:, :1])
        X = np.concatenate(
            [
                np.tile(np.eye(self.rotors), (W, 1, 1)), np.repeat(w.knots[:, None], self.rotors, axis=1),
                logs[..., None], slopes[..., None],
            ],
            axis=2,
        ).reshape(W * self.rotors, -1)  # fmt: skip
        usual = np.r_[np.full(self.rotors, SPREAD), np.full(self.knots.size, 0.03), 0.2, 0.02]
        robust, step = weight, np.zeros(X.shape[1])
        for _ in range(3):
            step = np.linalg.solve((X.T * robust) @ X + np.diag(3e-4 / usual**2), X.T @ (robust * off))
            left = np.abs(off - X @ step)
            robust = weight / np.maximum(1.0, left / (2.2 * max(float(median(left[weight > 0.0])), 1e-3)))
        self.gains = self.gains + step[: self.rotors]
        self.common = self.common + step[self.rotors : -2]
        self.curve = float(np.clip(self.curve + step[-2], *CURVES))
        self.delayed(self.lag + step[-1] / self.curve)

    def distinguished(self, w: _Windows) -> np.ndarray:
        """(R,) whether no other rotor's command predicts a rotor's tone as well."""
        tones, everyone = self.tones(w), range(self.rotors)
        middle = w.offsets.size // 2
        sure = np.ones(self.rotors, bool)
        for k in everyone:
            others = [j for j in everyone if j != k]
            own, *rest = self.evidence(w, tones, [k, *others], others)
            for other in rest:
                more = own[:, middle] - other[:, int(np.argmax(other.sum(axis=0)))]
                sure[k] &= float(more.mean()) > APART_SD * float(more.std()) / np.sqrt(len(more))
        return sure
