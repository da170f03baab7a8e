"""The largest loss of each rotor that can have remained undetected.

A loss that is not announced is taken for a disturbance: from its onset on the estimated biases of roll, pitch and yaw include the rotor's
deficit. A loss L of rotor i is a step of

    z = b / mean T      by      L B_i T_i / mean T

b: biases [hover thrusts of one rotor]; T: thrusts commanded; dividing by the mean removes a sagging battery. For every onset between two
blocks of time L is weighted least squares on the difference of the means of z after and before it; the variance of z is enlarged by (1 + r)
/ (1 - r) for errors of an autoregression with correlation r from block to block. The bound is the largest upper end of the 95 % intervals
over all onsets from 10 s after assessing began to 10 s before its end (6 s in short flights). Turning wind, or a shifting load, is such a
step as well: the bound then states that a loss could look like it. Thrust itself, which battery and air change for all rotors alike, is
left out for a single rotor.

Where such a step is certain, began with certain evidence for that rotor (`CERTAIN_NATS` each, against no change at all; the beginning of
one tick), and has lasted since, the flight cannot be called healthy: a gust explains the beginning as well, and another wind the rest, but
a loss explains both.

Equal losses of opposite rotors cancel in roll and pitch, and where both turn the same way as the others on average in yaw, too. For these
pairs thrust is used as well: the bound then includes a sagging battery and rising air.

Sources: G. V. Bayley and J. M. Hammersley, The effective number of independent observations in an autocorrelated time series, Supplement to
the Journal of the Royal Statistical Society 8 (1946) 184-197, for the enlargement; M. G. Kendall, Note on bias in the estimation of
autocorrelation, Biometrika 41 (1954) 403-404, for the (1 + 3 r) / N by which r is biased low.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch.answer.wording import SCALE
from rotorwatch.engine.bindings import event_rows, unexplained_evidence
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator import hypotheses, plant
from rotorwatch.engine.events.decisions import CERTAIN_NATS
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.intake.craft import YAW
from rotorwatch.engine.intake.ticks import CARRIES
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import LOST
from rotorwatch.stats.tails import student_quantile


def _step_explained(claim: Event, known: Event) -> bool:
    return known.means.wrong or known.source.name == event_rows.TRIM.name


STEPS = Source("steps", 11, _step_explained)
STEP_S = 2.0  # length of a block; a longer one masks the scatter of wind, a shorter one is as correlated as wind
BLOCKS = 8, 200  # at least, so that short flights have shorter ones, and at most
SPELL = 3  # blocks before and after an onset
FIRM = 5  # the same for the bound, where the flight is long enough: means of fewer do not resolve a step
CORRELATED = 0.9  # at most
# Causes of a loss of control that rest on how rotors answer their commands.
CLEARS = ("controller", "saturated", "unknown")
PUSH_S, LEANS_S = 1.0, 3.0  # before the force of a push is that large; length of a push, beyond that of turning wind
TOGETHER = 256  # chunks of a flight processed together: one by one they cost more than the estimator
ROWS = 2048  # stored of a flight; in longer ones a row is the sum of several ticks


def bounds(out, table: Ticks, B: np.ndarray) -> Unseen:
    """The bounds of a whole flight. out: the estimator's outputs at the ticks of `table`; B (4, n): effectiveness."""
    seen = Unseen(B, table.dt)
    seen.add(out, table)
    return seen


def usable(table: Ticks) -> np.ndarray:
    """(T,) bool: the ticks whose biases count. Rotors that do not carry the vehicle show no deficit; those of a tricopter make no yaw."""
    return (table.mode == ASSESS) & table.valid[:, :YAW].all(axis=1) & ~table.upset & (table.thrust.mean(axis=1) > CARRIES)


class Rows(NamedTuple):
    """R stretches of one or more ticks each. sums (R, 4 + n): of biases and thrusts; odds (R, n): the largest evidence [nats] against each
    rotor alone; when, onset (R, n): its time, and the onset that it implies [s]; leads (R, n): it exceeded any disturbance at some time;
    began (R,): a flight begins in the stretch, or since the one before."""

    sums: np.ndarray
    odds: np.ndarray
    when: np.ndarray
    onset: np.ndarray
    leads: np.ndarray
    began: np.ndarray

    def joined(self, more: Rows) -> Rows:
        return Rows(*(np.concatenate(pair) for pair in zip(self, more, strict=True)))

    def part(self, rows: slice) -> Rows:
        return Rows(*(column[rows] for column in self))

    def merged(self, k: int) -> Rows:
        """Stretches of k rows each; an incomplete last one is left out."""
        if k == 1:
            return self
        whole = len(self.sums) // k
        sums, odds, when, onset, leads, began = (a[: whole * k].reshape(whole, k, *a.shape[1:]) for a in self)
        most = odds.argmax(axis=1)[:, None]
        odds, when, onset = (np.take_along_axis(column, most, axis=1)[:, 0] for column in (odds, when, onset))
        return Rows(sums.sum(axis=1), odds, when, onset, np.asarray(leads.any(axis=1)), np.asarray(began.any(axis=1)))


