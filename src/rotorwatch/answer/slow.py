"""Losses that grow slowly, and losses that are said to be over and last, found afterwards in the trim of a whole flight.

The estimator announces steps. What grows over seconds or minutes it takes for a disturbance, and of a step within it only that step is
announced. Over the whole flight a loss that grows shows in

    z = (b + B T theta) / mean T      as      r L B_i T_i / mean T

b, theta: biases and losses as estimated, T: thrusts commanded, L: the loss of rotor i at the end, r: 0 until t0, 1 from t1 on, straight
between. The explanations of z on roll, pitch and yaw, each weighed by its evidence and its prior:

    nothing     a level, and what manoeuvres do
    a rotor     one L of rotor i on all axes; any size is as likely as any other
    other       any drift: of each axis by an amount of its own, of a Cauchy distribution of scale DRIFT - wind that turns, a load that
                shifts, a mount that gives -, of all axes at the same time or of each at its own

The noise of each axis is a random walk and white noise of any size and ratio (`methods/maths/trend.py`), for air wanders; white noise is
larger where z scatters more within a block of time. Manoeuvres show in z where gains are off, by GAIN or so: in proportion to commands of
torque that come and go within SMOOTH blocks. Thrust, which battery and air move for all rotors alike, is left out. So a drift is a rotor's
where it has the direction of that rotor, and is larger than drifts are.

A step of one rotor is told by the estimator. Where it has told that the step is over, its end is held against the trim after it: a loss
that is over leaves none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rotorwatch.answer import unseen
from rotorwatch.answer.wording import SCALE
from rotorwatch.engine.default import events
from rotorwatch.engine.default.residual_evidence import ResidualEvidence
from rotorwatch.engine.estimator.plant import USUAL_S
from rotorwatch.engine.front.losses import CLEAR, CREDIBLE, CURVE_SHARE, WITHIN_95
from rotorwatch.engine.motion.ticks import JUDGE, Ticks
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.methods.maths.trend import DOUBT, LEAST, WHITE

LEAST_S = 30.0  # of flight, below which nothing is looked for
BLOCK_S, BLOCKS = 2.0, 60  # length of a block at least; so many at most
RISES = (0, 3, 5, 8, 12, 18, 27, 40)  # blocks from t0 to t1
ONSETS = 20  # t0 that are tried for each, at most
GROWS_S = 8.0  # less is a step, after which the biases take a while to settle
SMOOTH, GAIN = 5, 0.2  # blocks; standard deviation of what gains are off by
LATER = 3  # blocks after a loss, at least, that tell whether it is over
LASTS = 0.5  # share of a loss that is still there when it is not over
BEGUN = 0.95  # probability with which it had begun by the time that is told
DRIFT = np.array([0.1, 0.1, 0.2])  # hover thrusts of one rotor, per mean thrust: roll, pitch, yaw
AMOUNTS = np.concatenate([-np.geomspace(1.5, 0.01, 40), np.geomspace(0.01, 1.5, 40)])  # the same, of a drift
RARE = 0.01  # how often a rotor loses slowly, to how often something else drifts
CURVE_SD = 0.12  # of an expo, that makes a curve steeper by CURVE_SHARE
LEAST_SHARE = 0.1  # of the mean thrust: a rotor that is commanded less shows nothing
SIZES = np.linspace(0.03, 0.99, 33)


class Growth(NamedTuple):
    """A loss that has grown, or a step. rotors: who it may be of (from 1), the likeliest first; start_s: since when it has been more than
    `healthy` on the scale of `wording`; end_s: when it ceased to grow, or was last seen; loss, interval: of each, at the end; odds: of the
    likeliest rotor, to everything else; looked_s: the last time that was looked at; grew: it is no step; course: (time [s], loss of the
    likeliest rotor) of each block."""

    rotors: tuple[int, ...]
    start_s: float
    end_s: float
    loss: tuple[float, ...]
    interval: tuple[tuple[float, float], ...]
    odds: float
    looked_s: float
    grew: bool
    course: tuple[tuple[float, float], ...]

    def left(self, after_s: float) -> float:
        """The loss that the trim shows after a time [s]; 0 where it shows too little."""
        later = [loss for time, loss in self.course if time > after_s]
        return float(np.median(later)) if len(later) >= LATER else 0.0

    @property
    def certain(self) -> bool:
        """Is it one rotor's, beyond doubt?"""
        return len(self.rotors) == 1 and self.odds > CLEAR


class Trim(NamedTuple):
    """N blocks of time: time (N,) s; at (N,): their numbers; z (N, 3); share (N, n): thrusts over their mean; white (N,): variance of white
    noise, to the least; length: of a block, s."""

    time: np.ndarray
    at: np.ndarray
    z: np.ndarray
    share: np.ndarray
    white: np.ndarray
    length: float


