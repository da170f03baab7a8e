"""What explains the trim of a whole flight, and its changes that are slow, or that no step of the estimator tells.

The estimator announces steps. What grows over seconds or minutes it takes for a disturbance, and what turns the vehicle without taking
thrust as well. Over the whole flight both show in

    z = (b + B T theta) / mean T

b, theta: biases and losses as estimated, T: thrusts commanded. With r: 0 until t0, 1 from t1 on, straight between, the explanations of z
on roll, pitch and yaw, each weighed by its evidence and its prior, are

    nothing         a level, and what manoeuvres do
    a rotor         r L B_i T_i / mean T, L: the loss of rotor i at the end; any size is as likely as any other
    other           any drift: of each axis by an amount of its own, of a Cauchy distribution of scale DRIFT - wind that turns, a load that
                    shifts, a mount that gives -, of all axes at the same time or of each at its own
    a turned mount  of those, yaw by TURNED and more beside less of the others: neither wind nor load does that

The noise of each axis is a random walk and white noise of any size and ratio (`methods/maths/trend.py`), for air wanders; white noise is
larger where z scatters more within a block of time. Manoeuvres show in z where gains are off, by GAIN or so: in proportion to commands of
torque that come and go within SMOOTH blocks. Thrust, which battery and air move for all rotors alike, is left out. So a drift is a rotor's
where it has the direction of that rotor, and is larger than drifts are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.answer import unseen
from rotorwatch.engine.estimator.plant import USUAL_S, YAW
from rotorwatch.engine.motion.ticks import JUDGE, Ticks
from rotorwatch.methods.maths.trend import DOUBT, LEAST, WHITE

LEAST_S = 30.0  # of flight, below which nothing is looked for
TOGETHER = 256  # pieces of a flight, before they are joined
BLOCK_S, BLOCKS = 2.0, 60  # length of a block at least; so many at most
RISES = (0, 3, 5, 8, 12, 18, 27, 40)  # blocks from t0 to t1
ONSETS = 20  # t0 that are tried for each, at most
SMOOTH, GAIN = 5, 0.2  # blocks; standard deviation of what gains are off by
DRIFT = np.array([0.1, 0.1, 0.2])  # hover thrusts of one rotor, per mean thrust: roll, pitch, yaw
AMOUNTS = np.concatenate([-np.geomspace(1.5, 0.01, 40), np.geomspace(0.01, 1.5, 40)])  # the same, of a drift
TURNED = 0.3  # the same: a mount that turns by a degree or two; wind and load turn a vehicle by half of it
RARE = 0.01  # how often a rotor loses slowly, to how often something else drifts
SIZES = np.linspace(0.03, 0.99, 33)


class Trim(NamedTuple):
    """N blocks of time: time (N,) s; at (N,): their numbers; z (N, 3); share (N, n): thrusts over their mean; white (N,): variance of white
    noise, to the least; length: of a block, s; curve_sd: how well the expo of the thrust curve is known."""

    time: np.ndarray
    at: np.ndarray
    z: np.ndarray
    share: np.ndarray
    white: np.ndarray
    length: float
    curve_sd: float


class Explained(NamedTuple):
    """A trim with what explains it. starts, rises (C,): courses, t0 and t1 - t0 in blocks. Log-odds to `nothing`, with their priors: losses
    (C, n, S): a rotor, for each course and size of SIZES; turned (C, A): a mount that turns the vehicle by each of AMOUNTS, none below
    TURNED; other: everything else together."""

    trim: Trim
    starts: np.ndarray
    rises: np.ndarray
    losses: np.ndarray
    turned: np.ndarray
    other: float

    def odds(self, mine: np.ndarray) -> float:
        """Odds of an explanation, a part of these arrays, to all others together."""
        share = _total(mine) - np.logaddexp.reduce([_total(self.losses), _total(self.turned), self.other])
        return float(np.exp(share - np.log1p(-np.exp(min(share, -1e-12)))))

    def since(self, start: float) -> float:
        """The time of a place among the blocks, s."""
        return float(self.trim.time[0] + self.trim.length * (start - self.trim.at[0]))


def explain(out, table: Ticks, B: np.ndarray) -> Explained | None:
    """The trim of a whole flight with what explains it; None where too little was judged. Arguments as of `Trims`."""
    trims = Trims(B)
    trims.add(out, table)
    return trims.explain()


def _total(logs: np.ndarray) -> float:
    return float(np.logaddexp.reduce(logs, None))


class Trims:
    """The trim of a flight that goes on, since its last take-off or knock. B (4, n): effectiveness."""

    def __init__(self, B: np.ndarray):
        self._B, self._curve_sd, self._dt = B, 0.0, 0.0
        self._ticks: list[np.ndarray] = []  # (T, 4 + n): time [s], z times the mean thrust (3,), thrusts
        self._judging, self._begin = False, np.inf

    def add(self, out, table: Ticks) -> None:
        """More ticks. out: the estimator's stacked outputs at them (theta (T, n), biases (T, 4))."""
        judging = table.mode == JUDGE
        begins = np.flatnonzero(judging & ~np.concatenate([[self._judging], judging[:-1]]))
        if begins.size:
            self._ticks, self._begin = [], float(table.time[begins[-1]])
        self._judging, self._curve_sd, self._dt = bool(judging[-1]), table.curve[1], table.dt
        use = np.flatnonzero(unseen.usable(out, table) & (table.time >= self._begin + USUAL_S))
        T = table.thrust[use]
        lacking = (out.biases[use] + (T * out.theta[use]) @ self._B.T)[:, :3]
        self._ticks.append(np.column_stack([table.time[use], lacking, T]))
        if len(self._ticks) > TOGETHER:
            self._ticks = [np.concatenate(self._ticks)]

    def explain(self) -> Explained | None:
        """What explains it; None where too little was judged."""
        seen = self._blocks()
        return None if seen is None else _weighed(seen, self._B)

    def _blocks(self) -> Trim | None:
        ticks = np.concatenate(self._ticks) if self._ticks else np.empty((0, 4))
        time, T = ticks[:, 0], ticks[:, 4:]
        if time.size < LEAST or time[-1] - time[0] < LEAST_S:
            return None
        span = float(time[-1] - time[0]) + self._dt
        count = int(np.clip(span / BLOCK_S, LEAST, BLOCKS))
        block = np.minimum(((time - time[0]) / span * count).astype(int), count - 1)
        size = np.bincount(block, minlength=count)
        some = size >= 0.5 * size.max()
        if some.sum() < LEAST:
            return None

        def mean(rows: np.ndarray) -> np.ndarray:
            return np.column_stack(
                [np.bincount(block, column, minlength=count)[some] / size[some] for column in rows.T]
            )

        of_all = T.mean(axis=1, keepdims=True)
        z = ticks[:, 1:4] / of_all
        scatter = mean(z**2) - mean(z) ** 2
        white = np.maximum((scatter / np.maximum(np.median(scatter, axis=0), 1e-12)).max(axis=1), 1.0)
        at, share = np.flatnonzero(some), mean(T) / mean(of_all)
        return Trim(time[0] + span * (at + 0.5) / count, at, mean(z), share, white, span / count, self._curve_sd)