class Unseen:
    """The bounds of an ongoing flight; memory is bounded. B (4, n): effectiveness; dt: length of a tick, s."""

    def __init__(self, B: np.ndarray, dt: float):
        self.B, self._dt, self._each = B, dt, 1
        n = B.shape[1]
        self._disturbance, none = ~list_hypotheses(n).fault, np.empty((0, n))
        self._rows = Rows(np.empty((0, 4 + n)), none, none, none, none > 0.0, np.empty(0, bool))  # of `_each` ticks
        self._rest = self._rows  # ticks too few for a row
        self._new: list[tuple[np.ndarray, ...]] = []  # chunks not yet processed
        self._began = False  # whether a flight began since the last tick in a row or the rest
        self._pushed, self._rested = False, -np.inf  # pushed at the last tick; last time without a push [s]
        self._pushes: list[float] = []  # onsets of pushes by an external force [s]

    def add(self, out, table: Ticks) -> None:
        """Add ticks, with the estimator's outputs at them."""
        if self._rested == -np.inf:
            self._rested = float(table.time[0])
        since = np.maximum.accumulate(np.where(out.pushed, self._rested, table.time))
        leans = out.pushed & (table.time - since > LEANS_S)
        starts = np.flatnonzero(out.pushed & ~np.concatenate([[self._pushed], out.pushed[:-1]]))
        self._pushes += table.time[starts].tolist()
        self._pushed, self._rested = bool(out.pushed[-1]), float(since[-1])
        # A lateral force turns the vehicle as well; a contact may leave another trim.
        arrays = (usable(table) & ~out.pushed, table.restart | leans, table.time, table.thrust, out.biases, out.log_odds, out.onset)
        self._new.append(arrays)
        if len(self._new) > TOGETHER:
            self._join()

    def _join(self) -> None:
        if not self._new:
            return
        ticks = self._rest.joined(self._looked_at(*map(np.concatenate, zip(*self._new, strict=True))))
        self._new.clear()
        while True:
            whole = len(ticks.sums) // self._each * self._each
            added = ticks.part(slice(whole)).merged(self._each)
            if len(self._rows.sums) + len(added.sums) <= ROWS:
                break
            self._rows = self._rows.merged(2)  # the last row of an odd number is half of a new one
            self._each *= 2
        self._rows, self._rest = self._rows.joined(added), ticks.part(slice(whole, None))

    def _looked_at(self, use, restart, time, thrust, biases, log_odds, onset) -> Rows:
        """Rows of the usable ticks."""
        begun = int(self._began) + np.cumsum(restart)
        count = begun[use]
        self._began = bool(begun[-1] > count[-1]) if count.size else bool(begun[-1])
        n = self.B.shape[1]
        odds, others = log_odds[use, :n], log_odds[use][:, self._disturbance].max(axis=1)
        when = np.broadcast_to(time[use, None], odds.shape)
        since = when - self._dt * onset[use, None]
        sums = np.concatenate([biases[use], thrust[use]], axis=1)
        return Rows(sums, odds, when, since, odds >= others[:, None], np.diff(count, prepend=0) > 0)

    def suspected(self, found: Sequence[Event], end_s: float) -> tuple[Event, ...]:
        """The rotors of a step that began with certain evidence and lasted until end_s. found: events, for the knocks, whose evidence
        concerns themselves."""
        step = self.step()
        if step is None or step.nats.max() < CERTAIN_NATS:
            return ()
        if (step.loss - step.half)[step.nats.argmax()] < dict(SCALE)["worn"]:
            return ()
        who = np.flatnonzero(step.nats > step.nats.max() - hypotheses.CLEAR)
        last_row = len(self._rows.sums) - 1
        about = (step.before + step.block * SPELL * np.array([-1.0, 1.0])) * last_row
        first, last = np.clip(about, 0, last_row).astype(int)
        here = self._rows.part(slice(first, last + 1))
        odds = np.where(self._disturbed(here.when, found), -np.inf, here.odds)[:, who]
        if odds.max() < CERTAIN_NATS or here.began[1:].any():
            return ()  # battery and payload change as well between two flights
        sure, rotor = np.unravel_index(odds.argmax(), odds.shape)
        rotors = tuple(int(i) + 1 for i in who[step.nats[who].argsort()[::-1]])
        half = WITHIN_95 * event_rows.sd_of(step.loss, step.half / WITHIN_95, self.B)
        low, high = np.clip([step.loss - half, step.loss + half], 0.0, 1.0)
        interval = tuple((float(low[i - 1]), float(high[i - 1])) for i in rotors)
        since = float(here.onset[sure, who[rotor]])
        return (unexplained_evidence.claim(rotors, since, end_s, interval, source=STEPS),)

    def _disturbed(self, when: np.ndarray, found: Sequence[Event]) -> np.ndarray:
        """True if the evidence at these times [s] is due to a knock among the events, or to a push."""
        pushed = np.zeros(np.shape(when), bool)
        for start in self._pushes:
            pushed |= (when > start - PUSH_S) & (when <= start)
        return pushed | unexplained_evidence.knocked(when, found)

    def doubted(self, found: Sequence[Event]) -> tuple[Event, ...]:
        """The events, with alternatives added to a loss of control without a rotor at fault: rotors against which evidence was certain
        shortly before, and exceeded that of any disturbance. Their deficit by then is part of the trim that the rotors are assessed by."""
        return tuple(self._doubted(e, found) if e.kind == LOST else e for e in found)

    def _doubted(self, lost: Event, found: Sequence[Event]) -> Event:
        self._join()
        rows, worked = self._rows, lost.extra.get("worked_until_s", ())
        if lost.rotors or lost.alternatives or lost.extra.get("cause") not in CLEARS or not len(rows.sums):
            return lost
        shortly = (rows.when >= lost.onset_s - plant.USUAL_S) & (rows.when < lost.detected_s)
        odds = np.where(shortly & rows.leads & ~self._disturbed(rows.when, found), rows.odds, -np.inf)
        most, since = odds.max(axis=0), np.take_along_axis(rows.onset, odds.argmax(axis=0)[None], axis=0)[0]
        if most.max() < CERTAIN_NATS:
            return lost
        who = np.flatnonzero(most > most.max() - hypotheses.CLEAR).tolist()
        names = " and ".join(f"rotor {i + 1} (since {since[i]:.1f} s)" for i in who)
        how = f"the vehicle departed controlled flight at {lost.onset_s:.1f} s, {lost.extra.get('how', '')}"
        worked = [min(t, float(since[i])) if t is not None and i in who else t for i, t in enumerate(worked)]
        return replace(
            lost, alternatives=tuple((i + 1,) for i in who),
            reason=f"{how}: the cause is unknown; before that there was evidence against {names}",
            extra={**lost.extra, "cause": "unknown", "worked_until_s": worked, "evidence": []},
        )  # fmt: skip

    def losses(self) -> np.ndarray:
        """Upper bound (n,) of the loss of each rotor since assessing began that was not announced; 1 where too little was assessed."""
        return self._of(np.eye(self.B.shape[1]), 3).upper(self.B)

    def step(self) -> Step | None:
        """The step of one rotor with the largest evidence, or None where too little was assessed."""
        steps = self._of(np.eye(self.B.shape[1]), 3)
        return steps.largest() if len(steps.before) else None

    def pair(self, partners: Mapping[int, Sequence[int]]) -> float:
        """The same for equal losses of two rotors, the largest of all pairs; 0 without any. partners: the opposite rotors of each rotor
        (0-based)."""
        pairs = [(i, j) for i, js in partners.items() for j in js if i < j]
        sets = np.zeros((self.B.shape[1], len(pairs)))
        for k, pair in enumerate(pairs):
            sets[list(pair), k] = 1.0
        return float(self._of(sets, 4).upper(self.B).max(initial=0.0))

    def _of(self, sets: np.ndarray, axes: int) -> _Steps:
        """Equal losses of sets of rotors (n, m), by the first axes."""
        self._join()
        rows = self._rows.sums
        if len(rows) < 2 * BLOCKS[0]:
            return _Steps(np.zeros(0), np.zeros((0, sets.shape[1])), np.zeros((0, sets.shape[1])), 1)
        N = int(np.clip(len(rows) * self._each * self._dt / STEP_S, *BLOCKS))
        sums = np.add.reduceat(rows, np.arange(N) * len(rows) // N)
        usual = sums[:, 4:].mean(axis=1, keepdims=True)
        return _steps(sums[:, :axes] / usual, sums[:, 4:] / usual, self.B[:axes], sets)


class Step(NamedTuple):
    """A step of the biases as a loss of one rotor. before: share of the assessed ticks before it; block: share of one block; loss (n,) of
    each rotor; half (n,): half its 95 % interval; nats (n,): evidence of each against no step."""

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

    def upper(self, B: np.ndarray) -> np.ndarray:
        """(m,): the largest upper end over all onsets but the first and the last, with the uncertainty of the vehicle's model; 1 without
        any."""
        if not len(self.before):
            return np.ones(self.loss.shape[1])
        loss = np.maximum(self.loss, 0.0)
        upper = loss + WITHIN_95 * event_rows.sd_of(loss, self.half() / WITHIN_95, B)
        edge = max(0, min(FIRM, self.N // 4) - SPELL)
        return np.minimum(upper[edge : len(upper) - edge].max(axis=0), 1.0)

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
    # The scatter is about the best step: about any other one, the step itself would count as scatter.
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