def trim(out, table: Ticks, B: np.ndarray) -> Trim | None:
    """The trim since the last take-off or knock; None where too little was judged. out: the estimator's stacked outputs (theta (T, n),
    biases (T, 4)); B (4, n): effectiveness."""
    judging = table.mode == JUDGE
    begins = table.time[judging & ~np.concatenate([[False], judging[:-1]])]
    if not begins.size:
        return None
    rows = np.flatnonzero(unseen.usable(table) & (table.time >= begins[-1] + USUAL_S))
    if rows.size < LEAST or table.time[rows[-1]] - table.time[rows[0]] < LEAST_S:
        return None
    time, T = table.time[rows], table.thrust[rows]
    span = float(time[-1] - time[0]) + table.dt
    count = int(np.clip(span / BLOCK_S, LEAST, BLOCKS))
    block = np.minimum(((time - time[0]) / span * count).astype(int), count - 1)
    size = np.bincount(block, minlength=count)
    some = size >= 0.5 * size.max()
    if some.sum() < LEAST:
        return None

    def mean(rows: np.ndarray) -> np.ndarray:
        return np.column_stack([np.bincount(block, column, minlength=count)[some] / size[some] for column in rows.T])

    usual = mean(T.mean(axis=1, keepdims=True))
    z = ((out.biases[rows] + (T * out.theta[rows]) @ B.T) / T.mean(axis=1, keepdims=True))[:, :3]
    scatter = mean(z**2) - mean(z) ** 2
    white = np.maximum((scatter / np.maximum(np.median(scatter, axis=0), 1e-12)).max(axis=1), 1.0)
    at = np.flatnonzero(some)
    return Trim(time[0] + span * (at + 0.5) / count, at, mean(z), mean(T) / usual, white, span / count)


def find(out, table: Ticks, B: np.ndarray) -> Growth | None:
    """The loss of one rotor that lasts to the end of a flight and is likelier than anything else; None where there is none."""
    seen = trim(out, table, B)
    if seen is None:
        return None
    starts, rises = _courses(seen.at)
    logs, nothing = _weighed(seen, B, starts, rises)
    rotor = np.logaddexp.reduce(logs, (0, 2))  # (n,), with the prior
    best = int(rotor.argmax())
    rest = np.logaddexp(nothing, np.logaddexp.reduce(np.delete(rotor, best), 0))
    if rotor[best] < rest:
        return None
    grows = rises * seen.length >= GROWS_S
    grew = bool(
        grows.any()
        and np.logaddexp.reduce(logs[grows][:, best], (0, 1)) > np.logaddexp.reduce(logs[~grows][:, best], (0, 1))
    )
    grows = grows if grew else ~grows
    who = np.flatnonzero(rotor > rotor[best] + np.log(CREDIBLE))
    who = who[np.argsort(-rotor[who])]
    each = [_size(logs[grows][:, i], B, table.curve[1]) for i in who]
    if each[0][1] < dict(SCALE)["worn"]:
        return None
    weight = np.exp(np.logaddexp.reduce(logs[grows][:, best], 1) - rotor[best])
    start, end = (
        float(seen.time[0] + seen.length * (_quantile(of[grows], weight, share) - seen.at[0]))
        for of, share in ((starts, BEGUN), (starts + rises, 0.5))
    )
    shows = start + (end - start) * min(dict(SCALE)["worn"] / each[0][0], 1.0)
    odds = float(np.exp(min(rotor[best] - rest, 50.0)))
    before = seen.z[: max(1, int(np.searchsorted(seen.time, start)))].mean(axis=0)
    course = (seen.z - before) @ B[:3, best] / ((B[:3, best] ** 2).sum() * np.maximum(seen.share[:, best], LEAST_SHARE))
    return Growth(
        tuple(int(i) + 1 for i in who), shows, min(end, float(seen.time[-1])), tuple(e[0] for e in each),
        tuple(e[1:] for e in each), odds, float(seen.time[-1]), grew, tuple(zip(seen.time.tolist(), course.tolist())),
    )  # fmt: skip


def _quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """The least of the values below which, itself included, lies this share of the weight."""
    order = np.argsort(values)
    below = weight[order].cumsum()
    return float(values[order][np.searchsorted(below, share * below[-1])])


def _size(logs: np.ndarray, B: np.ndarray, curve_sd: float) -> tuple[float, float, float]:
    """(loss, low, high) of one rotor, of its log-odds (courses, sizes). curve_sd: of the expo of the thrust curve, as in `Ticks`."""
    weight = np.exp(np.logaddexp.reduce(logs, 0) - logs.max())
    mean = float(weight @ SIZES / weight.sum())
    sd = np.sqrt(weight @ (SIZES - mean) ** 2 / weight.sum() + (0.5 * (SIZES[1] - SIZES[0])) ** 2)
    steeper = CURVE_SHARE * curve_sd / CURVE_SD * mean  # as in `losses.sd_of`, of a curve that nothing has told
    open_ = steeper * (1.0 - mean) / (1.0 - mean + steeper)
    half = WITHIN_95 * float(np.hypot(events.sd_of(np.array(mean), np.array(sd), B), open_))
    return mean, max(mean - half, 0.0), min(mean + half, 1.0)


