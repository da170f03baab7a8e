"""How large a loss of each rotor can be that has not been announced.

What is not announced has been taken for a disturbance: from its onset on the estimated biases of roll, pitch and yaw hold what the rotor
does not give. A loss L of rotor i is a step of

    z = b / mean T      by      L B_i T_i / mean T

b: biases [hover thrusts of one rotor]; T: thrusts commanded; dividing by the mean takes a sagging battery out. For every onset between
two blocks of time L is weighted least squares on the difference of the means of z after and before it; the variance of z is enlarged by
(1 + r) / (1 - r) for errors of an autoregression with correlation r from block to block. The bound is the largest upper end of the 95 %
intervals over all onsets. Wind that turns, or a load that shifts, is such a step as well: the bound then says that
a loss could look like this. Thrust itself, which battery and air move for all rotors alike, is left out for a single rotor.

Where such a step began with certain evidence for that rotor (`announcement.CERTAIN_NATS`, of one tick, and against no change at all), and
has stayed since, the flight cannot be called healthy: a gust explains the beginning as well, and another wind the rest, but a loss
explains both.

Equal losses of rotors that are opposite each other cancel in roll and pitch, and where both turn the same way as the others on average in
yaw, too. For these pairs thrust is used as well: the bound then holds a sagging battery and rising air.

Sources: G. V. Bayley and J. M. Hammersley, The effective number of independent observations in an autocorrelated time series, Supplement
to the Journal of the Royal Statistical Society 8 (1946) 184-197, for the enlargement; M. G. Kendall, Note on bias in the estimation of
autocorrelation, Biometrika 41 (1954) 403-404, for the (1 + 3 r) / N by which r comes out too small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rotorwatch.answer.wording import SCALE
from rotorwatch.default import announcement, events, hypotheses, residual_evidence
from rotorwatch.default.residual_evidence import ResidualEvidence
from rotorwatch.flight.diagnosis import Event
from rotorwatch.front.losses import WITHIN_95
from rotorwatch.maths.tails import student_quantile
from rotorwatch.motion.ticks import JUDGE, Ticks

STEP_S = 2.0  # length of a block; a longer one hides the scatter of wind, a shorter one is as correlated as the wind is
BLOCKS = 8, 200  # at least, so that short flights have shorter ones, and at most
SPELL = 3  # blocks before and after an onset
CORRELATED = 0.9  # at most
ROWS = 2048  # that are stored of a flight; of longer ones a row is the sum of several ticks


def of(biases: np.ndarray, table: Ticks, B: np.ndarray) -> Unseen:
    """What a whole flight shows. biases (T, 4): as estimated, at the ticks of `table`; B (4, n): effectiveness."""
    seen = Unseen(B, table.dt)
    seen.add(biases, table)
    return seen


def losses(biases: np.ndarray, table: Ticks, B: np.ndarray) -> np.ndarray:
    """The bounds of a whole flight, as `Unseen.losses`."""
    return of(biases, table, B).losses()


def suspected(seen: Unseen, out, table: Ticks, found: Sequence[Event]) -> tuple[ResidualEvidence, ...]:
    """The rotors that a step accuses which has stayed and began with certain evidence. seen: of the whole flight; out: the estimator's
    stacked outputs; found: events, for the knocks, whose evidence speaks of themselves."""
    step = seen.step()
    if step is None or (step.loss - step.half)[step.nats.argmax()] < dict(SCALE)["worn"]:
        return ()
    who = np.flatnonzero(step.nats > step.nats.max() - hypotheses.CLEAR)
    judged = np.flatnonzero(usable(table))
    about = (step.before + step.block * SPELL * np.array([-1.0, 1.0])) * (len(judged) - 1)
    first, last = judged[np.clip(about, 0, len(judged) - 1).astype(int)]
    began = usable(table) & ~residual_evidence.knocked(table, found)
    began[:first], began[last + 1 :] = False, False
    odds = np.where(began[:, None], np.asarray(out.log_odds)[:, who], -np.inf)
    if odds.max() < announcement.CERTAIN_NATS or table.restart[first + 1 : last + 1].any():
        return ()  # between two flights battery and payload change as well
    sure = int(odds.max(axis=1).argmax())
    start, end = float(table.time[sure] - table.dt * np.asarray(out.onset)[sure]), float(table.time[-1])
    rotors = tuple(int(i) + 1 for i in who[step.nats[who].argsort()[::-1]])
    half = WITHIN_95 * events.sd_of(step.loss, step.half / WITHIN_95, seen.B)
    low, high = np.clip([step.loss - half, step.loss + half], 0.0, 1.0)
    return (ResidualEvidence(rotors, start, end, tuple((float(low[i - 1]), float(high[i - 1])) for i in rotors)),)


def usable(table: Ticks) -> np.ndarray:
    """(T,) bool: the ticks whose biases count. Rotors that are commanded nothing cannot lack anything."""
    return (table.mode == JUDGE) & table.valid[:, :3].all(axis=1) & ~table.upset & table.thrust.any(axis=1)


class Unseen:
    """The bounds of a flight that goes on; its memory does not grow. B (4, n): effectiveness; dt: length of a tick, s."""

    def __init__(self, B: np.ndarray, dt: float):
        self.B, self._dt, self._each = B, dt, 1
        # Sums over `_each` ticks: biases of roll, pitch, yaw and thrust; thrusts.
        self._rows = np.empty((0, 4 + B.shape[1]))
        self._new: list[np.ndarray] = []  # ticks that are in no row yet

    def add(self, biases: np.ndarray, table: Ticks) -> None:
        """More ticks, with the biases (T, 4) that were estimated at them."""
        use = usable(table)
        if use.any():
            self._new.append(np.concatenate([biases[use], table.thrust[use]], axis=1))
        if len(self._new) > ROWS:
            self._join()

    def _join(self) -> None:
        if not self._new:
            return
        ticks = np.concatenate(self._new)
        while True:
            whole = len(ticks) // self._each * self._each
            added = ticks[:whole].reshape(-1, self._each, ticks.shape[1]).sum(axis=1)
            if len(self._rows) + len(added) <= ROWS:
                break
            pairs = len(self._rows) // 2  # of an odd number the last row is dropped: it is half of a new one
            self._rows = self._rows[: 2 * pairs].reshape(pairs, 2, ticks.shape[1]).sum(axis=1)
            self._each *= 2
        self._rows = np.concatenate([self._rows, added])
        self._new = [ticks[whole:]] if whole < len(ticks) else []

    def losses(self) -> np.ndarray:
        """Upper bound (n,) of what each rotor can have lost since judging began and was not announced; 1 where too little was judged."""
        return self._of(np.eye(self.B.shape[1]), 3).upper()

    def step(self) -> Step | None:
        """The step of one rotor that explains most, or None where too little was judged."""
        found = self._of(np.eye(self.B.shape[1]), 3)
        return found.largest() if len(found.before) else None

    def pair(self, partners: Mapping[int, Sequence[int]]) -> float:
        """The same of equal losses of two rotors, the largest of all pairs; 0 without any. partners: to each rotor (0-based) the ones
        opposite."""
        pairs = [(i, j) for i, js in partners.items() for j in js if i < j]
        sets = np.zeros((self.B.shape[1], len(pairs)))
        for k, pair in enumerate(pairs):
            sets[list(pair), k] = 1.0
        return float(self._of(sets, 4).upper().max(initial=0.0))

    def _of(self, sets: np.ndarray, axes: int) -> _Steps:
        """Equal losses of sets of rotors (n, m), by the first axes."""
        self._join()
        rows = self._rows
        if len(rows) < 2 * BLOCKS[0]:
            return _Steps(np.zeros(0), np.zeros((0, sets.shape[1])), np.zeros((0, sets.shape[1])), 1)
        N = int(np.clip(len(rows) * self._each * self._dt / STEP_S, *BLOCKS))
        sums = np.add.reduceat(rows, np.arange(N) * len(rows) // N)
        usual = sums[:, 4:].mean(axis=1, keepdims=True)
        return _steps(sums[:, :axes] / usual, sums[:, 4:] / usual, self.B[:axes], sets)


class Step(NamedTuple):
    """A step of the biases that a loss of one rotor explains. before: share of the judged ticks before it; block: share of them that one
    block is; loss (n,) of each rotor; half (n,): half its 95 % interval; nats (n,): how much better than no step each explains it."""

    before: float
    block: float
    loss: np.ndarray
    half: np.ndarray
    nats: np.ndarray


class _Steps(NamedTuple):
    """Losses (K, m) of m sets of rotors for K onsets, with their information; before (K,): share of N blocks before the onset."""

    before: np.ndarray
    loss: np.ndarray
    information: np.ndarray
    N: int

    def half(self) -> np.ndarray:
        """Half a 95 % interval (K, m)."""
        return student_quantile(0.975, self.N - 2) / np.sqrt(self.information)

    def upper(self) -> np.ndarray:
        """(m,): the largest upper end over all onsets; 1 without any."""
        if not len(self.before):
            return np.ones(self.loss.shape[1])
        return np.minimum((np.maximum(self.loss, 0.0) + self.half()).max(axis=0), 1.0)

    def largest(self) -> Step:
        nats = 0.5 * np.maximum(self.loss, 0.0) ** 2 * self.information
        k = int(nats.max(axis=1).argmax())
        return Step(float(self.before[k]), 1.0 / self.N, self.loss[k], self.half()[k], nats[k])


def _steps(z: np.ndarray, share: np.ndarray, B: np.ndarray, sets: np.ndarray) -> _Steps:
    """Losses of sets of rotors (n, m) from z (N, axes) and T / mean T (N, n) of N blocks; B (axes, n)."""
    N = len(z)
    k = np.arange(SPELL, N - SPELL + 1)[:, None]  # blocks before the onset
    sums, shares = z.cumsum(axis=0), share.cumsum(axis=0)
    before, after = sums[k[:, 0] - 1] / k, (sums[-1] - sums[k[:, 0] - 1]) / (N - k)
    # The scatter is that about the step that explains most: about any other one, the step itself would count as scatter.
    squares = np.maximum((z**2).sum(axis=0) - k * before**2 - (N - k) * after**2, 1e-12)
    best = int(np.log(squares).sum(axis=1).argmin())
    left = z - np.where(np.arange(N)[:, None] < k[best], before[best], after[best])
    r = (left[1:] * left[:-1]).sum(axis=0) / squares[best]
    r = np.clip(r + (1.0 + 3.0 * r) / N, 0.0, CORRELATED)
    weight = (N - 2) / squares[best] * (1.0 - r) / (1.0 + r) / (1.0 / k + 1.0 / (N - k))
    columns = B * ((shares[-1] - shares[k[:, 0] - 1]) / (N - k))[:, None, :] @ sets
    information = np.maximum(np.einsum("ka,kai->ki", weight, columns**2), 1e-12)
    loss = np.einsum("ka,kai->ki", weight * (after - before), columns) / information
    return _Steps(k[:, 0] / N, loss, information, N)
