"""Losses that grow slowly, and losses that are said to be over and last, found afterwards in the trim of a whole flight (trim.py).

A step of one rotor is told by the estimator. Where it has told that the step is over, its end is held against the trim after it: a loss
that is over leaves none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rotorwatch.answer.trim import SIZES, Explained
from rotorwatch.answer.wording import SCALE
from rotorwatch.engine.default import events, residual_evidence
from rotorwatch.engine.estimator.plant import USUAL_S
from rotorwatch.engine.front.decisions import CLEAR, CREDIBLE
from rotorwatch.engine.front.losses import CURVE_SHARE, WITHIN_95
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import LOSS

GROWS_S = 8.0  # less is a step, after which the biases take a while to settle
LATER = 3  # blocks after a loss, at least, that tell whether it is over
LASTS = 0.5  # share of a loss that is still there when it is not over
BEGUN = 0.95  # probability with which it had begun by the time that is told
CURVE_SD = 0.12  # of an expo, that makes a curve steeper by CURVE_SHARE
LEAST_SHARE = 0.1  # of the mean thrust: a rotor that is commanded less shows nothing


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


def find(found: Explained | None, B: np.ndarray) -> Growth | None:
    """The loss of one rotor that lasts to the end of a flight and is likelier than anything else; None where there is none. found: what
    explains its trim; B (4, n): effectiveness."""
    if found is None:
        return None
    seen, starts, rises, logs = found.trim, found.starts, found.rises, found.losses
    rotor = np.logaddexp.reduce(logs, (0, 2))  # (n,), with the prior
    best = int(rotor.argmax())
    odds = found.odds(logs[:, best])
    if odds < 1.0:
        return None
    grows = rises * seen.length >= GROWS_S
    grew = bool(
        grows.any()
        and np.logaddexp.reduce(logs[grows][:, best], (0, 1)) > np.logaddexp.reduce(logs[~grows][:, best], (0, 1))
    )
    grows = grows if grew else ~grows
    who = np.flatnonzero(rotor > rotor[best] + np.log(CREDIBLE))
    who = who[np.argsort(-rotor[who])]
    each = [_size(logs[grows][:, i], B, seen.curve_sd) for i in who]
    if each[0][1] < dict(SCALE)["worn"]:
        return None
    weight = np.exp(np.logaddexp.reduce(logs[grows][:, best], 1) - rotor[best])
    start, end = (
        found.since(_quantile(of[grows], weight, share)) for of, share in ((starts, BEGUN), (starts + rises, 0.5))
    )
    shows = start + (end - start) * min(dict(SCALE)["worn"] / each[0][0], 1.0)
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


def suspected(grown: Growth | None) -> tuple[Event, ...]:
    """Evidence against the rotors of a loss that seems to have grown."""
    if grown is None or not grown.grew:
        return ()
    share = grown.odds / (1.0 + grown.odds)
    who = grown.rotors, grown.start_s, grown.looked_s, grown.interval
    return (residual_evidence.claim(*who, probability=share, source=Source.TRIM),)