def _courses(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C,) t0 and (C,) t1 - t0, in blocks."""
    found = []
    for rise in RISES:
        last = max(at[0] + 1.0, at[-1] - 1.0 - 0.5 * rise)
        found += [(start, rise) for start in np.unique(np.linspace(at[0] + 1.0, last, ONSETS).round())]
    starts, rises = np.array(found, float).T
    return starts, rises


def _weighed(seen: Trim, B: np.ndarray, starts: np.ndarray, rises: np.ndarray) -> tuple[np.ndarray, float]:
    """Log-odds, with the prior, to the explanation `nothing`: of each course, rotor and size (C, n, S), and of all others together."""
    (N, n), C, at = seen.share.shape, len(starts), seen.at
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

    logs, together, apart = np.zeros((C, n, SIZES.size)), np.zeros(C), 0.0
    for axis in range(3):
        none = log_fit(axis, 0, np.zeros(1))[0, 0]
        density = np.gradient(AMOUNTS) / (np.pi * DRIFT[axis] * (1.0 + (AMOUNTS / DRIFT[axis]) ** 2))
        drift = np.logaddexp.reduce(log_fit(axis, 0, AMOUNTS) + np.log(density), 1) - none
        together += drift
        apart += np.logaddexp(0.0, np.logaddexp.reduce(drift, 0) - np.log(C)) - np.log(2.0)
        logs += log_fit(axis, slice(1, None), SIZES * B[axis, :, None]) - none
    other = np.logaddexp.reduce(np.array([0.0, np.logaddexp.reduce(together, 0) - np.log(C), apart]), 0) - np.log(3.0)
    return logs + np.log(RARE / (C * n * SIZES.size)), float(other)


def _lines(at: np.ndarray) -> np.ndarray:
    """(N, N): what gives the value at each time of the straight line through the values near it."""
    apart = at[None, :] - at[:, None]
    near = (np.abs(apart) <= SMOOTH).astype(float)
    m0, m1, m2 = near.sum(axis=1), (near * apart).sum(axis=1), (near * apart**2).sum(axis=1)
    return near * (m2[:, None] - m1[:, None] * apart) / np.maximum(m0 * m2 - m1**2, 1e-9)[:, None]


def join(losses: Sequence[Event], grown: Growth | None) -> tuple[Event, ...]:
    """The losses of a flight with the one that the trim shows, if that is certain. One that grew is an event; what was announced within it
    is its beginning. Losses of its rotor that were said to be over, though the trim still shows them, are one that lasts. Beside certain
    losses of other rotors, of which the trim is not clear, nothing is said."""
    if grown is None or not grown.certain:
        return tuple(losses)
    (rotor,), (size,), ((low, _),) = grown.rotors, grown.loss, grown.interval
    accusing = [e for e in losses if events.accuses(e)]
    own = [e for e in accusing if any(who == (rotor,) for who in e.explanations)]
    over = [e.end_s for e in own if e.end_s is not None]
    stays = len(over) == len(own) > 0 and grown.left(max(over) + USUAL_S) > LASTS * size
    step = any(not e.alternatives and low <= e.loss[0] for e in own)  # it is told already, as far as can be seen
    if len(own) < len(accusing) or not (stays or (grown.grew and not over and not step)):
        return tuple(losses)
    first, grew = min((e.onset_s for e in own), default=np.inf), grown.grew and not stays
    reason = (
        f"the rotors came to be commanded a torque that the motion does not show, along the direction of rotor {rotor} and by more than "
        "wind or load drift"
    )
    if stays:
        reason = f"{own[0].reason}; what looked like its end left the trim as it was"
    event = Event(
        LOSS, (rotor,), min(grown.start_s, first) if grew else first, min((e.detected_s for e in own), default=grown.looked_s), None,
        (size,), grown.interval, grown.odds / (1.0 + grown.odds), (), reason,
        {"live": bool(own), "loss_2s": [round(size, 4)], **({"grew_until_s": grown.end_s} if grew else {})},
    )  # fmt: skip
    rest = [e for e in losses if e not in own and e.rotors != (rotor,)]
    return tuple(sorted((*rest, event), key=lambda e: e.detected_s))


def suspected(grown: Growth | None, found: Sequence[Event]) -> tuple[ResidualEvidence, ...]:
    """The rotors of a loss that seems to have grown, of a flight whose events tell of no loss."""
    if grown is None or not grown.grew or any(e.kind == LOSS for e in found):
        return ()
    return (ResidualEvidence(grown.rotors, grown.start_s, grown.looked_s, grown.interval),)