def _courses(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C,) t0 and (C,) t1 - t0, in blocks."""
    found = []
    for rise in RISES:
        last = max(at[0] + 1.0, at[-1] - 1.0 - 0.5 * rise)
        found += [(start, rise) for start in np.unique(np.linspace(at[0] + 1.0, last, ONSETS).round())]
    starts, rises = np.array(found, float).T
    return starts, rises


def _weighed(seen: Trim, B: np.ndarray) -> Explained:
    (N, n), at = seen.share.shape, seen.at
    starts, rises = _courses(at)
    C = len(starts)
    r = np.clip((at - starts[:, None]) / np.maximum(rises, 1e-9)[:, None], 0.0, 1.0)
    r = np.where(rises[:, None] > 0, r, at >= starts[:, None])
    X = np.concatenate([r[:, None], r[:, None] * seen.share.T], axis=1).reshape(-1, N)  # of a drift, of each rotor
    torque = seen.share @ B[:3].T
    moves = torque - _lines(at) @ torque
    walk = np.minimum(at[:, None], at) - at[0] + 1.0
    fits = []  # of each axis and ratio of noises: the evidence of the noise, and sums of squares
    for k, q in enumerate(WHITE):
        whiten = np.linalg.inv(np.linalg.cholesky(walk + q * np.diag(seen.white)))
        U, size, _ = np.linalg.svd(whiten @ moves, full_matrices=False)
        for axis, y in enumerate(seen.z.T):
            left = whiten @ y
            left -= U @ (U.T @ left)
            known = 1.0 / np.sqrt(1.0 + GAIN**2 * size**2 * N / max(left @ left, 1e-12))
            W = whiten - (U * (1.0 - known)) @ (U.T @ whiten)
            level = W.sum(axis=1)
            W -= np.outer(level, level @ W) / (level @ level)
            fit = np.log(np.diag(whiten)).sum() + np.log(known).sum() - 0.5 * np.log(level @ level) + k * np.log(DOUBT)
            x, y = X @ W.T, W @ y
            fits.append((axis, fit, y @ y, (x @ y).reshape(C, n + 1), (x**2).sum(axis=1).reshape(C, n + 1)))

    def log_fit(axis: int, which, amount: np.ndarray) -> np.ndarray:
        """Of amounts (..., S) of the columns `which`, on one axis."""
        total = np.array(-np.inf)
        for fit, yy, xy, xx in (f[1:] for f in fits if f[0] == axis):
            rest = yy - 2.0 * amount * xy[:, which, None] + amount**2 * xx[:, which, None]
            total = np.logaddexp(total, fit - 0.5 * (N - 1) * np.log(np.maximum(rest, 1e-12 * yy + 1e-300)))
        return total

    losses = np.zeros((C, n, SIZES.size))
    small, large = np.zeros((3, C)), np.zeros((3, C, AMOUNTS.size))
    turns = np.abs(AMOUNTS) >= TURNED
    for axis in range(3):
        none = log_fit(axis, 0, np.zeros(1))[0, 0]
        density = np.gradient(AMOUNTS) / (np.pi * DRIFT[axis] * (1.0 + (AMOUNTS / DRIFT[axis]) ** 2))
        drift = log_fit(axis, 0, AMOUNTS) + np.log(density) - none
        small[axis], large[axis] = np.logaddexp.reduce(drift[:, ~turns], 1), np.where(turns, drift, -np.inf)
        losses += log_fit(axis, slice(1, None), SIZES * B[axis, :, None]) - none
    whole = np.logaddexp(small, np.logaddexp.reduce(large, 2))  # (3, C): of any amount
    still, calm = small[:YAW].sum(axis=0), whole[:YAW].sum(axis=0)  # roll and pitch at the same time: little, and any
    alone = (
        np.logaddexp(0.0, np.logaddexp.reduce(whole[:YAW], 1) - np.log(C)).sum() - np.log(2.0) * 3.0
    )  # each at its own
    turned = np.logaddexp(alone, still[:, None]) + large[YAW] - np.log(C)
    together = np.logaddexp(calm + small[YAW], calm + np.log(-np.expm1(np.minimum(still - calm, -1e-12))) + whole[YAW])
    apart = alone + np.logaddexp(0.0, _total(small[YAW]) - np.log(C))
    other = np.logaddexp.reduce(np.array([0.0, _total(together) - np.log(C), apart])) - np.log(3.0)
    losses += np.log(RARE / (C * n * SIZES.size))
    return Explained(seen, starts, rises, losses, turned - np.log(3.0), float(other))


def _lines(at: np.ndarray) -> np.ndarray:
    """(N, N): what gives the value at each time of the straight line through the values near it."""
    apart = at[None, :] - at[:, None]
    near = (np.abs(apart) <= SMOOTH).astype(float)
    m0, m1, m2 = near.sum(axis=1), (near * apart).sum(axis=1), (near * apart**2).sum(axis=1)
    return near * (m2[:, None] - m1[:, None] * apart) / np.maximum(m0 * m2 - m1**2, 1e-9)[:, None]
