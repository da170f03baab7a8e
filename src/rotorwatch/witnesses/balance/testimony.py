"""What a rotor's balance says on a loss of thrust: log-odds that join the motion's in the comparison of explanations.

A propeller that loses a piece loses thrust and balance at once; a weak motor, or an ESC, loses thrust alone; and a propeller may get out of
balance otherwise. With x the logarithm of a rotor's imbalance over what it should be, the evidence for a loss of its thrust is

    log [ ((1 - SHARE) p0(x) + SHARE p1(x)) / ((1 - ELSE) p0(x) + ELSE p1(x)) ]

p0: of a propeller that stays whole, p1: of one that lost a piece, SHARE and ELSE: probabilities of the latter with and without a loss of
thrust. So no imbalance says much more than log(SHARE / ELSE) for a loss, nor one less than log(1 - SHARE) against it.

At an onset x compares the figure after it with that before, less the other rotors' median change: p0 is Student's t with the errors of both
figures and SCATTER (unbalanced.py: steady within a flight, but the speeds change), wide tails for what no error shows; what may be the
sidebands of another rotor's tone says nothing for a loss. From take-off x
compares with earlier flights of the vehicle, where there are some, else with the root mean square of its other rotors: the ratio of squares
is F(2, 2 (n - 1)) (unbalanced.py), times a frame's gain that scatters by FRAME. p1: normal about GROWN with GROWN_SD, and flat above: 3 %
of a blade's mass at its tip shakes 2 to 27 times as much as what balancing leaves, more of small propellers (docs/balance.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.witnesses.balance.imbalances import Figure, Heard, history
from rotorwatch.witnesses.balance.unbalanced import SCATTER, SIDEBANDS, WORTH, gained, rise

SHARE = 0.5
ELSE = 0.01, 0.05  # at one time; in the life of a propeller so far
GROWN, GROWN_SD = 1.5, 1.0
DOF = 4.0
FRAME = 0.4
NORMAL = np.linspace(-3.0, 3.0, 61)


def at(found: Heard, onset: float) -> np.ndarray:
    """(n,) log-odds for a loss of each rotor's thrust at `onset` s; 0 of a rotor that is not heard on both sides of it."""
    changes = [rise(found, k, onset) for k in range(len(found.figures))]
    heard = {k: one[1:] for k, one in enumerate(changes) if one is not None}
    grown = {k: _log(after) - _log(before) for k, (before, after) in heard.items()}
    out = np.zeros(len(changes))
    for k, (before, after) in heard.items():
        rest = [x for j, x in grown.items() if heard[j][1].together != after.together]
        x = grown[k] - (float(median(np.array(rest))) if rest else 0.0)
        sd = np.sqrt(SCATTER**2 + _sd(before) ** 2 + _sd(after) ** 2)
        out[k] = _odds(_student(x / sd) / sd, _grown(x, sd), ELSE[0])
        most = max((gained(changes[j]) for j in grown if heard[j][1].together != after.together), default=0.0)
        if gained(changes[k]) < SIDEBANDS * most:
            out[k] = min(out[k], 0.0)
    return out


def from_takeoff(found: Heard, earlier: Sequence[Mapping[str, Any]] = ()) -> np.ndarray:
    """(n,) log-odds for a loss of each rotor's thrust since take-off; 0 of a rotor that is not heard. earlier: as of
    `unbalanced.findings`."""
    n = len(found.figures)
    past, out = history(earlier, found.channel.unit, n), np.zeros(n)
    for k, figure in enumerate(found.figures):
        if figure is None or len(figure.together) > 1:
            continue
        floor, value = _floor(figure), _log(figure)
        if past[k].size:
            logs = np.log(np.maximum(past[k], floor))
            own = np.square(logs - logs.mean()).sum()
            sd = np.sqrt((WORTH * SCATTER**2 + own) / (WORTH + logs.size - 1.0) * (1.0 + 1.0 / logs.size) + _sd(figure) ** 2)
            x = value - logs.mean()
            out[k] = _odds(_student(x / sd) / sd, _grown(x, sd), ELSE[1])
            continue
        others = list({f.together: f.value for f in found.figures if f is not None and f is not figure}.values())
        if len(others) >= 2 and found.channel.accel:
            x = value - np.log(max(float(np.sqrt(np.mean(np.square(others)))), floor))
            sd = float(np.hypot(FRAME, _sd(figure)))
            ratio, share = np.exp(2.0 * (x - sd * NORMAL)), np.exp(-0.5 * NORMAL**2)
            whole = float(share @ (2.0 * ratio * (1.0 + ratio / len(others)) ** -(len(others) + 1.0)) / share.sum())
            out[k] = _odds(whole, _grown(x, sd), ELSE[1])
    return out


def _odds(whole: float, damaged: float, otherwise: float) -> float:
    ratio = damaged / max(whole, 1e-300)
    return float(np.log(1.0 - SHARE + SHARE * ratio) - np.log(1.0 - otherwise + otherwise * ratio))


def _grown(x: float, sd: float) -> float:
    width = np.hypot(GROWN_SD, sd)
    return float(np.exp(-0.5 * (min(x - GROWN, 0.0) / width) ** 2) / width / np.sqrt(2.0 * np.pi))


def _student(t: float) -> float:
    """Density of Student's t with DOF = 4."""
    return 0.375 * (1.0 + t * t / DOF) ** -2.5


def _sd(figure: Figure) -> float:
    """Standard deviation of the logarithm of a figure that is at least `_floor`."""
    low = max(figure.low, 0.5 * _floor(figure))
    return float(np.log(max(figure.high, _floor(figure)) / low) / (2.0 * WITHIN_95))


def _log(figure: Figure) -> float:
    return float(np.log(max(figure.value, _floor(figure))))


def _floor(figure: Figure) -> float:
    """What is not heard in the mean of the windows."""
    return max(figure.noise / figure.windows**0.25, 1e-9)
